"""A robot or model that follows sliders in the browser in real time: its page and its server."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import sys
from collections.abc import Iterator
from typing import Any

from knode_cosserat.rods.system import System
from knode_cosserat.solvers.equilibrium import equilibrium
from knode_cosserat.solvers.result import SimulationError
from knode_cosserat.solvers.stepper import Stepper
from knode_cosserat.viewer.document import document
from knode_cosserat.viewer.drawing import sliders
from knode_cosserat.viewer.page_server import serve_page
from knode_cosserat.viewer.scene import Point, checked_target, track
from knode_cosserat.viewer.serve import Opening, checked_port
from knode_cosserat.viewer.session import Session

#: default time step (s)
USUAL = 0.05
#: time after which a waiting thread gets its turn (s); 5 ms is Python's default
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
    require_websockets()
    checked_port(port)
    given: Any = robot
    if not isinstance(given, System):
        raise ValueError(f"robot is a {type(given).__name__}; allowed is one robot")
    stepper = resting_stepper(robot, usual_step(robot) if dt is None else dt, space)
    page = live_page(stepper, title, target)
    with prompt_threads():
        asyncio.run(serve_page(page, lambda connection: Session(stepper, connection), port, open_browser))


def resting_stepper(robot: System, dt: float, space: str = "lobatto2") -> Stepper:
    """Return the robot in equilibrium under the sliders' initial controls: nothing moves by itself."""
    start = [slider["start"] for slider in sliders(robot)]
    return Stepper(robot, dt, space=space, initial=equilibrium(robot, start, space=space))


@contextlib.contextmanager
def prompt_threads() -> Iterator[None]:
    """Let threads wait for each other for less time: a solve takes turns with the server ten times or so."""
    before = sys.getswitchinterval()
    gc.collect()
    gc.freeze()  # a collection of everything that is loaded takes 0.1 to 0.3 s
    sys.setswitchinterval(SWITCH)
    try:
        yield
    finally:
        sys.setswitchinterval(before)
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
