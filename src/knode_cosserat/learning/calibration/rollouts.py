"""How far simulations with given parameters are from what was measured, and the slopes of that.

Only positions and orientations are compared: no velocity, force or strain has to be known. The derivatives
are those of each solved step, by the implicit function theorem.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.learning.calibration.misfit import LEAST, Differences
from knode_cosserat.learning.calibration.unknowns import Unknowns, found, with_coordinates, with_numbers
from knode_cosserat.learning.samples import DataError, samples
from knode_cosserat.rods.system import System
from knode_cosserat.solvers.march import Past, initial_past, rest_record
from knode_cosserat.solvers.run import Task, run_one
from knode_cosserat.solvers.sensitivity import tangent_march
from knode_cosserat.solvers.settings import Settings
from knode_cosserat.solvers.simulate import Run, beginning
from knode_cosserat.trajectory import Trajectory

#: a far start is brought near on the first two rows, then on this many times as many, and so on
GROWTH = 2

#: how many rows are looked at first
FIRST_ROWS = (2, 5, 10, 20, 50, 100)


class _Rollout(NamedTuple):
    """One trajectory to be simulated again."""

    settings: Settings
    dt: float
    #: the rows that it begins from, or none: it begins from the robot's own state at rest
    initial: Trajectory | None
    control: Float[np.ndarray, "T c"]
    y: Float[np.ndarray, "T N y"]


def _seen(robot: System, oriented: bool, y: Any, like: Any) -> Any:
    """Positions and, if the robot has any, quaternions of length one, of the same sign as others."""
    if not oriented:
        return robot.positions(y)
    h, other = robot.quaternions(y), robot.quaternions(like)
    size = jnp.sqrt(jnp.sum(h * h, axis=-1, keepdims=True))
    sign = jnp.where(jnp.sum(h * other, axis=-1, keepdims=True) < 0.0, -1.0, 1.0)
    return jnp.concatenate([robot.positions(y), sign * h / size], axis=-1)


class _Rows(NamedTuple):
    """The solved rows of a rollout, what they began from, and what was measured."""

    records: Float[Any, "T N x"]
    unknowns: Float[Any, "T k"]
    past: Past
    #: the last row and control of the rows that it began from, if there are any
    before: Any
    control: Float[Any, "T c"]
    measured: Float[Any, "T N y"]


@functools.partial(jax.jit, static_argnames=("unknowns", "settings", "oriented"))
def _differences(robot, coordinates, rows, table, dt, unknowns, settings, oriented):  # type: ignore[no-untyped-def]
    """Differences (M,) of solved rows from what was measured, and their derivatives (M, n)."""
    ny = robot.y_layout.size

    def start(x: Any) -> Any:
        system = with_coordinates(robot, unknowns, x)
        if rows.before is None:
            return system, initial_past(system, rest_record(system), jnp.zeros(system.control_size))
        if system.mixed:
            return system, initial_past(system, *rows.before)._replace(t0=rows.past.t0)
        return system, rows.past

    def left(y: Any) -> Any:
        # the base is left out: it is where the model puts it
        seen = _seen(robot, oriented, y, rows.measured) - _seen(robot, oriented, rows.measured, rows.measured)
        return seen[:, 1:].ravel()

    def along(direction: Any) -> Any:
        (system, past), (d_system, d_past) = jax.jvp(start, (coordinates,), (direction,))
        d_records, _ = tangent_march(
            settings, table, dt, rows.records, rows.unknowns, system, rows.control, past, d_system,
            jnp.zeros_like(rows.control), d_past.records[:2], d_past.rate,
        )  # fmt: skip
        return jax.jvp(left, (rows.records[..., :ny],), (d_records[..., :ny],))[1]

    directions = jnp.eye(coordinates.shape[0])
    return left(rows.records[..., :ny]), jax.vmap(along, out_axes=1)(directions)


class RolloutMisfit:
    """Whole simulations against the measured positions and orientations, from the same beginning.

    A trajectory that begins at t = 0 under no control begins from the robot's own state at rest; any other
    from its own first rows, which then have to be states without noise.
    """

    #: whether a search must not go far at once: simulations of a robot that is far off lead astray
    cautious = True

    def __init__(
        self, robot: System, trajectories: Sequence[Trajectory], unknowns: Unknowns, near: bool = False
    ):
        """`near`: a search begins where the robot is close to the real one."""
        self.robot, self.unknowns, self.near = robot, unknowns, near
        y = np.zeros(robot.y_layout.size)
        try:
            sizes = [np.size(robot.positions(y))]
        except AttributeError as error:
            raise DataError(f"rollouts are compared in positions, and {error}") from None
        with contextlib.suppress(AttributeError):
            sizes.append(np.size(robot.quaternions(y)))
        self.oriented = len(sizes) == 2
        #: what is compared
        self.fields = ("position", "orientation")[: len(sizes)]
        samples(robot, [_without_unused(robot, each) for each in trajectories])  # checks them
        self.rollouts = [_rollout(each) for each in trajectories]
        numbers = np.repeat(np.arange(len(sizes)), sizes)
        count = sum(rollout.y.shape[0] * (rollout.y.shape[1] - 1) for rollout in self.rollouts)
        #: which of `fields` each difference belongs to
        self.groups = np.tile(numbers, count)

    def __call__(self, coordinates: np.ndarray) -> Differences:
        """Differences of all rollouts; infinite if one of them has no solution."""
        system = with_numbers(self.robot, self.unknowns, found(self.unknowns, coordinates))
        parts = []
        for rollout in self.rollouts:
            part = self._of_one(system, coordinates, rollout)
            if part is None:
                size = len(self.groups)
                return Differences(np.full(size, np.inf), np.zeros((size, len(coordinates))))
            parts.append(part)
        values, slopes = zip(*parts, strict=True)
        return Differences(np.concatenate(values), np.concatenate(slopes))

    def _of_one(self, system: System, coordinates: np.ndarray, rollout: _Rollout) -> Differences | None:
        settings, dt, initial, control, y = rollout
        record, begun, _, first = beginning(Run(system, control, initial, settings, dt, None, False))
        task = Task(settings, dt, len(control), first)
        steps, _ = run_one(task, system, control, begun)
        if steps.result.min() < 0:
            return None
        before = None if initial is None else (record, np.asarray(initial.control)[-1])
        rows = _Rows(steps.records, steps.unknowns, begun.past, before, control, y)
        values, slopes = _differences(
            self.robot, coordinates, rows, task.table, dt, self.unknowns, settings, self.oriented
        )
        return Differences(np.asarray(values), np.asarray(slopes))

    def blocks(self, values: Float[np.ndarray, " M"]) -> list[tuple[np.ndarray, np.ndarray]]:
        """The field (n,) of the differences of a row, and these by row (R, n), of each trajectory."""
        counts = [rollout.y.shape[0] for rollout in self.rollouts]
        ends = np.cumsum(counts) * (len(self.groups) // sum(counts))
        parts = zip(np.split(values, ends[:-1]), np.split(self.groups, ends[:-1]), counts, strict=True)
        return [(groups.reshape(count, -1)[0], mine.reshape(count, -1)) for mine, groups, count in parts]

    def beginnings(self) -> list[Float[np.ndarray, " M"]]:
        """Which differences count in searches that lead to where that of all begins: more rows each time.

        A robot that is far from the real one is soon anywhere, and all rows together lead to a limp robot
        that hangs in the middle. The first rows tell the way.
        """
        if self.near:
            return []
        counts = [rollout.y.shape[0] for rollout in self.rollouts]
        rows = np.concatenate([np.arange(count) for count in counts])
        rows = np.repeat(rows, len(self.groups) // len(rows))
        return [(rows < last).astype(float) for last in FIRST_ROWS if last < max(counts)]

    def first_sizes(self) -> Float[np.ndarray, " G"]:
        """Sizes of the differences, by field, before anything is known: of positions, the length."""
        return np.array([float(np.asarray(self.robot.length)), 1.0])[: len(self.fields)]

    def least_sizes(self, coordinates: np.ndarray) -> Float[np.ndarray, " G"]:
        """The solver's tolerance, by field."""
        return LEAST * self.first_sizes()


