"""A closed loop in the browser: a robot follows a target that is dragged with the mouse.

The loop runs in one thread, a period every `dt`; the page's messages are read meanwhile. A new target only
replaces the reference. Shapes are sent as fast as the page takes them: a slow page misses some of them, and
the loop does not wait.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import dataclasses
import gc
import json
import reprlib
import tempfile
from collections import deque
from collections.abc import Callable, Coroutine, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from knode_cosserat._arguments import check_arguments
from knode_cosserat.control import Controller, LoopLog, Plant, constant
from knode_cosserat.control.commands import Status
from knode_cosserat.control.loop import Loop, Period, estimated_state, join_rows
from knode_cosserat.errors import KnodeCosseratError
from knode_cosserat.estimation.outputs import BodyPositions
from knode_cosserat.rods.parameters import parameter_at
from knode_cosserat.rods.wrapped import nominal_model
from knode_cosserat.schemes.result import SimulationError
from knode_cosserat.trajectory import Trajectory
from knode_cosserat.viewer.live import PATIENCE, PageSession, require_websockets, sequence_of
from knode_cosserat.viewer.pages import Opening, checked_port, document, serve_page, write_page
from knode_cosserat.viewer.scene import (
    Point,
    checked_target,
    encoded_array,
    kept,
    last_row,
    scene,
    sliders,
    track,
)

#: most periods of a record; earlier ones are forgotten
MOST_PERIODS = 12_000
#: statuses in the order of their numbers
STATUSES = tuple(status.value for status in Status)
#: names of the drawn shapes: the robot, its estimate beside it, and the estimate of an unknown shape
TRUE, ESTIMATED, ONLY_ESTIMATED = "robot", "estimate", "estimate (the true shape is unknown)"


class LoopFacts(NamedTuple):
    """Facts of a loop that do not change: what the page draws and lists.

    `columns` are the first place and the size of each part of a row's numbers.
    """

    columns: dict[str, tuple[int, int]]
    controls: list[dict[str, Any]]
    #: names and units of the adapted parameters
    parameters: list[dict[str, str]]
    #: box of soft limits of the tip, [low, high] with None where it is open; None without one
    soft: list[list[float | None]] | None
    dt: float

    @classmethod
    def of(cls, controller: Controller, robot: Any, start: Float[np.ndarray, " c"]) -> LoopFacts:
        """Return the facts of a controller; `robot` is the one that is drawn, at the control `start`."""
        limits = getattr(controller, "limits", None)
        controls = sliders(robot)
        for k, slider in enumerate(controls):
            slider["start"] = float(start[k])
            if limits is not None:
                slider["low"], slider["high"] = (float(end[k]) for end in (limits.low, limits.high))
        observer: Any = getattr(controller, "observer", None)
        parameters: list[dict[str, str]] = []
        for name in {} if observer is None else observer.estimate.parameters:
            # such as "loads.0.mass" or "gravity[0]"
            stated = parameter_at(nominal_model(observer.robot), name.partition("[")[0])
            parameters.append({"name": name, "unit": "" if stated is None else stated.unit})
        knots = getattr(controller, "knots", None)
        sizes = {
            "status": 1, "feedback": 1, "preparation": 1, "violation": 1, "missed": 1, "target": 3,
            "control": len(controls), "parameters": len(parameters), "deviations": len(parameters),
            "path": 0 if knots is None else 3 * knots.steps,
        }  # fmt: skip
        ends = np.cumsum([0, *sizes.values()])
        columns = {name: (int(ends[k]), size) for k, (name, size) in enumerate(sizes.items())}
        return cls(columns, controls, parameters, _soft_box(controller), controller.dt)

    @property
    def width(self) -> int:
        """Number of numbers in a row."""
        return sum(size for _, size in self.columns.values())

    def row(self, period: Period, missed: int, deviations: dict[str, float]) -> Float[np.ndarray, " w"]:
        """Return the numbers of a period; NaN where the controller gave none."""
        command = period.command
        path = np.full(self.columns["path"][1], np.nan)
        if np.size(command.path) == len(path):
            path = np.ravel(command.path)
        return np.concatenate([
            [STATUSES.index(command.status.value), period.feedback, period.preparation],
            [command.violation, missed], period.reference[:3], command.control,
            [period.parameters[entry["name"]] for entry in self.parameters],
            [deviations[entry["name"]] for entry in self.parameters], path,
        ])  # fmt: skip

    def for_page(self) -> dict[str, Any]:
        """Return the facts as plain values for JSON."""
        return self._asdict() | {"statuses": STATUSES}


def _soft_box(controller: Any) -> list[list[float | None]] | None:
    """Return the box of a controller's soft limits of the tip, or None."""
    for soft in getattr(controller, "soft", ()):
        output = soft.output
        if isinstance(output, BodyPositions) and output.fractions == (1.0,):
            ends = [np.broadcast_to(np.asarray(end, dtype=float), (3,)) for end in (soft.low, soft.high)]
            return [[float(x) if np.isfinite(x) else None for x in end] for end in ends]
    return None


