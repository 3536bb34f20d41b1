"""Co-simulation with MuJoCo: a rod on a site of a rigid robot, such as the flange of an arm.

The rod's base follows the site, and the wrench of the rod acts on the site's body. Both are solved together
in each step. With the mean wrench w on the body in the step, MuJoCo returns the velocity v(w) of the site
after it, and the rod returns its mean wrench W(v). Newton's method, with Broyden's updates, solves

    W(v(w)) = w,     (1 + B A) δw = W - w,     A = H J M⁻¹ Jᵀ,     B = -∂W/∂v

with the step H, MuJoCo's mass matrix M, and the Jacobian J of the site. B is the rod's apparent inertia over
H: where that is large against the flange's, motions by the wrench of the step before diverge at any step.

MuJoCo's semi-implicit integrators have velocities half a time step before positions. The rod takes the site's
pose of that time. The impulses on both are then equal, and momentum is kept to the tolerance.
"""

from __future__ import annotations

import importlib
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from knode_cosserat._arguments import check_arguments
from knode_cosserat._files.yaml_text import did_you_mean
from knode_cosserat.errors import KnodeCosseratError
from knode_cosserat.rods.ends import Clamped, Moving
from knode_cosserat.rods.rod import SlenderRod
from knode_cosserat.schemes.space import SpaceScheme
from knode_cosserat.solvers import Result, SimulationError, Stepper, equilibrium
from knode_cosserat.trajectory import Trajectory

__all__ = ["CouplingError", "RodOnSite"]

#: most corrections of the wrench in a step; and from how many on the rod's apparent inertia is measured again
MOST, MANY = 20, 4
#: displacement of the site in a step, as part of the rod's length, by which the apparent inertia is measured
PROBE = 1e-3
#: largest apparent inertia of the rod against that of the site: free flanges were unstable from 8.5 on
HEAVIEST = 5.0


class CouplingError(KnodeCosseratError, ValueError):
    """A rod and a MuJoCo model cannot be coupled; the message is one line."""

    code = "coupling"


class _Interface(NamedTuple):
    """Motion of the site: pose, then velocity and angular velocity, global frame."""

    p: Float[np.ndarray, "3"]
    h: Float[np.ndarray, "4"]
    twist: Float[np.ndarray, "6"]


