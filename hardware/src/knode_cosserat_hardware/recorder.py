"""Recorder of a robot's readings and poses: straight to a bag that `load_recording` reads."""

from __future__ import annotations

import contextlib
import io
import os
import threading
from collections.abc import Iterable
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

import numpy as np
from jaxtyping import Float

from knode_cosserat.recordings.config import RecordingConfig
from knode_cosserat.recordings.findings import RecordingError
from knode_cosserat.recordings.messages import encoder_of, message_type, typestore
from knode_cosserat.recordings.streams import OutgoingStream
from knode_cosserat.recordings.write import sent_numbers
from knode_cosserat_hardware.driver import Driver, HardwareError, HostClock, Reading
from knode_cosserat_hardware.middleware.mocap import MotionCapture, PoseFrame


class BagTopic(NamedTuple):
    """Topic of a ROS 1 bag with its message type, such as geometry_msgs/msg/PoseStamped."""

    name: str
    type: str


class Encoded(NamedTuple):
    """Encoded message of a topic."""

    topic: str
    data: bytes


class MessageEncoder:
    """Encoder of poses, tensions and commands (SI units) as ROS 1 messages of a configuration's topics.

    Args:
        config: topics, order and units of the messages.

    Raises:
        RecordingError: the configuration has other quantities than tensions; from all methods: a wrong number
            of tensions or bodies.
        ImportError: rosbags is not installed.
    """

    def __init__(self, config: RecordingConfig):
        others = [source.quantity for source in config.measured if source.quantity != "tension"]
        if others:
            raise RecordingError(f"{others[0]} cannot be recorded; required is a configuration with tensions")
        self.config = config
        #: names of the bodies, in the order of poses: the base, where there is one, then the markers
        self.bodies: tuple[str, ...] = tuple(marker.name for marker in config.markers)
        topics = [marker.topic for marker in config.markers]
        if config.base is not None:
            self.bodies, topics = ("base", *self.bodies), [config.base.topic, *topics]
        self._poses = [OutgoingStream(topic, "pose", [], np.zeros((0, 7))) for topic in topics]
        self._numbers = {
            role: OutgoingStream(source.topic, role, [], np.zeros((0, len(source.order))), source)  # type: ignore[arg-type]
            for role, source in (("control", config.tension), ("command", config.command))
            if source is not None
        }
        streams = [*self._poses, *self._numbers.values()]
        self._encode = {stream.topic: encoder_of(stream, 1) for stream in streams}
        #: topics of all messages
        self.topics = [BagTopic(stream.topic, message_type(stream, 1)) for stream in streams]

    def poses(
        self, stamp: int, position: Float[np.ndarray, "bodies 3"], quaternion: Float[np.ndarray, "bodies 4"]
    ) -> list[Encoded]:
        """Return the messages of all bodies with finite values: a lost body has no message.

        Args:
            stamp: time of the measurement (ns since 1970).
            position: positions (m), in the order of `bodies`.
            quaternion: orientations, scalar first.
        """
        scale = self.config.position_factor
        values = np.concatenate([np.asarray(position) / scale, np.asarray(quaternion)], axis=1)
        if values.shape != (len(self.bodies), 7):
            raise RecordingError(
                f"poses must be of {len(self.bodies)} bodies: {', '.join(self.bodies)} (got {len(values)})"
            )
        pairs = zip(self._poses, values, strict=True)
        return [self._message(stream, stamp, row) for stream, row in pairs if np.all(np.isfinite(row))]

    def tension(self, stamp: int, tension: Float[np.ndarray, " tendons"]) -> list[Encoded]:
        """Return the message of measured tensions (N).

        There is none if one is not finite, as without a measurement, or without a topic for tensions.
        """
        return self._tensions("control", stamp, tension) if np.all(np.isfinite(tension)) else []

    def command(self, stamp: int, tension: Float[np.ndarray, " tendons"]) -> list[Encoded]:
        """Return the message of commanded tensions (N); none if the configuration has no topic for it.

        Text commands in grams-force are rounded to whole numbers; one that is not finite is an error.
        """
        return self._tensions("command", stamp, tension)

    def simulation(self, stamp: int) -> list[Encoded]:
        """Return the line of the log on a simulated robot; none if commands are not text."""
        source, stream = self.config.command, self._numbers.get("command")
        if source is None or stream is None or source.text is None:
            return []
        return [self._message(stream, stamp, np.full(len(source.order), np.nan))]

    def _tensions(self, role: str, stamp: int, tension: Any) -> list[Encoded]:
        stream = self._numbers.get(role)
        if stream is None:
            return []
        values = np.asarray(tension, dtype=float)
        if values.shape != (len(stream.source.order),):
            raise RecordingError(
                f"topic {stream.topic} has {len(stream.source.order)} tendons (got tensions of shape "
                f"{values.shape})"
            )
        if not np.all(np.isfinite(values)):
            raise RecordingError(f"topic {stream.topic}: tensions must be finite (got {values.tolist()})")
        return [self._message(stream, stamp, sent_numbers(stream.source, values[None])[0])]

    def _message(self, stream: OutgoingStream, stamp: int, values: Any) -> Encoded:
        return Encoded(stream.topic, self._encode[stream.topic](stamp, 0, values))


