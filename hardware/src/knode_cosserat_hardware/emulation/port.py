"""Serial ports of an emulated robot: one in lock-step, and a pseudo-terminal that keeps real time."""

from __future__ import annotations

import contextlib
import os
import threading
import time
import tty
from collections.abc import Callable
from types import TracebackType
from typing import Self

from knode_cosserat_hardware.driver import HardwareError
from knode_cosserat_hardware.emulation.robot import EmulatedRobot
from knode_cosserat_hardware.transport import Transport

#: time between two exchanges of bytes of a pseudo-terminal (s)
EXCHANGE = 1.0 / 128.0


class EmulatedPort(Transport):
    """Port of an emulated robot in lock-step: reading moves the robot on, and its clock is the simulated one.

    The same program gives the same bits, whatever else the computer does.
    """

    real_time = False
    name = "emulated board"

    def __init__(self, robot: EmulatedRobot, damage: Callable[[bytes], bytes] | None = None):
        """Open the port, which resets the chip.

        Args:
            robot: the robot behind the port.
            damage: changes the bytes that the host sends, to try a bad cable.
        """
        self.robot, self._damage, self._is_open = robot, damage, True
        robot.chip.reset()

    def write(self, data: bytes) -> None:
        """Send bytes; they take their time on the wire."""
        self._check()
        self.robot.chip.send(data if self._damage is None else self._damage(data))

    def read(self, timeout: float) -> bytes:
        """Return the bytes that have arrived; moves the robot on until there are some, or by the timeout."""
        self._check()
        end = self.robot.time + timeout
        while not (data := self.robot.chip.received()) and self.robot.time < end:
            self.robot.step()
        return data

    def now(self) -> float:
        """Return the simulated time (s)."""
        return self.robot.time

    def close(self) -> None:
        """Close the port."""
        self._is_open = False

    def _check(self) -> None:
        if not self._is_open:
            raise HardwareError("the emulated port is closed; open a new one with robot.port()")


class PseudoTerminal:
    """A pseudo-terminal before an emulated robot that moves in real time: any program can open `path`.

    with PseudoTerminal(robot) as terminal:
        SerialBoard(terminal.path, limits).connect()
    """

    def __init__(self, robot: EmulatedRobot):
        self.robot = robot
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        #: name of the terminal's device file
        self.path = os.ttyname(self._slave)
        #: error that ended the robot's motion, if any
        self.error: Exception | None = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="emulated robot", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Stop the robot and close the terminal."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()
        for descriptor in (self._master, self._slave):
            with contextlib.suppress(OSError):
                os.close(descriptor)

    def _run(self) -> None:
        due = time.monotonic()
        try:
            while not self._stop.is_set():
                self._exchange()
                self.robot.advance(EXCHANGE)
                due += EXCHANGE
                rest = due - time.monotonic()
                if rest > 0.0:
                    time.sleep(rest)
                else:
                    # a robot that is late does not hurry
                    due = time.monotonic()
        except Exception as error:
            self.error = error

    def _exchange(self) -> None:
        with contextlib.suppress(BlockingIOError):
            self.robot.chip.send(os.read(self._master, 4096))
        if data := self.robot.chip.received():
            # bytes that nobody reads are lost, as on a wire
            with contextlib.suppress(BlockingIOError):
                os.write(self._master, data)
