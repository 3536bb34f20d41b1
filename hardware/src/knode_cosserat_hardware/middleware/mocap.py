"""Motion capture: interface of its sources, frames of axes, bodies that are lost; simulated cameras; VRPN."""

from __future__ import annotations

import abc
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple, Self

import numpy as np
from jaxtyping import Float

from knode_cosserat.recordings.config import RecordingConfig
from knode_cosserat_hardware.driver import HardwareError
from knode_cosserat_hardware.simulated import TrueShape

#: most frames that wait for `frames` (25 s at 240 Hz); older ones are dropped and counted
WAITING = 6000
UpAxis = Literal["z", "y"]


class PoseFrame(NamedTuple):
    """Poses of all bodies at one time; NaN where a body is lost."""

    #: time of the measurement on the host's monotonic clock (s)
    time: float
    #: positions (m)
    position: Float[np.ndarray, "bodies 3"]
    #: orientations, scalar first
    quaternion: Float[np.ndarray, "bodies 4"]


def lost_frame(time: float, count: int) -> PoseFrame:
    """Return a frame at a time (s) in which all bodies are lost."""
    return PoseFrame(time, np.full((count, 3), np.nan), np.full((count, 4), np.nan))


def upright(frame: PoseFrame, up: UpAxis) -> PoseFrame:
    """Return a frame with axes whose z points up, from one with `up`.

    From y up, the frame is rotated by 90° about x: (x, y, z) becomes (x, -z, y). The bodies' own axes
    are kept.
    """
    if up == "z":
        return frame
    x, y, z = frame.position.T
    # product of the rotation's quaternion (s, s, 0, 0) with each orientation
    s = np.sqrt(0.5)
    a, b, c, d = frame.quaternion.T
    turned = s * np.stack([a - b, a + b, c - d, c + d], axis=1)
    return PoseFrame(frame.time, np.stack([x, -z, y], axis=1), turned)


