"""Prediction of a recording from its measured controls, and its errors."""

from __future__ import annotations

import dataclasses
import types
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from knode_cosserat._arguments import check_arguments
from knode_cosserat.identification.steps import simulated_rows
from knode_cosserat.learning.ensemble import Ensemble, Prediction
from knode_cosserat.metrics import angle_between, dtw_distance, pose_mse, rms_distance
from knode_cosserat.recordings.measurements import Measurements
from knode_cosserat.recordings.recording import Recording
from knode_cosserat.rods.system import System
from knode_cosserat.rotation import quaternion_product, since_first
from knode_cosserat.schemes.result import SimulationError
from knode_cosserat.schemes.space import SpaceScheme
from knode_cosserat.solvers.branches import other_equilibria
from knode_cosserat.solvers.equilibrium import equilibria, equilibrium
from knode_cosserat.solvers.places import seen_positions, seen_quaternions
from knode_cosserat.solvers.refinement import fix_grid
from knode_cosserat.trajectory import Trajectory

#: seconds that recovery may take before a prediction has failed
RECOVERY = 5.0
#: rows that are listed one by one
MOST_LISTED = 6
#: probability of the band of an ensemble's predictions
LEVEL = 0.9


class Band(NamedTuple):
    """Interval of predicted positions that holds those of one more model, and its noise, with a probability.

    Attributes:
        low: lower limits of the positions (m).
        high: upper limits (m).
        level: the probability.
        coverage: part of the measured coordinates inside it; the first row is not counted.
        members: number of models that it was made of.
        failed: number of further models without a solution.
    """

    low: Float[np.ndarray, "T M d"]
    high: Float[np.ndarray, "T M d"]
    level: float
    coverage: float
    members: int
    failed: int


class SeveralEquilibria(NamedTuple):
    """Compared rows of a static recording with several equilibria under their controls.

    The robot's history decides at which one it is; the rows do not have it. The search takes many first
    guesses (`solvers.branches`), finds stable and unstable equilibria, and may miss some.

    Attributes:
        rows: indices of the rows in the recording.
        equilibria: number of equilibria found in each.
        predicted: distance of the tip from the prediction (m).
        nearest: distance of the tip from the nearest of the equilibria (m).
        tip_rmse_nearest: tip RMSE of all rows with the nearest equilibrium of each (m). It is not the error
            of a prediction, since the measurement chooses.
        tip_rmse_unambiguous: tip RMSE of the prediction in the rows with one equilibrium (m), or None.
        tip_rmse_same: tip RMSE of the prediction without rows where another equilibrium is nearer (m), or
            None.
    """

    rows: Int[np.ndarray, " R"]
    equilibria: Int[np.ndarray, " R"]
    predicted: Float[np.ndarray, " R"]
    nearest: Float[np.ndarray, " R"]
    tip_rmse_nearest: float
    tip_rmse_unambiguous: float | None
    tip_rmse_same: float | None

    @property
    def elsewhere(self) -> Bool[np.ndarray, " R"]:
        """True in rows where another equilibrium than the predicted one is nearer to the measurement."""
        return np.asarray(self.nearest < self.predicted)

    def to_dict(self) -> dict[str, Any]:
        """Return all fields as plain JSON values."""
        return {
            name: value.tolist() if isinstance(value, np.ndarray) else value
            for name, value in self._asdict().items()
        }

    def __str__(self) -> str:
        fewest, most = int(self.equilibria.min()), int(self.equilibria.max())
        many = f"{fewest}" if fewest == most else f"{fewest} to {most}"
        where = "row" if len(self.rows) == 1 else "rows"
        words = f"{len(self.rows)} {where} with {many} equilibria ({_listed(self.rows)}"
        if self.tip_rmse_unambiguous is not None:
            words += f"; tip RMSE of the other rows {1e3 * self.tip_rmse_unambiguous:.2f} mm"
        words += ")"
        if not self.elsewhere.any():
            return f"{words}, of which the predicted are the nearest"
        away = [
            f"row {row}: {1e3 * far:.2f} mm, the nearest {1e3 * near:.2f} mm"
            for row, far, near in zip(self.rows, self.predicted, self.nearest, strict=True)
            if near < far
        ]
        more = f"; and {len(away) - MOST_LISTED} more rows" if len(away) > MOST_LISTED else ""
        words += f"; predicted at another than the nearest: {'; '.join(away[:MOST_LISTED])}{more}"
        if self.tip_rmse_same is not None:
            them = "it" if len(away) == 1 else "them"
            words += f"; tip RMSE without {them} {1e3 * self.tip_rmse_same:.2f} mm"
        return f"{words}; with the nearest equilibrium of each row {1e3 * self.tip_rmse_nearest:.2f} mm"


