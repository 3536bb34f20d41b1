"""Commands that move a robot's hardware for long: record, run (closed loop), steer (teleoperation)."""

from __future__ import annotations

import contextlib
import datetime
import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from knode_cosserat.cli.arguments import Json, load_system, parse_limits, require_writable
from knode_cosserat.cli.control import Method, parsed_reference
from knode_cosserat.cli.output import write_output
from knode_cosserat.cli.program import examples
from knode_cosserat.recordings.formats import written_suffixes
from knode_cosserat_hardware.cli.maintenance import tension_text
from knode_cosserat_hardware.cli.options import (
    Capture,
    Port,
    RobotFile,
    Yes,
    commands,
    connected,
    emergency_stop,
    motion_capture,
    opened,
    recording_config,
    tip_source,
)

if TYPE_CHECKING:
    from knode_cosserat_hardware.driver import Driver


@commands.command(
    epilog=examples(
        "robot record --port /dev/ttyACM0 --controls a.csv --out a.bag --capture 'vrpn:10.0.0.2?base,tip'",
        "robot record --port simulated --controls random:0 --seconds 20 --out run.bag --yes",
    )
)
def record(
    port: Port,
    controls: Annotated[
        str,
        typer.Option(
            metavar="CONTROLS",
            help="Tensions (N): a CSV table, sine:PERIOD, step:HEIGHT, random:SEED, constant numbers, or by "
            "name such as tension_4=ramp:2, the others zero.",
        ),
    ],
    out: Annotated[Path, typer.Option(metavar="FILE", help="Write this bag (.bag).")],
    seconds: Annotated[
        float | None, typer.Option(metavar="S", help="Duration (s).", show_default="of the table, or 10")
    ] = None,
    dt: Annotated[
        float | None,
        typer.Option(metavar="S", help="Time between commands (s).", show_default="of the table, or 0.05"),
    ] = None,
    capture: Capture = None,
    robot: RobotFile = None,
    yes: Yes = False,
    as_json: Json = False,
) -> None:
    """Move a robot through tensions, and record commands, readings and poses in a bag.

    Beside the bag its configuration is written (.yaml), for `identify` and `evaluate` with --config. If the
    robot stops, the bag has everything up to then.
    """
    require_writable(out)
    machine = opened(port, robot)
    count = machine.driver.tendon_count
    rows, dt = _tension_rows(controls, seconds, dt, count)
    motion = (
        f"{count} tendons follow {controls} for {len(rows) * dt:g} s, {float(rows.min()):.3g} to "
        f"{float(rows.max()):.3g} N (within {machine.driver.limits.high:g} N)"
    )
    from knode_cosserat_hardware.driver import HostClock
    from knode_cosserat_hardware.recorder import Recorder, record_robot

    with contextlib.ExitStack() as stack:
        poses = stack.enter_context(motion_capture(machine, capture))
        names = [] if poses is None else list(poses.names)
        config = recording_config(machine, names)
        driver = stack.enter_context(connected(machine, yes, motion))
        recorder = Recorder(out, config, clock=HostClock(machine.driver.now))
        config.save(out.with_suffix(".yaml"))
        reduced = 0
        try:
            with recorder, emergency_stop(driver) as emergency:
                driver.arm()
                begin = driver.now()
                for k, row in enumerate(rows):
                    emergency.check()
                    sent = driver.command(row)
                    recorder.add_command(sent)
                    reduced += bool(np.max(np.abs(sent - row)) > 0.02)
                    record_robot(recorder, driver, begin + (k + 1) * dt - driver.now(), poses)
                driver.disarm()
        except BaseException:
            if out.exists():
                typer.echo(f"kept {recorder.written} messages in {out}", err=True)
            raise
    facts = {
        "commands": len(rows),
        "reduced": reduced,
        "messages": recorder.written,
        "bodies": names,
        "config": str(out.with_suffix(".yaml")),
    }
    lines = [f"recorded {len(rows)} commands, {reduced} of them reduced by limits, and {len(names)} bodies"]
    if not names:
        lines.append("no motion capture: the bag has tensions only, and no model can be identified from it")
    write_output(as_json, facts, lines, out=out)


