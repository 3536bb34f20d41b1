"""Misfit of simulations with given parameters to measured poses, and its derivatives.

Only positions and orientations are compared, at all nodes of trajectories or at the bodies of a recording. No
velocity, force or strain has to be known. Every solved step is differentiated by the implicit function
theorem.
"""

from __future__ import annotations

import concurrent.futures
import contextlib
import dataclasses
import functools
import os
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.learning.calibration.misfit import LEAST, LinearisedMisfit
from knode_cosserat.learning.calibration.unknowns import (
    Unknowns,
    searched_numbers,
    with_coordinates,
    with_numbers,
)
from knode_cosserat.recordings.measurements import Measurements
from knode_cosserat.rods.system import System, unknowns_of
from knode_cosserat.rotation import since_first
from knode_cosserat.solvers.boundary import NewtonOptions
from knode_cosserat.solvers.history import (
    StateHistory,
    at_stages,
    constant_history,
    rest_record,
    resting_history,
)
from knode_cosserat.solvers.initial import continued_state, initial_state
from knode_cosserat.solvers.places import Places, places_at, positions_at, quaternions_at
from knode_cosserat.solvers.replay import at_one_state
from knode_cosserat.solvers.result import SimulationError
from knode_cosserat.solvers.run import TimeIntegration, run_one
from knode_cosserat.solvers.segments import DataError, samples
from knode_cosserat.solvers.sensitivity import SystemMoves, TangentState, static_tangents, tangent_time_loop
from knode_cosserat.solvers.settings import Settings
from knode_cosserat.solvers.space import SpaceScheme
from knode_cosserat.trajectory import Trajectory

#: numbers of rows in preliminary searches
FIRST_ROWS = (2, 5, 10, 20, 50, 100)
#: row 0 disagrees with the initial equilibrium if it is further away than this part of the length, and than
#: this part of the motion's root mean square
AWAY, OF_MOTION = 0.01, 0.25

#: a trajectory starts unstressed if its row 0 is nearer to that shape than so many times to the equilibrium,
#: measurements if it is so many times nearer: a real robot is never unstressed
UNSTRESSED = 2.0
#: number of parallel rollouts: each keeps one core busy
CORES = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class _Rollout(NamedTuple):
    """One trajectory or recording to be simulated."""

    settings: Settings
    dt: float
    #: the initial rows, or None: it starts from an equilibrium, or unstressed
    initial: Trajectory | None
    #: control of the initial equilibrium, whose row is compared too; None: it starts unstressed, or from rows
    held: Float[np.ndarray, " c"] | None
    control: Float[np.ndarray, "T c"]
    #: places that are compared
    places: Places
    #: position and, if compared, unit quaternion; NaN where nothing was measured
    target: Float[np.ndarray, "T M k"]
    #: True if orientations are relative to row 0
    relative: bool


def _seen(robot: System, oriented: bool, y: Any, places: Places) -> Any:
    """Return positions and, if the robot has orientations, unit quaternions."""
    seen = [positions_at(robot, y, places)]
    if oriented:
        seen.append(quaternions_at(robot, y, places))
    return jnp.concatenate(seen, axis=-1)


class _Rows(NamedTuple):
    """Solved rows of a rollout, their initial state and history, and the measurements."""

    #: of every stage of every step
    records: Float[Any, "solves N x"]
    unknowns: Float[Any, "solves k"]
    past: StateHistory
    #: last row and control of the initial rows, if there are any
    before: Any
    #: y and z of the initial state at the nodes, and the control of an initial equilibrium
    first: Float[Any, "N x"]
    held: Any
    control: Float[Any, "T c"]
    places: Places
    target: Float[Any, "T M k"]


@functools.partial(jax.jit, static_argnames=("unknowns", "settings", "one_state"))
def _started(robot, coordinates, before, past, unknowns, settings, one_state):  # type: ignore[no-untyped-def]
    """Return a system's tangents by each coordinate, stacked, and the initial history with its tangents."""

    def start(x: Any) -> Any:
        system = with_coordinates(robot, unknowns, x)
        if before is None:
            return system, resting_history(system, settings)
        if system.mixed and one_state:
            record, control = before
            return system, constant_history(system, settings, record, control, past.t0)
        return system, past

    def along(direction: Any) -> Any:
        (_, past), (d_system, d_past) = jax.jvp(start, (coordinates,), (direction,))
        return d_system, past, (d_past.records, d_past.rate)

    return jax.vmap(along, out_axes=(0, None, -1))(jnp.eye(coordinates.shape[0]))


