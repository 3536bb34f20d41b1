"""Driver of brushless drives on a CAN bus that speak ODrive's CANSimple (firmware 0.5 and 0.6), by torque.

Turn on each drive's own watchdog before use (`axis.config.enable_watchdog`, `axis.config.watchdog_timeout`
of 0.1 to 0.25 s): it is what stops the motors if this program ends. Configure node ids, the current limit,
encoder and motor with the maker's tool.
"""

from __future__ import annotations

import contextlib
import enum
import struct
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import can
import numpy as np
from jaxtyping import Float

from knode_cosserat_hardware.driver import HardwareError, Limits, short_reason
from knode_cosserat_hardware.motor_robot import MotorReel, MotorRobot, MotorSample


class CanCommand(enum.IntEnum):
    """Lower 5 bits of an identifier; the upper 6 are the node's."""

    HEARTBEAT = 0x01
    ESTOP = 0x02
    SET_AXIS_STATE = 0x07
    GET_ENCODER_ESTIMATES = 0x09
    SET_CONTROLLER_MODE = 0x0B
    SET_INPUT_TORQUE = 0x0E
    SET_LIMITS = 0x0F
    GET_IQ = 0x14
    CLEAR_ERRORS = 0x18


#: states of an axis
IDLE, CLOSED_LOOP = 1, 8
#: modes of a controller: torque, without a ramp
TORQUE_CONTROL, PASSTHROUGH = 1, 1
#: bits of a heartbeat's error that are the same in all versions that have them, and names of faults
ERRORS = {
    1 << 24: "motor-watchdog",
    1 << 25: "stopped",
}


class Heartbeat(NamedTuple):
    """State of an axis, sent by itself (every 0.1 s by default)."""

    error: int
    state: int

    @property
    def fault(self) -> str:
        """Name of the fault that its error is; empty without one."""
        for bit, name in ERRORS.items():
            if self.error & bit:
                return name
        return "drive-error" if self.error else ""


def identifier(node: int, command: CanCommand) -> int:
    """Return the 11-bit identifier of a message."""
    return node << 5 | command


def node_and_command(arbitration_id: int) -> tuple[int, int]:
    """Return the node and the command of an identifier."""
    return arbitration_id >> 5, arbitration_id & 0x1F


def read_heartbeat(data: bytes) -> Heartbeat | None:
    """Return a heartbeat; None for damaged data. Bytes after the state differ between versions."""
    return Heartbeat(*struct.unpack_from("<IB", data)) if len(data) >= 5 else None


def read_two_floats(data: bytes) -> tuple[float, float] | None:
    """Return two numbers: position (turns) and velocity (turns/s), or Iq wanted and measured (A)."""
    if len(data) < 8:
        return None
    first, second = struct.unpack_from("<ff", data)
    # not finite: the encoder is not ready
    return (first, second) if abs(first) < 1e30 and abs(second) < 1e30 else None


#: silence of a heartbeat that is a fault, and longest change of an axis's state (s)
HEARTBEAT_TIMEOUT, CHANGE_TIME = 0.5, 1.0
#: time after which a request is sent again (s)
RETRY = 0.05
#: highest speed of the reels (rad/s): a torn tendon does not let the motor race
SPEED_LIMIT = 20.0