def _listed(rows: Int[np.ndarray, " R"]) -> str:
    """Return indices of rows, the first of many only."""
    first = ", ".join(map(str, rows[:MOST_LISTED]))
    return f"{first} and {len(rows) - MOST_LISTED} more" if len(rows) > MOST_LISTED else first


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Comparison:
    """A recording beside its prediction, in T compared rows and at M bodies.

    Rotations are relative to the first row, because the mounting of the bodies is unknown. Without a
    prediction, everything predicted is None. Numbers are NaN where they are not known.

    Attributes:
        robot: the robot or model; of an ensemble, its first member.
        measured: all rows of the recording.
        rows: indices of the compared rows.
        space: the scheme along the rod.
        position: predicted positions of the bodies (m); of an ensemble, their mean.
        quaternion: predicted orientations at the bodies, scalar first.
        turned: measured orientations, as the predicted ones would be.
        trajectory: the prediction, at the times of the compared rows; of an ensemble, its member nearest to
            the mean.
        extrapolated: True in rows outside what the robot learned from; None: not known.
        band: band of an ensemble's predictions, or None.
    """

    robot: System
    measured: Measurements
    rows: Int[np.ndarray, " T"]
    space: str
    position: Float[np.ndarray, "T M d"] | None = None
    quaternion: Float[np.ndarray, "T M 4"] | None = None
    turned: Float[np.ndarray, "T M 4"] | None = None
    trajectory: Trajectory | None = None
    extrapolated: Bool[np.ndarray, " T"] | None = None
    band: Band | None = None

    @property
    def time(self) -> Float[np.ndarray, " T"]:
        """Times of the compared rows (s)."""
        return self.measured.time[self.rows]

    @property
    def control(self) -> Float[np.ndarray, "T c"]:
        """Measured controls, each held to the next row of the recording."""
        return self.measured.control[self.rows]

    @property
    def seen(self) -> Float[np.ndarray, "T M d"]:
        """Measured positions of the bodies (m); NaN in rows that do not count."""
        known = self.measured.complete[self.rows]
        return np.where(known[:, None, None], self.measured.position[self.rows], np.nan)

    @property
    def distance(self) -> Float[np.ndarray, "T M"]:
        """Distance of each body from its prediction (m)."""
        if self.position is None:
            return np.full(self.seen.shape[:2], np.nan)
        return np.asarray(np.linalg.norm(self.position - self.seen, axis=-1))

    @property
    def angle(self) -> Float[np.ndarray, "T M"]:
        """Angle between the measured and the predicted orientation of each body (rad)."""
        if self.quaternion is None or self.turned is None:
            return np.full(self.seen.shape[:2], np.nan)
        known = self.measured.complete[self.rows]
        return np.where(known[:, None], angle_between(self.quaternion, self.turned), np.nan)


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """Errors of a prediction of a recording.

    Attributes:
        tip_rmse: root mean square distance of the tip (m), or None.
        rotation_rmse: root mean square angle between the orientations of the bodies (rad), or None.
        tip_dtw: dynamic-time-warping distance of the tip (m), or None.
        pose_mse: the paper's mean square error of positions and Euler angles of all bodies, times 1000, or
            None. Euler angles jump at ±π: robots are compared by `rotation_rmse`.
        failed: why there is no prediction, or None.
        extrapolated: part of the rows outside what the robot learned from; None: not known.
        sensors: root mean square error of each sensor beside motion capture, by its name and unit.
        several: rows of equilibria that have several, and errors without them; None if none was found.
        comparison: the rows that were compared; None if there was nothing to simulate.
    """

    tip_rmse: float | None = None
    rotation_rmse: float | None = None
    tip_dtw: float | None = None
    pose_mse: float | None = None
    failed: str | None = None
    extrapolated: float | None = None
    sensors: Mapping[str, float] | None = None
    several: SeveralEquilibria | None = dataclasses.field(default=None, compare=False)
    comparison: Comparison | None = dataclasses.field(default=None, compare=False)

    @property
    def tip(self) -> Float[np.ndarray, "T 3"] | None:
        """Predicted positions of the last body (m), or None."""
        found = None if self.comparison is None else self.comparison.position
        return None if found is None or not found.shape[1] else found[:, -1]

    @property
    def band(self) -> Band | None:
        """Band of an ensemble's predictions, or None."""
        return None if self.comparison is None else self.comparison.band

    def to_dict(self) -> dict[str, Any]:
        """Return the errors, or the reason of a failure, as plain JSON values."""
        errors = {name: getattr(self, name) for name in ("tip_rmse", "rotation_rmse", "tip_dtw", "pose_mse")}
        more = {name: getattr(self, name) for name in ("extrapolated", "failed", "sensors")}
        if self.band:
            more["band"] = {
                name: getattr(self.band, name) for name in ("level", "coverage", "members", "failed")
            }
        if self.several:
            more["several_equilibria"] = self.several.to_dict()
        return errors | {name: value for name, value in more.items() if value is not None}

    def __repr__(self) -> str:
        return f"Evaluation: {self}"

    def __str__(self) -> str:
        if self.failed is not None:
            return f"no prediction: {self.failed}"
        parts = []
        if self.tip_rmse is not None:
            off = 1e3 * (np.zeros(0) if self.comparison is None else self.comparison.distance[:, -1:])
            known = off[np.isfinite(off)]
            spread = f" (median {np.median(known):.2f}, largest {known.max():.2f})" if known.size else ""
            parts.append(f"tip RMSE {1e3 * self.tip_rmse:.2f} mm{spread}")
        if self.rotation_rmse is not None:
            parts.append(f"orientations {np.degrees(self.rotation_rmse):.3g} degrees off")
        if self.pose_mse is not None:
            parts.append(f"the paper's pose MSE {self.pose_mse:.3g}e-3")
        parts += [f"RMSE of {name} {error:.3g}" for name, error in (self.sensors or {}).items()]
        if self.band:
            lost = f", {self.band.failed} more without a solution" if self.band.failed else ""
            parts.append(
                f"{self.band.coverage:.0%} inside the {self.band.level:.0%} band of {self.band.members} "
                f"models{lost}"
            )
        if self.extrapolated:
            moved = None if self.comparison is None else self.comparison.trajectory
            farthest = "" if moved is None else moved.farthest
            share = f"{self.extrapolated:.0%} of the rows extrapolated"
            parts.append(f"{share} ({farthest})" if farthest else share)
        if self.several:
            parts.append(str(self.several))
        return (
            ", ".join(parts) or "nothing to compare: no row has the positions of all bodies and the controls"
        )


