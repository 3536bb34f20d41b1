"""Emulated robots: the real firmware in simavr, with motors, load cells, tendons and the rod around it.

Chip and robot move in lock-step; the same commands give the same bits. Ports connect drivers to it. The
emulator is built when it is first used; that needs Debian's packages of simavr and of the AVR compiler.
"""

from __future__ import annotations

import contextlib
import ctypes
import dataclasses
import functools
import hashlib
import os
import shutil
import subprocess
import threading
import time
import tty
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal, Self, get_args

import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.robot_file import load_robot
from knode_cosserat.rods.tendon_robots import RoutedTendonRobot
from knode_cosserat.rods.tendons import Reels
from knode_cosserat.solvers.stepper import Stepper
from knode_cosserat.trajectory import Trajectory
from knode_cosserat_hardware.board_link import Transport
from knode_cosserat_hardware.driver import HardwareError
from knode_cosserat_hardware.lines import GRAM_FORCE
from knode_cosserat_hardware.simulated import TrueShape

#: Debian packages that the build needs
PACKAGES = "make g++ arduino-core-avr gcc-avr avr-libc binutils-avr libsimavr-dev libelf-dev"
#: where Debian's packages put what the build needs
NEEDED = ("/usr/share/arduino/hardware/arduino/avr/cores/arduino", "/usr/include/simavr/sim_avr.h")


def firmware_folder() -> Path:
    """Return the folder of the firmware's sources."""
    here = Path(__file__).resolve()
    for folder in (here.parents[3] / "firmware", here.parent / "firmware"):
        if (folder / "Makefile").is_file():
            return folder
    raise HardwareError("the firmware's sources are not installed; use a checkout of the repository")


def missing() -> str:
    """Return the reason why the firmware cannot be built here, or an empty text."""
    tools = [name for name in ("make", "avr-g++", "g++") if shutil.which(name) is None]
    tools += [path for path in NEEDED if not os.path.exists(path)]
    if not tools:
        return ""
    return f"{tools[0]} is missing; install: apt-get install --no-install-recommends {PACKAGES}"


