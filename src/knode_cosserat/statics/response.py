"""One equilibrium and its linearisation, compiled: for inverse kinematics and similar tasks.

At an equilibrium G(y, ξ; control) = 0, and with a small wrench W at the tip G + e W = 0. The implicit
function theorem gives the derivatives of the pose with respect to both, from the solver's linearisation.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from knode_cosserat.rods.aspects import Drawing, Ends
from knode_cosserat.rods.system import System, unknown_count
from knode_cosserat.schemes.problem import row_of
from knode_cosserat.schemes.settings import Settings
from knode_cosserat.solvers.refinement import fix_grid
from knode_cosserat.solvers.replay import still_state
from knode_cosserat.solvers.rest import rest_record, unloaded_shape
from knode_cosserat.solvers.run import TimeIntegration
from knode_cosserat.solvers.sensitivity import Changes, static_tangents

#: function from a system and its last node's y to position (d,) in m and quaternion (scalar first) or None
Pose = Callable[[System, Any], tuple[Any, Any]]


def tip_pose(system: System, y: Any) -> tuple[Any, Any]:
    """Return position and orientation of the last node; the orientation is None if the system has none."""
    try:
        turned = Drawing.of(system).quaternions(y)
    except AttributeError:
        turned = None
    return Drawing.of(system).positions(y), turned


class Response(NamedTuple):
    """An equilibrium and its pose's derivatives; not converged if `error` is above `acceptable`.

    Twists belong to the pose: velocity of its position (m), then, if the pose has an orientation, its angular
    velocity (rad), both along the global axes.
    """

    y: Any
    error: Any
    position: Any
    quaternion: Any
    #: twist per control (p, c)
    jacobian: Any
    #: twist per force (N) and moment (N m) at the tip along the global axes (p, w); w is 0 if unavailable
    compliance: Any
    #: a `Result`, and the estimated error of positions (m)
    result: Any
    position_error: Any


def node_values(system: System, settings: Settings, control: Any, y: Any) -> tuple[Any, Any]:
    """Return y and z of an equilibrium at the nodes, from y at all points."""
    found, ny = still_state(system, settings.space, control, np.asarray(y)), system.y_layout.size
    record = row_of(system, found.y, found.records)
    return record[:, :ny], record[:, ny : ny + system.z_layout.size]


def twist(system: System, pose: Pose, y: Any, dy: Any) -> Any:
    """Return the pose's twist for a change dy of the last node's y."""
    (_, h), (dp, dh) = jax.jvp(lambda y: pose(system, y), (y,), (dy,))
    if h is None:
        return dp
    # ω = 2 (δh ∘ h⁻¹), for any length of h
    w, v, dw, dv = h[0], h[1:], dh[0], dh[1:]
    return jnp.concatenate([dp, 2.0 * (w * dv - dw * v - jnp.cross(dv, v)) / jnp.sum(h * h)])


def respond(system: System, settings: Settings, pose: Pose, control: Any, guess: Any) -> Response:
    """Return the equilibrium found from a guess of y at all points, its pose, and the pose's derivatives."""
    control, c, ny = np.asarray(control, dtype=float), system.control_layout.size, system.y_layout.size
    _, y, rows = TimeIntegration(settings).solve(system, control[None], np.asarray(guess))
    # a force and a moment at the tip are added to its conditions on n and m
    layout = Ends.of(system).layout
    names = tuple(name for name in ("n", "m") if name in layout.names)
    wrench = np.asarray(layout.indices(names) if names else [], dtype=int)
    d_controls, d_tip = np.eye(c, c + len(wrench))[None], np.zeros((unknown_count(system), c + len(wrench)))
    d_tip[wrench, c + np.arange(len(wrench))] = 1.0
    solved = rows.records, rows.unknowns
    changes = Changes(d_controls, tip=d_tip)
    d_rows, _, _ = static_tangents(settings, solved, (system, control[None]), changes)
    position, quaternion, twists = _pose_of(system, pose, y[-1], d_rows[0, -1, :ny])
    known = rows.error[0], position, quaternion, twists[:, :c], twists[:, c:]
    return Response(y, *known, rows.result[0], rows.position_error[0])


@functools.partial(jax.jit, static_argnames="pose")
def _pose_of(system, pose, y, d_y):  # type: ignore[no-untyped-def]
    """Return the pose of a last node, and its twists for changes d_y (y, m)."""
    twists = jax.vmap(functools.partial(twist, system, pose, y), in_axes=-1, out_axes=-1)(d_y)
    return *pose(system, y), twists


def equilibrium_poses(system: System, settings: Settings, pose: Pose, controls: np.ndarray) -> Any:
    """Return the poses of many equilibria (B, c), each solved from rest.

    Position, quaternion, error, the largest change from rest of each strain's magnitude, and result.
    """
    y, size, ny = unloaded_shape(system, settings.space), len(controls), system.y_layout.size
    y = np.broadcast_to(y, (size, *y.shape))
    rows = TimeIntegration(settings).solve(system, controls[:, None], y)[2]
    records = rows.records[:, 0]
    strain = (records - rest_record(system))[..., ny : ny + system.z_layout.size]
    lengths = [np.max(np.linalg.norm(part, axis=-1), axis=-1) for part in system.z_layout.split(strain)]
    poses = poses_of(system, pose, records[:, -1, :ny])
    return *poses, rows.error[:, 0], np.stack(lengths, axis=-1), rows.result[:, 0]


@functools.partial(jax.jit, static_argnames="pose")
def poses_of(system, pose, y):  # type: ignore[no-untyped-def]
    """Return the poses of last nodes y (B, y)."""
    return jax.vmap(functools.partial(pose, system))(y)


def first_solved(system: System, settings: Settings, pose: Pose, control: Any) -> Response:
    """Return the response at a control: from rest, then by the recoveries of `equilibrium`.

    Raises `SimulationError` if there is no equilibrium.
    """
    from knode_cosserat.solvers.equilibrium import equilibrium

    control = np.asarray(control, dtype=float)
    found = None
    # a rod that is held at both ends may need another guess, or be turned in parts
    if not Ends.of(system).rest_is_guess:
        found = respond(system, settings, pose, control, unloaded_shape(system, settings.space))
    if found is None or not found.error <= settings.newton.acceptable:
        recovered = equilibrium(
            fix_grid(system), control, space=settings.space, newton=settings.newton, with_stability=False
        )
        found = respond(
            system, settings, pose, control, still_state(system, settings.space, control, recovered.y[0]).y
        )
    return found
