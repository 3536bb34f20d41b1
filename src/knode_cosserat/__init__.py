"""Simulate Cosserat-rod robots, learn what the physics misses, predict real robots.

The names that a first script needs are here; start with `load_robot`, `simulate` and `Trajectory`. All other
public names are in the namespaces `robots`, `solvers`, `learning`, `calibration`, `recordings`, `statics`,
`estimation`, `control`, `hardware`, `identification`, `metrics`, `figures`, `viewer`, `controls`,
`named_controls`, `envs` and `sweeps`. Events are logged to the logger "knode_cosserat", which is quiet unless
a handler is added.
"""

import importlib
import logging
import typing
import warnings

from knode_cosserat import _jax as _jax  # isort: split  (first: it sets JAX up)
from knode_cosserat import (
    calibration,
    control,
    controls,
    envs,
    estimation,
    figures,
    hardware,
    identification,
    learning,
    metrics,
    named_controls,
    recordings,
    robots,
    solvers,
    statics,
    sweeps,
    viewer,
)
from knode_cosserat.calibration import calibrate
from knode_cosserat.errors import KnodeCosseratError
from knode_cosserat.identification import fit, identify
from knode_cosserat.learning import KNODE, FitConfig, load_model
from knode_cosserat.recordings import estimate_states, load_recording
from knode_cosserat.robots import System, catalog, load_robot, save_robot
from knode_cosserat.solvers import Result, SimulationError, equilibrium, simulate
from knode_cosserat.statics import inverse_kinematics, workspace
from knode_cosserat.trajectory import Trajectory
from knode_cosserat.trajectory_file import load_trajectory
from knode_cosserat.trajectory_system import TrajectoryFileError
from knode_cosserat.viewer import view

logging.getLogger(__name__).addHandler(logging.NullHandler())

__all__ = [
    "KNODE",
    "FitConfig",
    "KnodeCosseratError",
    "Result",
    "SimulationError",
    "System",
    "Trajectory",
    "TrajectoryFileError",
    "calibrate",
    "calibration",
    "catalog",
    "control",
    "controls",
    "envs",
    "equilibrium",
    "estimate_states",
    "estimation",
    "figures",
    "fit",
    "hardware",
    "identification",
    "identify",
    "inverse_kinematics",
    "learning",
    "load_model",
    "load_recording",
    "load_robot",
    "load_trajectory",
    "metrics",
    "named_controls",
    "recordings",
    "robots",
    "save_robot",
    "simulate",
    "solvers",
    "statics",
    "sweeps",
    "view",
    "viewer",
    "workspace",
]

#: names that used to be here, by the namespace that has them now
_MOVED = {
    "robots": (
        "Differences Field FunctionSection Layout ParallelRobot ParameterError RobotFileError Rod "
        "RoutedTendonRobot Scales SlenderRod Stretch TendonRobot ends loads parameter robot_schema routing "
        "surroundings"
    ),
    "solvers": (
        "BDF1 BDF2 BDFAlpha Euler History Lobatto2 Lobatto4 NewtonOptions Settings Stepper Trapezoidal"
    ),
    "learning": (
        "CheckpointError ConfigError DataError Ensemble FitError ModelFileError NetworkOptions "
        "PassiveOptions Residual RolloutTraining StructuredOptions Training explain load_ensemble"
    ),
    "calibration": "Calibration CalibrationError",
    "recordings": "Measurements Recording RecordingConfig RecordingError estimate_parts",
    "statics": (
        "Configuration EquilibriumPath InverseKinematics Manipulability Reach Stability Workspace compliance "
        "configuration equilibrium_path jacobian manipulability stability"
    ),
    "identification": "IdentificationError Identified",
    "metrics": "StateError node_error pose_mse rotation_rmse state_errors tip_dtw tip_rmse",
    "viewer": "export_scene view_live",
    "diagnosis": "Diagnosis doctor",
}
_NAMESPACES = {name: place for place, names in _MOVED.items() for name in names.split()}


def __dir__() -> list[str]:
    return sorted(__all__)


if not typing.TYPE_CHECKING:  # a type checker is to report names that do not exist

    def __getattr__(name: str) -> typing.Any:
        if name in _MOVED:
            return importlib.import_module(f"{__name__}.{name}")
        place = _NAMESPACES.get(name)
        if place is None:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        warnings.warn(
            f"{__name__}.{name} is now {__name__}.{place}.{name}; the old name will be removed",
            DeprecationWarning,
            stacklevel=2,
        )
        return getattr(importlib.import_module(f"{__name__}.{place}"), name)