class MotionCapture(abc.ABC):
    """Source of poses. A context manager: a thread receives frames from `open` to `close`.

    Args:
        names: names of the bodies, in the order of poses.
        up: axis of the source that points up; poses have z up.
        latency: time from measurement to arrival (s), subtracted from arrival times.
        clock: monotonic clock (s).

    Raises:
        HardwareError: names are missing or repeated, or a value is not allowed.
    """

    def __init__(
        self,
        names: Sequence[str],
        *,
        up: UpAxis = "z",
        latency: float = 0.0,
        clock: Callable[[], float] = time.monotonic,
    ):
        self.names = tuple(names)
        if not self.names or len(set(self.names)) < len(self.names):
            raise HardwareError(f"names must be one body or more, each once (got {list(self.names)})")
        if up not in ("z", "y"):
            raise HardwareError(f"up must be 'z' or 'y' (got {up!r})")
        if not 0.0 <= latency <= 1.0:
            raise HardwareError(f"latency must be between 0 and 1 s (got {latency!r})")
        self.up: UpAxis = up
        self.latency = latency
        self.clock = clock
        #: number of packets that were ignored: damaged, of another version, or of no known body
        self.ignored = 0
        #: number of frames that were dropped, because `frames` was not called for long
        self.dropped = 0
        #: reason of the last ignored packet; empty without one
        self.problem = ""
        self._newest: PoseFrame | None = None
        self._waiting: deque[PoseFrame] = deque()
        self._arrived = threading.Condition()
        self._error: HardwareError | None = None
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None

    @abc.abstractmethod
    def _connect(self) -> None:
        """Open the connection. Raises `HardwareError`."""

    @abc.abstractmethod
    def _receive(self) -> PoseFrame | None:
        """Return the next frame in the source's axes; None after a short time or an ignored packet."""

    @abc.abstractmethod
    def _disconnect(self) -> None:
        """Close the connection. Never raises."""

    def open(self) -> None:
        """Connect, and receive frames in a thread.

        Raises:
            HardwareError: the source cannot be reached.
        """
        if self._thread is not None:
            return
        self._closing.clear()
        self._error = None
        self._connect()
        self._thread = threading.Thread(target=self._run, name=type(self).__name__, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop receiving. Never raises."""
        self._closing.set()
        if self._thread is not None:
            self._thread.join(2.0)
            self._thread = None
        self._disconnect()

    def poses(self, timeout: float = 1.0) -> PoseFrame:
        """Return the newest frame; waits for one if the newest is older than `timeout` (s).

        Raises:
            HardwareError: no frame came in time, or the connection is lost.
        """

        def is_fresh() -> bool:
            return self._newest is not None and self.clock() - self._newest.time <= timeout

        with self._arrived:
            self._arrived.wait_for(lambda: is_fresh() or self._error is not None, timeout)
            self._check()
            if self._newest is None or not is_fresh():
                hint = f"; {self.ignored} packets were ignored: {self.problem}" if self.problem else ""
                raise HardwareError(
                    f"no frame of motion capture within {timeout:g} s{hint}; check that it streams "
                    f"{', '.join(self.names)} to this host"
                )
            return self._newest

    def frames(self) -> list[PoseFrame]:
        """Return all frames that came since the last call, the oldest first; does not wait.

        Raises:
            HardwareError: the connection is lost.
        """
        with self._arrived:
            self._check()
            found = list(self._waiting)
            self._waiting.clear()
            return found

    def _check(self) -> None:
        if self._error is not None:
            raise HardwareError(str(self._error))

    def _ignore(self, problem: str) -> None:
        self.ignored += 1
        self.problem = problem

    def _run(self) -> None:
        while not self._closing.is_set():
            try:
                frame = self._receive()
            except Exception as error:  # an error in a thread would be lost
                with self._arrived:
                    self._error = HardwareError(f"motion capture: the connection was lost: {error!s:.150}")
                    self._arrived.notify_all()
                return
            if frame is not None:
                self._publish(upright(frame, self.up))

    def _publish(self, frame: PoseFrame) -> None:
        with self._arrived:
            self._newest = frame
            self._waiting.append(frame)
            if len(self._waiting) > WAITING:
                self._waiting.popleft()
                self.dropped += 1
            self._arrived.notify_all()

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class SimulatedCapture(MotionCapture):
    """Poses of a simulated or emulated robot, without noise, in the order of a recording's bodies.

    Args:
        robot: a connected `SimulatedRobot`, or an `EmulatedRobot`. A call reads its present state: there is
            no thread.
        config: base and markers of the recording; the paper's robot if None.
        clock: the driver's clock (s), such as `EmulatedPort.now`; None: `robot.now`.
    """

    def __init__(
        self,
        robot: TrueShape,
        config: RecordingConfig | None = None,
        clock: Callable[[], float] | None = None,
    ):
        config = RecordingConfig.paper_robot() if config is None else config
        base = [] if config.base is None else ["base"]
        given: Any = robot
        self._now: Callable[[], float] = given.now if clock is None else clock
        super().__init__([*base, *(marker.name for marker in config.markers)], clock=self._now)
        self.robot = robot
        self._height = None if config.base is None else config.base.height
        self._fractions: Sequence[float] = [marker.fraction for marker in config.markers]
        self._last = -np.inf

    def poses(self, timeout: float = 1.0) -> PoseFrame:
        """Return the present poses; does not wait. Raises `HardwareError` if the robot is not connected."""
        values = np.asarray(self.robot.poses(self._fractions), dtype=float)
        if self._height is not None:
            values = np.concatenate([[[0.0, 0.0, self._height, 1.0, 0.0, 0.0, 0.0]], values])
        return PoseFrame(self._now(), values[:, :3], values[:, 3:])

    def frames(self) -> list[PoseFrame]:
        """Return the present poses once for each time of the robot; raises as `poses` does."""
        frame = self.poses()
        if frame.time <= self._last:
            return []
        self._last = frame.time
        return [frame]

    def open(self) -> None:
        """Do nothing: the robot is connected."""

    def close(self) -> None:
        """Do nothing: the robot stays connected."""

    def _connect(self) -> None:
        raise HardwareError("a simulated capture has no connection")

    def _receive(self) -> PoseFrame | None:
        return None

    def _disconnect(self) -> None:
        pass


#: port of VRPN servers
PORT = 3883
#: a body whose pose has not changed for this time is lost (s): noise changes every measured pose
LOST = 0.1


class VRPN(MotionCapture):
    """Motion capture by a VRPN server.

    The library gives no times of measurement: arrival times less `latency` are used. A server sends no pose
    of a lost body: its last pose is held for 0.1 s, and is NaN from then on. `poses` raises an error for a
    server that does not answer, because the library waits for it in silence.

    Args:
        names: names of the server's trackers, in the order of poses.
        host: address of the server.
        port: its port.
        rate: greatest number of frames in a second (Hz).
        up: axis of the server that points up.
        latency: time from measurement to arrival (s).
        clock: monotonic clock (s).

    Raises:
        HardwareError: a value is not allowed.
    """

    def __init__(
        self,
        names: Sequence[str],
        host: str,
        *,
        port: int = PORT,
        rate: float = 200.0,
        up: UpAxis = "z",
        latency: float = 0.0,
        clock: Callable[[], float] = time.monotonic,
    ):
        super().__init__(names, up=up, latency=latency, clock=clock)
        if not 1.0 <= rate <= 2000.0:
            raise HardwareError(f"rate must be between 1 and 2000 Hz (got {rate!r})")
        self.address = f"{host}:{port}"
        self.rate = rate
        self._client: Any = None
        self._changed = np.full(len(self.names), -np.inf)
        self._last = np.full((len(self.names), 7), np.nan)
        #: names of the server's trackers that have sent poses
        self.trackers: set[str] = set()

    def _connect(self) -> None:
        try:
            import motioncapture
        except ImportError:
            raise ImportError(
                "VRPN needs motioncapture: pip install 'knode-cosserat-hardware[mocap]' (Linux)"
            ) from None
        try:
            settings = {"hostname": self.address, "update_frequency": f"{self.rate:.0f}"}
            self._client = motioncapture.connect("vrpn", settings)
        except (RuntimeError, ValueError) as error:
            raise HardwareError(f"{self.address}: no VRPN server: {error!s:.150}") from None

    def _receive(self) -> PoseFrame | None:
        self._client.waitForNextFrame()
        now = self.clock()
        # the bodies that sent a pose since the last call
        bodies = self._client.rigidBodies
        self.trackers.update(bodies)
        is_fresh = False
        for row, name in enumerate(self.names):
            body = bodies.get(name)
            if body is None:
                continue
            turned = body.rotation
            pose = np.array([*body.position, turned.w, turned.x, turned.y, turned.z], dtype=float)
            if not np.all(np.isfinite(pose)):
                self._ignore(f"a pose of {name} is not finite")
            elif not np.array_equal(pose, self._last[row]):
                self._last[row], self._changed[row], is_fresh = pose, now, True
        if not is_fresh:
            return None
        poses = np.where((now - self._changed > LOST)[:, None], np.nan, self._last)
        return PoseFrame(now - self.latency, poses[:, :3], poses[:, 3:])

    def _disconnect(self) -> None:
        self._client = None
