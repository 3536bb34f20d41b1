"""Driver of Dynamixel motors with reels (XM series, protocol 2.0), in current-based position mode.

A motor pulls with its goal current towards a goal position, and stops there if the tendon is off. One
synchronous read takes current, velocity, position, errors and watchdog of all motors. On Linux, set the
latency timer of the USB adapter to 1 ms (16 ms is the default, and limits reads to 60 a second):

    echo 1 | sudo tee /sys/bus/usb-serial/devices/ttyUSB0/latency_timer
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from knode_cosserat_hardware.driver import HardwareError, Limits
from knode_cosserat_hardware.dynamixel_bus import DynamixelBus, Register
from knode_cosserat_hardware.motor_robot import MotorReel, MotorRobot, MotorSample

#: units of registers: current (A), velocity (rad/s), position (rad), watchdog (s)
CURRENT, VELOCITY, POSITION, WATCHDOG = 2.69e-3, 0.229 * 2 * math.pi / 60, 2 * math.pi / 4096, 0.02
#: operating mode: current-based position
MODE = 5
#: bits of the hardware error status
ERRORS = {0: "input-voltage", 2: "overheating", 3: "encoder", 4: "electrical-shock", 5: "overload"}
#: value of the watchdog register after it has stopped the motor
EXPIRED = 255
#: time of a motor's restart (s)
RESTART_TIME = 0.5

#: registers of one synchronous read, in this order
SAMPLED = (
    Register.PRESENT_CURRENT,
    Register.PRESENT_VELOCITY,
    Register.PRESENT_POSITION,
    Register.HARDWARE_ERROR,
    Register.BUS_WATCHDOG,
)


class DynamixelRobot(MotorRobot):
    """Robot with one Dynamixel motor and reel for each tendon.

    Call `command` or `read` at least every `host_timeout` while armed: otherwise the motors' own watchdog
    stops them.

    Args:
        port: serial port of the USB adapter, such as "/dev/ttyUSB0", or a port handler of the Dynamixel SDK.
        ids: identities of the motors, in the order of the tendons.
        limits: limits of commanded tensions.
        reel: the motors and their reels.
        baud: bits per second; set the motors to 1 000 000 or more.
        host_timeout: longest time between calls while armed (s), 0.02 to 2.54.

    Raises:
        HardwareError: an argument is not allowed.
    """

    def __init__(
        self,
        port: Any,
        ids: Sequence[int],
        limits: Limits | None = None,
        reel: MotorReel | None = None,
        *,
        baud: int = 1_000_000,
        host_timeout: float = 0.25,
    ):
        super().__init__(len(ids), limits, reel)
        if not WATCHDOG <= host_timeout <= 127 * WATCHDOG:
            raise HardwareError(f"host_timeout must be between 0.02 and 2.54 s (got {host_timeout!r})")
        self._bus = DynamixelBus(port, ids, baud)
        self._watchdog = round(host_timeout / WATCHDOG)
        self._current_limit = np.full(len(ids), np.inf)

    def _open(self) -> None:
        bus = self._bus
        bus.open()
        # settings can be written without torque only
        bus.write_all(Register.BUS_WATCHDOG, 0)
        bus.write_all(Register.TORQUE_ENABLE, 0)
        for motor in bus.ids:
            # the EEPROM is written only if needed: it wears
            for register, value in ((Register.RETURN_DELAY, 0), (Register.OPERATING_MODE, MODE)):
                if bus.read(motor, register) != value:
                    bus.write(motor, register, value)
        allowed = [bus.read(motor, Register.CURRENT_LIMIT) for motor in bus.ids]
        self._current_limit = np.array(allowed) * CURRENT
        bus.prepare_sampling(SAMPLED)
        self._require_current()

    def _require_current(self) -> None:
        """Check that the motors' limits of current allow the greatest tension."""
        needed = self.limits.high * self.reel.radius / self.reel.torque_constant
        weak = [self._bus.ids[k] for k in np.flatnonzero(self._current_limit < needed)]
        if weak:
            raise HardwareError(
                f"motor {weak[0]} allows {self._current_limit.min():.3g} A, limits.high needs {needed:.3g}; "
                "reduce limits.high, or raise the motor's Current Limit"
            )

    def _shut(self) -> None:
        self._bus.close()

    def _enable(self) -> None:
        bus = self._bus
        bus.write_each(Register.GOAL_CURRENT, [0] * self.tendon_count)
        for motor in bus.ids:
            bus.write(motor, Register.TORQUE_ENABLE, 1)
        # without a command the motors hold the end of their travel with no current
        bus.write_each(Register.GOAL_POSITION, self._ends(np.ones(self.tendon_count)))
        for motor in bus.ids:
            bus.write(motor, Register.BUS_WATCHDOG, self._watchdog)

    def _disable(self) -> None:
        # at once to all, then to each with an answer
        self._bus.write_all(Register.TORQUE_ENABLE, 0)
        silent = None
        for motor in self._bus.ids:
            try:
                self._bus.write(motor, Register.TORQUE_ENABLE, 0)
            except HardwareError as error:
                silent = error
        if silent is not None:
            raise silent
        self._bus.write_all(Register.BUS_WATCHDOG, 0)

    def _ends(self, sign: Float[np.ndarray, " c"]) -> list[int]:
        """Return the goal positions: the end of reeling in for positive signs, of reeling out for others."""
        length = np.where(sign >= 0.0, 1.02 * self.reel.reel_in, -1.02 * self.reel.reel_out)
        angle = (self._zero + length / self.reel.radius) * self._directions
        return [int(value) for value in np.rint(angle / POSITION)]

    def _write(self, torque: Float[np.ndarray, " c"]) -> None:
        if np.any(torque < 0.0):
            # only a jog reels out
            self._bus.write_each(Register.GOAL_POSITION, self._ends(torque))
        current = np.minimum(np.abs(torque) / self.reel.torque_constant, self._current_limit)
        self._bus.write_each(Register.GOAL_CURRENT, [int(value) for value in np.rint(current / CURRENT)])

    def _sample(self, timeout: float) -> MotorSample:
        start = time.monotonic()
        values = np.array(self._bus.sample(timeout), dtype=float)
        middle = 0.5 * (start + time.monotonic())
        current, velocity, angle, errors, watchdog = values.T
        return MotorSample(
            middle,
            current * CURRENT * self.reel.torque_constant * self._directions,
            angle * POSITION * self._directions,
            velocity * VELOCITY * self._directions,
            _fault(errors.astype(int), watchdog.astype(int)),
        )

    def _clear(self) -> None:
        values = self._bus.sample(1.0)
        restarted = [motor for motor, row in zip(self._bus.ids, values, strict=True) if row[3]]
        for motor in restarted:
            # the only way to clear a hardware error
            self._bus.reboot(motor)
        if restarted:
            time.sleep(RESTART_TIME)
        self._open()
        if restarted:
            # a motor forgets its turns when it restarts
            self._zero = self._sample(1.0).angle


def _fault(errors: np.ndarray, watchdog: np.ndarray) -> str:
    for k, bits in enumerate(errors):
        for bit, name in ERRORS.items():
            if bits >> bit & 1:
                return f"{name}:{k + 1}"
    expired = np.flatnonzero(watchdog == EXPIRED)
    return f"motor-watchdog:{expired[0] + 1}" if expired.size else ""
