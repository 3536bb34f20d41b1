"""Commands of a robot's hardware: connect, tare, jog, calibrate, commission."""

from __future__ import annotations

import getpass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from knode_cosserat._files.csv_rows import size_excess
from knode_cosserat.cli.arguments import Json, figures, parse_numbers, require_writable
from knode_cosserat.cli.output import write_output
from knode_cosserat.cli.program import examples
from knode_cosserat_hardware.cli.options import (
    Port,
    RobotFile,
    Yes,
    commands,
    connected,
    emergency_stop,
    has_terminal,
    opened,
    require_consent,
    tendon_index,
)

if TYPE_CHECKING:
    from knode_cosserat_hardware.driver import Driver, Reading

#: standard gravity (m/s²): weights are given by their masses
GRAVITY = 9.80665
#: number of readings whose mean is a point of a calibration
READINGS = 25


def reading_facts(reading: Reading) -> dict[str, Any]:
    """Return a reading as plain values."""
    return {
        "state": reading.state.value,
        "fault": reading.fault,
        "tension": [round(float(value), 4) for value in reading.tension],
    }


def tension_text(values: Any) -> str:
    """Return tensions (N) as text."""
    return " ".join(f"{float(value):.2f}" for value in values) + " N"


@commands.command(
    epilog=examples("robot connect --port /dev/ttyACM0", "robot connect --port simulated --json")
)
def connect(port: Port, robot: RobotFile = None, yes: Yes = False, as_json: Json = False) -> None:
    """Connect to a robot, and show its state, tensions and limits.

    Opening the serial port of a tension board resets it: the board tares, and its reels move.
    """
    machine = opened(port, robot)
    from knode_cosserat_hardware.driver import fault_message

    with connected(machine, yes) as driver:
        reading, limits = driver.read(), driver.limits
        facts = {
            "port": machine.name,
            "tendons": driver.tendon_count,
            **reading_facts(reading),
            "limits": {"low": limits.low, "high": limits.high, "rate": limits.rate, "total": limits.total},
        }
    lines = [
        f"{machine.name}: {reading.state.value}",
        *(
            [fault_message(reading.fault).replace("reset()", "knode-cosserat robot reset")]
            * bool(reading.fault)
        ),
        f"tensions {tension_text(reading.tension)}",
        f"limits {limits.low:g} to {limits.high:g} N, {limits.rate:g} N/s, {limits.total:g} N in total",
    ]
    write_output(as_json, facts, lines)


@commands.command(
    epilog=examples("robot reset --port /dev/ttyACM0", "robot reset --port /dev/ttyACM0 --no-estop --save")
)
def reset(
    port: Port,
    save: Annotated[
        bool, typer.Option("--save", help="Keep the board's settings and zeros in its EEPROM.")
    ] = False,
    estop: Annotated[
        bool | None,
        typer.Option(
            "--estop/--no-estop",
            help="Watch the contact of the emergency stop, or not: none is wired.",
            show_default="as it is",
        ),
    ] = None,
    robot: RobotFile = None,
    yes: Yes = False,
    as_json: Json = False,
) -> None:
    """Clear a latched fault, and show its meaning. Remove its cause first.

    The fault `settings` of a new board is cleared too: its program's settings are used. --save keeps them.
    """
    from knode_cosserat_hardware.driver import fault_message

    machine = opened(port, robot)
    with connected(machine, yes) as driver:
        fault = driver.read().fault
        board: Any = driver
        if (save or estop is not None) and not hasattr(driver, "save_settings"):
            raise ValueError(f"{machine.name} has no settings; leave out --save, --estop and --no-estop")
        if estop is not None:
            board.set_setting("estop", int(estop))
        driver.reset()
        if save:
            board.save_settings()
        reading = driver.read()
    meaning = fault_message(fault).partition("; then reset()")[0] if fault else "there was no fault"
    write_output(
        as_json, {"cleared": fault, **reading_facts(reading)}, [meaning, f"now {reading.state.value}"]
    )


