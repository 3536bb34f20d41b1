"""Session of an open page: its messages, and commands that every live page has."""

from __future__ import annotations

import abc
import asyncio
import json
import reprlib
from collections.abc import Callable, Coroutine, Mapping
from typing import Any

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
            "pause": lambda: self._pause(True), "resume": lambda: self._pause(False), "reset": self._reset,
        }  # fmt: skip

    async def run(self) -> None:
        """Run until the page is closed."""
        tasks = [asyncio.create_task(each) for each in (self._read(), self._take_newest(), *self._motions())]
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
            if _is_command(text):
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
            self.understand(_parsed(text))
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

    def _pause(self, paused: bool) -> None:
        self.paused = paused

    def _reset(self) -> None:
        self.begin_anew = True

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


def _is_command(text: str | bytes) -> bool:
    """True if a message may be a command, which is never dropped."""
    return isinstance(text, str) and '"command"' in text


def _parsed(text: Any) -> Any:
    """Return the value of a JSON text; `ValueError` for one that is too long or too deep."""
    if len(text) > LONGEST:
        raise ValueError(f"the message has {len(text)} characters; allowed are {LONGEST}")
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("the message is nested too deeply") from None
