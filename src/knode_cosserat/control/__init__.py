"""Closed-loop control: predictive control of any System, other controllers by name, and the loop."""

# these modules register their controllers
from knode_cosserat.control import ilqr as ilqr
from knode_cosserat.control import koopman as koopman
from knode_cosserat.control import lqr as lqr
from knode_cosserat.control import mppi as mppi
from knode_cosserat.control import tip_feedback as tip_feedback
from knode_cosserat.control.commands import (
    Command,
    Controller,
    ControlLimits,
    controller_named,
    register_controller,
)
from knode_cosserat.control.loop import LoopLog, run_loop
from knode_cosserat.control.plants import Plant, Sensor, SimulatedPlant
from knode_cosserat.control.predictive import PredictiveController, SoftLimit
from knode_cosserat.control.realtime import RealtimeError
from knode_cosserat.control.references import Reference, circle, constant, figure_eight, steps, table

__all__ = [
    "Command",
    "ControlLimits",
    "Controller",
    "LoopLog",
    "Plant",
    "PredictiveController",
    "RealtimeError",
    "Reference",
    "Sensor",
    "SimulatedPlant",
    "SoftLimit",
    "circle",
    "constant",
    "controller_named",
    "figure_eight",
    "register_controller",
    "run_loop",
    "steps",
    "table",
]
