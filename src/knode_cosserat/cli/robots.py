"""Commands on robots and models: simulate, equilibrium, info."""

from __future__ import annotations

import os
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from knode_cosserat.cli.arguments import (
    ROBOT,
    Changes,
    Json,
    NetCDF,
    Nodes,
    Picture,
    Progress,
    Robot,
    Space,
    figures,
    require_writable,
    system_of,
    wanted,
)
from knode_cosserat.cli.facts import (
    at_rest,
    derived,
    driven_by,
    error_text,
    learned,
    more_lines,
    outcome,
    parameters,
)
from knode_cosserat.cli.program import app, examples
from knode_cosserat.cli.telling import shown, table, tell, vector

if TYPE_CHECKING:
    from knode_cosserat.rods.system import System

COARSE = (
    "COARSE GRID: the estimated position error is more than 2 % of the length; "
    "give more --nodes, or --space lobatto4"
)


@app.command(
    epilog=examples(
        "simulate delrin-tendon-robot --controls sine:1.5 --steps 100 --out truth.nc",
        "simulate delrin-tendon-robot --controls step:1.5,at=2 --steps 200 --dt 0.02 --out step.nc",
        "simulate my-robot.yaml --controls tensions.csv --set youngs_modulus=10e9 --out stiff.nc",
        "simulate my-rod.yaml --controls 'base_z=ramp:0.1;base_rx=sine:2' --steps 100 --out pushed.nc",
        "simulate my-robot.yaml --controls random:0 --steps 100 --out r.nc --figure r.png --json",
    )
)
def simulate(
    robot: Robot,
    controls: Annotated[
        str,
        typer.Option(
            metavar="CONTROLS",
            help="sine:PERIOD, step:HEIGHT, ramp:HEIGHT, random:SEED, constant:TENSION or a CSV file; "
            "of a robot that is driven otherwise NAME=SIGNAL;…, such as base_z=ramp:0.1, or none.",
        ),
    ],
    out: Annotated[Path, NetCDF],
    steps: Annotated[
        int | None, typer.Option(metavar="N", help="Time steps.", show_default="as many as a file has")
    ] = None,
    dt: Annotated[
        float | None, typer.Option(metavar="S", help="Time step in s.", show_default="0.05, or a file's own")
    ] = None,
    time: Annotated[
        str, typer.Option(metavar="SCHEME", help="Scheme in time: bdf1, bdf2, bdf-alpha or trapezoidal.")
    ] = "bdf2",
    space: Space = "lobatto2",
    changes: Changes = None,
    nodes: Nodes = None,
    allow_failure: Annotated[
        bool, typer.Option("--allow-failure", help="Write what was solved even if a step has no solution.")
    ] = False,
    figure: Annotated[Path | None, Picture] = None,
    progress: Progress = None,
    as_json: Json = False,
) -> None:
    """Simulate a robot under tendon tensions, or whatever drives it."""
    require_writable(out, figure)
    drawing = figures() if figure else None
    import knode_cosserat as kc

    system = system_of(robot, changes, nodes)
    if dt is None:
        tensions_only = system.control_layout.names == ("tension",)
        dt = kc.controls.load(controls).dt if os.path.isfile(controls) and tensions_only else 0.05
    tensions = kc.named_controls.parse(system, controls, steps, dt)
    began = perf_counter()
    trajectory = kc.simulate(
        system, tensions, dt, time=time, space=space, progress=wanted(progress),
        on_failure="return" if allow_failure else "raise",
    )  # fmt: skip
    seconds = perf_counter() - began
    trajectory.save(out)
    if drawing:
        drawing.overview(trajectory).savefig(figure)
    came = outcome(trajectory)
    error = error_text(came["largest_position_error"], float(system.length))
    facts = {"robot": robot, "steps": len(tensions), "dt": dt, "computing_time": round(seconds, 4), **came}
    results = ", ".join(f"{count} {result}" for result, count in came["results"].items())
    lines = [
        f"simulated {robot}: {len(tensions)} steps of {dt:g} s in {seconds:.2f} s of computing",
        f"steps: {results}; largest residual {came['largest_residual']:.1e} of its natural scale",
        f"largest position error, by estimate: {error}",
        f"tip after the last step that was solved: {vector(came['tip_position'])} m",
    ]
    if kc.Result.COARSE in np.asarray(trajectory.result):
        lines.append(COARSE)
    if trajectory.extrapolation:
        lines.append(f"EXTRAPOLATION: {trajectory.extrapolation}")
    if came["first_failure"]:
        step, at, message = came["first_failure"].values()
        lines.append(f"NOT SOLVED from step {step} (t = {at:g} s) on: {message}")
    tell(as_json, facts, lines, out=out, figure=figure)


