"""Closed-loop control: predictive control of any System, other controllers by name, and the loop."""

from knode_cosserat.control.commands import (
    CONTROLLERS,
    Command,
    Controller,
    ControlLimits,
    Status,
    controller_named,
    identified_lag,
    register_controller,
)
from knode_cosserat.control.ilqr import ILQR
from knode_cosserat.control.koopman import KoopmanController
from knode_cosserat.control.loop import LoopLog, distance_out_of_reach, run_loop
from knode_cosserat.control.lqr import LQR
from knode_cosserat.control.mppi import MPPI
from knode_cosserat.control.planning import Weights
from knode_cosserat.control.plants import Plant, Sensor, SimulatedPlant
from knode_cosserat.control.predictive import PredictiveController, SoftLimit
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
from knode_cosserat.control.tip_feedback import PID, KinematicController

__all__ = [
    "CONTROLLERS",
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
    "distance_out_of_reach",
    "figure_eight",
    "identified_lag",
    "parse_reference",
    "register_controller",
    "run_loop",
    "steps",
    "table",
]
