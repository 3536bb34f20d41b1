"""Simulated robots behind the interface of drivers, to try commands and programs without a machine."""

from __future__ import annotations

import abc
import dataclasses
import time
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

from knode_cosserat._files.yaml_text import did_you_mean
from knode_cosserat.control.commands import mean_part, remaining_part
from knode_cosserat.estimation.outputs import BodyPoses, BodyPositions, final_output
from knode_cosserat.rods.system import System
from knode_cosserat.schemes.result import SimulationError
from knode_cosserat.solvers.stepper import Stepper
from knode_cosserat.trajectory import Trajectory
from knode_cosserat_hardware.driver import (
    FAULTS,
    Driver,
    DriverState,
    HardwareError,
    LatencyWindow,
    Limits,
    Reading,
    TensionLimiter,
)
from knode_cosserat_hardware.lines import GRAM_FORCE


class TrueShape(abc.ABC):
    """A robot whose true shape is known."""

    #: the simulated rod
    robot: System

    @abc.abstractmethod
    def true_state(self) -> Trajectory:
        """Return the state at this time, a trajectory of one row."""

    def tip(self) -> Float[np.ndarray, "3"]:
        """Return the true position of the tip (m)."""
        return self.positions((1.0,))[0]

    def positions(self, fractions: Sequence[float]) -> Float[np.ndarray, "M 3"]:
        """Return true positions of places along the rod (m), by their fractions of its length."""
        return final_output(self.robot, self.true_state(), BodyPositions(tuple(fractions))).reshape(-1, 3)

    def poses(self, fractions: Sequence[float]) -> Float[np.ndarray, "M 7"]:
        """Return true positions (m) and quaternions (w, x, y, z) of places along the rod."""
        return final_output(self.robot, self.true_state(), BodyPoses(tuple(fractions))).reshape(-1, 7)


#: settings and their first values, in the units of the wire protocol
SETTINGS = {"kp": 64, "ki": 256, "kd": 0, "limit": 2300, "jog": 80, "watchdog": 60, "release": 500}
#: gain of each load cell (1/4096 gf per count)
GAIN = 1024
#: number of conversions of a tare
CONVERSIONS = 25


@dataclasses.dataclass(frozen=True)
class MachineParameters:
    """Parameters of a simulated machine around the rod.

    Attributes:
        lag: time constant of the tensions (s).
        noise: standard deviation of the load cells (N).
        offset: of the load cells before they are tared (N).
        gain_error: relative error of the load cells' calibration.
        seed: of the noise.
    """

    lag: float = 0.05
    noise: float = 0.02
    offset: float = 0.3
    gain_error: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        if not (self.lag >= 0.0 and self.noise >= 0.0):
            raise HardwareError(
                f"lag and noise must be zero or more (got {self.lag:g} s and {self.noise:g} N)"
            )


class SimulatedLoadCells:
    """Load cells with noise, offset and an error of their gain, and the settings of their board.

    Args:
        machine: errors of the cells.
        count: number of tendons.
    """

    def __init__(self, machine: MachineParameters, count: int):
        self.machine, self.count = machine, count
        self._random = np.random.default_rng(machine.seed)
        self.settings = dict(SETTINGS)
        for k in range(1, count + 1):
            self.settings |= {f"gain{k}": GAIN, f"zero{k}": 0}

    def counts(self, force: Float[np.ndarray, " c"]) -> Float[np.ndarray, " c"]:
        """Return one conversion of true forces (N), in counts."""
        machine = self.machine
        noise = machine.noise * self._random.normal(size=self.count)
        return (force * (1.0 + machine.gain_error) + machine.offset + noise) / GRAM_FORCE * 4096.0 / GAIN

    def measured(self, force: Float[np.ndarray, " c"]) -> Float[np.ndarray, " c"]:
        """Return one measurement of true forces (N), by the settings (N)."""
        zero, gain = (
            np.array([self.settings[f"{name}{k + 1}"] for k in range(self.count)], dtype=float)
            for name in ("zero", "gain")
        )
        return (self.counts(force) - zero) * gain / 4096.0 * GRAM_FORCE

    def tare(self, force: Float[np.ndarray, " c"]) -> None:
        """Take the present readings as zero."""
        counts = np.mean([self.counts(force) for _ in range(CONVERSIONS)], axis=0)
        for k, zero in enumerate(counts):
            self.settings[f"zero{k + 1}"] = round(zero)


#: time between readings (s), longest silence of the host while armed (s), duration of a tare (s)
STEP, SILENCE, TARE = 0.02, 0.31, 0.5
#: tension (N) that 0.1 s of full drive adds to a tendon
JOG = 3.0
#: longest delay that a simulation in real time makes up for (s); beyond it, the simulated time is late
LATE = 1.0


