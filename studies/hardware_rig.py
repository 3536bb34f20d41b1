"""Emulated robot behind its board, as the study of the firmware uses it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float

from knode_cosserat import controls
from knode_cosserat.control import Controller, ControlLimits, controller_named
from knode_cosserat.control.commands import identified_lag
from knode_cosserat.estimation.outputs import TipPosition
from knode_cosserat.rods.robot_file import load_robot
from knode_cosserat.rods.tendons import LoadCells
from knode_cosserat_hardware.driver import Limits
from knode_cosserat_hardware.emulation import ROBOT, EmulatedPort, EmulatedRobot
from knode_cosserat_hardware.lines import GRAM_FORCE
from knode_cosserat_hardware.serial_board import SerialBoard
from studies.stand_in import DAMPING, NOISE, OFFSETS

#: period of the loop (s), and its tension limits (N, N/s)
DT, LOW, HIGH, RATE = 0.05, 0.5, 12.0, 40.0
#: limits of the driver: wider than those of the controller
DRIVER = Limits(0.0, 15.0, 1e4, 60.0)
#: part of the host's bits that the cable flips in the closed loop
BIT_ERRORS = 1e-5


def true_robot() -> Any:
    """Return the rod of the emulated robot in the closed loop."""
    rod: Any = load_robot(ROBOT)
    return rod.replace(bending_damping=DAMPING)


class Cable:
    """Cable that flips bits of the host's lines at random: the part `BIT_ERRORS`, or more in a burst."""

    def __init__(self, random: np.random.Generator, clock: Callable[[], float] = lambda: 0.0):
        self._random, self._clock = random, clock
        self._burst, self._end = 0.0, -np.inf

    def begin_burst(self, rate: float, seconds: float) -> None:
        """Flip another part of the bits for some time (s)."""
        self._burst, self._end = rate, self._clock() + seconds

    def __call__(self, data: bytes) -> bytes:
        """Return damaged bytes."""
        rate = self._burst if self._clock() < self._end else BIT_ERRORS
        flips = self._random.random((len(data), 8)) < rate
        masks = (flips * (1 << np.arange(8))).sum(axis=1)
        return bytes(byte ^ int(mask) for byte, mask in zip(data, masks, strict=True))


def loop_controller(lag: float) -> Controller:
    """Return the predictive controller of the closed loop, for tensions with a time constant (s)."""
    model = true_robot().replace(load_cells=LoadCells(gain=np.ones(4), offset=np.zeros(4)))
    limits = ControlLimits(LOW, HIGH, RATE, lag=lag)
    return controller_named("predictive", model, DT, limits, [OFFSETS], TipPosition(sigma=5e-4))


def connected(robot: EmulatedRobot, damage: Any = None) -> SerialBoard:
    """Return a tared board in front of an emulated robot."""
    board = SerialBoard(EmulatedPort(robot, damage), DRIVER, measured_high=40.0)
    board.connect()
    board.reset()
    board.tare()
    return board


def tensions(board: SerialBoard, robot: EmulatedRobot, grams: Any, seconds: float) -> Float[Any, "T c"]:
    """Return true tensions (gf) in steps of 1/256 s after a command (gf)."""
    board.command(np.asarray(grams, dtype=float) * GRAM_FORCE)
    rows = []
    for _ in range(round(256 * seconds)):
        board.wait(1.0 / 256.0)
        rows.append(robot.tension / GRAM_FORCE)
    return np.array(rows)


def measured_lag(board: SerialBoard) -> float:
    """Return the time constant (s) of the tensions, from random steps of 0.4 s."""
    commands = controls.random(150, low=1.0, high=6.0, seed=5, hold=8)
    board.arm()
    commanded, measured = [], []
    for command in commands:
        commanded.append(board.command(command))
        board.wait(DT)
        measured.append(board.read().tension)
    board.disarm()
    return identified_lag(np.array(commanded[8:]), np.array(measured[8:]), DT, measured[7])


def measured_tip(robot: EmulatedRobot, random: np.random.Generator) -> tuple[float, Float[Any, "3"]]:
    """Return the time (s) and the tip's position (m) with the noise of motion capture."""
    return robot.time, robot.tip() + NOISE * random.normal(size=3)
