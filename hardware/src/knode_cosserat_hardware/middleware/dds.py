"""Bridge to ROS 2 without ROS: readings, poses and wrenches as ROS 2's DDS messages, by Cyclone DDS."""

from __future__ import annotations

import contextlib
import os
import socket
import sys
from collections.abc import Iterator
from typing import Any

import numpy as np
from jaxtyping import Float

from knode_cosserat_hardware.driver import HardwareError, HostClock, Reading
from knode_cosserat_hardware.middleware.commands import Bridge, Source, tendon_names
from knode_cosserat_hardware.middleware.mocap import MotionCapture, PoseFrame

#: topics of the bridge; ROS 2 shows them without rt
STATE_TOPIC, POSE_TOPIC, WRENCH_TOPIC = "rt/joint_states", "rt/poses", "rt/wrench"
COMMAND_TOPIC = "rt/tendon_commands"
#: discovery and data on this host only, with unicast
LOOPBACK = """<CycloneDDS><Domain Id="any">
<General><Interfaces><NetworkInterface address="127.0.0.1" multicast="false"/></Interfaces>
<AllowMulticast>false</AllowMulticast></General>
<Discovery><ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>30</MaxAutoParticipantIndex>
<Peers><Peer Address="127.0.0.1"/></Peers></Discovery>
</Domain></CycloneDDS>"""
#: domains of this process, by number: (their object, True if on loopback only)
_domains: dict[int, tuple[Any, bool]] = {}


def open_participant(domain: int, loopback: bool) -> Any:
    """Return a participant of a DDS domain; on loopback it receives packets of this host only.

    Args:
        domain: number of the domain, 0 to 230, as ROS_DOMAIN_ID.
        loopback: True for this host only. False uses the environment's CYCLONEDDS_URI, or all networks.

    Raises:
        HardwareError: the domain cannot be opened, or is open with the other choice in this process.
        ImportError: cyclonedds is not installed.
    """
    try:
        from cyclonedds.core import DDSException
        from cyclonedds.domain import Domain, DomainParticipant
    except ImportError:
        raise ImportError(
            "the DDS bridge needs cyclonedds: pip install 'knode-cosserat-hardware[dds]'"
        ) from None
    if type(domain) is not int or not 0 <= domain <= 230:
        raise HardwareError(f"domain must be a whole number from 0 to 230 (got {domain!r})")
    if domain in _domains and _domains[domain][1] != loopback:
        raise HardwareError(
            f"DDS domain {domain} is open in this process with loopback={not loopback}; choose another domain"
        )
    try:
        if domain not in _domains:
            _domains[domain] = (Domain(domain, LOOPBACK) if loopback else None), loopback
        participant = DomainParticipant(domain)
    except DDSException as error:
        reason = " ".join(str(error).split())
        raise HardwareError(
            f"DDS domain {domain} cannot be opened: {reason:.150}; it may be open in this process already, "
            "or CYCLONEDDS_URI is wrong"
        ) from None
    if loopback:
        _restrict_sockets(domain)
    return participant


def _restrict_sockets(domain: int) -> None:
    """Let the domain's sockets receive from this host only: Cyclone DDS listens on all interfaces.

    Linux only; elsewhere packets that other hosts send to the domain's ports are received.
    """
    if not sys.platform.startswith("linux"):
        return
    # ports of a domain by the DDS standard
    ports = range(7400 + 250 * domain, 7400 + 250 * (domain + 1))
    for opened in _sockets():
        with contextlib.suppress(OSError), opened:
            if opened.family == socket.AF_INET and opened.getsockname()[1] in ports:
                opened.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, b"lo")


def _sockets() -> Iterator[socket.socket]:
    """Yield a duplicate of each socket of this process; the caller closes it."""
    folder = "/proc/self/fd"
    for name in os.listdir(folder):
        with contextlib.suppress(OSError):
            if os.readlink(f"{folder}/{name}").startswith("socket:"):
                yield socket.socket(fileno=os.dup(int(name)))


