"""Flood of the live server: 1,000 pages and 10,000 slider events per second, while its owner moves a slider.

The server runs in a process of its own. Half of the pages claim another origin, the others the server's own,
as any program of this machine can; pages that are turned away come back. The owner's page was opened first;
its delay is measured from a moved slider to the frame of that slider's number.
"""

from __future__ import annotations

import asyncio
import base64
import collections
import contextlib
import json
import os
import random
import selectors
import socket
import struct
import subprocess
import sys
import time

import numpy as np

from tools.attack.table import Row, printed_row

PAGES, EVENTS, ALLOWED = 1_000, 10_000.0, 0.1
#: interval of the owner's sliders (s), and pause before a page that was turned away comes back (s)
OWNER, RETURN = 0.05, (1.0, 3.0)
SERVER = """
import knode_cosserat as kc
from knode_cosserat.viewer import view_live
view_live(kc.load_robot("delrin-tendon-robot"), open_browser=lambda address: print(address, flush=True))
"""


def frame(text: str) -> bytes:
    """Return a text as a client's WebSocket frame; its mask is zero."""
    data = text.encode()
    size = (
        bytes([0x80 | len(data)]) if len(data) < 126 else bytes([0x80 | 126]) + struct.pack("!H", len(data))
    )
    return b"\x81" + size + b"\0\0\0\0" + data


class Page:
    """A page of the flood: a socket that connects, sends events, and comes back when it was turned away."""

    def __init__(self, port: int, origin: str):
        key = base64.b64encode(os.urandom(16)).decode()
        self._request = (
            f"GET /live HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            f"Sec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\nOrigin: {origin}\r\n\r\n"
        ).encode()
        self._port, self._rest = port, b""
        self.socket: socket.socket | None = None
        self.is_open, self.back, self.turned_away = False, 0.0, 0

    def connect(self, selector: selectors.BaseSelector) -> None:
        """Begin a connection."""
        self.socket = socket.socket()
        self.socket.setblocking(False)
        with contextlib.suppress(BlockingIOError):
            self.socket.connect(("127.0.0.1", self._port))
        self.is_open, self._rest = False, self._request
        selector.register(self.socket, selectors.EVENT_READ | selectors.EVENT_WRITE, self)

    def close(self, selector: selectors.BaseSelector) -> None:
        """End the connection, and come back later."""
        assert self.socket is not None
        selector.unregister(self.socket)
        self.socket.close()
        self.socket, self.is_open = None, False
        self.turned_away += 1
        self.back = time.monotonic() + random.uniform(*RETURN)

    def ready(self, selector: selectors.BaseSelector, events: int) -> None:
        """Send the request, or read what the server says."""
        assert self.socket is not None
        try:
            if events & selectors.EVENT_WRITE and self._rest:
                self._rest = self._rest[self.socket.send(self._rest) :]
                if not self._rest:
                    selector.modify(self.socket, selectors.EVENT_READ, self)
            if events & selectors.EVENT_READ:
                data = self.socket.recv(1 << 16)
                if not data or data.startswith((b"\x88", b"HTTP/1.1 4", b"HTTP/1.1 5")):
                    self.close(selector)
                elif data.startswith(b"HTTP/1.1 101"):
                    self.is_open = True
        except BlockingIOError:
            pass
        except OSError:
            self.close(selector)

    def event(self, data: bytes) -> bool:
        """Send an event; True if the server takes it now."""
        try:
            if self._rest or self.socket is None:
                return False
            self._rest = data[self.socket.send(data) :]
        except OSError:
            return False
        # the remainder of a frame goes first; without it the connection would be broken
        with contextlib.suppress(OSError):
            self._rest = self._rest[self.socket.send(self._rest) :] if self._rest else b""
        return True


