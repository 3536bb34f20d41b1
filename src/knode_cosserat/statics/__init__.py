"""Tasks about equilibria: inverse kinematics, workspace, stability, vibration, compliance, paths."""

from knode_cosserat.statics.configuration import Configuration, configuration
from knode_cosserat.statics.modes import Modes, modes
from knode_cosserat.statics.path import equilibrium_path
from knode_cosserat.statics.reach import InverseKinematics, Reach, inverse_kinematics
from knode_cosserat.statics.stability import Stability, stability
from knode_cosserat.statics.workspace import Workspace, workspace

__all__ = [
    "Configuration",
    "InverseKinematics",
    "Modes",
    "Reach",
    "Stability",
    "Workspace",
    "configuration",
    "equilibrium_path",
    "inverse_kinematics",
    "modes",
    "stability",
    "workspace",
]
