"""One-segment samples of trajectories: the true states at both ends of every segment.

A sample is one segment of the rod at one time. From the true y at its start, with the true history, a model
predicts y at its end and z at its start (`predict_segment`). Integration spans one segment only, so that
errors do not accumulate and all samples are predicted in parallel.

A trajectory holds y on the near side of a discontinuity and z on the far side. A segment starts on the far
side, and its sample has y there.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.errors import KnodeCosseratError
from knode_cosserat.rods.strands import in_strands, strand_count
from knode_cosserat.rods.system import System
from knode_cosserat.schemes import semi_discrete
from knode_cosserat.schemes.grid import ON_NODE, at_places, grid_of, inside
from knode_cosserat.schemes.history import coefficient_table, history_of
from knode_cosserat.schemes.semi_discrete import History, Point, records_in_strands, unpacked_history
from knode_cosserat.schemes.settings import MEASURED, Settings
from knode_cosserat.schemes.space import SpaceScheme
from knode_cosserat.solvers.replay import replay, replayed_settings
from knode_cosserat.trajectory import Trajectory


class DataError(KnodeCosseratError, ValueError):
    """Unusable trajectories. The message is one line: the trajectory, the place and the reason."""

    code = "training-data"


class Samples(NamedTuple):
    """Segments (S) of all trajectories, in the order trajectory, row, segment."""

    #: start of the segment, as a part of the length
    place: Float[Any, " S"]
    t: Float[Any, " S"]
    c0: Float[Any, " S"]
    #: y at the segment's start, on the far side of a discontinuity there
    y: Float[Any, "S y"]
    z: Float[Any, "S z"]
    #: y at the segment's end, on the near side of a discontinuity there
    y_next: Float[Any, "S y"]
    #: z at the segment's end, on the far side of a discontinuity there
    z_next: Float[Any, "S z"]
    #: y_s times the length at the segment's start, from the states alone
    slope: Float[Any, "S y"]
    control: Float[Any, "S c"]
    #: packed records of history at the places (start, end, stages between) of its first piece
    history: Float[Any, "S places x"]
    #: records of history of its other pieces, if the robot has discontinuities inside segments
    later: Float[Any, "S pieces-1 places x"]
    #: one over the number of samples of the same trajectory
    weight: Float[Any, " S"]
    #: indices of the trajectory and of its row
    origin: Any


class TipSamples(NamedTuple):
    """The last node of every row (S)."""

    t: Float[Any, " S"]
    c0: Float[Any, " S"]
    y: Float[Any, "S y"]
    control: Float[Any, "S c"]
    history: Float[Any, "S x"]
    weight: Float[Any, " S"]
    origin: Any


@dataclasses.dataclass(frozen=True)
class Dataset:
    """All samples of some trajectories, and the scheme that carries y over a segment."""

    segments: Samples
    tips: TipSamples
    space: SpaceScheme
    #: estimated error of `Samples.slope` (rms)
    doubt: Float[Any, " y"]


#: Newton's corrections of y at a discontinuity inside a segment
CORRECTIONS = 4


# points where a system's equations are evaluated


def start_point(system: System, sample: Samples) -> Point:
    """Return the point at a segment's start; slightly inside if the rod has discontinuities."""
    s, ds = sample.place * system.length, system.length / (system.nodes - 1)
    s = inside(s, s, s + ds) if system.discontinuities.places else s
    history = unpacked_history(system, sample.c0, sample.history[0])
    return Point(s, sample.t, sample.y, sample.control, history)


def end_point(system: System, sample: Samples) -> Point:
    """Return the point at a segment's end; slightly inside if the rod has discontinuities."""
    s, ds = sample.place * system.length, system.length / (system.nodes - 1)
    s = inside(s + ds, s, s + ds) if system.discontinuities.places else s + ds
    history = unpacked_history(system, sample.c0, sample.history[1])
    return Point(s, sample.t, sample.y_next, sample.control, history)


