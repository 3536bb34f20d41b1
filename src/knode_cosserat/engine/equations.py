"""Programs of a system's equations, and of the elimination of one piece of the rod.

All come from the system's own functions (`program.Program`), and derivatives from rules on the program.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from knode_cosserat.engine.program import LARGEST_PRODUCT, PRODUCTS, Nonzeros, Program
from knode_cosserat.rods.strands import strand_count, strand_of
from knode_cosserat.rods.system import System, unknown_count
from knode_cosserat.schemes import semi_discrete
from knode_cosserat.schemes.problem import StepProblem
from knode_cosserat.schemes.space import LOBATTO2, SpaceScheme

RUN, STEP, PLACE, STATE = 1, 2, 3, 4
#: largest number of operations: LLVM's time grows faster than their number, to minutes for a large network
MOST_OPERATIONS = 60_000


def most_operations(ny: int) -> int:
    """Return the largest number of operations of a system by the size of y: an assembly has several rods."""
    return MOST_OPERATIONS * (1 + ny // 40)


def constant_zeros(leaf: np.ndarray) -> np.ndarray:
    """Return true where a parameter is a constant of the program: zeros, but not those of large arrays.

    A zero with a minus sign is a parameter that is going to move (`with_moving`).
    """
    return ~is_moving(leaf) & (leaf.size <= LARGEST_PRODUCT)


def is_moving(leaf: np.ndarray) -> np.ndarray:
    """Return true where a number is not zero, or is going to move."""
    return (leaf != 0.0) | np.signbit(leaf)


def with_moving(leaf: np.ndarray, moving: np.ndarray) -> np.ndarray:
    """Return a parameter, or its tangents, with zeros that are going to move: one code serves all values."""
    return np.where(moving & (leaf == 0.0), -0.0, leaf)


@dataclasses.dataclass(eq=False)
class Sizes:
    """Sizes of a system: strands, y, z, control and unknowns, and numbers of a record."""

    strands: int
    ny: int
    nz: int
    nc: int
    k: int
    #: y, z and, if B is not zero, y_s
    numbers: int

    def by_strand(self, values: np.ndarray) -> np.ndarray:
        """Return packed y or records (…, x of all strands) split by strand: (…, strands, x of one)."""
        sizes = self.strands * np.array([self.ny, self.ny + self.nz])
        parts = np.split(values, sizes[sizes < values.shape[-1]], axis=-1)
        return np.concatenate([part.reshape(*part.shape[:-1], self.strands, -1) for part in parts], axis=-1)

    def join(self, values: np.ndarray) -> np.ndarray:
        """Return y or records by strand (…, strands, x of one) packed: (…, x of all)."""
        sizes = np.array([self.ny, self.ny + self.nz])
        parts = np.split(values, sizes[sizes < values.shape[-1]], axis=-1)
        return np.concatenate([part.reshape(*part.shape[:-2], -1) for part in parts], axis=-1)


class Equations(Sizes):
    """Programs of a system: rates and strains at a point of a strand with their derivatives, base and tip.

    Parameters that are zero are constants, which takes fewer operations; but not those that are `moving`.
    """

    def __init__(
        self, system: System, moving: Sequence[np.ndarray] | None = None, space: SpaceScheme = LOBATTO2
    ):
        self.system, self.space = system, space
        leaves, tree = jax.tree.flatten(system)
        leaves = [np.asarray(leaf, dtype=float) for leaf in leaves]
        # traced, because the numbers of a pattern are no robot's
        strand = self.strand = jax.eval_shape(strand_of, system)
        self.strands = strand_count(system)
        self.ny, self.nz = strand.y_layout.size, strand.z_layout.size
        self.nc, self.k = system.control_layout.size, unknown_count(system)
        self.numbers = self.ny + self.nz + (self.ny if system.mixed else 0)
        program = self.program = Program(most_operations(self.ny))
        self.parameters = [program.inputs(f"p{i}", leaf.shape, RUN, True) for i, leaf in enumerate(leaves)]
        #: the place of each parameter's node in the vector of parameters
        self.parameter_values = np.concatenate([leaf.reshape(-1) for leaf in leaves])
        folded = [
            np.where(constant_zeros(leaf) & ~moves, program.constant(0.0), nodes)
            for leaf, nodes, moves in zip(
                leaves, self.parameters, moving or [np.array(False)] * len(leaves), strict=True
            )
        ]
        self.c0, self.t = program.inputs("c0", (), STEP), program.inputs("t", (), STEP)
        self.control = program.inputs("control", (self.nc,), STEP)
        self.s = program.inputs("s", (), PLACE)
        self.y = program.inputs("y", (self.ny,), STATE)
        self.history = program.inputs("history", (self.numbers,), STATE)
        #: y and history of all strands, for base and tip; the first strand's inputs are those of a point
        self.strand_y, self.strand_history = (
            [nodes, *(program.inputs(f"{name}{q}", nodes.shape, STATE) for q in range(1, self.strands))]
            for name, nodes in (("y", self.y), ("history", self.history))
        )
        whole_y, whole_history = np.concatenate(self.strand_y), self.join(np.array(self.strand_history))
        self.unknowns = program.inputs("unknowns", (self.k,), STATE)

        def problem(step: Any, record: Any) -> StepProblem:
            leaves, c0, t, control = step
            own = jax.tree.unflatten(tree, leaves)
            return StepProblem(own, t, control, c0, record[None], space)

        def rates(step: Any, s: Any, y: Any, record: Any) -> Any:
            return problem(step, record).point_rates(s, y, record)

        def base(step: Any, unknowns: Any, record: Any) -> Any:
            return problem(step, record).base(unknowns)

        def tip(step: Any, y: Any, record: Any) -> Any:
            own, (_, c0, t, control) = jax.tree.unflatten(tree, step[0]), step
            return semi_discrete.tip(own, t, control, y, semi_discrete.unpacked_history(own, c0, record))

        def jump(step: Any, acting: Any, y: Any, record: Any) -> Any:
            return problem(step, record).jump(acting, y, record)

        def geometry(leaves: Any) -> Any:
            own = jax.tree.unflatten(tree, leaves)
            scales = own.scales()
            return 1.0 / scales.y, 1.0 / scales.tip, jnp.asarray(own.length)[None]

        step, known = (leaves, 1.0, 0.0, np.zeros(self.nc)), [*folded, self.c0, self.t, self.control]

        def results(function: Callable[..., Any], *inputs: np.ndarray) -> list[np.ndarray]:
            """Return the results of a function of a step and of inputs."""
            traced = jax.make_jaxpr(function)(step, *(np.zeros(nodes.shape) for nodes in inputs))
            return program.evaluate(traced, [*known, *inputs])

        # of the parameters alone: inverse scales, and the length, of which places and pieces are parts
        self.geometry = [
            np.broadcast_to(nodes, size)
            for nodes, size in zip(
                program.evaluate(jax.make_jaxpr(geometry)(leaves), folded),
                (len(whole_y), self.k, 1),
                strict=True,
            )
        ]
        self.length = int(self.geometry[2][0])
        self.f, self.z = results(rates, self.s, self.y, self.history)
        [self.base] = results(base, self.unknowns, whole_history)
        [self.tip] = results(tip, whole_y, whole_history)
        #: y on the far side of the discontinuities that act, and the nonzeros of its derivative, less 1
        count = len(system.discontinuities.places)
        self.acting, self.far = program.inputs("acting", (count,), STATE), self.y
        self.jumping: Nonzeros = []
        if system.discontinuities.jump is not None:
            [self.far] = results(jump, self.acting, self.y, self.history)
            slopes = program.jacobian(self.far, self.y)
            for i in range(self.ny):
                slopes[i, i] = program.apply("sub", int(slopes[i, i]), program.constant(1.0))
            self.jumping = program.nonzeros_of(slopes)
        slopes = program.jacobian(self.f, self.y)
        base_slopes = program.jacobian(self.base, self.unknowns)
        tip_slopes = program.jacobian(self.tip, whole_y)
        self.base_slopes, self.tip_slopes = map(program.nonzeros_of, (base_slopes, tip_slopes))
        #: structural nonzeros of the Jacobian
        self.pattern = [(i, j) for i, j, _ in program.nonzeros_of(slopes)]
        self.nonzeros = [node for *_, node in program.nonzeros_of(slopes)]
        needed = set(program.needed([*self.f, *self.z, *self.far, *self.base, *self.tip]))
        #: entries of a record that the equations need as history
        self.used_history = [
            i for i in range(self.numbers) if any(int(nodes[i]) in needed for nodes in self.strand_history)
        ]
        outputs = [*self.f, *self.z, *slopes.reshape(-1), *self.base, *self.tip]
        outputs += [*base_slopes.reshape(-1), *tip_slopes.reshape(-1)]
        outputs += [*self.far, *(node for *_, node in self.jumping)]
        #: tangents of y and of the history of all strands, and the products of derivatives with them
        self.dy, self.dhistory = (
            [program.inputs(f"d{name}{q}", (size,), STATE) for q in range(self.strands)]
            for name, size in (("y", self.ny), ("history", self.numbers))
        )
        directions = {
            int(node): int(tangent)
            for nodes, tangents in ((self.strand_y, self.dy), (self.strand_history, self.dhistory))
            for node, tangent in zip(np.concatenate(nodes), np.concatenate(tangents), strict=True)
        }
        self.products = {
            name: program.derivative([int(node) for node in nodes], directions)
            for name, nodes in (
                ("rates", [*self.f, *self.z]),
                ("far", self.far),
                ("tip", self.tip),
                ("base", self.base),
            )
        }
        for nodes in self.products.values():
            outputs += nodes
        self._outputs = outputs
        self._hoist()

    def slots(self, terms: Sequence[int]) -> Iterator[tuple[int, int, int]]:
        """Return the nodes of terms, with the first of their numbers in memory and the count of these."""
        first = 0
        for node in terms:
            count = math.prod(self.program.shapes.get(node, ()))
            yield node, first, count
            first += count

    def size(self, terms: Sequence[int]) -> int:
        """Return the count of all numbers of terms."""
        return sum(count for *_, count in self.slots(terms))

    def _hoist(self) -> None:
        self.step_terms = self._hoisted_terms(self._outputs, {STEP, RUN})
        self.place_terms = self._hoisted_terms(self._outputs, {PLACE})

    def _hoisted_terms(self, outputs: Sequence[int] | np.ndarray, levels: set[int]) -> list[int]:
        """Return the operations of these levels that operations of higher levels need."""
        program, found = self.program, set()
        for node in program.needed(outputs):
            if program.levels[node] > max(levels):
                found |= {each for each in program.arguments(node) if program.levels[each] in levels}
        found |= {int(node) for node in outputs if program.levels[int(node)] in levels}

        def is_used_there(node: int) -> bool:
            """True for truths, views and products, which are evaluated where they are used."""
            name = program.operations[node][0]
            return program.is_boolean(node) or name == "view" or (name in PRODUCTS and node in program.shapes)

        todo = [node for node in found if is_used_there(node)]
        while todo:
            node = todo.pop()
            found.discard(node)
            for each in program.arguments(node):
                if program.levels[each] in levels and each not in found:
                    todo.append(each) if is_used_there(each) else found.add(each)
        # arrays of parameters are in memory
        return sorted(node for node in found if program.operations[node][0] != "inputs")


class TangentEquations(Equations):
    """Programs of a system with all derivatives of rates and strains, jumps, tip and base."""

    def __init__(
        self, system: System, moving: Sequence[np.ndarray], transposed: bool, space: SpaceScheme = LOBATTO2
    ):
        """Differentiate the equations by y, history, control, and the parameters that are `moving`.

        By parameters: products of the derivatives with a direction or, if `transposed`, with cotangents.
        """
        super().__init__(system, moving, space)
        results = {
            "rates": [*self.f, *self.z],
            "far": [*self.far] if system.discontinuities.jump else [],
            "tip": [*self.tip],
            "base": [*self.base],
        }
        self.z_by_y = self.program.nonzeros(self.z, self.y)
        #: by the history of all strands in turn; that of a point is the first
        whole = np.concatenate(self.strand_history)
        self.by_history = {name: self.program.nonzeros(nodes, whole) for name, nodes in results.items()}
        self.by_control = {
            name: self.program.nonzeros(nodes, self.control) for name, nodes in results.items()
        }
        for nonzeros in (self.z_by_y, *self.by_history.values(), *self.by_control.values()):
            self._outputs += [node for *_, node in nonzeros]
        self._hoist()
        moved = np.concatenate([nodes[moves] for nodes, moves in zip(self.parameters, moving, strict=True)])
        #: arrays of moving parameters that are read in memory, with the place of each in their vector
        self.moving_arrays = {
            array: int(np.searchsorted(moved, nodes.flat[0]))
            for nodes in self.parameters
            if (array := self.program.known_inputs(nodes)) is not None and np.isin(nodes, moved).all()
        }
        moves = [*moved, *self.moving_arrays]
        self.moves_lengths = bool(self.program.dependent([self.length], moves))
        moves += [self.s.item()] if self.moves_lengths else []
        moved_nodes = self.program.dependent([*itertools.chain(*results.values())], moves)
        #: numbers of the results that move with the system at fixed y
        self.moving_rows = {
            name: [i for i, node in enumerate(nodes) if node in moved_nodes]
            for name, nodes in results.items()
        }
        (self._pull if transposed else self._push)(results, moved)

    def _push(self, results: dict[str, list[int]], moved: np.ndarray) -> None:
        program = self.program
        self.dparameters = program.inputs("dparameter", moved.shape, RUN, True)
        tangents = dict(zip(moved.tolist(), self.dparameters.tolist(), strict=True))
        #: tangent of the length
        [self.dlength] = program.derivative([self.length], tangents)
        self.ds = program.inputs("ds", (), PLACE)
        tangents[self.s.item()] = self.ds.item()
        #: tangents of the results by the system, at fixed y, history and control
        self.by_system = {name: program.derivative(nodes, tangents) for name, nodes in results.items()}
        outputs = [node for nodes in self.by_system.values() for node in nodes]
        self.moved_terms = self._hoisted_terms(outputs, {STEP, RUN})
        #: operations of the rates that all directions have in common
        self.common = self._common(self.by_system["rates"], [*self.dparameters, self.ds.item()])

    def _common(self, outputs: Sequence[int], directions: Sequence[int]) -> list[int]:
        """Return the operations at a state that are the same for all directions, and that others need."""
        program = self.program
        moving = program.dependent(outputs, directions, linear=True)
        todo = [each for node in moving for each in program.arguments(node)]
        found = set[int]()
        while todo:
            node = todo.pop()
            if node in moving or node in found or program.levels[node] != STATE:
                continue
            if node in program.shapes:
                return []  # arrays are evaluated where they are used
            name = program.operations[node][0]
            if program.is_boolean(node):
                todo += program.arguments(node)
            elif name != "input":
                found.add(node)
        # not those that need more of a step than the results do, such as an entry of an array of parameters
        hoisted, apart = {*self.step_terms, *self.place_terms}, set[int]()
        for node in program.needed(found, hoisted):
            is_input = program.operations[node][0] == "input" and program.levels[node] != STATE
            if node not in hoisted and (is_input or not apart.isdisjoint(program.arguments(node))):
                apart.add(node)
        return sorted(found - apart)

    def _pull(self, results: dict[str, list[int]], moved: np.ndarray) -> None:
        program = self.program
        moving = [*moved, *self.moving_arrays]
        #: cotangents of the results
        self.cotangents = {
            name: program.inputs(f"cotangent of {name}", (len(nodes),), STATE)
            for name, nodes in results.items()
        }
        needed = self._scalars_of(self._hoisted_terms([*itertools.chain(*results.values())], {STEP, RUN}))
        #: terms of a step by which moving parameters act
        self.moving_terms = sorted(program.dependent([*needed], moving).intersection(needed))
        #: cotangents of these terms, of the place, and of moving arrays, from those of the results at a place
        self.pulled = {
            name: program.gradient(
                nodes, self.cotangents[name], [*self.moving_terms, self.s.item(), *self.moving_arrays]
            )
            for name, nodes in results.items()
        }
        outputs = [node for nodes in self.pulled.values() for node in nodes]
        self.pulled_terms = self._hoisted_terms(outputs, {STEP, RUN})
        #: cotangents of the parameters from those of the terms, and of the length
        self.of_terms = program.inputs("cotangent of term", (len(self.moving_terms),), STEP)
        self.of_length = program.inputs("cotangent of length", (), RUN)
        self.by_terms = program.gradient(self.moving_terms, self.of_terms, moving)
        self.by_geometry = program.gradient([self.length], [self.of_length.item()], moving)

    def _scalars_of(self, terms: Sequence[int]) -> set[int]:
        """Return terms with the scalars from which arrays among them are computed in their place."""
        program, found, todo = self.program, set[int](), list(terms)
        while todo:
            node = todo.pop()
            todo += program.arguments(node) if node in program.shapes else ()
            found |= set() if node in program.shapes else {node}
        return found


class Elimination:
    """Programs of a piece: A and B are derivatives of its defect by y at its start (before jumps) and end.

    B is factored. A correction x of the start becomes B⁻¹ (A x + r) at the end.
    """

    def __init__(self, equations: Equations):
        n = equations.ny
        program = self.program = Program(most_operations(n))
        apply = program.apply
        zero, one = program.constant(0.0), program.constant(1.0)
        self.h = program.input("h", 1)
        stages, weights = equations.space.formula
        #: nonzeros of the slopes at the start, at the end, and at each stage
        self.slopes = [
            program.inputs(name, (len(equations.pattern),), 1)
            for name in ("start", "end", *(f"stage{k}" for k in range(len(stages))))
        ]

        def combine(part: float, factors: Sequence[float], rates: Sequence[Any]) -> Any:
            """Return part 1 + h Σ factor rate."""
            found = np.full((n, n), zero)
            for factor, rate in zip(factors, rates, strict=False):
                scaled = apply("mul", self.h, program.constant(factor))
                for i, j in zip(*np.nonzero(rate != zero), strict=True):
                    product = apply("mul", scaled, int(rate[i, j]))
                    found[i, j] = apply("add", int(found[i, j]), product)
            for i in range(n):
                found[i, i] = apply("add", program.constant(part), int(found[i, i]))
            return found

        def change_of_rates(slopes: np.ndarray, right: Any) -> Any:
            """Return the derivatives of rates times a matrix or a vector."""
            right = np.asarray(right)
            found = np.full(right.shape, zero)
            for node, (i, k) in zip(slopes, equations.pattern, strict=True):
                for at in np.ndindex(right.shape[1:]):
                    if right[k, *at] != zero:
                        term = apply("mul", int(node), int(right[k, *at]))
                        found[i, *at] = apply("add", int(found[i, *at]), term)
            return found

        def derivative(side: int, sign: float) -> Any:
            """Return 1 plus `sign` times the derivative of the increment by y at the start (0) or end (1)."""
            rates = [np.full((n, n), zero) for _ in range(2)]
            for node, at in zip(self.slopes[side], equations.pattern, strict=True):
                rates[side][at] = node
            for slopes, stage in zip(self.slopes[2:], stages, strict=True):
                part = (1.0 - stage.end, stage.end)[side]
                rates.append(change_of_rates(slopes, combine(part, stage.rates, rates)))
            return combine(1.0, [sign * weight for weight in weights], rates)

        A, B = derivative(0, 1.0), derivative(1, -1.0)
        self.jump = program.inputs("jump", (len(equations.jumping),), 1)
        start = A.copy()
        for node, (i, j, _) in zip(self.jump, equations.jumping, strict=True):
            for row in range(n):
                product = apply("mul", int(start[row, i]), int(node))
                A[row, j] = apply("add", int(A[row, j]), product)
        #: the matrix A
        self.matrix = A
        order = _least_fill(np.not_equal(B, zero))
        for at, p in enumerate(order):
            B[p, p] = apply("div", one, int(B[p, p]))
            for i in order[at + 1 :]:
                if B[i, p] == zero:
                    continue
                B[i, p] = apply("mul", int(B[i, p]), int(B[p, p]))
                for j in order[at + 1 :]:
                    product = apply("mul", int(B[i, p]), int(B[p, j]))
                    B[i, j] = apply("sub", int(B[i, j]), product)
        #: factors that are not constant, and their rows and columns
        self.places = [(i, j) for i, j in np.ndindex(B.shape) if not program.is_constant(int(B[i, j]))]
        self.factors = [int(B[i, j]) for i, j in self.places]
        self.stored = program.inputs("factor", (len(self.places),), 1)
        for node, (i, j) in zip(self.stored, self.places, strict=True):
            B[i, j] = node
        #: nonzeros of B⁻¹ A
        self.nonzero = np.not_equal(A, zero)
        #: B⁻¹ r in turn, with the factor's node: x[i] -= factor x[j] or, if i = j, x[i] *= factor
        self.substitution: list[tuple[int, int, int]] = []
        for turn, (i, others) in enumerate(
            [(i, order[:at]) for at, i in enumerate(order)]
            # the number that is known last is needed last
            + [(i, order[:at:-1]) for at, i in reversed(list(enumerate(order)))]
        ):
            for j in others:
                if B[i, j] != zero:
                    self.substitution.append((i, j, int(B[i, j])))
                    self.nonzero[i] |= self.nonzero[j]
            if turn >= n:
                self.substitution.append((i, i, int(B[i, i])))

        def solve(right: list[int]) -> list[int]:
            """Return B⁻¹ times a vector."""
            for i, j, factor in self.substitution:
                product = apply("mul", factor, right[j])
                right[i] = product if i == j else apply("sub", right[i], product)
            return right

        self.r, self.x = program.inputs("r", (n,), 1), program.inputs("x", (n,), 1)
        #: B⁻¹ r
        self.solution = solve([int(node) for node in self.r])
        #: entries of A that are not constant
        self.entries = [(i, j) for i, j in np.ndindex(A.shape) if not program.is_constant(int(A[i, j]))]

        def add_rates(to: list[int], factors: Sequence[float], rates: Sequence[np.ndarray]) -> list[int]:
            """Return numbers plus h Σ factor rate."""
            for factor, rate in zip(factors, rates, strict=False):
                scaled = apply("mul", self.h, program.constant(factor))
                products = (apply("mul", scaled, int(each)) for each in rate)
                to = [apply("add", a, b) for a, b in zip(to, products, strict=True)]
            return to

        start = [int(node) for node in self.x]
        for node, (i, j, _) in zip(self.jump, equations.jumping, strict=True):
            start[i] = apply("add", start[i], apply("mul", int(node), int(self.x[j])))
        rates = [change_of_rates(self.slopes[0], start), np.full(n, zero)]
        for slopes, stage in zip(self.slopes[2:], stages, strict=True):
            part = program.constant(1.0 - stage.end)
            y = add_rates([apply("mul", part, x) for x in start], stage.rates, rates)
            rates.append(change_of_rates(slopes, y))
        right = [apply("add", int(r), x) for r, x in zip(self.r, start, strict=True)]
        #: B⁻¹ (A x + r), with A x by slopes: less to store than A
        self.advance = solve(add_rates(right, weights, rates))


def _least_fill(nonzero: np.ndarray) -> list[int]:
    """Return an order of pivots on the diagonal with little fill-in (Markowitz 1957)."""
    nonzero, rest, order = nonzero.copy(), list(range(len(nonzero))), []
    while rest:
        counts = [(nonzero[rest, k].sum() - 1) * (nonzero[k, rest].sum() - 1) for k in rest]
        best = rest[int(np.argmin(counts))]
        for i in rest:
            if i != best and nonzero[i, best]:
                nonzero[i] |= nonzero[best]
        order.append(best)
        rest.remove(best)
    return order
