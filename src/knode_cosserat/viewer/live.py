"""A robot or model that follows sliders in the browser in real time, and sessions of live pages.

The drawn shape is the solution at the end of the current time step under the current control. A moved slider
solves this step again at once, without waiting for the next one. When the step's time is over, the step is
taken and the next one becomes current. Solves run in threads of their own, and never hold up the controls:

- The newest control wins: a solve that takes longer than `PATIENCE` is dropped when a newer control arrives.
- The page can cancel a solve. Recovery then ends after its current attempt, and its result is not used.
- A dropped solve works on a copy of the stepper, so that it cannot change the state.
"""

from __future__ import annotations

import abc
import asyncio
import concurrent.futures
import contextlib
import copy
import gc
import json
import reprlib
import sys
import threading
from collections.abc import Callable, Coroutine, Mapping
from time import perf_counter
from typing import Any

import numpy as np

from knode_cosserat._arguments import check_arguments
from knode_cosserat.rods.system import System
from knode_cosserat.schemes.result import SimulationError
from knode_cosserat.solvers.equilibrium import equilibrium
from knode_cosserat.solvers.stepper import Stepper
from knode_cosserat.trajectory import Trajectory
from knode_cosserat.viewer.pages import Opening, checked_port, document, serve_page
from knode_cosserat.viewer.scene import Point, checked_target, last_row, sliders, track

#: time over which the pace is averaged (s)
PACE = 1.0
#: time after which the page is told of a solve (s)
PATIENCE = 0.3
#: longest message of a page (characters)
LONGEST = 4096
#: shortest time between two values that are taken over (s); of those in between the newest counts
SHORTEST = 1.0 / 60.0
#: most messages of a page in a second: the page itself sends 60 or fewer; another program is cut off
MOST_PER_SECOND = 250
#: largest number of a message: a page gets it back as float32
MOST_MESSAGES = 2**24


class PageSession(abc.ABC):
    """Session of one page: reads its messages while a robot moves, at a period of `dt` (s)."""

    def __init__(self, connection: Any, dt: float):
        self.connection, self.dt = connection, dt
        self.sequence, self.paused, self.begin_anew = 0, False, False
        self.pace = 1.0
        self.wanted = asyncio.Event()
        #: newest message that is no command and was not processed yet
        self._newest: str | bytes | None = None
        self._unread = asyncio.Event()
        #: commands of the page by name
        self.commands: dict[str, Callable[[], None]] = {
            "pause": lambda: setattr(self, "paused", True),
            "resume": lambda: setattr(self, "paused", False),
            "reset": lambda: setattr(self, "begin_anew", True),
        }

    async def run(self) -> None:
        """Run until the page is closed."""
        coroutines = (self._read(), self._take_newest(), *self._motions())
        tasks = [asyncio.create_task(coroutine) for coroutine in coroutines]
        try:
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                task.result()
        finally:
            for task in tasks:
                task.cancel()

    @abc.abstractmethod
    def _motions(self) -> list[Coroutine[Any, Any, None]]:
        """Return the coroutines that move and show the robot; the session ends with the first of them."""

    @abc.abstractmethod
    def take(self, message: Mapping[str, Any]) -> None:
        """Take over a value from a message that is no command. `ValueError` or `KeyError` if it has none."""

    async def _read(self) -> None:
        """Read all messages at once: a page that sends many must not hold up the others."""
        clock, count, since = asyncio.get_running_loop(), 0, float("-inf")
        async for text in self.connection:
            count += 1
            if clock.time() - since > 1.0:
                count, since = 1, clock.time()
            if count > MOST_PER_SECOND:
                await self.connection.close(1008, f"more than {MOST_PER_SECOND} messages in a second")
                return
            # a message that may be a command is never dropped
            if isinstance(text, str) and '"command"' in text:
                await self._process(self._newest)  # in the order in which they came
                self._newest = None
                await self._process(text)
            else:
                self._newest = text
                self._unread.set()

    async def _take_newest(self) -> None:
        """Take over the newest value, not more often than every `SHORTEST`."""
        while True:
            await self._unread.wait()
            self._unread.clear()
            text, self._newest = self._newest, None
            await self._process(text)
            await asyncio.sleep(SHORTEST)

    async def _process(self, text: str | bytes | None) -> None:
        if text is None:
            return
        try:
            if len(text) > LONGEST:
                raise ValueError(f"the message has {len(text)} characters; allowed are {LONGEST}")
            try:
                message = json.loads(text)
            except RecursionError:
                raise ValueError("the message is nested too deeply") from None
            self.understand(message)
        except (ValueError, TypeError, OverflowError) as error:
            await self.connection.send(json.dumps({"error": " ".join(str(error).split())}))

    def understand(self, message: Any) -> None:
        """Process a message of the page: a value, or a command. `ValueError` for anything else."""
        if not isinstance(message, dict):
            raise ValueError(f"a message must be an object (got {reprlib.repr(message)})")
        command = message.get("command")
        if command is None:
            try:
                self.take(message)
            except KeyError as error:
                raise ValueError(f"the message has no {error}, and no command") from None
        elif isinstance(command, str) and command in self.commands:
            self.commands[command]()
        else:
            *names, last = self.commands
            allowed = f"{', '.join(names)} or {last}"
            raise ValueError(f"the command is {reprlib.repr(command)}; allowed is {allowed}")
        self.wanted.set()

    def _next_end(self, end: float, now: float) -> float:
        """Return the end of the next step, and average the pace; later steps do not catch up."""
        late = now - end
        weight = min(1.0, self.dt / PACE)
        self.pace += weight * (min(1.0, self.dt / (self.dt + max(0.0, late - self.dt))) - self.pace)
        return end + self.dt if late < self.dt else now + self.dt