def tip_point(system: System, sample: TipSamples) -> Point:
    """Return the point at the tip."""
    history = unpacked_history(system, sample.c0, sample.history)
    return Point(system.length, sample.t, sample.y, sample.control, history)


# predictions


def predict_segment(
    system: System, space: SpaceScheme, sample: Samples
) -> tuple[Float[Any, " y"], Float[Any, " z"]]:
    """Predict y at the end of one segment and z at its start (paper eq. 9, integration over one segment).

    y at the end follows the scheme's formula, with stages from the true y at both ends.
    """

    def derivatives(s: Any, y: Any, record: Any) -> Any:
        history = unpacked_history(system, sample.c0, record)
        return semi_discrete.derivatives(system, Point(s, sample.t, y, sample.control, history))

    def reached(bounds: tuple[Any, Any], start: Any, end: Any, records: Any) -> Any:
        low, high = bounds
        h = high - low

        def rates(place: float, y: Any, record: Any) -> Any:
            s = low + place * h
            return derivatives(inside(s, low, high) if system.discontinuities.places else s, y, record)[0]

        found = [rates(0.0, start, records[0])]
        found.append(rates(1.0, end, records[1]) if space.implicit else jnp.zeros_like(start))
        for k, stage in enumerate(space.formula.stages):
            moved = sum(x * f for x, f in zip(stage.rates, found, strict=False))
            y = (1.0 - stage.end) * start + stage.end * end + h * moved
            found.append(rates(stage.place, y, records[2 + k]))
        return start + h * sum(b * f for b, f in zip(space.formula.weights, found, strict=True))

    z = semi_discrete.derivatives(system, start_point(system, sample))[1]
    grid, ds = grid_of(system, space), system.length / (system.nodes - 1)
    if grid.parts.shape[1] == 1:
        s = sample.place * system.length
        return reached((s, s + ds), sample.y, sample.y_next, sample.history), z

    def along(y: Any, piece: Any) -> tuple[Any, None]:
        k, own, records = piece
        low, high = (ds * (jnp.asarray(grid.segment)[own] + jnp.asarray(grid.bounds)[own, k]) for k in (0, 1))
        history = unpacked_history(system, sample.c0, records[0])
        if system.discontinuities.jump is not None:
            acting = jnp.asarray(grid.acting)[own]
            beyond = semi_discrete.jump(system, acting, Point(None, sample.t, y, sample.control, history))
            y = jnp.where(k > 0, beyond, y)

        def corrected(_: Any, end: Any) -> Any:
            def left(end: Any) -> Any:
                return reached((low, high), y, end, records) - end

            return end - jnp.linalg.solve(jax.jacfwd(left)(end), left(end))

        inner = jax.lax.fori_loop(0, CORRECTIONS, corrected, y)
        last = jnp.asarray(grid.bounds)[own, 1] == 1.0
        found = reached((low, high), y, jnp.where(last, sample.y_next, inner), records)
        # segments with fewer pieces repeat their last piece
        return jnp.where((k > 0) & (own == previous(k)), y, found), None

    segment = jnp.round(sample.place * (system.nodes - 1)).astype(int)
    pieces = jnp.asarray(grid.parts)[segment]

    def previous(k: Any) -> Any:
        return pieces[jnp.maximum(k - 1, 0)]

    records = jnp.concatenate([sample.history[None], sample.later])
    y_next, _ = jax.lax.scan(along, sample.y, (jnp.arange(len(pieces)), pieces, records))
    return y_next, z


def samples(
    knowledge: System,
    trajectories: Sequence[Trajectory],
    nodes: Sequence[int] | None = None,
    model: System | None = None,
) -> Dataset:
    """Return one-segment samples of trajectories; `nodes` selects the predicted nodes (1 to N - 1).

    Trajectories hold the nodes only. The history at stages between nodes is interpolated, or evaluated by a
    `model` that is close to the real robot.

    Raises:
        DataError: a trajectory does not fit the nominal model or the others, is too short or not finite.
    """
    _check(knowledge, trajectories)
    ends = _checked_nodes(knowledge, nodes)
    parts = [_of_one(knowledge, trajectory, k, ends, model) for k, trajectory in enumerate(trajectories)]
    *joined, doubts = zip(*parts, strict=True)
    segments, tips = (jax.tree.map(lambda *leaves: np.concatenate(leaves), *each) for each in joined)
    doubt = np.sqrt(np.mean(np.square(doubts), axis=0))
    return Dataset(segments, tips, settings_of(trajectories[0]).space, doubt)