class BagMessage(NamedTuple):
    """Encoded message with its recording time (ns since 1970)."""

    received: int
    topic: str
    data: bytes


class _WholeFile(io.FileIO):
    """File without a buffer, which a full disk would leave behind; writes are whole."""

    def write(self, data: Any) -> int:
        rest = memoryview(data)
        while rest:
            rest = rest[super().write(rest) :]
        return len(data)

    def sync(self) -> None:
        os.fsync(self.fileno())

    def close(self) -> None:
        try:
            if not self.closed:
                self.sync()
        finally:
            super().close()


class BagStream:
    """ROS 1 bag that is written in chunks.

    Args:
        path: the file; it must not exist.
        topics: topics of the messages.

    Raises:
        OSError: the file exists or cannot be written.
        ImportError: rosbags is not installed.
    """

    def __init__(self, path: Path, topics: Iterable[BagTopic]):
        store = typestore(1)
        from rosbags.rosbag1 import Writer

        if path.exists():
            raise FileExistsError(path)
        self._bag = bag = Writer(path)
        # a chunk ends where `write` says
        bag.chunk_threshold = 1 << 40
        bag.open()
        assert bag.bio is not None
        try:
            bag.bio.close()
            self._file = _WholeFile(path, "r+b")
        except OSError:
            path.unlink(missing_ok=True)
            raise
        bag.bio = self._file
        #: end of the last complete chunk (bytes)
        self._end = self._file.seek(0, os.SEEK_END)
        self._connections = {topic.name: bag.add_connection(*topic, typestore=store) for topic in topics}

    def write(self, messages: list[BagMessage]) -> None:
        """Write messages as one chunk, and wait until the disk has it.

        Raises:
            OSError: the disk is full, for example; the file ends with the last complete chunk.
        """
        if not messages:
            return
        for message in messages:
            self._bag.write(self._connections[message.topic], message.received, message.data)
        try:
            self._bag.write_chunk(self._bag.chunks[-1])
        except OSError:
            self._file.truncate(self._end)
            raise
        self._end = self._file.tell()
        self._file.sync()

    def finish(self) -> None:
        """Write the index at the file's end, and close it.

        Raises:
            OSError: the disk is full, for example; the file has no index then.
        """
        try:
            self._bag.close()
        except OSError:
            self._file.truncate(self._end)
            raise

    def close(self) -> None:
        """Close the file without an index. Never raises."""
        with contextlib.suppress(OSError):
            self._file.close()


#: default time between two writes to the disk (s)
INTERVAL = 0.5


