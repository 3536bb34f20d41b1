"""The time loop of a rod as machine code: history, Newton's method, elimination, error estimate.

The equations at a point come from the system as a program (`Equations`). This module adds the mathematics of
`solvers`: the box scheme along the rod, corrections damped by the natural monotonicity test with factors that
are kept, elimination with a change of parameters after every few pieces, and the corrected motion whose
distance is the estimated discretisation error.

A lane of a vector is a robot of a batch. For a single robot it is a place along the rod; in the recursion
along the rod it is a column of the matrix that is eliminated. The code is the same: arrays know their layout
(`Array`), and values are `wide` where all places are independent, else `plain`.
"""

from __future__ import annotations

import contextlib
import ctypes
import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from knode_cosserat.engine.codegen import Function, Index, Module, Value, Variable
from knode_cosserat.engine.program import EngineError, Program
from knode_cosserat.rods.system import System, unknown_count
from knode_cosserat.solvers import semi_discrete
from knode_cosserat.solvers.boundary import LARGEST_CORRECTION, pivots_of
from knode_cosserat.solvers.grid import grid_of
from knode_cosserat.solvers.history import EXTRAPOLATIONS, StateHistory
from knode_cosserat.solvers.linear import _each
from knode_cosserat.solvers.problem import StepProblem
from knode_cosserat.solvers.result import Result
from knode_cosserat.solvers.settings import Settings
from knode_cosserat.solvers.space import LOBATTO2
from knode_cosserat.solvers.time import SDIRK2
from knode_cosserat.solvers.time_loop import (
    COARSE_ANGLE,
    COARSE_SHARE,
    ESTIMATE_TOLERANCE,
    ESTIMATE_TURNS,
    ROUNDING,
    StepCoefficients,
    StepRows,
    stage_extrapolations,
)

#: numbers of a solved stage, for each robot
USABLE, ERROR, CORRECTIONS, LINEARISATIONS, POSITION, ANGLE, TIME, ALIVE = range(8)
#: levels of inputs: parameters (once a run), step, place, state
RUN, STEP, PLACE, STATE = 1, 2, 3, 4


class Equations:
    """Programs of a system: rates and strains at a point with their derivatives, base and tip."""

    def __init__(self, system: System):
        self.system = system
        leaves, tree = jax.tree.flatten(system)
        leaves = [np.asarray(leaf, dtype=float) for leaf in leaves]
        self.ny, self.nz = system.y_layout.size, system.z_layout.size
        self.nc, self.k = system.control_size, unknown_count(system)
        self.numbers = self.ny + self.nz
        program = self.program = Program()
        self.parameters = [program.inputs(f"p{i}", leaf.shape, RUN) for i, leaf in enumerate(leaves)]
        #: the place of each parameter's node in the vector of parameters
        self.parameter_values = np.concatenate([leaf.reshape(-1) for leaf in leaves])
        # parameters that are zero are constants: fewer operations
        folded = [
            np.where(leaf == 0.0, program.constant(0.0), nodes)
            for leaf, nodes in zip(leaves, self.parameters, strict=True)
        ]
        self.c0, self.t = program.inputs("c0", (), STEP), program.inputs("t", (), STEP)
        self.control = program.inputs("control", (self.nc,), STEP)
        self.s = program.inputs("s", (), PLACE)
        self.y = program.inputs("y", (self.ny,), STATE)
        self.history = program.inputs("history", (self.numbers,), STATE)
        self.unknowns = program.inputs("unknowns", (self.k,), STATE)

        def problem(leaves: Any, c0: Any, t: Any, control: Any, record: Any) -> StepProblem:
            own = jax.tree.unflatten(tree, leaves)
            return StepProblem(own, t, control, c0, record[None], LOBATTO2)

        def rates(leaves: Any, c0: Any, t: Any, control: Any, s: Any, y: Any, record: Any) -> Any:
            return problem(leaves, c0, t, control, record).point_rates(s, y, record)

        def base(leaves: Any, c0: Any, t: Any, control: Any, unknowns: Any, record: Any) -> Any:
            return problem(leaves, c0, t, control, record).base(unknowns)

        def tip(leaves: Any, c0: Any, t: Any, control: Any, y: Any, record: Any) -> Any:
            own = jax.tree.unflatten(tree, leaves)
            return semi_discrete.tip(own, t, control, y, semi_discrete.unpacked_history(own, c0, record))

        def jump(leaves: Any, c0: Any, t: Any, control: Any, acting: Any, y: Any, record: Any) -> Any:
            return problem(leaves, c0, t, control, record).jump(acting, y, record)

        def geometry(leaves: Any) -> Any:
            own = jax.tree.unflatten(tree, leaves)
            still, scales = StepProblem.still(own, LOBATTO2, np.zeros(self.nc)), own.scales()
            length = jnp.asarray(own.length)[None]
            return 1.0 / scales.y, 1.0 / scales.tip, still.places, still.lengths()[:, 0], length

        one, step = np.zeros(()), (1.0, 0.0, np.zeros(self.nc))
        # of the parameters alone: inverse scales, places and lengths of pieces
        self.geometry = [
            np.broadcast_to(nodes, size)
            for nodes, size in zip(
                program.evaluate(jax.make_jaxpr(geometry)(leaves), folded),
                (self.ny, self.k, grid_of(system, LOBATTO2).count, grid_of(system, LOBATTO2).tip, 1),
                strict=True,
            )
        ]
        known = [*folded, self.c0, self.t, self.control]
        traced = jax.make_jaxpr(rates)(leaves, *step, one, np.ones(self.ny), np.zeros(self.numbers))
        self.f, self.z = program.evaluate(traced, [*known, self.s, self.y, self.history])
        traced = jax.make_jaxpr(base)(leaves, *step, np.zeros(self.k), np.zeros(self.numbers))
        [self.base] = program.evaluate(traced, [*known, self.unknowns, self.history])
        traced = jax.make_jaxpr(tip)(leaves, *step, np.ones(self.ny), np.zeros(self.numbers))
        [self.tip] = program.evaluate(traced, [*known, self.y, self.history])
        #: y on the far side of the discontinuities that act, and the nonzeros of its derivative, less 1
        self.acting, self.far, self.jumping = program.inputs("acting", (len(system.cuts),), STATE), self.y, []
        if system.jumps:
            shapes = np.zeros(len(system.cuts)), np.ones(self.ny), np.zeros(self.numbers)
            traced = jax.make_jaxpr(jump)(leaves, *step, *shapes)
            [self.far] = program.evaluate(traced, [*known, self.acting, self.y, self.history])
            slopes = program.jacobian(self.far, self.y)
            for i, j in np.ndindex(slopes.shape):
                if i == j:
                    slopes[i, i] = program.apply("sub", int(slopes[i, i]), program.constant(1.0))
                if not program.is_constant(int(slopes[i, j]), 0.0):
                    self.jumping.append((i, j, int(slopes[i, j])))
        self.slopes = program.jacobian(self.f, self.y)
        self.base_slopes = program.jacobian(self.base, self.unknowns)
        self.tip_slopes = program.jacobian(self.tip, self.y)
        #: structural nonzeros of the Jacobian
        self.pattern = [
            (i, j)
            for i, j in np.ndindex(self.slopes.shape)
            if not program.is_constant(int(self.slopes[i, j]), 0.0)
        ]
        needed = set(program.needed([*self.f, *self.z, *self.far, *self.base, *self.tip]))
        #: entries of a record that the equations need as history
        self.used_history = [i for i in range(self.numbers) if int(self.history[i]) in needed]
        outputs = [*self.f, *self.z, *self.slopes.reshape(-1), *self.base, *self.tip]
        outputs += [*self.base_slopes.reshape(-1), *self.tip_slopes.reshape(-1)]
        outputs += [*self.far, *(node for *_, node in self.jumping)]
        #: tangents of y and of the history, and the products of derivatives with them
        self.dy = program.inputs("dy", (self.ny,), STATE)
        self.dhistory = program.inputs("dhistory", (self.numbers,), STATE)
        directions = dict(zip([*self.y, *self.history], [*self.dy, *self.dhistory], strict=True))
        self.products = {
            name: program.derivative([int(node) for node in nodes], directions)
            for name, nodes in (
                ("rates", [*self.f, *self.z]), ("far", self.far), ("tip", self.tip), ("base", self.base)
            )
        }  # fmt: skip
        for nodes in self.products.values():
            outputs += nodes
        self.step_terms = self._hoisted(outputs, {STEP, RUN})
        self.place_terms = self._hoisted(outputs, {PLACE})

    def _hoisted(self, outputs: Sequence[int] | np.ndarray, levels: set[int]) -> list[int]:
        """Return the operations of these levels that operations of higher levels need."""
        program, found = self.program, set()
        for node in program.needed(outputs):
            if program.levels[node] > max(levels):
                found |= {each for each in program.arguments(node) if program.levels[each] in levels}
        found |= {int(node) for node in outputs if program.levels[int(node)] in levels}
        todo = [node for node in found if program.is_boolean(node)]
        while todo:  # truths are evaluated where they are used
            node = todo.pop()
            found.discard(node)
            for each in program.arguments(node):
                if program.levels[each] in levels and each not in found:
                    todo.append(each) if program.is_boolean(each) else found.add(each)
        return sorted(found)


