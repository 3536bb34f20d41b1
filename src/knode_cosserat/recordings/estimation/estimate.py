"""Estimation of full states on a model's nodes from a recording, for learning from a real robot."""

from __future__ import annotations

import dataclasses
from typing import Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline

from knode_cosserat._arguments import check_arguments
from knode_cosserat.recordings.estimation import balance, curvature, kinematics
from knode_cosserat.recordings.estimation.balance import KnownRows, packed_fields
from knode_cosserat.recordings.estimation.curvature import CapturedPoses
from knode_cosserat.recordings.findings import RecordingError, naming
from knode_cosserat.recordings.measurements import Measurements
from knode_cosserat.recordings.recording import Recording
from knode_cosserat.recordings.streams import Body
from knode_cosserat.rods.system import System
from knode_cosserat.schemes.settings import MEASURED, Settings
from knode_cosserat.schemes.space import Euler
from knode_cosserat.trajectory import Trajectory

Method = Literal["best", "paper"]
#: initial noise (m, rad)
NOISE = (3e-4, 3e-3)
#: largest ratio between the lengths of robot and recording, or its inverse
UNLIKE = 2.0
#: margin of poses used before the first row and after the last (s)
AROUND = 0.5
#: tolerance of stamps of one frame (s)
_SAME = 1e-4
#: smallest number of bodies away from the clamped end, and of rows
FEWEST_BODIES, FEWEST_ROWS = 2, 4


def estimate_states(
    recording: Recording | Measurements,
    robot: System,
    method: Method = "best",
    dt: float = 0.05,
    start: float | None = None,
    end: float | None = None,
) -> Trajectory:
    """Estimate full states from a recording: y and z on the robot's nodes, as data for learning.

    `method="best"` finds the rod's curvature over arclength and time that fits the poses best
    (`curvature`), at motion capture's own rate. Positions, orientations, velocities and accelerations are
    integrals of it. n and m follow from the robot's balance, integrated from the tip, and v from its
    constitutive law. u is the measured curvature, not the law's result for m, so that errors of the robot's
    model remain visible. `method="paper"` is the paper's
    method: cubic splines of positions and spherical interpolation of orientations over arclength at every
    row, central differences in time in the material frame (the paper's own scripts leave q in the global
    one), and the discrete equations of a simulation for n and m.

    Positions, orientations, velocities and u come from the recording alone. n, m and v depend on the
    robot's masses and loads and are as accurate as these.

    Args:
        recording: a recording, or its measurements on a grid; a recording gives better results.
        robot: the robot whose nodes, balance and constitutive law are used.
        method: "best" or "paper".
        dt: time from row to row (s).
        start: time of the first row (s); None: as in `Recording.sampled`.
        end: latest time of the last row (s).

    Returns:
        A `Trajectory` with the recording's times. It has no settings, except by the paper's method: there it
        has those of Euler's scheme, and the states satisfy its discrete equations. Row i has the control
        with which `simulate` reaches it: the tension held from row i - 1 on (row 0 has its own tension).

    Raises:
        RecordingError: the recording is in parts (then use `estimate_parts`), does not fit the robot, or has
            too few bodies or no orientations; or the method or a time is not allowed.
    """
    check_arguments(estimate_states, locals(), RecordingError)
    (states,) = _estimated_parts(recording, robot, method, (dt, start, end), is_one=True)
    return states


def estimate_parts(
    recording: Recording | Measurements,
    robot: System,
    method: Method = "best",
    dt: float = 0.05,
    start: float | None = None,
    end: float | None = None,
) -> list[Trajectory]:
    """Estimate full states, as `estimate_states`, of every part between gaps too long to be bridged.

    Raises:
        RecordingError: as in `estimate_states`, except that several parts are allowed.
    """
    check_arguments(estimate_parts, locals(), RecordingError)
    return _estimated_parts(recording, robot, method, (dt, start, end), is_one=False)