@functools.partial(jax.jit, static_argnames=("oriented", "relative"))
def _compared(robot, rows, y, d_y, oriented, relative):  # type: ignore[no-untyped-def]
    """Return differences (M,) of y in all rows from measurements, and their derivatives (M, n)."""

    def left(y: Any) -> Any:
        seen = _seen(robot, oriented, y, rows.places)
        if relative:
            seen = jnp.concatenate([seen[..., :-4], since_first(seen[..., -4:])], axis=-1)
        seen = seen if rows.held is not None else seen[1:]
        target = jnp.where(jnp.isnan(rows.target), 0.0, rows.target)
        if oriented:
            turn = target[..., -4:]
            same = jnp.sum(seen[..., -4:] * turn, axis=-1, keepdims=True) >= 0.0
            target = jnp.concatenate([target[..., :-4], jnp.where(same, turn, -turn)], axis=-1)
        return jnp.where(jnp.isnan(rows.target), 0.0, seen - target).ravel()

    return left(y), jax.vmap(lambda d_y: jax.jvp(left, (y,), (d_y,))[1], in_axes=-1, out_axes=1)(d_y)


def _differences(
    robot: System, system: System, coordinates: Any, rows: _Rows, task: TimeIntegration, unknowns: Unknowns,
    oriented: bool, relative: bool,
) -> LinearisedMisfit:  # fmt: skip
    """Return differences (M,) of solved rows from measurements, and their derivatives (M, n)."""
    settings, ny, n = task.settings, robot.y_layout.size, len(coordinates)
    directions, past, d_past = _started(
        robot, coordinates, rows.before, rows.past, unknowns, settings, task.known == 1
    )
    moves, first = SystemMoves(directions, np.eye(n)), np.asarray(rows.first)
    d_first = np.zeros((*first.shape, n))
    if rows.held is not None:
        solved, held = (first[None], np.asarray(unknowns_of(system, first[0]))[None]), rows.held[None]
        changes = moves, np.zeros((*held.shape, n))
        d_rows, _, d_records = static_tangents(settings, solved, (system, held), changes)
        d_first, past = d_rows[0, :, : first.shape[1]], at_one_state(system, settings, first, rows.held)
        d_past = np.stack([d_records] * 2), np.zeros_like(d_records)
    state = TangentState.of(system, settings.space, past, *d_past)
    changes = moves, np.zeros((*rows.control.shape, n))
    _, (d_records, _) = tangent_time_loop(
        settings, task.coefficients, (rows.records, rows.unknowns), (system, rows.control), changes, state
    )
    last = slice(settings.stages - 1, None, settings.stages)
    y, d_y = (
        np.concatenate([one[None, :, :ny], np.asarray(all_rows)[last, :, :ny]])
        for one, all_rows in ((first, rows.records), (d_first, d_records))
    )
    return LinearisedMisfit(*map(np.asarray, _compared(robot, rows, y, d_y, oriented, relative)))


