"""How far one-segment predictions with given parameters are from trajectories, and the slopes of that.

Differences (M,) come in groups, a field of the state a group, with their exact derivatives (M, n) by the
coordinates of the search.
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

from knode_cosserat.learning.calibration.unknowns import Unknowns, found, with_coordinates, with_numbers
from knode_cosserat.learning.samples import Dataset, Samples, TipSamples, predict, samples, told_by_rows
from knode_cosserat.rods.system import System, unpacked_history
from knode_cosserat.trajectory import Trajectory

#: ten times the solver's tolerance, of natural sizes: what is less is its error, and not even white
LEAST = 1e-9
#: what a sample holds of states
SEEN = ("y", "z", "y_next", "history", "later")
#: draws of noise; what is found with both signs of each hardly depends on how many there are
DRAWS = 6


def by_group(squares: Any, groups: np.ndarray) -> Float[np.ndarray, " G"]:
    """The mean of numbers in each group; not a number where a group is empty."""
    return np.bincount(groups, weights=squares) / np.bincount(groups)


class Differences(NamedTuple):
    """What is predicted minus what is there, and its derivatives by the coordinates of the search."""

    values: Float[np.ndarray, " M"]
    slopes: Float[np.ndarray, "M n"]


# one segment


def _differences(robot, coordinates, data, length, unknowns, space):  # type: ignore[no-untyped-def]
    """All differences (M,) of the samples' segments and tips, in one vector."""
    system = with_coordinates(robot, unknowns, coordinates)

    def scaled(record: Any) -> Any:
        # rates along the rod were taken at the length that the robot had
        if not system.mixed:
            return record
        ny = system.y_layout.size
        return jnp.concatenate([record[..., :-ny], record[..., -ny:] * (length / system.length)], axis=-1)

    def of_segment(sample: Samples) -> Any:
        own = sample._replace(history=scaled(sample.history), later=scaled(sample.later))
        y_next, z = predict(system, space, own)
        return jnp.concatenate([y_next - sample.y_next, z - sample.z])

    def of_tip(sample: TipSamples) -> Any:
        history = unpacked_history(system, sample.c0, scaled(sample.history))
        return system.tip(sample.t, sample.control, sample.y, history)

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
    """Derivatives of factors (k, M) times differences by the states and histories in the samples."""
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
    """One-segment predictions: y at the segment's end, z at its start, and the tip's conditions."""

    #: whether a search must not go far at once
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
        y, z, tip = robot.y_layout, robot.z_layout, robot.tip_layout
        self.fields = (*y.names, *z.names, *(f"tip {name}" if name != "tip" else name for name in tip.names))
        sizes = [field.size for layout in (y, z, tip) for field in layout.fields]
        numbers = np.repeat(np.arange(len(sizes)), sizes)
        own = y.size + z.size
        #: which of `fields` each number of a sample, and each difference, belongs to
        self.state_groups = numbers[:own]
        segments, tips = self.data.segments, self.data.tips
        self.groups = np.concatenate(
            [np.tile(numbers[:own], len(segments.t)), np.tile(numbers[own:], len(tips.t))]
        )
        self._on_device = jax.tree.map(jnp.asarray, (segments, tips))

    def __call__(
        self, coordinates: np.ndarray, moved: tuple[Samples, TipSamples] | None = None
    ) -> Differences:
        """Differences at the samples, or at others like them."""
        data = self._on_device if moved is None else moved
        slopes, values = _differences_and_slopes(
            self.robot, coordinates, data, self.length, self.unknowns, self.data.space
        )
        return Differences(np.asarray(values), np.asarray(slopes))

    def looking_back_on(self, model: System) -> SegmentMisfit | None:
        """The same with the past between nodes as a model has it; None if the nodes tell all of it."""
        if told_by_rows(self.robot, self.trajectories):
            return None
        return SegmentMisfit(self.robot, self.trajectories, self.unknowns, model)

    def blocks(self, values: Float[np.ndarray, " M"]) -> list[tuple[np.ndarray, np.ndarray]]:
        """The field (n,) of the differences of a row, and these by row (R, n), of each trajectory."""
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
        """Derivatives of factors times differences by ((y, z, y_next, history), (tip y, tip history))."""
        space = self.data.space
        pulled = _pulled_back(
            self.robot, coordinates, self._on_device, self.length, self.unknowns, space, factors
        )
        return jax.tree.map(np.asarray, pulled)

    def beginnings(self) -> list[Float[np.ndarray, " M"]]:
        """Which differences count in searches that lead to where that of all begins: there are none."""
        return []

    def first_sizes(self) -> Float[np.ndarray, " G"]:
        """Sizes of the differences, by field, before anything is known: how much the data vary there."""
        segments = self.data.segments
        change, strain = segments.y_next - segments.y, segments.z - np.mean(segments.z, axis=0)
        squares = np.mean(np.square(np.concatenate([change, strain], axis=1)), axis=0)
        own = np.sqrt(by_group(squares, self.state_groups))
        natural = [np.asarray(part) for part in self.robot.scales()]
        least = np.concatenate([LEAST * natural[0], np.zeros(len(squares) - len(natural[0]))])
        own = np.maximum(own, by_group(least, self.state_groups))
        tip_fields = [field.size for field in self.robot.tip_layout.fields]
        tips = [np.mean(part) for part in np.split(natural[1], np.cumsum(tip_fields)[:-1])]
        return np.concatenate([np.where(own > 0.0, own, 1.0), tips])

    def least_sizes(self, coordinates: np.ndarray) -> Float[np.ndarray, " G"]:
        """What noise of the size of the solver's tolerance makes of the differences, by field.

        z follows from y without an error of its own.
        """
        system = with_numbers(self.robot, self.unknowns, found(self.unknowns, coordinates))
        natural = LEAST * np.asarray(system.scales().y)
        noise = np.concatenate([natural, np.zeros(self.robot.z_layout.size)])
        change = self(coordinates, self.moved(self.draws[0], noise)).values - self(coordinates).values
        return np.sqrt(by_group(np.square(change), self.groups))

    @functools.cached_property
    def draws(self) -> list[tuple[Samples, TipSamples]]:
        """What white noise of size one in all of y and z adds to the samples, which are linear in it."""
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
        """The samples with noise of given sizes, in the numbers of y and z, added."""
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
