"""Prediction of a recording from its measured tensions, and its errors."""

from __future__ import annotations

import dataclasses
import types
from collections.abc import Iterable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat._arguments import check_arguments
from knode_cosserat.identification.steps import simulated_rows
from knode_cosserat.learning.ensemble import Prediction
from knode_cosserat.metrics import dtw_distance, pose_mse, rotation_rmse
from knode_cosserat.recordings.measurements import Measurements
from knode_cosserat.recordings.recording import Recording
from knode_cosserat.rods.system import System
from knode_cosserat.rotation import quaternion_product, since_first
from knode_cosserat.schemes.result import SimulationError
from knode_cosserat.schemes.space import SpaceScheme
from knode_cosserat.solvers.equilibrium import equilibria, equilibrium
from knode_cosserat.solvers.places import seen_positions, seen_quaternions
from knode_cosserat.solvers.refinement import fix_grid
from knode_cosserat.trajectory import Trajectory

#: seconds that recovery may take before a prediction has failed
RECOVERY = 5.0


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """A prediction against its recording.

    Attributes:
        tip_dtw: dynamic-time-warping distance of the tip (m), or None.
        tip_rmse: root mean square distance of the tip (m), or None.
        pose_mse: mean square error of positions and Euler angles of all bodies, times 1000, or None.
        rotation_rmse: root mean square angle between the orientations of all bodies (rad), or None.
        failed: why there is no prediction, or None.
        tip: predicted positions of the last body (m), or None.
        extrapolated: part of the rows outside the range that the robot was identified in; None: not known.
        sensors: root mean square error of each sensor beside motion capture, by its name and unit.
    """

    tip_dtw: float | None = None
    tip_rmse: float | None = None
    pose_mse: float | None = None
    rotation_rmse: float | None = None
    failed: str | None = None
    tip: Float[np.ndarray, "T 3"] | None = None
    extrapolated: float | None = None
    sensors: Mapping[str, float] | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return the errors, or the reason of a failure, as plain JSON values."""
        errors = {name: getattr(self, name) for name in ("tip_dtw", "pose_mse", "tip_rmse", "rotation_rmse")}
        more = {name: getattr(self, name) for name in ("extrapolated", "failed", "sensors")}
        return errors | {name: value for name, value in more.items() if value is not None}

    def __repr__(self) -> str:
        return f"Evaluation: {self}"

    def __str__(self) -> str:
        if self.failed is not None:
            return f"no prediction: {self.failed}"
        parts = []
        if self.tip_rmse is not None:
            parts.append(f"tip RMSE {1e3 * self.tip_rmse:.2f} mm")
        if self.pose_mse is not None and self.rotation_rmse is not None:
            degrees = np.degrees(self.rotation_rmse)
            parts.append(f"pose MSE {self.pose_mse:.3g}e-3, orientations {degrees:.3g} degrees off")
        parts += [f"RMSE of {name} {error:.3g}" for name, error in (self.sensors or {}).items()]
        if self.extrapolated:
            parts.append(f"{self.extrapolated:.0%} of the rows extrapolated")
        return ", ".join(parts)


def coverage(
    members: Iterable[System],
    measured: Recording | Measurements,
    level: float = 0.9,
    *,
    space: str | SpaceScheme = "lobatto4",
) -> float:
    """Return the fraction of the measured positions within the spread of several models.

    Each starts in its own equilibrium under the initial tensions. The interval contains one more model with
    the given probability (Student's t), as in `Prediction.interval`; the first row is not counted.

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
    predicted = list[Any]()
    for robot in members:
        moved = predict(robot, measured, space=space, recovery=RECOVERY)
        seen = seen_positions(robot, np.asarray(moved.y), measured.fractions)
        predicted.append(types.SimpleNamespace(position=seen))
    return Prediction(predicted).coverage(measured, level, first=0)


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
        measured: a recording (`Measurements.of`), or its rows; the tensions are known in all of them.
        space: the scheme along the rod.
        recovery: seconds that recovery from failed steps may take; None: the usual budget.

    Raises:
        SimulationError: an equilibrium or a step has no solution.
    """
    check_arguments(predict, locals())
    robot, measured = fix_grid(robot), Measurements.of(measured)
    if measured.static:
        return equilibria(
            robot,
            measured.tension,
            space=space,
            initial="separate",
            recovery_budget=recovery,
            with_stability=False,
        )
    initial: Any = "unstressed" if measured.unstressed else None
    first = measured.initial_tension
    if first is not None and not measured.unstressed:
        initial = equilibrium(robot, first, space=space, recovery_budget=recovery, with_stability=False)
    return simulated_rows(
        robot,
        measured.tension[:-1],
        measured.dt,
        initial,
        measured.initial_tension,
        measured.continuous,
        space,
        recovery,
    )


def evaluate(
    robot: System,
    measured: Recording | Measurements,
    *,
    every: int = 1,
    last: int | None = None,
    space: str | SpaceScheme = "lobatto4",
    recovery: float | None = RECOVERY,
) -> Evaluation:
    """Predict a recording from the equilibrium under its initial tensions, and compare.

    Rows of equilibria (`measured.static`) are predicted separately.

    Args:
        robot: any robot or model.
        measured: a recording, or its rows; with continuous tensions the time steps are shorter
            (`identification.steps`).
        every: interval of compared rows: 1 for all, 2 for every second.
        last: largest number of compared rows.
        space: the scheme along the rod.
        recovery: seconds that recovery from failed steps may take; None: the usual budget.

    Returns:
        The `Evaluation` over the rows in which all bodies were seen; with `failed` if a step has no solution.
    """
    check_arguments(evaluate, locals())
    measured = Measurements.of(measured)
    try:
        moved = predict(robot, measured, space=space, recovery=recovery)
    except SimulationError as error:
        return Evaluation(failed=str(error))
    return compared(robot, moved, measured, every=every, last=last)


def compared(
    robot: System, moved: Trajectory, measured: Measurements, *, every: int = 1, last: int | None = None
) -> Evaluation:
    """Return the errors of a motion in the rows of a recording; arguments as in `evaluate`."""
    rows = np.arange(len(measured.time))[::every][:last]
    y, z = np.asarray(moved.y)[rows], np.asarray(moved.z)[rows]
    position = np.asarray(seen_positions(robot, y, measured.fractions, z))
    quaternion = np.asarray(seen_quaternions(robot, y, measured.fractions))
    seen, known = measured.position[rows], measured.complete[rows]
    # the mounting of bodies is unknown: rotations are relative to the first row, where the robot is at rest
    begun = jnp.broadcast_to(quaternion[0], quaternion.shape)
    since = jnp.asarray(since_first(measured.quaternion[rows]))
    turned = np.asarray(jax.vmap(jax.vmap(quaternion_product))(since, begun))
    oriented = np.isfinite(turned).all(axis=(1, 2)) & known
    mse = rotation = tip = None
    if len(measured.fractions):
        tip = position[known, -1], seen[known, -1]
    if tip and oriented.any():
        poses = [
            types.SimpleNamespace(position=p[oriented], quaternion=h[oriented])
            for p, h in ((position, quaternion), (seen, turned))
        ]
        mse, rotation = pose_mse(*poses), rotation_rmse(*poses)
    sensors = {}
    for sensor in measured.sensors:
        output = sensor.output
        errors = np.asarray(output.errors(robot, y, z, sensor.values[rows]))
        known_units = [label.partition("(")[2].rstrip(")") or "rad" for label in output.labels]
        units = np.array(known_units if len(known_units) == errors.shape[1] else ["rad"] * errors.shape[1])
        for unit in dict.fromkeys(units.tolist()):
            off = errors[:, units == unit]
            sensors[f"{sensor.topic} ({unit})"] = float(np.sqrt(np.nanmean(off**2)))
    return Evaluation(
        tip_dtw=tip and dtw_distance(*tip),
        tip_rmse=tip and float(np.sqrt(np.mean(np.sum((tip[0] - tip[1]) ** 2, axis=1)))),
        pose_mse=mse,
        rotation_rmse=rotation,
        tip=tip and position[:, -1],
        extrapolated=None if moved.extrapolated is None else float(np.mean(moved.extrapolated[rows])),
        sensors=sensors or None,
    )
