"""Commands on robots and models: simulate, equilibrium, info, schema."""

from __future__ import annotations

import os
import re
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import numpy as np
import typer

from knode_cosserat._numbers import numbers_in
from knode_cosserat.cli import summaries
from knode_cosserat.cli.arguments import (
    ROBOT,
    Changes,
    Json,
    Model,
    NetCDF,
    Nodes,
    Picture,
    Report,
    Space,
    coarse_grid_in_output,
    figures,
    load_ensemble_folder,
    load_system,
    parse_numbers,
    require_trajectory_name,
    require_writable,
)
from knode_cosserat.cli.output import table, value_text, vector_text, write_output
from knode_cosserat.cli.program import app

if TYPE_CHECKING:
    from knode_cosserat.rods.system import System

COARSE = (
    "COARSE GRID: the estimated error is above 2 % of the length or 0.1 rad, or there is no estimate; "
    "use more --nodes, or --space lobatto4"
)


class _SimulationOptions(NamedTuple):
    """Controls and numerical settings of a simulation.

    Options:
        controls (--controls CONTROLS): Tensions: sine:PERIOD (s), step:HEIGHT (N; at 1.5 s, or
            step:HEIGHT,at=S), ramp:HEIGHT (N; in the first and last tendon, or
            ramp:HEIGHT,tendons=1,3), random:SEED, constant tensions (N) such as 7,5,5,7, or a CSV file. Any
            controls by name: NAME=SIGNAL;…, such as tension_4=ramp:2;base_z=0.1 (`knode-cosserat
            info ROBOT` lists the names), the others zero; or none, which a robot without controls
            need not state.
        steps (--steps N): Number of time steps; required unless a file gives the controls.
        dt (--dt S): Time step (s). Default: 0.05, or the file's.
        time (--time SCHEME): Time scheme: sdirk2, bdf1, bdf2, bdf-alpha or trapezoidal.
        initial (--initial STATE): State before the first step: equilibrium (at rest without controls), or
            unstressed (the shape that the rod was made in, as in the paper's studies).
        allow_failure (--allow-failure): Write the solved steps even if a later step fails.
    """

    controls: str | None = None
    steps: int | None = None
    dt: float | None = None
    time: str = "sdirk2"
    space: Space = "lobatto2"
    initial: str = "equilibrium"
    allow_failure: bool = False

    def word(self, system: System) -> str:
        """Return the text of a robot's controls."""
        from knode_cosserat.controls import labels

        names = labels(system.control_layout)
        if self.controls is None and names:
            raise ValueError(
                "--controls is not given; allowed is one number for each control, or NAME=SIGNAL;…, or none; "
                f"names are {', '.join(names)}"
            )
        return "none" if self.controls is None else self.controls


@app.command()
def simulate(
    model: Model,
    run: _SimulationOptions,
    out: Annotated[Path, NetCDF],
    report: Report,
    figure: Annotated[Path | None, Picture] = None,
) -> None:
    """Simulate a robot under tensions or other controls.

    Examples:
        simulate delrin-tendon-robot --controls sine:1.5 --steps 100 --out truth.nc
        simulate delrin-tendon-robot --controls step:1.5,at=2 --steps 200 --dt 0.02 --out step.nc
        simulate my-robot.yaml --controls tensions.csv --set youngs_modulus=10e9 --out stiff.nc
        simulate delrin-tendon-robot --controls 7,5,5,7 --steps 40 --out hold.nc
        simulate my-rod.yaml --controls 'base_z=ramp:0.1;base_rx=sine:2' --steps 100 --out pushed.nc
        simulate my-robot.yaml --controls random:0 --steps 100 --out r.nc --figure r.png --json
    """
    require_trajectory_name(out)
    require_writable(out, figure)
    drawing = figures() if figure else None
    import knode_cosserat as kc

    system, dt = model.load(), run.dt
    controls = run.word(system)
    if dt is None:
        tensions_only = system.control_layout.names == ("tension",)
        dt = kc.controls.load(controls).dt if os.path.isfile(controls) and tensions_only else 0.05
    sequence = kc.controls.parse(controls, run.steps, dt, system)
    began = perf_counter()
    with coarse_grid_in_output():
        trajectory = kc.simulate(
            system,
            sequence,
            dt,
            time=run.time,
            space=run.space,
            initial=run.initial,  # type: ignore[arg-type]  # checked there
            progress=report.shows_progress,
            on_failure="return" if run.allow_failure else "raise",
        )
    seconds = perf_counter() - began
    trajectory.save(out)
    if drawing:
        drawing.overview(trajectory).savefig(figure)
    summary = summaries.motion_summary(trajectory)
    errors = [
        summaries.error_text(summary[f"largest_{name}_error"], float(system.length), grid)
        for name, grid in (("position", trajectory.system), ("time", None))
    ]
    facts: dict[str, Any] = {"robot": model.robot, "steps": len(sequence), "dt": dt}
    facts |= {"computing_time": round(seconds, 4), **summary}
    results = ", ".join(f"{count} {result}" for result, count in summary["results"].items())
    lines = [
        f"simulated {model.robot}: {len(sequence)} steps of {dt:g} s, computed in {seconds:.2f} s",
        f"steps: {results}; largest scaled residual {summary['largest_residual']:.1e}",
        f"largest estimated position error: along the rod {errors[0]}; in time {errors[1]}",
        f"final tip position: {vector_text(summary['tip_position'])} m",
    ]
    if kc.Result.COARSE in np.asarray(trajectory.result):
        lines.append(COARSE)
    if trajectory.extrapolation:
        lines.append(f"EXTRAPOLATION: {trajectory.extrapolation}")
    if summary["first_failure"]:
        step, at, message = summary["first_failure"].values()
        lines.append(f"NOT SOLVED from step {step} (t = {at:g} s) on: {message}")
    write_output(report.as_json, facts, lines, out=out, figure=figure)


