"""Commands from other programs: accepted only if fresh, complete, and while the robot is armed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from knode_cosserat_hardware.driver import Driver, DriverState, HardwareError, HostClock

#: age from which a command is stale, and greatest advance of its stamp (s)
LARGEST_AGE, LARGEST_ADVANCE = 0.2, 0.05
#: silence after a command until the robot is disarmed (s)
SILENCE = 0.5


def tendon_names(count: int) -> list[str]:
    """Return the names of tendons in messages, from tendon_1 on."""
    return [f"tendon_{k + 1}" for k in range(count)]


class CommandGate:
    """Gate for commands of other programs to a driver.

    A command is refused, and counted by reason, if it is stale, out of order, incomplete, or the robot is
    not armed; the driver applies its limits to the others. After a silence of 0.5 s the robot is disarmed:
    a program that died leaves no tension.

    Args:
        driver: the robot.
        clock: clock of the stamps.
        largest_age: age from which a command is stale (s).
    """

    def __init__(self, driver: Driver, clock: HostClock, largest_age: float = LARGEST_AGE):
        self.driver = driver
        self.clock = clock
        self.largest_age = largest_age
        #: number of accepted commands, and of refused ones by reason
        self.accepted, self.refused = 0, Counter[str]()
        #: message of the last refusal of the driver
        self.problem = ""
        self._names = tendon_names(driver.tendon_count)
        self._stamp = 0
        self._commanded: float | None = None

    def pass_on(
        self, names: Sequence[str], tension: Sequence[float], stamp: int
    ) -> Float[np.ndarray, " c"] | None:
        """Send tensions (N) to the driver, and return those sent; None if they are refused.

        Args:
            names: names of the tendons, in any order; empty for tendon_1, tendon_2 …
            tension: of each tendon (N).
            stamp: time of the command (ns since 1970).
        """
        reason, values = self._checked(names, tension, stamp)
        if reason:
            self.refused[reason] += 1
            return None
        try:
            sent = self.driver.command(values)
        except HardwareError as error:
            self.refused["refused by the driver"] += 1
            self.problem = str(error)
            return None
        self.accepted += 1
        self._stamp, self._commanded = stamp, self.clock.now()
        return sent

    def watch(self) -> bool:
        """Disarm the robot if commands have stopped; True if it was disarmed now."""
        if self._commanded is None or self.clock.now() - self._commanded <= SILENCE:
            return False
        self._commanded = None
        if self.driver.state is not DriverState.ARMED:
            return False
        self.driver.disarm()
        return True

    def _checked(self, names: Sequence[str], tension: Sequence[float], stamp: int) -> tuple[str, Any]:
        age = self.clock.age(stamp)
        if age > self.largest_age or age < -LARGEST_ADVANCE:
            return "stale", None
        if stamp <= self._stamp:
            return "out of order", None
        values = np.array(tension, dtype=float)
        if values.shape != (len(self._names),):
            return "wrong number of tensions", None
        if not np.all(np.isfinite(values)):
            return "not finite", None
        if len(names):
            if sorted(names) != sorted(self._names):
                return "unknown names of tendons", None
            values = values[[list(names).index(name) for name in self._names]]
        if self.driver.state is not DriverState.ARMED:
            return "not armed", None
        return "", values
