"""Tangents of one solved time step, by the implicit function theorem.

A solved step satisfies G(y, ξ; history, control, parameters) = 0. The derivatives of the equations at every
place, with respect to the y, history and control there, are evaluated once for a step. Each tangent then
costs products of small matrices only, so that many columns cost little more than one.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.system import System
from knode_cosserat.solvers.boundary import pivots_of
from knode_cosserat.solvers.linear import factored, solved_correction
from knode_cosserat.solvers.problem import Stages, StepProblem


class Slopes(NamedTuple):
    """Values and derivatives of x = [y_s; z] of the strands at some places."""

    f: Float[Any, "n y"]
    z: Float[Any, "n z"]
    by_y: Float[Any, "n_strands x_of_strand used"]
    by_history: Float[Any, "n_strands x_of_strand used_history"]
    by_control: Float[Any, "n_strands x_of_strand c"]


class Moves(NamedTuple):
    """Tangents of the data of a step: history terms, control, and the system by `SystemMoves`."""

    history: Float[Any, "used x ..."]
    control: Float[Any, "c ..."]
    #: weights of the directions of `SystemMoves`
    weights: Float[Any, "directions ..."]


class SystemMoves(NamedTuple):
    """Directions in which the system changes, and the weight of each in one tangent.

    The equations are differentiated once for each direction, whatever the number of tangents.
    """

    #: tangent systems, stacked; None: the system does not change
    directions: Any
    weights: Float[Any, "directions ..."]

    @classmethod
    def of(cls, d_system: Any) -> SystemMoves:
        """Return one direction with the weight one, or none."""
        if d_system is None:
            return cls(None, np.zeros(0))
        return cls(jax.tree.map(lambda leaf: leaf[None], d_system), np.ones(1))


def _columns(matrices: Any, vectors: Any) -> Any:
    """Return the products of many matrices with a vector each."""
    return (matrices @ vectors[..., None])[..., 0]


class StepTangent:
    """Linear map from the tangents of a step's data to those of its solution."""

    def __init__(
        self, problem: StepProblem, y: Float[Any, "points y"], unknowns: Float[Any, " k"], directions: Any
    ):
        """Linearise the equations of a solved step at every place that the scheme uses.

        `directions` are those of `SystemMoves`.
        """
        self.problem, self.y, self.unknowns = problem.ready(), y, unknowns
        self.formula = problem.space.formula
        self._slopes: list[Slopes] = []
        self.found = self._along(y, self.problem.far(y), self._evaluated)
        self._by_system = None if directions is None else jax.vmap(self._of_system)(directions)
        self._factors = factored(self.problem.linearise(y, unknowns), pivots_of(problem.system))

    def _along(self, y: Any, far: Any, evaluate: Callable[[slice, Any], tuple[Any, Any]]) -> Stages:
        """Return the stages of the formula, their rates from a function of places and y."""
        problem = self.problem
        lanes, ends = problem.all_ends(y, far)
        found = Stages([ends], *([each] for each in evaluate(lanes, ends)))
        rates = [*problem.at_ends(found.f[0])]
        for k, stage in enumerate(self.formula.stages):
            between = problem.between(stage, ends[: problem.grid.tip], y[1:], rates)
            f, z = evaluate(problem.grid.stage(k), between)
            rates.append(f)
            for values, new in zip(found, (between, f, z), strict=True):
                values.append(new)
        return found

    def _evaluated(self, lanes: slice, y: Any) -> tuple[Any, Any]:
        self._slopes.append(place_slopes(self.problem, lanes, y))
        return self._slopes[-1].f, self._slopes[-1].z

    def _chained(self, d_y: Any, moves: Moves) -> Stages:
        """Return the tangents of all stages, by the chain rule; the system does not change."""
        problem, given = self.problem, iter(self._slopes)

        def evaluate(lanes: slice, d_lane: Any) -> tuple[Any, Any]:
            return _moved(problem, next(given), d_lane, moves.history[lanes], moves.control)

        return self._along(d_y, self._d_far(d_y, moves), evaluate)

    def _d_far(self, d_y: Any, moves: Moves) -> Any:
        if not self.problem.system.jumps:
            return d_y[:-1]

        def far(y: Any, history: Any, control: Any) -> Any:
            return self.problem.with_data(history, control).far(y)

        at = self.y, self.problem.history, self.problem.control
        return jax.jvp(far, at, (d_y, moves.history, moves.control))[1]

    def _ends(self, moves: Moves) -> tuple[Any, Any]:
        """Return the tangents of the tip's residual and of y at the base, at fixed y and unknowns."""

        def ends(history: Any, control: Any) -> Any:
            problem = self.problem.with_data(history, control)
            return problem.tip_residual(self.y[-1]), problem.base(self.unknowns)

        at = self.problem.history, self.problem.control
        return jax.jvp(ends, at, (moves.history, moves.control))[1]

    def _of_system(self, d_system: Any) -> Any:
        """Return the tangents of stages, reached y, tip and base by the system, at fixed y and unknowns."""

        def values(system: System) -> Any:
            problem = self.problem.of_system(system)
            found = problem.stages(self.y, self.formula, problem.ends(self.y))
            reached = problem.reached_by(self.formula, found)
            return found, reached, problem.tip_residual(self.y[-1]), problem.base(self.unknowns)

        return jax.jvp(values, (self.problem.system,), (d_system,))[1]

    def solved(self, moves: Moves) -> tuple[Any, Any, Any]:
        """Return the tangents of y, of the unknowns, and of the records at the places of the scheme.

        Many tangents at once have one more axis everywhere, the last.
        """
        many = moves.control.ndim > 1

        def each(function: Callable[..., Any]) -> Callable[..., Any]:
            return jax.vmap(function, in_axes=-1, out_axes=-1) if many else function

        of_system = each(self._weighted)(moves.weights)
        reached, tip, base = each(self._sources)(moves, of_system)
        pivots = pivots_of(self.problem.system)
        d_y, d_unknowns = solved_correction(self._factors, pivots, reached, tip, base)
        return d_y, d_unknowns, each(self._records)(d_y, moves, of_system)

    def _weighted(self, weights: Any) -> Any:
        """Return the tangents by the system, for weights of its directions; None: it does not change."""
        if self._by_system is None:
            return None
        return jax.tree.map(lambda leaf: jnp.tensordot(weights, leaf, 1), self._by_system)

    def _sources(self, moves: Moves, of_system: Any) -> tuple[Any, Any, Any]:
        """Return the tangents of reached y, tip and base at fixed y and unknowns."""
        reached = self.problem.reached_by(self.formula, self._chained(jnp.zeros_like(self.y), moves))
        sources = reached, *self._ends(moves)
        return sources if of_system is None else jax.tree.map(jnp.add, sources, of_system[1:])

    def _records(self, d_y: Any, moves: Moves, of_system: Any) -> Any:
        found = self._chained(d_y, moves)
        if of_system is not None:
            found = jax.tree.map(jnp.add, found, of_system[0])
        return self.problem.packed(found)


