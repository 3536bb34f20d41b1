"""Drivers of real robots: serial tension boards, Dynamixel motors, drives on a CAN bus.

Optional packages: `pip install 'knode-cosserat[hardware]'`. They are imported on first use.
"""

from typing import TYPE_CHECKING

from knode_cosserat._lazy import make_lazy

if TYPE_CHECKING:
    from knode_cosserat.hardware.clock import HostClock
    from knode_cosserat.hardware.description import Dimensions, HardwareDescription, load_hardware
    from knode_cosserat.hardware.driver import Driver, DriverState, HardwareError, Latency, Limits, Reading
    from knode_cosserat.hardware.middleware.mocap import MotionCapture, PoseFrame
    from knode_cosserat.hardware.middleware.natnet import NatNet
    from knode_cosserat.hardware.recorder import Recorder, record_robot
    from knode_cosserat.hardware.serial_board import SerialBoard
    from knode_cosserat.hardware.transport import SerialTransport, Transport

__all__ = [
    "Dimensions",
    "Driver",
    "DriverState",
    "HardwareDescription",
    "HardwareError",
    "HostClock",
    "Latency",
    "Limits",
    "MotionCapture",
    "NatNet",
    "PoseFrame",
    "Reading",
    "Recorder",
    "SerialBoard",
    "SerialTransport",
    "Transport",
    "load_hardware",
    "record_robot",
]

make_lazy(
    __name__,
    {
        "knode_cosserat.hardware.clock": "HostClock",
        "knode_cosserat.hardware.description": "Dimensions HardwareDescription load_hardware",
        "knode_cosserat.hardware.driver": "Driver DriverState HardwareError Latency Limits Reading",
        "knode_cosserat.hardware.middleware.mocap": "MotionCapture PoseFrame",
        "knode_cosserat.hardware.middleware.natnet": "NatNet",
        "knode_cosserat.hardware.recorder": "Recorder record_robot",
        "knode_cosserat.hardware.serial_board": "SerialBoard",
        "knode_cosserat.hardware.transport": "SerialTransport Transport",
    },
)
