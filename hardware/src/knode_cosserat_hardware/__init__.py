"""Drivers of real robots: serial tension boards, Dynamixel motors, drives on a CAN bus.

Packages of the drivers are imported on first use.
"""

from typing import TYPE_CHECKING

from knode_cosserat._lazy import make_lazy

if TYPE_CHECKING:
    from knode_cosserat_hardware.board_link import SerialTransport, Transport
    from knode_cosserat_hardware.calibration import LoadCellFit, fit_load_cell, write_calibration
    from knode_cosserat_hardware.can_robot import CanRobot
    from knode_cosserat_hardware.commissioning import Commissioning, Person
    from knode_cosserat_hardware.description import Dimensions, HardwareDescription, load_hardware
    from knode_cosserat_hardware.driver import (
        Driver,
        DriverState,
        HardwareError,
        HostClock,
        Latency,
        Limits,
        Reading,
    )
    from knode_cosserat_hardware.dynamixel import DynamixelRobot
    from knode_cosserat_hardware.middleware.commands import CommandGate
    from knode_cosserat_hardware.middleware.dds import DDSBridge
    from knode_cosserat_hardware.middleware.mocap import VRPN, MotionCapture, PoseFrame, SimulatedCapture
    from knode_cosserat_hardware.middleware.natnet import NatNet, NatNetAddress
    from knode_cosserat_hardware.middleware.ros1 import ROS1Node
    from knode_cosserat_hardware.motor_robot import MotorReel
    from knode_cosserat_hardware.open_driver import OpenedDriver, open_driver
    from knode_cosserat_hardware.plant import HardwarePlant
    from knode_cosserat_hardware.recorder import Recorder, record_robot
    from knode_cosserat_hardware.safety import EmergencyStop, SafeRegion, StoppedError
    from knode_cosserat_hardware.serial_board import SerialBoard
    from knode_cosserat_hardware.simulated import MachineParameters, SimulatedRobot
    from knode_cosserat_hardware.teleoperation import Gamepad, Keyboard, SliderWindow, TensionMap, teleoperate

__all__ = [
    "VRPN",
    "CanRobot",
    "CommandGate",
    "Commissioning",
    "DDSBridge",
    "Dimensions",
    "Driver",
    "DriverState",
    "DynamixelRobot",
    "EmergencyStop",
    "Gamepad",
    "HardwareDescription",
    "HardwareError",
    "HardwarePlant",
    "HostClock",
    "Keyboard",
    "Latency",
    "Limits",
    "LoadCellFit",
    "MachineParameters",
    "MotionCapture",
    "MotorReel",
    "NatNet",
    "NatNetAddress",
    "OpenedDriver",
    "Person",
    "PoseFrame",
    "ROS1Node",
    "Reading",
    "Recorder",
    "SafeRegion",
    "SerialBoard",
    "SerialTransport",
    "SimulatedCapture",
    "SimulatedRobot",
    "SliderWindow",
    "StoppedError",
    "TensionMap",
    "Transport",
    "fit_load_cell",
    "load_hardware",
    "open_driver",
    "record_robot",
    "teleoperate",
    "write_calibration",
]

make_lazy(
    __name__,
    {
        "knode_cosserat_hardware.board_link": "SerialTransport Transport",
        "knode_cosserat_hardware.calibration": "LoadCellFit fit_load_cell write_calibration",
        "knode_cosserat_hardware.can_robot": "CanRobot",
        "knode_cosserat_hardware.commissioning": "Commissioning Person",
        "knode_cosserat_hardware.description": "Dimensions HardwareDescription load_hardware",
        "knode_cosserat_hardware.driver": "Driver DriverState HardwareError HostClock Latency Limits Reading",
        "knode_cosserat_hardware.dynamixel": "DynamixelRobot",
        "knode_cosserat_hardware.middleware.commands": "CommandGate",
        "knode_cosserat_hardware.middleware.dds": "DDSBridge",
        "knode_cosserat_hardware.middleware.mocap": "MotionCapture PoseFrame SimulatedCapture VRPN",
        "knode_cosserat_hardware.middleware.natnet": "NatNet NatNetAddress",
        "knode_cosserat_hardware.middleware.ros1": "ROS1Node",
        "knode_cosserat_hardware.motor_robot": "MotorReel",
        "knode_cosserat_hardware.open_driver": "OpenedDriver open_driver",
        "knode_cosserat_hardware.plant": "HardwarePlant",
        "knode_cosserat_hardware.recorder": "Recorder record_robot",
        "knode_cosserat_hardware.safety": "EmergencyStop SafeRegion StoppedError",
        "knode_cosserat_hardware.serial_board": "SerialBoard",
        "knode_cosserat_hardware.simulated": "MachineParameters SimulatedRobot",
        "knode_cosserat_hardware.teleoperation": "Gamepad Keyboard SliderWindow TensionMap teleoperate",
    },
)
