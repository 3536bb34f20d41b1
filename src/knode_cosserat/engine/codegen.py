"""Machine code from Python: values, arrays, loops and functions of an LLVM module.

A value is a number or a vector of `lanes` numbers. An operation on a number and a vector repeats the number
in every lane. Python's operators and loops over Python lists write straight-line code; `Function.loop`,
`Function.while_` and `Function.if_` write control flow. Programs (`program.Program`) become straight-line
code by `Function.evaluate`.
"""

from __future__ import annotations

import contextlib
import contextvars
import dataclasses
import functools
import itertools
import operator
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from knode_cosserat.engine import elementary
from knode_cosserat.engine.arrays import ArrayCode, summands
from knode_cosserat.engine.program import EngineError, Program

if TYPE_CHECKING:
    from knode_cosserat.engine.machine_code import MachineCode

#: functions of one number that LLVM provides, then those of the C library, a call for every lane
INTRINSICS = {
    "abs": "fabs",
    "sqrt": "sqrt",
    "exp": "exp",
    "log": "log",
    "sin": "sin",
    "cos": "cos",
    "max": "maximum",
    "min": "minimum",
    "pow": "pow",
    "floor": "floor",
}
LIBRARY = {
    "log1p",
    "expm1",
    "tanh",
    "sin",
    "cos",
    "tan",
    "atan",
    "asin",
    "acos",
    "atan2",
    "erf",
    "fmod",
}
COMPARISONS = {"lt": "olt", "le": "ole", "gt": "ogt", "ge": "oge", "eq": "oeq", "ne": "une"}


#: numbers of a vector where code is written for another computer
LANES: contextvars.ContextVar[int | None] = contextvars.ContextVar("LANES", default=None)


def vector_lanes() -> int:
    """Return the numbers of a vector: those of this computer's registers, or of another one's (`LANES`).

    Vectors that take two registers need twice as long to compile, and steps are up to 1.3 times as slow.
    """
    return LANES.get() or _own_lanes()


@functools.cache
def _own_lanes() -> int:
    import llvmlite.binding as llvm  # later than the package, which is to be imported fast

    return 8 if llvm.get_host_cpu_features().get("avx512f") else 4


def literal(value: float) -> str:
    """Return a floating-point constant in LLVM's notation."""
    return f"0x{struct.unpack('<Q', struct.pack('<d', float(value)))[0]:016X}"


#: arrays with the addresses at which their sums are added, and which lanes are inside
Sums = tuple[Sequence[tuple[int, "Value"]], Any]
#: functions that write the value of a node, and return how it is read from then on
Stores = Mapping[int, Callable[["Value"], Any]]
Operator = Callable[["Value", Any], "Value"]


def _arithmetic(operation: str) -> tuple[Operator, Operator]:
    """Return an operator, and the one for a value on its right."""
    return (
        lambda value, other: value.function.binary(operation, value, other),
        lambda value, other: value.function.binary(operation, other, value),
    )


def _comparison(operation: str) -> Operator:
    return lambda value, other: value.function.compare(operation, value, other)


@dataclasses.dataclass(eq=False, slots=True)
class Value:
    """A number ("double"), truth ("i1") or whole number ("i64"), or a vector of `lanes` of them."""

    function: Function
    name: str
    kind: str = "double"
    lanes: int = 1
    #: of a product: its factors, and the block of code in which it is
    product: tuple[Value, Value, int] | None = None

    @property
    def type(self) -> str:
        """The type in LLVM's notation."""
        return self.kind if self.lanes == 1 else f"<{self.lanes} x {self.kind}>"

    __add__, __radd__ = _arithmetic("add")
    __sub__, __rsub__ = _arithmetic("sub")
    __mul__, __rmul__ = _arithmetic("mul")
    __truediv__, __rtruediv__ = _arithmetic("div")
    __lt__, __le__, __gt__, __ge__ = map(_comparison, ("lt", "le", "gt", "ge"))

    def __neg__(self) -> Value:
        return self.function.apply("neg", self)

    def __and__(self, other: Any) -> Value:
        return self.function.logical("and", self, other)

    def __or__(self, other: Any) -> Value:
        return self.function.logical("or", self, other)

    def __invert__(self) -> Value:
        return self.function.logical("xor", self, True)