@dataclasses.dataclass
class _Moment:
    """Shapes of one period by name, as `shapes` returns them, with the numbers of the loop."""

    time: float
    shapes: dict[str, Trajectory]
    numbers: Float[np.ndarray, " w"]
    reason: str


def shapes(plant: Plant, controller: Controller) -> dict[str, Trajectory]:
    """Return the shapes of a period by name, each a trajectory of one row: the robot and its estimate.

    Only a simulated plant knows its shape, and only a controller with an observer has an estimate.

    Raises:
        ValueError: there is neither of them.
    """
    true: Trajectory | None = getattr(plant, "state", None)
    estimate = estimated_state(controller)
    if true is not None:
        return {TRUE: true} if estimate is None else {TRUE: true, ESTIMATED: estimate}
    if estimate is not None:
        return {ONLY_ESTIMATED: estimate}
    raise ValueError(
        "there is no shape to draw: the plant does not know its own, and the controller has no observer. "
        "Use a controller such as predictive"
    )


def _for_loop(tracks: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Mark the second track as an overlay of the first."""
    return [shape | {"overlay": k > 0} for k, shape in enumerate(tracks)]


# the loop and its page


class FollowedTarget:
    """Closed loop whose reference is one position, with the moments of its last periods.

    One page at a time moves it; all its computations take place in one thread.
    """

    def __init__(self, controller: Controller, plant: Plant, title: str | None = None, target: Any = None):
        """Compile everything; the target is at the tip unless it is given (x, y, z in m).

        Raises:
            ValueError: a controller that does not track the tip, or an impossible target.
        """
        tracked = getattr(controller, "target", None)
        if tracked is not None and (tracked.size != 3 or getattr(tracked, "fractions", (1.0,)) != (1.0,)):
            raise ValueError(
                f"the controller tracks {', '.join(tracked.labels)}; the page moves a position of the tip: "
                "use TipPosition()"
            )
        self.first, self.plant = controller.copied(), plant
        self.thread = concurrent.futures.ThreadPoolExecutor(1)
        control = plant.start()
        first = next(iter(shapes(plant, controller).values()))
        self.robot = first.system
        self.title = title or type(self.robot).__name__
        self.facts = LoopFacts.of(controller, self.robot, control)
        start = checked_target(target, [self.robot])
        self.start = np.asarray(first.tip_position[-1] if start is None else start)
        self.position = self.start
        self.active: LoopSession | None = None
        self.restart()
        self.shapes = shapes(plant, self.loop.controller)
        self.tracks = _for_loop([track(state, name) for name, state in self.shapes.items()])
        self.names = [list(shape["arrays"]) for shape in self.tracks]

    def restart(self) -> None:
        """Start the plant, the controller and the record again; the target stays."""
        self.loop = Loop(self.first.copied(), self.plant, constant(self.position.tolist()), MOST_PERIODS)
        self.moments: deque[_Moment] = deque(maxlen=MOST_PERIODS)

    def scene(self) -> dict[str, Any]:
        """Return the page's scene of the run since the last start.

        Raises:
            ValueError: no period has passed.
        """
        moments = list(self.moments)
        if not moments:
            raise ValueError("no period has passed; there is nothing to export")
        motions = {
            name: join_rows([moment.shapes[name] for moment in moments], [moment.time for moment in moments])
            for name in moments[0].shapes
        }
        numbers = np.array([moment.numbers for moment in moments])
        place, size = self.facts.columns["target"]
        first, target = next(iter(motions.values())), numbers[0, place : place + size]
        # the tip's coordinates in the place of free ones
        target = np.where(np.isfinite(target), target, np.asarray(first.tip_position)[0])
        shown = scene(motions, self.title, target)
        rows = kept(np.shape(first.y), first.system.z_layout.size)[1]
        shown["tracks"] = _for_loop(shown["tracks"])
        shown["loop"] = self.facts.for_page() | {
            "rows": encoded_array(numbers[rows], "f4"),
            "reasons": [moments[k].reason for k in rows],
        }
        return shown

    def checked(self, target: Any) -> Float[np.ndarray, "3"]:
        """Return a target from a page's message; None stands for a free coordinate (NaN).

        Raises:
            ValueError: not three numbers, none of them, or a position far away.
        """
        numbers = isinstance(target, list) and len(target) == 3
        if not numbers or any(isinstance(x, bool) or not isinstance(x, int | float | None) for x in target):
            raise ValueError(f"target must be three numbers in m, or null (got {reprlib.repr(target)})")
        if all(x is None for x in target):
            raise ValueError("target must have at least one number")
        point = np.array(checked_target([0.0 if x is None else x for x in target], [self.robot]))
        point[[x is None for x in target]] = np.nan
        return point

    def period(self) -> _Moment:
        """Move by one period towards the newest target, and return the states at its measurement.

        Raises:
            SimulationError: the simulated robot was not solved.
        """
        loop, true = self.loop, getattr(self.plant, "state", None)
        drawn = {} if true is None else {TRUE: true}
        loop.reference = constant(self.position.tolist())
        deviations: dict[str, float] = {}

        def note() -> None:
            observer = getattr(loop.controller, "observer", None)
            for name, shape in shapes(self.plant, loop.controller).items():
                drawn.setdefault(name, shape)  # the robot itself has moved on
            deviations.update({} if observer is None else observer.estimate.deviations)

        row: Period = loop.period(note)
        numbers = self.facts.row(row, loop.missed, deviations)
        moment = _Moment(row.time, drawn, numbers, row.command.reason)
        self.moments.append(moment)
        return moment


class LoopSession(PageSession):
    """Session of one page that moves a target."""

    def __init__(self, followed: FollowedTarget, connection: Any):
        super().__init__(connection, followed.facts.dt)
        self.followed = followed
        self.begin_anew, self.reason = True, ""
        self.newest, self.fresh = b"", asyncio.Event()
        self.commands |= {
            "export": lambda: self._offer(self._exported),
            "log": lambda: self._offer(self._log),
        }
        self._offers: set[asyncio.Task[None]] = set()

    def _motions(self) -> list[Coroutine[Any, Any, None]]:
        return [self._move(), self._show()]

    async def run(self) -> None:
        """Run until the page is closed, or another page takes over."""
        before, self.followed.active = self.followed.active, self
        if before is not None:
            await before.end("Another page moves the target now. Reload this page to take over.")
        await super().run()

    async def end(self, reason: str) -> None:
        """Tell the page why its session ends, and close its connection."""
        with contextlib.suppress(Exception):  # the page may be gone
            await self.connection.send(json.dumps({"ended": reason}))
            await self.connection.close()

    def take(self, message: Mapping[str, Any]) -> None:
        """Take over the target of a message: only the reference changes."""
        point, number = self.followed.checked(message["target"]), sequence_of(message)
        self.followed.position, self.sequence = point, number

    async def _move(self) -> None:
        """Run a period every dt, unless the page has paused or the robot was not solved."""
        clock, followed = asyncio.get_running_loop(), self.followed
        due, stuck = clock.time(), False
        while True:
            with contextlib.suppress(TimeoutError):
                waiting = None if self.paused or stuck else max(0.0, due - clock.time())
                if not self.begin_anew:
                    await asyncio.wait_for(self.wanted.wait(), waiting)
            self.wanted.clear()
            if self.begin_anew:
                self.begin_anew, stuck = False, False
                await self._in_thread(followed.restart)
                self.newest = self.frame(_Moment(0.0, followed.shapes, self._at_rest(), ""))
                self.fresh.set()
                due = clock.time()
            if self.paused or stuck or clock.time() < due:
                continue
            due, sequence = self._next_end(due, clock.time()), self.sequence
            try:
                moment = await self._in_thread(followed.period)
            except KnodeCosseratError as error:
                stuck = True
                reason = error.result.message if isinstance(error, SimulationError) else str(error)
                text = f"The robot was not solved: {' '.join(reason.split())}. Start again."
                await self.connection.send(json.dumps({"unsolved": text, "sequence": sequence}))
                continue
            followed.loop.missed += clock.time() > due
            self.newest = self.frame(moment, sequence)
            self.fresh.set()
            if moment.reason != self.reason:
                self.reason = moment.reason
                await self.connection.send(json.dumps({"reason": moment.reason}))

    async def _in_thread(self, work: Callable[[], Any]) -> Any:
        """Compute in the loop's thread; the page is told if it takes long."""
        task = asyncio.get_running_loop().run_in_executor(self.followed.thread, work)
        if not (await asyncio.wait({task}, timeout=PATIENCE))[0]:
            await self.connection.send(json.dumps({"solving": self.sequence}))
        return await task

    async def _show(self) -> None:
        """Send the newest shape whenever there is one, and the page has taken the last one."""
        while True:
            await self.fresh.wait()
            self.fresh.clear()
            await self.connection.send(self.newest)

    def _at_rest(self) -> Float[np.ndarray, " w"]:
        numbers = np.full(self.followed.facts.width, np.nan)
        starts = [slider["start"] for slider in self.followed.facts.controls]
        for name, values in (("target", self.followed.position), ("control", starts), ("status", 0)):
            place, size = self.followed.facts.columns[name]
            numbers[place : place + size] = values
        return numbers

    def frame(self, moment: _Moment, sequence: int | None = None) -> bytes:
        """Return a period for the page: head as in `Session.frame`, the states' rows, the loop's numbers."""
        number = self.sequence if sequence is None else sequence
        states = list(moment.shapes.values())
        first = states[0]
        error = np.nan if first.position_error is None else first.position_error[0]
        place = self.followed.facts.columns["feedback"][0]
        spent = 1e3 * np.sum(moment.numbers[place : place + 2])
        head = [number, moment.time, first.result[0], error, self.pace, spent]
        pairs = zip(states, self.followed.names, strict=True)
        rows = [last_row(state.system, state, names) for state, names in pairs]
        parts = [np.array(head), *rows, moment.numbers]
        return np.concatenate([np.asarray(part, dtype=np.float32) for part in parts]).tobytes()

    # files

    def _offer(self, write: Callable[[], dict[str, str]]) -> None:
        task = asyncio.create_task(self._send_file(write))
        self._offers.add(task)
        task.add_done_callback(self._offers.discard)

    async def _send_file(self, write: Callable[[], dict[str, str]]) -> None:
        """Write a file beside the loop, and send it to the page."""
        try:
            message: dict[str, Any] = {"file": await asyncio.to_thread(write)}
        except ValueError as error:  # nothing to write
            message = {"error": str(error)}
        with contextlib.suppress(Exception):  # the page may be gone
            await self.connection.send(json.dumps(message))

    def _exported(self) -> dict[str, str]:
        return {"name": "run.html", "type": "text/html", "text": document(self.followed.scene())}

    def _log(self) -> dict[str, str]:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "log.csv"
            self.followed.loop.log().to_csv(path)
            return {"name": "log.csv", "type": "text/csv", "text": path.read_text(encoding="utf-8")}


def control_live(
    controller: Controller,
    plant: Plant,
    *,
    title: str | None = None,
    target: Point | None = None,
    export: str | Path | None = None,
    port: int = 0,
    open_browser: Opening = True,
) -> LoopLog | None:
    """Control a robot in the browser until interrupted (Ctrl-C), and return the log of its last run.

    The tip follows a target that is dragged with the mouse. The page shows the true and the estimated shape,
    the predicted path of the tip, the limits, and the times of the computation. The last 12 000 periods since
    the last start are kept.

    Args:
        controller: a controller of the tip's position; it is copied.
        plant: the robot. Of one that does not know its shape, only the estimate is drawn.
        title: heading of the page; by default the robot's class.
        target: first target (x, y, z) in m; by default the tip at the start.
        export: file to which the last run is written at the end, as by the page's *Export run*.
        port: port of the server, which only this machine reaches; 0 for any free one.
        open_browser: True opens the page and prints its address; False only prints it. A function is called
            with the address instead.

    Returns:
        The log of the run since the last start; None without a period.

    Raises:
        ImportError: `websockets` is not installed.
        ValueError: a controller that does not track the tip, or an impossible target or port.
    """
    check_arguments(control_live, locals())
    require_websockets()
    checked_port(port)
    followed = FollowedTarget(controller, plant, title, target)
    page = loop_page(followed)
    gc.collect()
    gc.freeze()  # a collection of everything that is loaded would take longer than a period
    try:
        asyncio.run(
            serve_page(page, lambda connection: LoopSession(followed, connection), port, open_browser)
        )
    finally:
        gc.unfreeze()
        followed.thread.shutdown()
    if not followed.moments:
        return None
    if export is not None:
        write_page(document(followed.scene()), Path(export))
    return followed.loop.log()


def loop_page(followed: FollowedTarget) -> bytes:
    """Return the page of a closed loop."""
    shown: dict[str, Any] = {
        "title": followed.title,
        "tracks": followed.tracks,
        "target": [float(x) for x in followed.start],
        "loop": followed.facts.for_page(),
        "live": {"dt": followed.facts.dt},
    }
    return document(shown, "'self' ws:").encode("utf-8")
