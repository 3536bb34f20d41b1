"""The ATmega2560 with the real firmware, in simavr."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from pathlib import Path

from knode_cosserat_hardware.driver import HardwareError
from knode_cosserat_hardware.emulation.toolchain import built

#: clock of the chip (1/s)
CLOCK = 16_000_000
#: data addresses of port A and of the compare registers that drive the motors (ATmega2560 data sheet)
PORTA, COMPARE, TOP = 0x22, (0x88, 0x8A, 0x98, 0x9A), 0x86


class Chip:
    """A chip that runs a program by exact numbers of clock cycles; the same inputs give the same bits."""

    def __init__(self, program: Path | None = None):
        """Load a program; None: the tension board's.

        Raises:
            HardwareError: the emulator is not installed, or the program cannot be loaded.
        """
        folder = built()
        self._library = library = ctypes.CDLL(str(folder / "libemulator.so"))
        library.emulator_open.restype = ctypes.c_void_p
        library.emulator_open.argtypes = [ctypes.c_char_p]
        library.emulator_run.argtypes = [ctypes.c_void_p, ctypes.c_uint64, ctypes.c_void_p]
        library.emulator_send.argtypes = [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_uint32]
        library.emulator_send.restype = ctypes.c_uint32
        library.emulator_receive.argtypes = [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_uint32]
        library.emulator_receive.restype = ctypes.c_uint32
        library.emulator_register.argtypes = [ctypes.c_void_p, ctypes.c_uint16]
        library.emulator_register.restype = ctypes.c_uint8
        library.emulator_contact.argtypes = [ctypes.c_void_p, ctypes.c_int]
        library.emulator_eeprom.argtypes = [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_uint16, ctypes.c_int]
        library.emulator_reset.argtypes = [ctypes.c_void_p]
        library.emulator_close.argtypes = [ctypes.c_void_p]
        path = folder / "tension.elf" if program is None else program
        self._chip = library.emulator_open(str(path).encode())
        if not self._chip:
            raise HardwareError(f"{path}: the emulator cannot load this program")
        self._voltages = (ctypes.c_uint32 * 4)()
        self._buffer = ctypes.create_string_buffer(65536)
        self.cycle = 0

    def run(self, cycles: int, millivolts: Sequence[int] = (0, 0, 0, 0)) -> None:
        """Run for some cycles with these voltages (mV) at the converter's inputs A0 to A3.

        Raises:
            HardwareError: the program crashed.
        """
        self.cycle += cycles
        self._voltages[:] = list(millivolts)
        if self._library.emulator_run(self._chip, self.cycle, self._voltages):
            raise HardwareError("the firmware crashed in the emulator")

    def send(self, data: bytes) -> None:
        """Send bytes to the chip's serial port, at 115200 baud.

        Raises:
            HardwareError: more than 64 KiB wait to be sent.
        """
        if self._library.emulator_send(self._chip, data, len(data)) != len(data):
            raise HardwareError("64 KiB wait for the chip's serial port; run the chip before sending more")

    def received(self) -> bytes:
        """Return the bytes that the chip has sent since the last call."""
        count = self._library.emulator_receive(self._chip, self._buffer, len(self._buffer))
        return self._buffer.raw[:count]

    def drives(self) -> list[float]:
        """Return the duty cycle of each motor's bridge, from -1 (reels out) to 1."""
        read, chip = self._library.emulator_register, self._chip
        top = read(chip, TOP) | read(chip, TOP + 1) << 8
        port = read(chip, PORTA)
        drives = []
        for tendon, address in enumerate(COMPARE):
            size = (read(chip, address) | read(chip, address + 1) << 8) / top if top else 0.0
            direction = port >> (2 * tendon) & 3
            drives.append(size if direction == 1 else -size if direction == 2 else 0.0)
        return drives

    def set_contact(self, is_open: bool) -> None:
        """Open or close the contact of the emergency stop at pin D18; it is closed at the start."""
        self._library.emulator_contact(self._chip, int(is_open))

    def eeprom(self, count: int = 4096) -> bytes:
        """Return the first bytes of EEPROM."""
        self._library.emulator_eeprom(self._chip, self._buffer, count, 0)
        return self._buffer.raw[:count]

    def set_eeprom(self, data: bytes) -> None:
        """Write bytes to the beginning of EEPROM."""
        self._library.emulator_eeprom(self._chip, data, len(data), 1)

    def reset(self) -> None:
        """Reset the chip, as opening its port or a loss of power does. EEPROM is kept."""
        self._library.emulator_reset(self._chip)

    def close(self) -> None:
        """Release the emulator."""
        if self._chip:
            self._library.emulator_close(self._chip)
            self._chip = None

    def __del__(self) -> None:
        if getattr(self, "_chip", None):
            self.close()