def coverage(
    members: Iterable[System],
    measured: Recording | Measurements,
    level: float = LEVEL,
    *,
    space: str | SpaceScheme = "lobatto4",
) -> float:
    """Return the fraction of the measured positions within the spread of several models.

    Each starts in its own equilibrium under the initial tensions. The interval is that of
    `Prediction.interval`, with the noise that an `Ensemble` states; the first row is not counted.

    Args:
        members: at least two models, such as an `Ensemble`.
        measured: a recording, or its rows.
        level: probability.
        space: the scheme along the rod.

    Raises:
        SimulationError: a member has no solution.
        ValueError: there are fewer than two members.
    """
    check_arguments(coverage, locals())
    measured = Measurements.of(measured)
    members = members if isinstance(members, Ensemble) else list(members)
    poses = [
        _Poses.of(robot, predict(robot, measured, space=space, recovery=RECOVERY), measured)
        for robot in members
    ]
    return _prediction(poses, _noise_of(members, measured)).coverage(measured, level, first=0)


def predict(
    robot: System,
    measured: Recording | Measurements,
    *,
    space: str | SpaceScheme = "lobatto4",
    recovery: float | None = None,
) -> Trajectory:
    """Return the motion of a robot under measured tensions, or motor angles, in the rows of the recording.

    It starts in the equilibrium before the first row. Rows of equilibria are separate equilibria. Latencies
    of load cells are corrected, and continuous tensions are followed by short steps (`identification.steps`).

    Args:
        robot: any robot or model.
        measured: a recording (`Measurements.of`), or its rows; the controls are known in all of them.
        space: the scheme along the rod.
        recovery: seconds that recovery from failed steps may take; None: the usual budget.

    Raises:
        RecordingError: the recording has other controls than the robot.
        SimulationError: an equilibrium or a step has no solution.
    """
    check_arguments(predict, locals())
    robot, measured = fix_grid(robot), Measurements.of(measured).controls_for(robot)
    if measured.static:
        return equilibria(
            robot,
            measured.control,
            space=space,
            initial="separate",
            recovery_budget=recovery,
            with_stability=False,
        )
    initial: Any = "unstressed" if measured.unstressed else None
    first = measured.initial_control
    if first is not None and not measured.unstressed:
        initial = equilibrium(robot, first, space=space, recovery_budget=recovery, with_stability=False)
    return simulated_rows(
        robot,
        measured.control[:-1],
        measured.dt,
        initial,
        measured.initial_control,
        measured.continuous,
        space,
        recovery,
    )