class RolloutMisfit:
    """Misfit of whole simulations to measured positions and orientations, from the same initial state.

    Measurements, and trajectories from t = 0 under zero control, start at rest: in the equilibrium under the
    controls before row 0, which is compared with row 0. A simulation that began unstressed does so here too:
    row 0 tells which of the two it is. Any other trajectory starts from its own first rows, which must then
    be states without noise.
    """

    #: true if the first step of a search must be limited: distant robots mislead the search
    cautious = True

    def __init__(
        self,
        robot: System,
        given: Sequence[Trajectory] | Sequence[Measurements],
        unknowns: Unknowns,
        near: bool = False,
        space: str | SpaceScheme = "lobatto2",
    ):
        """Set up the rollouts; `near` is true if the initial robot is close to the real one."""
        self.robot, self.unknowns, self.near = robot, unknowns, near
        y = np.asarray(robot.rest(0.0)[0])
        try:
            sizes = [np.size(robot.drawing.positions(y))]
        except AttributeError as error:
            raise DataError(f"rollouts are compared in positions, and {error}") from None
        with contextlib.suppress(AttributeError):
            sizes.append(np.size(robot.drawing.quaternions(y)))
        self.oriented = len(sizes) == 2
        #: number of a position's coordinates
        self._dimension = sizes[0]
        trajectories = [each for each in given if isinstance(each, Trajectory)]
        if trajectories:
            samples(robot, [_without_unused(robot, each) for each in trajectories])  # checks them
        #: true if the data are measurements: no model of a real robot is exact, so the search stops earlier
        self.rough = not trajectories
        self.rollouts = [
            _of_trajectory(robot, self.oriented, each)
            if isinstance(each, Trajectory)
            else _of_measurements(robot, self.oriented, each, space)
            for each in given
        ]
        if not self.rollouts:
            raise DataError("there are no trajectories to compare with")
        self._begun = False
        self._kept: dict[bytes, LinearisedMisfit] = {}
        self._known = [np.isfinite(one.target).ravel() for one in self.rollouts]
        #: compared fields; separate for each recording, because the model's error may differ between them
        self.fields, self._natural, self._groups = self._fields_of(given, sizes)
        #: index in `fields` of each difference
        self.groups = np.concatenate(
            [each[known] for each, known in zip(self._groups, self._known, strict=True)]
        )

    def _fields_of(self, given: Sequence[Any], sizes: list[int]) -> tuple[tuple[str, ...], Any, Any]:
        """Return the measured fields, their natural sizes, and the field of each difference.

        The differences are listed by rollout and include unmeasured ones; never measured ones have field -1.
        """
        apart = self.rough and len(self.rollouts) > 1
        what = ("position", "orientation")[: len(sizes)]
        names = [f" in {name}" for name in _names(given)] if apart else [""]
        labels = [f"{each}{name}" for name in names for each in what]
        natural = [float(np.asarray(self.robot.length)), 1.0][: len(what)] * len(names)
        kinds = np.repeat(np.arange(len(sizes)), sizes)
        groups = [
            np.tile(kinds + apart * len(what) * k, one.target[..., 0].size)
            for k, one in enumerate(self.rollouts)
        ]
        seen = np.unique(
            np.concatenate([each[known] for each, known in zip(groups, self._known, strict=True)])
        )
        number = np.full(len(labels), -1)
        number[seen] = np.arange(len(seen))
        return (
            tuple(labels[k] for k in seen),
            np.array([natural[k] for k in seen]),
            [number[each] for each in groups],
        )

    def __call__(self, coordinates: np.ndarray) -> LinearisedMisfit:
        """Return differences of all rollouts; infinite if a rollout has no solution. The last are cached."""
        key = np.asarray(coordinates).tobytes()
        if key not in self._kept:
            self._kept = {key: self._computed(coordinates)}
        return self._kept[key]

    def _computed(self, coordinates: np.ndarray) -> LinearisedMisfit:
        system = with_numbers(self.robot, self.unknowns, searched_numbers(self.unknowns, coordinates))

        def work(rollout: _Rollout) -> LinearisedMisfit | None:
            return self._of_one(system, coordinates, rollout)

        if self._begun:
            with concurrent.futures.ThreadPoolExecutor(CORES) as pool:
                parts = list(pool.map(work, self.rollouts))
        else:  # programs are compiled one by one
            self._begun, parts = True, list(map(work, self.rollouts))
        solved = [
            LinearisedMisfit(part.values[known], part.slopes[known])
            for part, known in zip(parts, self._known, strict=True)
            if part is not None
        ]
        if len(solved) < len(parts):
            size = len(self.groups)
            return LinearisedMisfit(np.full(size, np.inf), np.zeros((size, len(coordinates))))
        values, slopes = zip(*solved, strict=True)
        return LinearisedMisfit(np.concatenate(values), np.concatenate(slopes))

    def _of_one(self, system: System, coordinates: np.ndarray, rollout: _Rollout) -> LinearisedMisfit | None:
        settings, dt, initial, held, control, places, target, relative = rollout
        if initial is None:
            try:
                at_start = initial_state(system, settings, held=held)
            except SimulationError:
                return None
        else:
            at_start = continued_state(system, initial, settings, dt)
        known = at_start.state.known(settings)
        task = TimeIntegration(settings, dt, len(control), known)
        acting = at_stages(system, settings, control, at_start.control, at_start.state.dt is None)
        found, _, cause = run_one(task, system, acting, at_start.state.history, at_start.control)
        if cause:
            return None
        before = None if initial is None else (at_start.record, at_start.control)
        past = at_start.state.history
        rows = _Rows(*found.every_stage, past, before, at_start.record, held, acting, places, target)
        return _differences(
            self.robot, system, coordinates, rows, task, self.unknowns, self.oriented, relative
        )

    def blocks(self, values: Float[np.ndarray, " M"]) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return for each trajectory the field (n,) of a row's differences, and the differences (R, n)."""
        ends = np.cumsum([known.sum() for known in self._known])[:-1]
        found = []
        for mine, known, groups, one in zip(
            np.split(values, ends), self._known, self._groups, self.rollouts, strict=True
        ):
            whole = np.zeros(len(known))
            whole[known] = mine
            rows = len(one.target)
            fields = groups.reshape(rows, -1)[0]
            found.append((fields[fields >= 0], whole.reshape(rows, -1)[:, fields >= 0]))
        return found

    def require_start(self, coordinates: np.ndarray) -> None:
        """Raise `DataError` if a rollout's row 0 is not the equilibrium that it starts from."""
        values = self(coordinates).values
        ends = np.cumsum([known.sum() for known in self._known])[:-1]
        for k, (mine, known, one) in enumerate(
            zip(np.split(values, ends), self._known, self.rollouts, strict=True)
        ):
            if one.held is None or not np.all(np.isfinite(mine)):
                continue
            left = np.zeros(one.target.shape)
            left[known.reshape(left.shape)] = mine
            moved = one.target - one.target[:1]
            apart, motion = (
                np.linalg.norm(each[..., : self._dimension], axis=-1) for each in (left, np.nan_to_num(moved))
            )
            away, usual = np.max(apart[0]), np.max(np.sqrt(np.mean(motion**2, axis=0)))
            if away > max(AWAY * float(np.asarray(self.robot.length)), OF_MOTION * usual):
                raise DataError(
                    f"recording {k + 1}: row 0 is {1e3 * away:.3g} mm from the equilibrium under "
                    f"{np.round(one.held, 4).tolist()}; allowed is data that start at rest. Use the rows "
                    "after the robot has settled, state initial_tension, or give full states"
                )

    def beginnings(self) -> list[Float[np.ndarray, " M"]]:
        """Return masks of differences for preliminary searches, with more rows each time.

        Simulations of a distant robot soon diverge from the data, and a search on all rows ends at a robot
        that is too soft. A search on the first rows converges.
        """
        if self.near:
            return []
        rows = np.concatenate(
            [
                np.repeat(np.arange(len(one.target)), len(known) // len(one.target))[known]
                for one, known in zip(self.rollouts, self._known, strict=True)
            ]
        )
        return [(rows < last).astype(float) for last in FIRST_ROWS if last <= rows.max()]

    def first_sizes(self) -> Float[np.ndarray, " G"]:
        """Return initial sizes of the differences, by field; for positions, the length."""
        return self._natural

    def least_sizes(self, coordinates: np.ndarray) -> Float[np.ndarray, " G"]:
        """Return the solver's tolerance, by field."""
        return LEAST * self.first_sizes()


def _of_trajectory(robot: System, oriented: bool, trajectory: Trajectory) -> _Rollout:
    begins = _first_row(trajectory)
    control, y = (np.asarray(values, dtype=float)[begins:] for values in (trajectory.control, trajectory.y))
    settings = trajectory.settings or Settings()
    # the base is left out: its pose is given
    places = Places(np.arange(robot.nodes - 1), np.ones(robot.nodes - 1))
    initial: Trajectory | None = trajectory[:begins]
    held = None
    if _from_rest(trajectory):
        initial = None
        first = np.asarray(_seen(robot, False, np.asarray(trajectory.y, dtype=float)[:1], places))[0]
        held = _held_at_start(robot, settings, np.zeros(robot.control_size), places, first, UNSTRESSED)
        y = y if held is None else np.asarray(trajectory.y, dtype=float)
    target = np.asarray(_seen(robot, oriented, y, places))
    return _Rollout(settings, trajectory.dt, initial, held, control, places, target, False)


def _held_at_start(
    robot: System, settings: Settings, control: Any, places: Places, seen: Float[np.ndarray, "M d"],
    ratio: float,
) -> Float[np.ndarray, " c"] | None:  # fmt: skip
    """Return the control of the initial equilibrium; None if row 0 shows the unstressed robot.

    Args:
        robot: initial robot of the search.
        settings: of the simulation.
        control: control before row 0 (c,).
        places: of the measured positions.
        seen: their positions in row 0 (m), NaN where not measured.
        ratio: the robot is unstressed if the distance to that shape is below so many times the other one.
    """
    if not robot.ends.rest_is_guess:
        try:
            settled = np.asarray(initial_state(robot, settings, held=control).record)
        except SimulationError:
            return np.asarray(control)
        size = robot.y_layout.size
        shapes = jnp.stack([rest_record(robot)[:, :size], settled[:, :size]])
        apart = np.nansum((np.asarray(_seen(robot, False, shapes, places)) - seen) ** 2, axis=(1, 2))
        if np.any(np.isfinite(seen)) and apart[0] <= ratio**2 * apart[1]:
            return None
    return np.asarray(control)


def _of_measurements(robot: System, oriented: bool, given: Any, space: str | SpaceScheme) -> _Rollout:
    """Return the rollout of measurements, with the robot at rest in row 0.

    Raises:
        DataError: the measurements are not of this robot, too short, or lack tensions in some rows.
    """
    if not isinstance(given, Measurements):
        raise DataError(f"a {type(given).__name__} is no trajectory and no measurements")
    if len(given.time) < 2:
        raise DataError(f"{given.source}: {len(given.time)} rows; at least 2 are needed")
    if given.tension.shape[1] != robot.control_size:
        raise DataError(
            f"{given.source}: {given.tension.shape[1]} tensions in a row; the robot has {robot.control_size}"
        )
    if not np.any(np.isfinite(given.position[1:])):
        raise DataError(f"{given.source}: no pose was seen after the first row")
    if not np.all(np.isfinite(given.tension)):
        row = int(np.flatnonzero(~np.isfinite(given.tension).all(axis=1))[0])
        raise DataError(
            f"{given.source}: no tension is known at {given.time[row]:g} s; use the part before (`parts`)"
        )
    settings = Settings.of("sdirk2", space, "consistent", NewtonOptions())
    places = places_at(given.fractions, robot.nodes)
    before = given.tension[0] if given.initial_tension is None else given.initial_tension
    held = _held_at_start(robot, settings, before, places, given.position[0], 1.0 / UNSTRESSED)
    begins, quaternion = 1 if held is None else 0, given.quaternion
    target = given.position
    if oriented:
        if held is not None:
            # a body's axes are calibrated at rest, not on a straight robot
            quaternion = np.asarray(since_first(quaternion))
        length = np.linalg.norm(quaternion, axis=-1, keepdims=True)
        target = np.concatenate([target, quaternion / length], axis=-1)
    return _Rollout(
        settings, given.dt, None, held, given.tension[:-1], places, target[begins:],
        oriented and held is not None,
    )  # fmt: skip


def _names(given: Sequence[Measurements]) -> list[str]:
    """Return a name for each recording: the start of its source, or all of it; numbered if equal."""
    names = [each.source.partition(":")[0] for each in given]
    if len(set(names)) < len(names):
        names = [each.source for each in given]
    return [f"{name} ({k + 1})" if names.count(name) > 1 else name for k, name in enumerate(names)]


def _first_row(trajectory: Trajectory) -> int:
    """Return the first compared row: the first one with the full history of its scheme."""
    return 1 if trajectory.time[0] == 0.0 else 3


def _from_rest(trajectory: Trajectory) -> bool:
    return bool(trajectory.time[0] == 0.0 and not np.any(trajectory.control[0]))


def _without_unused(robot: System, given: Any) -> Any:
    """Return a trajectory in which unused numbers are finite: they need not have been measured."""
    if not isinstance(given, Trajectory) or given.y.ndim != 3 or not _from_rest(given):
        return given
    if given.y.shape[-1] != robot.y_layout.size:
        return given
    unused = tuple(field.name for field in robot.y_layout.fields if field.name not in ("p", "h"))
    where, y = robot.y_layout.indices(unused), np.array(given.y, dtype=float)
    y[..., where] = np.nan_to_num(y[..., where])
    return dataclasses.replace(given, y=y, z=np.nan_to_num(given.z))