class CanRobot(MotorRobot):
    """Robot with one brushless drive and reel for each tendon, on a CAN bus.

    Args:
        channel: channel of the adapter, such as "can0".
        node_ids: nodes of the drives, 0 to 63, in the order of the tendons.
        limits: limits of commanded tensions.
        reel: the motors and their reels; its torque constant is that of the output shaft.
        interface: interface of python-can, such as "socketcan" or "slcan".
        gear_ratio: turns of the motor by turns of the reel.
        bitrate: bits per second, for interfaces that set it.

    Raises:
        HardwareError: an argument is not allowed.
    """

    def __init__(
        self,
        channel: str,
        node_ids: Sequence[int],
        limits: Limits | None = None,
        reel: MotorReel | None = None,
        *,
        interface: str = "socketcan",
        gear_ratio: float = 1.0,
        bitrate: int = 1_000_000,
    ):
        self._nodes = tuple(node_ids)
        is_repeated = len(set(self._nodes)) != len(self._nodes)
        if not self._nodes or is_repeated or any(node not in range(64) for node in self._nodes):
            raise HardwareError(
                f"node_ids must be different whole numbers from 0 to 63 (got {list(node_ids)})"
            )
        if not 0.01 <= gear_ratio <= 1000.0:
            raise HardwareError(f"gear_ratio must be between 0.01 and 1000 (got {gear_ratio!r})")
        super().__init__(len(self._nodes), limits, reel)
        self.name = f"CAN {channel}"
        self._options: dict[str, Any] = {"channel": channel, "interface": interface, "bitrate": bitrate}
        self._gear = gear_ratio
        self._bus: Any = None
        self._closed_loop = False
        self._heartbeats: dict[int, tuple[float, Heartbeat]] = {}
        self._estimates: dict[int, tuple[float, float]] = {}
        self._currents: dict[int, tuple[float, float]] = {}

    # bus

    def _open(self) -> None:
        try:
            self._bus = can.Bus(**self._options)
        except Exception as error:  # each interface has its own errors
            raise HardwareError(
                f"{self.name}: cannot be opened ({short_reason(error)}); "
                "check the adapter, and with socketcan: "
                f"sudo ip link set {self._options['channel']} up type can bitrate {self._options['bitrate']}"
            ) from None
        self._closed_loop = False
        self._heartbeats.clear()
        self._wait_for(
            lambda node, beat: True, "sends no heartbeat; check power, cable, terminators, node id"
        )
        self._disable()
        # in units of the motor: turns/s, and A
        speed = SPEED_LIMIT * self._gear / (2 * np.pi)
        current = 1.5 * self.limits.high * self.reel.radius / self.reel.torque_constant
        for node in self._nodes:
            self._send(node, CanCommand.SET_LIMITS, "<ff", speed, current)
            self._send(node, CanCommand.SET_CONTROLLER_MODE, "<II", TORQUE_CONTROL, PASSTHROUGH)

    def _shut(self) -> None:
        bus, self._bus = self._bus, None
        if bus is not None:
            bus.shutdown()

    def _enable(self) -> None:
        self._write(np.zeros(self.tendon_count))
        for node in self._nodes:
            self._send(node, CanCommand.SET_AXIS_STATE, "<I", CLOSED_LOOP)
        self._closed_loop = True
        self._wait_for(
            lambda node, beat: beat.state == CLOSED_LOOP, "did not enter the closed loop; calibrate it first"
        )

    def _disable(self) -> None:
        self._closed_loop = False
        lost = None
        # one lost frame must not leave the others on
        for node in self._nodes:
            try:
                self._send(node, CanCommand.SET_INPUT_TORQUE, "<f", 0.0)
                self._send(node, CanCommand.SET_AXIS_STATE, "<I", IDLE)
            except HardwareError as error:
                lost = error
        if lost is not None:
            raise lost

    def stop(self) -> None:
        """Stop all drives by their emergency stop; the fault `stopped` latches. Never raises."""
        for node in self._nodes:
            with contextlib.suppress(Exception):
                self._send(node, CanCommand.ESTOP)
        super().stop()

    def _write(self, torque: Float[np.ndarray, " c"]) -> None:
        for node, value in zip(self._nodes, torque * self._directions / self._gear, strict=True):
            self._send(node, CanCommand.SET_INPUT_TORQUE, "<f", float(value))

    def _clear(self) -> None:
        for node in self._nodes:
            self._send(node, CanCommand.CLEAR_ERRORS, "<B", 0)
            self._send(node, CanCommand.SET_AXIS_STATE, "<I", IDLE)
        self._closed_loop = False
        self._drain()
        self._heartbeats.clear()
        # an error that stays is seen in the next sample
        with contextlib.suppress(HardwareError):
            self._wait_for(lambda node, beat: not beat.error, "")

    def _sample(self, timeout: float) -> MotorSample:
        self._drain()
        self._estimates.clear()
        self._currents.clear()
        start = time.monotonic()
        asked = -np.inf
        while not all(node in self._estimates and node in self._currents for node in self._nodes):
            now = time.monotonic()
            if now - start > max(timeout, RETRY):
                raise HardwareError(
                    f"{self.name}: drive {self._silent()} does not answer; check power and cable"
                )
            if now - asked > RETRY:
                asked = now
                for node in self._nodes:
                    self._request(node)
            self._receive(0.005)
        middle = 0.5 * (start + time.monotonic())
        turns = np.array([self._estimates[node] for node in self._nodes])
        current = np.array([self._currents[node][1] for node in self._nodes])
        scale = 2 * np.pi / self._gear
        return MotorSample(
            middle,
            current * self.reel.torque_constant * self._directions,
            turns[:, 0] * scale * self._directions,
            turns[:, 1] * scale * self._directions,
            self._fault_of_drives(),
        )

    def _fault_of_drives(self) -> str:
        now = time.monotonic()
        for k, node in enumerate(self._nodes):
            at, beat = self._heartbeats[node]
            if beat.fault:
                return f"{beat.fault}:{k + 1}"
            if now - at > HEARTBEAT_TIMEOUT:
                return f"heartbeat:{k + 1}"
            if self._closed_loop and beat.state != CLOSED_LOOP:
                return f"drive-idle:{k + 1}"
        return ""

    @property
    def drive_errors(self) -> dict[int, int]:
        """Error bits of each node's last heartbeat; the documentation of its firmware names them."""
        return {node: beat.error for node, (_, beat) in self._heartbeats.items()}

    # messages

    def _silent(self) -> int:
        missing = [node for node in self._nodes if node not in self._estimates or node not in self._currents]
        return missing[0] if missing else self._nodes[0]

    def _wait_for(self, condition: Callable[[int, Heartbeat], bool], problem: str) -> None:
        """Wait until the heartbeats of all drives meet a condition."""
        end = time.monotonic() + CHANGE_TIME
        while True:
            waiting = [
                node
                for node in self._nodes
                if node not in self._heartbeats or not condition(node, self._heartbeats[node][1])
            ]
            if not waiting:
                return
            if time.monotonic() > end:
                beat = self._heartbeats.get(waiting[0])
                error = f" (error 0x{beat[1].error:x})" if beat and beat[1].error else ""
                raise HardwareError(f"{self.name}: drive {waiting[0]} {problem}{error}")
            self._receive(0.01)

    def _request(self, node: int) -> None:
        for command in (CanCommand.GET_ENCODER_ESTIMATES, CanCommand.GET_IQ):
            self._put(arbitration_id=identifier(node, command), is_remote_frame=True, dlc=8)

    def _send(self, node: int, command: CanCommand, layout: str = "", *values: float) -> None:
        data = struct.pack(layout, *values) if layout else b""
        self._put(arbitration_id=identifier(node, command), data=data)

    def _put(self, **message: Any) -> None:
        bus = self._opened()
        try:
            bus.send(can.Message(is_extended_id=False, **message), timeout=0.1)
        except Exception as error:
            raise self._lost(error) from None

    def _drain(self) -> None:
        while self._receive(0.0):
            pass

    def _receive(self, timeout: float) -> bool:
        """Process a message; False if none came in time (s)."""
        bus = self._opened()
        try:
            message = bus.recv(timeout)
        except Exception as error:
            raise self._lost(error) from None
        if message is None:
            return False
        if message.is_remote_frame or message.is_extended_id or message.is_error_frame:
            return True
        node, command = node_and_command(message.arbitration_id)
        data = bytes(message.data)
        if node not in self._nodes:
            return True
        if command == CanCommand.HEARTBEAT and (beat := read_heartbeat(data)) is not None:
            self._heartbeats[node] = (time.monotonic(), beat)
        elif command in (CanCommand.GET_ENCODER_ESTIMATES, CanCommand.GET_IQ):
            values = self._estimates if command == CanCommand.GET_ENCODER_ESTIMATES else self._currents
            if (read := read_two_floats(data)) is not None:
                values[node] = read
        return True

    def _opened(self) -> Any:
        if self._bus is None:
            raise HardwareError(f"{self.name}: the bus is not open; call connect()")
        return self._bus

    def _lost(self, error: Exception) -> HardwareError:
        return HardwareError(
            f"{self.name}: the bus is lost ({short_reason(error)}); check adapter, cable and terminators"
        )