def evaluate(
    robot: System | Ensemble,
    measured: Recording | Measurements,
    *,
    ensemble: Sequence[System] | None = None,
    every: int = 1,
    last: int | None = None,
    space: str | SpaceScheme = "lobatto4",
    recovery: float | None = RECOVERY,
) -> Evaluation:
    """Predict a recording from the equilibrium under its initial controls, and compare.

    Rows of equilibria (`measured.static`) are predicted separately.

    Args:
        robot: any robot or model; of an ensemble, the mean of its predictions is compared.
        measured: a recording, or its rows; with continuous tensions the time steps are shorter
            (`identification.steps`).
        ensemble: models whose predictions make a band, such as `Identified.ensemble`; by default the members
            of an ensemble. Members without a solution are left out of the band, which states their number.
        every: interval of compared rows: 1 for all, 2 for every second.
        last: largest number of compared rows.
        space: the scheme along the rod.
        recovery: seconds that recovery from failed steps may take; None: the usual budget.

    Returns:
        The `Evaluation` over the rows in which all bodies were seen; with `failed` if a step has no solution.

    Raises:
        ValueError: `every` or `last` is less than one.
    """
    check_arguments(evaluate, locals())
    measured = Measurements.of(measured)
    alone = robot[0] if isinstance(robot, Ensemble) else robot
    empty = Comparison(alone, measured, _rows(measured, every, last), _name(space))
    members = ensemble if ensemble is not None else robot if isinstance(robot, Ensemble) else ()
    motions = list[tuple[System, Trajectory]]()
    reason = ""
    for member in members:
        try:
            motions.append((member, predict(member, measured, space=space, recovery=recovery)))
        except SimulationError as error:
            reason = str(error)
    try:
        moved = (
            None if isinstance(robot, Ensemble) else predict(robot, measured, space=space, recovery=recovery)
        )
    except SimulationError as error:
        return Evaluation(failed=str(error), comparison=empty)
    if moved is None and not motions:
        return Evaluation(failed=f"no member has a solution; the last: {reason}", comparison=empty)
    found = _compared(empty, moved, motions, len(members), _noise_of(members, measured))
    return dataclasses.replace(found, several=_several(found)) if measured.static else found


