"""Distances between a predicted and a reference trajectory, and errors of estimated states.

The distances use NumPy and SciPy on plain arrays. They compare simulated, predicted or recorded data with
positions and quaternions. The metrics of the paper's result tables are `tip_dtw` and `pose_mse`; the
paper is Jiahao et al., "Knowledge-based Neural Ordinary Differential Equations for Cosserat Rod-based Soft
Robots".

Every row counts, including the first. The paper keeps T rows of a trajectory under T controls: the initial
state and the states after all but the last control. To reproduce its numbers, slice before comparing.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple, Protocol

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike, NDArray

from knode_cosserat._arguments import check_arguments, numbers_of
from knode_cosserat.trajectory import Trajectory

__all__ = [
    "StateError",
    "dtw_distance",
    "node_error",
    "pose_mse",
    "rotation_rmse",
    "state_errors",
    "tip_dtw",
    "tip_rmse",
]

Array = NDArray[np.float64]
#: tolerance of equal times (s) and of equal places along the rod (fraction of its length)
_SAME = 1e-6


class PoseHistory(Protocol):
    """Protocol of a trajectory's data for the metrics; a `quaternion` beside it is checked too."""

    @property
    def position(self) -> ArrayLike:
        """Positions (T, N, 3) in m, global frame; (T, N, 2) of a planar system."""


class OrientedHistory(PoseHistory, Protocol):
    """Protocol of a trajectory's data with orientations, for `pose_mse`."""

    @property
    def quaternion(self) -> ArrayLike:
        """Quaternions (T, N, 4), scalar first, material to global frame; any nonzero norm."""


def dtw_distance(a: ArrayLike, b: ArrayLike) -> float:
    """Return the exact dynamic-time-warping distance (m) between two paths, with the L1 ground distance.

    The distance is the smallest sum of |Δx| + |Δy| + |Δz| over all monotone alignments that match both first
    points and both last points; planar paths have no Δz. There is no window and no normalisation by the
    alignment's length. Time grows with T · S, memory with T + S.

    Args:
        a: (T, 3) m, or (T, 2).
        b: (S, 3) m, or (S, 2).

    Raises:
        ValueError: a path is not (T, 3) or (T, 2), is empty, or has NaN or inf; or one is planar only.

    Source: Sakoe & Chiba, "Dynamic programming algorithm optimization for spoken word recognition", 1978,
    without slope constraint and with every step weighted one, as in the paper's result tables.
    """
    a = _path("first path", a)
    b = _path("second path", b)
    if a.shape[1] != b.shape[1]:
        raise ValueError(
            f"the paths have {a.shape[1]} and {b.shape[1]} coordinates; allowed is equal numbers"
        )
    _require_finite("first path", a)
    _require_finite("second path", b)

    # All cells (i, j) with i + j = k depend on the two antidiagonals before only, so each is one vector
    # operation. Reversed, b lies along the antidiagonal in the direction of a. Columns make each
    # coordinate contiguous.
    rows, columns = len(a), len(b)
    forward = np.ascontiguousarray(a.T)
    backward = np.ascontiguousarray(b[::-1].T)
    # Entry i + 1 is cell i of the antidiagonal; entry 0 and cells outside the table stay infinite.
    two_before, one_before, current = np.full((3, rows + 1), np.inf)
    two_before[0] = 0.0
    for k in range(rows + columns - 1):
        first, last = max(0, k - columns + 1), min(k, rows - 1) + 1
        shift = columns - 1 - k
        difference = forward[:, first:last] - backward[:, first + shift : last + shift]
        np.abs(difference, out=difference)
        cheapest = np.minimum(one_before[first:last], one_before[first + 1 : last + 1])
        np.minimum(cheapest, two_before[first:last], out=cheapest)
        current.fill(np.inf)
        current[first + 1 : last + 1] = sum(difference, start=cheapest)
        two_before, one_before, current = one_before, current, two_before
    return float(one_before[rows])


def tip_dtw(prediction: PoseHistory, reference: PoseHistory) -> float:
    """Return `dtw_distance` (m) between the paths of the two tips, the last nodes; it grows with the rows.

    The trajectories may differ in rows and in nodes.

    Raises:
        ValueError: a shape is wrong or a state is invalid.

    Source: "Tip Position DTW" in the paper's simulation and real-world result tables.
    """
    (predicted, _), (expected, _) = _poses("prediction", prediction), _poses("reference", reference)
    return dtw_distance(predicted[:, -1], expected[:, -1])


