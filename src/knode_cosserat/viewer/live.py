"""A robot or model that follows sliders in the browser in real time.

The drawn shape is the solution at the end of the current time step under the current control. A moved slider
solves this step again at once, without waiting for the next one. When the step's time is over, the step is
taken (`Stepper.step`) and the next one becomes current. Failures are reported, and the last shape stays.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import http
import json
from collections.abc import Callable
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from knode_cosserat.rods.system import System
from knode_cosserat.solvers.result import SimulationError
from knode_cosserat.solvers.stepper import Stepper
from knode_cosserat.trajectory import Trajectory
from knode_cosserat.viewer.document import document
from knode_cosserat.viewer.drawing import sliders
from knode_cosserat.viewer.scene import row_of, track
from knode_cosserat.viewer.serve import HOST, announce, checked_port

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection

#: default time step (s)
USUAL = 0.05
#: time over which the pace is averaged (s)
PACE = 1.0


def view_live(
    robot: System,
    *,
    dt: float | None = None,
    space: str = "lobatto2",
    title: str | None = None,
    port: int = 0,
    open_browser: bool = True,
    ready: Callable[[str], None] | None = None,
) -> None:
    """Show a robot or model in the browser that follows sliders in real time, until interrupted (Ctrl-C).

    Args:
        robot: a robot, or a model (`KNODE`).
        dt: time step (s), and how often the page gets a new shape; by default what a model learned at,
            or 0.05 s.
        space: scheme along the rod, "lobatto2", "lobatto4" or "euler".
        title: what stands above it; by default the robot's class.
        port: of the server, which only this machine reaches; 0 for any that is free.
        open_browser: whether to open the page; its address is printed in any case.
        ready: called with the address, instead of printing it.

    Raises:
        ImportError: `websockets` is not installed.
        ValueError: no robot of its own, one that has no control or no positions, or an impossible port.
        SimulationError: the robot cannot even begin to move.
    """
    require_websockets()
    checked_port(port)
    dt = usual_step(robot) if dt is None else dt
    page = live_page(robot, dt, space, title)
    asyncio.run(_serve(robot, dt, space, page, checked_port(port), open_browser, ready))


def usual_step(robot: System) -> float:
    """Return the time step (s) of a model's training trajectories, or else 0.05 s."""
    about = getattr(robot, "about", None)
    learned = None if about is None else about.facts.get("trajectories")
    try:
        return float(learned[0]["dt"]) if learned else USUAL
    except (KeyError, TypeError, ValueError):  # facts are the user's to change
        return USUAL


def require_websockets() -> None:
    """Raise `ImportError` in one line if the live mode cannot run."""
    try:
        import websockets.asyncio.server  # noqa: F401
    except ImportError:
        raise ImportError("the live mode needs websockets: pip install 'knode-cosserat[viz]'") from None


def live_page(robot: System, dt: float, space: str, title: str | None = None) -> bytes:
    """Return the page of a robot in motion; this also compiles its program."""
    stepper = Stepper(robot, dt, space=space)
    if not robot.control_size:
        raise ValueError(f"a {type(robot).__name__} has no controls, so that there is nothing to be moved")
    given = sliders(robot)
    # compiled now, not while somebody waits; a start without a solution is for the page to say
    with contextlib.suppress(SimulationError):
        stepper.preview([slider["start"] for slider in given])
    shown = track(stepper.state, "robot")
    name = title or type(robot).__name__
    live = {"sliders": given, "dt": dt}
    return document({"title": name, "tracks": [shown], "live": live}, "'self' ws:").encode("utf-8")


async def _serve(
    robot: System, dt: float, space: str, page: bytes, port: int, open_browser: bool,
    ready: Callable[[str], None] | None,
) -> None:  # fmt: skip
    from websockets.asyncio.server import serve
    from websockets.datastructures import Headers
    from websockets.exceptions import ConnectionClosed
    from websockets.http11 import Request, Response

    own: list[str] = []

    def answer(connection: Any, request: Request) -> Response | None:
        if request.headers.get("Host") not in own:  # a name that somebody made to point here
            return Response(403, "Forbidden", Headers(), b"")
        path = request.path.split("?")[0]
        if path == "/live":
            return None
        if path not in ("/", "/index.html"):
            return connection.respond(http.HTTPStatus.NOT_FOUND, "not found\n")
        headers = Headers({
            "Content-Type": "text/html; charset=utf-8", "Content-Length": str(len(page)),
            "Cache-Control": "no-store", "Connection": "close",
        })  # fmt: skip
        return Response(200, "OK", headers, page)

    async def connected(connection: ServerConnection) -> None:
        # another page of the browser must not reach it
        if connection.request is None or connection.request.headers.get("Origin") not in [
            f"http://{host}" for host in own
        ]:
            await connection.close(1008, "another origin")
            return
        with contextlib.suppress(ConnectionClosed):
            await Session(robot, dt, space, connection).run()

    async with serve(connected, HOST, port, process_request=answer, compression=None) as server:
        number = next(iter(server.sockets)).getsockname()[1]
        own += [f"{HOST}:{number}", f"localhost:{number}"]
        announce(f"http://{HOST}:{number}/", open_browser, ready)
        with contextlib.suppress(asyncio.CancelledError):
            await asyncio.get_running_loop().create_future()


