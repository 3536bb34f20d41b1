"""Simulate Cosserat-rod robots, learn what the physics misses, predict real robots.

Everything public is here; see `simulate`, `load_robot` and `Trajectory` first.
"""

from knode_cosserat import _jax as _jax  # isort: split  (first: it sets JAX up)
from knode_cosserat import controls
from knode_cosserat.evaluation.metrics import node_error, pose_mse, tip_dtw, tip_rmse
from knode_cosserat.rods.parameters import ParameterError, parameter
from knode_cosserat.rods.robot_file import RobotFileError, catalog, load_robot, save_robot
from knode_cosserat.rods.system import Field, History, Layout, Scales, System
from knode_cosserat.rods.tendon_robot import TendonRobot
from knode_cosserat.solvers.boundary import NewtonOptions
from knode_cosserat.solvers.equilibrium import equilibrium
from knode_cosserat.solvers.result import Result, SimulationError
from knode_cosserat.solvers.settings import Settings
from knode_cosserat.solvers.simulate import simulate
from knode_cosserat.solvers.space import RK4, Euler
from knode_cosserat.solvers.time import BDF1, BDF2, BDFAlpha, Trapezoidal
from knode_cosserat.trajectory import Trajectory
from knode_cosserat.trajectory_file import TrajectoryFileError, load_trajectory

__all__ = [
    "BDF1",
    "BDF2",
    "RK4",
    "BDFAlpha",
    "Euler",
    "Field",
    "History",
    "Layout",
    "NewtonOptions",
    "ParameterError",
    "Result",
    "RobotFileError",
    "Scales",
    "Settings",
    "SimulationError",
    "System",
    "TendonRobot",
    "Trajectory",
    "TrajectoryFileError",
    "Trapezoidal",
    "catalog",
    "controls",
    "equilibrium",
    "load_robot",
    "load_trajectory",
    "node_error",
    "parameter",
    "pose_mse",
    "save_robot",
    "simulate",
    "tip_dtw",
    "tip_rmse",
]
