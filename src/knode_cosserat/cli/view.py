"""The command `view`: trajectories in the browser or in one file, and robots that follow sliders."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from knode_cosserat.cli.arguments import (
    Changes,
    Json,
    Nodes,
    Space,
    is_trajectory,
    require_writable,
    system_of,
    trajectory_of,
)
from knode_cosserat.cli.program import app, examples
from knode_cosserat.cli.telling import tell

if TYPE_CHECKING:
    from knode_cosserat.trajectory import Trajectory

#: what moves if no robot is named
EXAMPLE = "delrin-tendon-robot"


@app.command(
    epilog=examples(
        "view truth.nc prediction.nc",
        "view truth.nc --export scene.html",
        "view --live delrin-tendon-robot",
        "view --live model",
    )
)
def view(
    files: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[FILE]…", help="Trajectories; with --live one robot or model.", show_default=False
        ),
    ] = None,
    live: Annotated[
        bool, typer.Option("--live", help="Move a robot or model by sliders, in real time.")
    ] = False,
    export: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Write one HTML file that opens anywhere, and end."),
    ] = None,
    port: Annotated[
        int,
        typer.Option(
            metavar="N",
            help="Port of the page's server, which only this machine reaches.",
            show_default="any that is free",
        ),
    ] = 0,
    no_open: Annotated[bool, typer.Option("--no-open", help="Do not open the browser.")] = False,
    dt: Annotated[
        float | None,
        typer.Option(
            metavar="S", help="With --live: time step in s.", show_default="what a model learned at, or 0.05"
        ),
    ] = None,
    space: Space = "lobatto2",
    changes: Changes = None,
    nodes: Nodes = None,
    as_json: Json = False,
) -> None:
    """Show trajectories in 3-D in the browser, or move a robot by sliders."""
    from knode_cosserat import viewer

    names = files or []

    def announce(address: str) -> None:
        tell(as_json, {"address": address}, [f"the viewer is at {address} (Ctrl-C ends it)"])
        if not no_open:
            viewer.serve.open_page(address)

    if live:
        if export:
            raise ValueError("--live and --export exclude each other: a file has nobody to simulate")
        if len(names) > 1:
            raise ValueError(f"--live moves one robot or model; given are {', '.join(names)}")
        name = names[0] if names else EXAMPLE
        from knode_cosserat.rods.robot_file import catalog

        viewer.live.require_websockets()
        robot = system_of(name, changes, nodes)
        if sys.stderr.isatty():
            typer.echo(f"preparing {name} …", err=True)
        viewer.view_live(
            robot, dt=dt, space=space, title=name if name in catalog() else Path(name).name, port=port,
            open_browser=announce,
        )  # fmt: skip
        return
    if not names:
        raise ValueError("no trajectory is given: knode-cosserat view FILE…, or view --live ROBOT")
    if changes or nodes or dt is not None or space != "lobatto2":
        raise ValueError("--set, --nodes, --dt and --space change what is simulated: they belong to --live")
    require_writable(export)
    trajectories = _by_name(names)
    if export:
        viewer.export_scene(trajectories, export)
        tell(as_json, {"trajectories": list(trajectories)}, [], export=export)
    else:
        viewer.view(trajectories, port=port, open_browser=announce)


def _by_name(files: list[str]) -> dict[str, Trajectory]:
    """Trajectories by the names of their files, as short as tells them apart."""
    short = [Path(file).stem for file in files]
    found: dict[str, Trajectory] = {}
    for file, stem in zip(files, short, strict=True):
        if Path(file).is_file() and not is_trajectory(file):
            raise ValueError(f"{file}: not a trajectory; a robot or model is shown by view --live {file}")
        name = stem if short.count(stem) == 1 else file
        while name in found:
            name += " (again)"
        found[name] = trajectory_of(Path(file))
    return found
