"""The commands under `robot`: options, consent, emergency stop, motion capture."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from knode_cosserat.cli.arguments import load_system
from knode_cosserat.cli.output import printable
from knode_cosserat.cli.program import command_group

if TYPE_CHECKING:
    from knode_cosserat.recordings import RecordingConfig
    from knode_cosserat_hardware.driver import Driver
    from knode_cosserat_hardware.middleware.mocap import MotionCapture
    from knode_cosserat_hardware.open_driver import OpenedDriver
    from knode_cosserat_hardware.safety import EmergencyStop
    from knode_cosserat_hardware.simulated import TrueShape

commands = command_group(
    help="Operate a real, emulated or simulated robot: connect, calibrate, record, control."
)

#: simulated robot, without --robot
ROBOT = "delrin-tendon-robot"

Port = Annotated[
    str,
    typer.Option(
        metavar="PORT",
        help="Serial port of a tension board (/dev/ttyACM0), simulated, emulated, "
        "'dynamixel:/dev/ttyUSB0?ids=1,2,3,4' or 'can:can0?ids=1,2,3,4'.",
    ),
]
RobotFile = Annotated[
    str | None,
    typer.Option(
        "--robot",
        metavar="FILE",
        help="Robot file with the tension limits of the hardware (section hardware); also the robot that is "
        "simulated.",
        show_default="limits of 15 N",
    ),
]
Yes = Annotated[bool, typer.Option("--yes", help="Move the robot without asking.")]
Capture = Annotated[
    str | None,
    typer.Option(
        metavar="SOURCE",
        help="Motion capture: 'natnet:SERVER?base=1,tip=2' (OptiTrack, identities of the bodies) or "
        "'vrpn:SERVER?base,tip'; without a base, its origin must be the clamped end.",
        show_default="the true tip of a simulated robot",
    ),
]


def has_terminal() -> bool:
    """Return True if a person can be asked."""
    return sys.stdin.isatty()


def require_consent(motion: str, yes: bool) -> None:
    """Ask before a motion.

    Raises:
        ValueError: nobody can be asked.
        typer.Abort: the person refused.
    """
    if yes:
        return
    if not has_terminal():
        raise ValueError(f"this moves the robot ({motion}); confirm it in a terminal, or give --yes")
    typer.echo(printable(f"This moves the robot: {motion}."), err=True)
    if not typer.confirm("Move it?", err=True):
        typer.echo("nothing was moved", err=True)
        raise typer.Abort


def opened(port: str, robot: str | None, simulated: Any = None) -> OpenedDriver:
    """Return the driver of a port with the limits of a robot file; nothing is opened yet.

    Args:
        port: the option --port.
        robot: the option --robot.
        simulated: robot that is simulated; None: that of --robot.
    """
    from knode_cosserat_hardware.description import HardwareDescription, load_hardware
    from knode_cosserat_hardware.open_driver import open_driver

    hardware = HardwareDescription() if robot is None else load_hardware(robot)

    def model() -> Any:
        return load_system(robot or ROBOT) if simulated is None else simulated

    return open_driver(port, hardware, model)


@contextlib.contextmanager
def connected(machine: OpenedDriver, yes: bool, motion: str = "") -> Iterator[Driver]:
    """Ask for consent, connect, and close at the end; an error stops the robot.

    Args:
        machine: the driver.
        yes: True if the person need not be asked.
        motion: what the command moves, beside what connecting moves.
    """
    moves = [each for each in (machine.connecting_moves, motion) if each]
    if moves:
        require_consent("; then ".join(moves), yes)
    driver = machine.driver
    if machine.connecting_moves:
        with emergency_stop(driver) as emergency, contextlib.ExitStack() as stack:
            stack.callback(driver.close)
            driver.connect()
            if machine.prepare is not None:
                machine.prepare(driver)
            emergency.check()
            stack.pop_all()
    with driver:
        yield driver


@contextlib.contextmanager
def emergency_stop(driver: Driver, **more: Any) -> Iterator[EmergencyStop]:
    """Announce and yield an emergency stop."""
    from knode_cosserat_hardware.safety import EmergencyStop

    with EmergencyStop(driver, **more) as emergency:
        keys = "space, Enter, q or Ctrl-C stops" if emergency.has_keys else "Ctrl-C or SIGTERM stops"
        typer.echo(f"{keys} the robot", err=True)
        yield emergency


@contextlib.contextmanager
def motion_capture(machine: OpenedDriver, source: str | None) -> Iterator[MotionCapture | None]:
    """Open motion capture by its word, and yield it; the true tip of a simulated robot, or None, without one.

    Raises:
        ValueError: the word is not understood.
        HardwareError: the source cannot be reached.
    """
    if source is None:
        yield None if machine.robot is None else _true_tip(machine, machine.robot)
        return
    kind, _, rest = source.partition(":")
    server, _, text = rest.partition("?")
    names = {name.strip(): value for name, _, value in (part.partition("=") for part in text.split(","))}
    known = {"natnet": all(value.isdigit() for value in names.values()), "vrpn": not any(names.values())}
    if not known.get(kind) or not server or not all(names):
        raise ValueError(
            f"--capture is {source!r}; allowed is natnet:SERVER?base=1,tip=2, with each body's streaming "
            "identity, or vrpn:SERVER?base,tip"
        )
    # recorders have the base first, and the tip is the last
    ordered = sorted(names, key=lambda name: name != "base")
    made: MotionCapture
    if kind == "natnet":
        from knode_cosserat_hardware.middleware.natnet import NatNet

        made = NatNet({name: int(names[name]) for name in ordered}, server, clock=machine.driver.now)
    else:
        from knode_cosserat_hardware.middleware.mocap import VRPN

        made = VRPN(ordered, server, clock=machine.driver.now)
    with made as capture:
        yield capture


def _true_tip(machine: OpenedDriver, robot: TrueShape) -> MotionCapture:
    """Return the source of a simulated robot's true tip."""
    from knode_cosserat_hardware.middleware.mocap import SimulatedCapture

    return SimulatedCapture(robot, recording_config(machine, ["tip"]), machine.driver.now)