def compared(
    robot: System, moved: Trajectory, measured: Measurements, *, every: int = 1, last: int | None = None
) -> Evaluation:
    """Return the errors of a motion in the rows of a recording; arguments as in `evaluate`."""
    space = "unknown" if moved.settings is None else _name(moved.settings.space)
    return _compared(Comparison(robot, measured, _rows(measured, every, last), space), moved, (), 0)


def _name(space: str | SpaceScheme) -> str:
    return space if isinstance(space, str) else space.name or type(space).__name__


def _rows(measured: Measurements, every: int, last: int | None) -> Int[np.ndarray, " T"]:
    for name, value in (("every", every), ("last", last)):
        if value is not None and value < 1:
            raise ValueError(f"{name} must be a number of rows from 1 on (got {value})")
    return np.arange(len(measured.time))[::every][:last]


class _Poses(NamedTuple):
    """Positions (T, M, d) and orientations (T, M, 4) of bodies, the latter NaN for a system without any."""

    position: Float[np.ndarray, "T M d"]
    quaternion: Float[np.ndarray, "T M 4"]

    @classmethod
    def of(cls, robot: System, moved: Trajectory, measured: Measurements) -> _Poses:
        """Return the poses of a motion at the places of a recording's bodies."""
        y, fractions = np.asarray(moved.y), measured.fractions.tolist()
        position = np.asarray(seen_positions(robot, y, fractions, np.asarray(moved.z)))
        try:
            return cls(position, np.asarray(seen_quaternions(robot, y, fractions)))
        except AttributeError:
            return cls(position, np.full((*position.shape[:2], 4), np.nan))


def _prediction(poses: Sequence[_Poses], noise: Any = 0.0) -> Prediction:
    members: Any = poses
    return Prediction(members, noise)


def _noise_of(members: Iterable[System], measured: Measurements) -> Any:
    """Return the noise (M,) of the members of an ensemble at the bodies (m); zero if none is stated."""
    return members.noise_at(measured.fractions) if isinstance(members, Ensemble) else 0.0


def _compared(
    empty: Comparison,
    moved: Trajectory | None,
    motions: Sequence[tuple[System, Trajectory]],
    members: int,
    noise: Any = 0.0,
) -> Evaluation:
    """Return the errors of a prediction.

    Args:
        empty: the rows to compare.
        moved: the prediction; None: the mean of an ensemble's.
        motions: members of an ensemble that have a solution, and their predictions.
        members: number of all members.
        noise: of the members (M,).
    """
    measured, rows = empty.measured, empty.rows
    spread = [
        _Poses(*(values[rows] for values in _Poses.of(robot, motion, measured))) for robot, motion in motions
    ]
    extrapolated: Any
    if moved is None:
        mean = _prediction(spread)
        pose = _Poses(mean.position, mean.quaternion)
        off = [np.nansum((each.position - pose.position) ** 2) for each in spread]
        robot, moved = motions[int(np.argmin(off))]
        known = [motion.extrapolated for _, motion in motions if motion.extrapolated is not None]
        extrapolated = np.any(known, axis=0) if known else None
    else:
        robot, extrapolated = empty.robot, moved.extrapolated
        pose = _Poses(*(values[rows] for values in _Poses.of(robot, moved, measured)))
    # the mounting of bodies is unknown: rotations are relative to the first row, where the robot is at rest
    begun = jnp.broadcast_to(pose.quaternion[0], pose.quaternion.shape)
    since = jnp.asarray(since_first(measured.quaternion[rows]))
    it = dataclasses.replace(
        empty,
        position=pose.position,
        quaternion=pose.quaternion,
        turned=np.asarray(jax.vmap(jax.vmap(quaternion_product))(since, begun)),
        trajectory=dataclasses.replace(_selected(moved, rows), time=empty.time),
        extrapolated=None if extrapolated is None else np.asarray(extrapolated)[rows],
    )
    if len(spread) > 1:
        prediction = _prediction(spread, noise)
        low, high = prediction.interval(LEVEL)
        inside = prediction.coverage(types.SimpleNamespace(position=it.seen), LEVEL, first=0)
        it = dataclasses.replace(it, band=Band(low, high, LEVEL, inside, len(spread), members - len(spread)))
    return _errors(it, robot, moved)