class Recorder:
    """Recorder of tensions, poses and commands into a ROS 1 bag with the paper's topics.

        with Recorder("run.bag") as recorder:
            recorder.add_reading(robot.read())

    A thread writes to the disk, so that no call waits for it. While it records, the file is `run.bag.active`,
    which `load_recording` reads too; at the end it is renamed. A killed process loses what was added in the
    last `interval`, and what is being written. On a full disk the file keeps everything up to the last
    complete chunk, and the next call raises a `HardwareError`. Values of a wrong number raise a
    `RecordingError`.

    Args:
        path: the bag; its name ends in .bag. An existing file is never replaced.
        config: topics, order and units; the paper's robot if None. A simulated robot is stated in the bag.
        clock: clock of readings and poses; a program's bridges and nodes share it.
        interval: time between two writes to the disk (s).

    Raises:
        HardwareError: the name is not allowed, or the file exists or cannot be created.
        RecordingError: the configuration has other quantities than tensions.
        ImportError: rosbags is not installed.
    """

    def __init__(
        self,
        path: str | Path,
        config: RecordingConfig | None = None,
        *,
        clock: HostClock | None = None,
        interval: float = INTERVAL,
    ):
        self.path = Path(path)
        if self.path.suffix != ".bag":
            raise HardwareError(f"{self.path}: the name of a recording must end in .bag")
        if not 0.01 <= interval <= 60.0:
            raise HardwareError(f"interval must be between 0.01 and 60 s (got {interval!r})")
        self.clock = HostClock() if clock is None else clock
        self.encoder = MessageEncoder(RecordingConfig.paper_robot() if config is None else config)
        self._interval = interval
        self._lock = threading.Condition()
        self._pending: list[BagMessage] = []
        #: number of messages that are on the disk
        self.written = 0
        self._error: HardwareError | None = None
        self._is_raised = False
        self._closing = False
        self._stream = self._open()
        if self.encoder.config.simulated:
            stamp = self.clock.stamp(self.clock.now())
            self._add(self.encoder.simulation(stamp))
        self._thread = threading.Thread(target=self._run, name=f"recorder {self.path.name}", daemon=True)
        self._thread.start()

    @property
    def active_path(self) -> Path:
        """File that is written while the recorder runs, and that remains if it is killed."""
        return self.path.with_name(self.path.name + ".active")

    def _open(self) -> BagStream:
        if self.path.exists():
            raise HardwareError(f"{self.path}: this file exists; choose another name, or delete it")
        try:
            return BagStream(self.active_path, self.encoder.topics)
        except FileExistsError:
            raise HardwareError(
                f"{self.active_path}: this file exists; it is from a recording that runs or was killed: "
                "rename it, for load_recording reads it"
            ) from None
        except OSError as error:
            raise HardwareError(f"{self.path}: cannot be written: {error.strerror}") from None

    def add_reading(self, reading: Reading) -> None:
        """Add the measured tensions of a reading; one without a measurement (NaN) has no message."""
        self._add(self.encoder.tension(self.clock.stamp(reading.time), reading.tension))

    def add_poses(self, frame: PoseFrame) -> None:
        """Add the poses of all bodies in the order of `encoder.bodies`; a lost body (NaN) has no message."""
        self._add(self.encoder.poses(self.clock.stamp(frame.time), frame.position, frame.quaternion))

    def add_command(self, tension: Float[np.ndarray, " c"], time: float | None = None) -> None:
        """Add commanded tensions (N), all finite, at a time (s, monotonic); now if None."""
        self._add(self.encoder.command(self.clock.stamp(self.clock.now() if time is None else time), tension))

    def close(self) -> None:
        """Write the rest and the index, and rename the file. A second call does nothing.

        Raises:
            HardwareError: a message could not be written; not if an earlier call has raised it.
        """
        with self._lock:
            if self._closing:
                return
            self._closing = True
            self._lock.notify_all()
        self._thread.join()
        if self._error is None:
            try:
                self._stream.finish()
                if self.path.exists():
                    self._fail("a file of this name was made meanwhile")
                else:
                    os.rename(self.active_path, self.path)
            except OSError as error:
                self._fail(error.strerror or str(error))
        self._stream.close()
        if not self._is_raised:
            self._check()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        # an error that leaves the block is more important than the file's
        with contextlib.suppress(HardwareError) if kind is not None else contextlib.nullcontext():
            self.close()

    def _add(self, messages: list[Encoded]) -> None:
        received = self.clock.stamp(self.clock.now())
        with self._lock:
            self._check()
            if self._closing:
                raise HardwareError(f"{self.path}: the recorder is closed; open another one")
            self._pending += [BagMessage(received, message.topic, message.data) for message in messages]

    def _check(self) -> None:
        if self._error is not None:
            self._is_raised = True
            raise HardwareError(str(self._error))

    def _fail(self, reason: str) -> None:
        self._error = HardwareError(
            f"{self.path}: recording stopped: {reason}; "
            f"{self.written} messages are kept in {self.active_path}"
        )

    def _run(self) -> None:
        while self._error is None:
            with self._lock:
                self._lock.wait_for(lambda: self._closing, self._interval)
                messages, self._pending = self._pending, []
                is_last = self._closing
            try:
                self._stream.write(messages)
                self.written += len(messages)
            except Exception as error:  # an error in a thread would be lost
                reason = error.strerror if isinstance(error, OSError) else None
                with self._lock:
                    self._fail(reason or f"{error!r:.150}")
            if is_last:
                return


def record_robot(
    recorder: Recorder, driver: Driver, duration: float, capture: MotionCapture | None = None
) -> int:
    """Record a robot for a time, in which nothing commands it, and return the number of readings.

    Args:
        recorder: an open recorder.
        driver: a connected robot.
        duration: how long (s), on the recorder's clock.
        capture: motion capture, in the order of the recorder's bodies.

    Raises:
        HardwareError: the robot or motion capture does not answer, or the disk is full.
    """
    # a simulated clock reaches the end but for rounding
    end = recorder.clock.now() + duration - 1e-9
    count = 0
    while recorder.clock.now() < end:
        recorder.add_reading(driver.read())
        count += 1
        for frame in capture.frames() if capture is not None else ():
            recorder.add_poses(frame)
    return count