class Index:
    """A whole number, plus a constant, that counts places in memory.

    The address of a place is written once, where the number is known, and serves all numbers stored there.
    """

    def __init__(self, value: Value, slot: list[str], delta: int = 0):
        self._root, self._slot, self.delta = value, slot, delta

    def __add__(self, number: int | Value) -> Index:
        """Return the sum with a number, known now or in the whole function (`Function.constant`)."""
        if isinstance(number, int):
            return Index(self._root, self._slot, self.delta + number)
        function, root = self._root.function, self._root
        key = (root.name, number.name)
        if key not in function.addresses:
            name = function.fresh()
            self._slot.append(f"  {name} = add nsw i64 {root.name}, {number.name}")
            function.addresses[key] = Value(function, name, "i64")
        return Index(function.addresses[key], self._slot, self.delta)

    @property
    def value(self) -> Value:
        """The number."""
        return self._root + self.delta if self.delta else self._root

    @property
    def key(self) -> tuple[str, int]:
        """A key that is equal for the same number in one function."""
        return self._root.name, self.delta

    def address(self, base: Value, place: int) -> Value:
        """Return the address of the place `value - delta`, `place` doubles apart from the next."""
        function, root = self._root.function, self._root
        key = (base.name, root.name, place)
        if key not in function.addresses:
            a, b = (function.fresh() for _ in range(2))
            self._slot.append(f"  {a} = mul nsw i64 {root.name}, {place}")
            self._slot.append(f"  {b} = getelementptr inbounds double, ptr {base.name}, i64 {a}")
            function.addresses[key] = Value(function, b, "ptr")
        return function.addresses[key]


class StackVariable:
    """A value that changes in loops: memory on the stack, which LLVM turns into registers."""

    def __init__(self, function: Function, value: Value):
        self._function, self._kind, self._lanes = function, value.kind, value.lanes
        # booleans are stored as they are; alignment is the type's own
        self._place = function.reserve(value.type)
        self.set(value)

    def set(self, value: Any) -> None:
        """Change the value."""
        value = self._function.splat(self._function.value(value, self._kind), self._lanes)
        self._function.emit(f"store {value.type} {value.name}, ptr {self._place}")

    def get(self) -> Value:
        """Return the value."""
        kind = self._kind if self._lanes == 1 else f"<{self._lanes} x {self._kind}>"
        return self._function.result(f"load {kind}, ptr {self._place}", self._kind, self._lanes)


class Values(dict[int, Any]):
    """Values of nodes; a function that reads one is called at every use, so that it takes no register."""

    def __getitem__(self, node: int) -> Any:
        value = super().__getitem__(node)
        return value() if callable(value) else value


class Module:
    """Functions that are compiled together."""

    def __init__(self) -> None:
        self._functions: list[Function] = []
        self.declarations: set[str] = set()
        self._elementary: set[str] = set()
        self._tables: dict[tuple[float, ...], str] = {}

    def function(self, name: str, arguments: Sequence[str], exported: bool = False) -> Function:
        """Begin a function; arguments are pointers, or whole numbers if their name begins with `n_`."""
        self._functions.append(Function(self, name, arguments, exported))
        return self._functions[-1]

    def constants(self, values: Sequence[float]) -> str:
        """Return the address of constants in memory."""
        return self._tables.setdefault(tuple(map(float, values)), f"@table{len(self._tables)}")

    def elementary(self, operation: str, lanes: int) -> str:
        """Return the name of an elementary function of vectors."""
        name = f"{operation}.{lanes}"
        if name not in self._elementary:
            self._elementary.add(name)
            f = Function(self, name, ["x"], False, lanes)
            x = f.arguments[0]
            found = StackVariable(f, elementary.FUNCTIONS[operation](f, x))
            if operation in elementary.OF_ANGLES:
                with f.if_(f.any(f.apply("abs", x) > elementary.LARGEST_ANGLE)):
                    found.set(f.call_library(operation, [x]))
            f.returned = found.get()
            self._functions.append(f)
        return name

    @property
    def text(self) -> str:
        """The module in LLVM's assembly language."""
        tables = []
        for numbers, name in self._tables.items():
            inside = ", ".join(f"double {literal(number)}" for number in numbers)
            tables.append(f"{name} = internal constant [{len(numbers)} x double] [{inside}], align 64")
        functions = (function.text for function in self._functions)
        return "\n".join([*sorted(self.declarations), *tables, *functions])

    def compile(self) -> MachineCode:
        """Return the exported functions as machine code for this computer."""
        from knode_cosserat.engine.machine_code import MachineCode  # LLVM is imported when it is needed

        kinds = {
            each.name: "".join("p" if own.kind == "ptr" else "n" for own in each.arguments)
            for each in self._functions
            if each.exported
        }
        return MachineCode.of(self.text, kinds)