class Elimination:
    """Program of a piece: factors of B = 1 - h/2 J at its end; B⁻¹ (A x + r), A = 1 + h/2 J at its start."""

    def __init__(self, equations: Equations):
        program = self.program = Program()
        n, pattern = equations.ny, equations.pattern
        zero, one = program.constant(0.0), program.constant(1.0)
        self.h = program.input("h", 1)
        half = program.apply("mul", self.h, program.constant(0.5))
        self.start = program.inputs("start", (len(pattern),), 1)
        self.end = program.inputs("end", (len(pattern),), 1)
        A, B = np.full((n, n), zero), np.full((n, n), zero)
        for k, (i, j) in enumerate(pattern):
            A[i, j] = program.apply("mul", half, int(self.start[k]))
            B[i, j] = program.apply("neg", program.apply("mul", half, int(self.end[k])))
        for i in range(n):
            B[i, i] = program.apply("add", one, int(B[i, i]))
        self._order = order = _least_fill(pattern, n)
        for at, p in enumerate(order):
            B[p, p] = program.apply("div", one, int(B[p, p]))
            for i in order[at + 1 :]:
                if B[i, p] == zero:
                    continue
                B[i, p] = program.apply("mul", int(B[i, p]), int(B[p, p]))
                for j in order[at + 1 :]:
                    product = program.apply("mul", int(B[i, p]), int(B[p, j]))
                    B[i, j] = program.apply("sub", int(B[i, j]), product)
        #: factors that are not constant
        self.places = [(i, j) for i, j in np.ndindex(B.shape) if not program.is_constant(int(B[i, j]))]
        self.factors = [int(B[i, j]) for i, j in self.places]
        stored = program.inputs("factor", (len(self.places),), 1)
        self.stored = stored
        LU = B.copy()
        for node, (i, j) in zip(stored, self.places, strict=True):
            LU[i, j] = node
        self.x, self.r = program.inputs("x", (n,), 1), program.inputs("r", (n,), 1)
        self.jump = program.inputs("jump", (len(equations.jumping),), 1)
        #: x on the far side of the discontinuities at the start
        self._far = [int(each) for each in self.x]
        for node, (i, j, _) in zip(self.jump, equations.jumping, strict=True):
            self._far[i] = program.apply("add", self._far[i], program.apply("mul", int(node), int(self.x[j])))
        self.advanced = [self._solved(A, LU, added) for added in ([int(each) for each in self.r], [zero] * n)]

    def _solved(self, A: Any, LU: Any, r: list[int]) -> list[int]:
        apply = self.program.apply
        x = self._far
        out = [apply("add", a, b) for a, b in zip(x, r, strict=True)]
        for i, j in np.ndindex(A.shape):
            out[i] = apply("add", out[i], apply("mul", int(A[i, j]), x[j]))
        for at, i in enumerate(self._order):
            for j in self._order[:at]:
                out[i] = apply("sub", out[i], apply("mul", int(LU[i, j]), out[j]))
        for at, i in reversed(list(enumerate(self._order))):
            for j in self._order[at + 1 :]:
                out[i] = apply("sub", out[i], apply("mul", int(LU[i, j]), out[j]))
            out[i] = apply("mul", out[i], int(LU[i, i]))
        return out


def _least_fill(pattern: Sequence[tuple[int, int]], n: int) -> list[int]:
    """Return an order of pivots on the diagonal with little fill-in (Markowitz 1957)."""
    nonzero = np.eye(n, dtype=bool)
    for i, j in pattern:
        nonzero[i, j] = True
    rest, order = list(range(n)), []
    while rest:
        counts = [(nonzero[rest, k].sum() - 1) * (nonzero[k, rest].sum() - 1) for k in rest]
        best = rest[int(np.argmin(counts))]
        for i in rest:
            if i != best and nonzero[i, best]:
                nonzero[i] |= nonzero[best]
        order.append(best)
        rest.remove(best)
    return order


@dataclasses.dataclass(frozen=True)
class Array:
    """Numbers of `size` components at `count` places, in the memory of a run."""

    offset: int
    size: int
    count: int
    #: distance between components and between places, in doubles
    component: int
    place: int

    def at(self, i: int, j: int) -> int:
        """Return the offset of component i at place j."""
        return self.offset + j * self.place + i * self.component