def flood(port: int, seconds: float, pages: int = PAGES, events: float = EVENTS) -> dict[str, int]:
    """Flood a server for so long; return counts of events and of pages."""
    selector, own = selectors.DefaultSelector(), f"http://127.0.0.1:{port}"
    clients = [Page(port, own if k % 2 else "http://elsewhere.example") for k in range(pages)]
    counts: collections.Counter[str] = collections.Counter()
    began, due = time.monotonic(), 0
    text = {"control": [5.0, 6.0, 5.5, 6.0], "sequence": 1}
    while (now := time.monotonic()) < began + seconds:
        for page in clients:
            # all of them come within the first second
            if page.socket is None and now > max(page.back, began + clients.index(page) / pages):
                page.connect(selector)
        for key, ready in selector.select(0.001):
            key.data.ready(selector, ready)
        opened = [page for page in clients if page.is_open]
        counts["open"] = max(counts["open"], len(opened))
        while opened and due < (now - began) * events:
            due += 1
            text["control"][0] = 5.0 + random.random()  # type: ignore[index]
            text["sequence"] = due % 2**24
            counts["taken" if opened[due % len(opened)].event(frame(json.dumps(text))) else "held back"] += 1
        due = max(due, int((now - began) * events) - 1000)
    counts["turned away"] = sum(page.turned_away for page in clients)
    return dict(counts)


async def owner(port: int, seconds: float, flooding: asyncio.Event) -> tuple[list[float], float]:
    """Move a slider at 20 Hz; return the delays to its frames, and the latest wake-up of this process (s).

    The latter is no fault of the server: it shows how busy the machine is.
    """
    from websockets.asyncio.client import connect

    sent: dict[int, float] = {}
    delays: list[float] = []
    late: list[float] = []
    address = f"ws://127.0.0.1:{port}/live"
    async with connect(address, origin=f"http://127.0.0.1:{port}") as own:  # type: ignore[arg-type]

        async def read() -> None:
            async for message in own:
                if isinstance(message, bytes):
                    number, now = int(np.frombuffer(message, np.float32)[0]), time.monotonic()
                    delays.extend(now - sent.pop(each) for each in list(sent) if each <= number)

        reading = asyncio.create_task(read())
        begin, number = time.monotonic(), 0
        await asyncio.sleep(1.0)
        flooding.set()
        while time.monotonic() < begin + seconds:
            number += 1
            sent[number] = time.monotonic()
            control = [5.0 + 0.5 * float(np.sin(number / 7 + k)) for k in range(4)]
            await own.send(json.dumps({"control": control, "sequence": number}))
            due = time.monotonic() + OWNER
            await asyncio.sleep(OWNER)
            late.append(time.monotonic() - due)
        await asyncio.sleep(1.0)
        reading.cancel()
        # a slider that no frame shows has waited until now
        return delays + [time.monotonic() - when for when in sent.values()], max(late)


async def attack(port: int, seconds: float, events: float) -> tuple[np.ndarray, float, dict[str, int]]:
    """Flood a server; return the owner's delays, its latest wake-up (s), and the flood's counts."""
    flooding = asyncio.Event()
    mine = asyncio.create_task(owner(port, seconds, flooding))
    await flooding.wait()
    command = [sys.executable, "-m", "tools.attack.flood", str(port), str(seconds - 2.0), str(events)]
    process = await asyncio.create_subprocess_exec(*command, stdout=subprocess.PIPE)
    delays, late = await mine
    said, _ = await process.communicate()
    return np.array(delays), late, json.loads(said)


def flooded(seconds: float = 60.0, events: float = EVENTS) -> list[Row]:
    """Flood a live server, and return the row of the table."""
    server = subprocess.Popen([sys.executable, "-c", SERVER], stdout=subprocess.PIPE, text=True)
    try:
        assert server.stdout is not None
        port = int(server.stdout.readline().strip().rstrip("/").rsplit(":", 1)[1])
        delays, late, counts = asyncio.run(attack(port, seconds, events))
        failures = [] if server.poll() is None else ["the live server has ended"]
    finally:
        server.kill()
        server.wait()
    middle, high, most = (1e3 * float(np.percentile(delays, share)) for share in (50, 99, 100))
    if not most <= 1e3 * ALLOWED:
        failures.append(f"the owner of the live server was answered after {most:.0f} ms")
    remark = f"owner: p50 {middle:.0f} ms, p99 {high:.0f} ms, max {most:.0f} ms of {len(delays)}"
    remark += f" (its process woke up to {1e3 * late:.0f} ms late); {counts}"
    taken, held = counts.get("taken", 0), counts.get("held back", 0)
    row = Row(f"{events:g} Hz of events at the live server", taken + held, held, failures, remark)
    printed_row(row)
    return [row]


if __name__ == "__main__":
    print(json.dumps(flood(int(sys.argv[1]), float(sys.argv[2]), events=float(sys.argv[3]))))
