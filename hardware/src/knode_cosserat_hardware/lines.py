"""Wire protocol of tension boards: lines of ASCII to messages and back (firmware/PROTOCOL.md).

Tensions on the wire are whole numbers in grams-force. Decoders return None for a line that is damaged.
"""

from __future__ import annotations

import binascii
import re
from collections.abc import Sequence
from typing import NamedTuple

from knode_cosserat_hardware.driver import HardwareError

#: newtons of a gram-force
GRAM_FORCE = 9.80665e-3
#: greatest length of a line to the board, and of a line that is decoded (without its end)
LONGEST, LONGEST_DECODED = 63, 160
#: numbers of lines wrap here
NUMBERS = 65536
#: states of a board
STATES = ("boot", "taring", "ready", "armed", "releasing", "fault")

_WORD = re.compile(r"[!-)+-~]{1,40}")
_NUMBER = re.compile(r"-?[0-9]{1,7}")
_BANNER = re.compile(r"# knode-tension (\S{1,20}) protocol ([0-9]{1,3}) tendons ([0-9]{1,2})")


class Telemetry(NamedTuple):
    """Telemetry of a board. `number`, `acknowledged`, `state` and `fault` are absent in plain mode.

    Tensions in grams-force, drives from -255 to 255, the loop time in ms.
    """

    tension: tuple[int, ...]
    drive: tuple[int, ...]
    loop_time: int
    number: int | None = None
    acknowledged: int | None = None
    state: str = ""
    #: such as "over-tension:3"; empty without a fault
    fault: str = ""


class Answer(NamedTuple):
    """Answer to the line with this number."""

    number: int
    verb: str
    values: tuple[str, ...] = ()


class Refusal(NamedTuple):
    """Refusal of the line with this number: it changed nothing. Number 0: it could not be read."""

    number: int
    reason: str


class FaultNotice(NamedTuple):
    """Notice of a fault that latched, such as "slack:2"."""

    fault: str


class Banner(NamedTuple):
    """First line of a board after its start."""

    version: str
    protocol: int
    tendons: int


class Remark(NamedTuple):
    """Remark for a person."""

    text: str


Message = Telemetry | Answer | Refusal | FaultNotice | Banner | Remark


def crc16(data: bytes) -> int:
    """Return the CRC-16/CCITT-FALSE of bytes: polynomial 0x1021, start 0xFFFF."""
    return binascii.crc_hqx(data, 0xFFFF)


def is_newer(number: int, other: int) -> bool:
    """True if a line's number is newer than another: their 16-bit signed difference is positive."""
    return 0 < (number - other) % NUMBERS < NUMBERS // 2


# encoding


def encode_tensions(tension: Sequence[int]) -> bytes:
    """Return the plain command of tensions (grams-force)."""
    if any(not 0 <= value < NUMBERS for value in tension):
        raise HardwareError(f"tensions on the wire must be between 0 and 65535 gf (got {list(tension)})")
    return encode_plain(" ".join(str(int(value)) for value in tension))


def encode_plain(text: str) -> bytes:
    """Return a line without number and checksum."""
    if not text.isascii() or not text.isprintable() or len(text) > LONGEST:
        raise HardwareError(
            f"a line must be printable ASCII of at most {LONGEST} characters (got {text[:80]!r})"
        )
    return text.encode("ascii") + b"\n"


def encode_framed(number: int, verb: str, *arguments: int | str) -> bytes:
    """Return a line with number and checksum."""
    words = [verb, *map(str, arguments)]
    wrong = [word for word in words if not _WORD.fullmatch(word)]
    if wrong:
        raise HardwareError(
            f"words on the wire must be printable ASCII without spaces (got {wrong[0][:80]!r})"
        )
    if not 0 <= number < NUMBERS:
        raise HardwareError(f"a line's number must be between 0 and 65535 (got {number})")
    return encode_plain(sealed(" ".join([str(number), *words])))