def sequence_of(message: Mapping[str, Any]) -> int:
    """Return the number of a message, which answers repeat."""
    number = message["sequence"]
    if not isinstance(number, int) or not 0 <= number < MOST_MESSAGES:
        raise ValueError(
            f"sequence must be a whole number below {MOST_MESSAGES} (got {reprlib.repr(number)})"
        )
    return number


# the session of a page with sliders

#: interval at which a solve in progress is checked for cancellation (s)
CHECK = 0.02
#: threads for solves: the current one, and those that were dropped and end after their current attempt
WORKERS = 4
#: largest estimated error of a drawn shape, as a part of the length; above `COARSE_SHARE` it is drawn faded
MOST_ERROR = 0.2

#: end of a solve: a message for the page, the stepper after it, and True if there is no solution
Solved = tuple[bytes | str, Stepper, bool]


class _Stop:
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
        self.commands["cancel"] = lambda: setattr(self, "cancelled", True)
        self.spent = 0.0

    def _motions(self) -> list[Coroutine[Any, Any, None]]:
        return [self._move()]

    def take(self, message: Mapping[str, Any]) -> None:
        """Take over the control of a message."""
        control = np.array(message["control"], dtype=float)
        if control.shape != self.control.shape or not np.all(np.isfinite(control)):
            raise ValueError(f"the control is not {self.control.size} finite numbers")
        self.control, self.sequence = control, sequence_of(message)

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
                message, self.stepper, stuck = solved
                await self.connection.send(message)
                if over:
                    end = self._next_end(end, loop.time())
                elif stuck or self.paused:
                    end = loop.time() + self.dt
        finally:
            worker.shutdown(wait=False, cancel_futures=True)

    async def _solved(self, worker: concurrent.futures.Executor, over: bool) -> Solved | None:
        """Solve in a thread under the current control; None if a newer control or a reset replaced it."""
        loop, sequence = asyncio.get_running_loop(), self.sequence
        stop, began, told = _Stop(self.recovering), loop.time(), False
        task = loop.run_in_executor(worker, self.attempt, self.control, sequence, over, stop)
        try:
            while not (await asyncio.wait({task}, timeout=CHECK))[0]:
                late = loop.time() - began > PATIENCE
                if self.cancelled:
                    text = "Cancelled: the last solved shape is shown. Move a slider to go on."
                    message = json.dumps({"unsolved": text, "sequence": sequence})
                    return message, self.stepper, True
                if self.begin_anew or (late and self.sequence != sequence):
                    return None
                if late and not told:
                    told = True
                    await self.connection.send(json.dumps({"solving": sequence}))
            return task.result()
        finally:
            stop.set()
            task.cancel()

    def attempt(self, control: np.ndarray, sequence: int, over: bool, stop: _Stop | None = None) -> Solved:
        """Take the step if it is over, and solve the current one, on a copy of the stepper."""
        began = perf_counter()
        stepper = self.stepper
        try:
            if over:
                moved = copy.copy(stepper)
                _require_accurate(moved.step(control, stop))
                stepper = moved
            preview = stepper.preview(control, stop)
            _require_accurate(preview)
        # ValueError: inaccurate, or a control outside its range
        except (SimulationError, ValueError) as error:
            reason = error.result.message if isinstance(error, SimulationError) else str(error)
            text = f"Not solved: {reason}. The last solved shape is shown; move a slider back."
            return json.dumps({"unsolved": text, "sequence": sequence}), stepper, True
        finally:
            if stop is not None:
                stop.release()
        self.spent = 1000.0 * (perf_counter() - began)
        return self.frame(preview, sequence), stepper, False

    def frame(self, shape: Trajectory, sequence: int) -> bytes:
        """Return a shape for the page: head, then the row.

        The head is: sequence, time, result, estimated position error (m), pace, computing time (ms).
        """
        head = [sequence, shape.time[0], shape.result[0], shape.position_error[0], self.pace, self.spent]
        row = last_row(self.stepper.robot, shape, self.names)
        return np.concatenate([np.array(head, dtype=np.float32), row]).tobytes()


