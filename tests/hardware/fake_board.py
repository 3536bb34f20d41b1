"""A tension board in Python behind a pseudo-terminal: plain and framed lines, faults, damage, silence."""

import collections
import contextlib
import os
import pty
import threading
import time
import tty

from knode_cosserat_hardware.lines import (
    Answer,
    Banner,
    FaultNotice,
    LineSplitter,
    Refusal,
    Remark,
    Telemetry,
    crc16,
    is_newer,
    sealed,
)


def encode_message(message, framed):
    """Return the line of a board's message, as a board sends it."""
    match message:
        case Telemetry():
            text = ",".join(map(str, (*message.tension, *message.drive, message.loop_time)))
            if framed:
                fault = message.fault or "-"
                text = f"{message.number or 0} : {message.acknowledged or 0} {message.state} {fault} {text}"
        case Answer():
            text = " ".join([str(message.number), "=", message.verb, *message.values])
        case Refusal():
            text = f"{message.number} ! {message.reason}" if framed else f"! {message.reason}"
        case FaultNotice():
            text = f"0 ! fault {message.fault}" if framed else f"! fault {message.fault}"
        case Banner():
            # a banner has no checksum in either mode
            framed = False
            text = f"# knode-tension {message.version} protocol {message.protocol} tendons {message.tendons}"
        case Remark():
            framed = False
            text = f"# {message.text}"
    return (sealed(text) if framed else text).encode("ascii") + b"\n"


class FakeLine:
    """A pseudo-terminal, and a thread that answers on it."""

    def __init__(self):
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.port = os.ttyname(self._slave)
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.unplug()

    def unplug(self):
        """Close the terminal, as pulling the cable does."""
        self._end.set()
        self._thread.join(2.0)
        for end in (self._master, self._slave):
            with contextlib.suppress(OSError):
                os.close(end)