def recording_config(machine: OpenedDriver, names: Sequence[str]) -> RecordingConfig:
    """Return the topics of a bag: tensions, commands, and bodies at even fractions of the length."""
    from knode_cosserat.recordings.config import (
        BaseSource,
        ControlSource,
        MarkerSource,
        RecordingConfig,
    )

    order = tuple(range(1, machine.driver.tendon_count + 1))
    # a configuration has one body or more: without motion capture its topic has no messages
    markers = [name for name in names if name != "base"] or ["tip"]
    is_simulated = machine.robot is not None
    rotation = (1.0, 0.0, 0.0, 0.0) if is_simulated else None
    return RecordingConfig(
        markers=tuple(
            MarkerSource(name, f"/{name}", (k + 1) / len(markers), rotation=rotation)
            for k, name in enumerate(markers)
        ),
        tension=ControlSource("/tension", order),
        command=ControlSource("/command", order),
        base=BaseSource("/base", machine.base_height) if "base" in names else None,
        simulated=is_simulated,
        description=f"recorded at {machine.name}",
    )


def tip_source(machine: OpenedDriver, capture: MotionCapture | None) -> Any:
    """Return a function with time (s) and position of the tip (m); None if it is not measured.

    The tip is the last body of motion capture. With a body named base, the position is relative to the
    clamped end below it; otherwise motion capture's origin must be at the clamped end.
    """
    if capture is None:
        return None
    above = np.array([0.0, 0.0, machine.base_height])

    def measured() -> Any:
        frame = capture.poses()
        origin = frame.position[0] - above if capture.names[0] == "base" else 0.0
        return frame.time, frame.position[-1] - origin

    return measured


def tendon_index(tendon: int, count: int) -> int:
    """Return the index of a tendon that is counted from 1. Raises `ValueError` if there is none."""
    if not 1 <= tendon <= count:
        raise ValueError(f"the tendon must be from 1 to {count} (got {tendon})")
    return tendon - 1
