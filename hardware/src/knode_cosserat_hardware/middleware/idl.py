"""Standard ROS 2 messages as DDS types, with ROS 2's names: all definitions of the DDS bridge.

Annotations are evaluated by cyclonedds: this module has no `from __future__ import annotations`.
"""

from dataclasses import dataclass

from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import float64, int32, sequence, uint32


def _name(package: str, message: str) -> str:
    """Return the DDS name of a ROS 2 message type."""
    return f"{package}::msg::dds_::{message}_"


@dataclass
class Time(IdlStruct, typename=_name("builtin_interfaces", "Time")):
    """Time since 1970: seconds and nanoseconds."""

    sec: int32
    nanosec: uint32


@dataclass
class Header(IdlStruct, typename=_name("std_msgs", "Header")):
    """Time and frame of a message."""

    stamp: Time
    frame_id: str


@dataclass
class Point(IdlStruct, typename=_name("geometry_msgs", "Point")):
    """Position (m)."""

    x: float64
    y: float64
    z: float64


@dataclass
class Quaternion(IdlStruct, typename=_name("geometry_msgs", "Quaternion")):
    """Orientation, scalar last."""

    x: float64
    y: float64
    z: float64
    w: float64


@dataclass
class Pose(IdlStruct, typename=_name("geometry_msgs", "Pose")):
    """Position (m) and orientation."""

    position: Point
    orientation: Quaternion


@dataclass
class PoseArray(IdlStruct, typename=_name("geometry_msgs", "PoseArray")):
    """Poses of several bodies at one time."""

    header: Header
    poses: sequence[Pose]  # type: ignore[type-arg, unused-ignore]


@dataclass
class Vector3(IdlStruct, typename=_name("geometry_msgs", "Vector3")):
    """Vector of a force (N) or torque (N m)."""

    x: float64
    y: float64
    z: float64


@dataclass
class Wrench(IdlStruct, typename=_name("geometry_msgs", "Wrench")):
    """Force (N) and torque (N m)."""

    force: Vector3
    torque: Vector3


@dataclass
class WrenchStamped(IdlStruct, typename=_name("geometry_msgs", "WrenchStamped")):
    """Wrench at one time."""

    header: Header
    wrench: Wrench


@dataclass
class JointState(IdlStruct, typename=_name("sensor_msgs", "JointState")):
    """State of joints: tendons, whose effort is the tension (N)."""

    header: Header
    name: sequence[str]  # type: ignore[type-arg, unused-ignore]
    position: sequence[float64]  # type: ignore[type-arg, unused-ignore]
    velocity: sequence[float64]  # type: ignore[type-arg, unused-ignore]
    effort: sequence[float64]  # type: ignore[type-arg, unused-ignore]
