"""Command that writes the parts of a robot as CAD files: robot-parts."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from knode_cosserat.cli.arguments import Json, Robot, require_writable
from knode_cosserat.cli.output import table, write_output
from knode_cosserat.cli.program import command_group, examples

parts_command = command_group()


@parts_command.command(
    "robot-parts",
    epilog=examples(
        "robot-parts delrin-routed-tendon-robot",
        "robot-parts delrin-routed-tendon-robot --out parts",
        "robot-parts my-robot.yaml --out parts --json",
    ),
)
def robot_parts(
    robot: Robot,
    out: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Write STEP and STL files to this folder.", show_default="none"),
    ] = None,
    as_json: Json = False,
) -> None:
    """Print a robot's bill of materials, and write its parts as CAD files.

    The parts are ribs, spools, base, motor plate, brackets and load cells. All dimensions follow from the
    robot's file and its section `hardware`. --out needs build123d. The parts were never built.
    """
    require_writable(folders=[out])
    from knode_cosserat_hardware.cad import bill_of_materials, export_parts

    items = bill_of_materials(robot)
    files = {} if out is None else export_parts(robot, out)
    facts = {
        "robot": robot,
        "materials": [item._asdict() for item in items],
        "files": {name: str(path) for name, path in files.items()},
    }
    lines = table([[str(item.count), item.part, item.specification] for item in items])
    write_output(as_json, facts, [*lines, *(f"wrote {path}" for path in files.values())])
