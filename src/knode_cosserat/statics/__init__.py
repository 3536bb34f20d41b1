"""Static tasks of a robot: inverse kinematics, workspace, stability, compliance, equilibrium paths."""

from knode_cosserat.statics.configuration import (
    Configuration,
    Manipulability,
    compliance,
    configuration,
    jacobian,
    manipulability,
)
from knode_cosserat.statics.path import EquilibriumPath, equilibrium_path
from knode_cosserat.statics.reach import InverseKinematics, Reach, inverse_kinematics
from knode_cosserat.statics.stability import Stability, stability
from knode_cosserat.statics.workspace import Workspace, workspace

__all__ = [
    "Configuration",
    "EquilibriumPath",
    "InverseKinematics",
    "Manipulability",
    "Reach",
    "Stability",
    "Workspace",
    "compliance",
    "configuration",
    "equilibrium_path",
    "inverse_kinematics",
    "jacobian",
    "manipulability",
    "stability",
    "workspace",
]
