"""Clock of a host: its monotonic times, as ROS stamps them."""

from __future__ import annotations

import time
from collections.abc import Callable


class HostClock:
    """Conversion of monotonic times (s) to ROS stamps (ns since 1970); the offset is measured once.

    A change of the system's time during a run does not move the stamps. Programs that stamp the same
    readings share one clock.

    Args:
        monotonic: clock of readings and poses (s); that of the transport for an emulated robot.
    """

    def __init__(self, monotonic: Callable[[], float] = time.monotonic):
        self._monotonic = monotonic
        self._offset = time.time_ns() - round(monotonic() * 1e9)

    def now(self) -> float:
        """Return the monotonic time (s)."""
        return self._monotonic()

    def stamp(self, time: float) -> int:
        """Return the stamp (ns since 1970) of a monotonic time (s)."""
        return self._offset + round(time * 1e9)

    def age(self, stamp: int) -> float:
        """Return the time since a stamp (s); negative for one in the future."""
        return (self.stamp(self.now()) - stamp) * 1e-9
