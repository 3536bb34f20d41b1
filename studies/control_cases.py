"""Robots, references and controllers of the study of closed-loop control.

One controller with default settings serves all cases. It adapts Young's modulus and a mass at the tip, so
that the cases also show what adaptation costs where nothing is wrong.
"""

from __future__ import annotations

import numpy as np

from knode_cosserat.control import (
    Controller,
    ControlLimits,
    PredictiveController,
    Reference,
    circle,
    controller_named,
    figure_eight,
    steps,
)
from knode_cosserat.estimation import Adapted
from knode_cosserat.rods.loads import AttachedMass
from knode_cosserat.rods.robot_file import load_robot
from knode_cosserat.rods.tendon_robots import TendonRod

#: the robot, period (s) of control, and limits of the tensions (N, N/s)
NOMINAL, DT = "delrin-tendon-robot", 0.05
LOW, HIGH, RATE = 0.0, 10.0, 40.0
LIMITS = ControlLimits(LOW, HIGH, RATE)
#: name of the controller that adapts parameters
ADAPTIVE = "predictive, adaptive"
#: time (s) that each step is held, and that the robot may take to get there
HOLD, TRANSIT = 3.0, 1.0
#: duration of a case, and time from which errors count (s)
SECONDS, SETTLED = 12.0, 5.0
#: mass at the tip (kg): its deviation in the controller, and the unknown masses that are tried
MASS, PAYLOADS = 0.03, (0.01, 0.05)
#: relative errors of the model
WRONG = 0.3
#: tensions (N) of the equilibrium in which observers begin, without knowing it
STILL = np.array([4.0, 1.0, 1.0, 2.0])


def references() -> dict[str, Reference]:
    """Return the references of the study by name."""
    points = [[0.0, 0.0], [0.08, 0.0], [0.0, 0.08], [-0.05, -0.05]]
    return {
        "circle, 4 s": circle(0.1, 4.0),
        "circle, 1.5 s": circle(0.1, 1.5),
        "figure of eight, 5 s": figure_eight(0.1, 5.0),
        "steps": steps([[*point, np.nan] for point in points], HOLD),
    }


def nominal_robot() -> TendonRod:
    """Return the model of the study: the paper's robot with a mass of zero at its tip."""
    robot = load_robot(NOMINAL)
    assert isinstance(robot, TendonRod)
    return robot.replace(loads=(AttachedMass(mass=0.0),))


def true_robots() -> dict[str, TendonRod]:
    """Return the controlled robots by name: the model itself, and others."""
    model = nominal_robot()
    stiff = float(model.youngs_modulus)
    found = {"exact model": model}
    for factor in (1.0 - WRONG, 1.0 + WRONG):
        # the model is wrong by this factor
        found[f"stiffness {factor - 1.0:+.0%}"] = model.replace(youngs_modulus=stiff / factor)
    for mass in PAYLOADS:
        found[f"unknown {1e3 * mass:.0f} g at the tip"] = model.replace(**{"loads.0.mass": mass})
    return found


def predictive(model: TendonRod, dt: float = DT) -> PredictiveController:
    """Return the controller of the study, which adapts stiffness and a mass at the tip."""
    found = controller_named(
        "predictive", model, dt, LIMITS, ["youngs_modulus", Adapted("loads.0.mass", MASS)]
    )
    assert isinstance(found, PredictiveController)
    return found


def controller_of_study(name: str) -> Controller:
    """Return a controller of the study by its name."""
    if name == ADAPTIVE:
        return predictive(nominal_robot())
    return controller_named(name, nominal_robot(), DT, LIMITS)


#: controllers that are slower than real time
SLOW = ("ilqr", "mppi")
#: robots that a quick study has for the controllers that it compares with
FEW = ("exact model", "stiffness +30%", "unknown 50 g at the tip")


def cases_of(name: str, quick: bool) -> tuple[list[str], list[str]]:
    """Return the names of robots and references of a controller: all, or the few of a quick study."""
    robots, paths = list(true_robots()), list(references())
    if not quick or name == ADAPTIVE:
        return robots, paths
    return list(FEW), paths[:1] if name in SLOW else paths
