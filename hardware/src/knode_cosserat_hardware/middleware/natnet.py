"""NatNet: rigid bodies of OptiTrack's Motive from its UDP packets (protocol versions 3 and 4)."""

from __future__ import annotations

import socket
import struct
import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from knode_cosserat_hardware.driver import HardwareError
from knode_cosserat_hardware.middleware.mocap import MotionCapture, PoseFrame, UpAxis, lost_frame

#: numbers of messages
CONNECT, SERVER_INFO, FRAME = 0, 1, 7
#: default multicast group and ports of Motive
GROUP, DATA_PORT, COMMAND_PORT = "239.255.42.99", 1511, 1510
#: largest number of items of a kind in one packet
MOST = 10_000


class PacketError(HardwareError):
    """A packet is damaged, or not of the NatNet protocol."""

    code = "packet"


class RigidBody(NamedTuple):
    """Rigid body of a frame, in the axes of Motive."""

    identity: int
    #: position (m)
    position: tuple[float, float, float]
    #: orientation, scalar last
    quaternion: tuple[float, float, float, float]
    #: False if the cameras lost it in this frame
    is_tracked: bool


class NatNetFrame(NamedTuple):
    """Frame of data: its rigid bodies, and times on the server's clock."""

    number: int
    bodies: list[RigidBody]
    #: time of the exposure and of the transmission, in ticks of the server's clock
    exposure: int
    transmission: int


class ServerInfo(NamedTuple):
    """Answer of the server: name, version of the protocol, frequency of its clock (Hz; 0 if not sent)."""

    name: str
    version: tuple[int, int]
    frequency: int


class NatNetAddress(NamedTuple):
    """Addresses of Motive and of this host."""

    #: host of Motive; None does not ask it, takes packets of any host, and needs a version
    server: str | None = None
    #: multicast group; None for unicast packets
    multicast: str | None = GROUP
    #: address of this host's network interface
    interface: str = "0.0.0.0"
    #: port of the data
    port: int = DATA_PORT


class _Reader:
    """Numbers of a packet, one after the other."""

    def __init__(self, data: bytes, version: tuple[int, int]):
        self._data = data
        self.version = version
        #: True if each section states its size
        self.is_sized = version >= (4, 1)
        self.position = 0

    def take(self, layout: str) -> tuple[Any, ...]:
        values = struct.Struct("<" + layout)
        if self.position + values.size > len(self._data):
            raise PacketError("it is cut")
        found = values.unpack_from(self._data, self.position)
        self.position += values.size
        return found

    def skip(self, size: int) -> None:
        self.take(f"{size}x")

    def count(self) -> int:
        (number,) = self.take("i")
        if not 0 <= number <= MOST:
            raise PacketError(f"it states {number} items; is the version of the protocol right?")
        return int(number)

    def section(self) -> tuple[int, int | None]:
        """Return the number of a section's items, and its end (None if it is not stated)."""
        number = self.count()
        if not self.is_sized:
            return number, None
        (size,) = self.take("i")
        if size < 0 or self.position + size > len(self._data):
            raise PacketError("it is cut")
        return number, self.position + size

    def text(self) -> str:
        end = self._data.find(b"\0", self.position)
        if end < 0:
            raise PacketError("a name has no end")
        found = self._data[self.position : end]
        self.position = end + 1
        return found.decode("utf-8", "replace")


def message_kind(data: bytes) -> int:
    """Return the number of a packet's message.

    Raises:
        PacketError: the packet is shorter than it states.
    """
    if len(data) < 4:
        raise PacketError("it is cut")
    kind, size = struct.unpack_from("<HH", data)
    if len(data) < 4 + size:
        raise PacketError("it is cut")
    return int(kind)


def parse_frame(data: bytes, version: tuple[int, int]) -> NatNetFrame:
    """Return the frame of a packet of rigid bodies and other data, which are skipped.

    Args:
        data: the packet, of version 3 or 4.
        version: version of the protocol.

    Raises:
        PacketError: the packet is damaged, or of another kind.
    """
    if message_kind(data) != FRAME:
        raise PacketError("it is no frame of data")
    reader = _Reader(data, version)
    reader.skip(4)
    (number,) = reader.take("i")
    _skip_section(reader, _skip_marker_set)
    _skip_section(reader, lambda each: each.skip(12))
    count, end = reader.section()
    bodies = [_rigid_body(reader) for _ in range(count)]
    if end is not None and reader.position != end:
        raise PacketError("its rigid bodies have another size than it states")
    _skip_section(reader, _skip_skeleton)
    if reader.is_sized:
        _skip_section(reader, None)
    # labelled markers: id, position, size, parameters, residual
    _skip_section(reader, lambda each: each.skip(26))
    for _ in ("force plates", "other devices"):
        _skip_section(reader, _skip_device)
    # time code, its fraction, time since the start of Motive, exposure, reception, transmission
    *_, exposure, _, transmission = reader.take("IIdQQQ")
    if not all(np.all(np.isfinite((*body.position, *body.quaternion))) for body in bodies):
        raise PacketError("a pose is not finite")
    return NatNetFrame(number, bodies, exposure, transmission)


def _rigid_body(reader: _Reader) -> RigidBody:
    identity, *values = reader.take("i7ffh")
    # after the pose: mean error of its markers (m), and flags
    flags = values.pop()
    return RigidBody(identity, tuple(values[:3]), tuple(values[3:7]), bool(flags & 1))


