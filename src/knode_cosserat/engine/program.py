"""Programs of scalar operations: a jaxpr evaluated on symbols, and its derivatives.

A `Program` is a list of operations in the order of evaluation. An operation is a tuple of a name and
of the numbers (nodes) of its arguments. Constants are folded, equal operations are shared, and operations
without effect are left out. All values are 64-bit floats or booleans; integers are kept as floats.

A node is a scalar or, where scalars would be too many (matrix products of a network), an array. Arrays take
the operations of scalars, entry by entry, and a scalar counts as an array of equal entries. Arrays begin
with a "stack" of scalars, or with "inputs" in memory, and end with an "entry"; "view" is an array of some of
the entries of another, "sum" adds those along the last axis, and "spread" adds entries to zeros at some
positions: the transpose of a view.

Algebra treats values as finite: x * 0 and x - x are 0. `x != x` is kept, because it tests for NaN. "max" and
"min" return NaN if an argument is NaN. "hold" returns its argument: derivatives stop there, or follow a rule
of their own. Derivatives at ties (max, min, abs, clamp) are those of JAX.
"""

from __future__ import annotations

import bisect
import dataclasses
import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal, jaxpr_as_fun

from knode_cosserat.errors import KnodeCosseratError

#: largest number of scalar products of one matrix product, and of results of other operations on arrays, that
#: are scalars
LARGEST_PRODUCT, LARGEST_SPREAD = 96, 31
#: largest number of entries of a table with a variable index, of turns of a scan, and of numbers to sort
LARGEST_TABLE, LONGEST_SCAN, LONGEST_SORT = 256, 1024, 32
#: largest matrix that is factorised with row exchanges that depend on values
PIVOTED = 6

#: an array of nodes
Nodes = np.ndarray
Tangents = dict[int, dict[Any, int]]
#: nonzeros of a matrix: row, column and node of each
Nonzeros = list[tuple[int, int, int]]


class EngineError(KnodeCosseratError, NotImplementedError):
    """The engine cannot run these equations."""

    code = "engine"


@dataclasses.dataclass(frozen=True)
class _WhileLoop:
    """A `while` loop: `program` computes the condition and the next state from the state and the inputs.

    In `program` the level of inputs is 1, and the level of the state is 2.
    """

    program: Program
    #: names of the inner inputs that do not change, with their outer nodes
    inputs: list[tuple[str, int]]
    #: inner nodes (inputs) of the state, and outer nodes of its initial values
    state: list[int]
    initial: list[int]
    #: inner nodes of the next state and of the condition
    next: list[int]
    condition: int
    #: "f" (float) or "b" (boolean), for each number of the state
    kinds: list[str]
    #: line of the user's code, for messages
    source: str = ""


class _Product(NamedTuple):
    """Product of a Jacobian with a vector: nodes that depend linearly on inputs."""

    inputs: list[int]
    outputs: list[int]
    #: nodes that depend on the inputs, in order
    steps: list[int]


class Positions(NamedTuple):
    """Regular positions in an array: the first one, the distances along the axes of a view, and its shape."""

    first: int
    strides: tuple[int, ...]
    shape: tuple[int, ...]

    @classmethod
    def whole(cls, shape: tuple[int, ...]) -> Positions:
        """Return the positions of all entries in order."""
        return cls(0, tuple(math.prod(shape[axis + 1 :]) for axis in range(len(shape))), shape)

    def all(self) -> np.ndarray:
        """Return the positions of all entries of the view."""
        steps = (np.arange(n) * stride for n, stride in zip(self.shape, self.strides, strict=True))
        return self.first + sum(np.ix_(*steps), start=np.zeros(self.shape, dtype=np.int64))


def regular(positions: np.ndarray) -> Positions | None:
    """Return positions that are regular, otherwise None."""
    first, strides = int(positions.flat[0]), []
    for axis, n in enumerate(positions.shape):
        second = positions[tuple(int(k == axis) for k in range(positions.ndim))] if n > 1 else first
        strides.append(int(second) - first)
    found = Positions(first, tuple(strides), positions.shape)
    return found if np.array_equal(found.all(), positions) else None


@dataclasses.dataclass(eq=False)
class _DerivativeRule:
    """Derivative rule of a JAX function: of `jax.custom_jvp`, or of a linear solver."""

    function: Callable[..., Any]
    #: shapes and types of the arguments
    shapes: list[Any]
    arguments: list[Nodes]
    #: "hold" nodes of the results
    results: list[Nodes] = dataclasses.field(default_factory=list)
    #: places of the arguments with tangents, and the results' tangents, once needed
    product: tuple[list[int], _Product] | None = None

    def trace(self) -> tuple[list[int], Any]:
        """Return the places of the arguments with tangents, and the jaxpr of the results' tangents."""
        active = [k for k, each in enumerate(self.shapes) if np.issubdtype(each.dtype, np.floating)]

        def along(primals: Any, tangents: Any) -> Any:
            def of_active(*moving: Any) -> Any:
                values = list(primals)
                for place, value in zip(active, moving, strict=True):
                    values[place] = value
                return self.function(*values)

            return jax.jvp(of_active, [primals[place] for place in active], tangents)[1]

        return active, jax.make_jaxpr(along)(self.shapes, [self.shapes[place] for place in active])


def _logistic(x: float) -> float:
    return 1.0 / (1.0 + math.exp(-x)) if x > -700.0 else 0.0


#: operations with their values for constants
FOLDED: dict[str, Callable[..., Any]] = {
    "add": np.add, "sub": np.subtract, "mul": np.multiply, "div": np.divide, "neg": np.negative,
    "abs": np.abs, "sqrt": np.sqrt, "exp": np.exp, "log": np.log, "log1p": np.log1p, "expm1": np.expm1,
    "sin": np.sin, "cos": np.cos, "tan": np.tan, "tanh": np.tanh, "atan2": np.arctan2, "asin": np.arcsin,
    "acos": np.arccos, "atan": np.arctan, "pow": np.power, "max": np.maximum, "min": np.minimum,
    "sign": np.sign, "floor": np.floor, "rem": np.fmod, "erf": math.erf, "logistic": _logistic,
    "isfinite": np.isfinite, "lt": np.less, "le": np.less_equal, "gt": np.greater, "ge": np.greater_equal,
    "eq": np.equal, "ne": np.not_equal, "and": np.logical_and, "or": np.logical_or, "not": np.logical_not,
    "select": lambda p, no, yes: yes if p else no, "hold": lambda x: x,
}  # fmt: skip
#: products, of which views are views of the factors
PRODUCTS = frozenset({"mul", "neg"})
COMMUTATIVE = frozenset({"add", "mul", "max", "min", "and", "or", "eq", "ne"})
COMPARISONS = frozenset({"lt", "le", "gt", "ge", "eq", "ne"})
BOOLEANS = COMPARISONS | {"and", "or", "not", "isfinite"}
#: constants that change nothing, and those that are the result whatever the other argument is
NEUTRAL: dict[str, Any] = {"add": 0.0, "mul": 1.0, "and": True, "or": False}
ABSORBING: dict[str, Any] = {"mul": 0.0, "and": False, "or": True}
#: operations that return either of two equal arguments
IDEMPOTENT = frozenset({"and", "or", "max", "min"})
#: number of nodes among the operands of an operation, which come first; all operands of other operations are
NODES = {"constant": 0, "input": 0, "inputs": 0, "view": 1, "entry": 1, "spread": 1, "sum": 1, "result": 1}