@commands.command(epilog=examples("robot tare --port /dev/ttyACM0"))
def tare(port: Port, robot: RobotFile = None, yes: Yes = False, as_json: Json = False) -> None:
    """Tare the load cells: each tendon is tightened, released, and read as zero."""
    machine = opened(port, robot)
    with connected(machine, yes, "all reels move in and out until the tendons are slack") as driver:
        with emergency_stop(driver) as emergency:
            driver.tare()
            emergency.check()
        reading = driver.read()
    write_output(as_json, reading_facts(reading), [f"tensions after tare {tension_text(reading.tension)}"])


@commands.command(epilog=examples("robot jog 1 --port /dev/ttyACM0 --drive 0.2 --times 3"))
def jog(
    tendon: Annotated[int, typer.Argument(metavar="TENDON", help="Tendon, counted from 1.")],
    port: Port,
    drive: Annotated[
        float, typer.Option(metavar="PART", help="Drive of the motor, from -1 (out) to 1 (in).")
    ] = 0.2,
    times: Annotated[int, typer.Option(metavar="N", min=1, max=100, help="Number of jogs of 0.1 s.")] = 1,
    robot: RobotFile = None,
    yes: Yes = False,
    as_json: Json = False,
) -> None:
    """Drive one motor for a tenth of a second, some times, and show the change of all tensions."""
    machine = opened(port, robot)
    index = tendon_index(tendon, machine.driver.tendon_count)
    if not 0.0 < abs(drive) <= 1.0:
        raise ValueError(f"--drive must be from -1 to 1, and not 0 (got {drive:g})")
    way = "in" if drive > 0.0 else "out"
    with connected(machine, yes, f"motor {tendon} reels {way} for {0.1 * times:g} s") as driver:
        before = _mean(driver, 10)
        with emergency_stop(driver) as emergency:
            for _ in range(times):
                emergency.check()
                driver.jog(index, drive)
                driver.read()
        after = _mean(driver, 10)
    change = [round(float(value), 4) for value in after - before]
    facts = {"tendon": tendon, "drive": drive, "times": times, "change": change}
    write_output(as_json, facts, [f"change of the tensions {tension_text(change)}"])


def _mean(driver: Driver, count: int) -> Any:
    return np.mean([driver.read().tension for _ in range(count)], axis=0)


@commands.command(
    epilog=examples(
        "robot calibrate 1 --port /dev/ttyACM0 --masses 0,0.2,0.5,1,0.5,0.2,0 --figure cell1.png",
        "robot calibrate 1 --table weights.csv",
    )
)
def calibrate(
    tendon: Annotated[int, typer.Argument(metavar="TENDON", help="Tendon, counted from 1.")],
    port: Annotated[
        str | None, typer.Option(metavar="PORT", help="Port of the robot, as in `robot connect`.")
    ] = None,
    masses: Annotated[
        str,
        typer.Option(metavar="NUMBERS", help="Masses (kg) that are hung on the tendon, in this order."),
    ] = "0,0.2,0.5,1,0.5,0.2,0",
    table: Annotated[
        Path | None,
        typer.Option(metavar="CSV", help="Use this table with the columns mass (kg) and reading instead."),
    ] = None,
    figure: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Draw readings, line and residuals into this file.")
    ] = None,
    save: Annotated[
        bool, typer.Option("--save", help="Write gain and zero to the board, and keep them there.")
    ] = False,
    robot: RobotFile = None,
    yes: Yes = False,
    as_json: Json = False,
) -> None:
    """Calibrate a load cell by weights hung on its tendon.

    Reports gain, offset, their standard errors, non-linearity and hysteresis. Motors hold still meanwhile.
    """
    require_writable(figure=figure)
    if (port is None) == (table is None):
        raise ValueError("give either --port, to hang weights on a robot, or --table")
    changed: dict[str, int] = {}
    if table is not None:
        from knode_cosserat_hardware.calibration import fit_load_cell

        fit = fit_load_cell(*_columns(table))
    else:
        assert port is not None
        machine = opened(port, robot)
        index = tendon_index(tendon, machine.driver.tendon_count)
        if machine.robot is None and not has_terminal():
            raise ValueError("calibrate needs a terminal: a person hangs the weights (or give --table)")
        with connected(machine, yes) as driver:
            weights = [
                GRAVITY * mass for mass in parse_numbers("--masses", masses, example="0,0.5,1", unit="kg")
            ]
            fit = _weighed(driver, index, weights)
            if save:
                from knode_cosserat_hardware.calibration import write_calibration

                board: Any = driver
                changed = write_calibration(driver, index, fit)
                board.save_settings()
    if figure is not None:
        figures()
        from knode_cosserat_hardware.figures import load_cell

        load_cell(fit).savefig(figure)
    lines = [repr(fit), *(f"warning: {each}" for each in fit.warnings)]
    lines += [f"{name} is now {value}" for name, value in changed.items()]
    write_output(as_json, {"tendon": tendon} | fit.summary() | {"settings": changed}, lines, figure=figure)