def place_slopes(problem: StepProblem, lanes: slice, y: Float[Any, "n y"]) -> Slopes:
    """Return x = [y_s; z] at places, and its derivatives by y, history and control there."""
    strand, columns, of_history = problem.system.strand, problem.columns, problem.history_columns
    sizes = len(columns), len(of_history), problem.system.control_size
    directions = jnp.eye(sum(sizes))

    def at_place(s: Any, y: Any, record: Any) -> Any:
        def moved(change: Any) -> Any:
            d_y, d_record, d_control = jnp.split(change, np.cumsum(sizes)[:-1])
            now = problem.with_data(problem.history, problem.control + d_control)
            x = now.point_rates(s, y.at[columns].add(d_y), record.at[of_history].add(d_record))
            return jnp.concatenate(x)

        def along(direction: Any) -> Any:
            return jax.jvp(moved, (jnp.zeros(sum(sizes)),), (direction,))

        return jax.vmap(along, out_axes=(None, -1))(directions)

    s, own, records = problem.lanes(lanes, y)
    # places last inside: XLA then vectorises over them
    x, by = jax.vmap(at_place, in_axes=(0, -1, -1), out_axes=-1)(s, own.T, records.T)
    ny = strand.y_layout.size
    f, z = (part.T.reshape(y.shape[0], -1) for part in (x[:ny], x[ny:]))
    by = jnp.moveaxis(by, -1, 0)
    return Slopes(f, z, *jnp.split(by, np.cumsum(sizes)[:-1], axis=-1))


def _moved(problem: StepProblem, slopes: Slopes, d_y: Any, d_history: Any, d_control: Any) -> tuple[Any, Any]:
    """Return the tangents of f and z at places."""
    d_own, d_records = problem.by_strand(d_y), problem.history_by_strand(d_history)
    moved = _columns(slopes.by_y, d_own[:, problem.columns])
    moved += _columns(slopes.by_history, d_records[:, problem.history_columns])
    moved += _columns(slopes.by_control, jnp.broadcast_to(d_control, (moved.shape[0], *d_control.shape)))
    ny = problem.system.strand.y_layout.size
    f, z = (part.reshape(d_y.shape[0], -1) for part in (moved[:, :ny], moved[:, ny:]))
    return f, z
