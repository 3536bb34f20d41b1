"""What a robot does about one equilibrium: Jacobian, compliance, manipulability."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import numpy as np

from knode_cosserat.control.asked import checked_control, checked_system, static_settings
from knode_cosserat.control.statics import Pose, first_solved, tip_pose
from knode_cosserat.rods.system import System
from knode_cosserat.solvers.boundary import NewtonOptions
from knode_cosserat.solvers.space import SpaceScheme

#: of a compliance, in parts of its largest eigenvalue: what schemes along the rod may be off by
ASYMMETRY = 1e-4


class Ellipsoid(NamedTuple):
    """How far a unit of control moves something: a Jacobian's singular values, largest first."""

    singular_values: np.ndarray
    #: the directions that belong to them, in columns
    directions: np.ndarray
    #: Yoshikawa's √det(J Jᵀ), or √det(Jᵀ J) with fewer controls than numbers: the singular values' product
    measure: float
    #: largest by smallest singular value; infinite where a direction is lost
    condition: float


class Manipulability(NamedTuple):
    """Yoshikawa's ellipsoids: of velocity (m per control), of turning (rad per control), of both together.

    Both together with lengths measured by the robot's own. `rotation` and `whole` are None without
    orientation.
    """

    translation: Ellipsoid
    rotation: Ellipsoid | None
    whole: Ellipsoid | None


@dataclasses.dataclass(frozen=True)
class Configuration:
    """An equilibrium's pose and its slopes, all from one linearisation.

    Twists have the velocity of the pose's position first, then its angular velocity, both along the global
    axes (the "hybrid" frame: at the pose's point, turned as the world is).
    """

    control: np.ndarray
    #: (3,) in m
    position: np.ndarray
    #: (4,), scalar first, or None of a robot without orientation
    quaternion: np.ndarray | None
    #: (6, c): twist per unit of each control, such as m/N and rad/N
    jacobian: np.ndarray
    _compliance: np.ndarray
    _length: float

    @property
    def compliance(self) -> np.ndarray:
        """(6, 6): twist per force (N) and moment (N·m) that act at the tip, all along the global axes.

        Tensions are held. Symmetric and positive definite for a stable, conservative robot whose pose is
        the tip's, up to the error of the scheme along the rod: use `space="lobatto4"` where that matters.

        Raises:
            ValueError: the robot's conditions at the tip are not forces and moments.
        """
        if not self._compliance.shape[1]:
            raise ValueError("the robot's tip_layout has no force n or moment m: a wrench cannot be added")
        return self._compliance

    @property
    def unstable(self) -> bool:
        """Whether the equilibrium is unstable, by a negative eigenvalue of the tip's compliance.

        The second variation of a conservative robot has as many negative eigenvalues as this compliance and
        the robot with its tip held together (Haynsworth): what buckles with a free tip is seen,
        what would buckle even between a clamped base and a held tip is not. For the
        tip's own pose only.
        """
        C = self.compliance
        if C.shape[0] != C.shape[1]:
            raise ValueError(f"compliance has shape {C.shape}: the robot's pose and wrench do not match")
        values = np.linalg.eigvalsh((C + C.T) / 2)
        # the stiffest directions are as small as the scheme's asymmetry
        return bool(values[0] < -ASYMMETRY * np.max(np.abs(values)))

    @property
    def manipulability(self) -> Manipulability:
        """How far and in which directions the controls move the pose (Yoshikawa 1985)."""
        J, count = self.jacobian, len(self.position)
        if self.quaternion is None:
            return Manipulability(_ellipsoid(J), None, None)
        scaled = np.concatenate([J[:count] / self._length, J[count:]])
        return Manipulability(_ellipsoid(J[:count]), _ellipsoid(J[count:]), _ellipsoid(scaled))


def _ellipsoid(J: np.ndarray) -> Ellipsoid:
    directions, values, _ = np.linalg.svd(J, full_matrices=False)
    if not len(values):
        # nothing drives it: √det(J Jᵀ) of what never moves
        return Ellipsoid(values, directions, 0.0, np.inf)
    lost = values[-1] <= np.finfo(float).eps * max(J.shape) * values[0]
    condition = np.inf if lost else float(values[0] / values[-1])
    return Ellipsoid(values, directions, float(np.prod(values)), condition)


def configuration(
    robot: System,
    control: Any,
    *,
    space: str | SpaceScheme = "lobatto2",
    newton: NewtonOptions = NewtonOptions(),
    pose: Pose = tip_pose,
) -> Configuration:
    """The equilibrium of `kc.equilibrium` under a control (c,), and its slopes.

    Args:
        robot: one robot or model.
        control: (c,); for a tendon robot the tensions in N. Of a robot without controls `np.zeros(0)`.
        space: "lobatto2", "lobatto4", "euler", or a scheme.
        newton: tolerances and limits of the solve.
        pose: from the system and its last node's y to position (m) and quaternion (or None); the tip's by
            default. A function that is kept, not a new one at each call: a program is compiled for each.

    Raises:
        SimulationError: no equilibrium was found.
        ValueError: arguments of a wrong shape.
    """
    system = checked_system(robot)
    control = checked_control(system, control)
    found = first_solved(system, static_settings(space, newton), pose, control)
    turned = None if found.quaternion is None else np.asarray(found.quaternion)
    return Configuration(
        control, np.asarray(found.position), turned, np.asarray(found.jacobian),
        np.asarray(found.compliance), float(system.length),
    )  # fmt: skip


def jacobian(robot: System, control: Any, **options: Any) -> np.ndarray:
    """Twist of the tip per unit of each control (6, c); see `configuration` and `Configuration.jacobian`."""
    return configuration(robot, control, **options).jacobian


def compliance(robot: System, control: Any, **options: Any) -> np.ndarray:
    """Twist of the tip per wrench there (6, 6); see `configuration` and `Configuration.compliance`."""
    return configuration(robot, control, **options).compliance


def manipulability(robot: System, control: Any, **options: Any) -> Manipulability:
    """How the controls move the tip; see `configuration` and `Manipulability`."""
    return configuration(robot, control, **options).manipulability
