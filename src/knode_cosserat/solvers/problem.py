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
from knode_cosserat.solvers.between import along_pieces
from knode_cosserat.solvers.crossing import (
    Points,
    carried_on,
    known_at,
    points_of,
    spread,
    taken,
    within,
)
from knode_cosserat.solvers.space import VALUES, Along, SpaceScheme


class Ahead(NamedTuple):
    """What of the equations was evaluated before a step is solved (`ahead.InTwo`), and the rest of them."""

    #: the rest: y_s and z from (what was evaluated, s, (y, packed record of history))
    then: Callable[[Any, Any, Any], Any]
    #: at the nodes of all strands
    nodes: Any
    #: where pieces begin, are half-way and end
    pieces: tuple[Any, Any, Any]


class StepProblem(eqx.Module):
    """One step: the system, its control, and what the time scheme remembers."""

    system: System
    t: Float[Any, ""]
    control: Float[Any, " c"]
    c0: Float[Any, ""]
    history: Float[Any, "nodes x"]
    space: SpaceScheme = eqx.field(static=True)
    #: what the tip's conditions are to leave: zero, but on the way to a solution
    tip_offset: Any = None
    #: what was evaluated before: nothing, unless it is `ready`
    ahead: Ahead | None = None

    def ready(self) -> StepProblem:
        """The same with all evaluated that depends on neither y nor the past, for what is iterated on."""
        strand, s = self.system.strand, self.arclength

        def at_point(s: Any, state: tuple[Any, Any]) -> Any:
            return self.point_rates(s, *state)

        record = self._past_by_strand(self.history[:1])[0]
        parts = in_two(at_point, s[0], (jnp.zeros(strand.y_layout.size), record))

        def at(*places: Any) -> list[Any]:
            # together, to be compiled once
            found = jax.vmap(parts.first)(jnp.concatenate(places))
            ends = np.cumsum([each.size for each in places])[:-1]
            pieces = [jnp.split(each, ends) for each in found]
            return [[each[k] for each in pieces] for k in range(len(places))]

        # a scheme that asks only for what is known where a piece begins is given that for all of it
        found, *others = at(self._inside, *(self._later if self.space.uses_middle else ()))
        begin = [each[:-1] for each in found]
        if self.space.uses_middle and not self.system.cuts:
            others.append([each[1:] for each in found])
        middle, end = others or (begin, begin)
        nodes = [taken(each, self.points.nodes) for each in found]
        ahead = jax.tree.map(self._each_strand, (nodes, (begin, middle, end)))
        return dataclasses.replace(self, ahead=Ahead(parts.then, *ahead))

    def point_rates(self, s: Any, y: Float[Any, " y"], history: Float[Any, " x"]) -> Any:
        """y_s and z at one point of a strand, from a packed record of its history."""
        strand = self.system.strand
        return strand.derivatives(s, self.t, y, self.control, unpacked_history(strand, self.c0, history))

    def _unpack(self, history: Float[Any, " x"]) -> History:
        return unpacked_history(self.system, self.c0, history)

    def base(self, unknowns: Float[Any, " k"]) -> Float[Any, " y"]:
        """y at the first node, for these unknowns."""
        return self.system.base(self.t, self.control, unknowns, self._unpack(self.history[0]))

    def tip_residual(self, y: Float[Any, " y"]) -> Float[Any, " k"]:
        """What is left of the tip's conditions at this y of the last node."""
        left = self.system.tip(self.t, self.control, y, self._unpack(self.history[-1]))
        return left if self.tip_offset is None else left - self.tip_offset

    def crossed(self, acting: Any, y: Float[Any, " y"], history: Float[Any, " x"]) -> Float[Any, " y"]:
        """y on the far side of the cuts that are acting."""
        if not self.system.jumps:
            return y
        return self.system.crossed(acting, self.t, y, self.control, self._unpack(history))

    @property
    def arclength(self) -> Float[Any, " nodes"]:
        """s at the nodes (m)."""
        return jnp.linspace(0.0, 1.0, self.system.nodes) * self.system.length

    @property
    def points(self) -> Points:
        """Where y is unknown: the nodes, and the cuts between them."""
        return points_of(self.system)

    def filled(self, y: Float[Any, "nodes y"]) -> Float[Any, "points y"]:
        """y at all points from that at the nodes: at a cut as carried there from the node before it."""
        points, found = self.points, spread(self.points, y)
        between = np.ones(len(points.segment), dtype=bool)
        between[points.nodes[1:] - 1] = False
        # one cut after the other, of all segments together
        for _ in range(np.max(np.diff(points.nodes)) - 1):
            reached = self.pieces(VALUES, found).reshape(found[1:].shape)
            found = found.at[1:].set(jnp.where(between[:, None], reached, found[1:]))
        return found

    def pieces(self, along: Along, y: Float[Any, "points y"]) -> Any:
        """What `along` makes of y at the points by the ends of all pieces of all strands, those inside."""
        low, high = self._ends
        acting = jnp.asarray(self.points.acting)
        past = along_pieces(self.system, self.space, self.history)
        lanes = (self._each_strand(low), self._by_strand(y[:-1]), *map(self._past_by_strand, past))

        def piece(ahead: Any, high: Any, acting: Any, low: Any, y: Any, *history: Any) -> Any:
            def advance(y: Any) -> Any:
                if not self.system.cuts:
                    return self.space.advance(self._rates, low, self._ds, y, known_at(history, ahead))
                where = low, high
                return carried_on(self.space, self._rates, self.crossed, acting, where, y, history, ahead)

            return along.on(advance, along.begin(y))

        ahead = None if self.ahead is None else self.ahead.pieces
        return _side_by_side(piece, lanes, ahead, self._each_strand(high), self._each_strand(acting))

    def _rates(self, s: Any, y: Any, known: Any) -> Any:
        return self._at_point(s, y, *known)[0]

    def _at_point(self, s: Any, y: Any, history: Any, ahead: Any) -> Any:
        """`point_rates`, with what was evaluated before."""
        if self.ahead is None:
            return self.point_rates(s, y, history)
        return self.ahead.then(ahead, s, (y, history))

    @property
    def _ds(self) -> Any:
        return self.system.length / (self.system.nodes - 1)

    @property
    def _ends(self) -> tuple[Any, Any]:
        """Where pieces begin and end (m)."""
        if not self.system.cuts:
            return self.arclength[:-1], self.arclength[1:]
        low, high = (self._ds * (self.points.segment + self.points.bounds[:, k]) for k in (0, 1))
        return low, high

    @property
    def _inside(self) -> Any:
        """Where the equations are evaluated for the points: on the far side of cuts, but at the tip."""
        if not self.system.cuts:
            return self.arclength
        low, high = self._ends
        return jnp.concatenate([within(low, low, high), within(high, low, high)[-1:]])

    @property
    def _later(self) -> tuple[Any, ...]:
        """Where pieces are half-way and, if that is not where the next one begins, end."""
        low, high = self._ends
        middle = (low + high) / 2
        return (middle, within(high, low, high)) if self.system.cuts else (middle,)

    def at_nodes(self, function: Callable[..., Any], y: Float[Any, "nodes y"]) -> Any:
        """Apply `function(s, y, record of history)` to all nodes of all strands (strands inside)."""
        at = self._each_strand(self.arclength), self._by_strand(y), self._past_by_strand(self.history)
        return jax.vmap(function)(*at)

    def _each_strand(self, values: Shaped[Any, "n ..."]) -> Shaped[Any, "n_strands ..."]:
        return jnp.repeat(values, self.system.strands, axis=0) if self.system.strands > 1 else values

    def _by_strand(self, rows: Float[Any, "n x"]) -> Float[Any, "n_strands x_of_strand"]:
        own = in_strands(self.system, rows)
        return own.reshape(-1, own.shape[-1])

    def _past_by_strand(self, rows: Float[Any, "n x"]) -> Float[Any, "n_strands x_of_strand"]:
        own = records_in_strands(self.system, rows)
        return own.reshape(-1, own.shape[-1])

    def record(self, y: Float[Any, "points y"]) -> Float[Any, "nodes x"]:
        """What must be kept of a solved step at every node: y, z and, if B is not zero, y_s."""
        nodes = self.points.nodes
        y, inside = taken(y, nodes), taken(self._inside, nodes)
        beyond = y
        if self.system.cuts:
            acting = jnp.asarray(self.points.acting[nodes[:-1]])
            beyond = jnp.concatenate([jax.vmap(self.crossed)(acting, y[:-1], self.history[:-1]), y[-1:]])
        at = self._each_strand(inside), self._by_strand(beyond), self._past_by_strand(self.history)
        rates = jax.vmap(self._at_point)(*at, None if self.ahead is None else self.ahead.nodes)
        y_s, z = (part.reshape(y.shape[0], -1) for part in rates)
        return jnp.concatenate([y, z, y_s] if self.system.mixed else [y, z], axis=1)


def _side_by_side(each: Callable[..., Any], lanes: tuple[Any, ...], *more: Any) -> Any:
    """`each(*more, *lanes)` of all rows; arclength first, then rows of numbers."""
    s, *rows = lanes
    # nodes last inside: XLA then vectorises over them
    axes = (*(0 for _ in more), 0, *(-1 for _ in rows))
    return jax.vmap(each, in_axes=axes)(*more, s, *(row.T for row in rows))
