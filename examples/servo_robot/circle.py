"""Follow a circle with the servo robot: the controller has the identified model, the robot differs.

    python examples/servo_robot/circle.py examples/servo_robot/identified.yaml [circle.png]

The robot is simulated. Its tendons have friction and up to 1 mm of slack, its backbone is softer by 10 %, and
its tendons stretch by 20 % more. The controller measures the tip with a noise of 0.2 mm, ten times a second.
"""

from __future__ import annotations

import dataclasses
import sys
from typing import Any

import numpy as np

import knode_cosserat as kc
from knode_cosserat.rods.tendons import TendonFriction

#: period of the control (s), and of the circle; its radius (m)
DT, TURN, RADIUS = 0.1, 10.0, 0.04


def stand_in(model: Any, seed: int = 0) -> Any:
    """Return a robot with friction and slack, and with other stiffnesses than the model's."""
    slack = np.random.default_rng(seed).uniform(0.0, 1e-3, model.control_layout.size)  # m
    return model.replace(
        reels=dataclasses.replace(model.reels, zero=np.asarray(model.reels.zero) + slack),
        friction=TendonFriction(wobble=0.5, curvature=0.1),
        youngs_modulus=0.9 * float(model.youngs_modulus),
        tendon_compliance=1.2 * float(model.tendon_compliance),
        passport=None,
    )


def main(file: str, picture: str = "circle.png", seconds: float = 2.5 * TURN) -> kc.control.LoopLog:
    """Return the log of the loop, and print the error after the first turn, as a part of the length."""
    model: Any = kc.load_robot(file)
    limits = kc.control.ControlLimits(low=-0.002, high=0.006, rate=0.005, safe=0.0)  # m, m/s
    controller = kc.control.controller_named("kinematic:integral=2", model, DT, limits)
    sensor = kc.control.Sensor(kc.estimation.TipPosition(), noise=1.0)
    plant = kc.control.SimulatedPlant(stand_in(model), DT, sensor, substeps=4)
    log = kc.control.run_loop(controller, plant, kc.control.circle(RADIUS, period=TURN), seconds)
    error = log.tip_rmse(TURN)
    print(f"tip RMSE {1e3 * error:.2f} mm, {error / float(model.length):.2%} of the length; {log}")
    kc.figures.closed_loop(log).savefig(picture)
    return log


if __name__ == "__main__":
    main(*sys.argv[1:])
