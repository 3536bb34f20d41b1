"""An emulated robot: the real firmware on an emulated chip, with motors, load cells, tendons and the rod.

Chip and robot move in lock-step; the same commands give the same bits.
"""

from __future__ import annotations

from typing import Any, Literal, get_args

import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.reels import Reels
from knode_cosserat.rods.robot_file import load_robot
from knode_cosserat.rods.routed_robot import RoutedTendonRobot
from knode_cosserat.solvers.stepper import Stepper
from knode_cosserat.trajectory import Trajectory
from knode_cosserat_hardware.driver import HardwareError
from knode_cosserat_hardware.emulation.chip import CLOCK, Chip
from knode_cosserat_hardware.emulation.motors import (
    LoadCellParameters,
    LoadCells,
    MotorParameters,
    Motors,
)
from knode_cosserat_hardware.true_shape import TrueShape

#: steps of the motors in a second, and in each step of the rod. With steps of the rod half as
#: long the loop is the same (tests/hardware/test_emulation.py); with 1/64 s it oscillates at 26 Hz
STEPS, ROD_STEPS = 512, 4
#: robot of the catalog that is emulated by default
ROBOT = "delrin-routed-tendon-robot"
#: length (m) taken in by each reel for the linearisation: some 4 N in each tendon
TAUT = 1.0e-3
#: emergency stop: released, pressed (the contact opens and the motors lose their supply), or its wire to the
#: board is broken
Switch = Literal["released", "pressed", "broken"]
#: compliance of a tendon of 0.6 m with its load cell (m/N)
COMPLIANCE = 2.0e-4


class EmulatedRobot(TrueShape):
    """A tendon robot with four motors behind the emulated board.

        robot = kch.emulation.EmulatedRobot()
        with kch.SerialBoard(kch.emulation.EmulatedPort(robot), limits) as board:
            board.arm()

    Each step of the rod solves for the tensions that belong to the reels' positions. Between two steps the
    tendons' paths are extrapolated, and follow the reels as in a step of a straight rod.
    """

    def __init__(
        self, robot: str | RoutedTendonRobot = ROBOT, *, motors: MotorParameters | None = None,
        cells: LoadCellParameters | None = None, compliance: float = COMPLIANCE,
        slack: float = 0.002, seed: int = 0,
    ):  # fmt: skip
        """Set up the robot at rest with slack tendons, and start the chip.

        Args:
            robot: a routed tendon robot with four tendons, or its name or file.
            motors: of all tendons; None: a nominal JGA25-371.
            cells: load cells of all tendons; None: nominal ones.
            compliance: of each tendon (m/N).
            slack: of each tendon at the start (m).
            seed: of the noise.

        Raises:
            HardwareError: another kind of robot, or the emulator is not installed.
        """
        given: Any = load_robot(robot) if isinstance(robot, str) else robot
        if not isinstance(given, RoutedTendonRobot) or given.tendon_count != 4:
            raise HardwareError(
                "the emulated board drives a routed tendon robot with 4 tendons (got "
                f"{type(given).__name__}); use {ROBOT}, for example"
            )
        reels = Reels(motors=[1.0, 2.0, 3.0, 4.0], compliance=[compliance] * 4)
        self.robot = given.replace(drive="reel", reels=reels)
        self._random = np.random.default_rng(seed)
        self.motors = Motors(4, motors or MotorParameters())
        self.cells = LoadCells(4, cells or LoadCellParameters(), self._random)
        self.motors.rotor -= slack
        self.motors.position -= slack
        #: tendons that are torn, or off their reels
        self.torn = np.zeros(4, dtype=bool)
        self._compliance = compliance
        self._stepper = Stepper(self.robot, ROD_STEPS / STEPS)
        self._stepper.step(self.motors.position)
        self._fields = {field.name: where for field, where in _places(self.robot)}
        self._straight = self._path()
        self._follows = self._response()
        self._taken, self._rate = np.zeros(4), np.zeros(4)
        self._reeled, self._reel_rate = self.motors.position.copy(), np.zeros(4)
        self.tension = np.zeros(4)
        self.chip, self._count = Chip(), 0
        self._switch: Switch = "released"

    @property
    def time(self) -> float:
        """Time since the chip's start (s)."""
        return self._count / STEPS

    @property
    def switch(self) -> Switch:
        """Emergency stop: "released", "pressed" (cuts the motors' supply too), or "broken" (its wire)."""
        return self._switch

    @switch.setter
    def switch(self, value: Switch) -> None:
        if value not in get_args(Switch):
            raise HardwareError(f"switch must be one of {', '.join(get_args(Switch))} (got {value!r})")
        self._switch = value
        self.chip.set_contact(value != "released")

    def advance(self, seconds: float) -> None:
        """Move chip and robot on by some time (s), rounded to 1/512 s."""
        for _ in range(round(seconds * STEPS)):
            self.step()

    def step(self) -> None:
        """Move chip and robot on by 1/512 s."""
        self.chip.run(CLOCK // STEPS, self.cells.millivolts(self.tension))
        h = 1.0 / STEPS
        self.motors.step(np.array(self.chip.drives()), self.tension, h, self._switch != "pressed")
        self._count += 1
        if self._count % ROD_STEPS:
            since = (self._count % ROD_STEPS) * h
            reeled = self.motors.position - self._reeled - since * self._reel_rate
            shortened = self._taken + since * self._rate + self._follows @ reeled
            stretch = np.maximum(self.motors.position - shortened, 0.0)
            self.tension = np.where(self.torn, 0.0, stretch / self._compliance)
            return
        # a torn tendon is one that its reel has let out by far
        self._stepper.step(np.where(self.torn, -0.2, self.motors.position))
        taken, reeled = self._straight - self._path(), self.motors.position.copy()
        self._rate = (taken - self._taken) * STEPS / ROD_STEPS
        self._reel_rate = (reeled - self._reeled) * STEPS / ROD_STEPS
        self._taken, self._reeled = taken, reeled
        self.tension = np.where(self.torn, 0.0, np.maximum(self._row("tension"), 0.0))

    def _row(self, name: str, node: int = 0, state: Any = None) -> Float[np.ndarray, " c"]:
        row = self._stepper.state if state is None else state
        return np.asarray(row.y[-1, node, self._fields[name]])

    def _path(self, state: Any = None) -> Float[np.ndarray, " c"]:
        """Return the length of each tendon from base to tip (m)."""
        return self._row("path", -1, state) - self._row("path", 0, state)

    def _response(self) -> Float[np.ndarray, "c c"]:
        """Return how much shorter each path becomes within a step if a reel takes in more (m/m)."""
        rod = Stepper(self.robot, ROD_STEPS / STEPS)
        for _ in range(20):
            rod.step(np.full(4, TAUT))
        taut = self._path(rod.preview(np.full(4, TAUT)))
        changed = [self._path(rod.preview(TAUT + 0.1 * TAUT * unit)) for unit in np.eye(4)]
        return (taut - np.array(changed).T) / (0.1 * TAUT)

    def true_state(self) -> Trajectory:
        """Return the state at the last step of the rod, a trajectory of one row."""
        return self._stepper.state


def _places(robot: RoutedTendonRobot) -> list[tuple[Any, slice]]:
    """Return the fields of y with their places."""
    places, start = [], 0
    for field in robot.y_layout.fields:
        places.append((field, slice(start, start + field.size)))
        start += field.size
    return places
