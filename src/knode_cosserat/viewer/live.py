"""A robot or model that follows sliders in the browser in real time: its page and its server."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import http
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from knode_cosserat.rods.system import System
from knode_cosserat.solvers.result import SimulationError
from knode_cosserat.solvers.stepper import Stepper
from knode_cosserat.viewer.connection import PageSession
from knode_cosserat.viewer.document import document
from knode_cosserat.viewer.drawing import sliders
from knode_cosserat.viewer.scene import Point, checked_target, track
from knode_cosserat.viewer.serve import HOST, Opening, announce, checked_port, own_names
from knode_cosserat.viewer.session import Session

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection

#: default time step (s)
USUAL = 0.05
#: most pages that are open at once: each solves its own steps; others are answered 503
MOST_PAGES = 4
#: connections that are accepted at once: the open pages are served in between
BACKLOG = 8


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
    require_websockets()
    checked_port(port)
    stepper = Stepper(robot, usual_step(robot) if dt is None else dt, space=space)
    page = live_page(stepper, title, target)
    gc.collect()
    gc.freeze()  # a collection of everything that is loaded takes 0.1 to 0.3 s
    try:
        asyncio.run(serve_page(page, lambda connection: Session(stepper, connection), port, open_browser))
    finally:
        gc.unfreeze()


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


def live_page(stepper: Stepper, title: str | None = None, target: Point | None = None) -> bytes:
    """Return the page of a robot in motion; this also compiles its program."""
    robot = stepper.robot
    if not robot.control_size:
        raise ValueError(f"a {type(robot).__name__} has no controls, so that there is nothing to be moved")
    given = sliders(robot)
    # compiled now, not while somebody waits; a start without a solution is for the page to say
    with contextlib.suppress(SimulationError):
        stepper.preview([slider["start"] for slider in given])
    shown = {
        "title": title or type(robot).__name__,
        "tracks": [track(stepper.state, "robot")],
        "target": checked_target(target, [robot]),
        "live": {"sliders": given, "dt": stepper.dt},
    }
    return document(shown, "'self' ws:").encode("utf-8")


async def serve_page(
    page: bytes, session: Callable[[Any], PageSession], port: int, open_browser: Opening
) -> None:
    """Serve a page and the connections of its open copies, each with its session, until cancelled."""
    from websockets.asyncio.server import serve
    from websockets.datastructures import Headers
    from websockets.exceptions import ConnectionClosed
    from websockets.http11 import Request, Response

    own: list[str] = []
    opened: set[Any] = set()

    def full() -> Response:
        text = f"{MOST_PAGES} pages of this robot are open; close one, then load this page again\n"
        headers = Headers({"Content-Type": "text/plain", "Connection": "close"})
        return Response(503, "Service Unavailable", headers, text.encode())

    def answer(connection: Any, request: Request) -> Response | None:
        if request.headers.get_all("Host") not in (
            [name] for name in own
        ):  # a name that somebody made to point here
            return Response(403, "Forbidden", Headers(), b"")
        path = request.path.split("?")[0]
        if path == "/live":
            # another page of the browser must not reach it
            if request.headers.get("Origin") not in [f"http://{host}" for host in own]:
                return Response(403, "Forbidden", Headers(), b"another origin\n")
            return full() if len(opened) >= MOST_PAGES else None
        if path not in ("/", "/index.html"):
            return connection.respond(http.HTTPStatus.NOT_FOUND, "not found\n")
        if len(opened) >= MOST_PAGES:
            return full()
        headers = Headers({
            "Content-Type": "text/html; charset=utf-8", "Content-Length": str(len(page)),
            "Cache-Control": "no-store", "Connection": "close",
        })  # fmt: skip
        return Response(200, "OK", headers, page)

    async def connected(connection: ServerConnection) -> None:
        if len(opened) >= MOST_PAGES:  # several came together
            await connection.close(1013, "too many pages")
            return
        opened.add(connection)
        try:
            with contextlib.suppress(ConnectionClosed):
                await session(connection).run()
        finally:
            opened.discard(connection)

    async with serve(
        connected, HOST, port, process_request=answer, compression=None, backlog=BACKLOG
    ) as server:
        number = next(iter(server.sockets)).getsockname()[1]
        own += own_names(number)
        announce(f"http://{HOST}:{number}/", open_browser)
        with contextlib.suppress(asyncio.CancelledError):
            await asyncio.get_running_loop().create_future()