def _tension_rows(controls: str, seconds: float | None, dt: float | None, count: int) -> tuple[Any, float]:
    """Return tensions (N) in rows, and the time between them (s)."""
    import knode_cosserat as kc

    if os.path.isfile(controls):
        step = float(kc.controls.load(controls).dt) if dt is None else dt
        steps = None if seconds is None else round(seconds / step)
    else:
        step = 0.05 if dt is None else dt
        if not 0.0 < step <= 10.0:
            raise ValueError(f"--dt must be between 0 and 10 s (got {step:g})")
        steps = round((10.0 if seconds is None else seconds) / step)
    return np.asarray(kc.controls.parse(controls, steps, step, count)), step


@commands.command(
    epilog=examples(
        "robot run found.yaml --port /dev/ttyACM0 --robot my-robot.yaml --reference path.csv "
        "--capture 'natnet:10.0.0.2?base=1,tip=2' --radius 0.15 --out run.csv",
        "robot run delrin-tendon-robot --port simulated --reference circle:radius=0.05,period=4 --yes",
    )
)
def run(
    model: Annotated[str, typer.Argument(metavar="MODEL", help="Robot or model that predicts.")],
    port: Port,
    reference: Annotated[
        str,
        typer.Option(metavar="NAME|CSV", help="Wanted tip, as in `control`: circle:radius=0.05,period=4."),
    ],
    seconds: Annotated[float, typer.Option(metavar="S", help="Duration (s).")] = 10.0,
    dt: Annotated[float, typer.Option(metavar="S", help="Period of the control (s).")] = 0.05,
    method: Method = "predictive",
    high: Annotated[
        str | None,
        typer.Option(
            metavar="NUMBERS", help="Greatest tension (N).", show_default="the robot's, within its sum"
        ),
    ] = None,
    lag: Annotated[
        float, typer.Option(metavar="S", help="Time constant of the motors that the controller expects (s).")
    ] = 0.05,
    radius: Annotated[
        float | None,
        typer.Option(
            metavar="M", help="Stop if the tip is further from the axis (m).", show_default="not checked"
        ),
    ] = None,
    capture: Capture = None,
    robot: RobotFile = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Write one row a period to this CSV file.",
            show_default="after a fault: run-TIME.csv",
        ),
    ] = None,
    recording: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help=f"Write tip and controls as a recording: {', '.join(written_suffixes())}.",
        ),
    ] = None,
    yes: Yes = False,
    as_json: Json = False,
) -> None:
    """Close the loop around a robot: the tip follows a reference.

    The tip is measured by motion capture. The robot stops at a fault, outside --radius, and by the emergency
    stop; the log up to then is written.
    """
    for path in (out, recording):
        require_writable(path)
    from knode_cosserat import control as kcc
    from knode_cosserat_hardware.plant import HardwarePlant
    from knode_cosserat_hardware.safety import SafeRegion

    system = load_system(model)
    machine = opened(port, robot, None if robot else system)
    if system.control_layout.size != machine.driver.tendon_count:
        raise ValueError(
            f"{model} has {system.control_layout.size} controls and the robot {machine.driver.tendon_count} "
            "tendons; they must be equal"
        )
    if machine.robot is None and capture is None:
        raise ValueError("run needs the tip's position; give --capture natnet:SERVER?base=1,tip=2")
    limits = _control_limits(machine.driver, high, lag)
    wanted = parsed_reference(reference)
    controller = kcc.controller_named(method, system, dt, limits)
    motion = f"the tip follows {reference} for {seconds:g} s, tensions up to {np.max(limits.high):.3g} N"
    region = None if radius is None else SafeRegion(radius=radius)
    with motion_capture(machine, capture) as poses, connected(machine, yes, motion) as driver:
        with _kept_log(out), emergency_stop(driver) as emergency:
            source = tip_source(machine, poses)
            plant = HardwarePlant(
                driver, source, controller.dt, region=region, emergency=emergency, robot=system
            )
            log = kcc.run_loop(controller, plant, wanted, seconds)
            driver.disarm()
        latency = driver.latency
    if out is not None:
        log.to_csv(out)
    if recording is not None:
        log.measurements(simulated=machine.robot is not None).save(recording)
    facts = log.summary() | {
        "reduced": plant.reduced,
        "latency_ms": None if not latency.count else round(1e3 * latency.median, 3),
    }
    lines = [
        f"tip RMSE {facts['tip_rmse']:.3g} m over the second half; {facts['periods']} periods, "
        f"{facts['missed']} late, {facts['fallbacks']} without a solution, {plant.reduced} commands reduced"
    ]
    write_output(as_json, facts, lines, out=out)