@functools.lru_cache
def built() -> Path:
    """Return the folder of the built firmware; builds it (some seconds) if its sources are newer."""
    if reason := missing():
        raise HardwareError(f"the firmware cannot be built: {reason}")
    sources = firmware_folder()
    folder = _output(sources)
    folder.mkdir(parents=True, exist_ok=True)
    done = subprocess.run(
        ["make", "--no-print-directory", "-C", str(sources), f"OUT={folder}", "all"],
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        lines = [line for line in done.stderr.splitlines() if "error" in line.lower()]
        raise HardwareError(f"the firmware's build failed: {(lines or ['make failed'])[0]}")
    return folder


def _output(sources: Path) -> Path:
    """Return the folder for outputs: that of `make firmware` in a checkout, else one in the user's cache."""
    root = sources.parent
    if (root / "pyproject.toml").is_file() and os.access(root, os.W_OK):
        return root / "build" / "firmware"
    digest = hashlib.sha256()
    for file in sorted(sources.rglob("*")):
        if file.is_file():
            digest.update(file.read_bytes())
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return base / "knode-cosserat" / f"firmware-{digest.hexdigest()[:16]}"


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
        chip, text, size, flag = ctypes.c_void_p, ctypes.c_char_p, ctypes.c_uint32, ctypes.c_int
        for name, result, arguments in (
            ("open", chip, [text]),
            ("run", flag, [chip, ctypes.c_uint64, chip]),
            ("send", size, [chip, text, size]),
            ("receive", size, [chip, text, size]),
            ("register", ctypes.c_uint8, [chip, ctypes.c_uint16]),
            ("contact", flag, [chip, flag]),
            ("eeprom", flag, [chip, text, ctypes.c_uint16, flag]),
            ("reset", flag, [chip]),
            ("close", flag, [chip]),
        ):
            function = getattr(library, f"emulator_{name}")
            function.restype, function.argtypes = result, arguments
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

    def fuzz(self, seed: int, frames: int) -> tuple[int, int]:
        """Send frames that are random or almost right to a new board, and check its motors after each.

        Returns:
            Number of frames after which a motor did what its state does not allow, and of ticks armed.
        """
        armed = ctypes.c_uint64(0)
        unsafe = self._library.host_fuzz(seed, frames, ctypes.byref(armed))
        return int(unsafe), int(armed.value)

    def __del__(self) -> None:
        if getattr(self, "_board", None):
            self._library.host_close(self._board)


@dataclasses.dataclass(frozen=True)
class MotorParameters:
    """Geared DC motor with a reel; all values are at the reel's surface unless stated.

    The defaults are nominal values of a JGA25-371 with a gear of 1:34 and a reel of 10 mm radius. They are
    typical for this size; no motor was measured.

    Attributes:
        voltage: supply (V).
        resistance: of winding and bridge (ohm).
        inductance: of the winding (H).
        speed: without load at the supply's voltage (m/s).
        force: of the stalled motor at this voltage (N).
        mass: rotor and gear, moved along with the tendon (kg).
        friction: of the gear (N).
        backlash: of the gear (m).
        pull: force that the reel needs to move through the backlash, per speed (N s/m).
    """

    voltage: float = 12.0
    resistance: float = 5.5
    inductance: float = 2.0e-3
    speed: float = 0.29
    force: float = 42.0
    mass: float = 2.3
    friction: float = 3.0
    backlash: float = 1.5e-4
    pull: float = 60.0


class Motors:
    """Motors of all tendons, moved by implicit steps: `position` is the length that each reel took in (m)."""

    def __init__(self, count: int, parameters: MotorParameters):
        self.parameters = parameters
        self.current, self.speed = np.zeros(count), np.zeros(count)
        self.rotor, self.position = np.zeros(count), np.zeros(count)

    def step(
        self, drive: Float[np.ndarray, " c"], tension: Float[np.ndarray, " c"], h: float, powered: bool = True
    ) -> None:
        """Move on by `h` (s) under duty cycles and tensions (N). Without power the motors turn freely."""
        p = self.parameters
        back_emf, force_per_current = p.voltage / p.speed, p.force * p.resistance / p.voltage
        # current at the end of the step: a - b v
        divisor = 1.0 + h * p.resistance / p.inductance
        a = (self.current + h / p.inductance * p.voltage * drive) / divisor
        b = h / p.inductance * back_emf / divisor
        if not powered:
            a, b = np.zeros_like(a), 0.0
        inertia = p.mass / h + force_per_current * b
        free = (p.mass / h * self.speed + force_per_current * a - tension) / inertia
        self.speed = np.sign(free) * np.maximum(np.abs(free) - p.friction / inertia, 0.0)
        self.current = a - b * self.speed
        self.rotor = self.rotor + h * self.speed
        half = 0.5 * p.backlash
        moved = self.position - h * tension / p.pull
        self.position = np.clip(moved, self.rotor - half, self.rotor + half)


@dataclasses.dataclass(frozen=True)
class LoadCellParameters:
    """Load cells with their amplifiers.

    Attributes:
        offset: voltage of a slack tendon (V).
        sensitivity: voltage per force (V/N). By default a gram-force is a quarter of a converter's step.
        spread: standard deviation of the cells' relative sensitivity and of their relative offset.
        noise: standard deviation of a conversion (V).
    """

    offset: float = 0.5
    sensitivity: float = 0.25 * 5.0 / 1023.0 / GRAM_FORCE
    spread: float = 0.0
    noise: float = 2.0e-3


class LoadCells:
    """Load cells of all tendons, with noise, and faults that are injected."""

    def __init__(self, count: int, parameters: LoadCellParameters, random: np.random.Generator):
        self._random, self._noise = random, parameters.noise
        spread = parameters.spread * random.normal(size=(2, count))
        self.offset = parameters.offset * (1.0 + spread[0])
        self.sensitivity = parameters.sensitivity * (1.0 + spread[1])
        #: voltage at which a cell is stuck (V); NaN: it works
        self.stuck = np.full(count, np.nan)
        self._last = self.offset.copy()

    def millivolts(self, tension: Float[np.ndarray, " c"]) -> list[int]:
        """Return the voltages (mV) of one conversion."""
        volts = (
            self.offset + self.sensitivity * tension + self._noise * self._random.normal(size=len(tension))
        )
        self._last = np.where(np.isnan(self.stuck), volts, self.stuck)
        return [int(value) for value in np.clip(np.rint(1e3 * self._last), 0, 5000)]

    def freeze(self, tendon: int) -> None:
        """Let a cell repeat its last voltage."""
        self.stuck[tendon] = self._last[tendon]


#: steps of the motors in a second, and in each step of the rod. With steps of the rod half as
#: long the loop is the same (tests/hardware/test_emulation.py); with 1/64 s it oscillates at 26 Hz
STEPS, ROD_STEPS = 512, 4
#: robot of the catalog that is emulated by default
ROBOT = "delrin-routed-tendon-robot"
#: length (m) taken in by each reel for the linearisation: some 4 N in each tendon
TAUT = 1.0e-3
#: emergency stop: released, pressed (the contact opens and the motors lose their supply), or its wire to the
#: board is broken
Switch = Literal["released", "pressed", "broken"]
#: compliance of a tendon of 0.6 m with its load cell (m/N)
COMPLIANCE = 2.0e-4


class EmulatedRobot(TrueShape):
    """A tendon robot with four motors behind the emulated board.

        robot = kch.emulation.EmulatedRobot()
        with kch.SerialBoard(kch.emulation.EmulatedPort(robot), limits) as board:
            board.arm()

    Each step of the rod solves for the tensions that belong to the reels' positions. Between two steps the
    tendons' paths are extrapolated, and follow the reels as in a step of a straight rod.
    """

    def __init__(
        self,
        robot: str | RoutedTendonRobot = ROBOT,
        *,
        motors: MotorParameters | None = None,
        cells: LoadCellParameters | None = None,
        compliance: float = COMPLIANCE,
        slack: float = 0.002,
        seed: int = 0,
    ):
        """Set up the robot at rest with slack tendons, and start the chip.

        Args:
            robot: a routed tendon robot with four tendons, or its name or file.
            motors: of all tendons; None: a nominal JGA25-371.
            cells: load cells of all tendons; None: nominal ones.
            compliance: of each tendon (m/N).
            slack: of each tendon at the start (m).
            seed: of the noise.

        Raises:
            HardwareError: another kind of robot, or the emulator is not installed.
        """
        given: Any = load_robot(robot) if isinstance(robot, str) else robot
        if not isinstance(given, RoutedTendonRobot) or given.tendon_count != 4:
            raise HardwareError(
                "the emulated board drives a routed tendon robot with 4 tendons (got "
                f"{type(given).__name__}); use {ROBOT}, for example"
            )
        reels = Reels(motors=[1.0, 2.0, 3.0, 4.0], compliance=[compliance] * 4)
        self.robot = given.replace(drive="reel", reels=reels)
        self._random = np.random.default_rng(seed)
        self.motors = Motors(4, motors or MotorParameters())
        self.cells = LoadCells(4, cells or LoadCellParameters(), self._random)
        self.motors.rotor -= slack
        self.motors.position -= slack
        #: tendons that are torn, or off their reels
        self.torn = np.zeros(4, dtype=bool)
        self._compliance = compliance
        self._stepper = Stepper(self.robot, ROD_STEPS / STEPS)
        self._stepper.step(self.motors.position)
        self._straight = self._path()
        self._follows = self._response()
        self._taken, self._rate = np.zeros(4), np.zeros(4)
        self._reeled, self._reel_rate = self.motors.position.copy(), np.zeros(4)
        self.tension = np.zeros(4)
        self.chip, self._count = Chip(), 0
        self._switch: Switch = "released"

    @property
    def time(self) -> float:
        """Time since the chip's start (s)."""
        return self._count / STEPS

    @property
    def switch(self) -> Switch:
        """Emergency stop: "released", "pressed" (cuts the motors' supply too), or "broken" (its wire)."""
        return self._switch

    @switch.setter
    def switch(self, value: Switch) -> None:
        if value not in get_args(Switch):
            raise HardwareError(f"switch must be one of {', '.join(get_args(Switch))} (got {value!r})")
        self._switch = value
        self.chip.set_contact(value != "released")

    def advance(self, seconds: float) -> None:
        """Move chip and robot on by some time (s), rounded to 1/512 s."""
        for _ in range(round(seconds * STEPS)):
            self.step()

    def step(self) -> None:
        """Move chip and robot on by 1/512 s."""
        self.chip.run(CLOCK // STEPS, self.cells.millivolts(self.tension))
        h = 1.0 / STEPS
        self.motors.step(np.array(self.chip.drives()), self.tension, h, self._switch != "pressed")
        self._count += 1
        if self._count % ROD_STEPS:
            since = (self._count % ROD_STEPS) * h
            reeled = self.motors.position - self._reeled - since * self._reel_rate
            shortened = self._taken + since * self._rate + self._follows @ reeled
            stretch = np.maximum(self.motors.position - shortened, 0.0)
            self.tension = np.where(self.torn, 0.0, stretch / self._compliance)
            return
        # a torn tendon is one that its reel has let out by far
        self._stepper.step(np.where(self.torn, -0.2, self.motors.position))
        taken, reeled = self._straight - self._path(), self.motors.position.copy()
        self._rate = (taken - self._taken) * STEPS / ROD_STEPS
        self._reel_rate = (reeled - self._reeled) * STEPS / ROD_STEPS
        self._taken, self._reeled = taken, reeled
        self.tension = np.where(self.torn, 0.0, np.maximum(self._row("tension"), 0.0))

    def _row(self, name: str, node: int = 0, state: Any = None) -> Float[np.ndarray, " c"]:
        row = self._stepper.state if state is None else state
        return np.asarray(self.robot.y_layout.get(row.y[-1, node], name))

    def _path(self, state: Any = None) -> Float[np.ndarray, " c"]:
        """Return the length of each tendon from base to tip (m)."""
        return self._row("path", -1, state) - self._row("path", 0, state)

    def _response(self) -> Float[np.ndarray, "c c"]:
        """Return how much shorter each path becomes within a step if a reel takes in more (m/m)."""
        rod = Stepper(self.robot, ROD_STEPS / STEPS)
        for _ in range(20):
            rod.step(np.full(4, TAUT))
        taut = self._path(rod.preview(np.full(4, TAUT)))
        changed = [self._path(rod.preview(TAUT + 0.1 * TAUT * unit)) for unit in np.eye(4)]
        return (taut - np.array(changed).T) / (0.1 * TAUT)

    def true_state(self) -> Trajectory:
        """Return the state at the last step of the rod, a trajectory of one row."""
        return self._stepper.state


#: time between two exchanges of bytes of a pseudo-terminal (s)
EXCHANGE = 1.0 / 128.0


class EmulatedPort(Transport):
    """Port of an emulated robot in lock-step: reading moves the robot on, and its clock is the simulated one.

    The same program gives the same bits, whatever else the computer does.
    """

    real_time = False
    name = "emulated board"

    def __init__(self, robot: EmulatedRobot, damage: Callable[[bytes], bytes] | None = None):
        """Open the port, which resets the chip.

        Args:
            robot: the robot behind the port.
            damage: changes the bytes that the host sends, to try a bad cable.
        """
        self.robot, self._damage, self._is_open = robot, damage, True
        robot.chip.reset()

    def write(self, data: bytes) -> None:
        """Send bytes; they take their time on the wire."""
        self._check()
        self.robot.chip.send(data if self._damage is None else self._damage(data))

    def read(self, timeout: float) -> bytes:
        """Return the bytes that have arrived; moves the robot on until there are some, or by the timeout."""
        self._check()
        end = self.robot.time + timeout
        while not (data := self.robot.chip.received()) and self.robot.time < end:
            self.robot.step()
        return data

    def now(self) -> float:
        """Return the simulated time (s)."""
        return self.robot.time

    def advance(self, seconds: float) -> None:
        """Move the robot on by some time (s)."""
        self.robot.advance(seconds)

    def close(self) -> None:
        """Close the port."""
        self._is_open = False

    def _check(self) -> None:
        if not self._is_open:
            raise HardwareError("the emulated port is closed; open a new one with robot.port()")


class PseudoTerminal:
    """A pseudo-terminal before an emulated robot that moves in real time: any program can open `path`.

    with PseudoTerminal(robot) as terminal:
        SerialBoard(terminal.path, limits).connect()
    """

    def __init__(self, robot: EmulatedRobot):
        self.robot = robot
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        #: name of the terminal's device file
        self.path = os.ttyname(self._slave)
        #: error that ended the robot's motion, if any
        self.error: Exception | None = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="emulated robot", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop the robot and close the terminal."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()
        for descriptor in (self._master, self._slave):
            with contextlib.suppress(OSError):
                os.close(descriptor)

    def _run(self) -> None:
        due = time.monotonic()
        try:
            while not self._stop.is_set():
                self._exchange()
                self.robot.advance(EXCHANGE)
                due += EXCHANGE
                rest = due - time.monotonic()
                if rest > 0.0:
                    time.sleep(rest)
                else:
                    # a robot that is late does not hurry
                    due = time.monotonic()
        except Exception as error:
            self.error = error

    def _exchange(self) -> None:
        with contextlib.suppress(BlockingIOError):
            self.robot.chip.send(os.read(self._master, 4096))
        if data := self.robot.chip.received():
            # bytes that nobody reads are lost, as on a wire
            with contextlib.suppress(BlockingIOError):
                os.write(self._master, data)