class SimulatedRobot(TrueShape, Driver):
    """A simulated tendon robot with motors, load cells and faults, in real time or in lock-step.

    In lock-step the simulated time moves on only by `wait`, `read`, `tare`, `jog` and `advance`, so that a
    program gives the same numbers in each run.

        with SimulatedRobot(kc.load_robot("delrin-tendon-robot")) as robot:
            robot.arm()
            robot.command([1.0, 1.0, 1.0, 1.0])
            robot.wait(0.5)
            print(robot.read(), robot.tip())

    Args:
        robot: a robot or model driven by tensions.
        limits: limits of commanded tensions.
        machine: motors and load cells; None: the defaults.
        real_time: True if the simulated time follows the clock.

    Raises:
        HardwareError: the robot has other controls than tensions, or the limits are not allowed.
    """

    def __init__(
        self,
        robot: System,
        limits: Limits | None = None,
        *,
        machine: MachineParameters | None = None,
        real_time: bool = False,
    ):
        if robot.control_layout.names != ("tension",):
            raise HardwareError(
                f"a simulated robot is driven by tensions; this {type(robot).__name__} has "
                f"{', '.join(robot.control_layout.names) or 'no controls'}"
            )
        self.machine = machine = MachineParameters() if machine is None else machine
        self.robot, self.real_time = robot, real_time
        self.tendon_count = robot.control_layout.size
        self.limits = Limits() if limits is None else limits
        self._limiter = TensionLimiter(self.limits, self.tendon_count)
        count = self.tendon_count
        self.cells = SimulatedLoadCells(machine, count)
        #: true tensions (N)
        self.tension = np.zeros(count)
        self._hung, self._drive = np.zeros(count), np.zeros(count)
        self._stepper: Stepper | None = None
        self._wanted, self._measured = np.zeros(count), np.zeros(count)
        self._armed, self._fault, self._lost = False, "", False
        self._planned: list[tuple[float, str]] = []
        self._count, self._returned, self._called, self._origin = 0, -1, 0.0, 0.0
        self._latencies, self._sent = LatencyWindow(), -1.0
        #: called with the robot after each step of the simulation
        self.observer: Callable[[SimulatedRobot], None] | None = None

    # state and time

    @property
    def state(self) -> DriverState:
        """State of the robot."""
        if self._stepper is None or self._lost:
            return DriverState.DISCONNECTED
        self._follow_clock()
        if self._fault:
            return DriverState.FAULT
        return DriverState.ARMED if self._armed else DriverState.READY

    def now(self) -> float:
        """Return the time on the robot's clock (s): monotonic in real time, else simulated."""
        return time.monotonic() if self.real_time else self._count * STEP

    def wait(self, seconds: float) -> None:
        """Wait (s), with the watchdog fed."""
        end = self.now() + seconds
        self._touch()
        while (rest := end - self.now()) > 1e-9:
            if self.real_time:
                time.sleep(min(rest, STEP))
            elif rest < 0.5 * STEP:
                break
            else:
                self._step()
            self._touch()

    def advance(self, seconds: float) -> None:
        """Let time pass without a sign of life from the host (s): armed, the watchdog reacts."""
        self._require()
        if self.real_time:
            time.sleep(seconds)
            self._follow_clock()
            return
        for _ in range(round(seconds / STEP)):
            self._step()

    def inject(self, fault: str, after: float = 0.0) -> None:
        """Cause a fault such as "over-tension:2" after a time (s); "lost" stands for a lost connection.

        Raises:
            HardwareError: there is no such fault.
        """
        name = fault.partition(":")[0]
        known = ["lost", *FAULTS]
        if name not in known:
            raise HardwareError(
                f"the fault {name!r} is unknown; allowed is {', '.join(known)}{did_you_mean(name, known)}"
            )
        if after <= 0.0:
            self._latch(fault)
        else:
            self._planned.append((self._count * STEP + after, fault))

    def hang(self, tendon: int, force: float) -> None:
        """Hang a weight (N) on a tendon, counted from 0, for the calibration of its load cell."""
        self._hung[tendon] = force

    # interface of drivers

    def connect(self) -> None:
        """Start the simulation at rest."""
        if self._stepper is not None:
            return
        try:
            stepper = Stepper(self.robot, STEP, initial="equilibrium")
            stepper.preview(self.tension)
        except SimulationError as error:
            raise HardwareError(f"the robot cannot be simulated: {error}") from None
        self._stepper, self._lost, self._fault, self._armed = stepper, False, "", False
        self._origin = time.monotonic() - self._count * STEP
        self._called = self._count * STEP
        self._sense()

    def tare(self) -> None:
        """Take the readings of slack tendons as zero. Returns when it is done."""
        self._touch()
        self._require_ready("tare")
        self._wanted = np.zeros(self.tendon_count)
        self.wait(TARE)
        self.cells.tare(self.tension + self._hung)
        self.wait(STEP)

    def arm(self) -> None:
        """Let the tensions follow commands, from zero on."""
        self._touch()
        self._require_no_fault()
        if self._armed:
            return
        self._wanted, self._armed = np.zeros(self.tendon_count), True
        self._limiter.reset(self.now())
        self._touch()

    def command(self, tension: Float[np.ndarray, " c"]) -> Float[np.ndarray, " c"]:
        """Set the wanted tensions (N), and return them within the limits."""
        self._touch()
        self._require_armed()
        self._wanted = self._limiter.reduced(tension, self.now())
        self._sent = self.now() if self._sent < 0.0 else self._sent
        return self._wanted.copy()

    def read(self, timeout: float = 1.0) -> Reading:
        """Return the newest reading; waits (s) for one that was not returned before."""
        self._touch()
        end = self.now() + timeout
        while self._count == self._returned:
            if self.now() > end:
                raise HardwareError(f"the simulated robot: no reading in {timeout:g} s")
            self.wait(STEP)
        self._returned = self._count
        stamp = self._count * STEP + (self._origin if self.real_time else 0.0)
        return Reading(stamp, self._measured.copy(), self._drive.copy(), self.state, self._fault)

    def jog(self, tendon: int, drive: float) -> None:
        """Drive one motor for a tenth of a second; tendon from 0 on, drive from -1 to 1."""
        self._check_jog(tendon, drive, self.cells.settings["jog"] / 255.0)
        self._touch()
        self._require_ready("jog")
        self._wanted = self.tension.copy()
        self._wanted[tendon] = max(0.0, self._wanted[tendon] + JOG * drive)
        self._drive[tendon] = drive
        self.wait(0.1)

    def disarm(self) -> None:
        """Release the tendons and stop the motors."""
        self._touch()
        self._armed, self._wanted = False, np.zeros(self.tendon_count)

    def stop(self) -> None:
        """Stop at once: release the tendons; the fault `stopped` latches. Never raises."""
        if self._stepper is not None and not self._lost:
            self._latch("stopped:0")

    def reset(self) -> None:
        """Clear a latched fault; ready afterwards."""
        self._touch()
        self._fault = ""

    def close(self) -> None:
        """Disarm and end the simulation. Never raises."""
        self._armed, self._wanted, self._stepper = False, np.zeros(self.tendon_count), None

    # settings, by the names of the wire protocol

    def setting(self, name: str) -> int:
        """Return a setting. Raises `HardwareError` if there is none of this name."""
        self._touch()
        settings = self.cells.settings
        if name not in settings:
            raise HardwareError(f"the setting {name!r} is unknown{did_you_mean(name, list(settings))}")
        return settings[name]

    def set_setting(self, name: str, value: int) -> int:
        """Change a setting, and return it. Raises `HardwareError` if name or value are not allowed."""
        self.setting(name)
        if self._armed:
            raise HardwareError("settings cannot change while the robot is armed; call disarm() first")
        if isinstance(value, bool) or value != int(value):
            raise HardwareError(f"{name} must be a whole number (got {value!r})")
        self.cells.settings[name] = int(value)
        return int(value)

    def save_settings(self) -> None:
        """Keep the settings; a simulated robot forgets them at its end."""
        self._touch()

    # true state

    def true_state(self) -> Trajectory:
        """Return the state at this time, a trajectory of one row."""
        self._touch()
        return self._require().state

    # steps

    def _require(self) -> Stepper:
        if self._lost:
            raise HardwareError("the simulated robot: the connection is lost; connect again")
        if self._stepper is None:
            raise HardwareError("the robot is not connected; call connect(), or use it in a with statement")
        return self._stepper

    def _touch(self) -> None:
        """Follow the clock, and note that the host is alive."""
        self._require()
        self._follow_clock()
        self._called = self._count * STEP

    def _follow_clock(self) -> None:
        if not self.real_time or self._stepper is None or self._lost:
            return
        behind = time.monotonic() - self._origin - self._count * STEP
        if behind > LATE:
            if self._armed:
                self._latch("watchdog:0")
            self._origin += behind - LATE
            behind = LATE
        # so many steps, and not until now: on a busy computer steps may take longer than their time
        for _ in range(int(behind / STEP + 1e-9)):
            self._step()

    def _step(self) -> None:
        if self._armed and self._count * STEP - self._called > SILENCE:
            self._latch("watchdog:0")
        for planned in [each for each in self._planned if each[0] <= (self._count + 1) * STEP + 1e-9]:
            self._planned.remove(planned)
            self._latch(planned[1])
        stepper = self._require()
        away, lag = self.tension - self._wanted, self.machine.lag
        acting = self._wanted + away * remaining_part(lag, STEP)
        try:
            stepper.step(self._wanted + away * mean_part(lag, STEP))
        except SimulationError as error:
            self._latch("stopped:0")
            raise HardwareError(
                f"the simulation failed: {error}; reduce the tensions or their rate"
            ) from None
        self._drive = np.clip((self._wanted - acting) / 5.0, -1.0, 1.0)
        self.tension = acting
        self._count += 1
        self._sense()
        if self._sent >= 0.0:
            self._latencies.add(self.now() - self._sent)
            self._sent = -1.0
        if self.observer is not None:
            self.observer(self)

    def _sense(self) -> None:
        self._measured = self.cells.measured(self.tension + self._hung)
        over = np.flatnonzero(self._measured / GRAM_FORCE > self.cells.settings["limit"])
        if len(over):
            self._latch(f"over-tension:{over[0] + 1}")

    def _latch(self, fault: str) -> None:
        self._armed, self._wanted = False, np.zeros(self.tendon_count)
        if fault.startswith("lost"):
            self._lost = True
        elif not self._fault:
            self._fault = fault if ":" in fault else f"{fault}:0"
