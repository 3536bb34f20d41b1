"""Closed-loop control: predictive control of any System, baselines, and the loop."""

from knode_cosserat.control.baselines import PID, KinematicController
from knode_cosserat.control.commands import Command, Controller, ControlLimits, Status
from knode_cosserat.control.loop import LoopLog, run_loop
from knode_cosserat.control.plants import Plant, Sensor, SimulatedPlant
from knode_cosserat.control.predictive import PredictiveController, SoftLimit, Weights
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
    "PID",
    "Command",
    "ControlLimits",
    "Controller",
    "KinematicController",
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
    "figure_eight",
    "parse_reference",
    "run_loop",
    "steps",
    "table",
]
