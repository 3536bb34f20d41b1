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

from knode_cosserat.rods.system import System, unknown_count
from knode_cosserat.solvers.boundary import Solution, factors_of, newton, pivots_of
from knode_cosserat.solvers.evaluation import still_state
from knode_cosserat.solvers.history import rest_record
from knode_cosserat.solvers.linear import solved_correction
from knode_cosserat.solvers.problem import StepProblem, row_of
from knode_cosserat.solvers.run import Equilibria
from knode_cosserat.solvers.settings import Settings
from knode_cosserat.solvers.static_loop import unloaded_shape

#: function from a system and its last node's y to position (d,) in m and quaternion (scalar first) or None
Pose = Callable[[System, Any], tuple[Any, Any]]


def tip_pose(system: System, y: Any) -> tuple[Any, Any]:
    """Return position and orientation of the last node; the orientation is None if the system has none."""
    try:
        turned = system.quaternions(y)
    except AttributeError:
        turned = None
    return system.positions(y), turned


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


def static_problem(system: System, settings: Settings, control: Any) -> StepProblem:
    """Return the boundary-value problem of `kc.equilibrium`."""
    return StepProblem.still(system, settings.space, control)


def solve_response(system: System, settings: Settings, control: Any, y: Any, unknowns: Any) -> Solution:
    """Solve for an equilibrium from a guess; its `error` tells if it converged."""
    problem = static_problem(system, settings, control).ready()
    return newton(problem, y, unknowns, settings.newton)[0]


def node_values(system: System, settings: Settings, control: Any, y: Any) -> tuple[Any, Any]:
    """Return y and z of an equilibrium at the nodes, from y at all points."""
    found, ny = still_state(system, settings.space, control, np.asarray(y)), system.y_layout.size
    record = row_of(system, found.y, found.records)
    return record[:, :ny], record[:, ny : ny + system.z_layout.size]


def wrench_fields(system: System) -> tuple[str, ...]:
    """Return the tip's conditions to which a force and a moment at the tip are added."""
    return tuple(name for name in ("n", "m") if name in system.tip_layout.names)


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
    control = np.asarray(control, dtype=float)
    _, y, rows = Equilibria(settings, 1).solve(system, control[None], np.asarray(guess), (0, 1))
    unknowns = rows.unknowns[0]
    pose_and_slopes = _pose_of(system, settings, pose, control, y, unknowns)
    return Response(y, rows.error[0], *pose_and_slopes)


@functools.partial(jax.jit, static_argnames=("settings", "pose"))
def _pose_of(system, settings, pose, control, y, unknowns):  # type: ignore[no-untyped-def]
    """Return the pose of an equilibrium, and its derivatives by controls and by a wrench."""
    problem = static_problem(system, settings, control)
    factors, pivots = factors_of(problem, y, unknowns), pivots_of(system)

    def by_control(d_control: Any) -> Any:
        def at_solution(control: Any) -> Any:
            problem = static_problem(system, settings, control)
            return *problem.residuals(y), problem.base(unknowns)

        defects, tip, base = jax.jvp(at_solution, (control,), (d_control,))[1]
        dy, _ = solved_correction(factors, pivots, defects, tip, base)
        return twist(system, pose, y[-1], dy[-1])

    def by_wrench(tip: Any) -> Any:
        dy, _ = solved_correction(factors, pivots, jnp.zeros_like(y[1:]), tip)
        return twist(system, pose, y[-1], dy[-1])

    names = wrench_fields(system)
    columns = np.eye(unknown_count(system))[system.tip_layout.indices(names) if names else []]
    position, quaternion = pose(system, y[-1])
    jacobian = jax.vmap(by_control, out_axes=-1)(jnp.eye(system.control_size))
    empty = jnp.zeros((jacobian.shape[0], 0))
    compliance = jax.vmap(by_wrench, out_axes=-1)(jnp.asarray(columns)) if names else empty
    return position, quaternion, jacobian, compliance


def equilibrium_poses(system: System, settings: Settings, pose: Pose, controls: np.ndarray) -> Any:
    """Return the poses of many equilibria (B, c), each solved from rest.

    Position, quaternion, error, and the largest change from rest of each strain's magnitude.
    """
    y, size, ny = unloaded_shape(system, settings.space), len(controls), system.y_layout.size
    y = np.broadcast_to(y, (size, *y.shape))
    rows = Equilibria(settings, 1).solve_many(system, controls[:, None], y)[2]
    records = rows.records[:, 0]
    strain = (records - rest_record(system))[..., ny : ny + system.z_layout.size]
    lengths = [np.max(np.linalg.norm(part, axis=-1), axis=-1) for part in system.z_layout.split(strain)]
    return *poses_of(system, pose, records[:, -1, :ny]), rows.error[:, 0], np.stack(lengths, axis=-1)


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
    if not system.rest_is_guess:
        found = respond(system, settings, pose, control, unloaded_shape(system, settings.space))
    if found is None or not found.error <= settings.newton.acceptable:
        recovered = equilibrium(system, control, space=settings.space, newton=settings.newton)
        found = respond(
            system, settings, pose, control, still_state(system, settings.space, control, recovered.y[0]).y
        )
    return found
