"""Marker trajectories and analog channels in C3D files: binary blocks of 512 bytes (www.c3d.org).

Byte 0 is the number of the first block of parameters, byte 1 is 0x50. Numbers are of Intel, DEC or MIPS
processors, and data are floats or scaled integers. A marker with a negative fourth word is lost. Of the
parameters, `POINT:UNITS` states the unit of length and `POINT:Y_SCREEN` the axis that points up.

A file is read as far as its frames are complete: a reader that requires header and parameters to agree would
refuse files of several programs. That is why no library reads them. Of 300 files with a few changed bytes,
266 are read here; c3d 0.6.0 refuses 83 of these, and ezc3d 1.7.2 ends or hangs the process on 15 of the 300,
and does not read files of MIPS.
"""

from __future__ import annotations

import struct
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from knode_cosserat._files import csv_rows
from knode_cosserat._files.reading import require_limit
from knode_cosserat.errors import KnodeCosseratError
from knode_cosserat.recordings import content
from knode_cosserat.recordings.exports import MOST_COLUMNS, Channels, Track, export_table, length_unit
from knode_cosserat.recordings.findings import Finding, RecordingError
from knode_cosserat.recordings.formats import RecordingFormat, register
from knode_cosserat.recordings.table import Table

_BLOCK, _KEY = 512, 0x50
#: processor numbers: byte order of each, "dec" for DEC's floats
_PROCESSORS = {84: "<", 85: "dec", 86: ">"}
#: types of parameters: bytes of an element, and NumPy's letter
_TYPES = {-1: (1, "S"), 1: (1, "i"), 2: (2, "i"), 4: (4, "f")}
#: number of frames that stands for more than the header can state
_FULL = 65535


def read_c3d(path: Path, wanted: Collection[str] = ()) -> Table:
    """Return the markers and analog channels of a file. Raises `RecordingError`."""
    data = content.file_bytes(path, csv_rows.LARGEST_FILE)
    try:
        return _C3D(data).table()
    except (struct.error, IndexError, ValueError) as error:
        if isinstance(error, KnodeCosseratError):
            raise
        raise RecordingError(f"this C3D file is damaged: {error}") from None