#: time from row to row, and times of the first and of the last row (s)
_Times = tuple[float, float | None, float | None]


def _estimated_parts(
    recording: Recording | Measurements, robot: System, method: str, times: _Times, *, is_one: bool
) -> list[Trajectory]:
    """Return the states of all parts; with `is_one` there may be no other part.

    Raises:
        RecordingError: an argument is not allowed, the recording does not fit the robot, or has too few data.
    """
    balance.require_rod(robot)
    rows = _rows(recording, times)
    with naming(rows.source):
        parts = _parts(recording, rows, robot, times[0])
        for part in parts:
            ratio = _stretch(part, robot)
            if not 1.0 / UNLIKE < ratio < UNLIKE:
                raise RecordingError(
                    f"its rod is {ratio * float(robot.length):.3f} m long and the robot "
                    f"{float(robot.length):.3f} m; allowed is up to {UNLIKE:g} times that, or a half"
                )
        if is_one and len(parts) > 1:
            listed = ", ".join(f"{part.rows.time[0]:g} to {part.rows.time[-1]:g} s" for part in parts)
            raise RecordingError(
                f"the recording is in {len(parts)} parts ({listed}); choose one by start and end, or take "
                "all of them by estimate_parts"
            )
        return [_estimated(part, robot, method) for part in parts]


def _stretch(part: _Interval, robot: System) -> float:
    """Return the ratio of the rod's length to its model's, from the straightest row."""
    places = part.fractions * float(robot.length)
    reach = np.linalg.norm(part.rows.position[:, part.rows.fractions > 0.0], axis=2)
    return float(np.nanmax(reach @ places / (places @ places)))


def _estimated(part: _Interval, robot: System, method: str) -> Trajectory:
    tension, settings = part.rows.control, None
    # the tension held from the row before; for the first row, its own
    control = np.concatenate([tension[:1], tension[:-1]])
    if method == "paper":
        settings = dataclasses.replace(MEASURED, space=Euler())
        y, z = _paper_states(part, robot, control, settings)
    else:
        y, z = _best(part, robot, control)
    rows = len(part.rows.time)
    if not (np.isfinite(y).all() and np.isfinite(z).all()):
        raise RecordingError("the robot's equations gave states that are not finite")
    return Trajectory(
        system=robot,
        settings=settings,
        time=part.rows.time,
        y=y,
        z=z,
        control=control,
        result=np.zeros(rows, dtype=int),
        residual=np.zeros(rows),
        iterations=np.zeros(rows, dtype=int),
    )


def _best(part: _Interval, robot: System, control: Float[np.ndarray, "T c"]) -> tuple[np.ndarray, np.ndarray]:
    """Return y and z at the nodes: the motion, n and m from the robot's balance, and v from its law."""
    y0, z0 = (np.asarray(values, dtype=float) for values in robot.rest(jnp.zeros(())))
    h, p = y0[robot.y_layout.slice("h")], y0[robot.y_layout.slice("p")]
    rod = kinematics.RodGeometry.of(
        float(robot.length), robot.nodes, part.fractions, h / np.linalg.norm(h), p
    )
    time = part.rows.time
    fit = curvature.fitted(rod, part.poses, _stretch(part, robot), NOISE)
    motion = kinematics.motion(rod, fit.at(time), fit.stretch)
    shape = motion.shape
    spin = np.concatenate([np.zeros_like(motion.w[..., :1]), motion.w], axis=-1)
    h_t = 0.5 * kinematics.hamilton(shape.h, spin)
    p_t = kinematics.rotated(shape.R, motion.q)
    z = np.broadcast_to(z0, (*motion.q.shape[:2], robot.z_layout.size)).copy()
    z[..., robot.z_layout.slice("u")] = shape.u
    rows = KnownRows(
        t=time,
        control=control,
        y=packed_fields(robot, "y", p=shape.p, h=shape.h, q=motion.q, w=motion.w),
        y_t=packed_fields(robot, "y", p=p_t, h=h_t, q=motion.q_t, w=motion.w_t),
        z=z,
        z_t=packed_fields(robot, "z", u=motion.u_t),
    )
    y = balance.loads_of(robot, rod.s, rows)[:, rod.nodes]
    at_nodes = rows._replace(y=y, y_t=rows.y_t[:, rod.nodes], z=z[:, rod.nodes], z_t=rows.z_t[:, rod.nodes])
    dt = float(np.mean(np.diff(time)))
    by_law = balance.strains_of(robot, at_nodes, MEASURED, round(dt, 9)).copy()
    by_law[..., robot.z_layout.slice("u")] = shape.u[:, rod.nodes]
    return y, by_law


