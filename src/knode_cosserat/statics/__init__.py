"""Static tasks of a robot: inverse kinematics, workspace, stability, compliance, equilibrium paths."""

from knode_cosserat.statics.configuration import Configuration, configuration
from knode_cosserat.statics.path import equilibrium_path
from knode_cosserat.statics.reach import InverseKinematics, Reach, inverse_kinematics
from knode_cosserat.statics.stability import Stability, stability
from knode_cosserat.statics.workspace import Workspace, workspace

__all__ = [
    "Configuration",
    "InverseKinematics",
    "Reach",
    "Stability",
    "Workspace",
    "configuration",
    "equilibrium_path",
    "inverse_kinematics",
    "stability",
    "workspace",
]