class FakeBoard(FakeLine):
    """A board in a thread; its watchdog is slower than a real one, for busy computers.

    `paper` is the paper's board: no banner, no hello, plain telemetry only.
    """

    def __init__(self, *, paper=False, banner=True, taring=0.0, limit=2300, watchdog=0.6):
        self.paper, self.banner, self.limit, self.watchdog = paper, banner and not paper, limit, watchdog
        self.framed, self.state, self.fault = False, "ready" if not taring else "taring", ""
        self.wanted, self.measured = [0] * 4, [0] * 4
        self.received, self.accepted, self.last = [], [], None
        self.settings = {"kp": 300, "limit": limit, "jog": 80, "estop": 1}
        self.saved = False
        #: part of lines of each kind with one damaged byte, and of commands that the board reads damaged
        self.damage, self.damage_input = 0, 0
        self.silent = False
        self._taring, self._number, self._count = taring, 0, collections.Counter()
        self._splitter = LineSplitter()
        self.fed = time.monotonic()
        super().__init__()

    def latch(self, fault):
        """Latch a fault, such as "slack:2"."""
        if not self.fault:
            self.fault, self.state, self.wanted = fault, "fault", [0] * 4
            self._send(FaultNotice(fault))

    def restart(self):
        """Start again, as after a loss of supply."""
        self.framed, self.state, self.fault, self.last, self.wanted = False, "ready", "", None, [0] * 4
        self._send(Banner("1.0.0", 2, 4))

    def write(self, data):
        with contextlib.suppress(OSError):
            os.write(self._master, data)

    # the board

    def _send(self, message):
        if self.silent:
            return
        line = bytearray(encode_message(message, self.framed))
        # each kind is counted for itself, or the answers of a repeated request could all be damaged
        self._count[type(message)] += 1
        if self.damage and self._count[type(message)] % self.damage == 0:
            line[len(line) // 2] ^= 0x15
        self.write(bytes(line))

    def _run(self):
        start, sent = time.monotonic(), 0.0
        if self.banner:
            # the boot loader
            self._end.wait(0.15)
            with contextlib.suppress(OSError):
                os.read(self._master, 1000)
            self._send(Banner("1.0.0", 2, 4))
        while not self._end.is_set():
            try:
                for line in self._splitter.feed(os.read(self._master, 1000)):
                    self._take(line)
            except OSError:
                pass
            now = time.monotonic()
            if self.state == "taring" and now - start > self._taring:
                self.state = "ready"
            if self.framed and self.state in ("armed", "taring") and now - self.fed > self.watchdog:
                self.latch("watchdog:0")
            if self.state == "armed" and not self.framed and now - self.fed > 0.5:
                self.state = "ready"
            if now - sent > 0.02:
                sent = now
                self._telemetry()
            self._end.wait(0.002)

    def _telemetry(self):
        tension = [a or b for a, b in zip(self.measured, self.wanted, strict=True)]
        drive = (10, -20, 255, -255)
        if self.framed:
            self._number = (self._number + 1) % 65536
            more = (self._number, self.last or 0, self.state, self.fault)
            self._send(Telemetry(tuple(tension), drive, 4, *more))
        else:
            self._send(Telemetry(tuple(tension), drive, 4))

    def _take(self, line):
        self.received.append(line)
        if self.damage_input and len(self.received) % self.damage_input == 0:
            line = line[:-1] + b"?"
        text = line.decode("ascii", "replace")
        if self.paper:
            if len(text.split()) == 4 and text.replace(" ", "").isdigit():
                self.wanted, self.state, self.fed = (
                    [int(word) for word in text.split()],
                    "armed",
                    time.monotonic(),
                )
            return
        if text == "stop":
            self.latch("stopped:0")
        elif text.startswith("hello "):
            self.framed, self.last = text == "hello 2", None
            self.state = "ready" if self.state == "armed" else self.state
            self.fed = time.monotonic()
            self._send(Answer(0, "hello", ("2", "knode-tension", "1.0.0", "4", "256", str(self.limit))))
        elif self.framed:
            self._take_framed(line)
        elif text == "reset":
            self.fault, self.state = "", "ready"
        else:
            self._plain(text)

    def _plain(self, text):
        if self.state not in ("ready", "armed"):
            self._send(Refusal(0, "state"))
            return
        if len(text.split()) != 4 or not text.replace(" ", "").isdigit():
            self._send(Refusal(0, "arguments"))
            return
        self.wanted, self.state, self.fed = [int(word) for word in text.split()], "armed", time.monotonic()

    def _take_framed(self, line):
        body, _, check = line.rpartition(b"*")
        if check != f"{crc16(body):04X}".encode():
            self._send(Refusal(0, "checksum"))
            return
        number, verb, *words = body.decode().split()
        number = int(number)
        if self.last is not None and not is_newer(number, self.last):
            self._send(Refusal(number, "order"))
            return
        self.last, self.fed = number, time.monotonic()
        self.accepted.append((verb, *words))
        reason = self._obey(number, verb, words)
        if reason:
            self._send(Refusal(number, reason))

    def _obey(self, number, verb, words):
        allowed = {"tension": "armed", "arm": "ready", "disarm": "armed", "reset": "fault", "drive": "ready"}
        if verb in allowed and self.state != allowed[verb]:
            return "state"
        values = ()
        if verb == "tension":
            if not all(0 <= int(word) <= self.limit for word in words):
                return "range"
            self.wanted = [int(word) for word in words]
            return None
        if verb == "keep":
            return None
        if verb in ("get", "set"):
            if words[0] not in self.settings:
                return "name"
            if verb == "set":
                self.settings[words[0]] = int(words[1])
            values = (words[0], str(self.settings[words[0]]))
        elif verb in ("arm", "disarm", "reset"):
            self.state = {"arm": "armed"}.get(verb, "ready")
            self.fault, self.wanted = "", [0] * 4
        elif verb == "drive":
            if abs(int(words[1])) > self.settings["jog"]:
                return "range"
        elif verb == "save":
            self.saved = True
        self._send(Answer(number, verb, values))
        return None