@app.command(epilog=examples("equilibrium delrin-tendon-robot --tension 7,5,5,7"))
def equilibrium(
    robot: Robot,
    tension: Annotated[
        str | None, typer.Option(metavar="N,N,…", help="Tension of every tendon in N, such as 7,5,5,7.")
    ] = None,
    control: Annotated[
        str | None,
        typer.Option(metavar="NAME=VALUE,…", help="Controls by name, such as base_z=0.1; others are zero."),
    ] = None,
    space: Space = "lobatto2",
    changes: Changes = None,
    nodes: Nodes = None,
    out: Annotated[Path | None, NetCDF] = None,
    as_json: Json = False,
) -> None:
    """Find a robot's shape at rest under a constant control."""
    require_writable(out)
    import knode_cosserat as kc

    system = system_of(robot, changes, nodes)
    rest = kc.equilibrium(system, _control(system, tension, control), space=space)
    if out:
        rest.save(out)
    facts = {"robot": robot, **at_rest(rest), "unstable": _unstable(rest, space)}
    lines = [
        f"tip: {vector(facts['tip_position'])} m",
        f"the tip leans {np.degrees(facts['tip_inclination']):.2f} degrees from the z axis",
        f"residual {facts['residual']:.1e} of its natural scale; largest position error, by estimate: "
        f"{error_text(facts['position_error'], float(system.length))}",
    ]
    if "base_force" in facts:
        lines.append(f"internal force at the base: {vector(facts['base_force'])} N")
        lines.append(f"internal moment at the base: {vector(facts['base_moment'])} N m")
    if facts["unstable"]:
        lines.append("UNSTABLE: the least push, and the robot leaves this shape")
    if rest.extrapolation:
        lines.append("EXTRAPOLATION: the model was not trained under such controls or strains")
    if rest.result[0] == kc.Result.COARSE:
        lines.append(COARSE)
    elif facts["result"] != "converged":
        lines.append(f"found on a detour: {facts['result']}")
    tell(as_json, facts, lines, out=out)


@app.command(epilog=examples("info", "info delrin-tendon-robot --set length=0.4", "info model"))
def info(
    robot: Annotated[
        str | None, typer.Argument(metavar="[ROBOT]", help=f"{ROBOT} Without: list the catalog.")
    ] = None,
    changes: Changes = None,
    nodes: Nodes = None,
    as_json: Json = False,
) -> None:
    """Show a robot's parameters, its controls and what a model learned, or list the catalog."""
    import knode_cosserat as kc

    robots = kc.catalog()
    if robot is None:
        if changes or nodes:
            raise ValueError("--set and --nodes change a robot: name it")
        tell(as_json, {"catalog": robots}, table(list(robots.items())))
        return
    system = system_of(robot, changes, nodes)
    parts = {"parameters": parameters(system), "derived": derived(system)}
    rows = []
    for title, quantities in parts.items():
        rows += [[""] * 4, [title, "", "", ""]]
        rows += [
            [f"  {name}", shown(it["value"]), it["unit"], it["meaning"]] for name, it in quantities.items()
        ]
    drives = driven_by(system)
    rows += [[""] * 4, ["controls", "", "", ""]]
    rows += [[f"  {name}", "", it["unit"], it["meaning"]] for name, it in drives.items()]
    if not drives:
        rows.append(["  none", "", "", "nothing drives it"])
    more = more_lines(system)
    heading = f"{robot}: {robots[robot]}" if robot in robots else robot
    facts, lines = learned(system)
    tell(
        as_json,
        {"robot": robot, "kind": type(system).__name__, **parts, "controls": drives, "parts": more, **facts},
        [heading, *table(rows), *(["", "parts", *more] if more else []), *(["", *lines] if lines else [])],
    )


@app.command(epilog=examples("schema > robot.schema.json"))
def schema(
    as_json: Annotated[bool, typer.Option("--json", help="Print it on one line.")] = False,
) -> None:
    """Print the JSON Schema of robot files, by which editors complete and check them."""
    import json

    import knode_cosserat as kc

    typer.echo(json.dumps(kc.robots.robot_schema(), indent=None if as_json else 2, ensure_ascii=False))


def _unstable(rest: Any, space: str) -> bool | None:
    """True if an equilibrium is unstable, by its energy or else the tip's compliance; None if unknown."""
    import knode_cosserat as kc

    try:
        return not kc.statics.stability(rest).stable
    except ValueError:
        # on reels, or no rod
        if not {"n", "m"} <= set(rest.system.tip_layout.names):
            return None
        return bool(kc.statics.configuration(rest.system, rest.control[0], space=space).unstable)


def _control(system: System, tension: str | None, control: str | None) -> Any:
    """Return the constant control: tensions, or controls by name."""
    from knode_cosserat import named_controls

    tensions = [field.size for field in system.control_layout.fields if field.name == "tension"]
    if tension is None and control is None and system.control_size:
        names = ", ".join(named_controls.labels(system.control_layout))
        raise ValueError(f"no control is given: --tension N,N,… or --control NAME=VALUE,…; there are {names}")
    if tension is not None and not tensions:
        raise ValueError("--tension: the robot is not driven by tensions; give --control NAME=VALUE,…")
    words = [] if control is None else [f"{name}=constant:{value}" for name, _, value in (
        each.partition("=") for each in control.split(","))]  # fmt: skip
    if tension is not None:
        called = named_controls.labels(system.control_layout)[system.control_layout.slice("tension")]
        values = zip(called, _tensions(tension, tensions[0]), strict=True)
        # first, so that a tension that --control gives too is refused
        words = [f"{name}=constant:{value!r}" for name, value in values] + words
    return named_controls.parse_signals(system.control_layout, words, np.ones(1))[0]


def _tensions(text: str, count: int) -> list[float]:
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count or not all(0.0 <= value < np.inf for value in values):
        raise ValueError(f"--tension {text!r}: allowed is {count} numbers, 0 or more (N), such as 7,5,5,7")
    return values
