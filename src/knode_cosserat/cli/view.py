"""Command that shows trajectories and interactive robots in the browser: view."""

from __future__ import annotations

import sys
import webbrowser
from pathlib import Path
from typing import Annotated, NamedTuple

import typer

from knode_cosserat.cli.arguments import (
    Changes,
    Json,
    Nodes,
    Space,
    argument,
    command_line,
    is_recording,
    is_trajectory,
    load_system,
    require_writable,
    trajectories_by_name,
)
from knode_cosserat.cli.output import write_output
from knode_cosserat.cli.program import app

#: robot of `view --live` without a name
EXAMPLE = "delrin-tendon-robot"


class _Live(NamedTuple):
    """Simulation in real time.

    Options:
        live (--live): Simulate a robot or model in real time, controlled by sliders.
        dt (--dt S): With --live: time step (s). Default: the model's training step, or 0.05.
    """

    live: bool = False
    dt: float | None = None
    space: Space = "lobatto2"
    changes: Changes = None
    nodes: Nodes = None


class _Page(NamedTuple):
    """Page of the viewer.

    Options:
        export (--export FILE): Write one self-contained HTML file and exit.
        port (--port N): Port of the local web server, reachable from this machine only. Default: any free
            port.
        no_open (--no-open): Do not open the browser.
    """

    export: Path | None = None
    port: int = 0
    no_open: bool = False


@app.command()
def view(
    live: _Live,
    page: _Page,
    files: Annotated[
        list[str] | None,
        argument("[FILE]…", "Trajectory files; with --live, one robot or model.", show_default=False),
    ] = None,
    as_json: Json = False,
) -> None:
    """Show trajectories in 3-D, or control a robot by sliders.

    The scene opens in the browser.

    Examples:
        view truth.nc prediction.nc
        view truth.nc --export scene.html
        view --live delrin-tendon-robot
        view --live model
    """
    from knode_cosserat import viewer

    names, export = files or [], page.export

    def announce(address: str) -> None:
        write_output(as_json, {"address": address}, [f"the viewer is at {address} (Ctrl-C ends it)"])
        if not page.no_open:
            webbrowser.open(address)

    if live.live:
        if export:
            raise ValueError(
                "--live and --export exclude each other: a file cannot simulate. Give one of them"
            )
        if len(names) > 1:
            raise ValueError(f"--live needs one robot or model (got {', '.join(names)})")
        name = names[0] if names else EXAMPLE
        from knode_cosserat.rods.robot_file import catalog

        viewer.live.require_websockets()
        robot = load_system(name, live.changes, live.nodes)
        if sys.stderr.isatty():
            typer.echo(f"preparing {name} …", err=True)
        viewer.view_live(
            robot,
            dt=live.dt,
            space=live.space,
            title=name if name in catalog() else Path(name).name,
            port=page.port,
            open_browser=announce,
        )
        return
    if not names:
        raise ValueError("no trajectory is given; type: knode-cosserat view FILE…, or view --live ROBOT")
    if live != _Live():
        raise ValueError("--set, --nodes, --dt and --space change a simulation; use them with --live")
    require_writable(export)
    for file in names:
        if Path(file).is_file() and not is_trajectory(file) and not is_recording(file):
            typed = command_line("view", "--live", file)
            raise ValueError(f"{file}: not a trajectory. To show a robot or model, type: {typed}")
    trajectories = trajectories_by_name(names)
    if export:
        viewer.export_scene(trajectories, export)
        write_output(as_json, {"trajectories": list(trajectories)}, [], export=export)
    else:
        viewer.view(trajectories, port=page.port, open_browser=announce)
