"""Recorder of a robot's readings and poses: straight to a bag that `load_recording` reads."""

from __future__ import annotations

import contextlib
import os
import threading
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
from jaxtyping import Float

from knode_cosserat.hardware.bag_stream import BagMessage, BagStream
from knode_cosserat.hardware.clock import HostClock
from knode_cosserat.hardware.driver import Driver, HardwareError, Reading
from knode_cosserat.hardware.middleware.mocap import MotionCapture, PoseFrame
from knode_cosserat.recordings.config import RecordingConfig
from knode_cosserat.recordings.write import Encoded, MessageEncoder

#: default time between two writes to the disk (s)
INTERVAL = 0.5


class Recorder:
    """Recorder of tensions, poses and commands into a ROS 1 bag with the paper's topics.

        with Recorder("run.bag") as recorder:
            recorder.add_reading(robot.read())

    A thread writes to the disk, so that no call waits for it. While it records, the file is `run.bag.active`,
    which `load_recording` reads too; at the end it is renamed. A killed process loses what was added in the
    last `interval`, and what is being written. On a full disk the file keeps everything up to the last
    complete chunk, and the next call raises an error.

    Args:
        path: the bag; its name ends in .bag. An existing file is never replaced.
        config: topics, order and units; the paper's robot if None. A simulated robot is stated in the bag.
        clock: clock of readings and poses; a program's bridges and nodes share it.
        interval: time between two writes to the disk (s).

    Raises:
        HardwareError: the name is not allowed, or the file exists or cannot be created.
        RecordingError: the configuration has motors in place of tensions.
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
        """Add the measured tensions of a reading; one without a measurement (NaN) has no message.

        Raises:
            HardwareError: an earlier message could not be written.
            RecordingError: the number of tensions is wrong.
        """
        self._add(self.encoder.tension(self.clock.stamp(reading.time), reading.tension))

    def add_poses(self, frame: PoseFrame) -> None:
        """Add the poses of all bodies in the order of `encoder.bodies`; a lost body (NaN) has no message.

        Raises:
            HardwareError: an earlier message could not be written.
            RecordingError: the number of bodies is wrong.
        """
        self._add(self.encoder.poses(self.clock.stamp(frame.time), frame.position, frame.quaternion))

    def add_command(self, tension: Float[np.ndarray, " c"], time: float | None = None) -> None:
        """Add commanded tensions (N), at a time (s, monotonic); now if None.

        Raises:
            HardwareError: an earlier message could not be written.
            RecordingError: the number of tensions is wrong, or one is not finite.
        """
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
    """Record a connected robot, which nothing commands meanwhile, and return the number of readings.

    Args:
        recorder: an open recorder.
        driver: a connected robot.
        duration: how long (s), on the recorder's clock.
        capture: motion capture, in the order of the recorder's bodies.

    Raises:
        HardwareError: the robot or motion capture does not answer, or the disk is full.
    """
    end = recorder.clock.now() + duration
    count = 0
    while recorder.clock.now() < end:
        recorder.add_reading(driver.read())
        count += 1
        for frame in capture.frames() if capture is not None else ():
            recorder.add_poses(frame)
    return count
