"""Closed-loop control: predictive control of any System, baselines, and the loop."""

from knode_cosserat.control.baselines.iterative import ILQR
from knode_cosserat.control.baselines.koopman import KoopmanController
from knode_cosserat.control.baselines.lqr import LQR
from knode_cosserat.control.baselines.sampling import MPPI
from knode_cosserat.control.baselines.tip_feedback import PID, KinematicController
from knode_cosserat.control.commands import Command, Controller, ControlLimits, Status
from knode_cosserat.control.lag import identified_lag
from knode_cosserat.control.loop import LoopLog, run_loop
from knode_cosserat.control.named import controller_named
from knode_cosserat.control.plants import Plant, Sensor, SimulatedPlant
from knode_cosserat.control.predictive import PredictiveController, SoftLimit
from knode_cosserat.control.program import Weights
from knode_cosserat.control.qp import DAQP, QPError, QPSolver
from knode_cosserat.control.references import (
    Reference,
    ReferenceFormatError,
    circle,
    constant,
    figure_eight,
    parse_reference,
    steps,
    table,
)

__all__ = [
    "DAQP",
    "ILQR",
    "LQR",
    "MPPI",
    "PID",
    "Command",
    "ControlLimits",
    "Controller",
    "KinematicController",
    "KoopmanController",
    "LoopLog",
    "Plant",
    "PredictiveController",
    "QPError",
    "QPSolver",
    "Reference",
    "ReferenceFormatError",
    "Sensor",
    "SimulatedPlant",
    "SoftLimit",
    "Status",
    "Weights",
    "circle",
    "constant",
    "controller_named",
    "figure_eight",
    "identified_lag",
    "parse_reference",
    "run_loop",
    "steps",
    "table",
]