def _skip_section(reader: _Reader, skip: Callable[[_Reader], None] | None) -> None:
    count, end = reader.section()
    if end is not None:
        reader.position = end
        return
    assert skip is not None
    for _ in range(count):
        skip(reader)


def _skip_marker_set(reader: _Reader) -> None:
    reader.text()
    reader.skip(12 * reader.count())


def _skip_skeleton(reader: _Reader) -> None:
    reader.skip(4)
    for _ in range(reader.count()):
        _rigid_body(reader)


def _skip_device(reader: _Reader) -> None:
    reader.skip(4)
    for _ in range(reader.count()):
        reader.skip(4 * reader.count())


def parse_server_info(data: bytes) -> ServerInfo:
    """Return the server's answer to a request of connection.

    Raises:
        PacketError: the packet is damaged, or of another kind.
    """
    if message_kind(data) != SERVER_INFO:
        raise PacketError("it is no answer of a server")
    reader = _Reader(data, (0, 0))
    reader.skip(4)
    (name,) = reader.take("256s")
    reader.skip(4)
    major, minor, *_ = reader.take("4B")
    try:
        (frequency,) = reader.take("Q")
    except PacketError:
        frequency = 0
    return ServerInfo(name.split(b"\0")[0].decode("utf-8", "replace"), (major, minor), int(frequency))


class NatNet(MotionCapture):
    """Motion capture of OptiTrack's Motive, by its UDP packets.

    Motive's default axes have y up. Damaged packets are ignored and counted.

    Args:
        bodies: streaming identities of Motive's rigid bodies by name, in the order of poses.
        address: host of Motive, or all addresses.
        version: version of the protocol; None asks the server.
        up: axis of Motive that points up.
        latency: time from transmission to arrival (s); from exposure, if the server's clock is not known.
        clock: monotonic clock (s).

    Raises:
        HardwareError: a value is not allowed.
    """

    def __init__(
        self,
        bodies: Mapping[str, int],
        address: str | NatNetAddress,
        *,
        version: tuple[int, int] | None = None,
        up: UpAxis = "y",
        latency: float = 0.0,
        clock: Callable[[], float] = time.monotonic,
    ):
        super().__init__(list(bodies), up=up, latency=latency, clock=clock)
        self.address = NatNetAddress(address) if isinstance(address, str) else address
        if self.address.server is None and version is None:
            raise HardwareError("version must be given without a server, such as (4, 1)")
        self._rows = {identity: row for row, identity in enumerate(bodies.values())}
        if len(self._rows) < len(self.names):
            raise HardwareError(f"bodies must have different identities (got {dict(bodies)})")
        self.version = None if version is None else _checked_version(version)
        self._frequency = 0
        self._host: str | None = None
        self._socket: socket.socket | None = None

    def ask_server(self, timeout: float = 1.0, port: int = COMMAND_PORT) -> ServerInfo:
        """Return the server's name, its version of the protocol and the frequency of its clock.

        Raises:
            HardwareError: it does not answer in time (s).
        """
        server = self.address.server
        if server is None:
            raise HardwareError("there is no server to ask; give its address")
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as commands:
            commands.settimeout(timeout / 3.0)
            for _ in range(3):
                try:
                    commands.sendto(struct.pack("<HH", CONNECT, 0), (server, port))
                    return parse_server_info(commands.recv(65_535))
                except PacketError as error:
                    self._ignore(str(error))
                except OSError:
                    continue
        raise HardwareError(
            f"{server}: no answer of Motive on port {port}; check its address and its streaming panel"
        )

    def _connect(self) -> None:
        server, multicast, interface, port = self.address
        if server is not None:
            try:
                self._host = socket.gethostbyname(server)
            except OSError:
                raise HardwareError(f"{server}: there is no host of this name") from None
        if self.version is None:
            info = self.ask_server()
            self.version, self._frequency = _checked_version(info.version), info.frequency
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self._socket.bind((interface if multicast is None else "", port))
            if multicast is not None:
                member = socket.inet_aton(multicast) + socket.inet_aton(interface)
                self._socket.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, member)
        except OSError as error:
            self._disconnect()
            raise HardwareError(
                f"NatNet: port {port} cannot be opened: {error.strerror or error}; check the interface"
            ) from None
        self._socket.settimeout(0.1)

    def _disconnect(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _receive(self) -> PoseFrame | None:
        assert self._socket is not None and self.version is not None
        try:
            data, (host, _) = self._socket.recvfrom(65_535)
        except TimeoutError:
            return None
        arrival = self.clock()
        if self._host not in (None, host):
            self._ignore(f"a packet from {host}")
            return None
        try:
            if message_kind(data) != FRAME:
                return None
            frame = parse_frame(data, self.version)
        except PacketError as error:
            self._ignore(f"a packet is damaged: {error}")
            return None
        delay = self.latency
        if self._frequency and 0 < frame.exposure <= frame.transmission:
            delay += min((frame.transmission - frame.exposure) / self._frequency, 1.0)
        poses = lost_frame(arrival - delay, len(self.names))
        for body in frame.bodies:
            row = self._rows.get(body.identity)
            if row is not None and body.is_tracked:
                x, y, z, w = body.quaternion
                poses.position[row], poses.quaternion[row] = body.position, (w, x, y, z)
        return poses


def _checked_version(version: tuple[int, int]) -> tuple[int, int]:
    major, minor = version
    if major not in (3, 4):
        raise HardwareError(f"NatNet {major}.{minor} is not supported; supported are versions 3 and 4")
    return major, minor