def pose_mse(prediction: OrientedHistory, reference: OrientedHistory) -> float:
    """Return the mean squared error of positions and orientations, times 1000, as in the paper's tables.

    The mean runs over rows, nodes and six numbers: x, y, z in metres and three Euler angles in radians,
    extrinsic in the order z, y, x. It adds m² to rad², and angles on opposite sides of ±π differ by almost
    2π; both are part of the published definition.

    Raises:
        ValueError: a shape is wrong, rows or nodes differ, a state is invalid, or there are no orientations,
            as in planar systems, for which `node_error` and `tip_rmse` compare positions.

    Source: "Pose MSE (× 10³)" in the paper's simulation result table.
    """
    predicted, expected = _comparable_poses(prediction, reference)
    for name, pose in (("prediction", predicted), ("reference", expected)):
        if pose[1] is None:
            raise ValueError(
                f"{name} has no orientations, quaternion (T, N, 4), which pose_mse compares; use node_error "
                "or tip_rmse"
            )
    position_error = predicted[0] - expected[0]
    angles = [_rotations(quaternion).as_euler("zyx") for _, quaternion in (predicted, expected)]
    angle_error = (angles[0] - angles[1]).reshape(*position_error.shape[:2], 3)
    return float(1000 * np.mean(np.concatenate([position_error, angle_error], axis=-1) ** 2))


def tip_rmse(prediction: PoseHistory, reference: PoseHistory) -> float:
    """Return the root mean square over rows of the distance (m) between the two tips, the last nodes.

    The trajectories may differ in nodes.

    Raises:
        ValueError: a shape is wrong, rows differ, or a state is invalid.
    """
    predicted, expected = _comparable_poses(prediction, reference, same_nodes=False)
    return float(rms_distance(predicted[0][:, -1], expected[0][:, -1]))


def rotation_rmse(prediction: PoseHistory, reference: PoseHistory) -> float:
    """Return the root mean square over rows and nodes of the angle (rad) between the orientations, 0 to π.

    Unlike the Euler angles of `pose_mse` it does not depend on the axes of the global frame.

    Raises:
        ValueError: a shape is wrong, rows or nodes differ, or a state is invalid.
    """
    predicted, expected = _comparable_poses(prediction, reference)
    turned, from_there = (_rotations(each[1]) for each in (predicted, expected))
    return float(np.sqrt(np.mean((from_there.inv() * turned).magnitude() ** 2)))


def node_error(prediction: PoseHistory, reference: PoseHistory) -> Array:
    """Return the root mean square over rows of the distance (m) between positions, for each node, (N,).

    Raises:
        ValueError: a shape is wrong, rows or nodes differ, or a state is invalid.
    """
    predicted, expected = _comparable_poses(prediction, reference)
    return rms_distance(predicted[0], expected[0])


def rms_distance(a: Array, b: Array) -> Array:
    """Return the root mean square over time (...) of the distances between points (T, ..., d)."""
    return np.sqrt(np.mean(np.sum((a - b) ** 2, axis=-1), axis=0))


def _rotations(quaternion: Array) -> Any:
    # imported here, because the import takes a third of a second
    from scipy.spatial.transform import Rotation

    scalar_last = np.roll(quaternion, -1, axis=-1)
    return Rotation.from_quat(scalar_last.reshape(-1, 4))


def _comparable_poses(
    prediction: PoseHistory, reference: PoseHistory, same_nodes: bool = True
) -> tuple[Any, Any]:
    predicted = _poses("prediction", prediction)
    expected = _poses("reference", reference)
    for axis, what in enumerate(("rows", "nodes", "coordinates")):
        given, wanted = predicted[0].shape[axis], expected[0].shape[axis]
        if given != wanted and (same_nodes or what != "nodes"):
            raise ValueError(
                f"prediction has {given} {what} and reference has {wanted}; both must have the same number"
            )
    return predicted, expected


def _poses(name: str, history: PoseHistory) -> tuple[Array, Array | None]:
    """Return positions (T, N, d), and quaternions (T, N, 4) or None of a system without orientations."""
    if not hasattr(history, "position"):
        raise ValueError(
            f"{name} is a {type(history).__name__}; allowed is a Trajectory, or anything with position "
            "(T, N, 3) or (T, N, 2) in m, and quaternion (T, N, 4) if it has orientations"
        )
    position = np.asarray(history.position, dtype=float)
    if position.ndim == 4:
        raise ValueError(
            f"{name}.position has shape {position.shape}, a batch of {len(position)} trajectories; "
            "index a single trajectory, (T, N, 3)"
        )
    if position.ndim != 3 or position.shape[-1] not in (2, 3) or position.size == 0:
        raise ValueError(
            f"{name}.position has shape {position.shape}; it must be (T, N, 3), or (T, N, 2) in a plane, "
            "with at least one row and node"
        )
    if not hasattr(history, "quaternion"):
        _require_finite(name, position)
        return position, None
    quaternion = np.asarray(history.quaternion, dtype=float)
    if quaternion.shape != (*position.shape[:2], 4):
        raise ValueError(
            f"{name}.quaternion has shape {quaternion.shape}; "
            f"beside position {position.shape} it must be {(*position.shape[:2], 4)}"
        )
    _require_finite(name, position, quaternion, np.where(quaternion.any(axis=-1), 0.0, np.nan))
    return position, quaternion


