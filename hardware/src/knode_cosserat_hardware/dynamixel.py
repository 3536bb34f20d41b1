"""Driver of Dynamixel motors with reels (XM series, protocol 2.0), in current-based position mode.

A motor pulls with its goal current towards a goal position, and stops there if the tendon is off. One
synchronous read takes current, velocity, position, errors and watchdog of all motors. On Linux, set the
latency timer of the USB adapter to 1 ms (16 ms is the default, and limits reads to 60 a second):

    echo 1 | sudo tee /sys/bus/usb-serial/devices/ttyUSB0/latency_timer
"""

from __future__ import annotations

import contextlib
import enum
import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import dynamixel_sdk as sdk
import numpy as np
from jaxtyping import Float

from knode_cosserat_hardware.driver import HardwareError, Limits, short_reason
from knode_cosserat_hardware.motor_robot import MotorReel, MotorRobot, MotorSample

#: tries of a transfer
TRIES = 3
#: the motors copy the registers of a sample here, so that one read takes them all
INDIRECT_ADDRESS, INDIRECT_DATA = 168, 224


class Register(enum.Enum):
    """Registers of the X series: address, size (bytes), True if signed."""

    RETURN_DELAY = (9, 1, False)
    OPERATING_MODE = (11, 1, False)
    CURRENT_LIMIT = (38, 2, False)
    TORQUE_ENABLE = (64, 1, False)
    HARDWARE_ERROR = (70, 1, False)
    BUS_WATCHDOG = (98, 1, False)
    GOAL_CURRENT = (102, 2, True)
    GOAL_POSITION = (116, 4, True)
    PRESENT_CURRENT = (126, 2, True)
    PRESENT_VELOCITY = (128, 4, True)
    PRESENT_POSITION = (132, 4, True)

    @property
    def address(self) -> int:
        """Address of the first byte."""
        return self.value[0]

    @property
    def size(self) -> int:
        """Number of bytes."""
        return self.value[1]

    def decoded(self, data: bytes) -> int:
        """Return the value of the register's bytes."""
        return int.from_bytes(data, "little", signed=self.value[2])

    def encoded(self, value: int) -> list[int]:
        """Return the bytes of a value."""
        return list(value.to_bytes(self.size, "little", signed=self.value[2] and value < 0))