def _selected(moved: Trajectory, rows: Int[np.ndarray, " T"]) -> Trajectory:
    step = int(rows[1] - rows[0]) if len(rows) > 1 else 1
    return moved[: int(rows[-1]) + 1 : step]


def _errors(it: Comparison, robot: System, moved: Trajectory) -> Evaluation:
    """Return the errors of a comparison; those of sensors are of one motion of one robot."""
    position, turned = np.asarray(it.position), np.asarray(it.turned)
    known, bodies = it.measured.complete[it.rows], bool(len(it.measured.fractions))
    tip = (position[known, -1], it.seen[known, -1]) if bodies and known.any() else None
    quaternion = np.asarray(it.quaternion)
    oriented = np.isfinite(turned).all(axis=(1, 2)) & known
    mse = None
    if bodies and oriented.any():
        mse = pose_mse(
            *(
                types.SimpleNamespace(position=p[oriented], quaternion=h[oriented])
                for p, h in ((position, quaternion), (it.seen, turned))
            )
        )
    angle = it.angle[np.isfinite(it.angle)]
    return Evaluation(
        tip_rmse=tip and float(rms_distance(*tip)),
        rotation_rmse=float(np.sqrt(np.mean(angle**2))) if angle.size else None,
        tip_dtw=tip and dtw_distance(*tip),
        pose_mse=mse,
        extrapolated=None if it.extrapolated is None else float(np.mean(it.extrapolated)),
        sensors=_sensor_errors(it, robot, moved) or None,
        comparison=it,
    )


def _several(found: Evaluation) -> SeveralEquilibria | None:
    """Return the rows with several equilibria, where the tip was seen; None if there are none."""
    it = found.comparison
    if it is None or it.trajectory is None or found.tip_rmse is None:
        return None
    others, records = other_equilibria(it.trajectory)
    predicted = it.distance[:, -1]
    known = np.isfinite(predicted)
    rows, count = np.unique(others[known[others]], return_counts=True)
    if not len(rows):
        return None
    system, width = it.trajectory.system, it.trajectory.system.y_layout.size
    y, z = np.split(records, [width], axis=-1)
    position = np.asarray(seen_positions(system, y, it.measured.fractions.tolist(), z))
    away = np.linalg.norm(position[:, -1] - it.seen[others, -1], axis=-1)
    nearest = np.array([min(predicted[row], *away[others == row]) for row in rows])
    every = predicted.copy()
    every[rows] = nearest

    def rms(chosen: Bool[np.ndarray, " T"]) -> float | None:
        return float(np.sqrt(np.mean(predicted[chosen] ** 2))) if chosen.any() else None

    alone = known & ~np.isin(np.arange(len(known)), rows)
    return SeveralEquilibria(
        rows=it.rows[rows],
        equilibria=count + 1,
        predicted=predicted[rows],
        nearest=nearest,
        tip_rmse_nearest=float(np.sqrt(np.mean(every[known] ** 2))),
        tip_rmse_unambiguous=rms(alone),
        tip_rmse_same=rms(known & (every == predicted)),
    )


def _sensor_errors(it: Comparison, robot: System, moved: Trajectory) -> dict[str, float]:
    """Return the root mean square error of each sensor, by its name and unit."""
    y, z = np.asarray(moved.y)[it.rows], np.asarray(moved.z)[it.rows]
    sensors = {}
    for sensor in it.measured.sensors:
        output = sensor.output
        errors = np.asarray(output.errors(robot, y, z, sensor.values[it.rows]))
        known_units = [label.partition("(")[2].rstrip(")") or "rad" for label in output.labels]
        units = np.array(known_units if len(known_units) == errors.shape[1] else ["rad"] * errors.shape[1])
        for unit in dict.fromkeys(units.tolist()):
            off = errors[:, units == unit]
            sensors[f"{sensor.topic} ({unit})"] = float(np.sqrt(np.nanmean(off**2)))
    return sensors