class Session:
    """Session of one page: its robot, its control and commands, and the clock."""

    def __init__(self, robot: System, dt: float, space: str, connection: Any):
        self.robot, self.dt, self.space, self.connection = robot, dt, space, connection
        self.names = list(track(Stepper(robot, dt, space=space).state, "robot")["arrays"])
        self.stepper = Stepper(robot, dt, space=space)
        self.control = np.array([slider["start"] for slider in sliders(robot)])
        self.sequence, self.paused, self.begin_anew = 0, False, False
        self.wanted = asyncio.Event()
        self.pace, self.spent = 1.0, 0.0

    async def run(self) -> None:
        """Run until the page is closed."""
        reading = asyncio.create_task(self._read())
        moving = asyncio.create_task(self._move())
        try:
            done, _ = await asyncio.wait({reading, moving}, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                task.result()
        finally:
            reading.cancel()
            moving.cancel()

    async def _read(self) -> None:
        async for text in self.connection:
            try:
                self.understand(json.loads(text))
            except (ValueError, TypeError, KeyError, AttributeError) as error:
                await self.connection.send(json.dumps({"error": " ".join(str(error).split())}))

    def understand(self, message: Any) -> None:
        """Process a message of the page: a control, or a command. `ValueError` for anything else."""
        command = message.get("command")
        if command is None:
            control = np.array(message["control"], dtype=float)
            if control.shape != self.control.shape or not np.all(np.isfinite(control)):
                raise ValueError(f"the control is not {self.control.size} finite numbers")
            self.control, self.sequence = control, int(message["sequence"])
        elif command in ("pause", "resume"):
            self.paused = command == "pause"
        elif command == "reset":
            self.begin_anew = True
        else:
            raise ValueError(f"the command is {command!r}; allowed is pause, resume or reset")
        self.wanted.set()

    async def _move(self) -> None:
        """A step ends every dt, and the one in progress is solved again when the control changes."""
        loop = asyncio.get_running_loop()
        # of its own, so that the page is heard while a step is looked for
        with concurrent.futures.ThreadPoolExecutor(1) as worker:
            end, stuck = loop.time() + self.dt, False
            while True:
                if self.begin_anew:
                    self.begin_anew, stuck = False, False
                    self.stepper = await loop.run_in_executor(worker, self._anew)
                    end = loop.time() + self.dt
                with contextlib.suppress(TimeoutError):
                    waiting = None if self.paused or stuck else max(0.0, end - loop.time())
                    await asyncio.wait_for(self.wanted.wait(), waiting)
                self.wanted.clear()
                sequence, control = self.sequence, self.control
                over = not self.paused and not stuck and loop.time() >= end
                message, stuck = await loop.run_in_executor(worker, self.solve, control, sequence, over)
                await self.connection.send(message)
                if over:
                    late = loop.time() - end
                    weight = min(1.0, self.dt / PACE)
                    self.pace += weight * (
                        min(1.0, self.dt / (self.dt + max(0.0, late - self.dt))) - self.pace
                    )
                    # a slow solution delays the clock; later steps do not catch up
                    end = end + self.dt if late < self.dt else loop.time() + self.dt
                elif stuck or self.paused:
                    end = loop.time() + self.dt

    def _anew(self) -> Stepper:
        return Stepper(self.robot, self.dt, space=self.space)

    def solve(self, control: np.ndarray, sequence: int, over: bool) -> tuple[bytes | str, bool]:
        """Take the step if it is over, solve the current one; return a message, and True if it failed."""
        began = perf_counter()
        try:
            if over:
                self.stepper.step(control)
            ahead = self.stepper.preview(control)
        except SimulationError as error:
            text = (
                f"Not solved: {error.result.message}. The last shape that was is shown; move a slider back."
            )
            return json.dumps({"unsolved": text, "sequence": sequence}), True
        self.spent = 1000.0 * (perf_counter() - began)
        return self.frame(ahead, sequence), False

    def frame(self, ahead: Trajectory, sequence: int) -> bytes:
        """Return a shape for the page: sequence, time, result, pace, computing time (ms), then the row."""
        head = [sequence, ahead.time[0], ahead.result[0], self.pace, self.spent]
        row = row_of(self.robot, ahead, self.names)
        return np.concatenate([np.array(head, dtype=np.float32), row]).tobytes()