def sealed(text: str) -> str:
    """Return a line with its checksum."""
    return f"{text}*{crc16(text.encode('ascii')):04X}"


# decoding


def decode_plain(line: bytes) -> Message | None:
    """Return the message of a plain line, without its end; None for a damaged line."""
    text = _text(line)
    if text is None:
        return None
    if text.startswith("#"):
        found = _BANNER.fullmatch(text)
        return Banner(found[1], int(found[2]), int(found[3])) if found else Remark(text[1:].strip())
    if text.startswith("! "):
        return _refused(0, text[2:].split(" "))
    return _numbers(text)


def decode_framed(line: bytes) -> Message | None:
    """Return the message of a line with checksum, without its end; a banner has none. None: damaged."""
    text = _text(line)
    if text is None:
        return None
    if text.startswith("#"):
        return decode_plain(line)
    body, star, check = text.rpartition("*")
    if not star or not re.fullmatch("[0-9A-F]{4}", check) or crc16(body.encode("ascii")) != int(check, 16):
        return None
    words = body.split(" ")
    if len(words) < 3 or not _is_number(words[0]):
        return None
    number, sign, rest = int(words[0]), words[1], words[2:]
    if sign == "=":
        return Answer(number, rest[0], tuple(rest[1:]))
    if sign == "!":
        return _refused(number, rest)
    return _telemetry(number, rest) if sign == ":" else None


def decode(line: bytes) -> Message | None:
    """Return the message of a line of either mode; None for a damaged line."""
    return decode_framed(line) if b"*" in line and not line.startswith(b"#") else decode_plain(line)


def _text(line: bytes) -> str | None:
    if not line or len(line) > LONGEST_DECODED:
        return None
    try:
        text = line.decode("ascii")
    except UnicodeDecodeError:
        return None
    return text if text.isprintable() else None


def _is_number(word: str) -> bool:
    return bool(re.fullmatch("[0-9]{1,5}", word)) and int(word) < NUMBERS


def _refused(number: int, words: list[str]) -> Message | None:
    if len(words) == 2 and words[0] == "fault" and _is_fault(words[1]):
        return FaultNotice(words[1])
    return Refusal(number, words[0]) if len(words) == 1 and _WORD.fullmatch(words[0]) else None


def _is_fault(word: str) -> bool:
    return bool(re.fullmatch("[a-z][a-z-]{0,30}:[0-9]{1,2}", word))


def _telemetry(number: int, words: list[str]) -> Telemetry | None:
    if len(words) != 4 or not _is_number(words[0]) or words[1] not in STATES:
        return None
    if words[2] != "-" and not _is_fault(words[2]):
        return None
    plain = _numbers(words[3])
    if plain is None:
        return None
    fault = "" if words[2] == "-" else words[2]
    return Telemetry(plain.tension, plain.drive, plain.loop_time, number, int(words[0]), words[1], fault)


def _numbers(text: str) -> Telemetry | None:
    """Return telemetry from an odd count of numbers: tensions, as many drives, and the loop time."""
    words = text.replace(" ", "").split(",")
    if len(words) < 3 or len(words) % 2 == 0 or not all(_NUMBER.fullmatch(word) for word in words):
        return None
    values = tuple(map(int, words))
    count = len(values) // 2
    return Telemetry(values[:count], values[count:-1], values[-1])


class LineSplitter:
    """Divides received bytes into lines; a line that is too long is dropped."""

    def __init__(self) -> None:
        self._rest = bytearray()
        self._dropping = False

    def feed(self, data: bytes) -> list[bytes]:
        """Return the lines that these bytes complete, without their ends."""
        self._rest += data
        *lines, rest = bytes(self._rest).split(b"\n")
        if lines and self._dropping:
            del lines[0]
            self._dropping = False
        if len(rest) > LONGEST_DECODED:
            self._dropping, rest = True, b""
        self._rest = bytearray(rest)
        return [line.removesuffix(b"\r") for line in lines if line not in (b"", b"\r")]
