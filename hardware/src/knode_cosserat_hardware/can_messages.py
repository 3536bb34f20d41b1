"""Messages of ODrive's CANSimple protocol: identifiers, and little-endian data of at most 8 bytes."""

from __future__ import annotations

import enum
import struct
from typing import NamedTuple


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
