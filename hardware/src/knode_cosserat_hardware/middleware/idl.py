"""Standard ROS 2 messages as DDS types, with ROS 2's names: all definitions of the DDS bridge.

Positions are in m, forces in N, torques in N m; a tendon's effort in a JointState is its tension (N). Values
are checked by cyclonedds, which has no types that mypy understands.
"""

from typing import Any

from cyclonedds.idl import make_idl_struct, types
from cyclonedds.idl.types import float64, int32, uint32

sequence: Any = types.sequence


def _message(package: str, name: str, /, **fields: Any) -> Any:
    """Return the class of a ROS 2 message type, with its fields in order."""
    return make_idl_struct(name, f"{package}::msg::dds_::{name}_", fields)


#: since 1970
Time = _message("builtin_interfaces", "Time", sec=int32, nanosec=uint32)
Header = _message("std_msgs", "Header", stamp=Time, frame_id=str)
Point = _message("geometry_msgs", "Point", x=float64, y=float64, z=float64)
#: scalar last
Quaternion = _message("geometry_msgs", "Quaternion", x=float64, y=float64, z=float64, w=float64)
Pose = _message("geometry_msgs", "Pose", position=Point, orientation=Quaternion)
PoseArray = _message("geometry_msgs", "PoseArray", header=Header, poses=sequence[Pose])
Vector3 = _message("geometry_msgs", "Vector3", x=float64, y=float64, z=float64)
Wrench = _message("geometry_msgs", "Wrench", force=Vector3, torque=Vector3)
WrenchStamped = _message("geometry_msgs", "WrenchStamped", header=Header, wrench=Wrench)
JointState = _message(
    "sensor_msgs",
    "JointState",
    header=Header,
    name=sequence[str],
    position=sequence[float64],
    velocity=sequence[float64],
    effort=sequence[float64],
)