class Held(NamedTuple):
    """Constant control of an equilibrium: from tensions, from numbers in order, or by name.

    Options:
        tension (--tension N,N,…): Tensions of all tendons (N), such as 7,5,5,7 or 700gf,5,5,7.
        control (--control CONTROL): All controls in order, such as 7,5,5,7; or some by name, such as
            base_z=20mm,base_ry=0.2, and the others zero. Numbers may have units. `knode-cosserat info
            ROBOT` lists names and units.
    """

    tension: str | None = None
    control: str | None = None

    def of(self, system: System) -> Any:
        """Return the control of a robot."""
        from knode_cosserat.controls import labels, parse_signals

        layout = system.control_layout
        names = labels(layout)
        tensions = [field.size for field in layout.fields if field.name == "tension"]
        if self.tension is None and self.control is None and names:
            raise ValueError(
                f"no control is given; give --tension N,N,… or --control NAME=VALUE,…; "
                f"controls are {', '.join(names)}"
            )
        if self.tension is not None and not tensions:
            raise ValueError(
                f"--tension: this robot has no tensions; give --control NAME=VALUE,…; "
                f"controls are {', '.join(names) or 'none'}"
            )
        words = [] if self.control is None else _control_words(self.control, names)
        if self.tension is not None:
            values = parse_numbers("--tension", self.tension, tensions[0], unit="N")
            if not all(0.0 <= value < np.inf for value in values):
                raise ValueError(
                    f"--tension must be {tensions[0]} numbers, 0 or more (N), such as 7,5,5,7 "
                    f"(got {self.tension!r})"
                )
            named = zip(names[layout.slice("tension")], values, strict=True)
            # first, so that a tension that --control repeats is refused
            words = [f"{name}=constant:{value!r}" for name, value in named] + words
        return parse_signals(layout, words, {"middle": np.ones(1), "end": np.ones(1)})[0]


@app.command()
def equilibrium(
    model: Model,
    held: Held,
    space: Space = "lobatto2",
    out: Annotated[Path | None, NetCDF] = None,
    as_json: Json = False,
) -> None:
    """Compute the static equilibrium under a constant control.

    Examples:
        equilibrium delrin-tendon-robot --tension 7,5,5,7
        equilibrium soft-slender-robot --control base_z=0.1,base_ry=0.2
    """
    require_trajectory_name(out)
    require_writable(out)
    import knode_cosserat as kc

    system = model.load()
    with coarse_grid_in_output():
        rest = kc.equilibrium(system, held.of(system), space=space)
    stability, verdict = summaries.verdict_summary(rest)
    if out:
        rest.save(out)
    facts = {"robot": model.robot, **summaries.equilibrium_summary(rest), **stability}
    lines = [
        f"tip: {vector_text(facts['tip_position'])} m",
        f"inclination of the tip from the z axis: {np.degrees(facts['tip_inclination']):.2f} degrees",
        f"scaled residual {facts['residual']:.1e}; largest estimated position error: "
        f"{summaries.error_text(facts['position_error'], float(system.length), rest.system)}",
    ]
    if "base_force" in facts:
        lines.append(f"internal force at the base: {vector_text(facts['base_force'])} N")
        lines.append(f"internal moment at the base: {vector_text(facts['base_moment'])} N m")
    lines += verdict
    if rest.result[0] == kc.Result.OTHER_TURNS:
        lines.append(f"OTHER TURNS: {facts['result']}")
    if rest.extrapolation:
        lines.append(f"EXTRAPOLATION: {rest.farthest}")
    if rest.result[0] == kc.Result.COARSE:
        lines.append(COARSE)
    elif facts["result"] != "converged" and rest.result[0] not in (kc.Result.UNSTABLE, kc.Result.OTHER_TURNS):
        lines.append(f"solved with recovery: {facts['result']}")
    write_output(as_json, facts, lines, out=out)