def _weighed(driver: Driver, index: int, weights: list[float]) -> Any:
    """Return the fit of readings under weights (N), each hung by a person or by the simulation."""
    from knode_cosserat_hardware.calibration import fit_load_cell
    from knode_cosserat_hardware.driver import HardwareError, fault_message

    hang: Any = getattr(driver, "hang", None)
    readings = []
    for weight in weights:
        if hang is not None:
            hang(index, weight)
        else:
            typer.prompt(
                f"Hang {weight / GRAVITY:g} kg on tendon {index + 1}, wait until it is still, press Enter",
                default="",
                show_default=False,
                prompt_suffix=" ",
                err=True,
            )
        driver.wait(0.1)
        readings.append(float(_mean(driver, READINGS)[index]))
        if fault := driver.read().fault:
            raise HardwareError(f"while weighing {weight / GRAVITY:g} kg: {fault_message(fault)}")
    return fit_load_cell(weights, readings)


def _columns(path: Path) -> tuple[Any, Any]:
    """Return weights (N) and readings of a CSV table with the columns mass and reading."""
    import pandas as pd  # type: ignore[import-untyped]

    if reason := size_excess(path):
        raise ValueError(f"{path}: {reason}")
    try:
        rows = pd.read_csv(path)
    except (pd.errors.ParserError, pd.errors.EmptyDataError, UnicodeDecodeError):
        raise ValueError(f"{path}: not a CSV table; required are the columns mass (kg) and reading") from None
    for name in ("mass", "reading"):
        if name not in rows:
            raise ValueError(f"{path} has no column {name}; required are mass (kg) and reading")
    return GRAVITY * rows["mass"].to_numpy(dtype=float), rows["reading"].to_numpy(dtype=float)


@commands.command(
    epilog=examples("robot commission --port /dev/ttyACM0 --robot my-robot.yaml --report report.json")
)
def commission(
    port: Port,
    report: Annotated[
        Path, typer.Option(metavar="FILE", help="Report (.json); an unfinished one is resumed.")
    ],
    person: Annotated[
        str | None, typer.Option(metavar="NAME", help="Person in charge.", show_default="user name")
    ] = None,
    robot: RobotFile = None,
    yes: Yes = False,
    as_json: Json = False,
) -> None:
    """Commission a robot: a checklist for a person, and measured checks, with a report.

    Each motion is described and asked for. With --yes nothing is asked: what a person has to confirm stays
    not confirmed, and the report is not complete.
    """
    require_writable(report)
    from knode_cosserat_hardware.commissioning import Commissioning, Person

    def consent(motion: str) -> bool:
        try:
            require_consent(motion, yes)
        except typer.Abort:
            return False
        return True

    def confirm(statement: str) -> bool | None:
        return None if yes else typer.confirm(f"{statement} Is this so?", err=True)

    machine = opened(port, robot)
    if not (yes or has_terminal()):
        raise ValueError("commission asks questions in a terminal; there is none (or give --yes)")
    lines: list[str] = []

    def show(step: Any, found: dict[str, Any]) -> None:
        reason = f": {found['reason']}" if found.get("reason") else ""
        typer.echo(f"{step.name}: {found['result']}{reason}", err=True)

    with connected(machine, yes) as driver:
        who = Person(person or getpass.getuser(), confirm, consent)
        work = Commissioning(driver, report, machine.name, who)
        found = work.run(show)
    failed = [step["name"] for step in found["steps"] if step["result"] == "failed"]
    lines.append("complete" if found["complete"] else "not complete")
    write_output(as_json, found, lines, report=report)
    if failed:
        raise typer.Exit(1)