def _control_limits(driver: Driver, high: str | None, lag: float) -> Any:
    from knode_cosserat.control import ControlLimits

    limits, count = driver.limits, driver.tendon_count
    most = (
        min(limits.high, limits.total / count)
        if high is None
        else parse_limits("--high", high, ["N"] * count)
    )
    if np.max(most) > limits.high:
        raise ValueError(f"--high is {high}; the robot allows {limits.high:g} N")
    return ControlLimits(limits.low, most, limits.rate, lag=lag)


@contextlib.contextmanager
def _kept_log(out: Path | None) -> Iterator[None]:
    """Write the log of a loop that an error ended."""
    from knode_cosserat.errors import KnodeCosseratError

    try:
        yield
    except (KnodeCosseratError, KeyboardInterrupt) as error:
        log = getattr(error, "log", None)
        if log is not None:
            path = out or Path(f"run-{datetime.datetime.now():%Y%m%d-%H%M%S}.csv")
            log.to_csv(path)
            typer.echo(f"kept {len(log.time)} periods in {path}", err=True)
        raise


@commands.command(
    epilog=examples(
        "robot steer --port /dev/ttyACM0 --device /dev/input/js0",
        "robot steer --port 'simulated?real_time=1' --device sliders",
    )
)
def steer(
    port: Port,
    device: Annotated[
        str,
        typer.Option(
            metavar="DEVICE",
            help="Gamepad (/dev/input/js0), keyboard (arrows, + and -), or sliders: a window with one for "
            "each tendon.",
        ),
    ] = "keyboard",
    seconds: Annotated[
        float | None, typer.Option(metavar="S", help="Duration (s).", show_default="until the stop")
    ] = None,
    high: Annotated[
        float | None,
        typer.Option(metavar="N", help="Greatest tension (N).", show_default="the robot's, within its sum"),
    ] = None,
    robot: RobotFile = None,
    yes: Yes = False,
    as_json: Json = False,
) -> None:
    """Steer a robot by a gamepad, by the arrow keys, or by sliders.

    Gamepad and keys bend in two directions, and co-contract. Sliders set each tension, in a window with a
    button that stops; without a display the keys are used.
    """
    from dataclasses import replace

    from knode_cosserat_hardware.teleoperation import TensionMap, teleoperate

    machine = opened(port, robot)
    driver = machine.driver
    mapping = TensionMap.of(driver.limits, driver.tendon_count)
    if high is not None:
        mapping = replace(mapping, high=min(high, mapping.high))
    inputs = _input_device(device, mapping, driver.tendon_count, machine.name)
    window = inputs if device == "sliders" and hasattr(inputs, "show") else None
    others = getattr(inputs, "press", None)
    last: list[Any] = [np.zeros(driver.tendon_count)]

    def shown(wish: Any, sent: Any, reading: Any) -> None:
        last[0] = sent
        if window is not None:
            window.show(wish, sent, reading)

    with contextlib.closing(inputs):
        motion = f"the rod bends by {device}, tensions up to {mapping.high:.3g} N"
        with connected(machine, yes, motion), emergency_stop(driver, other_keys=others) as emergency:
            if others is not None and not emergency.has_keys:
                raise ValueError("the keyboard needs a terminal; give --device /dev/input/js0 for a gamepad")
            count = teleoperate(
                driver,
                inputs,
                mapping if window is None else None,
                emergency,
                seconds=float("inf") if seconds is None else seconds,
                shown=shown,
            )
    facts = {"commands": count, "tension": [round(float(value), 4) for value in last[0]]}
    write_output(as_json, facts, [f"{count} commands; the last tensions were {tension_text(last[0])}"])


def _input_device(device: str, mapping: Any, tendons: int, title: str) -> Any:
    """Return gamepad, keyboard or window of sliders; the keyboard, with a line, if there is no display."""
    from knode_cosserat_hardware.driver import HardwareError
    from knode_cosserat_hardware.teleoperation import Gamepad, Keyboard, SliderWindow

    if device == "sliders":
        try:
            return SliderWindow(tendons, mapping.low, mapping.high, f"knode-cosserat: {title}")
        except HardwareError as error:
            typer.echo(f"{error}; steering by keys: arrows, + and -", err=True)
            return Keyboard()
    return Keyboard() if device == "keyboard" else Gamepad(device)
