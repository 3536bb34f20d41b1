"""VRPN: poses of motion-capture systems with a VRPN server (Vicon, OptiTrack), by `motioncapture`."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from knode_cosserat_hardware.driver import HardwareError
from knode_cosserat_hardware.middleware.mocap import MotionCapture, PoseFrame, UpAxis

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
