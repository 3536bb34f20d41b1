"""Estimation of full states on a model's nodes from a recording, for learning from a real robot."""

from __future__ import annotations

from typing import Literal, get_args

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.recordings.estimation import balance, curvature, kinematics, paper
from knode_cosserat.recordings.estimation.balance import KnownRows, packed_fields
from knode_cosserat.recordings.estimation.observations import RecordingPart, parts_of
from knode_cosserat.recordings.findings import RecordingError
from knode_cosserat.recordings.measurements import Measurements
from knode_cosserat.recordings.recording import Recording
from knode_cosserat.rods.system import System
from knode_cosserat.solvers.settings import Settings
from knode_cosserat.solvers.space import Euler
from knode_cosserat.trajectory import Trajectory

Method = Literal["best", "paper"]
#: initial noise (m, rad)
NOISE = (3e-4, 3e-3)
#: largest ratio between the lengths of robot and recording, or its inverse
UNLIKE = 2.0


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
    model remain visible. `method="paper"` is the paper's method (`paper`).

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
    found = _parts(recording, robot, method, dt, start, end)
    if len(found) > 1:
        times = ", ".join(f"{part.rows.time[0]:g} to {part.rows.time[-1]:g} s" for part in found)
        raise RecordingError(
            f"{found[0].rows.source}: the recording is in {len(found)} parts ({times}); choose one by start "
            "and end, or take all of them by estimate_parts"
        )
    return _estimated(found[0], robot, method)


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
    return [_estimated(part, robot, method) for part in _parts(recording, robot, method, dt, start, end)]


def _parts(
    recording: Recording | Measurements,
    robot: System,
    method: str,
    dt: float,
    start: float | None,
    end: float | None,
) -> list[RecordingPart]:
    if method not in get_args(Method):
        raise RecordingError(f'method is {method!r}; allowed is "best" or "paper"')
    if not isinstance(robot, System):
        raise RecordingError(f"robot is a {type(robot).__name__}; allowed is a robot or a model")
    balance.require_rod(robot)
    parts = parts_of(recording, robot, dt, start, end)
    for part in parts:
        ratio = _stretch(part, robot)
        if not 1.0 / UNLIKE < ratio < UNLIKE:
            raise RecordingError(
                f"{part.rows.source}: its rod is {ratio * float(robot.length):.3f} m long and the robot "
                f"{float(robot.length):.3f} m; allowed is up to {UNLIKE:g} times that, or a half"
            )
    return parts


def _stretch(part: RecordingPart, robot: System) -> float:
    """Return the ratio of the rod's length to its model's, from the straightest row."""
    places = part.fractions * float(robot.length)
    reach = np.linalg.norm(part.rows.position[:, part.rows.fractions > 0.0], axis=2)
    return float(np.nanmax(reach @ places / (places @ places)))


def applied_controls(part: RecordingPart) -> Float[np.ndarray, "T c"]:
    """Return for each row the tension held from the row before; for the first, its own."""
    tension = part.rows.tension
    return np.concatenate([tension[:1], tension[:-1]])


def _estimated(part: RecordingPart, robot: System, method: str) -> Trajectory:
    control, settings = applied_controls(part), None
    if method == "paper":
        settings = Settings(space=Euler(), start="paper")
        y, z = paper.paper_states(part, robot, control, settings)
    else:
        y, z = _best(part, robot, control)
    rows = len(part.rows.time)
    if not (np.isfinite(y).all() and np.isfinite(z).all()):
        raise RecordingError(f"{part.rows.source}: the robot's equations gave states that are not finite")
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


def rod_of(part: RecordingPart, robot: System) -> kinematics.RodGeometry:
    """Return the grid for a robot and the bodies of a recording."""
    y0 = np.asarray(robot.rest(jnp.zeros(()))[0], dtype=float)
    h = y0[robot.y_layout.slice("h")]
    return kinematics.RodGeometry.of(
        float(robot.length),
        robot.nodes,
        part.fractions,
        h / np.linalg.norm(h),
        y0[robot.y_layout.slice("p")],
    )


def _best(
    part: RecordingPart, robot: System, control: Float[np.ndarray, "T c"]
) -> tuple[np.ndarray, np.ndarray]:
    rod, time = rod_of(part, robot), part.rows.time
    fit = curvature.fitted(rod, part.poses, _stretch(part, robot), NOISE)
    it = kinematics.motion(rod, fit.at(time), fit.stretch)
    return completed(robot, rod, it, time, control)


def completed(
    robot: System,
    rod: kinematics.RodGeometry,
    it: kinematics.RodMotion,
    time: Float[np.ndarray, " T"],
    control: Float[np.ndarray, "T c"],
) -> tuple[Float[np.ndarray, "T N y"], Float[np.ndarray, "T N z"]]:
    """Return y and z at the nodes: the motion, n and m from the robot's balance, and v from its law."""
    spin = np.concatenate([np.zeros_like(it.w[..., :1]), it.w], axis=-1)
    h_t = 0.5 * kinematics.hamilton(it.shape.h, spin)
    p_t = (it.shape.R @ it.q[..., None])[..., 0]
    _, z_rest = robot.rest(jnp.zeros(()))
    z = np.broadcast_to(np.asarray(z_rest), (*it.q.shape[:2], robot.z_layout.size)).copy()
    z[..., robot.z_layout.slice("u")] = it.shape.u
    rows = KnownRows(
        t=time,
        control=control,
        y=packed_fields(robot, "y", p=it.shape.p, h=it.shape.h, q=it.q, w=it.w),
        y_t=packed_fields(robot, "y", p=p_t, h=h_t, q=it.q_t, w=it.w_t),
        z=z,
        z_t=packed_fields(robot, "z", u=it.u_t),
    )
    y = balance.loads_of(robot, rod.s, rows)[:, rod.nodes]
    at_nodes = rows._replace(y=y, y_t=rows.y_t[:, rod.nodes], z=z[:, rod.nodes], z_t=rows.z_t[:, rod.nodes])
    dt = float(np.mean(np.diff(time)))
    by_law = balance.strains_of(robot, at_nodes, Settings(), round(dt, 9)).copy()
    by_law[..., robot.z_layout.slice("u")] = it.shape.u[:, rod.nodes]
    return y, by_law