def _path(name: str, points: ArrayLike) -> Array:
    points = numbers_of(name, points, "(T, 3) in m, or (T, 2)")
    if points.ndim != 2 or points.shape[1] not in (2, 3) or len(points) == 0:
        raise ValueError(
            f"{name} has shape {points.shape}; it must be (T, 3), or (T, 2) in a plane, with at least one row"
        )
    return points


def _require_finite(name: str, *arrays: Array) -> None:
    valid = np.all([np.isfinite(array).reshape(len(array), -1).all(axis=1) for array in arrays], axis=0)
    if not valid.all():
        raise ValueError(
            f"{name} has invalid states from row {int(np.argmin(valid))} on; compare only the valid rows"
        )


# states


class StateError(NamedTuple):
    """Error of one quantity: root mean square over rows and nodes of a vector's length.

    Attributes:
        rms: root mean square of the error.
        size: root mean square of the true quantity; for an orientation, of its angle from upright.
        unit: unit of both.
    """

    rms: float
    size: float
    unit: str


def state_errors(
    estimate: Trajectory, truth: Trajectory, start: float | None = None
) -> dict[str, StateError]:
    """Return the errors of all fields that estimate and truth share in y and z; h's error is an angle.

    Args:
        estimate: estimated states of one robot.
        truth: true states; they may have more rows and more nodes.
        start: rows before this time are left out (s).

    Raises:
        ValueError: the truth has no row at a time of the estimate, or no node at a place.
    """
    check_arguments(state_errors, locals())
    for name, it in (("estimate", estimate), ("truth", truth)):
        if np.ndim(it.y) != 3:
            raise ValueError(f"the {name} is a batch of {len(it.y)}; allowed is one robot")
    time = np.asarray(estimate.time)
    mine = np.flatnonzero(time >= (-np.inf if start is None else start) - _SAME)
    rows = _matching(time[mine], np.asarray(truth.time), "row", "s")
    places = [np.linspace(0.0, 1.0, np.shape(it.y)[1]) for it in (estimate, truth)]
    nodes = _matching(places[0], places[1], "node", "of its length")
    errors = {}
    for name, unit in _common_rows(estimate, truth):
        found = np.asarray(estimate.part(name), dtype=float)[mine]
        true = np.asarray(truth.part(name), dtype=float)[np.ix_(rows, nodes)]
        if name == "h":
            upright = np.broadcast_to([1.0, 0.0, 0.0, 0.0], true.shape)
            errors[name] = StateError(
                _rms(angle_between(found, true)), _rms(angle_between(true, upright)), "rad"
            )
        else:
            errors[name] = StateError(_rms(_length(found - true)), _rms(_length(true)), unit)
    return errors


def _common_rows(estimate: Trajectory, truth: Trajectory) -> Iterator[tuple[str, str]]:
    for part in ("y_layout", "z_layout"):
        mine, other = getattr(estimate.system, part), getattr(truth.system, part)
        sizes = {field.name: field.size for field in other.fields}
        for field in mine.fields:
            if sizes.get(field.name) == field.size:
                yield field.name, field.unit


def _matching(
    wanted: Float[np.ndarray, " a"], there: Float[np.ndarray, " b"], what: str, unit: str
) -> Int[np.ndarray, " a"]:
    nearest = (
        np.abs(there[None, :] - wanted[:, None]).argmin(axis=1) if len(wanted) else np.zeros(0, dtype=int)
    )
    far = np.abs(there[nearest] - wanted) > _SAME
    if len(wanted) == 0 or far.any():
        missing = f" at {wanted[np.argmax(far)]:g} {unit}" if len(wanted) else " to compare"
        raise ValueError(f"the truth has no {what}{missing}; required is one for each of the estimate's")
    return np.asarray(nearest)


def _length(vectors: Float[np.ndarray, "T N size"]) -> Any:
    return np.linalg.norm(vectors, axis=-1)


def angle_between(a: Float[np.ndarray, "T N 4"], b: Float[np.ndarray, "T N 4"]) -> Any:
    """Return the angle (rad) between orientations, accurate also for small angles."""
    a, b = a / np.linalg.norm(a, axis=-1, keepdims=True), b / np.linalg.norm(b, axis=-1, keepdims=True)
    b = np.where(np.sum(a * b, axis=-1, keepdims=True) < 0.0, -b, b)
    return 4.0 * np.arcsin(np.clip(np.linalg.norm(a - b, axis=-1) / 2.0, 0.0, 1.0))


def _rms(values: Any) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