class Program:
    """Scalar operations in the order of evaluation, without repetition."""

    def __init__(self, limit: float = math.inf) -> None:
        #: largest number of operations
        self.limit = limit
        #: ("constant",), ("input", name), ("add", a, b), …, ("loop", *arguments), ("result", loop node, k)
        self.operations: list[tuple[Any, ...]] = []
        #: values of constants, None of all others
        self.values: list[Any] = []
        #: 0 of constants, given for inputs, and otherwise the largest of the arguments
        self.levels: list[int] = []
        #: loops by node
        self.loops: dict[int, _WhileLoop] = {}
        #: derivative rules of "hold" nodes, by node; None: the derivative is zero
        self.rules: dict[int, _DerivativeRule | None] = {}
        #: shapes of arrays; other nodes are scalars
        self.shapes: dict[int, tuple[int, ...]] = {}
        self._boolean: list[bool] = []
        self._memo: dict[Any, Any] = {}
        #: first node and number of scalars that are the entries of an array, and the array; or, of inputs in
        #: memory, its operation
        self._families: list[tuple[int, int, Any]] = []
        self._count = 0
        #: selects with constants only, such as an index of the smallest entry
        self.choices: set[int] = set()

    # construction

    def _new(self, key: Any, operation: tuple[Any, ...], level: int, boolean: bool, value: Any = None) -> int:
        found = self._memo.get(key)
        if found is None:
            found = self._memo[key] = len(self.operations)
            self.operations.append(operation)
            self.values.append(value)
            self.levels.append(level)
            self._boolean.append(boolean)
        return found

    def constant(self, value: Any) -> int:
        """Return the node of a constant: a boolean, or a number (kept as a float)."""
        boolean = isinstance(value, (bool, np.bool_))
        value = bool(value) if boolean else float(value) + 0.0
        return self._new(("constant", boolean, repr(value)), ("constant",), 0, boolean, value)

    def input(self, name: str, level: int, boolean: bool = False) -> int:
        """Return the node of a named input; level 0 is of constants."""
        return self._new(("input", name), ("input", name), level, boolean)

    def inputs(self, name: str, shape: tuple[int, ...], level: int, in_memory: bool = False) -> Nodes:
        """Return an array of inputs, named by their flat index, such as name[0].

        If they are in memory, in this order, arrays of them are read there.
        """
        first, size = len(self.operations), math.prod(shape)
        nodes = [self.input(f"{name}[{k}]", level) for k in range(size)]
        if size and in_memory:
            self._families.append((first, size, ("inputs", first, size)))
        return np.array(nodes, dtype=np.int64).reshape(shape)

    def constants(self, values: Any) -> Nodes:
        """Return an array of constants."""
        values = np.asarray(values)
        nodes = [self.constant(value) for value in values.ravel().tolist()]
        return np.array(nodes, dtype=np.int64).reshape(values.shape)

    def apply(self, operation: str, *arguments: int) -> int:
        """Return the node of an operation on scalars, simplified and shared."""
        if operation in COMMUTATIVE and arguments[0] > arguments[1]:
            arguments = arguments[::-1]
        key = (operation, *arguments)
        found = self._memo.get(key)
        if found is None:
            arguments = tuple(map(int, arguments))
            found = self._simplify(operation, *arguments)
            if found is None:
                found = self._create(operation, *arguments)
            self._memo[key] = found
        return found

    def _create(self, operation: str, *arguments: int) -> int:
        self._count += 1
        if self._count > self.limit:
            raise EngineError(f"engine: more than {self.limit} operations; use smaller laws")
        key, level = (operation, *arguments), max(self.levels[a] for a in arguments)
        last = self._boolean[arguments[-1]]
        node = self._new(key, key, level, operation in BOOLEANS or (last and operation == "select"))
        shape = next((self.shapes[a] for a in arguments if a in self.shapes), None)
        if shape is not None:
            self.shapes[node] = shape
        if operation == "select" and all(self.is_constant(a) or a in self.choices for a in arguments[1:]):
            self.choices.add(node)
        return node

    def _simplify(self, operation: str, *arguments: int) -> int | None:
        """Return an equal node that is simpler than the operation, or None."""
        values = [self.values[a] for a in arguments]
        if None not in values and operation in FOLDED:
            with np.errstate(all="ignore"):
                value = FOLDED[operation](*values)
            return self.constant(value.item() if isinstance(value, np.generic) else value)
        if operation not in ("select", "hold"):
            spread = self._spread(operation, arguments)
            if spread is not None:
                return spread
        if operation in COMMUTATIVE:
            for x, y in (arguments, arguments[::-1]):
                if self.is_constant(x) and self.values[x] == NEUTRAL.get(operation):
                    return y
                if self.is_constant(x) and self.values[x] == ABSORBING.get(operation):
                    return x
            if operation in IDEMPOTENT and arguments[0] == arguments[1]:
                return arguments[0]
        rewrite = REWRITES.get(operation)
        return None if rewrite is None else rewrite(self, *arguments)

    def _spread(self, operation: str, arguments: tuple[int, ...]) -> int | None:
        """Return an operation of constants and one choice of constants: a choice of results."""
        choices = [a for a in arguments if not self.is_constant(a)]
        if len(choices) != 1 or choices[0] not in self.choices or self.is_boolean(choices[0]):
            return None
        _, p, *branches = self.operations[choices[0]]
        results = [
            self.apply(operation, *(each if a == choices[0] else a for a in arguments)) for each in branches
        ]
        return self.apply("select", p, *results)

    def _opposite(self, node: int) -> int | None:
        """Return x if the node is -x."""
        name, *arguments = self.operations[node]
        return arguments[0] if name == "neg" else None

    def _simple_add(self, a: int, b: int) -> int | None:
        for x, y in ((a, b), (b, a)):
            negated = self._opposite(y)
            if negated is not None:
                return self.apply("sub", x, negated)
        return None

    def _simple_sub(self, a: int, b: int) -> int | None:
        if a == b:
            return self.constant(0.0)
        if self.is_constant(b, 0.0):
            return a
        if self.is_constant(a, 0.0):
            return self.apply("neg", b)
        left, right = self._opposite(a), self._opposite(b)
        if right is not None:
            return self.apply("add", a, right)
        return None if left is None else self.apply("neg", self.apply("add", left, b))

    def _simple_neg(self, a: int) -> int | None:
        name, *arguments = self.operations[a]
        if name == "sub":
            return self._memo.get(("sub", *arguments[::-1]))
        return self._opposite(a)

    def _simple_mul(self, a: int, b: int) -> int | None:
        for x, y in ((a, b), (b, a)):
            if self.is_constant(x, -1.0):
                return self.apply("neg", y)
            negated = self._opposite(y)
            if negated is not None:
                return self.apply("neg", self.apply("mul", x, negated))
            name, *factors = self.operations[y]
            if self.is_constant(x) and name == "mul":
                for c, rest in (factors, factors[::-1]):
                    if self.is_constant(c):
                        return self.apply("mul", self.apply("mul", x, c), rest)
        return None

    def _simple_div(self, a: int, b: int) -> int | None:
        if self.is_constant(a, 0.0):
            return a
        if self.is_constant(b) and self.values[b] != 0.0:
            return self.apply("mul", a, self.constant(1.0 / self.values[b]))
        negated = self._opposite(b)
        if negated is not None:
            return self.apply("neg", self.apply("div", a, negated))
        one = self.constant(1.0)
        return None if a == one else self.apply("mul", a, self.apply("div", one, b))

    def _simple_abs(self, a: int) -> int | None:
        if self.operations[a][0] in ("abs", "sqrt", "exp"):
            return a
        negated = self._opposite(a)
        return None if negated is None else self.apply("abs", negated)

    def _simple_pow(self, a: int, b: int) -> int | None:
        power = self.values[b]
        if power is None:
            return None
        if power == int(power) and abs(power) <= 64:
            return self.power(a, int(power))
        half = abs(power) == 0.5
        return self.power(self.apply("sqrt", a), round(2 * power)) if half else None

    def power(self, a: int, power: int) -> int:
        """Return an integer power by products."""
        if power < 0:
            return self.apply("div", self.constant(1.0), self.power(a, -power))
        if power < 2:
            return a if power else self.constant(1.0)
        half = self.power(a, power // 2)
        square = self.apply("mul", half, half)
        return self.apply("mul", square, a) if power % 2 else square

    def _simple_select(self, p: int, no: int, yes: int) -> int | None:
        if no == yes or self.is_constant(p):
            return yes if self.values[p] else no
        if self.operations[p][0] == "not":
            return self.apply("select", self.operations[p][1], yes, no)
        if self.is_constant(no, False):
            return self.apply("and", p, yes)
        if self.is_constant(yes, True):
            return self.apply("or", p, no)
        if self.is_constant(no, True) and self.is_constant(yes, False):
            return self.apply("not", p)
        return None

    def _simple_not(self, a: int) -> int | None:
        return self.operations[a][1] if self.operations[a][0] == "not" else None

    def _simple_hold(self, a: int) -> int:
        stopped = self.operations[a][0] == "hold" and self.rules[a] is None
        return a if stopped else self.hold(a, None)

    def hold(self, node: int, rule: _DerivativeRule | None) -> int:
        """Return a node of the same value whose derivative follows a rule; None: it is zero."""
        while (known := self._memo.get(("held", node))) is not None:
            if self.rules[known] is rule:
                return known
            node = known
        new = self._new(("held", node), ("hold", node), self.levels[node], self._boolean[node])
        self.rules[new] = rule
        if node in self.shapes:
            self.shapes[new] = self.shapes[node]
        return new

    def apply_rule(
        self, name: str, function: Any, shapes: Any, arguments: list[Nodes], values: Any
    ) -> list[Nodes]:
        """Return the results of a function with a derivative rule; `values` evaluates it."""
        key = ("rule", name, *(x for each in arguments for x in (each.shape, each.tobytes())))
        if key not in self._memo:
            rule = _DerivativeRule(function, shapes, arguments)
            # before the results, because nodes are in the order of evaluation
            self._all_parts(arguments)
            for array in values():
                held = [self.hold(node, rule) for node in self.parts(array)]
                rule.results.append(self._nodes(held, array.shape))
            self._memo[key] = rule.results
        return self._memo[key]

    def loop(self, loop: _WhileLoop) -> list[int]:
        """Return the nodes of the final state of a loop."""
        arguments = [*(node for _, node in loop.inputs), *loop.initial]
        inner = loop.program
        program = (*zip(inner.operations, map(repr, inner.values), strict=True),)
        nested = tuple(key for key in inner._memo if key[0] == "loop")
        key = ("loop", program, nested, tuple(loop.next), loop.condition, tuple(arguments))
        if key not in self._memo:
            level = max((self.levels[a] for a in arguments), default=0)
            self.loops[self._new(key, ("loop", *arguments), level, False)] = loop
        node = self._memo[key]
        results = [("result", node, k) for k in range(len(loop.kinds))]
        return [
            self._new(each, each, self.levels[node], kind == "b")
            for each, kind in zip(results, loop.kinds, strict=True)
        ]

    # arrays

    def _array(self, operation: tuple[Any, ...], shape: tuple[int, ...], level: int, boolean: bool) -> int:
        node = self._new(operation, operation, level, boolean)
        self.shapes[node] = shape
        return node

    def locate(self, nodes: Nodes) -> tuple[Any, Positions] | None:
        """Return the array, or the operation of an array of inputs, of which scalars are regular entries."""
        at = bisect.bisect_right(self._families, nodes.flat[0], key=lambda family: family[0]) - 1
        if at < 0:
            return None
        first, count, owner = self._families[at]
        if nodes.min() < first or nodes.max() >= first + count:
            return None
        positions = regular(nodes - first)
        return None if positions is None else (owner, positions)

    def is_computed(self, nodes: Nodes) -> bool:
        """Return True if scalars are regular entries of one array that is no input."""
        found = self.locate(nodes) if nodes.size > LARGEST_SPREAD else None
        return found is not None and isinstance(found[0], int)

    def array(self, nodes: Nodes) -> int:
        """Return an array of scalars: a view if they are regular entries of one array, otherwise a copy."""
        found = self.locate(nodes)
        if found is None:
            scalars = nodes.ravel().tolist()
            level = max(self.levels[node] for node in scalars)
            base = self._array(("stack", *scalars), (nodes.size,), level, self._boolean[scalars[0]])
            return self.view(base, np.arange(nodes.size).reshape(nodes.shape))
        owner, positions = found
        if not isinstance(owner, int):
            owner = self._array(owner, owner[2:], self.levels[owner[1]], False)
        return self.view(owner, positions.all())

    def known_inputs(self, nodes: Nodes) -> int | None:
        """Return the array of all inputs of one name in memory, or None if nothing needs it."""
        return self._memo.get(("inputs", int(nodes.flat[0]), nodes.size)) if nodes.size else None

    def array_input(self, name: str, shape: tuple[int, ...], level: int) -> int:
        """Return an input that is an array, without inputs for its entries."""
        return self._array(("input", name), shape, level, False)

    def entries(self, node: int, shape: tuple[int, ...] | None = None) -> Nodes:
        """Return the scalars of an array; a scalar is repeated."""
        if node not in self.shapes:
            return np.full(shape or (), node, dtype=np.int64)
        own = self.shapes[node]
        name, *rest = self.operations[node]
        if name == "view":
            return self.entries(rest[0]).ravel()[rest[1].all()]
        if name == "inputs":
            return np.arange(rest[0], rest[0] + rest[1])
        if name == "stack":
            return np.array(rest, dtype=np.int64)
        key, count = ("entries", node), math.prod(own)
        if key not in self._memo:
            self._memo[key] = first = len(self.operations)
            self._families.append((first, count, node))
            for k in range(count):
                each = ("entry", node, k)
                self._new(each, each, self.levels[node], self._boolean[node])
        return np.arange(self._memo[key], self._memo[key] + count).reshape(own)

    def view(self, node: int, positions: np.ndarray) -> int:
        """Return an array of the entries of another at these positions in it (as if it were flat)."""
        if node not in self.shapes:
            return node
        shape = self.shapes[node]
        name, *rest = self.operations[node]
        if positions.shape == shape and np.array_equal(positions.ravel(), np.arange(positions.size)):
            return node
        if name in PRODUCTS:
            # a view of factors, so that the products need no memory
            parts = [self.view(each, positions) for each in rest]
            return self.apply(name, *parts)
        if name == "view":
            return self.view(rest[0], rest[1].all().ravel()[positions])
        found = regular(positions)
        if found is None:
            return self.array(self.entries(node).ravel()[positions])
        return self._array(("view", node, found), found.shape, self.levels[node], self._boolean[node])

    def total(self, node: int, count: int) -> int:
        """Return the sums along the last axis, of this length, of an array."""
        if node not in self.shapes:
            return self.apply("mul", node, self.constant(float(count)))
        name, *rest = self.operations[node]
        if name == "neg":
            return self.apply("neg", self.total(rest[0], count))
        if name == "mul":
            for factor, other in (rest, rest[::-1]):
                found = self._choose(factor, other)
                if found is not None:
                    return found
        return self._array(("sum", node, count), self.shapes[node][:-1], self.levels[node], False)

    def spread(self, node: int, positions: Positions, shape: tuple[int, ...]) -> int:
        """Return an array of zeros to which the entries of another are added at positions in it."""
        is_whole = node in self.shapes and positions == Positions.whole(shape)
        if is_whole or self.is_constant(node, 0.0):
            return node
        return self._array(("spread", node, positions, shape), shape, self.levels[node], False)

    def unit(self, size: int, k: int) -> int:
        """Return the unit vector along axis k."""
        found = self.array(self.constants(np.equal(np.arange(size), k).astype(float)))
        self._memo["unit", found] = k
        return found

    def _choose(self, factor: int, other: int) -> int | None:
        """Return the entries that a product with a unit vector along the last axis chooses, or None."""
        base, *rest = self.operations[factor][1:] if self.operations[factor][0] == "view" else (factor,)
        one = self._memo.get(("unit", base))
        if one is None:
            return None
        shape = self.shapes[factor]
        chosen = (rest[0].all() if rest else np.arange(math.prod(shape)).reshape(shape)) == one
        if not chosen.any():
            return self.constant(0.0)
        column = chosen.reshape(-1, shape[-1])[0]
        if column.sum() != 1 or not (chosen == column).all():
            return None
        return self.view(other, np.arange(chosen.size).reshape(shape)[..., int(column.argmax())])

    def parts(self, nodes: Nodes) -> list[int]:
        """Return the one array with these scalars as entries, or the scalars."""
        return [self.array(nodes)] if self.is_computed(nodes) else nodes.ravel().tolist()

    def _all_parts(self, arrays: Iterable[Nodes]) -> list[int]:
        return [node for nodes in arrays for node in self.parts(nodes)]

    # queries

    def arguments(self, node: int) -> tuple[int, ...]:
        """Return the nodes that a node depends on directly."""
        name, *operands = self.operations[node]
        return tuple(operands[: NODES.get(name)])

    def needed(self, outputs: Iterable[int], known: Any = frozenset()) -> list[int]:
        """Return the nodes that the outputs depend on, in order, with known ones but not beyond them."""
        return self._order(outputs, lambda node: () if node in known else self.arguments(node))

    @staticmethod
    def _order(outputs: Iterable[int], sources: Callable[[int], Iterable[int]]) -> list[int]:
        seen: set[int] = set()
        stack = [int(node) for node in outputs]
        while stack:
            node = stack.pop()
            if node not in seen:
                seen.add(node)
                stack.extend(sources(node))
        return sorted(seen)

    def depth_first(self, outputs: Iterable[int], known: Any = frozenset()) -> list[int]:
        """Return the nodes that the outputs depend on, each output after what only it needs."""
        seen: set[int] = set()
        order: list[int] = []
        stack = [(int(node), False) for node in reversed(list(outputs))]
        while stack:
            node, is_ready = stack.pop()
            if is_ready:
                order.append(node)
            elif node not in seen:
                seen.add(node)
                sources = () if node in known else self.arguments(node)
                stack += [(node, True), *((each, False) for each in reversed(sources))]
        return order

    def is_boolean(self, node: int) -> bool:
        """Return True if the value of a node is a boolean."""
        return self._boolean[node]

    def is_constant(self, node: int, value: Any = None) -> bool:
        """Return True if a node is a constant; with a value, if it is this one."""
        own = self.values[node]
        return own is not None and (value is None or (own == value and isinstance(own, type(value))))

    # derivatives

    def derivative(self, outputs: Sequence[int] | Nodes, tangents: Mapping[int, int]) -> list[int]:
        """Return the tangents of the outputs from those of independent nodes: a product J·v."""
        found = self._forward(outputs, {int(node): {0: int(tangent)} for node, tangent in tangents.items()})
        zero = self.constant(0.0)
        return [found.get(int(node), {}).get(0, zero) for node in outputs]

    def jacobian(self, outputs: Sequence[int] | Nodes, variables: Sequence[int] | Nodes) -> Nodes:
        """Return the derivatives (outputs, variables); structural zeros are the constant 0."""
        one, zero = self.constant(1.0), self.constant(0.0)
        found = self._forward(outputs, {int(node): {k: one} for k, node in enumerate(variables)})
        rows = [found.get(int(node), {}) for node in outputs]
        entries = [[row.get(k, zero) for k in range(len(variables))] for row in rows]
        return np.array(entries, dtype=np.int64).reshape(len(rows), len(variables))

    def nonzeros(self, outputs: Sequence[int] | Nodes, variables: Sequence[int] | Nodes) -> Nonzeros:
        """Return the structural nonzeros of the derivatives (outputs, variables)."""
        return self.nonzeros_of(self.jacobian(outputs, variables))

    def nonzeros_of(self, matrix: Nodes) -> Nonzeros:
        """Return the entries of a matrix that are not the constant 0."""
        entries = ((*at, int(matrix[at])) for at in np.ndindex(matrix.shape))
        return [entry for entry in entries if not self.is_constant(entry[2], 0.0)]

    def gradient(
        self,
        outputs: Sequence[int] | Nodes,
        cotangents: Sequence[int] | Nodes,
        variables: Sequence[int] | Nodes,
        linear: bool = False,
    ) -> list[int]:
        """Return the cotangents of independent nodes from those of the outputs: a product λᵀ·J.

        Outputs that are `linear` in the variables are differentiated as they are evaluated, without rules.
        The cotangent of an array is an array, or a scalar for equal entries.
        """
        zero, independent = self.constant(0.0), set(map(int, variables))
        dependent = self.dependent(outputs, variables, linear)
        firsts: dict[int, int] = {}
        for node in sorted(dependent):
            firsts.setdefault(id(self.rules.get(node)), node)
        found: dict[int, int] = {}
        #: cotangents of entries, by array
        entries: dict[int, dict[int, int]] = {}

        def add(node: int, cotangent: int, shape: tuple[int, ...] = ()) -> None:
            """Add to the cotangent of an argument of an operation of some shape."""
            if node not in dependent:
                return
            if node not in self.shapes:
                for count in reversed(shape):
                    cotangent = self.total(cotangent, count)
                cotangent = int(self.entries(cotangent))
            found[node] = self.apply("add", found.get(node, zero), cotangent)

        for node, cotangent in zip(outputs, cotangents, strict=True):
            add(int(node), int(cotangent))
        for node in sorted(dependent, reverse=True):
            name, *arguments = self.operations[node]
            shape = self.shapes.get(node, ())
            if node in entries:
                scalars = np.full(shape, zero)
                scalars.flat[list(entries[node])] = list(entries[node].values())
                add(node, self.array(scalars))
            own, rule = found.get(node), None if linear else self.rules.get(node)
            if node in independent:
                continue
            if rule is not None:
                # all results together: those that need them have been passed
                if node == firsts[id(rule)]:
                    active, product = self._product(rule)
                    results = [found.get(each, zero) for each in self._all_parts(rule.results)]
                    pulled = self.gradient(product.outputs, results, product.inputs, linear=True)
                    moving = self._all_parts(rule.arguments[k] for k in active)
                    for each, cotangent in zip(moving, pulled, strict=True):
                        add(each, cotangent)
            elif own is None:
                continue
            elif name == "select":
                p, no, yes = arguments
                add(no, self.apply("select", p, own, zero), shape)
                add(yes, self.apply("select", p, zero, own), shape)
            elif name in PARTIALS:
                for argument, partial in zip(arguments, PARTIALS[name], strict=True):
                    if argument in dependent:
                        add(argument, self.apply("mul", self._partial(partial, node), own), shape)
            elif name in LINEAR:
                argument, *parameters = arguments
                add(argument, *LINEAR[name].transpose(self, own, self.shapes.get(argument), *parameters))
            elif name == "hold" and linear:
                add(arguments[0], own)
            elif name == "entry":
                entries.setdefault(arguments[0], {})[arguments[1]] = own
            elif name == "stack":
                for each, cotangent in zip(arguments, self.entries(own, shape), strict=True):
                    add(each, int(cotangent))
            elif name == "result":
                raise self._loop_error(arguments[0])
        return [
            self.spread(found.get(node, zero), Positions.whole(self.shapes[node]), self.shapes[node])
            if node in self.shapes
            else found.get(node, zero)
            for node in map(int, variables)
        ]

    def dependent(
        self, outputs: Sequence[int] | Nodes, variables: Sequence[int] | Nodes, linear: bool = False
    ) -> set[int]:
        """Return the nodes from variables to outputs that move with the variables; see `gradient`."""
        independent, found = set(map(int, variables)), set[int]()
        arguments = self.arguments if linear else self._sources_of_tangents

        def sources(node: int) -> Iterable[int]:
            return () if node in independent else arguments(node)

        for node in self._order(outputs, sources):
            if node in independent or not found.isdisjoint(sources(node)):
                found.add(node)
        return found

    def _partial(self, partial: Callable[..., _Scalar | float], node: int) -> int:
        """Return a partial derivative of an operation."""
        value = partial(*(_Scalar(self, each) for each in (node, *self.operations[node][1:])))
        return value.node if isinstance(value, _Scalar) else self.constant(value)

    def _loop_error(self, node: int) -> EngineError:
        return EngineError(
            f"{self.loops[node].source}: a while loop is differentiated; state its "
            "derivative by jax.custom_jvp, or stop the gradient of its inputs and add one Newton correction "
            "after it"
        )

    def _forward(self, outputs: Sequence[int] | Nodes, seeds: Tangents) -> Tangents:
        """Return tangents of the nodes needed, by variable; zero ones are left out."""

        def sources(node: int) -> Iterable[int]:
            return () if node in seeds else self._sources_of_tangents(node)

        found = {node: self._nonzero(each) for node, each in seeds.items()}
        for node in self._order(outputs, sources):
            if node in found:
                continue
            name, *operands = self.operations[node]
            if name == "select":
                found[node] = self._select_tangents(node, found)
            elif name in PARTIALS:
                found[node] = self._chain_tangents(node, found)
            elif name in LINEAR:
                argument, *parameters = operands
                tangents = found.get(argument, {}).items()
                images = {key: LINEAR[name].image(self, each, *parameters) for key, each in tangents}
                found[node] = self._nonzero(images)
            elif name in ("stack", "inputs"):
                found[node] = self._stack_tangents(self.entries(node), found)
            elif name == "entry":
                found[node] = self._entry_tangents(operands[0], operands[1], found)
            elif (rule := self.rules.get(node)) is not None:
                self._by_rule(rule, found)
            elif name == "loop" and any(found.get(a) for a in self.arguments(node)):
                raise self._loop_error(node)
        return found

    def _nonzero(self, tangents: dict[Any, int]) -> dict[Any, int]:
        return {key: node for key, node in tangents.items() if not self.is_constant(node, 0.0)}

    def _select_tangents(self, node: int, found: Tangents) -> dict[Any, int]:
        _, p, *branches = self.operations[node]
        no, yes = (found.get(branch, {}) for branch in branches)
        zero = self.constant(0.0)
        return {k: self.apply("select", p, no.get(k, zero), yes.get(k, zero)) for k in {**no, **yes}}

    def _chain_tangents(self, node: int, found: Tangents) -> dict[Any, int]:
        name, *arguments = self.operations[node]
        partials, zero = dict[int, int](), self.constant(0.0)
        for argument, partial in zip(arguments, PARTIALS[name], strict=True):
            if found.get(argument):
                own = self._partial(partial, node)
                partials[argument] = self.apply("add", partials.get(argument, zero), own)
        total: dict[Any, int] = {}
        for argument, own in partials.items():
            for key, tangent in found[argument].items():
                total[key] = self.apply("add", total.get(key, zero), self.apply("mul", own, tangent))
        return self._nonzero(total)

    def _stack_tangents(self, scalars: Nodes, found: Tangents) -> dict[Any, int]:
        """Return the tangents of an array of scalars.

        The variables are these scalars themselves if that takes fewer products: unit vectors choose columns
        of a matrix, at no cost, but there may be more of them, and each entry of a result is combined later.
        """
        moving = {k: found[node] for k, node in enumerate(scalars.tolist()) if found.get(node)}
        keys = dict.fromkeys(key for tangents in moving.values() for key in tangents)
        is_sparse = 2 * sum(map(len, moving.values())) < len(moving) * len(keys)
        if len(moving) < 2 * len(keys) and is_sparse:
            return {_Component(int(scalars[k])): self.unit(scalars.size, k) for k in moving}
        zero = np.full(scalars.size, self.constant(0.0))
        tangents = {}
        for key in keys:
            own = zero.copy()
            for k, each in moving.items():
                own[k] = each.get(key, zero[k])
            tangents[key] = self.array(own)
        return tangents

    def _entry_tangents(self, array: int, k: int, found: Tangents) -> dict[Any, int]:
        """Return the tangents of an entry of an array, by variables that are no components of arrays."""
        total, zero = dict[Any, int](), self.constant(0.0)
        for key, tangent in found.get(array, {}).items():
            own = int(self.entries(tangent, self.shapes[array]).flat[k])
            chain = found[key.node] if isinstance(key, _Component) else {key: self.constant(1.0)}
            for variable, slope in chain.items():
                total[variable] = self.apply("add", total.get(variable, zero), self.apply("mul", own, slope))
        return self._nonzero(total)

    def _sources_of_tangents(self, node: int) -> Iterable[int]:
        """Return the nodes that the derivative of a node depends on."""
        if self.operations[node][0] != "hold":
            return self.arguments(node)
        rule = self.rules[node]
        return () if rule is None else self._all_parts(rule.arguments)

    def _by_rule(self, rule: _DerivativeRule, found: Tangents) -> None:
        """Add the tangents of all results of a rule."""
        moving = {node: found[node] for node in self._all_parts(rule.arguments) if found.get(node)}
        results = self._all_parts(rule.results)
        found.update((node, {}) for node in results)
        zero = self.constant(0.0)
        for key in dict.fromkeys(key for each in moving.values() for key in each):
            active, product = self._product(rule)
            places = self._all_parts(rule.arguments[k] for k in active)
            own = [moving.get(node, {}).get(key, zero) for node in places]
            tangents = self._replace(product, dict(zip(product.inputs, own, strict=True)))
            for node, tangent in zip(results, tangents, strict=True):
                if not self.is_constant(tangent, 0.0):
                    found[node][key] = tangent

    def _product(self, rule: _DerivativeRule) -> tuple[list[int], _Product]:
        """Return the active arguments of a rule, and its results' tangents."""
        if rule.product is None:
            active, jaxpr = rule.trace()
            prefix, tangents = f"tangent {len(self.operations)}", []
            for k, nodes in enumerate(rule.arguments[k] for k in active):
                if self.is_computed(nodes):
                    tangents.append(self.entries(self.array_input(f"{prefix} {k}", nodes.shape, 1)))
                else:
                    tangents.append(self.inputs(f"{prefix} {k}", nodes.shape, 1))
            outputs = self._all_parts(self.evaluate(jaxpr, [*rule.arguments, *tangents]))
            inputs = self._all_parts(tangents)
            depending, steps = set(inputs), []
            for node in self._order(outputs, self._sources):
                if not depending.isdisjoint(self._sources(node)):
                    depending.add(node)
                    steps.append(node)
            rule.product = active, _Product(inputs, outputs, steps)
        return rule.product

    def _sources(self, node: int) -> tuple[int, ...]:
        """Return the nodes that value and derivatives of a node, and its rule's other results, depend on."""
        rule = self.rules.get(node)
        if rule is None:
            return self.arguments(node)
        results = self._all_parts(rule.results)
        return (*self._all_parts(rule.arguments), *(self.operations[each][1] for each in results))

    def _replace(self, product: _Product, new: dict[int, int]) -> list[int]:
        """Return the outputs with other nodes in the place of the inputs."""
        for node in product.steps:
            rule = self.rules.get(node)
            if node in new:
                continue
            if rule is None:
                new[node] = self._with_arguments(node, new)
                continue
            arguments = [
                self._nodes([new.get(each, each) for each in self.parts(array)], array.shape)
                for array in rule.arguments
            ]
            copy = _DerivativeRule(rule.function, rule.shapes, arguments)
            for array in rule.results:
                parts = self.parts(array)
                values = [self.operations[each][1] for each in parts]
                held = [self.hold(new.get(each, each), copy) for each in values]
                new.update(zip(parts, held, strict=True))
                copy.results.append(self._nodes(held, array.shape))
        return [new.get(node, node) for node in product.outputs]

    def _nodes(self, parts: list[int], shape: tuple[int, ...]) -> Nodes:
        """Return the scalars of an array, or of a list of all scalars."""
        if len(parts) == 1:
            return self.entries(parts[0], shape).reshape(shape)
        return np.array(parts, dtype=np.int64).reshape(shape)

    def _with_arguments(self, node: int, new: dict[int, int]) -> int:
        """Return an operation with other arguments in the place of its own."""
        name, *rest = self.operations[node]
        if name in ("loop", "result"):
            raise EngineError("a derivative rule depends on tangents by a while loop; use a formula")
        arguments = [new.get(each, each) for each in self.arguments(node)]
        if name == "stack":
            return self.array(np.array(arguments, dtype=np.int64))
        if name in LINEAR:
            return LINEAR[name].image(self, arguments[0], *rest[1:])
        if name == "entry":
            return int(self.entries(arguments[0], self.shapes[rest[0]]).flat[rest[1]])
        return self.apply(name, *arguments)

    # jaxprs

    def evaluate(self, closed_jaxpr: Any, arguments: Sequence[Nodes]) -> list[Nodes]:
        """Return the results of a jaxpr for arrays of nodes."""
        return _JaxprEvaluation(self).closed(closed_jaxpr, arguments)


class _Component(NamedTuple):
    """Variable of a derivative: a scalar in an array."""

    node: int


class _Linear(NamedTuple):
    """A linear operation on an array: it for another argument, and its transpose.

    Both have the operation's parameters. The transpose of a result's cotangent has the shape of the argument
    before them, and returns a cotangent for the entries of some shape.
    """

    image: Callable[..., int]
    transpose: Callable[..., tuple[int, tuple[int, ...]]]


def _transposed_view(
    program: Program, own: int, shape: tuple[int, ...], positions: Positions
) -> tuple[int, tuple[int, ...]]:
    first, strides, counts = positions
    # repeated entries are added
    for axis in reversed(range(len(counts))):
        if strides[axis] == 0:
            order = np.moveaxis(np.arange(math.prod(counts)).reshape(counts), axis, -1)
            own = program.total(program.view(own, order), counts[axis])
            strides, counts = (each[:axis] + each[axis + 1 :] for each in (strides, counts))
    return program.spread(own, Positions(first, strides, counts), shape), shape


def _transposed_sum(
    program: Program, own: int, shape: tuple[int, ...], _: int
) -> tuple[int, tuple[int, ...]]:
    rows = np.arange(math.prod(shape[:-1])).reshape(*shape[:-1], 1)
    return program.view(own, np.broadcast_to(rows, shape)), shape


#: linear operations on arrays
LINEAR = {
    "view": _Linear(lambda program, x, positions: program.view(x, positions.all()), _transposed_view),
    "sum": _Linear(lambda program, x, count: program.total(x, count), _transposed_sum),
    "spread": _Linear(
        lambda program, x, positions, shape: program.spread(x, positions, shape),
        lambda program, own, _, positions, shape: (program.view(own, positions.all()), positions.shape),
    ),
}

#: rules that return an equal node that is simpler than an operation, or None
REWRITES: dict[str, Callable[..., int | None]] = {
    "add": Program._simple_add, "sub": Program._simple_sub, "neg": Program._simple_neg,
    "mul": Program._simple_mul, "div": Program._simple_div, "abs": Program._simple_abs,
    "pow": Program._simple_pow, "select": Program._simple_select, "not": Program._simple_not,
    "hold": Program._simple_hold,
}  # fmt: skip


def _arithmetic(
    operation: str,
) -> tuple[Callable[[_Scalar, Any], _Scalar], Callable[[_Scalar, Any], _Scalar]]:
    """Return an operator of scalars, and the one for a scalar on its right."""
    return (
        lambda x, other: x.of(operation, other),
        lambda x, other: _Scalar(x.program, x.program.constant(other)).of(operation, x),
    )


class _Scalar:
    """A node with arithmetic, to write formulas."""

    def __init__(self, program: Program, node: int) -> None:
        self.program = program
        self.node = node

    def of(self, operation: str, *others: _Scalar | float) -> _Scalar:
        """Return an operation on this and on other scalars or numbers."""
        nodes = [
            other.node if isinstance(other, _Scalar) else self.program.constant(other) for other in others
        ]
        return _Scalar(self.program, self.program.apply(operation, self.node, *nodes))

    def __neg__(self) -> _Scalar:
        return self.of("neg")

    __add__, __radd__ = _arithmetic("add")
    __sub__, __rsub__ = _arithmetic("sub")
    __mul__, __rmul__ = _arithmetic("mul")
    __truediv__, __rtruediv__ = _arithmetic("div")


def _share(a: _Scalar, b: _Scalar, comparison: str) -> _Scalar:
    """Return the derivative of max or min by the first argument: a half at ties."""
    tied = a.of("eq", b).of("select", 0.0, 0.5)
    return a.of(comparison, b).of("select", tied, 1.0)


#: partial derivatives by each argument, from the result r and the arguments; other operations have none
PARTIALS: dict[str, tuple[Callable[..., _Scalar | float], ...]] = {
    "add": (lambda r, a, b: 1.0, lambda r, a, b: 1.0),
    "sub": (lambda r, a, b: 1.0, lambda r, a, b: -1.0),
    "mul": (lambda r, a, b: b, lambda r, a, b: a),
    "div": (lambda r, a, b: 1.0 / b, lambda r, a, b: -r * (1.0 / b)),
    "neg": (lambda r, a: -1.0,),
    "abs": (lambda r, a: a.of("ge", 0.0).of("select", -1.0, 1.0),),
    "sqrt": (lambda r, a: 0.5 / r,),
    "exp": (lambda r, a: r,),
    "log": (lambda r, a: 1.0 / a,),
    "log1p": (lambda r, a: 1.0 / (1.0 + a),),
    "expm1": (lambda r, a: 1.0 + r,),
    "sin": (lambda r, a: a.of("cos"),),
    "cos": (lambda r, a: -a.of("sin"),),
    "tan": (lambda r, a: 1.0 + r * r,),
    "tanh": (lambda r, a: 1.0 - r * r,),
    "atan2": (lambda r, a, b: b / (a * a + b * b), lambda r, a, b: -a / (a * a + b * b)),
    "asin": (lambda r, a: 1.0 / (1.0 - a * a).of("sqrt"),),
    "acos": (lambda r, a: -1.0 / (1.0 - a * a).of("sqrt"),),
    "atan": (lambda r, a: 1.0 / (1.0 + a * a),),
    "pow": (
        lambda r, a, b: b * a.of("pow", b - 1.0),
        lambda r, a, b: a.of("eq", 0.0).of("select", a, 1.0).of("log") * r,
    ),
    "max": (lambda r, a, b: _share(a, b, "gt"), lambda r, a, b: 1.0 - _share(a, b, "gt")),
    "min": (lambda r, a, b: _share(a, b, "lt"), lambda r, a, b: 1.0 - _share(a, b, "lt")),
    "rem": (lambda r, a, b: 1.0, lambda r, a, b: (r - a) / b),
    "erf": (lambda r, a: (-(a * a)).of("exp") * (2.0 / math.sqrt(math.pi)),),
    "logistic": (lambda r, a: r * (1.0 - r),),
}


def _sinh(x: _Scalar) -> _Scalar:
    grown = x.of("expm1")
    return 0.5 * (grown + grown / (1.0 + grown))


def _cbrt(x: _Scalar) -> _Scalar:
    size = (x.of("abs").of("log") / 3.0).of("exp")
    return x.of("sign") * x.of("eq", 0.0).of("select", size, 0.0)


def _round_to_even(x: _Scalar) -> _Scalar:
    up = (x + 0.5).of("floor")
    odd = up.of("rem", 2.0).of("ne", 0.0)
    return odd.of("and", (up - x).of("eq", 0.5)).of("select", up, up - 1.0)


#: functions of one number by other operations
FORMULAS: dict[str, Callable[[_Scalar], _Scalar]] = {
    "square": lambda x: x * x,
    "one_minus_square": lambda x: (1.0 - x) * (1.0 + x),
    "rsqrt": lambda x: 1.0 / x.of("sqrt"),
    "cbrt": _cbrt,
    "exp2": lambda x: (x * math.log(2.0)).of("exp"),
    "ceil": lambda x: -(-x).of("floor"),
    "sinh": _sinh,
    "cosh": lambda x: 0.5 * (x.of("exp") + (-x).of("exp")),
    "asinh": lambda x: x.of("sign") * (x.of("abs") + x * x / (1.0 + (1.0 + x * x).of("sqrt"))).of("log1p"),
    "acosh": lambda x: (x + ((x - 1.0) * (x + 1.0)).of("sqrt")).of("log"),
    "atanh": lambda x: 0.5 * (2.0 * x / (1.0 - x)).of("log1p"),
    "round": lambda x: x.of("sign") * (x.of("abs") + 0.5).of("floor"),
}

#: primitives that are operations under another or the same name
ELEMENTWISE = {name: name for name in FOLDED if name not in ("select", "hold", "isfinite")} | {
    "add_any": "add",
    "is_finite": "isfinite",
    "stop_gradient": "hold",
    "lt_to": "lt",
    "le_to": "le",
}
UNCHANGED = frozenset({"copy", "copy_p", "optimization_barrier", "reduce_precision", "device_put", "pvary"})
CALLS = ("jaxpr", "call_jaxpr", "fun_jaxpr")
REDUCED = {
    "reduce_sum": "add",
    "reduce_prod": "mul",
    "reduce_max": "max",
    "reduce_min": "min",
    "reduce_and": "and",
    "reduce_or": "or",
}
ACCUMULATED = {"cumsum": "add", "cumprod": "mul", "cummax": "max", "cummin": "min"}
#: primitives that move entries, from arrays of nodes and parameters
RESHAPED: dict[str, Callable[[Any, Any], Nodes]] = {
    "reshape": lambda arrays, own: arrays[0].reshape(own["new_sizes"]),
    "squeeze": lambda arrays, own: np.squeeze(arrays[0], tuple(own["dimensions"])),
    "expand_dims": lambda arrays, own: np.expand_dims(arrays[0], tuple(own["dimensions"])),
    "transpose": lambda arrays, own: np.transpose(arrays[0], own["permutation"]),
    "concatenate": lambda arrays, own: np.concatenate(arrays, axis=own["dimension"]),
    "stack": lambda arrays, own: np.stack(arrays, axis=own["axis"]),
    "tile": lambda arrays, own: np.tile(arrays[0], own["reps"]),
    "rev": lambda arrays, own: np.flip(arrays[0], own["dimensions"]),
}
SCATTERED = {
    "scatter-add": "add",
    "scatter_add": "add",
    "scatter_mul": "mul",
    "scatter-mul": "mul",
    "scatter_min": "min",
    "scatter-min": "min",
    "scatter_max": "max",
    "scatter-max": "max",
}
#: primitives that are not covered, with what to use instead
INSTEAD = {
    "custom_vjp_call": "use jax.custom_jvp",
    "custom_vjp_call_jaxpr": "use jax.custom_jvp",
    "eigh": "use a closed form, or a Cholesky factorisation",
    "svd": "use jnp.linalg.solve or a Cholesky factorisation",
    "qr": "use jnp.linalg.solve or a Cholesky factorisation",
    "random_bits": "draw random numbers outside of the equations",
    "threefry2x32": "draw random numbers outside of the equations",
    "pure_callback": "write the function in jax.numpy",
    "io_callback": "write the function in jax.numpy",
    "debug_callback": "remove jax.debug.print and jax.debug.callback",
}
JAX = str(Path(jax.__file__).parent)


def source_line(equations: Sequence[Any]) -> str:
    """Return file and line of the user's code that made the last of nested equations."""
    for equation in reversed(equations):
        traceback = equation.source_info.traceback
        for frame in () if traceback is None else traceback.frames:
            if not frame.file_name.startswith((JAX, "<")) and "site-packages" not in frame.file_name:
                return f"{frame.file_name}:{frame.line_num}"
    return "unknown line"


class _JaxprEvaluation:
    """Evaluates jaxprs on the nodes of a program. Methods `_do_…` are of primitives."""

    def __init__(self, program: Program) -> None:
        self.program = program
        self.apply = program.apply
        #: equations that are being evaluated, from the outermost one
        self.nested: list[Any] = []

    def closed(self, closed: Any, arguments: Sequence[Nodes]) -> list[Nodes]:
        """Return the results of a closed jaxpr."""
        return self.run(closed.jaxpr, [self.program.constants(each) for each in closed.consts], arguments)

    def run(self, jaxpr: Any, constants: Sequence[Nodes], arguments: Sequence[Nodes]) -> list[Nodes]:
        """Return the results of a jaxpr."""
        known = dict(zip((*jaxpr.constvars, *jaxpr.invars), (*constants, *arguments), strict=True))

        def read(atom: Any) -> Nodes:
            return self.program.constants(atom.val) if isinstance(atom, Literal) else known[atom]

        for equation in jaxpr.eqns:
            self.nested.append(equation)
            results = self.equation(equation, [read(atom) for atom in equation.invars])
            self.nested.pop()
            known.update(zip(equation.outvars, results, strict=True))
        return [read(atom) for atom in jaxpr.outvars]

    def equation(self, equation: Any, arguments: list[Nodes]) -> list[Nodes]:
        """Return the results of an equation of a jaxpr."""
        name, params = equation.primitive.name, equation.params
        method = getattr(self, f"_do_{name.replace('-', '_')}", None)
        if method is not None:
            results = method(equation, *arguments)
            return results if isinstance(results, list) else [results]
        if name in UNCHANGED:
            return arguments
        if name in FORMULAS:
            return [self._of_one(FORMULAS[name], arguments[0])]
        if name in ELEMENTWISE:
            return [self.elementwise(self._operation(equation, ELEMENTWISE[name]), *arguments)]
        if name in RESHAPED:
            return [RESHAPED[name](arguments, params)]
        if name in REDUCED:
            return [self._reduce(REDUCED[name], arguments[0], params["axes"])]
        if name in ACCUMULATED:
            return [self._accumulate(ACCUMULATED[name], equation, *arguments)]
        if name in SCATTERED:
            return [self._do_scatter(equation, *arguments)]
        inner = next((params[key] for key in CALLS if key in params), None)
        if inner is None or name in INSTEAD:
            raise self.error(equation)
        if isinstance(inner, Jaxpr):
            inner = ClosedJaxpr(inner, ())
        return self.closed(inner, arguments)

    def error(
        self, equation: Any, reason: str = "is not covered by the engine", instead: str = ""
    ) -> EngineError:
        """Return the error of an equation that is not covered."""
        name = equation.primitive.name
        instead = instead or INSTEAD.get(name, "write it with other functions of jax.numpy")
        return EngineError(f"{source_line(self.nested)}: {name} {reason}; {instead}")

    def _operation(self, equation: Any, name: str) -> Any:
        """Return an operation on scalars: those of integers and booleans differ."""
        dtype = equation.invars[0].aval.dtype
        boolean = np.issubdtype(dtype, np.bool_)
        if boolean and name in ("eq", "ne"):
            return self._differs if name == "ne" else lambda a, b: self.apply("not", self._differs(a, b))
        if boolean and name in ("max", "min"):
            return {"max": "or", "min": "and"}[name]
        if name in ("and", "or", "not") and not boolean:
            raise self.error(equation, "of integers is not covered by the engine", "use booleans")
        if name == "div" and np.issubdtype(dtype, np.integer):
            return lambda a, b: self.truncate(self.apply("div", a, b))
        return name

    def _differs(self, a: int, b: int) -> int:
        return self.apply("select", a, b, self.apply("not", b))

    def truncate(self, a: int) -> int:
        """Return a number rounded towards zero."""
        return self.apply("mul", self.apply("sign", a), self.apply("floor", self.apply("abs", a)))

    def elementwise(self, operation: Any, *arrays: Nodes) -> Nodes:
        """Return the results of an operation (a name or a function) for all entries."""
        if isinstance(operation, str):
            name, apply = operation, self.apply
            operation = lambda *nodes: apply(name, *nodes)  # noqa: E731
        if len(arrays) > 1:
            arrays = np.broadcast_arrays(*arrays)
        if any(self.program.is_computed(array) for array in arrays):
            parts = [self._array_or_scalar(array) for array in arrays]
            if None not in parts:
                return self.program.entries(operation(*parts), arrays[0].shape)
        entries = zip(*(array.ravel().tolist() for array in arrays), strict=True)
        return np.array([operation(*each) for each in entries], dtype=np.int64).reshape(arrays[0].shape)

    def _array_or_scalar(self, nodes: Nodes) -> int | None:
        """Return an array, or the scalar that all entries are; None if the entries are few and different."""
        if (nodes == nodes.flat[0]).all():
            return int(nodes.flat[0])
        few = nodes.size <= LARGEST_PRODUCT and self.program.locate(nodes) is None
        return None if few else self.program.array(nodes)

    def where(self, condition: int, no: list[Nodes], yes: list[Nodes]) -> list[Nodes]:
        """Return one or the other of two lists of arrays."""
        return [
            self.elementwise(lambda a, b: self.apply("select", condition, a, b), *each)
            for each in zip(no, yes, strict=True)
        ]

    # shapes

    def _do_broadcast_in_dim(self, e: Any, x: Nodes, *_: Any) -> Nodes:
        shape = e.params["shape"]
        own = [1] * len(shape)
        for size, axis in zip(x.shape, e.params["broadcast_dimensions"], strict=True):
            own[axis] = size
        return np.broadcast_to(x.reshape(own), shape)

    def _do_slice(self, e: Any, x: Nodes) -> Nodes:
        starts, limits = e.params["start_indices"], e.params["limit_indices"]
        return x[tuple(map(slice, starts, limits, e.params["strides"] or (1,) * x.ndim))]

    def _do_split(self, e: Any, x: Nodes) -> list[Nodes]:
        return list(np.split(x, np.cumsum(e.params["sizes"])[:-1], e.params["axis"]))

    def _do_unstack(self, e: Any, x: Nodes) -> list[Nodes]:
        return list(np.moveaxis(x, e.params["axis"], 0))

    def _do_iota(self, e: Any) -> Nodes:
        shape, dimension = e.params["shape"], e.params["dimension"]
        own = [1] * len(shape)
        own[dimension] = -1
        return self.program.constants(np.broadcast_to(np.arange(shape[dimension]).reshape(own), shape))

    def _do_pad(self, e: Any, x: Nodes, fill: Nodes) -> Nodes:
        for axis, (low, high, inner) in enumerate(e.params["padding_config"]):
            x = np.moveaxis(x, axis, 0)
            size = max(0, len(x) + max(0, len(x) - 1) * inner)
            out = np.full((size + max(low, 0) + max(high, 0), *x.shape[1:]), int(fill))
            out[max(low, 0) : max(low, 0) + size : inner + 1] = x
            x = np.moveaxis(out[max(-low, 0) : len(out) - max(-high, 0)], 0, axis)
        return x

    # numbers

    def _do_convert_element_type(self, e: Any, x: Nodes) -> Nodes:
        old, new_dtype = e.invars[0].aval.dtype, e.params["new_dtype"]
        if old == new_dtype:
            return x
        zero, one = self.program.constant(0.0), self.program.constant(1.0)
        if np.issubdtype(old, np.bool_):
            return self.elementwise(lambda a: self.apply("select", a, zero, one), x)
        if np.issubdtype(new_dtype, np.bool_):
            return self.elementwise(lambda a: self.apply("ne", a, zero), x)
        if np.issubdtype(old, np.floating) and np.issubdtype(new_dtype, np.integer):
            return self.elementwise(self.truncate, x)
        return x

    def _do_integer_pow(self, e: Any, x: Nodes) -> Nodes:
        return self.elementwise(lambda a: self.program.power(a, e.params["y"]), x)

    def _do_round(self, e: Any, x: Nodes) -> Nodes:
        is_even = int(e.params["rounding_method"]) == 1
        return self._of_one(_round_to_even if is_even else FORMULAS["round"], x)

    def _of_one(self, formula: Callable[[_Scalar], _Scalar], x: Nodes) -> Nodes:
        return self.elementwise(lambda node: formula(_Scalar(self.program, node)).node, x)

    def _do_xor(self, e: Any, a: Nodes, b: Nodes) -> Nodes:
        return self.elementwise(self._operation(e, "ne"), a, b)

    def _do_clamp(self, e: Any, low: Nodes, x: Nodes, high: Nodes) -> Nodes:
        def clamped(low: int, x: int, high: int) -> int:
            below = self.apply("select", self.apply("ge", x, high), x, high)
            return self.apply("select", self.apply("le", x, low), below, low)

        return self.elementwise(clamped, low, x, high)

    def _do_select_n(self, e: Any, which: Nodes, *cases: Nodes) -> Nodes:
        if np.issubdtype(e.invars[0].aval.dtype, np.bool_):
            return self.elementwise("select", which, *cases)
        entries = np.stack(cases).reshape(len(cases), -1)
        which = np.broadcast_to(which, cases[0].shape).ravel()
        chosen = [
            self.by_index(e, [node], [(0, len(cases) - 1)], lambda case, k=k: [entries[case, k : k + 1]])[0]
            for k, node in enumerate(which.tolist())
        ]
        return np.concatenate(chosen).reshape(cases[0].shape)

    # reductions

    def _accumulate(self, operation: str, e: Any, x: Nodes) -> Nodes:
        way = slice(None, None, -1 if e.params["reverse"] else 1)
        x = np.moveaxis(x, e.params["axis"], 0)[way]
        found = x.copy()
        for k in range(1, len(x)):
            found[k] = self.elementwise(operation, found[k - 1], x[k])
        return np.moveaxis(found[way], 0, e.params["axis"])

    def _reduce(self, operation: str, x: Nodes, axes: Sequence[int]) -> Nodes:
        rest = tuple(k for k in range(x.ndim) if k not in axes)
        shape = tuple(x.shape[k] for k in rest)
        rows = x.transpose(*axes, *rest).reshape(-1, *shape)
        if not len(rows):
            empty: Any = {"add": 0.0, "mul": 1.0, "max": -np.inf, "min": np.inf, "and": True, "or": False}
            return np.full(shape, self.program.constant(empty[operation]))
        if operation == "add" and self.program.is_computed(rows):
            last = self.program.array(np.moveaxis(rows, 0, -1))
            return self.program.entries(self.program.total(last, len(rows)), shape)
        total = rows[0]
        for row in rows[1:]:
            total = self.elementwise(operation, total, row)
        return total

    def _do_argmin(self, e: Any, x: Nodes) -> Nodes:
        return self._best_index("lt", np.moveaxis(x, e.params["axes"][0], 0))

    def _do_argmax(self, e: Any, x: Nodes) -> Nodes:
        return self._best_index("gt", np.moveaxis(x, e.params["axes"][0], 0))

    def _best_index(self, comparison: str, rows: Nodes) -> Nodes:
        f = self.apply
        best, index = rows[0], np.full(rows.shape[1:], self.program.constant(0.0))
        for k in range(1, len(rows)):
            # the first NaN counts as the smallest and as the largest number
            missing = self.elementwise(lambda a, b: f("and", f("ne", a, a), f("eq", b, b)), rows[k], best)
            better = self.elementwise("or", self.elementwise(comparison, rows[k], best), missing)
            best = self.elementwise("select", better, best, rows[k])
            index = self.elementwise("select", better, index, self.program.constants(k))
        return index

    def _do_sort(self, e: Any, *arrays: Nodes) -> list[Nodes]:
        dimension = e.params["dimension"]
        moved = [np.moveaxis(array, dimension, 0) for array in arrays]
        count = len(moved[0])
        keys = [self._values(key) for key in moved[: e.params["num_keys"]]]
        if not any(np.isnan(key).any() for key in keys):
            order = np.lexsort(keys[::-1], axis=0)
            moved = [np.take_along_axis(array, order, axis=0) for array in moved]
        elif len(arrays) == 1 and count <= LONGEST_SORT:
            rows = list(moved[0])
            for last in range(count - 1, 0, -1):
                for k in range(last):
                    pair = rows[k], rows[k + 1]
                    rows[k], rows[k + 1] = self.elementwise("min", *pair), self.elementwise("max", *pair)
            moved = [np.stack(rows)]
        else:
            raise self.error(e, f"of {count} variable numbers is not covered by the engine", "sort constants")
        return [np.moveaxis(array, 0, dimension) for array in moved]

    def _values(self, x: Nodes) -> np.ndarray:
        """Return the values of constants, and NaN for other nodes."""
        values = [self.program.values[node] for node in x.ravel().tolist()]
        return np.array([math.nan if each is None else each for each in values], dtype=float).reshape(x.shape)

    # variable indices

    def by_index(
        self,
        e: Any,
        nodes: Sequence[int],
        ranges: Sequence[tuple[int, int]],
        entry: Callable[..., list[Nodes]],
    ) -> list[Nodes]:
        """Return the entry for indices that may be variables: by selects; indices are clipped to ranges."""
        if not nodes:
            return entry()
        program, memo = self.program, {}
        low, high = ranges[0]

        def at(k: int) -> list[Nodes]:
            return self.by_index(e, nodes[1:], ranges[1:], lambda *rest: entry(k, *rest))

        def found(node: int) -> list[Nodes]:
            if node not in memo:
                memo[node] = search(node)
            return memo[node]

        def search(node: int) -> list[Nodes]:
            if program.is_constant(node):
                return at(min(max(int(program.values[node]), low), high))
            if node in program.choices:
                _, p, no, yes = program.operations[node]
                return self.where(p, found(no), found(yes))
            if high - low >= LARGEST_TABLE:
                raise self.error(
                    e,
                    f"with a variable index into {high - low + 1} entries is not covered by the engine",
                    f"use a formula, or at most {LARGEST_TABLE} entries",
                )
            values = at(low)
            for k in range(low + 1, high + 1):
                beyond = self.apply("ge", node, program.constant(float(k)))
                values = self.where(beyond, values, at(k))
            return values

        return found(int(nodes[0]))

    def _do_dynamic_slice(self, e: Any, x: Nodes, *starts: Nodes) -> list[Nodes]:
        slice_sizes = e.params["slice_sizes"]
        ranges = [(0, size - own) for size, own in zip(x.shape, slice_sizes, strict=True)]

        def entry(*first: int) -> list[Nodes]:
            return [x[tuple(slice(k, k + n) for k, n in zip(first, slice_sizes, strict=True))]]

        return self.by_index(e, [int(start) for start in starts], ranges, entry)

    def _do_dynamic_update_slice(self, e: Any, x: Nodes, update: Nodes, *starts: Nodes) -> list[Nodes]:
        ranges = [(0, size - own) for size, own in zip(x.shape, update.shape, strict=True)]

        def entry(*first: int) -> list[Nodes]:
            out = x.copy()
            out[tuple(slice(k, k + n) for k, n in zip(first, update.shape, strict=True))] = update
            return [out]

        return self.by_index(e, [int(start) for start in starts], ranges, entry)

    def _windows(
        self,
        e: Any,
        indices: Nodes,
        axes: tuple[Any, ...],
        sizes: Sequence[int],
        entry: Callable[[Any, Any], list[Nodes]],
    ) -> Callable[[Any], list[Nodes]]:
        """Return a function that calls entry(place, slices) for a batch index; slices are None outside.

        `axes` of the first operand: those of variable indices, of batches, and of batches in the indices.
        """
        shape, (moving, own, batch_axes) = e.invars[0].aval.shape, axes
        # a gather or scatter may skip indices outside of an array
        margin = 1 if "FILL" in str(e.params["mode"]).upper() else 0

        def at(place: Any) -> list[Nodes]:
            fixed = {axis: place[k] for axis, k in zip(own, batch_axes, strict=True)}
            ranges = [(-margin, shape[axis] - sizes[axis] + margin) for axis in moving]

            def window(*starts: int) -> list[Nodes]:
                first = fixed | dict(zip(moving, starts, strict=True))
                inside = all(0 <= k <= shape[axis] - sizes[axis] for axis, k in first.items())
                slices = tuple(slice(first.get(a, 0), first.get(a, 0) + sizes[a]) for a in range(len(shape)))
                return entry(place, slices if inside else None)

            return self.by_index(e, indices[place].tolist(), ranges, window)

        return at

    def _do_gather(self, e: Any, x: Nodes, indices: Nodes) -> Nodes:
        d, sizes, fill_value = (e.params[key] for key in ("dimension_numbers", "slice_sizes", "fill_value"))
        dropped = (*d.collapsed_slice_dims, *d.operand_batching_dims)
        kept = tuple(size for axis, size in enumerate(sizes) if axis not in dropped)
        fill = np.full(kept, self.program.constant(math.nan if fill_value is None else fill_value))
        axes = d.start_index_map, d.operand_batching_dims, d.start_indices_batching_dims
        at = self._windows(
            e, indices, axes, sizes, lambda _, slices: [fill if slices is None else x[slices].reshape(kept)]
        )
        batch = indices.shape[:-1]
        out = np.empty((*batch, *kept), dtype=np.int64)
        for place in np.ndindex(*batch):
            out[place] = at(place)[0]
        return np.moveaxis(out, range(len(batch), out.ndim), d.offset_dims)

    def _do_scatter(self, e: Any, x: Nodes, indices: Nodes, updates: Nodes) -> Nodes:
        operation = SCATTERED.get(e.primitive.name)
        d, batch = e.params["dimension_numbers"], indices.shape[:-1]
        window = d.update_window_dims
        updates = np.moveaxis(updates, window, range(len(batch), len(batch) + len(window)))
        dropped = (*d.inserted_window_dims, *d.operand_batching_dims)
        own = iter(updates.shape[len(batch) :])
        sizes = [1 if axis in dropped else next(own) for axis in range(x.ndim)]
        out = x

        def entry(place: Any, slices: Any) -> list[Nodes]:
            if slices is None:
                return [out]
            new, update = out.copy(), updates[place].reshape(sizes)
            new[slices] = self.elementwise(operation, out[slices], update) if operation else update
            return [new]

        axes = d.scatter_dims_to_operand_dims, d.operand_batching_dims, d.scatter_indices_batching_dims
        at = self._windows(e, indices, axes, sizes, entry)
        for place in np.ndindex(*batch):
            out = at(place)[0]
        return out

    # linear algebra

    def _do_dot_general(self, e: Any, a: Nodes, b: Nodes) -> Nodes:
        (summed_a, summed_b), (batch_a, batch_b) = e.params["dimension_numbers"]

        def ordered(x: Nodes, batch: Any, summed: Any) -> tuple[Nodes, tuple[int, ...]]:
            free = [k for k in range(x.ndim) if k not in batch and k not in summed]
            x = x.transpose(*batch, *free, *summed)
            shape = x.shape[: len(batch)], x.shape[len(batch) : len(batch) + len(free)]
            return x.reshape(*(math.prod(each) for each in shape), -1), shape[1]

        batch = tuple(a.shape[k] for k in batch_a)
        (a, free_a), (b, free_b) = ordered(a, batch_a, summed_a), ordered(b, batch_b, summed_b)
        if np.sum(self._nonzero(a) @ self._nonzero(b).transpose(0, 2, 1)) > LARGEST_PRODUCT:
            program, (*rows, count) = self.program, a.shape[:2] + b.shape[1:]
            views = []
            for x, axis in ((a, 2), (b, 1)):
                positions = np.expand_dims(np.arange(x.size).reshape(x.shape), axis)
                own = np.broadcast_to(positions, (*rows, count)).reshape(*(n for n in rows if n > 1), count)
                views.append(program.view(program.array(x), own))
            total = program.total(self.apply("mul", *views), count)
            return program.entries(total).reshape((*batch, *free_a, *free_b))
        products = self.elementwise("mul", a[:, :, None, :], b[:, None, :, :])
        return self._reduce("add", products, (3,)).reshape((*batch, *free_a, *free_b))

    def _nonzero(self, x: Nodes) -> Any:
        """Return 1 for entries that are not structural zeros."""
        return np.where(self._values(x) == 0.0, 0, 1)

    def _each(self, function: Callable[..., list[Nodes]], *arrays: Nodes) -> list[Nodes]:
        """Return the results of a function of matrices for stacks of matrices."""
        batch = arrays[0].shape[:-2]
        if not batch:
            return function(*arrays)
        found = [function(*(array[place] for array in arrays)) for place in np.ndindex(*batch)]
        return [np.stack(each).reshape(*batch, *each[0].shape) for each in zip(*found, strict=True)]

    def _less(self, start: int, a: Iterable[Any], b: Iterable[Any]) -> int:
        """Return start - a·b."""
        for x, y in zip(a, b, strict=True):
            start = self.apply("sub", start, self.apply("mul", int(x), int(y)))
        return start

    def _do_cholesky(self, e: Any, A: Nodes) -> list[Nodes]:
        def factor(A: Nodes) -> list[Nodes]:
            L = self.program.constants(np.zeros(A.shape))
            for j, i in itertools.combinations_with_replacement(range(len(A)), 2):
                rest = self._less(int(A[i, j]), L[i, :j], L[j, :j])
                L[i, j] = self.apply("sqrt", rest) if i == j else self.apply("div", rest, int(L[j, j]))
            return [L]

        return self._each(factor, A)

    def _do_triangular_solve(self, e: Any, A: Nodes, B: Nodes) -> list[Nodes]:
        left_side, transpose_a = e.params["left_side"], e.params["transpose_a"]
        lower, unit_diagonal = e.params["lower"] != (transpose_a == left_side), e.params["unit_diagonal"]

        def solve(A: Nodes, B: Nodes) -> list[Nodes]:
            A, X = (A.T if transpose_a == left_side else A), (B if left_side else B.T).copy()
            n = len(A)
            for k, c in (
                (k, c) for c in range(X.shape[1]) for k in (range(n) if lower else range(n - 1, -1, -1))
            ):
                others = slice(0, k) if lower else slice(k + 1, n)
                rest = self._less(int(X[k, c]), A[k, others], X[others, c])
                X[k, c] = rest if unit_diagonal else self.apply("div", rest, int(A[k, k]))
            return [X if left_side else X.T]

        return self._each(solve, A, B)

    def _do_lu(self, e: Any, A: Nodes) -> list[Nodes]:
        return self._each(self._factors, A)

    def _factors(self, A: Nodes) -> list[Nodes]:
        """Return LU factors, pivots and the permutation.

        Rows are exchanged by values if the matrix is small and not triangular, otherwise only where a pivot
        would be a structural zero.
        """
        f, A = self.apply, A.copy()
        n, columns = A.shape
        pivoted = n <= PIVOTED and np.triu(self._nonzero(A), 1).any()
        order = self.program.constants(np.arange(n))
        pivots = self.program.constants(np.arange(min(n, columns)))
        for k in range(min(n, columns)):
            rows = [i for i in range(k, n) if not self.program.is_constant(int(A[i, k]), 0.0)]
            if not rows:
                continue
            if not pivoted or len(rows) == 1:
                rows = rows[:1]
            sizes = self.elementwise("abs", A[rows, k])
            index = self.by_index(
                None,
                [int(self._best_index("gt", sizes))],
                [(0, len(rows) - 1)],
                lambda place, rows=rows: [self.program.constants(rows[place])],
            )[0]
            pivots[k] = index
            full = np.concatenate([A, order[:, None]], axis=1)
            chosen = self.by_index(None, [int(index)], [(k, n - 1)], lambda row, full=full: [full[row]])[0]
            for i in set(rows) - {k}:
                here = f("eq", int(index), self.program.constant(i))
                full[i] = self.elementwise(lambda a, b, here=here: f("select", here, a, b), full[i], full[k])
            full[k] = chosen
            A, order = full[:, :-1], full[:, -1]
            for i in range(k + 1, n):
                A[i, k] = f("div", int(A[i, k]), int(A[k, k]))
                for j in range(k + 1, columns):
                    A[i, j] = self._less(int(A[i, j]), A[i, k : k + 1], A[k, j : j + 1])
        return [A, pivots, order]

    # functions

    def _rule(
        self, e: Any, arguments: Sequence[Nodes], name: str, debug_info: Any, values: Any
    ) -> list[Nodes]:
        """Return results whose derivatives follow the rule of the function."""
        known: dict[Any, Nodes] = {
            atom: nodes
            for atom, nodes in zip(e.invars, arguments, strict=True)
            if not isinstance(atom, Literal)
        }
        if not all(np.issubdtype(var.aval.dtype, np.floating) for var in e.outvars):
            raise self.error(e, "with results that are no floats is not covered by the engine")
        info = debug_info._replace(arg_names=("",) * len(known), result_paths=None)
        jaxpr = Jaxpr((), list(known), list(e.outvars), [e], debug_info=info)
        function, shapes = jaxpr_as_fun(ClosedJaxpr(jaxpr, ())), [var.aval for var in known]
        name = f"{name} {[atom.val for atom in e.invars if isinstance(atom, Literal)]}"
        return self.program.apply_rule(name, function, shapes, list(known.values()), values)

    def _do_custom_jvp_call(self, e: Any, *arguments: Nodes) -> list[Nodes]:
        call_jaxpr = e.params["call_jaxpr"]
        info = call_jaxpr.jaxpr.debug_info
        return self._rule(
            e, arguments, str(info.func_src_info), info, lambda: self.closed(call_jaxpr, arguments)
        )

    def _do_custom_linear_solve(self, e: Any, *arguments: Nodes) -> list[Nodes]:
        const_lengths, jaxprs = e.params["const_lengths"], e.params["jaxprs"]
        first = const_lengths.matvec + const_lengths.vecmat
        last = first + const_lengths.solve
        used = [*arguments[first:last], *arguments[last + const_lengths.transpose_solve :]]
        name, info = f"custom_linear_solve {jaxprs.solve.jaxpr}", jaxprs.solve.jaxpr.debug_info
        return self._rule(e, arguments, name, info, lambda: self.closed(jaxprs.solve, used))

    def _do_platform_index(self, e: Any) -> Nodes:
        places = [k for k, each in enumerate(e.params["platforms"]) if each is None or "cpu" in each]
        return self.program.constants(places[0])

    def _do_cond(self, e: Any, index: Nodes, *arguments: Nodes) -> list[Nodes]:
        branches = e.params["branches"]
        last = len(branches) - 1
        return self.by_index(e, [int(index)], [(0, last)], lambda k: self.closed(branches[k], arguments))

    def _do_scan(self, e: Any, *arguments: Nodes) -> list[Nodes]:
        length, reverse = e.params["length"], e.params["reverse"]
        if "ft_in" in e.params:  # JAX 0.11 and later
            num_consts, num_carry, _ = (len([*part]) for part in e.params["ft_in"].unpack())
        else:
            num_consts, num_carry = e.params["num_consts"], e.params["num_carry"]
        if length > LONGEST_SCAN:
            raise self.error(e, f"of {length} turns is too long for the engine", "use fewer turns")
        constants, carry = arguments[:num_consts], list(arguments[num_consts : num_consts + num_carry])
        rows = []
        for k in reversed(range(length)) if reverse else range(length):
            turn = [each[k] for each in arguments[num_consts + num_carry :]]
            found = self.closed(e.params["jaxpr"], [*constants, *carry, *turn])
            carry = found[:num_carry]
            rows.append(found[num_carry:])
        stacked = [np.stack(each) for each in zip(*(rows[::-1] if reverse else rows), strict=True)]
        if not length:
            stacked = [np.empty(var.aval.shape, dtype=np.int64) for var in e.outvars[num_carry:]]
        return [*carry, *stacked]

    def _do_while(self, e: Any, *arguments: Nodes) -> list[Nodes]:
        outer, inner = self.program, Program(self.program.limit)
        cond_nconsts = e.params["cond_nconsts"]
        count = cond_nconsts + e.params["body_nconsts"]
        inputs: dict[int, str] = {}

        def imported(node: int) -> int:
            if outer.is_constant(node):
                return inner.constant(outer.values[node])
            name = inputs.setdefault(node, f"input[{len(inputs)}]")
            return inner.input(name, 1, outer.is_boolean(node))

        fixed = [self.elementwise(imported, each) for each in arguments[:count]]
        state, kinds = list[Nodes](), list[str]()
        for array, var in zip(arguments[count:], e.invars[count:], strict=True):
            boolean = np.issubdtype(var.aval.dtype, np.bool_)
            names = range(len(kinds), len(kinds) + array.size)
            own = [inner.input(f"state[{k}]", 2, boolean) for k in names]
            state.append(np.array(own, dtype=np.int64).reshape(array.shape))
            kinds += ["b" if boolean else "f"] * array.size
        condition = inner.evaluate(e.params["cond_jaxpr"], [*fixed[:cond_nconsts], *state])[0]
        following = inner.evaluate(e.params["body_jaxpr"], [*fixed[cond_nconsts:], *state])

        loop = _WhileLoop(
            inner,
            [(name, node) for node, name in inputs.items()],
            _flat(state),
            _flat(arguments[count:]),
            _flat(following),
            int(condition),
            kinds,
            source_line(self.nested),
        )
        results = iter(outer.loop(loop))
        return [
            np.array([next(results) for _ in range(array.size)], dtype=np.int64).reshape(array.shape)
            for array in state
        ]


def _flat(arrays: Iterable[Nodes]) -> list[int]:
    return [node for array in arrays for node in array.ravel().tolist()]