class Function:
    """A function of a module, and the place where code is written."""

    def __init__(
        self, module: Module, name: str, arguments: Sequence[str], exported: bool, lanes: int | None = None
    ):
        """Begin a function; with lanes, of vectors, which returns the vector `returned`."""
        self.module, self.name, self._count, self.exported = module, name, 0, exported
        self._lines: list[Any] = []
        self._stack: list[str] = []
        self._blocks = 0
        #: addresses of places that have been written
        self.addresses: dict[Any, Value] = {}
        self.returned: Any = None
        kinds = ["double" if lanes else "i64" if each.startswith("n_") else "ptr" for each in arguments]
        self.arguments = [
            Value(self, f"%{name}", kind, lanes or 1) for name, kind in zip(arguments, kinds, strict=True)
        ]

    @property
    def text(self) -> str:
        """The function in LLVM's assembly language."""
        given = ", ".join(f"{each.type} {each.name}" for each in self.arguments)
        linkage = "" if self.exported else "internal "
        lines = itertools.chain.from_iterable(
            [line] if isinstance(line, str) else line for line in self._lines
        )
        body = "\n".join([*self._stack, "  br label %begin", "begin:", *lines])
        # vectors that do not fit into registers are kept on the stack, aligned
        aligned = 'nounwind alignstack(64) "stackrealign"'
        inline = aligned if self.exported else f"noinline {aligned}"
        kind, end = "void", "ret void"
        if self.returned is not None:
            kind, end = self.returned.type, f"ret {self.returned.type} {self.returned.name}"
        return f"define {linkage}{kind} @{self.name}({given}) {inline} {{\nentry:\n{body}\n  {end}\n}}"

    def constant(self, base: Value, offset: int) -> Value:
        """Return a whole number in memory that does not change in this function."""
        key = (base.name, offset)
        if key not in self.addresses:
            at, name = self.fresh(), self.fresh()
            self._stack.append(f"  {at} = getelementptr inbounds double, ptr {base.name}, i64 {offset}")
            self._stack.append(f"  {name} = load i64, ptr {at}")
            self.addresses[key] = Value(self, name, "i64")
        return self.addresses[key]

    def constant_index(self, number: Value) -> Index:
        """Return a number from `constant` as an index."""
        return Index(number, self._stack)

    # lines

    def emit(self, line: str) -> None:
        """Write a line."""
        self._lines.append("  " + line)

    def _fresh(self, prefix: str = "x") -> str:
        self._count += 1
        return f"{prefix}{self._count}"

    def fresh(self) -> str:
        """Return a new name."""
        return "%" + self._fresh()

    def index(self, value: Value) -> Index:
        """Return an index of places, for code from here on."""
        slot: list[str] = []
        self._lines.append(slot)
        return Index(value, slot)

    def result(self, expression: str, kind: str = "double", lanes: int = 1) -> Value:
        """Write an expression and return its value."""
        name = "%" + self._fresh()
        self.emit(f"{name} = {expression}")
        return Value(self, name, kind, lanes)

    def reserve(self, kind: str) -> str:
        """Return the address of memory for one value of this type."""
        name = "%" + self._fresh("m")
        self._stack.append(f"  {name} = alloca {kind}")
        return name

    def variable(self, value: Value) -> StackVariable:
        """Return a value that changes in loops."""
        return StackVariable(self, value)

    def address(self, name: str) -> Value:
        """Return an address as a value."""
        return Value(self, name, "ptr")

    # values

    def value(self, value: Any, kind: str = "double") -> Value:
        """Return a constant, or the value itself."""
        if isinstance(value, Value):
            return value
        if isinstance(value, StackVariable):
            return value.get()
        if kind == "i1" or isinstance(value, bool):
            return Value(self, "true" if value else "false", "i1")
        if kind == "i64":
            return Value(self, str(int(value)), "i64")
        return Value(self, literal(value))

    def splat(self, value: Value, lanes: int) -> Value:
        """Return a vector with the value in every lane."""
        if value.lanes == lanes:
            return value
        if not value.name.startswith("%"):
            inside = ", ".join([f"{value.kind} {value.name}"] * lanes)
            return Value(self, f"<{inside}>", value.kind, lanes)
        kind = f"<{lanes} x {value.kind}>"
        one = self.result(f"insertelement {kind} poison, {value.kind} {value.name}, i32 0", value.kind, lanes)
        zeros = f"<{lanes} x i32> zeroinitializer"
        return self.result(f"shufflevector {kind} {one.name}, {kind} poison, {zeros}", value.kind, lanes)

    def _same(self, *values: Any, kind: str = "double") -> tuple[list[Value], int]:
        found = [self.value(each, kind) for each in values]
        lanes = max(each.lanes for each in found)
        return [self.splat(each, lanes) for each in found], lanes

    def binary(self, operation: str, a: Any, b: Any) -> Value:
        """Return a sum, difference, product or quotient.

        A product that is added in the same block of code is rounded with the sum. That is written here, not
        left to the code generator: all machine code of a program computes the same bits.
        """
        whole = any(isinstance(each, Value) and each.kind == "i64" for each in (a, b))
        (a, b), lanes = self._same(a, b, kind="i64" if whole else "double")
        if whole:
            return self.result(f"{operation} i64 {a.name}, {b.name}", "i64")
        if operation in ("add", "sub") and a is not b:
            for product, other in ((a, b), (b, a)):
                if product.product and product.product[2] == self._blocks:
                    x, y, _ = product.product
                    if operation == "sub":
                        x, other = (x, -other) if product is a else (-x, other)
                    return self.intrinsic("fma", x, y, other)
        found = self.result(f"f{operation} {a.type} {a.name}, {b.name}", lanes=lanes)
        if operation == "mul":
            found.product = a, b, self._blocks
        return found

    def compare(self, operation: str, a: Any, b: Any) -> Value:
        """Return the truth of a comparison; false for NaN, except for `ne`."""
        whole = any(isinstance(each, Value) and each.kind == "i64" for each in (a, b))
        (a, b), lanes = self._same(a, b, kind="i64" if whole else "double")
        if whole:
            sign = operation if operation in ("eq", "ne") else "s" + operation
            return self.result(f"icmp {sign} i64 {a.name}, {b.name}", "i1")
        return self.result(f"fcmp {COMPARISONS[operation]} {a.type} {a.name}, {b.name}", "i1", lanes)

    def logical(self, operation: str, a: Any, b: Any) -> Value:
        """Return a conjunction, disjunction or exclusive disjunction."""
        (a, b), lanes = self._same(a, b, kind="i1")
        return self.result(f"{operation} {a.type} {a.name}, {b.name}", "i1", lanes)

    def select(self, condition: Any, yes: Any, no: Any) -> Value:
        """Return one of two values for each lane."""
        kind = next((each.kind for each in (yes, no) if isinstance(each, Value)), "double")
        (yes, no), lanes = self._same(yes, no, kind=kind)
        condition = self.value(condition, "i1")
        lanes = max(lanes, condition.lanes)
        yes, no = self.splat(yes, lanes), self.splat(no, lanes)
        if condition.lanes < lanes:
            condition = self.splat(condition, lanes)
        return self.result(
            f"select {condition.type} {condition.name}, {yes.type} {yes.name}, {no.type} {no.name}",
            yes.kind,
            lanes,
        )

    def apply(self, operation: str, *arguments: Any) -> Value:
        """Return an operation of a program (`program.Program`)."""
        if operation in OPERATIONS:
            return OPERATIONS[operation](self, *arguments)
        values, lanes = self._same(*arguments)
        if lanes > 1 and operation in elementary.FUNCTIONS:
            return self._call(self.module.elementary(operation, lanes), values)
        if operation in INTRINSICS:
            return self.intrinsic(INTRINSICS[operation], *values)
        return self.call_library("fmod" if operation == "rem" else operation, values)

    def intrinsic(self, name: str, *values: Value) -> Value:
        """Return a function that LLVM provides, of numbers in the same lanes."""
        kind, lanes = values[0].type, values[0].lanes
        full = f"llvm.{name}.{'f64' if lanes == 1 else f'v{lanes}f64'}"
        self.module.declarations.add(f"declare {kind} @{full}({', '.join([kind] * len(values))})")
        return self._call(full, values)

    def call_library(self, name: str, values: Sequence[Value]) -> Value:
        """Return a function of the C library, by a call for every lane."""
        if name not in LIBRARY:
            raise EngineError(f"engine: no machine code for {name!r}")
        self.module.declarations.add(f"declare double @{name}({', '.join(['double'] * len(values))})")
        lanes = range(values[0].lanes)
        return self.join([self._call(name, [self.lane(each, k) for each in values]) for k in lanes])

    def _call(self, name: str, values: Sequence[Value]) -> Value:
        given = ", ".join(f"{each.type} {each.name}" for each in values)
        return self.result(f"call {values[0].type} @{name}({given})", lanes=values[0].lanes)

    def lane(self, value: Value, k: int) -> Value:
        """Return the number in lane k."""
        if value.lanes == 1:
            return value
        return self.result(f"extractelement {value.type} {value.name}, i32 {k}", value.kind)

    def join(self, numbers: Sequence[Value]) -> Value:
        """Return the vector of these numbers."""
        if len(numbers) == 1:
            return numbers[0]
        kind, found = f"<{len(numbers)} x double>", "poison"
        for k, each in enumerate(numbers):
            one = self.result(
                f"insertelement {kind} {found}, double {each.name}, i32 {k}", lanes=len(numbers)
            )
            found = one.name
        return one

    def transpose(self, rows: Sequence[Value]) -> list[Value]:
        """Return the transpose of as many vectors as each has lanes."""
        found, n = list(rows), len(rows)
        for size in itertools.takewhile(lambda size: size < n, (1, 2, 4, 8)):
            low = [k + (n - size if k & size else 0) for k in range(n)]
            for i in (i for i in range(n) if not i & size):
                pair = found[i], found[i + size]
                found[i], found[i + size] = (
                    self._shuffle(*pair, [k + shift for k in low]) for shift in (0, size)
                )
        return found

    def _shuffle(self, a: Value, b: Value, lanes: Sequence[int]) -> Value:
        """Return the vector of these lanes of two vectors."""
        picked = ", ".join(f"i32 {k}" for k in lanes)
        vector = f"shufflevector {a.type} {a.name}, {b.type} {b.name}, <{len(lanes)} x i32> <{picked}>"
        return self.result(vector, a.kind, len(lanes))

    def largest(self, value: Value) -> Value:
        """Return the largest number of all lanes."""
        return self._fold(value, lambda a, b: self.select(a > b, a, b))

    def total(self, value: Value) -> Value:
        """Return the sum of all lanes."""
        return self._fold(value, operator.add)

    def any(self, value: Value) -> Value:
        """Return true if a lane is true."""
        if value.lanes == 1:
            return value
        name = f"llvm.vector.reduce.or.v{value.lanes}i1"
        self.module.declarations.add(f"declare i1 @{name}({value.type})")
        return self.result(f"call i1 @{name}({value.type} {value.name})", "i1")

    def _fold(self, value: Value, operation: Operator) -> Value:
        """Return an operation of all lanes, in pairs."""
        if value.lanes <= 2:
            return functools.reduce(operation, [self.lane(value, k) for k in range(value.lanes)])
        half, kind = value.lanes // 2, value.type
        indices = (", ".join(f"i32 {first + k}" for k in range(half)) for first in (0, half))
        halves = [
            self.result(
                f"shufflevector {kind} {value.name}, {kind} poison, <{half} x i32> <{each}>", lanes=half
            )
            for each in indices
        ]
        return self._fold(operation(*halves), operation)

    # memory

    def pointer(self, base: Value, offset: Any) -> Value:
        """Return the address of the double at an offset."""
        offset = self.value(offset, "i64")
        return self.result(f"getelementptr inbounds double, ptr {base.name}, i64 {offset.name}", "ptr")

    def load(self, base: Value, offset: Any, lanes: int = 1) -> Value:
        """Return numbers in memory; offset in doubles."""
        at = self.pointer(base, offset)
        kind = "double" if lanes == 1 else f"<{lanes} x double>"
        return self.result(f"load {kind}, ptr {at.name}, align 8", lanes=lanes)

    def store(self, value: Any, base: Value, offset: Any, lanes: int | None = None) -> None:
        """Write numbers to memory; offset in doubles."""
        value = self.value(value)
        value = self.splat(value, lanes) if lanes is not None else value
        at = self.pointer(base, offset)
        self.emit(f"store {value.type} {value.name}, ptr {at.name}, align 8")

    # control flow

    def _label(self, name: str) -> None:
        self._blocks += 1
        self._lines.append(f"{name}:")

    @contextlib.contextmanager
    def loop(self, count: Any, start: Any = 0, step: int = 1) -> Iterator[Index]:
        """Write a loop over start, start + step, … below (or, for a negative step, not below) count."""
        index = StackVariable(self, self.value(start, "i64"))
        names = [self._fresh(part) for part in ("head", "body", "end")]
        count = self.value(count, "i64")
        self.emit(f"br label %{names[0]}")
        self._label(names[0])
        i = index.get()
        more = i < count if step > 0 else i >= count
        self.emit(f"br i1 {more.name}, label %{names[1]}, label %{names[2]}")
        self._label(names[1])
        yield self.index(i)
        index.set(i + step)
        self.emit(f"br label %{names[0]}")
        self._label(names[2])

    @contextlib.contextmanager
    def while_(self, condition: Callable[[], Value]) -> Iterator[None]:
        """Write a loop that runs as long as a condition is true; it is evaluated before every turn."""
        names = [self._fresh(part) for part in ("head", "body", "end")]
        self.emit(f"br label %{names[0]}")
        self._label(names[0])
        self.emit(f"br i1 {condition().name}, label %{names[1]}, label %{names[2]}")
        self._label(names[1])
        yield
        self.emit(f"br label %{names[0]}")
        self._label(names[2])

    @contextlib.contextmanager
    def if_(self, condition: Value) -> Iterator[None]:
        """Write code that runs if a condition is true."""
        names = [self._fresh(part) for part in ("body", "end")]
        self.emit(f"br i1 {condition.name}, label %{names[0]}, label %{names[1]}")
        self._label(names[0])
        yield
        self.emit(f"br label %{names[1]}")
        self._label(names[1])

    def call(self, function: Function, *arguments: Any) -> None:
        """Call another function of the module."""
        given = []
        for own, argument in zip(function.arguments, arguments, strict=True):
            given.append(f"{own.type} {self.value(argument, 'i64').name}")
        self.emit(f"call void @{function.name}({', '.join(given)})")

    # programs

    def evaluate(
        self,
        program: Program,
        outputs: Sequence[int],
        known: Mapping[int, Any],
        lanes: int,
        sums: Sums = ((), True),
        stores: Stores | None = None,
    ) -> Values:
        """Write the operations that outputs need, and return the values of all of them.

        `known` are values of inputs and of operations that have been evaluated, or functions that read them;
        those of arrays are in memory (`arrays.Stored`). Loops run until every lane is done; lanes that are
        done keep their values. `sums` are arrays, the sums of which over the lanes inside are added to memory
        at their addresses. `stores` are called as soon as the value of their node is known, and each output
        is then evaluated with what it needs before the next one: few values wait in registers.
        """
        added, inside = sums
        values = Values(known)
        parts = [part for node, _ in added for part, _ in summands(program, node)]
        arrays = ArrayCode(self, program, outputs, parts, values)
        order = arrays.needed
        if stores and program.shapes.keys().isdisjoint(order):
            order = program.depth_first(outputs, values)
        for node in order:
            operation, *arguments = program.operations[node]
            if node in values or operation == "result":
                pass
            elif operation == "loop":
                self._loop(program, node, values, lanes)
            elif operation == "entry":
                values[node] = arrays.load(*arguments)
            elif node in program.shapes:
                arrays.write(node)
            else:
                values[node] = self._scalar(program, node, values)
            if stores and node in stores:
                values[node] = stores[node](values[node])
        for node, target in added:
            arrays.add(node, target, inside)
        return values

    def side_by_side(
        self, program: Program, outputs: Sequence[int], every: Sequence[Mapping[int, Any]]
    ) -> list[Values]:
        """Write the scalar operations that outputs need, each for all known values before the next one."""
        found = [Values(known) for known in every]
        for node, values in itertools.product(program.needed(outputs, found[0]), found):
            if node not in values:
                values[node] = self._scalar(program, node, values)
        return found

    def _scalar(self, program: Program, node: int, values: Values) -> Value:
        operation, *arguments = program.operations[node]
        if operation == "constant":
            value = program.values[node]
            return self.value(value if isinstance(value, bool) else float(value))
        if operation in ("input", "inputs"):
            raise KeyError(f"input {arguments[0]} has no value")
        return self.apply(operation, *(values[each] for each in arguments))

    def _loop(self, program: Program, node: int, values: dict[int, Any], lanes: int) -> None:
        loop = program.loops[node]
        inner: dict[int, Value] = {}
        for name, outer in loop.inputs:
            inner[loop.program.input(name, 1)] = values[outer]
        state = []
        for start, kind in zip(loop.initial, loop.kinds, strict=True):
            value = self.value(values[start], "i1" if kind == "b" else "double")
            state.append(StackVariable(self, self.splat(value, lanes)))
        found: dict[int, Value] = {}
        running: list[Value] = []

        def condition() -> Value:
            now = {each: variable.get() for each, variable in zip(loop.state, state, strict=True)}
            found.clear()
            found.update(self.evaluate(loop.program, [loop.condition], inner | now, lanes))
            running[:] = [self.splat(found[loop.condition], lanes)]
            return self.any(running[0])

        with self.while_(condition):
            after = self.evaluate(loop.program, loop.next, found, lanes)
            kept = [
                self.select(running[0], after[new], variable.get())
                for new, variable in zip(loop.next, state, strict=True)
            ]
            for variable, value in zip(state, kept, strict=True):
                variable.set(value)
        for later in range(node + 1, len(program.operations)):
            operation = program.operations[later]
            if operation[0] == "result" and operation[1] == node:
                values[later] = state[operation[2]].get()


def _negate(f: Function, x: Value) -> Value:
    return f.result(f"fneg {x.type} {x.name}", lanes=x.lanes)


def _by(method: Callable[..., Value], names: Iterable[str]) -> dict[str, Callable[..., Value]]:
    """Return the operations that a method of functions writes by their name."""
    return {name: lambda f, *values, name=name: method(f, name, *values) for name in names}


#: operations of programs that are instructions of their own, or formulas
OPERATIONS: dict[str, Callable[..., Value]] = {
    **_by(Function.binary, ("add", "sub", "mul", "div")),
    **_by(Function.compare, COMPARISONS),
    **_by(Function.logical, ("and", "or")),
    "not": lambda f, x: f.logical("xor", x, True),
    "select": lambda f, p, no, yes: f.select(p, yes, no),
    "hold": lambda f, x: x,
    "neg": _negate,
    "sign": lambda f, x: f.select(x > 0.0, 1.0, f.select(x < 0.0, -1.0, 0.0)),
    "isfinite": lambda f, x: f.apply("abs", x) < float("inf"),
    "logistic": lambda f, x: 1.0 / (1.0 + f.apply("exp", -x)),
}