def _paper_states(
    part: _Interval, robot: System, control: Float[np.ndarray, "T c"], settings: Settings
) -> tuple[Float[np.ndarray, "T N y"], Float[np.ndarray, "T N z"]]:
    """Return y and z of the rows. Raises `RecordingError` if a body has no orientation."""
    rows = part.rows
    used = rows.fractions > 0.0
    if not np.isfinite(rows.quaternion[:, used]).all():
        raise RecordingError("a body has no orientation; the paper's method needs that of every body")
    y0 = np.asarray(robot.rest(jnp.zeros(()))[0], dtype=float)
    p0, h0 = y0[robot.y_layout.slice("p")], y0[robot.y_layout.slice("h")]
    count = len(rows.time)
    places = np.concatenate([[0.0], rows.fractions[used]])
    position = np.concatenate([np.broadcast_to(p0, (count, 1, 3)), rows.position[:, used]], axis=1)
    quaternion = np.concatenate([np.broadcast_to(h0, (count, 1, 4)), rows.quaternion[:, used]], axis=1)
    nodes = np.linspace(0.0, 1.0, robot.nodes)
    p, h = _along(places, position, quaternion, nodes)
    dt = rows.dt
    R = kinematics.matrices(h)
    p_t = np.gradient(p, dt, axis=0, edge_order=2)
    h_t = np.gradient(h, dt, axis=0, edge_order=2)
    q = (np.swapaxes(R, -1, -2) @ p_t[..., None])[..., 0]
    w = 2.0 * kinematics.hamilton(h * np.array([1.0, -1.0, -1.0, -1.0]), h_t)[..., 1:]
    known = packed_fields(robot, "y", p=p, h=h, q=q, w=w)
    return balance.semi_discretised(robot, (rows.time, control, known), settings, round(dt, 9))


def _along(
    places: Float[np.ndarray, " B"],
    position: Float[np.ndarray, "T B 3"],
    quaternion: Float[np.ndarray, "T B 4"],
    nodes: Float[np.ndarray, " N"],
) -> tuple[Float[np.ndarray, "T N 3"], Float[np.ndarray, "T N 4"]]:
    """Return positions and orientations at the nodes for every row."""
    p = np.asarray(CubicSpline(places, position, axis=1)(nodes))
    after = np.clip(np.searchsorted(places, nodes, side="left"), 1, len(places) - 1)
    part = (nodes - places[after - 1]) / (places[after] - places[after - 1])
    start, to = quaternion[:, after - 1], quaternion[:, after]
    turn = kinematics.turn_between(to, start) * part[:, None]
    angle = np.linalg.norm(turn, axis=-1, keepdims=True)
    step = np.concatenate([np.cos(angle / 2), np.sinc(angle / (2 * np.pi)) / 2 * turn], axis=-1)
    h = kinematics.hamilton(step, start)
    # q and -q are the same rotation: choose the continuous sign, because rows are differentiated in time
    flips = np.cumprod(np.where(np.sum(h[1:] * h[:-1], axis=-1) < 0.0, -1.0, 1.0), axis=0)
    h[1:] *= flips[..., None]
    return p, np.where(h[:1, :, :1] < 0.0, -h, h)


# parts of a recording


