"""The board's logic on this computer, and scripts that run the same on the emulated chip."""

from __future__ import annotations

import ctypes
from collections.abc import Iterable
from typing import NamedTuple

from knode_cosserat_hardware.driver import HardwareError
from knode_cosserat_hardware.emulation.chip import CLOCK, Chip
from knode_cosserat_hardware.emulation.toolchain import built


class Fuzzed(NamedTuple):
    """Result of a fuzzing run."""

    #: frames after which a motor did what its state does not allow
    unsafe: int
    #: ticks in which the board was armed
    armed: int


class HostBoard:
    """The board's logic, compiled for this computer with checks for undefined behaviour.

    Script lines: `s` starts, `r TEXT` receives a line, `t N a b c d` ticks N times with these readings
    (counts), `p W M …` steps a PID (firmware/tests/script.h).
    """

    def __init__(self) -> None:
        self._library = library = ctypes.CDLL(str(built() / "libtension_host.so"))
        library.host_open.restype = ctypes.c_void_p
        library.host_run.argtypes = [ctypes.c_void_p, ctypes.c_char_p]
        library.host_run.restype = ctypes.c_char_p
        library.host_close.argtypes = [ctypes.c_void_p]
        library.host_fuzz.argtypes = [ctypes.c_uint64, ctypes.c_uint64, ctypes.c_void_p]
        library.host_fuzz.restype = ctypes.c_uint64
        self._board = library.host_open()

    def run(self, line: str) -> str:
        """Run a line of a script, and return what it prints; lines that the board sends begin with `>`."""
        return str(self._library.host_run(self._board, line.encode("latin-1")).decode("latin-1"))

    def fuzz(self, seed: int, frames: int) -> Fuzzed:
        """Send frames that are random or almost right to a new board, and check its motors after each."""
        armed = ctypes.c_uint64(0)
        unsafe = self._library.host_fuzz(seed, frames, ctypes.byref(armed))
        return Fuzzed(int(unsafe), int(armed.value))

    def __del__(self) -> None:
        if getattr(self, "_board", None):
            self._library.host_close(self._board)


def run_on_chip(lines: Iterable[str]) -> list[str]:
    """Return what each line of a script prints on the emulated chip, with its 16-bit integers.

    Raises:
        HardwareError: the chip does not answer.
    """
    chip = Chip(built() / "vectors.elf")
    printed, pending = [], _until_dot(chip, "")[1]
    for line in lines:
        chip.send(line.encode("latin-1") + b"\n")
        found, pending = _until_dot(chip, pending)
        printed.append(found)
    chip.close()
    return printed


def _until_dot(chip: Chip, text: str) -> tuple[str, str]:
    """Return the chip's output until a line with a dot, and the rest."""
    for _ in range(20_000):
        text += chip.received().decode("latin-1")
        head, dot, rest = ("\n" + text).partition("\n.\n")
        if dot:
            return head[1:] + ("\n" if head[1:] else ""), rest
        chip.run(CLOCK // 1000)
    raise HardwareError("the chip does not answer in 20 s")
