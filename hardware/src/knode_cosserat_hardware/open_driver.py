"""Drivers by a word, such as "/dev/ttyACM0" or "dynamixel:/dev/ttyUSB0?ids=1,2", as on the command line."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from knode_cosserat._files.yaml_text import did_you_mean
from knode_cosserat._numbers import numbers_in
from knode_cosserat.rods.system import System
from knode_cosserat.rods.tendon_robots import RoutedTendonRobot
from knode_cosserat_hardware.description import HardwareDescription
from knode_cosserat_hardware.driver import Driver, HardwareError, Limits
from knode_cosserat_hardware.motor_robot import MotorReel

if TYPE_CHECKING:
    from knode_cosserat_hardware.simulated import TrueShape

#: words before the address, and options of each
KINDS: dict[str, tuple[str, ...]] = {
    "simulated": ("real_time", "noise", "fault", "after"), "emulated": (), "serial": ("protocol",),
    "dynamixel": ("ids", "baud", "torque_constant", "directions"),
    "can": ("ids", "bitrate", "interface", "gear_ratio", "torque_constant", "directions"),
}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class OpenedDriver:
    """A driver that is not connected yet, and functions of the robot behind it.

    Attributes:
        driver: the driver.
        name: name for messages and reports.
        connecting_moves: what moves when the driver connects; empty if nothing does.
        robot: the simulated or emulated robot, whose true shape is known; None for a real one.
        prepare: called with the driver after it has connected; None: nothing is to do.
        base_height: height of the base's motion-capture body above the rod's clamped end (m).
    """

    driver: Driver
    name: str
    connecting_moves: str = ""
    robot: TrueShape | None = None
    prepare: Callable[[Driver], Any] | None = None
    base_height: float = 0.0


def open_driver(port: str, hardware: HardwareDescription, robot: Callable[[], System]) -> OpenedDriver:
    """Return a driver by a word; nothing is opened before `connect`.

    The words: a serial port of a tension board ("/dev/ttyACM0", "COM3", "serial:/dev/ttyACM0?protocol=1"),
    "simulated" ("simulated?real_time=1,fault=slack:2,after=1"), "emulated",
    "dynamixel:/dev/ttyUSB0?ids=1,2,3,4" or "can:can0?ids=1,2,3,4".

    Args:
        port: the word.
        hardware: limits of commanded tensions, and radius of the reels.
        robot: returns the robot that is simulated; called for simulated ports only.

    Raises:
        HardwareError: the word is not understood, or a package or the emulator is not installed.
    """
    head, _, text = port.partition("?")
    kind, colon, address = head.partition(":")
    if kind not in KINDS or (not colon and kind not in ("simulated", "emulated")):
        kind, address = "serial", head
    if not address and kind not in ("simulated", "emulated"):
        raise HardwareError(f"--port {port!r} has no address; write {kind}:/dev/ttyUSB0, for example")
    if kind == "serial" and ("/" not in address and not address.upper().startswith("COM")):
        raise HardwareError(
            f"--port is {port!r}; allowed is a serial port such as /dev/ttyACM0, simulated, emulated, "
            f"dynamixel:PORT?ids=1,2 or can:CHANNEL?ids=1,2{did_you_mean(address, list(KINDS))}"
        )
    options = _options(port, text, KINDS[kind])
    limits, base_height = hardware.tension, hardware.dimensions.base_height
    match kind:
        case "simulated":
            from knode_cosserat_hardware.simulated import MachineParameters, SimulatedRobot

            machine = MachineParameters(noise=_number(options, "noise", MachineParameters.noise))
            is_real_time = bool(_number(options, "real_time", 0.0))
            simulated = SimulatedRobot(robot(), limits, machine=machine, real_time=is_real_time)
            if "fault" in options:
                simulated.inject(options["fault"], after=max(_number(options, "after", 1.0), 1e-6))
            opened = OpenedDriver(simulated, "simulated", robot=simulated)
        case "emulated":
            opened = _emulated(limits, robot())
        case "serial":
            from knode_cosserat_hardware.serial_board import SerialBoard

            board = SerialBoard(address, limits, protocol=int(_number(options, "protocol", 2.0)))
            moves = "opening the port resets the board, and the board tares: all reels move in and out"
            opened = OpenedDriver(board, address, moves)
        case "dynamixel":
            from knode_cosserat_hardware.dynamixel import DynamixelRobot

            ids, reel, baud = _ids(options), _reel(options, hardware), int(_number(options, "baud", 1e6))
            driver: Driver = DynamixelRobot(address, ids, limits, reel, baud=baud)
            opened = OpenedDriver(driver, f"dynamixel:{address}")
        case _:
            from knode_cosserat_hardware.can_robot import CanRobot

            driver = CanRobot(
                address,
                _ids(options),
                limits,
                _reel(options, hardware),
                interface=options.get("interface", "socketcan"),
                gear_ratio=_number(options, "gear_ratio", 1.0),
                bitrate=int(_number(options, "bitrate", 1e6)),
            )
            opened = OpenedDriver(driver, f"can:{address}")
    return dataclasses.replace(opened, base_height=base_height)


def _options(port: str, text: str, known: tuple[str, ...]) -> dict[str, str]:
    """Return options from `a=1,2&b=3` or `a=1,b=3`: a part without "=" belongs to the one before it."""
    found: dict[str, str] = {}
    name = ""
    for part in text.replace("&", ",").split(",") if text else ():
        key, equals, value = part.partition("=")
        if equals:
            name = key.strip()
            if name not in known:
                raise HardwareError(
                    f"--port {port!r}: the option {name!r} is unknown; allowed is "
                    f"{', '.join(known) or 'none'}"
                )
            found[name] = value.strip()
        elif name:
            found[name] += f",{part.strip()}"
        else:
            raise HardwareError(f"--port {port!r}: options must be NAME=VALUE (got {part!r})")
    return found


def _number(options: dict[str, str], name: str, default: float) -> float:
    numbers = numbers_in(options[name]) if name in options else [default]
    if numbers is None or len(numbers) != 1:
        raise HardwareError(f"the option {name} of --port must be a number (got {options[name]!r})")
    return float(numbers[0])


def _ids(options: dict[str, str]) -> list[int]:
    numbers = numbers_in(options.get("ids", ""))
    if not numbers or any(number != int(number) for number in numbers):
        raise HardwareError("--port needs the motors' identities in the tendons' order, such as ?ids=1,2,3,4")
    return [int(number) for number in numbers]


def _emulated(limits: Limits, robot: System) -> OpenedDriver:
    try:
        from knode_cosserat_hardware.emulation import EmulatedPort, EmulatedRobot
        from knode_cosserat_hardware.serial_board import SerialBoard
    except ImportError as error:
        raise HardwareError(f"the emulated robot is not available here ({error})") from None
    emulated = EmulatedRobot(robot) if isinstance(robot, RoutedTendonRobot) else EmulatedRobot()
    return OpenedDriver(
        SerialBoard(EmulatedPort(emulated), limits),
        "emulated",
        "the emulated board tares: all reels move in and out",
        emulated,
        _accept_settings,
    )


def _accept_settings(driver: Driver) -> None:
    """Accept the program's settings on a board whose EEPROM is empty, as an emulated one always is; tare."""
    if driver.read().fault.startswith("settings"):
        driver.reset()
        driver.tare()


def _reel(options: dict[str, str], hardware: HardwareDescription) -> MotorReel:
    """Return the motors and reels of a port's options; the reels' radius is that of the robot file."""
    directions = numbers_in(options.get("directions", "1")) or [0.0]
    return MotorReel(
        radius=hardware.dimensions.spool_radius,
        torque_constant=_number(options, "torque_constant", MotorReel.torque_constant),
        directions=tuple(int(direction) for direction in directions),
    )