class DynamixelBus:
    """Motors on one bus. Transfers are tried three times.

    Args:
        port: serial port, or a port handler of the SDK.
        ids: identities of the motors.
        baud: bits per second.

    Raises:
        HardwareError: an identity is not allowed.
    """

    def __init__(self, port: Any, ids: Sequence[int], baud: int):
        self.ids = tuple(ids)
        if (
            not self.ids
            or len(set(self.ids)) != len(self.ids)
            or not all(each in range(253) for each in self.ids)
        ):
            raise HardwareError(f"ids must be different whole numbers from 0 to 252 (got {list(ids)})")
        self.name = port if isinstance(port, str) else "Dynamixel bus"
        self._given, self._baud = port, baud
        self._port: Any = None
        self._packets: Any = None
        self._sampled: tuple[Register, ...] = ()
        self._reader: Any = None

    def open(self) -> None:
        """Open the port; nothing if it is open."""
        if self._port is not None:
            return
        port = sdk.PortHandler(self._given) if isinstance(self._given, str) else self._given
        try:
            opened = port.openPort() and port.setBaudRate(self._baud)
        except Exception as error:
            raise HardwareError(
                f"{self.name}: cannot be opened ({short_reason(error)}); check the adapter"
            ) from None
        if not opened:
            raise HardwareError(f"{self.name}: cannot be opened at {self._baud} baud; check port and baud")
        self._port, self._packets = port, sdk.PacketHandler(2.0)
        with contextlib.suppress(OSError, ValueError):
            timer = int(Path(f"/sys/bus/usb-serial/devices/{Path(self.name).name}/latency_timer").read_text())
            self._slow = timer > 2

    #: True if the USB adapter's latency timer limits the rate of reads
    _slow = False

    def close(self) -> None:
        """Close the port."""
        port, self._port, self._reader = self._port, None, None
        if port is not None:
            port.closePort()

    def read(self, motor: int, register: Register) -> int:
        """Return a register of one motor."""

        def transfer() -> tuple[int, Any]:
            data, result, _ = self._packets.readTxRx(self._port, motor, register.address, register.size)
            return result, data

        return register.decoded(bytes(self._tried(transfer, motor)))

    def write(self, motor: int, register: Register, value: int) -> None:
        """Write a register of one motor."""
        self._write_bytes(motor, register.address, register.encoded(value), register.name)

    def write_all(self, register: Register, value: int) -> None:
        """Write one value to all motors, without answers."""
        self.write_each(register, [value] * len(self.ids))

    def write_each(self, register: Register, values: Sequence[int]) -> None:
        """Write a value to each motor in one packet, without answers."""
        writer = sdk.GroupSyncWrite(self._open_port(), self._packets, register.address, register.size)
        for motor, value in zip(self.ids, values, strict=True):
            writer.addParam(motor, register.encoded(value))
        self._tried(lambda: (writer.txPacket(), None), 0)

    def reboot(self, motor: int) -> None:
        """Start a motor again, which clears its hardware errors."""
        self._tried(lambda: (self._packets.reboot(self._port, motor)[0], None), motor)

    def prepare_sampling(self, registers: Sequence[Register]) -> None:
        """Tell the motors which registers a sample has."""
        self._sampled = tuple(registers)
        addresses = [each.address + k for each in registers for k in range(each.size)]
        data = [byte for address in addresses for byte in address.to_bytes(2, "little")]
        for motor in self.ids:
            self._write_bytes(motor, INDIRECT_ADDRESS, data, "Indirect Address")
        self._reader = sdk.GroupSyncRead(self._port, self._packets, INDIRECT_DATA, len(addresses))
        for motor in self.ids:
            self._reader.addParam(motor)

    def sample(self, timeout: float) -> list[list[int]]:
        """Return the registers of a sample for each motor, by one synchronous read."""
        self._open_port()
        end, tries = time.monotonic() + timeout, 0
        while self._safely(lambda: (self._reader.txRxPacket(), None))[0] != 0:
            tries += 1
            if time.monotonic() > end and tries >= TRIES:
                silent = [motor for motor in self.ids if not self._reader.data_dict.get(motor)]
                raise self._silent(silent[0] if silent else self.ids[0])
        rows = []
        for motor in self.ids:
            data, row, start = bytes(self._reader.data_dict[motor]), [], 0
            for register in self._sampled:
                row.append(register.decoded(data[start : start + register.size]))
                start += register.size
            rows.append(row)
        return rows

    def _write_bytes(self, motor: int, address: int, data: list[int], name: str) -> None:
        def transfer() -> tuple[int, Any]:
            result, error = self._packets.writeTxRx(self._port, motor, address, len(data), data)
            return result, error

        # bit 7 reports a hardware error, not a refusal
        error = self._tried(transfer, motor) & 0x7F
        if error:
            reason = " ".join(self._packets.getRxPacketError(error).split())
            raise HardwareError(f"{self.name}: motor {motor} refused to write {name}: {reason}")

    def _tried(self, transfer: Any, motor: int) -> Any:
        self._open_port()
        for _ in range(TRIES):
            result, value = self._safely(transfer)
            if result == 0:
                return value
        raise self._silent(motor)

    def _safely(self, transfer: Any) -> tuple[int, Any]:
        try:
            return transfer()
        # the SDK passes on errors of the port, and of packets that it does not expect
        except Exception as error:
            raise HardwareError(
                f"{self.name}: the bus is lost ({short_reason(error)}); check the USB cable"
            ) from None
        finally:
            if self._port is not None:
                # the SDK leaves it set after an error, and refuses all later packets
                self._port.is_using = False

    def _silent(self, motor: int) -> HardwareError:
        slow = "; set latency_timer to 1 ms" if self._slow else ""
        return HardwareError(
            f"{self.name}: motor {motor} does not answer; check its power, cable and id, and the baud "
            f"({self._baud}){slow}"
        )

    def _open_port(self) -> Any:
        if self._port is None:
            raise HardwareError(f"{self.name}: the bus is not open; call connect()")
        return self._port


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
