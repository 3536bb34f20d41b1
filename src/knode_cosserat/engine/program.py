"""Programs of scalar operations: a jaxpr evaluated on symbols, and its derivatives.

A `Program` is a list of scalar operations in the order of evaluation. An operation is a tuple of a name and
of the numbers (nodes) of its arguments. Constants are folded, equal operations are shared, and operations
without effect are left out. All values are 64-bit floats or booleans; integers are kept as floats.

Algebra treats values as finite: x * 0 and x - x are 0. `x != x` is kept, because it tests for NaN. "max" and
"min" return NaN if an argument is NaN. "hold" returns its argument: derivatives stop there, or follow a rule
of their own. Derivatives at ties (max, min, abs, clamp) are those of JAX.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal, jaxpr_as_fun

from knode_cosserat.errors import KnodeCosseratError

#: largest number of scalar products of one matrix product: larger ones would be long code
LARGEST_PRODUCT = 64 * 64
#: largest number of entries of a table with a variable index, of turns of a scan, and of numbers to sort
LARGEST_TABLE, LONGEST_SCAN, LONGEST_SORT = 256, 1024, 32
#: largest matrix that is factorised with row exchanges that depend on values
PIVOTED = 6

#: an array of nodes
Nodes = np.ndarray
Tangents = dict[int, dict[Any, int]]


class EngineError(KnodeCosseratError, NotImplementedError):
    """The engine cannot run these equations."""

    code = "engine"


@dataclasses.dataclass(frozen=True)
class Loop:
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


@dataclasses.dataclass(frozen=True)
class Rule:
    """Derivative rule of a JAX function: of `jax.custom_jvp`, or of a linear solver."""

    #: identifies the function
    name: str
    function: Callable[..., Any]
    shapes: list[Any]
    arguments: list[Nodes]
    #: "hold" nodes of the results
    results: list[Nodes]
    traced: dict[Any, Any] = dataclasses.field(default_factory=dict)

    def products(self, active: tuple[int, ...], count: int) -> Any:
        """Return the jaxpr of products of the Jacobian with `count` tangents of the active arguments."""

        def along(primals: Any, tangents: Any) -> Any:
            def of_active(*moving: Any) -> Any:
                values = list(primals)
                for place, value in zip(active, moving, strict=True):
                    values[place] = value
                return self.function(*values)

            moving = [primals[place] for place in active]
            return jax.vmap(lambda *each: jax.jvp(of_active, moving, each)[1])(*tangents)

        if (active, count) not in self.traced:
            tangents = [
                jax.ShapeDtypeStruct((count, *self.shapes[k].shape), self.shapes[k].dtype) for k in active
            ]
            self.traced[active, count] = jax.make_jaxpr(along)(self.shapes, tangents)
        return self.traced[active, count]


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
COMMUTATIVE = frozenset({"add", "mul", "max", "min", "and", "or", "eq", "ne"})
COMPARISONS = frozenset({"lt", "le", "gt", "ge", "eq", "ne"})
BOOLEANS = COMPARISONS | {"and", "or", "not", "isfinite"}


class Program:
    """Scalar operations in the order of evaluation, without repetition."""

    def __init__(self) -> None:
        #: ("constant",), ("input", name), ("add", a, b), …, ("loop", k, *arguments), ("result", loop node, k)
        self.operations: list[tuple[Any, ...]] = []
        #: values of constants, None of all others
        self.values: list[Any] = []
        #: 0 of constants, given for inputs, and otherwise the largest of the arguments
        self.levels: list[int] = []
        self.loops: list[Loop] = []
        #: derivative rules of "hold" nodes, by node; a node without a rule has derivative zero
        self.rules: dict[int, Rule] = {}
        self._boolean: list[bool] = []
        self._memo: dict[Any, int] = {}
        #: selects with constants only, such as an index of the smallest entry
        self._choices: set[int] = set()

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

    def inputs(self, name: str, shape: tuple[int, ...], level: int) -> Nodes:
        """Return an array of inputs, named by their flat index: name[0], name[1], …"""
        nodes = [self.input(f"{name}[{k}]", level) for k in range(math.prod(shape))]
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
            found = self._simplified(operation, *arguments)
            if found is None:
                found = self._created(operation, *arguments)
            self._memo[key] = found
        return found

    def _created(self, operation: str, *arguments: int) -> int:
        key, level = (operation, *arguments), max(self.levels[a] for a in arguments)
        last = self._boolean[arguments[-1]]
        node = self._new(key, key, level, operation in BOOLEANS or (last and operation in ("select", "hold")))
        if operation == "select" and all(self.is_constant(a) or a in self._choices for a in arguments[1:]):
            self._choices.add(node)
        return node

    def _simplified(self, operation: str, *arguments: int) -> int | None:
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
        simplify = getattr(self, f"_simple_{operation}", None)
        return None if simplify is None else simplify(*arguments)

    def _spread(self, operation: str, arguments: tuple[int, ...]) -> int | None:
        """Return an operation of constants and one choice of constants: a choice of results."""
        choices = [a for a in arguments if not self.is_constant(a)]
        if len(choices) != 1 or choices[0] not in self._choices or self.is_boolean(choices[0]):
            return None
        _, p, *branches = self.operations[choices[0]]
        results = [
            self.apply(operation, *(each if a == choices[0] else a for a in arguments)) for each in branches
        ]
        return self.apply("select", p, *results)

    def _negated(self, node: int) -> int | None:
        """Return x if the node is -x."""
        name, *arguments = self.operations[node]
        return arguments[0] if name == "neg" else None

    def _simple_add(self, a: int, b: int) -> int | None:
        for x, y in ((a, b), (b, a)):
            if self.is_constant(x, 0.0):
                return y
            negated = self._negated(y)
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
        left, right = self._negated(a), self._negated(b)
        if right is not None:
            return self.apply("add", a, right)
        return None if left is None else self.apply("neg", self.apply("add", left, b))

    def _simple_neg(self, a: int) -> int | None:
        name, *arguments = self.operations[a]
        if name == "sub":
            return self._memo.get(("sub", *arguments[::-1]))
        return self._negated(a)

    def _simple_mul(self, a: int, b: int) -> int | None:
        for x, y in ((a, b), (b, a)):
            value = self.values[x]
            if value == 0.0:
                return x
            if value == 1.0:
                return y
            if value == -1.0:
                return self.apply("neg", y)
            negated = self._negated(y)
            if negated is not None:
                return self.apply("neg", self.apply("mul", x, negated))
            name, *factors = self.operations[y]
            if value is not None and name == "mul":
                for c, rest in (factors, factors[::-1]):
                    if self.is_constant(c):
                        return self.apply("mul", self.apply("mul", x, c), rest)
        return None

    def _simple_div(self, a: int, b: int) -> int | None:
        if self.is_constant(a, 0.0):
            return a
        if self.is_constant(b) and self.values[b] != 0.0:
            return self.apply("mul", a, self.constant(1.0 / self.values[b]))
        negated = self._negated(b)
        if negated is not None:
            return self.apply("neg", self.apply("div", a, negated))
        one = self.constant(1.0)
        return None if a == one else self.apply("mul", a, self.apply("div", one, b))

    def _simple_abs(self, a: int) -> int | None:
        if self.operations[a][0] in ("abs", "sqrt", "exp"):
            return a
        negated = self._negated(a)
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

    def _simple_and(self, a: int, b: int) -> int | None:
        for x, y in ((a, b), (b, a)):
            if self.is_constant(x):
                return y if self.values[x] else x
        return a if a == b else None

    def _simple_or(self, a: int, b: int) -> int | None:
        for x, y in ((a, b), (b, a)):
            if self.is_constant(x):
                return x if self.values[x] else y
        return a if a == b else None

    def _simple_not(self, a: int) -> int | None:
        return self.operations[a][1] if self.operations[a][0] == "not" else None

    def _simple_max(self, a: int, b: int) -> int | None:
        return a if a == b else None

    _simple_min = _simple_max

    def _simple_hold(self, a: int) -> int | None:
        return a if self.operations[a][0] == "hold" and a not in self.rules else None

    def held(self, node: int, rule: Rule) -> int:
        """Return a node of the same value whose derivative follows a rule."""
        while True:
            node = self._created("hold", node)
            known = self.rules.setdefault(node, rule)
            if known is rule or (
                known.name == rule.name
                and all(np.array_equal(a, b) for a, b in zip(known.arguments, rule.arguments, strict=True))
            ):
                return node

    def loop(self, loop: Loop) -> list[int]:
        """Return the nodes of the final state of a loop."""
        arguments = [*(node for _, node in loop.inputs), *loop.initial]
        inner = loop.program
        program = (*zip(inner.operations, map(repr, inner.values), strict=True),)
        nested = tuple(inner._memo[key] for key in inner._memo if key[0] == "loop")
        key = ("loop", program, nested, tuple(loop.next), loop.condition, tuple(arguments))
        if key not in self._memo:
            level = max((self.levels[a] for a in arguments), default=0)
            self._new(key, ("loop", len(self.loops), *arguments), level, False)
            self.loops.append(loop)
        node = self._memo[key]
        results = [("result", node, k) for k in range(len(loop.kinds))]
        return [
            self._new(each, each, self.levels[node], kind == "b")
            for each, kind in zip(results, loop.kinds, strict=True)
        ]

    # queries

    def arguments(self, node: int) -> tuple[int, ...]:
        """Return the nodes that a node depends on directly."""
        name, *rest = self.operations[node]
        if name in ("constant", "input"):
            return ()
        if name == "loop":
            return tuple(rest[1:])
        return (rest[0],) if name == "result" else tuple(rest)

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

    def is_boolean(self, node: int) -> bool:
        """Return True if the value of a node is a boolean."""
        return self._boolean[node]

    def is_constant(self, node: int, value: Any = None) -> bool:
        """Return True if a node is a constant; with a value, if it is this one."""
        own = self.values[node]
        return own is not None and (value is None or (own == value and isinstance(own, type(value))))

    # derivatives

    def derivative(self, outputs: Sequence[int], tangents: Mapping[int, int]) -> list[int]:
        """Return the tangents of the outputs from those of independent nodes: a product J·v."""
        found = self._forward(outputs, {int(node): {0: int(tangent)} for node, tangent in tangents.items()})
        zero = self.constant(0.0)
        return [found.get(int(node), {}).get(0, zero) for node in outputs]

    def jacobian(self, outputs: Sequence[int], variables: Sequence[int]) -> Nodes:
        """Return the derivatives (outputs, variables); structural zeros are the constant 0."""
        one, zero = self.constant(1.0), self.constant(0.0)
        found = self._forward(outputs, {int(node): {k: one} for k, node in enumerate(variables)})
        rows = [found.get(int(node), {}) for node in outputs]
        entries = [[row.get(k, zero) for k in range(len(variables))] for row in rows]
        return np.array(entries, dtype=np.int64).reshape(len(rows), len(variables))

    def _forward(self, outputs: Sequence[int], seeds: Tangents) -> Tangents:
        """Return tangents of the nodes needed, by variable; zero ones are left out."""

        def sources(node: int) -> Iterable[int]:
            if node in seeds:
                return ()
            if self.operations[node][0] != "hold":
                return self.arguments(node)
            rule = self.rules.get(node)
            return () if rule is None else np.concatenate([a.ravel() for a in rule.arguments]).tolist()

        found = {node: self._nonzero(each) for node, each in seeds.items()}
        for node in self._order(outputs, sources):
            if node in found:
                continue
            name = self.operations[node][0]
            if name == "select":
                found[node] = self._selected(node, found)
            elif name in PARTIALS:
                found[node] = self._chained(node, found)
            elif node in self.rules:
                self._by_rule(self.rules[node], found)
            elif name == "loop" and any(found.get(a) for a in self.arguments(node)):
                source = self.loops[self.operations[node][1]].source
                raise EngineError(
                    f"{source}: a while loop is differentiated; state its derivative by jax.custom_jvp, or "
                    "stop the gradient of its inputs and add one Newton correction after it"
                )
        return found

    def _nonzero(self, tangents: dict[Any, int]) -> dict[Any, int]:
        return {key: node for key, node in tangents.items() if not self.is_constant(node, 0.0)}

    def _selected(self, node: int, found: Tangents) -> dict[Any, int]:
        _, p, *branches = self.operations[node]
        no, yes = (found.get(branch, {}) for branch in branches)
        zero = self.constant(0.0)
        return {k: self.apply("select", p, no.get(k, zero), yes.get(k, zero)) for k in {**no, **yes}}

    def _chained(self, node: int, found: Tangents) -> dict[Any, int]:
        name, *arguments = self.operations[node]
        partials: dict[int, int] = {}
        for argument, partial in zip(arguments, PARTIALS[name], strict=True):
            if found.get(argument):
                own = partial(self.apply, self.constant, node, *arguments)
                partials[argument] = (
                    self.apply("add", partials[argument], own) if argument in partials else own
                )
        total: dict[Any, int] = {}
        for argument, partial in partials.items():
            for key, tangent in found[argument].items():
                term = self.apply("mul", partial, tangent)
                total[key] = self.apply("add", total[key], term) if key in total else term
        return self._nonzero(total)

    def _by_rule(self, rule: Rule, found: Tangents) -> None:
        """Add the tangents of all results of a rule."""
        moving = [[found.get(node, {}) for node in nodes.ravel().tolist()] for nodes in rule.arguments]
        active = tuple(k for k, each in enumerate(moving) if any(each))
        keys = list(dict.fromkeys(key for each in moving for one in each for key in one))
        if keys:
            zero = self.constant(0.0)
            tangents = [
                np.array([[one.get(key, zero) for one in moving[k]] for key in keys], dtype=np.int64).reshape(
                    len(keys), *rule.shapes[k].shape
                )
                for k in active
            ]
            columns = self.evaluate(rule.products(active, len(keys)), [*rule.arguments, *tangents])
        for k, nodes in enumerate(rule.results):
            for place in np.ndindex(nodes.shape):
                own = {key: int(columns[k][(i, *place)]) for i, key in enumerate(keys)}
                found[int(nodes[place])] = self._nonzero(own)

    # jaxprs

    def evaluate(self, closed_jaxpr: Any, arguments: Sequence[Nodes]) -> list[Nodes]:
        """Return the results of a jaxpr for arrays of nodes."""
        return Evaluation(self).closed(closed_jaxpr, arguments)


#: partial derivatives by each argument, from (apply, constant, own node, *arguments); without: zero
PARTIALS: dict[str, tuple[Callable[..., int], ...]] = {
    "add": (lambda f, c, r, a, b: c(1.0), lambda f, c, r, a, b: c(1.0)),
    "sub": (lambda f, c, r, a, b: c(1.0), lambda f, c, r, a, b: c(-1.0)),
    "mul": (lambda f, c, r, a, b: b, lambda f, c, r, a, b: a),
    "div": (
        lambda f, c, r, a, b: f("div", c(1.0), b),
        lambda f, c, r, a, b: f("neg", f("mul", r, f("div", c(1.0), b))),
    ),
    "neg": (lambda f, c, r, a: c(-1.0),),
    "abs": (lambda f, c, r, a: f("sign", a),),
    "sqrt": (lambda f, c, r, a: f("div", c(0.5), r),),
    "exp": (lambda f, c, r, a: r,),
    "log": (lambda f, c, r, a: f("div", c(1.0), a),),
    "log1p": (lambda f, c, r, a: f("div", c(1.0), f("add", c(1.0), a)),),
    "expm1": (lambda f, c, r, a: f("add", c(1.0), r),),
    "sin": (lambda f, c, r, a: f("cos", a),),
    "cos": (lambda f, c, r, a: f("neg", f("sin", a)),),
    "tan": (lambda f, c, r, a: f("add", c(1.0), f("mul", r, r)),),
    "tanh": (lambda f, c, r, a: f("sub", c(1.0), f("mul", r, r)),),
    "atan2": (
        lambda f, c, r, a, b: f("div", b, f("add", f("mul", a, a), f("mul", b, b))),
        lambda f, c, r, a, b: f("neg", f("div", a, f("add", f("mul", a, a), f("mul", b, b)))),
    ),
    "asin": (lambda f, c, r, a: f("div", c(1.0), f("sqrt", f("sub", c(1.0), f("mul", a, a)))),),
    "acos": (lambda f, c, r, a: f("div", c(-1.0), f("sqrt", f("sub", c(1.0), f("mul", a, a)))),),
    "atan": (lambda f, c, r, a: f("div", c(1.0), f("add", c(1.0), f("mul", a, a))),),
    "pow": (
        lambda f, c, r, a, b: f("mul", b, f("pow", a, f("sub", b, c(1.0)))),
        lambda f, c, r, a, b: f("mul", f("log", f("select", f("eq", a, c(0.0)), a, c(1.0))), r),
    ),
    "max": (
        lambda f, c, r, a, b: _share(f, c, "gt", a, b),
        lambda f, c, r, a, b: f("sub", c(1.0), _share(f, c, "gt", a, b)),
    ),
    "min": (
        lambda f, c, r, a, b: _share(f, c, "lt", a, b),
        lambda f, c, r, a, b: f("sub", c(1.0), _share(f, c, "lt", a, b)),
    ),
    "rem": (lambda f, c, r, a, b: c(1.0), lambda f, c, r, a, b: f("div", f("sub", r, a), b)),
    "erf": (
        lambda f, c, r, a: f(
            "mul", c(2.0 / math.sqrt(math.pi)), f("exp", f("neg", f("mul", a, a)))
        ),
    ),
    "logistic": (lambda f, c, r, a: f("mul", r, f("sub", c(1.0), r)),),
}  # fmt: skip


def _share(apply: Any, constant: Any, comparison: str, a: int, b: int) -> int:
    """Return the derivative of max or min by the first argument: a half at ties."""
    tied = apply("select", apply("eq", a, b), constant(0.0), constant(0.5))
    return apply("select", apply(comparison, a, b), tied, constant(1.0))