def _require_accurate(row: Trajectory) -> None:
    """Raise `ValueError` for a row whose estimated discretisation error makes its shape meaningless."""
    error = float(row.position_error[0])
    share = error / float(row.system.length)
    # NaN: there is no estimate
    if not share <= MOST_ERROR:
        off = "by any amount" if np.isnan(share) else f"by about {error:.2g} m ({share:.0%} of the length)"
        raise ValueError(f"the grid of {row.system.nodes} nodes is too coarse, positions would be off {off}")


# the page

#: default time step (s)
USUAL = 0.05
#: time after which a waiting thread gets its turn (s), so that a solve takes turns with the server; 5 ms is
#: Python's default
SWITCH = 5e-4


def view_live(
    robot: System,
    *,
    dt: float | None = None,
    space: str = "lobatto2",
    title: str | None = None,
    target: Point | None = None,
    port: int = 0,
    open_browser: Opening = True,
) -> None:
    """Show a robot or model in the browser that follows sliders in real time, until interrupted (Ctrl-C).

    Args:
        robot: a robot, or a model (`KNODE`).
        dt: time step (s), and how often the page gets a new shape; by default what a model learned at,
            or 0.05 s.
        space: scheme along the rod, "lobatto2", "lobatto4" or "euler".
        title: heading of the page; by default the robot's class.
        target: position (x, y, z) in m that is marked, with the distance of the tip to it.
        port: port of the server, which only this machine reaches; 0 for any free one.
        open_browser: True opens the page and prints its address; False only prints it. A function is called
            with the address instead.

    Raises:
        ImportError: `websockets` is not installed.
        ValueError: no robot of its own, one that has no control or no positions, or an impossible target or
            port.
        SimulationError: the robot's initial equilibrium was not found.
    """
    check_arguments(view_live, locals())
    require_websockets()
    checked_port(port)
    # in equilibrium under the sliders' initial controls: nothing moves by itself
    still = equilibrium(robot, [slider["start"] for slider in sliders(robot)], space=space)
    stepper = Stepper(still.system, usual_step(robot) if dt is None else dt, space=space, initial=still)
    page = live_page(stepper, title, target)
    interval = sys.getswitchinterval()
    gc.collect()
    gc.freeze()  # a collection of everything that is loaded takes 0.1 to 0.3 s
    sys.setswitchinterval(SWITCH)
    try:
        asyncio.run(serve_page(page, lambda connection: Session(stepper, connection), port, open_browser))
    finally:
        sys.setswitchinterval(interval)
        gc.unfreeze()


def usual_step(robot: System) -> float:
    """Return the time step (s) of the data that a model learned from, or else 0.05 s."""
    origins = () if robot.passport is None else robot.passport.origins
    return next((origin.dt for origin in origins if origin.learned and origin.dt), USUAL)


def require_websockets() -> None:
    """Raise `ImportError` in one line if the live mode cannot run."""
    try:
        import websockets.asyncio.server  # noqa: F401
    except ImportError:
        raise ImportError("the live mode needs websockets: pip install 'knode-cosserat[viz]'") from None


def live_page(stepper: Stepper, title: str | None = None, target: Point | None = None) -> bytes:
    """Return the page of a robot in motion; this also compiles its program."""
    robot = stepper.robot
    if not robot.control_layout.size:
        raise ValueError(f"a {type(robot).__name__} has no controls, so that there is nothing to be moved")
    controls = sliders(robot)
    # compiled now, not while somebody waits; a start without a solution is for the page to say
    with contextlib.suppress(SimulationError):
        stepper.preview([slider["start"] for slider in controls])
    shown = {
        "title": title or type(robot).__name__,
        "tracks": [track(stepper.state, "robot")],
        "target": checked_target(target, [robot]),
        "live": {"sliders": controls, "dt": stepper.dt},
    }
    return document(shown, "'self' ws:").encode("utf-8")