@dataclasses.dataclass(frozen=True, eq=False)
class _Interval:
    """Unbroken part of a recording: the rows to estimate, and the bodies away from the clamped end.

    `poses` are at motion capture's own rate, `fractions` the places of the bodies.
    """

    rows: Measurements
    poses: CapturedPoses
    fractions: Float[np.ndarray, " M"]


def _rows(recording: Recording | Measurements, times: _Times) -> Measurements:
    """Return the rows to estimate. Raises `RecordingError` if measurements have another time step."""
    dt, start, end = times
    if isinstance(recording, Recording):
        return recording.sampled(dt, start, end)
    rows = recording
    if start is not None or end is not None:
        rows = rows.between(-np.inf if start is None else start, np.inf if end is None else end + 1e-9)
    if abs(rows.dt - dt) > 1e-6 * dt:
        raise RecordingError(
            f"{rows.source}: its rows are {rows.dt:g} s apart and dt is {dt:g} s; allowed is the same"
        )
    return rows


def _parts(
    recording: Recording | Measurements, rows: Measurements, robot: System, dt: float
) -> list[_Interval]:
    """Return the parts with enough rows for an estimation. Raises `RecordingError` without any."""
    rows = rows.controls_for(robot)
    _check(rows)
    pieces = rows.parts(shortest=(FEWEST_ROWS - 1) * dt)
    if not pieces:
        raise RecordingError(
            f"no {FEWEST_ROWS} rows of {dt:g} s one after the other with all positions and controls"
        )
    used = rows.fractions > 0.0
    parts = []
    for piece in pieces:
        poses = (
            _frames([body for body, use in zip(recording.bodies, used, strict=True) if use], piece.time)
            if isinstance(recording, Recording)
            else _of_rows(piece, used)
        )
        parts.append(_Interval(piece, poses, rows.fractions[used]))
    return parts


def _check(rows: Measurements) -> None:
    away = rows.fractions > 0.0
    if away.sum() < FEWEST_BODIES:
        raise RecordingError(
            f"{int(away.sum())} bodies on the rod away from its clamped end; "
            f"required is {FEWEST_BODIES} or more"
        )
    if not np.isfinite(rows.quaternion[:, away]).all(axis=2).any():
        raise RecordingError(
            "no body has orientations; required for states is one or more (see the "
            "recording's findings, the markers' `rotation` and `rest` in its configuration)"
        )


def _of_rows(rows: Measurements, used: np.ndarray) -> CapturedPoses:
    position, quaternion = rows.position[:, used], rows.quaternion[:, used]
    turned = np.isfinite(quaternion).all(axis=2)
    filled = np.where(turned[..., None], quaternion, [1.0, 0.0, 0.0, 0.0])
    # bridged poses are not observations
    seen = rows.measured[:, used]
    return CapturedPoses(rows.time, position, filled, seen, turned & seen)


def _frames(bodies: list[Body], time: Float[np.ndarray, " T"]) -> CapturedPoses:
    """Return the poses of all bodies, grouped by frame."""
    first, last = time[0] - AROUND, time[-1] + AROUND
    inside = [body.time[(body.time >= first) & (body.time <= last)] for body in bodies]
    stamps = np.unique(np.concatenate(inside))
    frames = stamps[np.concatenate([[True], np.diff(stamps) > _SAME])]
    count = (len(frames), len(bodies))
    position, quaternion = np.zeros((*count, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (*count, 1))
    placed, turned = np.zeros(count, dtype=bool), np.zeros(count, dtype=bool)
    for k, body in enumerate(bodies):
        inside_rows = np.flatnonzero((body.time >= first) & (body.time <= last))
        row = np.searchsorted(frames, body.time[inside_rows] + _SAME / 2, side="right") - 1
        position[row, k], placed[row, k] = body.position[inside_rows], True
        if body.quaternion is not None:
            quaternion[row, k], turned[row, k] = body.quaternion[inside_rows], True
    return CapturedPoses(frames, position, quaternion, placed, turned)
