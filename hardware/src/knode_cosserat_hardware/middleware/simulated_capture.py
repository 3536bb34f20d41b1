"""Simulated motion capture: poses of a simulated or emulated robot's bodies."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from knode_cosserat.recordings.config import RecordingConfig
from knode_cosserat_hardware.driver import HardwareError
from knode_cosserat_hardware.middleware.mocap import MotionCapture, PoseFrame
from knode_cosserat_hardware.true_shape import TrueShape


class SimulatedCapture(MotionCapture):
    """Poses of a simulated or emulated robot, without noise, in the order of a recording's bodies.

    Args:
        robot: a connected `SimulatedRobot`, or an `EmulatedRobot`. A call reads its present state: there is
            no thread.
        config: base and markers of the recording; the paper's robot if None.
        clock: the driver's clock (s), such as `EmulatedPort.now`; None: `robot.now`.
    """

    def __init__(
        self, robot: TrueShape, config: RecordingConfig | None = None,
        clock: Callable[[], float] | None = None,
    ):  # fmt: skip
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
        """Return the present poses; does not wait.

        Raises:
            HardwareError: the robot is not connected.
        """
        values = np.asarray(self.robot.poses(self._fractions), dtype=float)
        if self._height is not None:
            values = np.concatenate([[[0.0, 0.0, self._height, 1.0, 0.0, 0.0, 0.0]], values])
        return PoseFrame(self._now(), values[:, :3], values[:, 3:])

    def frames(self) -> list[PoseFrame]:
        """Return the present poses once for each time of the robot.

        Raises:
            HardwareError: the robot is not connected.
        """
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
