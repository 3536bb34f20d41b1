"""Session of a live page: its robot, its clock, and solves that never hold up the controls.

The drawn shape is the solution at the end of the current time step under the current control. A moved slider
solves this step again at once, without waiting for the next one. When the step's time is over, the step is
taken and the next one becomes current. Solves run in threads of their own:

- The newest control wins: a solve that takes longer than `PATIENCE` is dropped when a newer control arrives.
- The page can cancel a solve. Recovery then ends after its current attempt, and its result is not used.
- A dropped solve works on a copy of the stepper, so that it cannot change the state.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import copy
import json
import threading
from collections.abc import Callable, Coroutine, Mapping
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np

from knode_cosserat.solvers.result import SimulationError
from knode_cosserat.solvers.stepper import Stepper
from knode_cosserat.trajectory import Trajectory
from knode_cosserat.viewer.connection import PATIENCE, PageSession, sequence_of
from knode_cosserat.viewer.drawing import sliders
from knode_cosserat.viewer.scene import last_row, track

#: interval at which a solve in progress is checked for cancellation (s)
CHECK = 0.02
#: threads for solves: the current one, and those that were dropped and end after their current attempt
WORKERS = 4
#: largest estimated error of a drawn shape, as a part of the length; above `COARSE_SHARE` it is drawn faded
MOST_ERROR = 0.2


class Solved(NamedTuple):
    """End of a solve: a message for the page, the stepper after it, and True if there is no solution."""

    message: bytes | str
    stepper: Stepper
    stuck: bool


class Stop:
    """Stop function of a solve. Its first call, at the start of a recovery, waits for other recoveries.

    So the program of a recovery is compiled once, not at the same time in several threads.
    """

    def __init__(self, recovering: threading.Lock):
        self._recovering, self._held, self._stopped = recovering, False, threading.Event()

    def __call__(self) -> bool:
        """Return True if the solve is no longer wanted."""
        while not (self._held or self._stopped.is_set()):
            self._held = self._recovering.acquire(timeout=CHECK)
        return self._stopped.is_set()

    def set(self) -> None:
        """End the recovery after its current attempt."""
        self._stopped.set()

    def release(self) -> None:
        """Let the next recovery begin."""
        if self._held:
            self._held = False
            self._recovering.release()


class Session(PageSession):
    """Session of one page with sliders: its robot, its control and commands, and the clock."""

    def __init__(self, stepper: Stepper, connection: Any):
        super().__init__(connection, stepper.dt)
        self.first, self.stepper = stepper, copy.copy(stepper)
        self.names = list(track(stepper.state, "robot")["arrays"])
        self.control = np.array([slider["start"] for slider in sliders(stepper.robot)])
        self.cancelled, self.recovering = False, threading.Lock()
        self.commands["cancel"] = self._cancel
        self.spent = 0.0

    def _motions(self) -> list[Coroutine[Any, Any, None]]:
        return [self._move()]

    def take(self, message: Mapping[str, Any]) -> None:
        """Take over the control of a message."""
        control = np.array(message["control"], dtype=float)
        if control.shape != self.control.shape or not np.all(np.isfinite(control)):
            raise ValueError(f"the control is not {self.control.size} finite numbers")
        self.control, self.sequence = control, sequence_of(message)

    def _cancel(self) -> None:
        self.cancelled = True

    async def _move(self) -> None:
        """A step ends every dt, and the one in progress is solved again when the control changes."""
        loop = asyncio.get_running_loop()
        worker = concurrent.futures.ThreadPoolExecutor(WORKERS)
        end, stuck, tried = loop.time() + self.dt, False, self.sequence
        try:
            while True:
                with contextlib.suppress(TimeoutError):
                    waiting = None if self.paused or stuck else max(0.0, end - loop.time())
                    await asyncio.wait_for(self.wanted.wait(), waiting)
                self.wanted.clear()
                self.cancelled = False  # nothing is being solved
                if stuck and self.sequence == tried and not self.begin_anew:
                    continue  # the same control has no solution still
                if self.begin_anew:
                    self.begin_anew, stuck = False, False
                    self.stepper = copy.copy(self.first)
                    end = loop.time() + self.dt
                over, tried = not self.paused and not stuck and loop.time() >= end, self.sequence
                solved = await self._solved(worker, over)
                if solved is None:  # dropped: a newer control or a reset is already waiting
                    self.wanted.set()
                    continue
                self.stepper, stuck = solved.stepper, solved.stuck
                await self.connection.send(solved.message)
                if over:
                    end = self._next_end(end, loop.time())
                elif stuck or self.paused:
                    end = loop.time() + self.dt
        finally:
            worker.shutdown(wait=False, cancel_futures=True)

    async def _solved(self, worker: concurrent.futures.Executor, over: bool) -> Solved | None:
        """Solve in a thread under the current control; None if a newer control or a reset replaced it."""
        loop, sequence = asyncio.get_running_loop(), self.sequence
        stop, began, told = Stop(self.recovering), loop.time(), False
        task = loop.run_in_executor(worker, self._attempt, self.control, sequence, over, stop)
        try:
            while not (await asyncio.wait({task}, timeout=CHECK))[0]:
                late = loop.time() - began > PATIENCE
                if self.cancelled:
                    text = "Cancelled: the last solved shape is shown. Move a slider to go on."
                    message = json.dumps({"unsolved": text, "sequence": sequence})
                    return Solved(message, self.stepper, True)
                if self.begin_anew or (late and self.sequence != sequence):
                    return None
                if late and not told:
                    told = True
                    await self.connection.send(json.dumps({"solving": sequence}))
            return task.result()
        finally:
            stop.set()
            task.cancel()

    def _attempt(self, control: np.ndarray, sequence: int, over: bool, stop: Stop) -> Solved:
        try:
            return self.attempt(control, sequence, over, stop)
        finally:
            stop.release()

    def attempt(
        self, control: np.ndarray, sequence: int, over: bool, stop: Callable[[], bool] | None = None
    ) -> Solved:
        """Take the step if it is over, and solve the current one, on a copy of the stepper."""
        began = perf_counter()
        stepper = self.stepper
        try:
            if over:
                moved = copy.copy(stepper)
                _require_accurate(moved.step(control, stop))
                stepper = moved
            ahead = stepper.preview(control, stop)
            _require_accurate(ahead)
        except (
            SimulationError,
            ValueError,
        ) as error:  # ValueError: inaccurate, or a control outside its range
            reason = error.result.message if isinstance(error, SimulationError) else str(error)
            text = f"Not solved: {reason}. The last solved shape is shown; move a slider back."
            return Solved(json.dumps({"unsolved": text, "sequence": sequence}), stepper, True)
        self.spent = 1000.0 * (perf_counter() - began)
        return Solved(self.frame(ahead, sequence), stepper, False)

    def frame(self, ahead: Trajectory, sequence: int) -> bytes:
        """Return a shape for the page: head, then the row.

        The head is: sequence, time, result, estimated position error (m), pace, computing time (ms).
        """
        head = [sequence, ahead.time[0], ahead.result[0], ahead.position_error[0], self.pace, self.spent]
        row = last_row(self.stepper.robot, ahead, self.names)
        return np.concatenate([np.array(head, dtype=np.float32), row]).tobytes()


def _require_accurate(row: Trajectory) -> None:
    """Raise `ValueError` for a row whose estimated discretisation error makes its shape meaningless."""
    error = float(row.position_error[0])
    share = error / float(row.system.length)
    # NaN: there is no estimate
    if not share <= MOST_ERROR:
        off = "by any amount" if np.isnan(share) else f"by about {error:.2g} m ({share:.0%} of the length)"
        raise ValueError(f"the grid of {row.system.nodes} nodes is too coarse, positions would be off {off}")
