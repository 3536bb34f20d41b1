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
from knode_cosserat.solvers.crossing import (
    carried_part,
    crossing_of,
    known_at,
    rounds_of,
    taken,
    within,
)
from knode_cosserat.solvers.space import Along, SpaceScheme, middles


class Ahead(NamedTuple):
    """What of the equations was evaluated before a step is solved (`ahead.InTwo`), and the rest of them."""

    #: the rest: y_s and z from (what was evaluated, s, (y, packed record of history))
    then: Callable[[Any, Any, Any], Any]
    #: at the nodes of all strands
    nodes: Any
    #: where segments, or parts of them in their rounds, begin, are half-way and end
    segments: tuple[Any, Any, Any]


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

        record = self._past_points(self.history[:1])[0]
        parts = in_two(at_point, s[0], (jnp.zeros(strand.y_layout.size), record))

        def at(*places: Any) -> list[Any]:
            # together, to be compiled once
            found = jax.vmap(parts.first)(jnp.concatenate([each.reshape(-1) for each in places]))
            ends = np.cumsum([each.size for each in places])[:-1]
            pieces = [jnp.split(each, ends) for each in found]
            return [
                [each[k].reshape(*like.shape, *each[k].shape[1:]) for each in pieces]
                for k, like in enumerate(places)
            ]

        # a scheme that asks only for what is known where a segment begins is given that for all of it
        everywhere = self.space.uses_middle
        if self.system.cuts:
            places = self._part_places()
            nodes, begin, *others = at(self._inside, *(places if everywhere else places[:1]))
        else:
            nodes, *others = at(s, (s[:-1] + s[1:]) / 2) if everywhere else at(s)
            begin, end = ([each[rows] for each in nodes] for rows in (np.s_[:-1], np.s_[1:]))
            others = [*others, end] if everywhere else []
        middle, end = others or (begin, begin)
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

    def segments(self, along: Along, y: Float[Any, "nodes y"]) -> Any:
        """What `along` makes of y at the nodes by the ends of all segments of all strands, those inside."""
        s = self._each_strand(self.arclength[:-1])
        inner = middles(self.history) if self.space.uses_middle else self.history[:-1]
        past = (self._past_points(rows) for rows in (self.history[:-1], inner, self.history[1:]))
        lanes = (s, self._points(y[:-1]), *past)
        ahead = None if self.ahead is None else self.ahead.segments
        if self.system.cuts:
            return self._in_rounds(along, lanes, ahead)

        def segment(ahead: Any, s_j: Any, y_j: Any, *history: Any) -> Any:
            def advance(y: Any) -> Any:
                return self.space.advance(self._rates, s_j, self._ds, y, known_at(history, ahead))

            return along.on(advance, along.begin(y_j))

        return _side_by_side(segment, lanes, ahead)

    def _in_rounds(self, along: Along, lanes: tuple[Any, ...], ahead: Any) -> Any:
        """The same of segments that are parted, or where y jumps."""
        rounds = rounds_of(self.system.cuts, self.system.nodes)
        parted = len(rounds.segment) > 1

        def part(state: Any, begins: Any, part: Any, ahead: Any, s_j: Any, y_j: Any, *history: Any) -> Any:
            def advance(y: Any) -> Any:
                where = s_j, self._ds
                return carried_part(
                    self.space, self._rates, self.crossed, part, where, y, history, parted, ahead
                )

            begun = along.begin(y_j)
            if parted:
                begun = jax.tree.map(lambda new, old: jnp.where(begins, new, old), begun, state)
            return along.on(advance, begun)

        def one(state: Any, given: Any) -> Any:
            *steered, lanes = given
            state = _side_by_side(part, lanes, state, *steered)
            return state, state

        shape, rows = rounds.segment.shape, rounds.segment.reshape(-1)
        lanes = tuple(taken(each, rows).reshape(*shape, *each.shape[1:]) for each in lanes)
        parts = (rounds.bounds[..., 0], rounds.bounds[..., 1], rounds.acting)
        given = jax.tree.map(jnp.asarray, (rounds.begins, parts, ahead, lanes))
        first = jax.vmap(along.begin)(lanes[1][0])
        if not parted:
            return one(first, jax.tree.map(lambda each: each[0], given))[0]
        _, found = jax.lax.scan(one, first, given)
        return jax.tree.map(lambda each: taken(each.reshape(-1, *each.shape[2:]), rounds.last), found)

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
    def _inside(self) -> Any:
        """Where the equations are evaluated for the nodes: on the far side of cuts, but at the tip."""
        s = self.arclength
        if not self.system.cuts:
            return s
        return jnp.concatenate([within(s[:-1], s[:-1], s[1:]), within(s[-1:], s[-2:-1], s[-1:])])

    def _part_places(self) -> tuple[Any, Any, Any]:
        """Where all parts of segments begin, are half-way and end, (rounds, places) each."""
        rounds = rounds_of(self.system.cuts, self.system.nodes)
        low, high = (self._ds * (rounds.segment + rounds.bounds[..., k]) for k in range(2))
        return within(low, low, high), (low + high) / 2, within(high, low, high)

    def at_points(self, function: Callable[..., Any], y: Float[Any, "nodes y"]) -> Any:
        """Apply `function(s, y, record of history)` to all nodes of all strands (strands inside)."""
        at = self._each_strand(self.arclength), self._points(y), self._past_points(self.history)
        return jax.vmap(function)(*at)

    def _each_strand(self, values: Shaped[Any, "n ..."]) -> Shaped[Any, "points ..."]:
        return jnp.repeat(values, self.system.strands, axis=0) if self.system.strands > 1 else values

    def _points(self, rows: Float[Any, "n x"]) -> Float[Any, "points x_of_strand"]:
        own = in_strands(self.system, rows)
        return own.reshape(-1, own.shape[-1])

    def _past_points(self, rows: Float[Any, "n x"]) -> Float[Any, "points x_of_strand"]:
        own = records_in_strands(self.system, rows)
        return own.reshape(-1, own.shape[-1])

    def record(self, y: Float[Any, "nodes y"]) -> Float[Any, "nodes x"]:
        """What must be kept of a solved step at every node: y, z and, if B is not zero, y_s."""
        beyond, crossings = y, crossing_of(self.system)
        if crossings is not None:
            acting = jnp.asarray(crossings.acting[:, 0])
            beyond = jnp.concatenate([jax.vmap(self.crossed)(acting, y[:-1], self.history[:-1]), y[-1:]])
        points = self._each_strand(self._inside), self._points(beyond), self._past_points(self.history)
        rates = jax.vmap(self._at_point)(*points, None if self.ahead is None else self.ahead.nodes)
        y_s, z = (part.reshape(y.shape[0], -1) for part in rates)
        return jnp.concatenate([y, z, y_s] if self.system.mixed else [y, z], axis=1)


def _side_by_side(each: Callable[..., Any], lanes: tuple[Any, ...], *more: Any) -> Any:
    """`each(*more, *lanes)` of all rows; arclength first, then rows of numbers."""
    s, *rows = lanes
    # nodes last inside: XLA then vectorises over them
    axes = (*(0 for _ in more), 0, *(-1 for _ in rows))
    return jax.vmap(each, in_axes=axes)(*more, s, *(row.T for row in rows))
