"""Misfit of one-segment predictions with given parameters, and its derivatives.

Differences (M,) are in groups, one for each field of the state. Their exact derivatives (M, n) are with
respect to the coordinates of the search.
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

from knode_cosserat.learning.calibration.unknowns import (
    Unknowns,
    searched_numbers,
    with_coordinates,
    with_numbers,
)
from knode_cosserat.rods.system import System
from knode_cosserat.solvers import semi_discrete
from knode_cosserat.solvers.segments import (
    Dataset,
    Samples,
    TipSamples,
    predict_segment,
    rows_are_states,
    samples,
)
from knode_cosserat.solvers.semi_discrete import unpacked_history
from knode_cosserat.trajectory import Trajectory

#: ten times the solver's tolerance, in natural units: smaller differences are solver errors
LEAST = 1e-9
#: fields of a sample that depend on measured states
SEEN = ("y", "z", "y_next", "history", "later")
#: number of draws of noise; with both signs of each draw, results hardly depend on it
DRAWS = 6


def by_group(squares: Any, groups: np.ndarray) -> Float[np.ndarray, " G"]:
    """Return the mean of numbers in each group; NaN for an empty group."""
    return np.bincount(groups, weights=squares) / np.bincount(groups)


class LinearisedMisfit(NamedTuple):
    """Predictions minus data, and their derivatives with respect to the coordinates of the search."""

    values: Float[np.ndarray, " M"]
    slopes: Float[np.ndarray, "M n"]


# one segment


def _differences(robot, coordinates, data, length, unknowns, space):  # type: ignore[no-untyped-def]
    """Return all differences (M,) of the samples' segments and tips, in one vector."""
    system = with_coordinates(robot, unknowns, coordinates)

    def scaled(record: Any) -> Any:
        # rates along the rod were computed with the robot's initial length
        if not system.mixed:
            return record
        ny = system.y_layout.size
        return jnp.concatenate([record[..., :-ny], record[..., -ny:] * (length / system.length)], axis=-1)

    def of_segment(sample: Samples) -> Any:
        own = sample._replace(history=scaled(sample.history), later=scaled(sample.later))
        y_next, z = predict_segment(system, space, own)
        return jnp.concatenate([y_next - sample.y_next, z - sample.z])

    def of_tip(sample: TipSamples) -> Any:
        history = unpacked_history(system, sample.c0, scaled(sample.history))
        return semi_discrete.tip(system, sample.t, sample.control, sample.y, history)

    segments, tips = data
    return jnp.concatenate([jax.vmap(of_segment)(segments).ravel(), jax.vmap(of_tip)(tips).ravel()])


@functools.partial(jax.jit, static_argnames=("unknowns", "space"))
def _differences_and_slopes(robot, coordinates, data, length, unknowns, space):  # type: ignore[no-untyped-def]
    def twice(x: Any) -> tuple[Any, Any]:
        values = _differences(robot, x, data, length, unknowns, space)
        return values, values

    return jax.jacfwd(twice, has_aux=True)(coordinates)


@functools.partial(jax.jit, static_argnames=("unknowns", "space"))
def _pulled_back(robot, coordinates, data, length, unknowns, space, factors):  # type: ignore[no-untyped-def]
    """Return derivatives of factors (k, M) times differences by the samples' states and history."""
    segments, tips = data

    def of(measured: Any) -> Any:
        s, t = measured
        moved = (
            segments._replace(**dict(zip(SEEN, s, strict=True))),
            tips._replace(y=t[0], history=t[1]),
        )
        return _differences(robot, coordinates, moved, length, unknowns, space)

    measured = tuple(getattr(segments, name) for name in SEEN), (tips.y, tips.history)
    _, pull = jax.vjp(of, measured)
    return jax.vmap(lambda factor: pull(factor)[0])(factors)