class _C3D:
    def __init__(self, data: bytes) -> None:
        self.data = data
        begin = (data[0] - 1) * _BLOCK
        _, _, blocks, processor = data[begin : begin + 4]
        if processor not in _PROCESSORS:
            raise RecordingError(
                f"this C3D file is of the processor {processor}; allowed is 84 (Intel), 85 (DEC) or 86 (MIPS)"
            )
        self.processor = _PROCESSORS[processor]
        self.order = "<" if self.processor == "dec" else self.processor
        self.parameters = self._parameters(data[begin + 4 : begin + max(blocks, 1) * _BLOCK])
        self.findings: list[Finding] = []

    def table(self) -> Table:
        words = struct.unpack_from(f"{self.order}5H", self.data, 2)
        points = self._number("POINT:USED", words[0])
        require_limit(3 * points, MOST_COLUMNS, "columns")
        per_frame, analog = struct.unpack_from(f"{self.order}H", self.data, 18)[0], words[1]
        scale = self._number("POINT:SCALE", self._floats(self.data[12:16])[0], float)
        rate = self._number("POINT:RATE", self._floats(self.data[20:24])[0], float)
        if not rate > 0.0:
            raise RecordingError(f"this C3D file has the rate {rate:g}; required is one above 0 Hz")
        if points == 0:
            raise RecordingError("this C3D file has no markers")
        first, stated = self._frames(words[2], words[3])
        is_float = scale < 0.0
        size = (4 * points + analog) * (4 if is_float else 2)
        begin = (
            self._number("POINT:DATA_START", 0) or struct.unpack_from(f"{self.order}H", self.data, 16)[0]
        ) - 1
        body = self.data[max(begin, 1) * _BLOCK :]
        count = min(stated, len(body) // size)
        if count < stated:
            what = f"the file was cut: {count} of {stated} frames are complete"
            self.findings.append(Finding("warning", "", what))
        kind = np.dtype(f"{self.order}i2")
        numbers = (
            self._floats(body[: count * size]) if is_float else np.frombuffer(body[: count * size], kind)
        )
        rows = numbers.reshape(count, 4 * points + analog)
        measured = rows[:, : 4 * points].reshape(count, points, 4).astype(float)
        length = length_unit(self._texts("POINT:UNITS", 1)[0], "mm", self.findings)
        position = measured[:, :, :3] * length * (1.0 if is_float else scale)
        position[(measured[:, :, 3] < 0.0) | ~np.isfinite(position).all(axis=2)] = np.nan
        time = (first - 1 + np.arange(count)) / rate
        names = self._texts("POINT:LABELS", points, "marker")
        tracks = [Track(names[k], position[:, k]) for k in range(points)]
        channels = (
            self._channels(rows[:, 4 * points :], time, rate, per_frame) if analog and per_frame else []
        )
        return export_table(time, tracks, up=self._up(), channels=channels, findings=self.findings)

    def _channels(self, rows: np.ndarray, time: np.ndarray, rate: float, per_frame: int) -> list[Channels]:
        """Return the analog channels in their units."""
        count = rows.shape[1] // per_frame
        raw = rows[:, : count * per_frame].reshape(-1, count).astype(float)
        if self._texts("ANALOG:FORMAT", 1)[0].upper() == "UNSIGNED" and rows.dtype.kind == "i":
            raw %= 65536.0
        scales = self._array("ANALOG:SCALE", count, 1.0) * self._number("ANALOG:GEN_SCALE", 1.0, float)
        values = (raw - self._array("ANALOG:OFFSET", count, 0.0)) * scales
        names, units = self._texts("ANALOG:LABELS", count, "channel"), self._texts("ANALOG:UNITS", count)
        at = (time[:, None] + np.arange(per_frame) / (rate * per_frame)).ravel()
        titles = [f"{name} [{unit}]" if unit else name for name, unit in zip(names, units, strict=True)]
        return [(at, dict(zip(titles, values.T, strict=True)))]

    def _frames(self, first: int, last: int) -> tuple[int, int]:
        """Return the first frame's number and the stated number of frames."""
        count = last - first + 1
        actual = [self.parameters.get(f"TRIAL:ACTUAL_{end}_FIELD") for end in ("START", "END")]
        if all(isinstance(word, np.ndarray) and word.size == 2 for word in actual):
            # two words of 16 bits, the lower first
            first, last = (int(word[0]) % 65536 + 65536 * (int(word[1]) % 65536) for word in actual)  # type: ignore[index]
            return first, last - first + 1
        frames = self._number("POINT:FRAMES", 0) % 65536
        if last == _FULL or count <= 0:
            count = self._number("POINT:LONG_FRAMES", frames if 0 < frames < _FULL else 1 << 40)
        return first, count

    def _up(self) -> str:
        """Return the axis that points up; a note if it is not stated."""
        axis = self._texts("POINT:Y_SCREEN", 1)[0].lower().removeprefix("+")
        if axis in ("x", "y", "z", "-x", "-y", "-z"):
            return axis
        what = "POINT:Y_SCREEN does not state which axis points up; z is taken (`up` states it)"
        self.findings.append(Finding("note", "", what))
        return "z"

    def _floats(self, data: bytes) -> Float[np.ndarray, " n"]:
        """Return floats of the file's processor."""
        if self.processor != "dec":
            return np.frombuffer(data, f"{self.order}f4")
        # DEC's floats have their words swapped, and an exponent that is larger by 2
        return np.frombuffer(data, "<u2").reshape(-1, 2)[:, ::-1].copy().view("<f4").ravel() / 4.0

    def _parameters(self, section: bytes) -> dict[str, Any]:
        """Return the parameters by GROUP:NAME: arrays of numbers or lists of texts."""
        groups: dict[int, str] = {}
        parameters: list[tuple[int, str, Any]] = []
        position = 0
        while position + 4 <= len(section):
            length, group = struct.unpack_from("bb", section, position)
            position += 2
            if length == 0 or group == 0:
                break
            name = section[position : position + abs(length)].decode("latin-1").strip().upper()
            position += abs(length)
            (offset,) = struct.unpack_from(f"{self.order}h", section, position)
            if group < 0:
                groups[-group] = name
            else:
                parameters.append((group, name, self._value(section, position + 2)))
            if offset <= 0:
                break
            position += offset
        return {f"{groups.get(group, group)}:{name}": value for group, name, value in parameters}

    def _value(self, section: bytes, position: int) -> Any:
        kind, dimensions = struct.unpack_from("bB", section, position)
        position += 2
        if kind not in _TYPES:
            return None
        sizes = list(section[position : position + dimensions])
        position += dimensions
        size, letter = _TYPES[kind]
        count = int(np.prod(sizes, dtype=np.int64)) if sizes else 1
        raw = section[position : position + count * size]
        if len(raw) < count * size:
            return None
        if letter == "S":
            width = sizes[0] if sizes else 1
            return [
                raw[k : k + width].decode("latin-1").strip(" \0") for k in range(0, len(raw), max(width, 1))
            ]
        return self._floats(raw) if letter == "f" else np.frombuffer(raw, f"{self.order}i{size}")

    def _number(self, name: str, default: Any, kind: Any = int) -> Any:
        value = self.parameters.get(name)
        if not isinstance(value, np.ndarray) or value.size == 0:
            return kind(default)
        number = value[0]
        # words of 16 bits are counts here, though C3D's integers have signs
        return kind(int(number) % 65536 if value.dtype.kind == "i" and value.dtype.itemsize == 2 else number)

    def _array(self, name: str, count: int, default: float) -> Float[np.ndarray, " count"]:
        """Return one number a channel; missing ones are the default."""
        values, stated = np.full(count, default), self.parameters.get(name)
        if isinstance(stated, np.ndarray):
            values[: min(count, stated.size)] = stated[:count]
        return values

    def _texts(self, name: str, count: int, default: str = "") -> list[str]:
        """Return texts, also those of the parameters NAME2, NAME3 and so on; missing ones are numbered."""
        texts: list[str] = []
        for number in ["", *range(2, 100)]:
            part = self.parameters.get(f"{name}{number}")
            if not isinstance(part, list) or len(texts) >= count:
                break
            texts += part
        texts = [*texts, *[""] * count][:count]
        return [text or (f"{default} {k + 1}" if default else "") for k, text in enumerate(texts)]


def _is_c3d(head: bytes) -> bool:
    """True for a first block of a C3D file, with the processor in its parameters if these are near."""
    if len(head) < _BLOCK or head[0] < 2 or head[1] != _KEY or b"\0" not in head[:_BLOCK]:
        return False
    begin = (head[0] - 1) * _BLOCK
    return begin + 4 > len(head) or head[begin + 3] in _PROCESSORS


register(RecordingFormat("C3D", recognise=_is_c3d, read=read_c3d, suffixes=(".c3d",)))
