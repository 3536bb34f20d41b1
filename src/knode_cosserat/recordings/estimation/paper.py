"""The paper's state estimation: splines along the rod, differences in time, and the discrete equations.

Positions are cubic splines over arclength through base and bodies; orientations are interpolated spherically.
Both are evaluated at the model's nodes, row by row. Velocities are central differences in time, in the
material frame (the paper's own scripts leave q in the global one). n and m are integrated from the tip with
the discrete equations of a simulation. v and u follow from the robot's constitutive law.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.recordings.estimation import balance, kinematics
from knode_cosserat.recordings.estimation.observations import RecordingPart
from knode_cosserat.recordings.findings import RecordingError
from knode_cosserat.rods.system import System
from knode_cosserat.solvers.settings import Settings


def paper_states(
    part: RecordingPart, robot: System, control: Float[np.ndarray, "T c"], settings: Settings
) -> tuple[Float[np.ndarray, "T N y"], Float[np.ndarray, "T N z"]]:
    """Return y and z of the rows. Raises `RecordingError` if a body has no orientation."""
    rows = part.rows
    used = rows.fractions > 0.0
    if not np.isfinite(rows.quaternion[:, used]).all():
        raise RecordingError(
            f"{rows.source}: a body has no orientation; the paper's method needs that of every body"
        )
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
    known = balance.packed_fields(robot, "y", p=p, h=h, q=q, w=w)
    return balance.semi_discretised(robot, rows.time, control, known, settings, round(dt, 9))


def _along(
    places: Float[np.ndarray, " B"],
    position: Float[np.ndarray, "T B 3"],
    quaternion: Float[np.ndarray, "T B 4"],
    nodes: Float[np.ndarray, " N"],
) -> tuple[Float[np.ndarray, "T N 3"], Float[np.ndarray, "T N 4"]]:
    """Return positions and orientations at the nodes for every row."""
    from scipy.interpolate import CubicSpline

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