class RodOnSite:
    """A rod robot on a site (or body) of a MuJoCo model.

        coupled = RodOnSite(robot, model, data, "attachment_site")
        data.ctrl[:] = …
        coupled.step(tensions)
        coupled.state.tip_position[0], coupled.wrench

    The robot's `base_end` may have a position and an orientation, which are then in the frame of the site.
    Gravity is the model's. Motions are stable while the rod's apparent inertia is less than about five times
    that of the site, beyond which a warning is given; that of an arm is far larger than its rod's.
    """

    def __init__(
        self,
        robot: SlenderRod,
        model: Any,
        data: Any,
        site: str,
        *,
        substeps: int = 1,
        space: str | SpaceScheme = "lobatto4",
        tolerance: float = 1e-7,
    ):
        """Couple them at the present state of `data`, the rod in equilibrium with the motion of the site.

        Args:
            robot: a rod with a clamped base.
            model: a `mujoco.MjModel`.
            data: its `mujoco.MjData`, which `step` advances.
            site: name of the site, or of the body, that carries the rod.
            substeps: time steps of MuJoCo in a step of the rod, in which the wrench is constant.
            space: scheme along the rod, as in `simulate`.
            tolerance: of the wrench, relative to its size.

        Raises:
            CouplingError: there is no such site, or the robot cannot be on it.
            ImportError: MuJoCo is not installed.
        """
        check_arguments(RodOnSite.__init__, locals())
        try:
            self._mujoco = importlib.import_module("mujoco")
        except ImportError:
            raise ImportError("MuJoCo is not installed: pip install 'knode-cosserat[mujoco]'") from None
        if not isinstance(model, self._mujoco.MjModel) or not isinstance(data, self._mujoco.MjData):
            raise CouplingError(
                f"model and data are {type(model).__name__} and {type(data).__name__}; allowed are a"
                " mujoco.MjModel and its MjData"
            )
        if substeps < 1 or not tolerance > 0.0:
            raise CouplingError(
                f"substeps is {substeps} and tolerance {tolerance}; allowed are 1 or more, and above 0"
            )
        self.model, self.data, self.tolerance, self.substeps = model, data, tolerance, substeps
        self._place(site)
        if not isinstance(robot.base_end, Moving):
            if type(robot.base_end) is not Clamped:
                raise CouplingError(f"base_end is {robot.base_end.kind}; allowed is clamped or moving")
            mount = {name: getattr(robot.base_end, name) for name in ("position", "orientation")}
            robot = robot.replace(base_end=Moving(**mount))
        #: the rod, with the gravity of the model
        self.robot = robot.replace(gravity=np.array(model.opt.gravity))
        layout = self.robot.control_layout
        self._columns = [
            layout.slice(f"base_{name}")
            for name in ("position", "orientation", "velocity", "angular_velocity")
        ]
        self._own = np.setdiff1d(
            np.arange(layout.size), np.concatenate([np.arange(layout.size)[each] for each in self._columns])
        )
        self._natural = np.asarray(self.robot.scales().y)[[7, 10]]
        #: time step of the rod (s)
        self.dt = float(model.opt.timestep) * substeps
        self._h = np.array([1.0, 0.0, 0.0, 0.0])
        own, interface = np.zeros(len(self._own)), self._interface()
        begun = self._control(own, interface)
        start = equilibrium(self.robot, begun, space=space)
        self._stepper = Stepper(self.robot, self.dt, space=space, initial=start, errors=False)
        #: wrench of the rod on the site in the last step: force (N) and moment (N·m) about it, global frame
        self.wrench = self._at_site(np.asarray(start.base_wrench[0]), start)
        #: corrections of the wrench in the last step
        self.corrections = 0
        self._inertia = self._measured_inertia(own, interface)
        largest = float(np.max(np.abs(np.linalg.eigvals(self._inertia @ self._mobility()))))
        if largest > HEAVIEST:
            warnings.warn(
                f"the rod's inertia is {largest:.3g} times that of the site; motions are stable up to about "
                f"{HEAVIEST:g}: give the body more mass or inertia, or the model shorter time steps",
                stacklevel=2,
            )

    def __repr__(self) -> str:
        return f"RodOnSite: {self._stepper!r}"

    @property
    def state(self) -> Trajectory:
        """Present state of the rod, a trajectory of one row; its control has the motion of its base."""
        return self._stepper.state

    def step(self, control: Any = ()) -> Trajectory:
        """Advance both by the rod's time step under its own control (k,), and return the rod's state.

        Raises:
            CouplingError: a control of a wrong shape.
            SimulationError: the step was not solved. Model and rod are then in the state before it.
        """
        own = np.asarray(control, dtype=float)
        if own.shape != (len(self._own),):
            raise CouplingError(f"the control has shape {own.shape}; allowed is ({len(self._own)},)")
        kind = self._mujoco.mjtState.mjSTATE_INTEGRATION
        before = np.empty(self._mujoco.mj_stateSize(self.model, kind))
        self._mujoco.mj_getState(self.model, self.data, before, kind)

        def restore() -> None:
            self._mujoco.mj_setState(self.model, self.data, before, kind)

        try:
            after, wrench, self.corrections = self._solve(own, restore)
            state = self._stepper.step(self._control(own, after))
        except Exception:
            restore()
            raise
        self.wrench = wrench
        return state

    def _solve(
        self, own: np.ndarray, restore: Callable[[], None]
    ) -> tuple[_Interface, Float[np.ndarray, "6"], int]:
        """Return the motion of the site after a step of the model, the wrench in it, and the corrections."""
        if self.corrections >= MANY:
            self._inertia = self._measured_inertia(own, self._interface())
        slope, wrench = np.eye(6) + self._inertia @ self._mobility(), self.wrench
        missing = step = np.zeros(6)
        for k in range(MOST):
            restore()
            after = self._advance(wrench)
            row = self._stepper.preview(self._control(own, after))
            found = self._at_site(row.mean_base_wrench[0], row)
            error = found - wrench
            if np.all(np.abs(error) <= self.tolerance * self._size(found)):
                return after, wrench, k
            if k:
                # Broyden's update
                slope += np.outer(missing - error - slope @ step, step) / (step @ step)
            missing, step = error, np.linalg.solve(slope, error)
            wrench = wrench + step
        cause = f"The wrench was not found in {MOST} corrections: take shorter time steps of the model."
        time, residual = self._stepper.time + self.dt, float(np.max(np.abs(error) / self._size(found)))
        raise SimulationError(round(time / self.dt), time, residual, Result.NO_CONVERGENCE, cause)

    # the model

    def _place(self, site: str) -> None:
        """Find the site, or the body, that carries the rod."""
        mujoco, kinds = self._mujoco, self._mujoco.mjtObj
        sites, bodies = (
            mujoco.mj_name2id(self.model, kind, site) for kind in (kinds.mjOBJ_SITE, kinds.mjOBJ_BODY)
        )
        self._is_site = sites >= 0
        index = sites if self._is_site else bodies
        if index < 0:
            known = [self.model.site(k).name for k in range(self.model.nsite)]
            known += [self.model.body(k).name for k in range(1, self.model.nbody)]
            raise CouplingError(
                f"the model has no site or body {site!r}; there are {', '.join(filter(None, known))}"
                + did_you_mean(site, known)
            )
        self._index = index
        self._kind = kinds.mjOBJ_SITE if self._is_site else kinds.mjOBJ_XBODY
        self._body = int(self.model.site_bodyid[index]) if self._is_site else index
        integrator = mujoco.mjtIntegrator(self.model.opt.integrator)
        #: time by which velocities are behind positions (s)
        self._lag = 0.0 if integrator == mujoco.mjtIntegrator.mjINT_RK4 else self.model.opt.timestep / 2.0
        mujoco.mj_forward(self.model, self.data)

    @property
    def _pose(self) -> tuple[np.ndarray, np.ndarray]:
        """Position (m) and rotation matrix (9,) of the site."""
        data, k = self.data, self._index
        return (data.site_xpos[k], data.site_xmat[k]) if self._is_site else (data.xpos[k], data.xmat[k])

    def _interface(self) -> _Interface:
        """Return the motion of the site, with the pose at the time of the velocities."""
        mujoco, model, data = self._mujoco, self.model, self.data
        for update in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_comVel):
            update(model, data)
        spatial, h = np.empty(6), np.empty(4)
        mujoco.mj_objectVelocity(model, data, self._kind, self._index, spatial, 0)
        p, R = self._pose
        mujoco.mju_mat2Quat(h, R)
        # of two signs that nearer to the step before
        self._h = h if h @ self._h >= 0.0 else -h
        found = _Interface(p.copy(), self._h, np.concatenate([spatial[3:], spatial[:3]]))
        return self._moved(found, -self._lag * found.twist)

    def _moved(self, interface: _Interface, move: Float[np.ndarray, "6"]) -> _Interface:
        """Return the motion with a pose moved by a displacement (m) and a rotation vector (rad)."""
        turn, h = np.empty(4), np.empty(4)
        angle = float(np.linalg.norm(move[3:]))
        axis = move[3:] / angle if angle else np.array([0.0, 0.0, 1.0])
        self._mujoco.mju_axisAngle2Quat(turn, axis, angle)
        self._mujoco.mju_mulQuat(h, turn, interface.h)
        return _Interface(interface.p + move[:3], h, interface.twist)

    def _advance(self, wrench: Float[np.ndarray, "6"]) -> _Interface:
        """Make a step of the model with a wrench at the site, and return the site's motion after it."""
        mujoco, model, data = self._mujoco, self.model, self.data
        acting = data.xfrc_applied[self._body]
        users = acting.copy()
        for _ in range(self.substeps):
            mujoco.mj_kinematics(model, data)
            arm = self._pose[0] - data.xipos[self._body]
            acting[:3] = users[:3] + wrench[:3]
            acting[3:] = users[3:] + wrench[3:] + np.cross(arm, wrench[:3])
            mujoco.mj_step(model, data)
        acting[:] = users
        return self._interface()

    def _mobility(self) -> Float[np.ndarray, "6 6"]:
        """Return A, the change of the site's velocities in a step by a wrench there."""
        J = np.zeros((6, self.model.nv))
        jacobian = self._mujoco.mj_jacSite if self._is_site else self._mujoco.mj_jacBody
        jacobian(self.model, self.data, J[:3], J[3:], self._index)
        solved = np.zeros_like(J)
        self._mujoco.mj_solveM(self.model, self.data, solved, J)
        return self.dt * J @ solved.T

    # the rod

    def _control(self, own: np.ndarray, interface: _Interface) -> np.ndarray:
        """Return the rod's control with the motion of its base."""
        control = np.zeros(self.robot.control_layout.size)
        control[self._own] = own
        values = interface.p, interface.h, interface.twist[:3], interface.twist[3:]
        for where, value in zip(self._columns, values, strict=True):
            control[where] = value
        return control

    def _at_site(self, wrench: np.ndarray, row: Trajectory) -> np.ndarray:
        """Return a wrench about the base of the rod as the one about the site."""
        arm = row.y[-1, 0, :3] - row.control[-1, self._columns[0]]
        return np.concatenate([wrench[:3], wrench[3:] + np.cross(arm, wrench[:3])])

    def _size(self, wrench: np.ndarray) -> np.ndarray:
        """Return the size of a wrench, for a relative tolerance: at least the rod's natural one."""
        force, moment = (np.max(np.abs(part)) for part in (wrench[:3], wrench[3:]))
        return np.repeat(np.array([force, moment]) + self._natural, 3)

    def _measured_inertia(self, own: np.ndarray, interface: _Interface) -> Float[np.ndarray, "6 6"]:
        """Return B, the rod's apparent inertia over the step."""

        def wrench(motion: _Interface) -> np.ndarray:
            row = self._stepper.preview(self._control(own, motion))
            return self._at_site(row.mean_base_wrench[0], row)

        columns, still = [], wrench(interface)
        for k in range(6):
            probe = np.zeros(6)
            probe[k] = PROBE / self.dt * (float(self.robot.length) if k < 3 else 1.0)
            moved = self._moved(interface, 0.5 * self.dt * probe)
            columns.append((still - wrench(moved._replace(twist=interface.twist + probe))) / probe[k])
        return np.stack(columns, axis=1)