class Core:
    """Machine code of a system's time loop."""

    def __init__(self, system: System, settings: Settings, robots: bool, lanes: int = 8):
        if system.strands > 1 or system.mixed or settings.space != LOBATTO2 or settings.time is None:
            raise EngineError("engine: one rod, a balance with B = 0, motions, lobatto2; use simulate")
        self.settings, self.scheme, self.newton = settings, settings.time, settings.newton
        self.equations, self.batch, self.L = Equations(system), robots, lanes
        moving = [node for node in self.equations.products["base"] if not self._is_zero(node)]
        if moving and isinstance(self.scheme, SDIRK2):
            raise EngineError("engine: a base that depends on rates needs a scheme of one stage")
        self.elimination = Elimination(self.equations)
        self.grid = grid_of(system, LOBATTO2)
        self.pivots = [int(each) for each in pivots_of(system)]
        self.P = lanes if robots else 1
        self._size = 0
        e, grid = self.equations, self.grid
        self.pieces, self.points, self.ends, self.count = grid.tip, grid.tip + 1, grid.ends, grid.count
        self.stride = (-(-(grid.count + 1) // lanes) + 1) * lanes
        ny, nz, k = e.ny, e.nz, e.k
        a = self._array
        self.params, self.scale_y, self.scale_tip = a(len(e.parameter_values), 1), a(ny, 1), a(k, 1)
        self.inputs, self.steps_terms, self.t0 = a(2 + e.nc, 1), a(len(e.step_terms), 1), a(1, 1)
        self.s, self.h, self.length = a(1, self.count), a(1, self.pieces), a(1, 1)
        self.geometry = self.scale_y, self.scale_tip, self.s, self.h, self.length
        self.place_terms = a(len(e.place_terms), self.count)
        self.y, self.trial, self.better = (a(ny, self.ends) for _ in range(3))
        self.direction, self.dy = a(ny, self.ends), a(ny, self.ends)
        self.f, self.z, self.fe = a(ny, self.count), a(nz, self.count), a(ny, self.pieces)
        self.slope, self.slope_end = a(len(e.pattern), self.ends), a(len(e.pattern), self.pieces)
        self.factor = a(len(self.elimination.factors), self.pieces)
        self.r, self.defect = a(ny, self.pieces), a(ny, self.pieces)
        self.acting, self.jump = a(len(system.cuts), self.pieces), a(len(e.jumping), self.pieces)
        #: y at the places of the ends; with jumps it differs from y at the points
        self.far = a(ny, self.ends) if system.jumps else None
        self.w, self.X = a(ny, self.points), a(ny * k, self.points)
        groups = -(-self.pieces // _each(self.pieces))
        self.T, self.inverse = a(k * k, groups), a(k * k, 1)
        self.beta, self.alpha = a(k, groups), a(k, self.points)
        self.unknowns, self.step_unknowns, self.trial_unknowns = a(k, 1), a(k, 1), a(k, 1)
        self.S, self.M = a(ny * k, 1), a(ny * k, 1)
        self.tip, self.tip_defect = a(k, 1), a(k, 1)
        self.records = [a(ny + nz, self.count) for _ in range(2)]
        self.errors = [a(ny + nz, self.ends) for _ in range(2)]
        self.time_errors = [a(ny + nz, self.ends) for _ in range(2)]
        self.rate, self.error_rate = a(ny + nz, self.count), a(ny + nz, self.ends)
        self.H, self.dH, self.own_dH = a(ny + nz, self.count), a(ny + nz, self.ends), a(ny + nz, self.ends)
        self.move, self.dfar, self.df = a(ny + nz, self.ends), a(ny, self.ends), a(ny, self.ends)
        self.dz, self.dfe, self.own_defect = a(nz, self.ends), a(ny, self.pieces), a(ny, self.pieces)
        self.difference, self.sum = a(ny + nz, self.ends), a(ny + nz, self.ends)
        self.past = [a(ny, self.ends) for _ in range(3)]
        self.weights = a(3, 1)
        self.columns = [self._columns(ny * k) for _ in range(2)]
        self.module = Module()
        self._write()
        self.compiled = self.module.compile()

    def _is_zero(self, node: int) -> bool:
        return self.equations.program.is_constant(int(node), 0.0)

    # memory

    def _array(self, size: int, count: int) -> Array:
        """Reserve an array: robots in lanes, or places in lanes."""
        place, component = (size * self.L, self.L) if self.batch else (1, 1 if count == 1 else self.stride)
        found = Array(self._size, size, count, component, place)
        length = size * count * self.L if self.batch else size * (1 if count == 1 else self.stride)
        self._size += -(-length // self.L) * self.L
        return found

    def _columns(self, size: int) -> Array:
        """Reserve a matrix whose columns are in lanes (one robot), or follow each other (robots in lanes)."""
        found = Array(self._size, size, 1, self.L, 0)
        self._size += size * self.L
        return found

    # writing functions

    def _function(self, name: str, *arguments: str) -> Function:
        f = self.module.function(name, ["memory", *arguments])
        self._now = f
        return f

    def _at(self, array: Array, i: int, j: int | Index) -> tuple[Value, int]:
        """Return an address and an offset from it."""
        memory = self._now.arguments[0]
        if isinstance(j, int):
            return memory, array.at(i, j)
        return j.address(memory, array.place), array.at(i, j.delta)

    def _pointer(self, array: Array, j: int | Index) -> Value:
        """Return the address of component 0 at a place."""
        return self._now.pointer(*self._at(array, 0, j))

    def _get(self, array: Array, i: int, j: int | Index = 0, lanes: int = 0) -> Value:
        return self._now.load(*self._at(array, i, j), lanes or self.P)

    def _put(self, value: Any, array: Array, i: int, j: int | Index = 0, lanes: int = 0) -> None:
        self._now.store(value, *self._at(array, i, j), lanes or self.P)

    def _wide(self, array: Array, i: Any, j: Any = 0) -> Value:
        # a number that is the same at all places
        lanes = self.L if self.batch or array.count > 1 else 1
        return self._get(array, i, j, lanes)

    def _write_wide(self, value: Any, array: Array, i: Any, j: Any) -> None:
        self._put(value, array, i, j, self.L)

    @contextlib.contextmanager
    def _places(self, count: int, first: int = 0) -> Iterator[Index]:
        """Write a loop over places, all independent: one by one, or as many as there are lanes.

        The last lanes of a single robot may lie beyond the last place. They hold numbers that nobody reads.
        """
        with self._now.loop(first + count, first, 1 if self.batch else self.L) as j:
            yield j

    def _inside(self, j: Index, end: int) -> Any:
        """Return true for the lanes before a place."""
        if self.batch:
            return True
        f = self._now
        numbers = f.joined([f.value(float(k)) for k in range(self.L)])
        here = f.result(f"sitofp i64 {j.value.name} to double")
        return numbers + here < float(end)

    def _largest(self, value: Value) -> Value:
        """Return the largest of a wide value for each robot."""
        return value if self.batch else self._now.largest(value)

    # the equations

    def _known(self, j: Any, wide: bool, state: dict[int, Value]) -> dict[int, Value]:
        """Return the values of hoisted terms at a place."""
        e = self.equations
        nodes = e.program.needed(self._outputs, frozenset(state))
        needed = set(nodes) | {each for node in nodes for each in e.program.arguments(node)}
        values = dict(state)
        for k, node in enumerate(e.step_terms):
            if node in needed:
                values[node] = self._wide(self.steps_terms, k) if wide else self._get(self.steps_terms, k)
        for k, node in enumerate(e.place_terms):
            if node in needed:
                values[node] = self._wide(self.place_terms, k, j)
        return values

    def _evaluated(
        self, outputs: Sequence[int] | np.ndarray, j: Any, wide: bool, state: dict[int, Value]
    ) -> list[Value]:
        """Write the operations of outputs at a place."""
        self._outputs = [int(each) for each in outputs]
        lanes = self.L if wide else self.P
        known = self._known(j, wide, state)
        values = self._now.evaluate(self.equations.program, self._outputs, known, lanes)
        return [values[node] for node in self._outputs]

    def _write_setup(self) -> None:
        """Scales, places and lengths of pieces: once a run."""
        e = self.equations
        self.setup = f = self._function("setup")
        outputs = [int(node) for nodes in e.geometry for node in nodes]
        values = f.evaluate(e.program, outputs, self._parameters(), self.P)
        for array, nodes in zip(self.geometry, e.geometry, strict=True):
            for k, node in enumerate(nodes):
                i, j = (0, k) if array.size == 1 else (k, 0)
                self._put(values[int(node)], array, i, j)
            if array.count > 1 and not self.batch:
                # the lanes beyond the last place
                for k in range(array.count, self.stride):
                    self._put(values[int(nodes[-1])], array, 0, k)

    def _parameters(self) -> dict[int, Value]:
        nodes = np.concatenate([nodes.reshape(-1) for nodes in self.equations.parameters])
        return {int(node): self._get(self.params, k) for k, node in enumerate(nodes)}

    def _write_terms(self) -> None:
        """Terms that depend on neither y nor the history: once a step."""
        e = self.equations
        self.terms = f = self._function("terms")
        state = self._parameters()
        for k, node in enumerate([e.c0.item(), e.t.item(), *e.control]):
            state[int(node)] = self._get(self.inputs, k)
        values = f.evaluate(e.program, e.step_terms, state, self.P)
        for k, node in enumerate(e.step_terms):
            self._put(values[node], self.steps_terms, k)
        if not e.place_terms:
            return
        known = {node: values[node] for node in e.step_terms} | state
        with self._places(self.count) as j:
            here = known | {e.s.item(): self._wide(self.s, 0, j)}
            values = f.evaluate(e.program, e.place_terms, here, self.L)
            for k, node in enumerate(e.place_terms):
                self._write_wide(values[node], self.place_terms, k, j)

    def _write_rates(self, name: str, slopes: bool) -> Function:
        """A function of the addresses of y and history, and a place: rates and strains, and their slopes."""
        e = self.equations
        f = self._function(name, "y", "history", "n_place")
        _, y, history, place = f.arguments
        j = f.index(place)
        component = self.f.component
        state = {int(node): f.load(y, i * component, self.L) for i, node in enumerate(e.y)}
        for i in e.used_history:
            state[int(e.history[i])] = f.load(history, i * component, self.L)
        outputs = [*e.f, *e.z, *([e.slopes[at] for at in e.pattern] if slopes else [])]
        found = self._evaluated(outputs, j, True, state)
        for i in range(e.ny):
            self._write_wide(found[i], self.f, i, j)
        for i in range(e.nz):
            self._write_wide(found[e.ny + i], self.z, i, j)
        for i in range(len(e.pattern) if slopes else 0):
            self._write_wide(found[e.ny + e.nz + i], self.slope, i, j)
        return f

    def _rates_at(
        self, function: Function, y: Array, history: Array, j: Index, place: Index | None = None
    ) -> None:
        """Write a call of a function of rates; `place` if y is not stored by place."""
        place = j if place is None else place
        f = self._now
        f.call(function, f.arguments[0], self._pointer(y, j), self._pointer(history, place), place.value)

    def _write_far(self, y: Array, history: Array, slopes: bool = False) -> Array:
        """Write y at all ends of pieces: after jumps at their starts, before jumps at their ends."""
        e = self.equations
        far = y if self.far is None else self.far
        if self.far is not None:
            with self._places(self.points) as j:
                for i in range(e.ny):
                    self._write_wide(self._wide(y, i, j), far, i, j)
            with self._places(self.pieces) as j:
                state = {int(node): self._wide(y, i, j) for i, node in enumerate(e.y)}
                state |= {int(e.history[i]): self._wide(history, i, j) for i in e.used_history}
                state |= {int(node): self._wide(self.acting, i, j) for i, node in enumerate(e.acting)}
                outputs = [*e.far, *(node for *_, node in e.jumping if slopes)]
                found = self._evaluated(outputs, j, True, state)
                for k, value in enumerate(found):
                    array, i = (far, k) if k < e.ny else (self.jump, k - e.ny)
                    self._write_wide(value, array, i, j)
        for k, point in enumerate(self.grid.near):
            for i in range(e.ny):
                self._put(self._get(y, i, int(point)), far, i, self.points + k)
        return far

    def _write_ends(self, source: Array, target: Array) -> None:
        """Copy values at places to the ends of pieces."""
        with self._places(self.pieces) as j:
            for i in range(source.size):
                self._write_wide(self._wide(source, i, j + 1), target, i, j)
        for k, point in enumerate(self.grid.near):
            for i in range(source.size):
                self._put(self._get(source, i, self.points + k), target, i, int(point) - 1)

    def _write_residual(self, name: str, y: Array, history: Array) -> Function:
        """Rates at all ends of pieces by y, and the defects of all pieces and of the tip."""
        f = self._function(name)
        far = self._write_far(y, history)
        with self._places(self.ends) as j:
            self._rates_at(self.rates, far, history, j)
        self._write_defects(y, history)
        return f

    def _write_defects(self, y: Array, history: Array) -> None:
        e, far = self.equations, y if self.far is None else self.far
        self._write_ends(self.f, self.fe)
        with self._places(self.pieces) as j:
            half = self._wide(self.h, 0, j) * 0.5
            for i in range(e.ny):
                rates = self._wide(self.f, i, j) + self._wide(self.fe, i, j)
                change = self._wide(far, i, j) - self._wide(y, i, j + 1)
                self._write_wide(change + half * rates, self.r, i, j)
        at_tip = self._tip_state(y, history)
        for i, value in enumerate(self._evaluated(e.tip, 0, False, at_tip)):
            self._put(value, self.tip, i)

    def _tip_state(self, y: Array, history: Array) -> dict[int, Value]:
        e, tip = self.equations, self.points - 1
        state = {int(node): self._get(y, i, tip) for i, node in enumerate(e.y)}
        return state | {int(e.history[i]): self._get(history, i, tip) for i in e.used_history}

    def _base_state(self, unknowns: Array, history: Array) -> dict[int, Value]:
        e = self.equations
        state = {int(node): self._get(unknowns, i) for i, node in enumerate(e.unknowns)}
        return state | {int(e.history[i]): self._get(history, i, 0) for i in e.used_history}

    # elimination along the rod

    def _write_factor(self) -> None:
        """Factors of all pieces, from the slopes at their ends."""
        f, el = self._function("factored"), self.elimination
        self.factored = f
        with self._places(self.pieces) as j:
            known = {int(node): self._wide(self.slope_end, k, j) for k, node in enumerate(el.end)}
            known[el.h] = self._wide(self.h, 0, j)
            values = f.evaluate(el.program, el.factors, known, self.L)
            for k, node in enumerate(el.factors):
                self._write_wide(values[node], self.factor, k, j)

    def _write_advance(self, name: str, columns: bool) -> Function:
        """A piece's B⁻¹ (A x + r), of one vector, or of the columns of a matrix without r."""
        el = self.elimination
        f = self._function(name, "from", "to", "n_piece")
        _, source, target, piece = f.arguments
        j = f.index(piece)
        lanes = self.L if columns else self.P
        step = self.L if self.batch or columns else self.w.component
        known = {int(node): self._get(self.slope, k, j) for k, node in enumerate(el.start)}
        known |= {int(node): self._get(self.factor, k, j) for k, node in enumerate(el.stored)}
        known |= {int(node): self._get(self.jump, k, j) for k, node in enumerate(el.jump)}
        known[el.h] = self._get(self.h, 0, j)
        known |= {int(node): f.load(source, i * step, lanes) for i, node in enumerate(el.x)}
        if not columns:
            known |= {int(node): self._get(self.r, i, j) for i, node in enumerate(el.r)}
        outputs = el.advanced[1 if columns else 0]
        values = f.evaluate(el.program, outputs, known, lanes)
        for i, node in enumerate(outputs):
            f.store(values[node], target, i * step, lanes)
        return f

    def _matrix(self, i: int, c: int) -> int:
        """Index of an entry of a matrix of `columns`."""
        return c * self.equations.ny + i if self.batch else i

    def _write_change(self) -> None:
        """Change of parameters: X T with T the inverse of X's rows of pivots, and T."""
        self.change = f = self._function("change", "n_group")
        group = f.index(f.arguments[1])
        e, columns = self.equations, self.columns[0]
        k = e.k
        rows = [self._row(columns, i) for i in range(e.ny)]
        eye = [self._unit_row(i) for i in range(k)]
        for r, pivot in enumerate(self.pivots):
            scale = 1.0 / self._entry(rows[pivot], r)
            g = [each * scale for each in rows[pivot]]
            g = self._with_entry(g, r, 1.0 - scale)
            for each in (rows, eye):
                for i, row in enumerate(each):
                    x = self._entry(row, r)
                    each[i] = [a - x * b for a, b in zip(row, g, strict=True)]
        for i, row in enumerate(rows):
            self._set_row(row, columns, i)
        for i, row in enumerate(eye):
            for c in range(k):
                self._put(self._entry(row, c), self.T, i * k + c, group)

    def _row(self, columns: Array, i: int) -> list[Value]:
        """Return a row of a matrix of `columns`: a list of robots' numbers, or one vector."""
        count = self.equations.k if self.batch else 1
        return [self._get(columns, self._matrix(i, c), 0, self.L) for c in range(count)]

    def _set_row(self, row: list[Value], columns: Array, i: int) -> None:
        for c, value in enumerate(row):
            self._put(value, columns, self._matrix(i, c), 0, self.L)

    def _unit_row(self, i: int) -> list[Value]:
        f, k = self._now, self.equations.k
        if self.batch:
            return [f.splat(f.value(float(c == i)), self.L) for c in range(k)]
        return [f.joined([f.value(float(c == i)) for c in range(self.L)])]

    def _entry(self, row: list[Value], c: int) -> Value:
        return row[c] if self.batch else self._now.lane(row[0], c)

    def _with_entry(self, row: list[Value], c: int, value: Value) -> list[Value]:
        if self.batch:
            return [*row[:c], value, *row[c + 1 :]]
        kind = row[0].type
        found = f"insertelement {kind} {row[0].name}, double {value.name}, i32 {c}"
        return [self._now.result(found, lanes=self.L)]

    def _write_along(self) -> None:
        """X along the rod, from S at the base; at the tip the inverse of M X."""
        e = self.equations
        k = e.k
        self.along = f = self._function("along")
        memory = f.arguments[0]
        one, other = self.columns
        for i in range(e.ny):
            if self.batch:
                self._set_row([self._get(self.S, i * k + c) for c in range(k)], one, i)
            else:
                numbers = [self._get(self.S, i * k + c) if c < k else f.value(0.0) for c in range(self.L)]
                self._set_row([f.joined(numbers)], one, i)
        each = _each(self.pieces)
        full = (self.pieces - 1) // each

        def piece(j: Index) -> None:
            for c in range(k if self.batch else 1):
                first = self._matrix(0, c)
                source, target = (f.pointer(memory, each.at(first, 0)) for each in (one, other))
                f.call(self.advance_columns, memory, source, target, j.value)
            for i in range(e.ny):
                self._set_row(self._row(other, i), one, i)

        def keep(j: Index) -> None:
            for i in range(e.ny):
                row = self._row(one, i)
                for c in range(k):
                    self._put(self._entry(row, c), self.X, i * k + c, j + 1)

        with f.loop(full) as g:
            with f.loop((g.value + 1) * each, g.value * each) as j:
                piece(j)
                keep(j)
            f.call(self.change, memory, g.value)
            keep(f.index((g.value + 1) * each - 1))
        with f.loop(self.pieces, full * each) as j:
            piece(j)
            keep(j)
        # M X at the tip and its inverse: reuse of the change of parameters
        rows = []
        for a in range(k):
            row = None
            for i in range(e.ny):
                if e.program.is_constant(int(e.tip_slopes[a, i]), 0.0):
                    continue
                term = [self._get(self.M, a * e.ny + i) * x for x in self._row(one, i)]
                row = term if row is None else [p + q for p, q in zip(row, term, strict=True)]
            assert row is not None
            rows.append(row)
        eye = [self._unit_row(i) for i in range(k)]
        for r in range(k):
            scale = 1.0 / self._entry(rows[r], r)
            changed = self._with_entry([x * scale for x in rows[r]], r, 1.0 - scale)
            for matrix in (rows, eye):
                for i, row in enumerate(matrix):
                    x = self._entry(row, r)
                    matrix[i] = [p - x * q for p, q in zip(row, changed, strict=True)]
        for i, row in enumerate(eye):
            for c in range(k):
                self._put(self._entry(row, c), self.inverse, i * k + c)

    def _write_linearise(self) -> None:
        """Rates, slopes and factors at y."""
        e = self.equations
        self.linearised = f = self._function("linearised")
        memory = f.arguments[0]
        far = self._write_far(self.y, self.H, slopes=True)
        with self._places(self.ends) as j:
            self._rates_at(self.rates_and_slopes, far, self.H, j)
        self._write_ends(self.slope, self.slope_end)
        f.call(self.factored, memory)
        state = self._base_state(self.unknowns, self.H)
        for k, value in enumerate(self._evaluated(e.base_slopes.reshape(-1), 0, False, state)):
            self._put(value, self.S, k)
        for k, value in enumerate(
            self._evaluated(e.tip_slopes.reshape(-1), 0, False, self._tip_state(self.y, self.H))
        ):
            self._put(value, self.M, k)
        f.call(self.along, memory)

    def _write_correct(self) -> None:
        """The correction of all points and of the unknowns, from the defects."""
        e = self.equations
        ny, k = e.ny, e.k
        self.correct = f = self._function("correct")
        memory = f.arguments[0]
        each = _each(self.pieces)
        full = (self.pieces - 1) // each
        for i in range(ny):
            self._put(0.0, self.w, i, 0)

        def piece(j: Index) -> None:
            source, target = self._pointer(self.w, j), self._pointer(self.w, j + 1)
            f.call(self.advance, memory, source, target, j.value)

        with f.loop(full) as g:
            with f.loop((g.value + 1) * each, g.value * each) as j:
                piece(j)
            last = f.index((g.value + 1) * each)
            beta = [self._get(self.w, p, last) for p in self.pivots]
            for c in range(k):
                self._put(beta[c], self.beta, c, g)
            for i in range(ny):
                w = self._get(self.w, i, last)
                for c in range(k):
                    w = w - self._get(self.X, i * k + c, last) * beta[c]
                self._put(w, self.w, i, last)
        with f.loop(self.pieces, full * each) as j:
            piece(j)
        at_tip = []
        for a in range(k):
            value = self._get(self.tip, a)
            for i in range(ny):
                if not e.program.is_constant(int(e.tip_slopes[a, i]), 0.0):
                    value = value + self._get(self.M, a * ny + i) * self._get(self.w, i, self.points - 1)
            at_tip.append(value)
        alpha = [Variable(f, f.splat(f.value(0.0), self.P)) for _ in range(k)]
        for a in range(k):
            value = self._get(self.inverse, a * k) * at_tip[0]
            for c in range(1, k):
                value = value + self._get(self.inverse, a * k + c) * at_tip[c]
            alpha[a].set(-value)

        def keep(j: Index) -> None:
            for a in range(k):
                self._put(alpha[a].get(), self.alpha, a, j)

        with f.loop(self.pieces + 1, full * each + 1) as j:
            keep(j)
        with f.loop(0, full - 1, -1) as g:
            keep(f.index((g.value + 1) * each))
            change = [alpha[c].get() - self._get(self.beta, c, g) for c in range(k)]
            for a in range(k):
                value = self._get(self.T, a * k, g) * change[0]
                for c in range(1, k):
                    value = value + self._get(self.T, a * k + c, g) * change[c]
                alpha[a].set(value)
            with f.loop((g.value + 1) * each, g.value * each + 1) as j:
                keep(j)
        for a in range(k):
            self._put(alpha[a].get(), self.step_unknowns, a)
        with self._places(self.points - 1, 1) as j:
            own = [self._wide(self.alpha, c, j) for c in range(k)]
            for i in range(ny):
                value = self._wide(self.w, i, j)
                for c in range(k):
                    value = value + self._wide(self.X, i * k + c, j) * own[c]
                self._write_wide(value, self.dy, i, j)
        for i in range(ny):
            value = f.splat(f.value(0.0), self.P)
            for c in range(k):
                if not e.program.is_constant(int(e.base_slopes[i, c]), 0.0):
                    value = value + self._get(self.S, i * k + c) * alpha[c].get()
            self._put(value, self.dy, i, 0)

    # sizes

    def _norm(
        self, array: Array, scale: str, count: int, first: int = 0, relative: Array | None = None
    ) -> Value:
        """Return the largest component over its natural unit; infinite for NaN."""
        f = self._now
        found = Variable(f, f.splat(f.value(0.0), self.L))
        finite = Variable(f, f.splat(f.value(0.0), self.L))
        with self._places(count, first) as j:
            largest, total = found.get(), finite.get()
            inside = self._inside(j, first + count)
            for i in range(array.size):
                x = f.apply("abs", self._wide(array, i, j))
                unit = self._wide(self.scale_y, i)
                if relative is None:
                    x = x * unit
                else:
                    x = x / (1.0 / unit + f.apply("abs", self._wide(relative, i, j)))
                x = x if self.batch else f.select(inside, x, 0.0)
                largest, total = f.apply("max", largest, x), total + x
            found.set(largest)
            finite.set(total)
        # maxnum drops NaN; a sum keeps it
        known = f.compare("lt", finite.get(), float("inf"))
        return self._largest(f.select(known, found.get(), float("inf")))

    def _tip_norm(self) -> Value:
        f = self._now
        found = f.splat(f.value(0.0), self.P)
        for i in range(self.equations.k):
            x = f.apply("abs", self._get(self.tip, i)) * self._get(self.scale_tip, i)
            found = f.select(f.compare("le", x, found), found, x)
        return found

    # Newton's method

    def _write_base(self, unknowns: Array, y: Array, history: Array) -> None:
        e = self.equations
        state = self._base_state(unknowns, history)
        for i, value in enumerate(self._evaluated(e.base, 0, False, state)):
            self._put(value, y, i, 0)

    def _write_newton(self) -> None:
        """Solve one step from y and the unknowns; results in y, the rates belong to y."""
        e, newton = self.equations, self.newton
        self.solve = f = self._function("solve", "numbers")
        memory, numbers = f.arguments
        P, infinity = self.P, float("inf")

        def plain(value: float) -> Variable:
            return Variable(f, f.splat(f.value(value), P))

        def truth(value: bool) -> Variable:
            return Variable(f, f.splat(f.value(value), P))

        error, size, left, damping = plain(infinity), plain(infinity), plain(infinity), plain(1.0)
        corrections, linearisations = plain(0.0), plain(0.0)
        usable = f.load(numbers, USABLE * P, P) > 0.0
        alive = f.load(numbers, ALIVE * P, P) > 0.0
        renew, first, fresh, old, done = (truth(False) for _ in range(5))
        renew.set(~usable)
        old.set(usable)
        with self._places(self.points) as j:
            for i in range(e.ny):
                self._write_wide(0.0, self.direction, i, j)
        for i in range(e.k):
            self._put(0.0, self.trial_unknowns, i)  # the direction of the unknowns

        def active() -> Value:
            count = linearisations.get() + f.select(renew.get(), 1.0, 0.0)
            return alive & ~done.get() & (count <= float(newton.max_linearisations))

        with f.while_(lambda: f.any(active())):
            going = active()
            anew = Variable(f, f.any(renew.get() & going))
            with f.if_(anew.get()):
                f.call(self.linearised, memory)
                now = active()
                damping.set(f.select(now, 1.0, damping.get()))
                size.set(f.select(now, infinity, size.get()))
                old.set(old.get() & ~now)
                first.set(now | first.get())
                fresh.set(fresh.get() & ~now)
                renew.set(renew.get() & ~now)
                linearisations.set(linearisations.get() + f.select(now, 1.0, 0.0))
                with self._places(self.points) as j:
                    for i in range(e.ny):
                        self._write_wide(self._wide(self.y, i, j), self.trial, i, j)
                f.call(self.defects, memory)
            with f.if_(~anew.get()):
                step = self._spread(damping.get())
                with self._places(self.points) as j:
                    for i in range(e.ny):
                        moved = self._wide(self.y, i, j) + step * self._wide(self.direction, i, j)
                        self._write_wide(moved, self.trial, i, j)
                for i in range(e.k):
                    moved = self._get(self.unknowns, i) + damping.get() * self._get(self.trial_unknowns, i)
                    self._put(moved, self.tip_defect, i)  # the trial's unknowns
                self._write_base(self.tip_defect, self.trial, self.H)
                f.call(self.residual, memory)
            with f.if_(anew.get()):
                for i in range(e.k):
                    self._put(self._get(self.unknowns, i), self.tip_defect, i)
            now_error = f.apply("max", self._norm(self.r, "y", self.pieces), self._tip_norm())
            f.call(self.correct, memory)
            now_size = self._norm(self.dy, "y", self.points)
            now_left = self._norm(self.dy, "y", self.points, 0, self.trial)
            was_first, was_fresh, was_old = first.get(), fresh.get(), old.get()
            was_damping, was_size, was_error = damping.get(), size.get(), error.get()
            good = (now_error <= newton.tolerance) & (now_left <= LARGEST_CORRECTION)
            shorter = (now_size <= (1.0 - was_damping * 0.25) * was_size) & (now_size < infinity)
            accept = good | shorter
            ratio = f.apply("max", was_size / now_size, 1.0 + 1e-6)
            rate = f.apply("log", ratio)
            slow = f.apply("log", now_error / newton.tolerance) > rate * float(newton.patience)
            slow = shorter & ~was_first & (was_size < infinity) & (slow | (was_damping < 1.0))
            shorten = ~accept & was_fresh & ~was_first & (was_damping > newton.least_damping)
            rounding = ~accept & (was_error <= newton.acceptable) & ~was_old & ~was_first
            dead = rounding | (~accept & (was_first | was_fresh) & ~shorten)
            again = ~good & ~dead & (slow | (~accept & ~shorten))
            longer = f.select(was_first, 1.0, f.apply("min", 1.0, 4.0 * was_damping))
            accept = accept & going
            error.set(f.select(accept, now_error, was_error))
            size.set(f.select(accept, now_size, was_size))
            left.set(f.select(accept, now_left, left.get()))
            damping.set(f.select(going, f.select(accept, longer, was_damping * 0.25), was_damping))
            renew.set(f.select(going, again, renew.get()))
            fresh.set(f.select(accept, was_first, was_fresh))
            first.set(was_first & ~going)
            done.set(done.get() | ((good | dead) & going))
            more = going & ~(good | dead | again)
            corrections.set(corrections.get() + f.select(more, 1.0, 0.0))
            wide_accept = self._spread(accept)
            with self._places(self.points) as j:
                for i in range(e.ny):
                    for source, target in ((self.trial, self.y), (self.dy, self.direction)):
                        value = f.select(wide_accept, self._wide(source, i, j), self._wide(target, i, j))
                        self._write_wide(value, target, i, j)
            for i in range(e.k):
                for source, target in (
                    (self.tip_defect, self.unknowns),
                    (self.step_unknowns, self.trial_unknowns),
                ):
                    self._put(f.select(accept, self._get(source, i), self._get(target, i)), target, i)
        last = f.select(
            left.get() <= LARGEST_CORRECTION,
            error.get(),
            f.apply("max", error.get(), f.apply("min", left.get(), 1.0)),
        )
        keeps = (last <= newton.acceptable) & ~renew.get()
        f.store(f.select(keeps, 1.0, 0.0), numbers, USABLE * P, P)
        f.store(last, numbers, ERROR * P, P)
        f.store(corrections.get(), numbers, CORRECTIONS * P, P)
        f.store(linearisations.get(), numbers, LINEARISATIONS * P, P)

    def _spread(self, value: Value) -> Value:
        return self._now.splat(value, self.L)

    # the corrected motion

    def _write_check(self) -> None:
        """Rates and residual of the solution, its records, and the defects of Simpson's formula."""
        e = self.equations
        self.check = f = self._function("check", "numbers", "coefficients")
        memory, numbers, _ = f.arguments
        f.call(self.residual_of_y, memory)
        largest = f.apply("max", self._norm(self.r, "y", self.pieces), self._tip_norm())
        f.store(f.apply("max", largest, f.load(numbers, ERROR * self.P, self.P)), numbers, ERROR * self.P)
        middle = self.ends
        far = self.y if self.far is None else self.far
        with self._places(self.pieces) as j:
            h = self._wide(self.h, 0, j)
            for i in range(e.ny):
                a, b = self._wide(far, i, j), self._wide(self.y, i, j + 1)
                rates = self._wide(self.f, i, j) - self._wide(self.fe, i, j)
                self._write_wide(0.5 * (a + b) + 0.125 * h * rates, self.middle, i, j)
            self._rates_at(self.rates, self.middle, self.H, j, j + middle)
            for i in range(e.ny):
                rates = self._wide(self.f, i, j) + self._wide(self.fe, i, j)
                mid = self._wide(self.f, i, j + middle)
                # Simpson's increment less that of the box scheme
                self._write_wide(h * ((1 / 6 - 0.5) * rates + (2 / 3) * mid), self.defect, i, j)
        self._write_records()
        # no residual has the strains of the tip
        total = Variable(f, f.splat(f.value(0.0), self.L))
        with self._places(self.points) as j:
            for i in range(e.nz):
                size = f.apply("abs", self._wide(self.z, i, j))
                total.set(
                    total.get() + (size if self.batch else f.select(self._inside(j, self.points), size, 0.0))
                )
        finite = self._largest(f.select(total.get() < float("inf"), 0.0, float("inf")))
        f.store(f.apply("max", finite, f.load(numbers, ERROR * self.P, self.P)), numbers, ERROR * self.P)

    def _write_corrected(self, name: str, errors: list[Array], has_defect: bool, number: int) -> Function:
        """The corrected motion: from its own history, and with defects or, without, those of the solution.

        The residual that the solution has left is none of its errors. Errors beyond the rod's length, and all
        later ones, are unknown.
        """
        e = self.equations
        f = self._function(name, "numbers")
        memory, numbers = f.arguments
        f.call(self.residual_of_y, memory)
        with self._places(self.pieces) as j:
            for i in range(e.ny):
                defect = self._wide(self.defect, i, j) if has_defect else 0.0
                self._write_wide(defect - self._wide(self.r, i, j), self.own_defect, i, j)
        for i in range(e.k):
            self._put(self._get(self.tip, i), self.tip_defect, i)
        with self._places(self.ends) as j:
            for i in range(e.ny):
                start = 2.0 * self._wide(errors[0], i, j) - self._wide(errors[1], i, j)
                self._write_wide(self._wide(self.y, i, j) + start, self.better, i, j)
            for i in e.used_history:
                value = self._wide(self.H, i, j) + self._wide(self.dH, i, j)
                self._write_wide(value, self.own_dH, i, j)
        for i, p in enumerate(self.pivots):
            change = 2.0 * self._get(errors[0], p, 0) - self._get(errors[1], p, 0)
            self._put(self._get(self.unknowns, i) + change, self.trial_unknowns, i)

        def evaluated() -> Value:
            self._write_base(self.trial_unknowns, self.better, self.own_dH)
            f.call(self.residual_of_better, memory)
            with self._places(self.pieces) as j:
                for i in range(e.ny):
                    value = self._wide(self.r, i, j) + self._wide(self.own_defect, i, j)
                    self._write_wide(value, self.r, i, j)
            for i in range(e.k):
                self._put(self._get(self.tip, i) - self._get(self.tip_defect, i), self.tip, i)
            return f.apply("max", self._norm(self.r, "y", self.pieces), self._tip_norm())

        alive = f.load(numbers, ALIVE * self.P, self.P) > 0.0
        largest = Variable(f, f.splat(f.value(0.0), self.P))
        left = Variable(f, f.splat(f.value(float("inf")), self.P))
        turns = Variable(f, f.value(0.0))
        largest.set(evaluated())

        def going() -> Value:
            found = Variable(f, f.splat(f.value(0.0), self.L))
            with self._places(self.points) as j:
                for i in range(e.ny):
                    y = self._wide(self.y, i, j)
                    change = self._wide(self.better, i, j) - y - self._wide(errors[0], i, j)
                    size = f.apply("abs", change) / (1.0 / self._wide(self.scale_y, i) + f.apply("abs", y))
                    size = size if self.batch else f.select(self._inside(j, self.points), size, 0.0)
                    found.set(f.apply("max", found.get(), size))
            far = left.get() > ESTIMATE_TOLERANCE * self._largest(found.get()) + ROUNDING
            return f.any(far & alive) & (turns.get() < float(ESTIMATE_TURNS)) | (turns.get() < 1.0)

        with f.while_(going):
            f.call(self.correct, memory)
            with self._places(self.points) as j:
                for i in range(e.ny):
                    value = self._wide(self.better, i, j) + self._wide(self.dy, i, j)
                    self._write_wide(value, self.better, i, j)
            for i in range(e.k):
                value = self._get(self.trial_unknowns, i) + self._get(self.step_unknowns, i)
                self._put(value, self.trial_unknowns, i)
            size = self._norm(self.dy, "y", self.points, 0, self.y)
            before = largest.get()
            largest.set(evaluated())
            left.set(size * largest.get() / before)
            turns.set(turns.get() + 1.0)
        off, angle = self._errors_of_poses()
        known = self._spread(f.select(off <= self._get(self.length, 0), 1.0, float("nan")))
        with self._places(self.ends) as j:
            for i in range(errors[0].size):
                self._write_wide(self._wide(errors[0], i, j), errors[1], i, j)
        far = self.better if self.far is None else self.far
        with self._places(self.ends) as j:
            for i in range(e.ny):
                value = self._wide(far, i, j) - self._wide(self.records[0], i, j)
                self._write_wide(value * known, errors[0], i, j)
            for i in range(e.nz):
                value = self._wide(self.z, i, j) - self._wide(self.records[0], e.ny + i, j)
                self._write_wide(value * known, errors[0], e.ny + i, j)
        f.store(f.select(off <= self._get(self.length, 0), off, float("nan")), numbers, number * self.P)
        if has_defect:
            f.store(angle, numbers, ANGLE * self.P)
        return f

    def _errors_of_poses(self) -> tuple[Value, Value]:
        """Return the largest error of positions (m) and of orientations (rad), of the better y."""
        f, layout = self._now, self.equations.system.y_layout
        offs, angles = (Variable(f, f.splat(f.value(0.0), self.L)) for _ in range(2))
        total = Variable(f, f.splat(f.value(0.0), self.L))
        with self._places(self.points) as j:

            def change(i: int) -> Value:
                return self._wide(self.better, i, j) - self._wide(self.y, i, j)

            def largest(found: Variable, value: Value) -> None:
                value = value if self.batch else f.select(self._inside(j, self.points), value, 0.0)
                found.set(f.apply("max", found.get(), value))
                total.set(total.get() + value)

            names = layout.names
            if "p" in names:
                span = layout.slice("p")
                p = [change(i) for i in range(span.start, span.stop)]
                largest(offs, p[0] * p[0] + p[1] * p[1] + p[2] * p[2])
            else:
                for i in range(self.equations.ny):
                    size = change(i) * self._wide(self.scale_y, i) * self._wide(self.length, 0)
                    largest(offs, size * size)
            if "h" in names:
                span = layout.slice("h")
                rows = range(span.start, span.stop)
                h, d = [self._wide(self.y, i, j) for i in rows], [change(i) for i in rows]
                square = h[0] * h[0] + h[1] * h[1] + h[2] * h[2] + h[3] * h[3]
                along = (h[0] * d[0] + h[1] * d[1] + h[2] * d[2] + h[3] * d[3]) / square
                across = [a - b * along for a, b in zip(d, h, strict=True)]
                size = across[0] * across[0] + across[1] * across[1]
                largest(angles, (size + across[2] * across[2] + across[3] * across[3]) / square)
        finite = f.compare("lt", total.get(), float("inf"))
        off, angle = (
            f.apply("sqrt", self._largest(f.select(finite, each.get(), float("inf"))))
            for each in (offs, angles)
        )
        return off, 2.0 * angle

    def _write_time_errors(self) -> None:
        """Errors of the states after a stage by the time scheme (see `solvers.time_loop.time_errors`)."""
        e, scheme = self.equations, self.scheme
        assert isinstance(scheme, SDIRK2)
        self.time_error = f = self._function("time_error", "numbers", "coefficients")
        memory, numbers, coefficients = f.arguments
        c0, c1, c2 = (f.load(coefficients, i) for i in range(3))
        with self._places(self.ends) as j:
            for i in range(e.numbers):
                value = c1 * self._wide(self.time_errors[0], i, j) + c2 * self._wide(
                    self.time_errors[1], i, j
                )
                self._write_wide(value, self.dH, i, j)
        with f.if_(f.compare("ne", c2, 0.0)):
            # the difference of the rates at both stages, and its product with the equations' derivatives
            with self._places(self.ends) as j:
                for i in range(e.numbers):
                    self._write_wide(-c0 * self._wide(self.difference, i, j), self.move, i, j)
                for i in range(e.ny):
                    self._write_wide(0.0, self.dy, i, j)
            f.call(self.products, memory)
            f.call(self.correct, memory)
            f.call(self.products, memory)
            with self._places(self.ends) as j:
                for i in range(e.numbers):
                    once = self._wide(self.dfar, i, j) if i < e.ny else self._wide(self.dz, i - e.ny, j)
                    once = once - self._wide(self.difference, i, j)
                    value = self._wide(self.dH, i, j) - c0 * scheme.defect * once
                    self._write_wide(value, self.sum, i, j)
            with self._places(self.ends) as j:
                for i in range(e.numbers):
                    self._write_wide(self._wide(self.sum, i, j), self.dH, i, j)
        f.call(self.corrected_in_time, memory, numbers)

    def _write_products(self) -> None:
        """Products of derivatives with `dy` at the points and `move` of the history: defects, tip, z."""
        e = self.equations
        self.products = self._function("products")
        far = self.y if self.far is None else self.far
        with self._places(self.points) as j:
            for i in range(e.ny):
                self._write_wide(self._wide(self.dy, i, j), self.dfar, i, j)
        if self.far is not None:
            self._write_far(self.y, self.H)
            with self._places(self.pieces) as j:
                state = self._state_with_tangents(self.y, self.dy, j)
                state |= {int(node): self._wide(self.acting, i, j) for i, node in enumerate(e.acting)}
                for i, value in enumerate(self._evaluated(e.products["far"], j, True, state)):
                    self._write_wide(value, self.dfar, i, j)
        else:
            self._write_far(self.y, self.H)
        for k, point in enumerate(self.grid.near):
            for i in range(e.ny):
                self._put(self._get(self.dy, i, int(point)), self.dfar, i, self.points + k)
        with self._places(self.ends) as j:
            state = self._state_with_tangents(far, self.dfar, j)
            found = self._evaluated(e.products["rates"], j, True, state)
            for i in range(e.ny):
                self._write_wide(found[i], self.df, i, j)
            for i in range(e.nz):
                self._write_wide(found[e.ny + i], self.dz, i, j)
        self._write_ends(self.df, self.dfe)
        with self._places(self.pieces) as j:
            half = self._wide(self.h, 0, j) * 0.5
            for i in range(e.ny):
                rates = self._wide(self.df, i, j) + self._wide(self.dfe, i, j)
                change = self._wide(self.dfar, i, j) - self._wide(self.dy, i, j + 1)
                self._write_wide(change + half * rates, self.r, i, j)
        tip = self.points - 1
        state = self._tip_state(self.y, self.H)
        state |= {int(node): self._get(self.dy, i, tip) for i, node in enumerate(e.dy)}
        state |= {int(e.dhistory[i]): self._get(self.move, i, tip) for i in range(e.numbers)}
        for i, value in enumerate(self._evaluated(e.products["tip"], 0, False, state)):
            self._put(value, self.tip, i)

    def _state_with_tangents(self, y: Array, dy: Array, j: Index) -> dict[int, Value]:
        e = self.equations
        state = {int(node): self._wide(y, i, j) for i, node in enumerate(e.y)}
        state |= {int(e.history[i]): self._wide(self.H, i, j) for i in e.used_history}
        state |= {int(node): self._wide(dy, i, j) for i, node in enumerate(e.dy)}
        return state | {int(node): self._wide(self.move, i, j) for i, node in enumerate(e.dhistory)}

    def _write_records(self) -> None:
        """Shift the records by one step; the rate and the stages' difference of rates need the old ones."""
        e, f = self.equations, self._now
        coefficients = f.arguments[-1]
        c0 = f.load(coefficients, 0)
        far = self.y if self.far is None else self.far
        newest = [(far, i) for i in range(e.ny)] + [(self.z, i) for i in range(e.nz)]
        if isinstance(self.scheme, SDIRK2):
            with self._places(self.ends) as j:
                for i, (array, k) in enumerate(newest):
                    rate = self._wide(array, k, j) + self._wide(self.H, i, j) / c0
                    step = self._wide(self.records[0], i, j) - self._wide(self.records[1], i, j)
                    self._write_wide(rate - step, self.difference, i, j)
        with self._places(self.count) as j:
            for i in range(e.numbers):
                self._write_wide(self._wide(self.records[0], i, j), self.records[1], i, j)
        with self._places(self.ends) as j:
            for i in range(e.ny):
                self._write_wide(self._wide(far, i, j), self.records[0], i, j)
        with self._places(self.pieces) as j:
            for i in range(e.ny):
                self._write_wide(self._wide(self.middle, i, j), self.records[0], i, j + self.ends)
        with self._places(self.count) as j:
            for i in range(e.nz):
                self._write_wide(self._wide(self.z, i, j), self.records[0], e.ny + i, j)
        if self.settings.uses_rate:
            with self._places(self.count) as j:
                for i in range(e.numbers):
                    value = c0 * self._wide(self.records[0], i, j) + self._wide(self.H, i, j)
                    self._write_wide(value, self.rate, i, j)

    # the time loop

    def _write_run(self) -> None:
        """All steps from `n_start` to `n_stop`, until every robot has failed; `reached` counts the solved."""
        e, P = self.equations, self.P
        names = ["memory", "controls", "coefficients", "extrapolations", "rows", "infos", "reached"]
        f = self._now = self.module.function("run", [*names, "n_start", "n_stop"], exported=True)
        memory, controls, coefficients, extrapolations, rows, infos, reached, start, stop = f.arguments
        numbers = Value(f, f.reserve(f"[{8 * P} x double]"), "ptr")
        for k in range(8):
            f.store(1.0 if k == ALIVE else 0.0, numbers, k * P, P)
        f.call(self.setup, memory)
        step, nodes, stages = Variable(f, start), len(self.grid.nodes), self.settings.stages

        def going() -> Value:
            return (step.get() < stop) & f.any(f.load(numbers, ALIVE * P, P) > 0.0)

        with f.while_(going):
            with f.loop(stages) as stage:
                number = step.get() * stages + stage.value
                table = f.pointer(coefficients, number * 5)
                f.call(self.stage, memory, numbers, table, f.pointer(controls, number * (e.nc * P)))
                guesses = f.pointer(extrapolations, stage.value * 18)
                f.call(self.guesses, memory, guesses)
                with f.loop(nodes) as node:
                    point = self._node(node)
                    target = f.pointer(rows, (number * nodes + node.value) * (e.numbers * P))
                    for i in range(e.numbers):
                        value = self._get(self.y if i < e.ny else self.records[0], i, point)
                        f.store(value, target, i * P, P)
                info = f.pointer(infos, number * ((8 + e.k) * P))
                for k in range(8):
                    f.store(f.load(numbers, k * P, P), info, k * P, P)
                for k in range(e.k):
                    f.store(self._get(self.unknowns, k), info, (8 + k) * P, P)
            alive = f.load(numbers, ALIVE * P, P) > 0.0
            f.store(f.load(reached, 0, P) + f.select(alive, 1.0, 0.0), reached, 0, P)
            step.set(step.get() + 1)

    def _write_stage(self) -> None:
        """One stage of a step: history, first guess, solution, records and estimates."""
        e, P = self.equations, self.P
        self.stage = f = self._function("stage", "numbers", "coefficients", "controls")
        memory, numbers, coefficients, controls = f.arguments
        c0, c1, c2, d1, t = (f.load(coefficients, i) for i in range(5))
        self._put(c0, self.inputs, 0)
        self._put(t + self._get(self.t0, 0), self.inputs, 1)
        for i in range(e.nc):
            self._put(f.load(controls, i * P, P), self.inputs, 2 + i)
        f.call(self.terms, memory)

        def history(states: list[Array], rate: Array, target: Array, count: int) -> None:
            with self._places(count) as j:
                for i in range(e.numbers):
                    value = c1 * self._wide(states[0], i, j) + c2 * self._wide(states[1], i, j)
                    if self.settings.uses_rate:
                        value = value + d1 * self._wide(rate, i, j)
                    self._write_wide(value, target, i, j)

        history(self.records, self.rate, self.H, self.count)
        weights = [self._wide(self.weights, k) for k in range(3)]
        with self._places(self.points) as j:
            for i in range(e.ny):
                guess = weights[0] * self._wide(self.past[0], i, j)
                for k in (1, 2):
                    guess = guess + weights[k] * self._wide(self.past[k], i, j)
                self._write_wide(guess, self.y, i, j)
        for i, p in enumerate(self.pivots):
            self._put(self._get(self.y, p, 0), self.unknowns, i)
        self._write_base(self.unknowns, self.y, self.H)
        f.call(self.solve, memory, numbers)
        history(self.errors, self.error_rate, self.dH, self.ends)
        f.call(self.check, memory, numbers, coefficients)
        f.call(self.corrected, memory, numbers)
        if self.settings.uses_rate:
            with self._places(self.ends) as j:
                for i in range(e.numbers):
                    value = c0 * self._wide(self.errors[0], i, j) + self._wide(self.dH, i, j)
                    self._write_wide(value, self.error_rate, i, j)
        if isinstance(self.scheme, SDIRK2):
            f.call(self.time_error, memory, numbers, coefficients)
        solved = f.load(numbers, ERROR * P, P) <= self.newton.acceptable
        alive = f.load(numbers, ALIVE * P, P)
        f.store(f.select(solved, alive, 0.0), numbers, ALIVE * P, P)

    def _node(self, node: Index) -> Index:
        """Return the point of a node."""
        f = self._now
        if not len(self.grid.between):
            return node
        at = f.pointer(f.pointer(f.arguments[0], self.node_table.offset), node.value)
        return f.index(f.result(f"load i64, ptr {at.name}", "i64"))

    def _write_guesses(self) -> None:
        """Weights of the extrapolations in the next first guess, and the shift of earlier states.

        The extrapolations (2, 3, 3) are those to this stage and to the next.
        """
        e = self.equations
        self.guesses = f = self._function("guesses", "extrapolations")
        _, table = f.arguments
        this, following = (
            [[f.load(table, 9 * half + 3 * row + k) for k in range(3)] for row in range(3)]
            for half in range(2)
        )
        misfits = [Variable(f, f.splat(f.value(0.0), self.L)) for _ in range(3)]
        with self._places(self.points) as j:
            for i in range(e.ny):
                past = [self._wide(each, i, j) for each in self.past]
                unit, y = self._wide(self.scale_y, i), self._wide(self.y, i, j)
                for order, (misfit, weights) in enumerate(zip(misfits, this, strict=True)):
                    guess = past[0] * weights[0]
                    for k in range(1, order + 1):
                        guess = guess + past[k] * weights[k]
                    size = f.apply("abs", guess - y) * unit
                    size = size if self.batch else f.select(self._inside(j, self.points), size, 0.0)
                    misfit.set(f.apply("max", misfit.get(), size))
        sizes = [self._largest(each.get()) for each in misfits]
        least = f.apply("max", f.apply("min", sizes[0], f.apply("min", sizes[1], sizes[2])), ROUNDING)
        ratios = [f.apply("max", each / least, 1.0) for each in sizes]
        trusts = [1.0 / (each * each * each) for each in ratios]
        total = trusts[0] + trusts[1] + trusts[2]
        for k in range(3):
            weight = f.value(0.0)
            for order in range(k, 3):
                weight = weight + trusts[order] / total * following[order][k]
            self._put(weight, self.weights, k)
        for source, target in (
            (self.past[1], self.past[2]), (self.past[0], self.past[1]), (self.y, self.past[0])
        ):  # fmt: skip
            with self._places(self.points) as j:
                for i in range(e.ny):
                    self._write_wide(self._wide(source, i, j), target, i, j)

    def _write(self) -> None:
        e = self.equations
        self.middle = self._array(e.ny, self.pieces)
        self.node_table = self._array(len(self.grid.nodes), 1)
        self._write_setup()
        self._write_terms()
        self.rates = self._write_rates("rates", slopes=False)
        self.rates_and_slopes = self._write_rates("rates_and_slopes", slopes=True)
        self.residual = self._write_residual("residual", self.trial, self.H)
        self.residual_of_y = self._write_residual("residual_of_y", self.y, self.H)
        self.residual_of_better = self._write_residual("residual_of_better", self.better, self.own_dH)
        self.defects = self._function("defects")
        self._write_defects(self.trial, self.H)
        self._write_factor()
        self.advance = self._write_advance("advance", columns=False)
        self.advance_columns = self._write_advance("advance_columns", columns=True)
        self._write_change()
        self._write_along()
        self._write_linearise()
        self._write_correct()
        self._write_newton()
        self._write_check()
        self.corrected = self._write_corrected("corrected", self.errors, True, POSITION)
        if isinstance(self.scheme, SDIRK2):
            self._write_products()
            self.corrected_in_time = self._write_corrected("in_time", self.time_errors, False, TIME)
            self._write_time_errors()
        self._write_stage()
        self._write_guesses()
        self._write_run()

    # running

    def integrate(
        self, parameters: np.ndarray, controls: np.ndarray, steps: StepCoefficients, states: StateHistory,
        span: tuple[int, int],
    ) -> tuple[np.ndarray, StateHistory, StepRows]:  # fmt: skip
        """Solve a span of steps of each robot until one fails (see `time_loop.time_loop`).

        Parameters (lanes, n), controls (lanes, T, c) or (lanes, T, stages * c) and states (lanes, ...).
        Returns the numbers of steps done, the states after them, and rows.
        """
        e, P, stages = self.equations, self.P, self.settings.stages
        start, stop = span
        total, nodes = controls.shape[1], len(self.grid.nodes)
        own = controls.reshape(P, total, -1, e.nc)
        own = np.broadcast_to(own, (P, total, stages, e.nc))
        own = np.ascontiguousarray(np.moveaxis(own, 0, -1))
        table = np.empty((total, stages, 5))
        coefficients = np.asarray(steps.table).reshape(2, stages, 4)
        table[..., :4] = coefficients[1]
        table[:1, :, :4] = coefficients[0]
        table[..., 4] = (np.arange(total)[:, None] + np.asarray(steps.ends)) * steps.dt
        guesses = stage_extrapolations(self.settings) if stages > 1 else EXTRAPOLATIONS[None]
        guesses = np.ascontiguousarray(np.stack([guesses, np.roll(guesses, -1, axis=0)], axis=1))
        rows = np.zeros((total, stages, nodes, e.numbers, P))
        infos = np.zeros((total, stages, 8 + e.k, P))
        run = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * 7, *[ctypes.c_long] * 2)(
            self.compiled.address("run")
        )

        def ran(stop: int) -> tuple[np.ndarray, np.ndarray]:
            memory, reached = self._memory(parameters, states), np.full(P, float(start))
            arrays = memory, own, table, guesses, rows, infos, reached
            run(*(each.ctypes.data for each in arrays), start, stop)
            return memory, reached

        memory, reached = ran(stop)
        if not self.batch and reached[0] < stop:
            # the state before the step that failed
            failed = rows.copy(), infos.copy()
            memory, _ = ran(int(reached[0]))
            rows, infos = failed
        return reached.astype(int), self._states(memory, states), self._rows(rows, infos)

    def _rows(self, rows: np.ndarray, infos: np.ndarray) -> StepRows:
        """Return rows (lanes, steps, ...); a step's row is that of its last stage."""
        rows, infos = np.moveaxis(rows, -1, 0), np.moveaxis(infos, -1, 0)
        numbers, unknowns = infos[..., :8], infos[..., 8:]
        error = np.max(numbers[..., ERROR], axis=-1)
        off, angle = numbers[..., -1, POSITION], numbers[..., -1, ANGLE]
        length = self._lengths[:, None]
        fine = (off <= COARSE_SHARE * length) & (angle <= COARSE_ANGLE)
        result = np.where(fine, int(Result.CONVERGED), int(Result.COARSE))
        result = np.where(error <= self.newton.acceptable, result, int(Result.NO_CONVERGENCE))
        time_error = numbers[..., -1, TIME] if isinstance(self.scheme, SDIRK2) else np.full(off.shape, np.nan)
        corrections = np.sum(numbers[..., CORRECTIONS], axis=-1).astype(int)
        return StepRows(
            rows[:, :, -1], unknowns[:, :, -1], error, corrections, off, result, time_error,
            rows[:, :, :-1], unknowns[:, :, :-1],
        )  # fmt: skip

    def _arrays(self) -> dict[str, list[Array]]:
        """Return the arrays of each part of a `StateHistory`."""
        return {
            "records": self.records, "rate": [self.rate], "y": self.past, "weights": [self.weights],
            "t0": [self.t0], "error": [*self.errors, self.error_rate], "time_error": self.time_errors,
        }  # fmt: skip

    def _places_of(self, array: Array) -> tuple[np.ndarray, int]:
        """Return the offsets (places, size) of an array for the first lane, and its number of places."""
        count = array.count if self.batch or array.count == 1 else self.stride
        at = np.arange(count)[:, None] * array.place + np.arange(array.size) * array.component
        return array.offset + at, count

    def _memory(self, parameters: np.ndarray, states: StateHistory) -> np.ndarray:
        """Return the memory of a run from these states."""
        raw = np.zeros(self._size + 16)
        memory = raw[(-raw.ctypes.data // 8) % 8 :][: self._size]

        def put(array: Array, values: np.ndarray) -> None:
            """Write values (lanes, places, size); the last place is repeated in the lanes beyond it."""
            at, count = self._places_of(array)
            values = values.reshape(self.P, -1, array.size)
            values = values[:, np.minimum(np.arange(count), values.shape[1] - 1)]
            for lane, value in enumerate(values):
                memory[at + lane] = value

        put(self.params, parameters)
        if self.acting.size:
            put(self.acting, np.broadcast_to(self.grid.acting, (self.P, *self.grid.acting.shape)))
        for name, arrays in self._arrays().items():
            values = np.asarray(getattr(states, name), float)
            if name == "weights":
                put(self.weights, values)
                continue
            for k, array in enumerate(arrays):
                put(array, values[:, k] if len(arrays) > 1 else values)
        put(self.y, np.asarray(states.y, float)[:, 0])
        table = memory[self.node_table.offset :].view(np.int64)
        table[: len(self.grid.nodes)] = self.grid.nodes
        return memory

    def _states(self, memory: np.ndarray, states: StateHistory) -> StateHistory:
        """Return the states at the end of a run."""

        def get(array: Array, count: int) -> np.ndarray:
            at, _ = self._places_of(array)
            return np.stack([memory[at[:count] + lane] for lane in range(self.P)])

        self._lengths = get(self.length, 1)[:, 0, 0]
        found = {}
        for name, arrays in self._arrays().items():
            before = np.asarray(getattr(states, name))
            if name in ("weights", "t0"):
                found[name] = get(arrays[0], 1).reshape(before.shape)
                continue
            values = [get(array, before.shape[-2]) for array in arrays]
            found[name] = np.stack(values, axis=1) if len(values) > 1 else values[0]
        return StateHistory(**found)
