"""Session of a page with a closed loop: a target that a person moves, and the loop that follows it.

The loop runs in one thread, a period every `dt`; the page's messages are read meanwhile. A new target only
replaces the reference. Shapes are sent as fast as the page takes them: a slow page misses some of them, and
the loop does not wait.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import json
import reprlib
from collections.abc import Callable, Coroutine, Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from knode_cosserat.control import Controller, Plant, Reference, constant
from knode_cosserat.control.loop import Loop, Period
from knode_cosserat.errors import KnodeCosseratError
from knode_cosserat.solvers.result import SimulationError
from knode_cosserat.viewer.connection import PATIENCE, PageSession, sequence_of
from knode_cosserat.viewer.record import (
    MOST_PERIODS,
    TRUE,
    LoopFacts,
    LoopRecord,
    Moment,
    for_loop,
    shapes,
)
from knode_cosserat.viewer.scene import checked_target, last_row, track


class FollowedTarget:
    """Closed loop whose reference is one position, with the record of its last periods.

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
        given = checked_target(target, [self.robot])
        self.start = np.asarray(first.tip_position[-1] if given is None else given)
        self.position = self.start
        self.active: LoopSession | None = None
        self.restart()
        self.shapes = shapes(plant, self.loop.controller)
        self.tracks = for_loop([track(state, name) for name, state in self.shapes.items()])
        self.names = [list(each["arrays"]) for each in self.tracks]

    def restart(self) -> None:
        """Start the plant, the controller and the record again; the target stays."""
        self.loop = Loop(self.first.copied(), self.plant, self._reference(), MOST_PERIODS)
        self.record = LoopRecord(self.facts)

    def _reference(self) -> Reference:
        return constant(self.position.tolist())

    def checked(self, given: Any) -> Float[np.ndarray, "3"]:
        """Return a target from a page's message; None stands for a free coordinate (NaN).

        Raises:
            ValueError: not three numbers, none of them, or a position far away.
        """
        numbers = isinstance(given, list) and len(given) == 3
        if not numbers or any(isinstance(x, bool) or not isinstance(x, int | float | None) for x in given):
            raise ValueError(f"target must be three numbers in m, or null (got {reprlib.repr(given)})")
        if all(x is None for x in given):
            raise ValueError("target must have at least one number")
        known = [0.0 if x is None else x for x in given]
        point = np.array(checked_target(known, [self.robot]))
        point[[x is None for x in given]] = np.nan
        return point

    def period(self) -> Moment:
        """Move by one period towards the newest target, and return the states at its measurement.

        Raises:
            SimulationError: the simulated robot was not solved.
        """
        loop, true = self.loop, getattr(self.plant, "state", None)
        drawn = {} if true is None else {TRUE: true}
        loop.reference = self._reference()
        deviations: dict[str, float] = {}

        def note() -> None:
            observer = getattr(loop.controller, "observer", None)
            for name, shape in shapes(self.plant, loop.controller).items():
                drawn.setdefault(name, shape)  # the robot itself has moved on
            deviations.update({} if observer is None else observer.estimate.deviations)

        row: Period = loop.period(note)
        numbers = self.facts.row(row, loop.missed, deviations)
        moment = Moment(row.time, drawn, numbers, row.command.reason)
        self.record.moments.append(moment)
        return moment


class LoopSession(PageSession):
    """Session of one page that moves a target."""

    def __init__(self, followed: FollowedTarget, connection: Any):
        super().__init__(connection, followed.facts.dt)
        self.followed = followed
        self.begin_anew, self.reason = True, ""
        self.newest, self.fresh = b"", asyncio.Event()
        self.commands |= {
            "export": lambda: self._offer(self._exported), "log": lambda: self._offer(self._log),
        }  # fmt: skip
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
                self.newest = self.frame(Moment(0.0, followed.shapes, self._at_rest(), ""))
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
        for name, values in (("target", self.followed.position), ("control", self._starts()), ("status", 0)):
            place, size = self.followed.facts.columns[name]
            numbers[place : place + size] = values
        return numbers

    def _starts(self) -> list[float]:
        return [each["start"] for each in self.followed.facts.controls]

    def frame(self, moment: Moment, sequence: int | None = None) -> bytes:
        """Return a period for the page: head as in `Session.frame`, the states' rows, the loop's numbers."""
        number = self.sequence if sequence is None else sequence
        states = list(moment.shapes.values())
        first = states[0]
        error = np.nan if first.position_error is None else first.position_error[0]
        place = self.followed.facts.columns["feedback"][0]
        spent = 1e3 * np.sum(moment.numbers[place : place + 2])
        head = [number, moment.time, first.result[0], error, self.pace, spent]
        rows = [
            last_row(state.system, state, names)
            for state, names in zip(states, self.followed.names, strict=True)
        ]
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
        page = self.followed.record.page(self.followed.title)
        return {"name": "run.html", "type": "text/html", "text": page}

    def _log(self) -> dict[str, str]:
        import tempfile
        from pathlib import Path

        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "log.csv"
            self.followed.loop.log().to_csv(path)
            return {"name": "log.csv", "type": "text/csv", "text": path.read_text(encoding="utf-8")}