def _rollout(trajectory: Trajectory) -> _Rollout:
    begins = _first_row(trajectory)
    control, y = (np.asarray(values, dtype=float)[begins:] for values in (trajectory.control, trajectory.y))
    initial = None if _from_rest(trajectory) else trajectory[:begins]
    return _Rollout(trajectory.settings or Settings(), trajectory.dt, initial, control, y)


def _first_row(trajectory: Trajectory) -> int:
    """The first row that is compared: one that has all the rows before it that its scheme looks at."""
    return 1 if trajectory.time[0] == 0.0 else 3


def _from_rest(trajectory: Trajectory) -> bool:
    return bool(trajectory.time[0] == 0.0 and not np.any(trajectory.control[0]))


def _without_unused(robot: System, given: Any) -> Any:
    """A trajectory whose numbers that are not looked at are finite: they need not have been measured."""
    if not isinstance(given, Trajectory) or given.y.ndim != 3 or not _from_rest(given):
        return given
    if given.y.shape[-1] != robot.y_layout.size:
        return given
    unused = tuple(field.name for field in robot.y_layout.fields if field.name not in ("p", "h"))
    where, y = robot.y_layout.indices(unused), np.array(given.y, dtype=float)
    y[..., where] = np.nan_to_num(y[..., where])
    return dataclasses.replace(given, y=y, z=np.nan_to_num(given.z))
