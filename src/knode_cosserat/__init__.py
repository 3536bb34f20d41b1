"""Simulate Cosserat-rod robots, learn what the physics misses, predict real robots.

All public names are here; see `simulate`, `load_robot` and `Trajectory` first. Events are logged to the
logger "knode_cosserat", which is quiet unless a handler is added.
"""

import logging

from knode_cosserat import _jax as _jax  # isort: split  (first: it sets JAX up)
from knode_cosserat import controls, named_controls
from knode_cosserat.control.configuration import (
    Configuration,
    Manipulability,
    compliance,
    configuration,
    jacobian,
    manipulability,
)
from knode_cosserat.control.path import EquilibriumPath, equilibrium_path
from knode_cosserat.control.reach import InverseKinematics, Reach, inverse_kinematics
from knode_cosserat.control.stability import Stability, stability
from knode_cosserat.control.workspace import Workspace, workspace
from knode_cosserat.diagnosis import Diagnosis, doctor
from knode_cosserat.evaluation import figures
from knode_cosserat.evaluation.metrics import node_error, pose_mse, tip_dtw, tip_rmse
from knode_cosserat.evaluation.state_errors import StateError, state_errors
from knode_cosserat.identification.fit import fit
from knode_cosserat.identification.identify import IdentificationError, identify
from knode_cosserat.identification.result import Identified
from knode_cosserat.learning.calibration.calibrate import Calibration, CalibrationError, calibrate
from knode_cosserat.learning.config import (
    ConfigError,
    FitConfig,
    NetworkOptions,
    PassiveOptions,
    RolloutTraining,
    StructuredOptions,
    Training,
)
from knode_cosserat.learning.ensemble import Ensemble, load_ensemble
from knode_cosserat.learning.explain import explain
from knode_cosserat.learning.files.model_file import ModelFileError, load_model
from knode_cosserat.learning.knode import KNODE
from knode_cosserat.learning.residual import Residual
from knode_cosserat.learning.samples import DataError
from knode_cosserat.learning.training.checkpoint import CheckpointError
from knode_cosserat.learning.training.runs import FitError
from knode_cosserat.recordings.config import RecordingConfig
from knode_cosserat.recordings.estimation.estimate import estimate_parts, estimate_states
from knode_cosserat.recordings.findings import RecordingError
from knode_cosserat.recordings.load import load_recording
from knode_cosserat.recordings.measurements import Measurements
from knode_cosserat.recordings.recording import Recording
from knode_cosserat.rods import ends, loads, routing, surroundings
from knode_cosserat.rods.layout import Field, Layout
from knode_cosserat.rods.parallel_robot import ParallelRobot
from knode_cosserat.rods.parameters import ParameterError, parameter
from knode_cosserat.rods.robot_file import RobotFileError, catalog, load_robot, save_robot
from knode_cosserat.rods.robot_schema import robot_schema
from knode_cosserat.rods.rod import Rod
from knode_cosserat.rods.routed_robot import RoutedTendonRobot
from knode_cosserat.rods.section import Differences, FunctionSection, Stretch
from knode_cosserat.rods.slender_rod import SlenderRod
from knode_cosserat.rods.system import History, Scales, System
from knode_cosserat.rods.tendon_robot import TendonRobot
from knode_cosserat.solvers.boundary import NewtonOptions
from knode_cosserat.solvers.equilibrium import equilibrium
from knode_cosserat.solvers.result import Result, SimulationError
from knode_cosserat.solvers.settings import Settings
from knode_cosserat.solvers.simulate import simulate
from knode_cosserat.solvers.space import Euler, Lobatto2, Lobatto4
from knode_cosserat.solvers.stepper import Stepper
from knode_cosserat.solvers.time import BDF1, BDF2, BDFAlpha, Trapezoidal
from knode_cosserat.trajectory import Trajectory
from knode_cosserat.trajectory_file import load_trajectory
from knode_cosserat.trajectory_system import TrajectoryFileError
from knode_cosserat.viewer import export_scene, view, view_live

logging.getLogger(__name__).addHandler(logging.NullHandler())

__all__ = [
    "BDF1",
    "BDF2",
    "KNODE",
    "BDFAlpha",
    "Calibration",
    "CalibrationError",
    "CheckpointError",
    "ConfigError",
    "Configuration",
    "DataError",
    "Diagnosis",
    "Differences",
    "Ensemble",
    "EquilibriumPath",
    "Euler",
    "Field",
    "FitConfig",
    "FitError",
    "FunctionSection",
    "History",
    "IdentificationError",
    "Identified",
    "InverseKinematics",
    "Layout",
    "Lobatto2",
    "Lobatto4",
    "Manipulability",
    "Measurements",
    "ModelFileError",
    "NetworkOptions",
    "NewtonOptions",
    "ParallelRobot",
    "ParameterError",
    "PassiveOptions",
    "Reach",
    "Recording",
    "RecordingConfig",
    "RecordingError",
    "Residual",
    "Result",
    "RobotFileError",
    "Rod",
    "RolloutTraining",
    "RoutedTendonRobot",
    "Scales",
    "Settings",
    "SimulationError",
    "SlenderRod",
    "Stability",
    "StateError",
    "Stepper",
    "Stretch",
    "StructuredOptions",
    "System",
    "TendonRobot",
    "Training",
    "Trajectory",
    "TrajectoryFileError",
    "Trapezoidal",
    "Workspace",
    "calibrate",
    "catalog",
    "compliance",
    "configuration",
    "controls",
    "doctor",
    "ends",
    "equilibrium",
    "equilibrium_path",
    "estimate_parts",
    "estimate_states",
    "explain",
    "export_scene",
    "figures",
    "fit",
    "identify",
    "inverse_kinematics",
    "jacobian",
    "load_ensemble",
    "load_model",
    "load_recording",
    "load_robot",
    "load_trajectory",
    "loads",
    "manipulability",
    "named_controls",
    "node_error",
    "parameter",
    "pose_mse",
    "robot_schema",
    "routing",
    "save_robot",
    "simulate",
    "stability",
    "state_errors",
    "surroundings",
    "tip_dtw",
    "tip_rmse",
    "view",
    "view_live",
    "workspace",
]
