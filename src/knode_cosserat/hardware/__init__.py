"""Drivers of real robots: serial tension boards, Dynamixel motors, drives on a CAN bus.

Optional packages: `pip install 'knode-cosserat[hardware]'`. They are imported on first use.
"""

from typing import TYPE_CHECKING

from knode_cosserat._lazy import make_lazy

if TYPE_CHECKING:
    from knode_cosserat.hardware.calibration import LoadCellFit, fit_load_cell, write_calibration
    from knode_cosserat.hardware.can_robot import CanRobot
    from knode_cosserat.hardware.clock import HostClock
    from knode_cosserat.hardware.commissioning import Commissioning, Person
    from knode_cosserat.hardware.description import Dimensions, HardwareDescription, load_hardware
    from knode_cosserat.hardware.driver import Driver, DriverState, HardwareError, Latency, Limits, Reading
    from knode_cosserat.hardware.dynamixel import DynamixelRobot
    from knode_cosserat.hardware.middleware.commands import CommandGate
    from knode_cosserat.hardware.middleware.dds import DDSBridge
    from knode_cosserat.hardware.middleware.loopback import LoopbackLatency, measure_loopback
    from knode_cosserat.hardware.middleware.mocap import MotionCapture, PoseFrame
    from knode_cosserat.hardware.middleware.natnet import NatNet, NatNetAddress
    from knode_cosserat.hardware.middleware.ros1 import ROS1Node
    from knode_cosserat.hardware.middleware.simulated_capture import SimulatedCapture
    from knode_cosserat.hardware.middleware.vrpn import VRPN
    from knode_cosserat.hardware.motor_robot import MotorReel
    from knode_cosserat.hardware.open_driver import OpenedDriver, open_driver
    from knode_cosserat.hardware.plant import HardwarePlant
    from knode_cosserat.hardware.recorder import Recorder, record_robot
    from knode_cosserat.hardware.safety import EmergencyStop, SafeRegion, StoppedError
    from knode_cosserat.hardware.serial_board import SerialBoard
    from knode_cosserat.hardware.simulated import SimulatedRobot
    from knode_cosserat.hardware.simulated_cells import MachineParameters
    from knode_cosserat.hardware.sliders import SliderWindow
    from knode_cosserat.hardware.teleoperation import Gamepad, Keyboard, TensionMap, teleoperate
    from knode_cosserat.hardware.transport import SerialTransport, Transport

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
    "LoopbackLatency",
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
    "measure_loopback",
    "open_driver",
    "record_robot",
    "teleoperate",
    "write_calibration",
]

make_lazy(
    __name__,
    {
        "knode_cosserat.hardware.calibration": "LoadCellFit fit_load_cell write_calibration",
        "knode_cosserat.hardware.can_robot": "CanRobot",
        "knode_cosserat.hardware.clock": "HostClock",
        "knode_cosserat.hardware.commissioning": "Commissioning Person",
        "knode_cosserat.hardware.description": "Dimensions HardwareDescription load_hardware",
        "knode_cosserat.hardware.driver": "Driver DriverState HardwareError Latency Limits Reading",
        "knode_cosserat.hardware.dynamixel": "DynamixelRobot",
        "knode_cosserat.hardware.middleware.commands": "CommandGate",
        "knode_cosserat.hardware.middleware.dds": "DDSBridge",
        "knode_cosserat.hardware.middleware.loopback": "LoopbackLatency measure_loopback",
        "knode_cosserat.hardware.middleware.mocap": "MotionCapture PoseFrame",
        "knode_cosserat.hardware.middleware.natnet": "NatNet NatNetAddress",
        "knode_cosserat.hardware.middleware.ros1": "ROS1Node",
        "knode_cosserat.hardware.middleware.simulated_capture": "SimulatedCapture",
        "knode_cosserat.hardware.middleware.vrpn": "VRPN",
        "knode_cosserat.hardware.motor_robot": "MotorReel",
        "knode_cosserat.hardware.open_driver": "OpenedDriver open_driver",
        "knode_cosserat.hardware.plant": "HardwarePlant",
        "knode_cosserat.hardware.recorder": "Recorder record_robot",
        "knode_cosserat.hardware.safety": "EmergencyStop SafeRegion StoppedError",
        "knode_cosserat.hardware.serial_board": "SerialBoard",
        "knode_cosserat.hardware.simulated": "SimulatedRobot",
        "knode_cosserat.hardware.simulated_cells": "MachineParameters",
        "knode_cosserat.hardware.sliders": "SliderWindow",
        "knode_cosserat.hardware.teleoperation": "Gamepad Keyboard TensionMap teleoperate",
        "knode_cosserat.hardware.transport": "SerialTransport Transport",
    },
)
