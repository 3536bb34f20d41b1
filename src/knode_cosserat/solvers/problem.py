"""The equations of one time step along the rod: what Newton's method (`boundary`) solves."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Shaped

from knode_cosserat.rods.system import (
    History,
    System,
    in_strands,
    records_in_strands,
    unpacked_history,
)
from knode_cosserat.solvers.ahead import in_two
from knode_cosserat.solvers.between import at_stages
from knode_cosserat.solvers.crossing import Points, carried_on, points_of, spread, taken, within
from knode_cosserat.solvers.space import VALUES, Along, SpaceScheme
from knode_cosserat.solvers.time import TimeScheme


class Ahead(NamedTuple):
    """What of the equations was evaluated before a step is solved (`ahead.InTwo`), and the rest of them."""

    #: the rest: y_s and z from (what was evaluated, s, (y, packed record of history))
    then: Callable[[Any, Any, Any], Any]
    #: at the stages of the pieces of all strands, and of the points
    pieces: Any
    points: Any


def no_history(system: System, space: SpaceScheme) -> Float[Any, "stages points x"]:
    """That of an equilibrium."""
    ny, nz = system.y_layout.size, system.z_layout.size
    count = len(points_of(system).segment) + 1
    return jnp.zeros((len(space.parts), count, ny + nz + (ny if system.mixed else 0)))


def keeps_stages(system: System, time: TimeScheme, space: SpaceScheme) -> bool:
    """Whether the past is kept at the stages of the scheme along the rod, or interpolated between nodes.

    What stages after the first find is of low order, and lets waves grow that no segment resolves. A scheme
    in time without memory of rates damps what is so fast; others do not, and waves of strings, systems with
    y_st, are slow.
    """
    return len(space.parts) == 1 or not (time.uses_rate or system.mixed)


def row_of(
    system: System, y: Float[Any, "points y"], records: Float[Any, "stages points x"]
) -> Float[Any, "nodes x"]:
    """What is shown of a solved step: y at the nodes, on the near side of cuts, z and y_s on the far."""
    nodes, ny = points_of(system).nodes, system.y_layout.size
    return jnp.concatenate([taken(y, nodes), taken(records[0], nodes)[:, ny:]], axis=1)


class StepProblem(eqx.Module):
    """One step: the system, its control, and what the time scheme remembers."""

    system: System
    t: Float[Any, ""]
    control: Float[Any, " c"]
    c0: Float[Any, ""]
    #: at the stages of each point: those of the piece that begins there, and at the tip of one without length
    history: Float[Any, "stages points x"]
    space: SpaceScheme = eqx.field(static=True)
    #: what the tip's conditions are to leave: zero, but on the way to a solution
    tip_offset: Any = None
    #: what was evaluated before: nothing, unless it is `ready`
    ahead: Ahead | None = None
    #: whether stages between nodes look back on themselves, or on what the nodes say (`keeps_stages`)
    own_past: bool = eqx.field(static=True, default=True)

    @classmethod
    def still(
        cls, system: System, space: SpaceScheme, control: Any, t: Any = 0.0, **options: Any
    ) -> StepProblem:
        """That of an equilibrium: nothing moves, and nothing did."""
        t, c0 = jnp.asarray(t, dtype=float), jnp.zeros(())
        return cls(system, t, jnp.asarray(control), c0, no_history(system, space), space, **options)

    def ready(self) -> StepProblem:
        """The same with all evaluated that depends on neither y nor the past, for what is iterated on."""
        strand, (places, stages) = self.system.strand, self._places

        def at_point(s: Any, state: tuple[Any, Any]) -> Any:
            return self.point_rates(s, *state)

        record = self._past_by_strand(self.history[:1, :1])[0, 0]
        parts = in_two(at_point, places[0], (jnp.zeros(strand.y_layout.size), record))
        # together, to be compiled once
        found = [
            jnp.stack([taken(each, stage) for stage in stages]) for each in jax.vmap(parts.first)(places)
        ]
        points = [self._each_strand(each, axis=1) for each in found]
        pieces = [self._each_strand(each[:, :-1], axis=1) for each in found]
        return dataclasses.replace(self, ahead=Ahead(parts.then, pieces, points))

    def point_rates(self, s: Any, y: Float[Any, " y"], history: Float[Any, " x"]) -> Any:
        """y_s and z at one point of a strand, from a packed record of its history."""
        strand = self.system.strand
        return strand.derivatives(s, self.t, y, self.control, unpacked_history(strand, self.c0, history))

    def _unpack(self, history: Float[Any, " x"]) -> History:
        return unpacked_history(self.system, self.c0, history)

    def base(self, unknowns: Float[Any, " k"]) -> Float[Any, " y"]:
        """y at the first node, for these unknowns."""
        return self.system.base(self.t, self.control, unknowns, self._unpack(self.history[0, 0]))

    def tip_residual(self, y: Float[Any, " y"]) -> Float[Any, " k"]:
        """What is left of the tip's conditions at this y of the last node."""
        left = self.system.tip(self.t, self.control, y, self._unpack(self.history[0, -1]))
        return left if self.tip_offset is None else left - self.tip_offset

    def crossed(self, acting: Any, y: Float[Any, " y"], history: Float[Any, " x"]) -> Float[Any, " y"]:
        """y on the far side of the cuts that are acting."""
        if not self.system.jumps:
            return y
        return self.system.crossed(acting, self.t, y, self.control, self._unpack(history))

    # where

    @property
    def arclength(self) -> Float[Any, " nodes"]:
        """s at the nodes (m)."""
        return jnp.linspace(0.0, 1.0, self.system.nodes) * self.system.length

    @property
    def points(self) -> Points:
        """Where y is unknown: the nodes, and the cuts between them."""
        return points_of(self.system)

    @property
    def _ends(self) -> tuple[Any, Any]:
        """Where the pieces of all points begin and end (m); that of the tip has no length."""
        if not self.system.cuts:
            low = self.arclength
            return low, jnp.concatenate([low[1:], low[-1:]])
        ds = self.system.length / (self.system.nodes - 1)
        low, high = (ds * (self.points.segment + self.points.bounds[:, k]) for k in (0, 1))
        # on the near side of what may jump there
        tip = within(high[-1:], low[-1:], high[-1:])
        return jnp.concatenate([low, tip]), jnp.concatenate([high, tip])

    @property
    def _places(self) -> tuple[Any, np.ndarray]:
        """Where the equations are evaluated (m), each place once, and which of them is each point's stage."""
        (low, high), parts = self._ends, np.unique(self.space.parts)
        count, which = len(self.points.segment) + 1, np.searchsorted(parts, self.space.parts)
        stages = which[:, None] * count + np.arange(count)
        places = [low + part * (high - low) for part in parts]
        if self.system.cuts:
            places = [within(each, low, high) for each in places]
        elif len(parts) > 1 and parts[-1] == 1.0:
            # the end of a piece is where the next one begins
            places.pop()
            stages[which == which.max()] = np.minimum(np.arange(count) + 1, count - 1)
        return jnp.concatenate(places), stages

    @property
    def stages(self) -> Float[Any, "stages points"]:
        """Where the equations are evaluated (m)."""
        places, stages = self._places
        return places[stages]

    # along the rod

    def filled(self, y: Float[Any, "nodes y"]) -> Float[Any, "points y"]:
        """y at all points from that at the nodes: at a cut as carried there from the node before it."""
        points, found = self.points, spread(self.points, y)
        between = np.ones(len(points.segment), dtype=bool)
        between[points.nodes[1:] - 1] = False
        # one cut after the other, of all segments together
        for _ in range(np.max(np.diff(points.nodes)) - 1):
            found = found.at[1:].set(jnp.where(between[:, None], self.reached(found), found[1:]))
        return found

    def reached(self, y: Float[Any, "points y"]) -> Float[Any, "pieces y"]:
        """y by the ends of all pieces."""
        return self.pieces(VALUES, y).reshape(y[1:].shape)

    def pieces(self, along: Along, y: Float[Any, "points y"]) -> Any:
        """What `along` makes of y at the points by the ends of all pieces of all strands, those inside."""

        def rates(s: Any, y: Any, known: Any) -> Any:
            return self._at_point(s, y, *known)[0], None

        def piece(advance: Callable[[Any], Any], y: Any) -> Any:
            return along.on(lambda y: advance(y)[0], along.begin(y))

        low, high = (each[:-1] for each in self._ends)
        ahead = None if self.ahead is None else self.ahead.pieces
        lanes = low, high, jnp.asarray(self.points.acting), y[:-1], self.history[:, :-1], ahead
        return self._side_by_side(piece, rates, lanes, 0)

    def records(self, y: Float[Any, "points y"]) -> Float[Any, "stages points x"]:
        """What must be kept of a solved step at every stage: y, z and, if B is not zero, y_s."""
        found = self._at_stages(y)
        return found if self.own_past else at_stages(self.system, self.space, row_of(self.system, y, found))

    def _at_stages(self, y: Float[Any, "points y"]) -> Float[Any, "stages points x"]:
        """y, z and, if B is not zero, y_s, as the stages have them."""

        def rates(s: Any, y: Any, known: Any) -> Any:
            y_s, z = self._at_point(s, y, *known)
            return y_s, (y, z, y_s) if self.system.mixed else (y, z)

        ahead = None if self.ahead is None else self.ahead.points
        acting = np.concatenate([self.points.acting, np.zeros_like(self.points.acting[:1])])
        lanes = *self._ends, jnp.asarray(acting), y, self.history, ahead
        found = self._side_by_side(lambda advance, y: advance(y)[1], rates, lanes, 1)
        shape = self.history.shape[:2]
        return jnp.concatenate([each.reshape(*shape, -1) for each in found], axis=-1)

    def records_between(self, y: Float[Any, "points y"]) -> Float[Any, "stages points x"]:
        """As `records`, of equations that these y do not solve.

        What is missing by a piece's end is added to y along it, and the rest is evaluated there.
        """
        ny = self.system.y_layout.size
        gap = jnp.pad(y[1:] - self.reached(y), ((0, 1), (0, 0)))
        parts = np.array(self.space.parts)[:, None, None]
        own = self._at_stages(y)[..., :ny] + parts * gap

        def at_stage(s: Any, y: Any, history: Any) -> Any:
            rates = jax.vmap(self.point_rates)(self._each_strand(s), self._by_strand(y), history)
            y_s, z = (each.reshape(len(s), -1) for each in rates)
            return (y, z, y_s) if self.system.mixed else (y, z)

        found = jax.vmap(at_stage)(self.stages, own, self._past_by_strand(self.history))
        return jnp.concatenate(found, axis=-1)

    def _side_by_side(self, each: Any, rates: Any, lanes: tuple[Any, ...], out: int) -> Any:
        """`each(advance, y)` of the pieces of all strands, `advance` by these rates; stacked along `out`."""
        low, high, acting, y, history, ahead = lanes

        def piece(low: Any, high: Any, acting: Any, y: Any, history: Any, ahead: Any) -> Any:
            known = history, ahead

            def advance(y: Any) -> Any:
                if not self.system.cuts:
                    return self.space.advance(rates, low, high - low, y, known)
                beyond = self.crossed(acting, y, history[0])
                return carried_on(self.space, rates, (low, high), beyond, known)

            return each(advance, y)

        # nodes last inside: XLA then vectorises over them
        side_by_side = jax.vmap(piece, in_axes=(0, 0, 0, -1, -1, 1), out_axes=out)
        low, high, acting = map(self._each_strand, (low, high, acting))
        past = jnp.moveaxis(self._past_by_strand(history), 1, -1)
        return side_by_side(low, high, acting, self._by_strand(y).T, past, ahead)

    def _at_point(self, s: Any, y: Any, history: Any, ahead: Any) -> Any:
        """`point_rates`, with what was evaluated before."""
        if self.ahead is None:
            return self.point_rates(s, y, history)
        return self.ahead.then(ahead, s, (y, history))

    def at_nodes(self, function: Callable[..., Any], y: Float[Any, "nodes y"], history: Any) -> Any:
        """Apply `function(s, y, record of history)` to all nodes of all strands (strands inside)."""
        past = self._past_by_strand(history[None])[0]
        return jax.vmap(function)(self._each_strand(self.arclength), self._by_strand(y), past)

    def _each_strand(self, values: Shaped[Any, "..."], axis: int = 0) -> Shaped[Any, "..."]:
        return jnp.repeat(values, self.system.strands, axis=axis) if self.system.strands > 1 else values

    def _by_strand(self, rows: Float[Any, "n x"]) -> Float[Any, "n_strands x_of_strand"]:
        own = in_strands(self.system, rows)
        return own.reshape(-1, own.shape[-1])

    def _past_by_strand(self, records: Float[Any, "stages n x"]) -> Float[Any, "stages n_strands own"]:
        own = records_in_strands(self.system, records)
        return own.reshape(len(records), -1, own.shape[-1])