@app.command()
def info(
    robot: Annotated[
        str | None, typer.Argument(metavar="[ROBOT]", help=f"{ROBOT} If omitted, list the catalog.")
    ] = None,
    changes: Changes = None,
    nodes: Nodes = None,
    recordings: Annotated[
        list[Path] | None,
        typer.Option(
            "--recording",
            metavar="FILE",
            help="Compare this recording, or trajectory, with those of the passport; may be repeated.",
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Show a robot's parameters and controls, or the catalog.

    For a model, or the folder of an ensemble, show the residual as well. What was learned has a passport:
    recordings, held-out errors, ranges of controls and strains.

    Examples:
        info
        info delrin-tendon-robot --set length=0.4
        info model
        info found.yaml --recording a.csv
    """
    import knode_cosserat as kc

    robots = kc.catalog()
    if robot is None:
        if changes or nodes or recordings:
            raise ValueError(
                "--set, --nodes and --recording need a robot: name it, such as delrin-tendon-robot"
            )
        write_output(as_json, {"catalog": robots}, table(list(robots.items())))
        return
    ensemble = load_ensemble_folder(robot, changes)
    system = load_system(robot, changes, nodes) if ensemble is None else ensemble[0]
    parts = {"parameters": summaries.parameters(system), "derived": summaries.derived(system)}
    rows = []
    for title, quantities in parts.items():
        rows += [[""] * 4, [title, "", "", ""]]
        rows += [
            [f"  {name}", value_text(it["value"]), it["unit"], it["meaning"]]
            for name, it in quantities.items()
        ]
    drives = summaries.control_summary(system)
    rows += [[""] * 4, ["controls", "", "", ""]]
    rows += [[f"  {name}", "", it["unit"], it["meaning"]] for name, it in drives.items()]
    if not drives:
        rows.append(["  none", "", "", "the robot has no controls"])
    more = summaries.more_lines(system)
    heading = f"{robot}: {robots[robot]}" if robot in robots else robot
    if ensemble is not None:
        heading += f": ensemble of {len(ensemble)} models; the first"
    facts, lines = summaries.residual_summary(system)
    learned, words = summaries.passport_summary(system, recordings or ())
    facts |= learned
    lines += [*([""] if lines and words else []), *words]
    write_output(
        as_json,
        {"robot": robot, "kind": type(system).__name__, **parts, "controls": drives, "parts": more, **facts},
        [heading, *table(rows), *(["", "parts", *more] if more else []), *(["", *lines] if lines else [])],
    )


@app.command()
def schema(
    as_json: bool = False,
) -> None:
    """Print the JSON Schema of robot files.

    Editors use it to complete and check them.

    Options:
        as_json (--json): Print the schema on one line.

    Examples:
        schema > robot.schema.json
    """
    import json

    import knode_cosserat as kc

    typer.echo(json.dumps(kc.robots.robot_schema(), indent=None if as_json else 2, ensure_ascii=False))


def _control_words(control: str, names: list[str]) -> list[str]:
    """Return the signals `NAME=constant:VALUE` of a control given by numbers in order, or by names."""
    if "=" not in control:
        numbers = numbers_in(control)
        # numbers with units are separated by commas only
        values = re.split(r"[,;]", control) if numbers is None else [repr(number) for number in numbers]
        if len(values) != len(names):
            raise ValueError(
                f"--control must be {len(names)} numbers, in the order {', '.join(names)}, or NAME=VALUE,…, "
                f"such as {names[0] if names else 'NAME'}=0.1 (got {control!r})"
            )
        return [f"{name}=constant:{value.strip()}" for name, value in zip(names, values, strict=True)]
    words = []
    # separated by commas, semicolons or spaces, but not by spaces around an equals sign or before a unit
    for each in re.split(r"\s*[,;]\s*|\s+(?=\w+=)", re.sub(r"\s*=\s*", "=", control.strip())):
        name, equals, value = each.partition("=")
        if not (name and equals and value):
            raise ValueError(
                f"--control must be {len(names)} numbers, or NAME=VALUE,… (got {control!r}); "
                f"names are {', '.join(names)}"
            )
        words.append(f"{name}=constant:{value}")
    return words