class SegmentMisfit:
    """Misfit of one-segment predictions: y at the segment's end, z at its start, and tip conditions."""

    #: true if the first step of a search must be limited
    cautious = False

    def __init__(
        self,
        robot: System,
        trajectories: Sequence[Trajectory],
        unknowns: Unknowns,
        model: System | None = None,
    ):
        self.robot, self.unknowns, self.trajectories = robot, unknowns, list(trajectories)
        self.data: Dataset = samples(robot, trajectories, model=model)
        self.length = float(np.asarray(robot.length))
        y, z, tip = robot.y_layout, robot.z_layout, robot.ends.layout
        self.fields = (*y.names, *z.names, *(f"tip {name}" if name != "tip" else name for name in tip.names))
        sizes = [field.size for layout in (y, z, tip) for field in layout.fields]
        numbers = np.repeat(np.arange(len(sizes)), sizes)
        own = y.size + z.size
        #: index in `fields` of each number of a sample; `groups` has the same for each difference
        self.state_groups = numbers[:own]
        segments, tips = self.data.segments, self.data.tips
        self.groups = np.concatenate(
            [np.tile(numbers[:own], len(segments.t)), np.tile(numbers[own:], len(tips.t))]
        )
        self._on_device = jax.tree.map(jnp.asarray, (segments, tips))

    def __call__(
        self, coordinates: np.ndarray, moved: tuple[Samples, TipSamples] | None = None
    ) -> LinearisedMisfit:
        """Return differences at the samples, or at `moved` samples of the same shape."""
        data = self._on_device if moved is None else moved
        slopes, values = _differences_and_slopes(
            self.robot, coordinates, data, self.length, self.unknowns, self.data.space
        )
        return LinearisedMisfit(np.asarray(values), np.asarray(slopes))

    def looking_back_on(self, model: System) -> SegmentMisfit | None:
        """Return a copy with the history between nodes from a model; None if the nodes hold all of it."""
        if rows_are_states(self.robot, self.trajectories):
            return None
        return SegmentMisfit(self.robot, self.trajectories, self.unknowns, model)

    def blocks(self, values: Float[np.ndarray, " M"]) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return for each trajectory the field (n,) of a row's differences, and the differences (R, n)."""
        segments, tips = self.data.segments.origin, self.data.tips.origin
        cut = len(segments) * len(self.state_groups)
        parts = []
        for origin, where in ((segments, slice(0, cut)), (tips, slice(cut, None))):
            each = values[where].reshape(len(origin), -1), self.groups[where].reshape(len(origin), -1)
            for k in range(len(self.trajectories)):
                here = origin[:, 0] == k
                by_row, fields = (part[here].reshape(len(np.unique(origin[here, 1])), -1) for part in each)
                parts.append((fields[0], by_row))
        return parts

    def pulled_back(self, coordinates: np.ndarray, factors: Float[np.ndarray, "k M"]) -> Any:
        """Return derivatives of factors times differences by the `SEEN` fields and (tip y, tip history)."""
        space = self.data.space
        pulled = _pulled_back(
            self.robot, coordinates, self._on_device, self.length, self.unknowns, space, factors
        )
        return jax.tree.map(np.asarray, pulled)

    def beginnings(self) -> list[Float[np.ndarray, " M"]]:
        """Return masks of differences for preliminary searches: none."""
        return []

    def first_sizes(self) -> Float[np.ndarray, " G"]:
        """Return initial sizes of the differences, by field: the variation of the data."""
        segments = self.data.segments
        change, strain = segments.y_next - segments.y, segments.z - np.mean(segments.z, axis=0)
        squares = np.mean(np.square(np.concatenate([change, strain], axis=1)), axis=0)
        own = np.sqrt(by_group(squares, self.state_groups))
        natural = [np.asarray(part) for part in self.robot.scales()]
        least = np.concatenate([LEAST * natural[0], np.zeros(len(squares) - len(natural[0]))])
        own = np.maximum(own, by_group(least, self.state_groups))
        tip_fields = [field.size for field in self.robot.ends.layout.fields]
        tips = [np.mean(part) for part in np.split(natural[1], np.cumsum(tip_fields)[:-1])]
        return np.concatenate([np.where(own > 0.0, own, 1.0), tips])

    def least_sizes(self, coordinates: np.ndarray) -> Float[np.ndarray, " G"]:
        """Return the differences caused by noise of the size of the solver's tolerance, by field.

        Noise is added to y only; z follows from y without an additional error.
        """
        system = with_numbers(self.robot, self.unknowns, searched_numbers(self.unknowns, coordinates))
        natural = LEAST * np.asarray(system.scales().y)
        noise = np.concatenate([natural, np.zeros(self.robot.z_layout.size)])
        change = self(coordinates, self.moved(self.draws[0], noise)).values - self(coordinates).values
        return np.sqrt(by_group(np.square(change), self.groups))

    @functools.cached_property
    def draws(self) -> list[tuple[Samples, TipSamples]]:
        """Changes of the samples by white noise of size one in y and z; the samples are linear in it."""
        rng = np.random.default_rng(0)
        return [self._unit_noise(rng) for _ in range(DRAWS)]

    def _unit_noise(self, rng: np.random.Generator) -> tuple[Samples, TipSamples]:
        drawn = [
            dataclasses.replace(
                each, y=rng.normal(size=np.shape(each.y)), z=rng.normal(size=np.shape(each.z))
            )
            for each in self.trajectories
        ]
        noise = samples(self.robot, drawn)
        return noise.segments, noise.tips

    def moved(
        self, noise: tuple[Samples, TipSamples], sizes: Float[np.ndarray, " x"]
    ) -> tuple[Samples, TipSamples]:
        """Return the samples with added noise of given sizes, for each number of y and z."""
        ny = self.robot.y_layout.size
        in_y, in_z, record = sizes[:ny], sizes[ny:], np.concatenate([sizes, sizes[:ny]])
        (segments, tips), (own, own_tips) = noise, (self.data.segments, self.data.tips)

        def remembered(history: Any, noise: Any) -> Any:
            return history + record[: history.shape[-1]] * noise

        return (
            own._replace(
                y=own.y + in_y * segments.y,
                z=own.z + in_z * segments.z,
                y_next=own.y_next + in_y * segments.y_next,
                history=remembered(own.history, segments.history),
                later=remembered(own.later, segments.later),
            ),
            own_tips._replace(
                y=own_tips.y + in_y * tips.y, history=remembered(own_tips.history, tips.history)
            ),
        )