def rows_are_states(knowledge: System, trajectories: Sequence[Trajectory]) -> bool:
    """True if the rows hold every state that steps need, or were not simulated."""
    if not any(each.settings for each in trajectories):
        return True
    # no stages between nodes, no discontinuities, B zero
    stages = any(each.settings.space.formula.stages for each in trajectories if each.settings)
    return not (knowledge.mixed or stages or knowledge.discontinuities.places)


def strand_samples(knowledge: System, data: Dataset) -> Dataset:
    """Return the segments strand by strand, as samples of `strand_of(knowledge)`; the tips are unchanged."""
    count, segments = strand_count(knowledge), data.segments
    if count == 1:
        return data

    def own(values: Any) -> Any:
        return np.asarray(in_strands(knowledge, values)).reshape(len(values) * count, -1)

    def past(records: Any) -> Any:
        own = np.asarray(records_in_strands(knowledge, np.asarray(records)))
        return np.moveaxis(own, -2, 1).reshape(len(records) * count, *own.shape[1:-2], own.shape[-1])

    shared = ("place", "t", "c0", "control", "weight", "origin")
    every: dict[str, Any] = {name: np.repeat(getattr(segments, name), count, axis=0) for name in shared}
    every |= {name: own(getattr(segments, name)) for name in ("y", "z", "y_next", "z_next", "slope")}
    every |= {"history": past(segments.history), "later": past(segments.later)}
    every |= {"weight": every["weight"] / count}
    doubt = np.sqrt(np.mean(np.square(in_strands(knowledge, data.doubt)), axis=0))
    return dataclasses.replace(data, segments=Samples(**every), doubt=doubt)


def settings_of(trajectory: Trajectory) -> Settings:
    """Return the settings of a trajectory; those of measured rows if it was not simulated."""
    return trajectory.settings or MEASURED


def _of_one(
    knowledge: System, trajectory: Trajectory, k: int, ends: np.ndarray, model: System | None
) -> tuple[Samples, TipSamples, np.ndarray]:
    settings, dt = replayed_settings(trajectory), trajectory.dt
    y, z, control = (np.asarray(a, dtype=float) for a in (trajectory.y, trajectory.z, trajectory.control))
    time = np.asarray(trajectory.time, dtype=float)
    slope, doubt = slopes_of(settings, y)

    def recorded(y: np.ndarray, z: np.ndarray, slope: np.ndarray) -> np.ndarray:
        return np.concatenate([y, z, slope / knowledge.length] if knowledge.mixed else [y, z], axis=-1)

    record, stages = recorded(y, z, slope), np.zeros((len(time), 0))
    if settings.stages > 1:
        between = np.moveaxis(np.nan_to_num(np.asarray(trajectory.stages, dtype=float)), 1, 0)
        parts = [(each[..., : y.shape[-1]], each[..., y.shape[-1] :][..., : z.shape[-1]]) for each in between]
        stages = np.stack([recorded(*part, slopes_of(settings, part[0])[0]) for part in parts], axis=1)
    c0, history = histories(settings, dt, record, stages)
    ny, nz, rest = y.shape[-1], z.shape[-1], np.zeros_like(y)
    terms = (
        history[..., :ny],
        history[..., ny : ny + nz],
        history[..., ny + nz :] if knowledge.mixed else rest,
    )
    beyond = _far_side(knowledge, Point(None, time, y, control, History(c0, *terms)))
    if knowledge.discontinuities.places:
        slope, doubt = slopes_of(settings, y, beyond, knowledge.discontinuities.places)
    # earlier rows equal the first row if that is the start of a motion, and are unknown otherwise
    first = 1 if time[0] == 0.0 or settings.stages > 1 else 2
    rows = np.arange(first, len(time))
    history, c0 = history[rows], c0[rows]
    stages, later = _past_of_rows(knowledge, trajectory, rows, history, model)
    starts, count = ends - 1, len(rows) * len(ends)

    def flat(values: Any) -> Any:
        return values.reshape(count, *values.shape[2:])

    def spread(values: Any) -> Any:
        return np.repeat(values, len(ends), axis=0)

    at = np.ix_(rows, starts)
    segments = Samples(
        place=np.tile(starts / (knowledge.nodes - 1.0), len(rows)),
        t=spread(time[rows]),
        c0=spread(c0),
        y=flat(beyond[at]),
        z=flat(z[at]),
        y_next=flat(y[np.ix_(rows, ends)]),
        z_next=flat(z[np.ix_(rows, ends)]),
        slope=flat(slope[at]),
        control=spread(control[rows]),
        history=flat(stages[:, starts]),
        later=flat(later[:, starts]),
        weight=np.full(count, 1.0 / count),
        origin=np.stack([np.full(count, k), spread(rows)], axis=1),
    )
    tips = TipSamples(
        t=time[rows],
        c0=c0,
        y=y[rows, -1],
        control=control[rows],
        history=history[:, -1],
        weight=np.full(len(rows), 1.0 / len(rows)),
        origin=np.stack([np.full(len(rows), k), rows], axis=1),
    )
    return segments, tips, doubt


