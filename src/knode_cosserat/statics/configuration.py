"""Linearisation of a robot about one equilibrium: Jacobian, compliance, manipulability."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import numpy as np

from knode_cosserat._arguments import check_arguments
from knode_cosserat._reprs import quantity, wrap_lines
from knode_cosserat.rods.system import System
from knode_cosserat.schemes.settings import NewtonOptions
from knode_cosserat.schemes.space import SpaceScheme
from knode_cosserat.solvers.refinement import Solved, is_too_coarse, refine
from knode_cosserat.statics.arguments import checked_control, static_settings
from knode_cosserat.statics.response import Pose, first_solved, tip_pose

#: error of the schemes along the rod in a compliance, as a fraction of its largest eigenvalue
ASYMMETRY = 1e-4


class Ellipsoid(NamedTuple):
    """Motion per unit of control: a Jacobian's singular values, largest first."""

    singular_values: np.ndarray
    #: the corresponding directions, in columns
    directions: np.ndarray
    #: Yoshikawa's √det(J Jᵀ), or √det(Jᵀ J) with fewer controls than rows: the singular values' product
    measure: float
    #: ratio of largest to smallest singular value; infinite if a direction is lost
    condition: float

    def __repr__(self) -> str:
        return (
            f"Ellipsoid: singular values {quantity(self.singular_values)}; measure {self.measure:.4g}; "
            f"condition {self.condition:.4g}"
        )


class Manipulability(NamedTuple):
    """Yoshikawa's ellipsoids: velocity (m per control), rotation (rad per control), and both combined.

    The combined ellipsoid divides lengths by the robot's length. `rotation` and `whole` are None without
    orientation.
    """

    translation: Ellipsoid
    rotation: Ellipsoid | None
    whole: Ellipsoid | None

    def __repr__(self) -> str:
        parts = zip(self._fields, self, strict=True)
        return "\n".join(["Manipulability", *(f"    {name}: {each}" for name, each in parts)])


@dataclasses.dataclass(frozen=True)
class Configuration:
    """Pose of an equilibrium and its derivatives, from one linearisation.

    Twists have the velocity of the pose's position first, then its angular velocity, both along the global
    axes (the "hybrid" frame: origin at the pose's position, axes parallel to the global ones).
    """

    control: np.ndarray
    #: (3,) in m
    position: np.ndarray
    #: (4,), scalar first; None for a robot without orientation
    quaternion: np.ndarray | None
    #: (6, c): twist per unit of each control, such as m/N and rad/N
    jacobian: np.ndarray
    _compliance: np.ndarray
    _length: float
    _coarse: bool = False

    def __repr__(self) -> str:
        turned = "" if self.quaternion is None else f", quaternion {quantity(self.quaternion)}"
        return wrap_lines(
            f"Configuration: control {quantity(self.control)}; "
            f"position {quantity(self.position, 'm')}{turned}; jacobian {self.jacobian.shape}"
        )

    @property
    def compliance(self) -> np.ndarray:
        """(6, 6): twist per force (N) and moment (N·m) at the tip, all along the global axes.

        Controls are constant. The matrix is symmetric and positive definite for a stable, conservative robot
        with the tip's pose, up to the error of the scheme along the rod. Use `space="lobatto4"` if that error
        matters.

        Raises:
            ValueError: the robot's conditions at the tip are not forces and moments.
        """
        if not self._compliance.shape[1]:
            raise ValueError("the robot's tip has no force n or moment m: a wrench cannot be added")
        return self._compliance

    @property
    def unstable(self) -> bool:
        """True if the tip's compliance has a negative eigenvalue: the equilibrium is then unstable.

        The second variation of a conservative robot has as many negative eigenvalues as this compliance and
        the robot with its tip held together (Haynsworth). Buckling with a free tip is therefore detected.
        Buckling between a clamped base and a held tip is not. Only valid for the tip's own pose.
        """
        if self._coarse:
            raise ValueError("stability is not tested: the grid is too coarse for the shape; use more nodes")
        C = self.compliance
        if C.shape[0] != C.shape[1]:
            raise ValueError(f"compliance has shape {C.shape}: the robot's pose and wrench do not match")
        values = np.linalg.eigvalsh((C + C.T) / 2)
        # eigenvalues of the stiffest directions are within the scheme's asymmetry
        return bool(values[0] < -ASYMMETRY * np.max(np.abs(values)))

    @property
    def manipulability(self) -> Manipulability:
        """Size and directions of the pose's motion under the controls (Yoshikawa 1985)."""
        J, count = self.jacobian, len(self.position)
        if self.quaternion is None:
            return Manipulability(_ellipsoid(J), None, None)
        scaled = np.concatenate([J[:count] / self._length, J[count:]])
        return Manipulability(_ellipsoid(J[:count]), _ellipsoid(J[count:]), _ellipsoid(scaled))


def _ellipsoid(J: np.ndarray) -> Ellipsoid:
    directions, values, _ = np.linalg.svd(J, full_matrices=False)
    if not len(values):
        # no controls: √det(J Jᵀ) is zero
        return Ellipsoid(values, directions, 0.0, np.inf)
    lost = values[-1] <= np.finfo(float).eps * max(J.shape) * values[0]
    condition = np.inf if lost else float(values[0] / values[-1])
    return Ellipsoid(values, directions, float(np.prod(values)), condition)


def configuration(
    robot: System,
    control: Any = None,
    *,
    space: str | SpaceScheme = "lobatto2",
    newton: NewtonOptions = NewtonOptions(),
    pose: Pose = tip_pose,
) -> Configuration:
    """Return the equilibrium of `kc.equilibrium` under a control (c,), and its derivatives.

    Args:
        robot: one robot or model.
        control: (c,); for a tendon robot the tensions in N. None: for a robot without controls.
        space: "lobatto2", "lobatto4", "euler", or a scheme.
        newton: tolerances and limits of the solve.
        pose: function from the system and its last node's y to position (m) and quaternion (or None); the
            tip's by default. Reuse one function object: a program is compiled for each.

    Raises:
        SimulationError: no equilibrium was found.
        ValueError: arguments of a wrong shape.
    """
    check_arguments(configuration, locals())
    control, settings = checked_control(robot, control), static_settings(space, newton)

    def solve(robot: System) -> Solved[Configuration]:
        found = first_solved(robot, settings, pose, control)
        turned = None if found.quaternion is None else np.asarray(found.quaternion)
        linearised = Configuration(
            control,
            np.asarray(found.position),
            turned,
            np.asarray(found.jacobian),
            np.asarray(found.compliance),
            float(robot.length),
            bool(is_too_coarse(settings.space, found.result)),
        )
        return Solved(linearised, found.result, found.position_error)

    return refine(solve, robot, settings.space)