class DDSBridge(Bridge):
    """Publisher of a robot's readings for ROS 2, and, if chosen, subscriber of commands.

        with DDSBridge(robot) as bridge:
            bridge.run(60.0)

    Topics: `/joint_states` (JointState; effort is the tension in N), `/poses` (PoseArray) and `/wrench`
    (WrenchStamped). With `commands=True` the efforts (N) of `/tendon_commands` (JointState) are sent to the
    armed driver, which applies its limits. The bridge never arms a robot.

    Args:
        source: a connected driver, or another source of readings.
        domain: number of the DDS domain (ROS_DOMAIN_ID).
        loopback: True for this host only; False for the network. DDS has no passwords.
        commands: True accepts commands; the source must be a driver.
        capture: motion capture, whose frames are published too.
        clock: clock of the stamps; a program's recorders and bridges share it.
        frame: name of the frame of poses and wrenches.

    Raises:
        HardwareError: a value is not allowed, or the domain cannot be opened.
        ImportError: cyclonedds is not installed.
    """

    def __init__(
        self,
        source: Source,
        *,
        domain: int = 0,
        loopback: bool = True,
        commands: bool = False,
        capture: MotionCapture | None = None,
        clock: HostClock | None = None,
        frame: str = "world",
    ):
        super().__init__(source, commands, capture, clock)
        self.frame = frame
        self._participant = open_participant(domain, loopback)
        from knode_cosserat_hardware.middleware import idl

        # cyclonedds has no types that mypy understands
        self._idl: Any = idl
        self._state, self._poses, self._wrench = (
            open_writer(self._participant, topic, kind)
            for topic, kind in (
                (STATE_TOPIC, idl.JointState),
                (POSE_TOPIC, idl.PoseArray),
                (WRENCH_TOPIC, idl.WrenchStamped),
            )
        )
        if commands:
            self._commands = open_reader(self._participant, COMMAND_TOPIC, idl.JointState)

    def publish(self, reading: Reading) -> None:
        """Publish a reading as JointState: name tendon_1 …, effort the tension (N)."""
        tension = np.asarray(reading.tension, dtype=float).tolist()
        message = self._idl.JointState(
            self._header(reading.time), tendon_names(len(tension)), [], [], tension
        )
        self._state.write(message)

    def publish_poses(self, frame: PoseFrame) -> None:
        """Publish a frame as PoseArray, in the order of its bodies; NaN for a lost body."""
        idl = self._idl
        rows = np.concatenate([frame.position, frame.quaternion], axis=1).tolist()
        poses = [
            idl.Pose(idl.Point(px, py, pz), idl.Quaternion(x, y, z, w)) for px, py, pz, w, x, y, z in rows
        ]
        self._poses.write(idl.PoseArray(self._header(frame.time), poses))

    def publish_wrench(
        self, time: float, force: Float[np.ndarray, "3"], torque: Float[np.ndarray, "3"]
    ) -> None:
        """Publish a force (N) and a torque (N m), measured or estimated at a time (s, monotonic)."""
        idl = self._idl
        parts = (idl.Vector3(*map(float, np.asarray(each).tolist())) for each in (force, torque))
        self._wrench.write(idl.WrenchStamped(self._header(time), idl.Wrench(*parts)))

    def handle_commands(self) -> int:
        """Send the newest command to the driver, and return the number of commands that came.

        Older ones that came meanwhile are counted as superseded.
        """
        if self.gate is None:
            return 0
        messages = [each for each in self._commands.take(N=100) if isinstance(each, self._idl.JointState)]
        if messages:
            self.gate.refused["superseded"] += len(messages) - 1
            newest = messages[-1]
            stamp = newest.header.stamp.sec * 10**9 + newest.header.stamp.nanosec
            self.gate.pass_on(newest.name, newest.effort, stamp)
        self.gate.watch()
        return len(messages)

    def close(self) -> None:
        """Leave the domain. The driver is left as it is."""
        self._state = self._poses = self._wrench = self._commands = self._participant = None

    def _header(self, time: float) -> Any:
        stamp = self.clock.stamp(time)
        return self._idl.Header(self._idl.Time(stamp // 10**9, stamp % 10**9), self.frame)


def open_writer(participant: Any, topic: str, kind: Any) -> Any:
    """Return a writer with ROS 2's default quality of service: reliable, the last 10 messages."""
    from cyclonedds.pub import DataWriter

    return _opened(DataWriter, participant, topic, kind)


def open_reader(participant: Any, topic: str, kind: Any) -> Any:
    """Return a reader with ROS 2's default quality of service: reliable, the last 10 messages."""
    from cyclonedds.sub import DataReader

    return _opened(DataReader, participant, topic, kind)


def _opened(endpoint: Any, participant: Any, topic: str, kind: Any) -> Any:
    from cyclonedds.qos import Policy, Qos
    from cyclonedds.topic import Topic
    from cyclonedds.util import duration

    quality = Qos(
        # a writer waits at most this long for a slow reader
        Policy.Reliability.Reliable(duration(milliseconds=100)),
        Policy.Durability.Volatile,
        Policy.History.KeepLast(10),
        Policy.DataRepresentation(use_cdrv0_representation=True),
    )
    return endpoint(participant, Topic(participant, topic, kind, qos=quality), qos=quality)