def _past_of_rows(
    knowledge: System, trajectory: Trajectory, rows: np.ndarray, history: np.ndarray, model: System | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return `Samples.history` and `Samples.later` of all segments, row by row."""
    space = settings_of(trajectory).space
    simulated = trajectory.settings is not None
    known = replay(trajectory, model) if model is not None and simulated else None
    if known is None:
        past = jax.vmap(lambda each: in_segments(knowledge, space, at_places(knowledge, space, each)))(
            history
        )
    else:
        along = known.terms[rows - known.first]
        past = jax.vmap(lambda each: in_segments(knowledge, space, each))(along)
    return np.asarray(past[0]), np.asarray(past[1])


def in_segments(knowledge: System, space: SpaceScheme, records: Float[Any, "places x"]) -> Any:
    """Return records (segments, places, x) of first pieces, (segments, pieces - 1, places, x) of others."""
    grid = grid_of(knowledge, space)
    parts = grid.parts
    found = records[grid.places_of(parts.ravel()).reshape(*parts.shape, -1)]
    return found[:, 0], found[:, 1:]


def histories(
    settings: Settings, dt: float, record: np.ndarray, stages: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return c0 (T,) and ʰ (T, N, x) of every row, by the trajectory's own scheme; zero in row 0."""
    table = coefficient_table(settings, dt)
    table = table.reshape(len(table), settings.stages, -1)
    rate, newest = np.zeros_like(record[0]), [record[0]] * settings.memory
    c0, history = np.zeros(len(record)), np.zeros_like(record)
    for i in range(1, len(record)):
        for coefficients, now in zip(table[min(i, len(table)) - 1], [*stages[i], record[i]], strict=True):
            c0[i] = coefficients[0]
            history[i] = history_of(newest, rate, coefficients, settings)
            rate, newest = c0[i] * now + history[i], [now, *newest[:-1]]
    return c0, history


def _far_side(knowledge: System, rows: Point) -> Float[Any, "T N y"]:
    """Return y at all nodes of rows (T, …), on the far side of the nominal model's discontinuities."""
    y = rows.y
    if not (knowledge.discontinuities.places and knowledge.discontinuities.jump):
        return y
    # the discontinuities at the exact start of each segment
    grid = grid_of(knowledge)
    acting = grid.acting[grid.nodes[:-1]]
    jumping = np.flatnonzero(acting.any(axis=1))
    if not len(jumping):
        return y
    beyond, terms = y.copy(), [each[:, jumping] for each in rows.history[1:]]
    rows = rows._replace(y=y[:, jumping], history=History(rows.history.c0, *terms))
    beyond[:, jumping] = _jump(knowledge, acting[jumping], rows)
    return beyond


@jax.jit
def _jump(knowledge: System, acting: Any, rows: Point) -> Any:
    own = History(None, 0, 0, 0)
    at_node = functools.partial(semi_discrete.jump, knowledge)
    at_row = jax.vmap(at_node, in_axes=(0, Point(None, None, 0, None, own)))
    return jax.vmap(at_row, in_axes=(None, Point(None, 0, 0, 0, own._replace(c0=0))))(acting, rows)


def is_undivided(knowledge: System, place: Float[Any, " S"]) -> Float[np.ndarray, " S"]:
    """Return 1 for each segment (by its start, a part of the length) without inner discontinuity, else 0."""
    if not knowledge.discontinuities.places:
        return np.ones(len(place))
    grid = grid_of(knowledge)
    segment = np.round(np.asarray(place) * (knowledge.nodes - 1)).astype(int)
    return (grid.bounds[grid.nodes[segment], 1] == 1.0).astype(float)


# checks


def _check(knowledge: System, trajectories: Sequence[Trajectory]) -> None:
    if not trajectories:
        raise DataError("there are no trajectories; at least one is needed")
    wanted = (knowledge.nodes, knowledge.y_layout.size)
    for k, trajectory in enumerate(trajectories):
        name = f"trajectory {k}"
        if not isinstance(trajectory, Trajectory):
            raise DataError(f"{name} is a {type(trajectory).__name__}; allowed is a Trajectory")
        shape = np.shape(trajectory.y)
        if len(shape) != 3:
            raise DataError(f"{name} is a batch of {shape[0]}; give its robots one by one")
        if shape[0] < 3:
            raise DataError(f"{name} has {shape[0]} rows; at least 3 are needed")
        if shape[1:] != wanted:
            raise DataError(
                f"{name} has {shape[1]} nodes of {shape[2]} numbers; "
                f"the nominal model has {wanted[0]} of {wanted[1]}"
            )
        controls = np.shape(trajectory.control)[-1]
        if controls != knowledge.control_layout.size:
            names = ", ".join(field.name for field in knowledge.control_layout.fields)
            raise DataError(
                f"{name} has {controls} controls a row; the nominal model has "
                f"{knowledge.control_layout.size} ({names})"
            )
        for what in ("y", "z", "control"):
            finite = np.isfinite(np.asarray(getattr(trajectory, what)))
            if not finite.all():
                row = int(np.argwhere(~finite)[0][0])
                raise DataError(
                    f"{name} has {what} that is not finite in row {row}; learn from the rows before it"
                )
        steps = np.diff(np.asarray(trajectory.time))
        if np.any(steps <= 0) or np.ptp(steps) > 1e-6 * steps.max():
            raise DataError(
                f"{name} has time steps from {steps.min():g} to {steps.max():g} s; "
                "they must be positive and equal"
            )
    first = trajectories[0]
    for k, trajectory in enumerate(trajectories):
        if not np.isclose(trajectory.dt, first.dt, rtol=1e-6):
            raise DataError(
                f"trajectory {k} has time steps of {trajectory.dt:g} s and trajectory 0 of {first.dt:g} s; "
                "all must be the same"
            )
        if settings_of(trajectory).space != settings_of(first).space:
            raise DataError(
                f"trajectory {k} was solved by {settings_of(trajectory).space} along the rod and "
                f"trajectory 0 by {settings_of(first).space}; all must be the same"
            )


def _checked_nodes(knowledge: System, nodes: Sequence[int] | None) -> np.ndarray:
    last = knowledge.nodes - 1
    if nodes is None:
        return np.arange(1, last + 1)
    chosen = sorted(nodes)
    if not chosen or len(set(chosen)) < len(chosen) or not set(chosen) <= set(range(1, last + 1)):
        raise DataError(f"nodes is {nodes!r}; allowed is different whole numbers from 1 to {last}")
    return np.array(chosen)


# rates along the rod of a trajectory's rows


def slopes_of(
    settings: Settings, y: np.ndarray, beyond: np.ndarray | None = None, cuts: tuple[float, ...] = ()
) -> tuple[np.ndarray, np.ndarray]:
    """Return y_s times the length (T, N, y), from the states alone, and its estimated error (y,).

    Exact if a segment is one Euler step. Otherwise from splines; the error estimate is the difference from
    splines of the next lower order. For the trapezoidal rule the slopes are the nearest ones to the splines'
    whose means equal the changes over segments. No spline spans a discontinuity: with `beyond` (y on the far
    side), slopes at discontinuities are those on the far side.
    """
    last = y.shape[1] - 1
    beyond = y if beyond is None else beyond
    if settings.space.order == 1:
        forward = (y[:, 1:] - beyond[:, :-1]) * last
        return np.concatenate([forward, forward[:, -1:]], axis=1), np.zeros(y.shape[-1])
    slope, wrong = np.zeros_like(y), np.zeros_like(y)
    for first, end in pieces(cuts, last + 1):
        values = y[:, first : end + 1].copy()
        values[:, 0] = beyond[:, first]
        rates, doubt = _spline_slopes(values, last)
        if settings.space.order == 2:
            rates = _trapezoidal_slopes(values, rates, last)
        slope[:, first : end + 1], wrong[:, first : end + 1] = rates, doubt
    # a node alone between discontinuities has no spline: use the slope of the segment, with a large error
    alone = [first for first, end in pieces(cuts, last + 1) if first == end]
    for node in alone:
        other = node if node < last else node - 1
        slope[:, node] = (y[:, other + 1] - beyond[:, other]) * last
        wrong[:, node] = slope[:, node]
    return slope, 0.1 * np.sqrt(np.mean(np.square(wrong), axis=(0, 1)))


def pieces(cuts: tuple[float, ...], nodes: int) -> list[tuple[int, int]]:
    """Return the first and last node of each smooth stretch; neighbours share a node on a discontinuity."""
    along = np.asarray(cuts) * (nodes - 1)
    nearest = np.round(along)
    is_node = np.abs(nearest - along) < ON_NODE * (nodes - 1)
    on_node = set(nearest[is_node].astype(int).tolist())
    between = set(np.floor(along[~is_node]).astype(int).tolist())
    found: list[tuple[int, int]] = []
    first = 0
    for node in range(nodes - 1):
        if node in between:
            found.append((first, node))
            first = node + 1
        elif node + 1 in on_node and node + 1 < nodes - 1:
            found.append((first, node + 1))
            first = node + 1
    return [*found, (first, nodes - 1)]


def _trapezoidal_slopes(values: np.ndarray, near: np.ndarray, last: int) -> np.ndarray:
    """Return the slopes nearest to `near` whose means over segments equal the changes of values."""
    if values.shape[1] < 3:
        return near
    signs = (-1.0) ** np.arange(values.shape[1])[:, None]
    change = np.diff(values, axis=1) * last
    steps = np.cumsum(2.0 * change * signs[1:], axis=1)
    found = signs * np.concatenate([np.zeros_like(steps[:, :1]), steps], axis=1)
    # the alternating component is free
    return found + signs * np.mean(signs * (near - found), axis=1, keepdims=True)


def _spline_slopes(values: np.ndarray, last: int) -> tuple[np.ndarray, np.ndarray]:
    """Return spline slopes of one smooth stretch, and their difference from the next lower order."""
    # imported here: it takes a third of a second
    from scipy.interpolate import make_interp_spline

    count = values.shape[1]
    if count == 1:
        return np.zeros_like(values), np.zeros_like(values)
    place = np.arange(count) / last
    orders = min(7, count - 1), min(5, count - 2)
    high, low = (
        make_interp_spline(place, values, k=order, axis=1).derivative()(place)
        if order > 0
        else np.zeros_like(values)
        for order in orders
    )
    return high, high - low
