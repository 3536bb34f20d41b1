"""Command that shows trajectories, predictions and interactive robots in the browser: view."""

from __future__ import annotations

import sys
import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from knode_cosserat.cli.arguments import (
    Changes,
    Json,
    Nodes,
    Sampling,
    argument,
    command_line,
    is_recording,
    is_trajectory,
    load_ensemble_folder,
    load_system,
    require_writable,
    trajectories_by_name,
)
from knode_cosserat.cli.learn import evaluate_on_recordings
from knode_cosserat.cli.output import write_output
from knode_cosserat.cli.program import app

if TYPE_CHECKING:
    from knode_cosserat.identification import Evaluation

#: robot of `view --live` without a name
EXAMPLE = "delrin-tendon-robot"


class _Simulation(NamedTuple):
    """Simulation in real time, or of recordings.

    Options:
        live (--live): Simulate a robot or model in real time, controlled by sliders.
        dt (--dt S): Time step with --live (s), by default the model's training step, or 0.05. Time between
            rows of recordings (s), by default 0.0125.
        space (--space SCHEME): Scheme along the rod: lobatto2 (order 2), lobatto4 (order 4) or euler (order
            1, the paper's). Default: lobatto2 with --live, lobatto4 for recordings.
    """

    live: bool = False
    dt: float | None = None
    space: str | None = None
    changes: Changes = None
    nodes: Nodes = None


class _Rows(NamedTuple):
    """Rows of recordings.

    Options:
        config (--config YAML): Meaning of the recordings' topics or columns. Default: the paper's robot for
            bags; titles and comments for tables.
        start (--start S): Start time in the recordings (s), at which the robot rests. Default: 0.
        seconds (--seconds S): Duration used (s). Default: to the end.
    """

    config: Path | None = None
    start: float | None = None
    seconds: float | None = None

    def sampling(self, simulation: _Simulation) -> Sampling:
        """Return the rows with their time step and the scheme along the rod."""
        chosen: dict[str, Any] = {"dt": simulation.dt, "space": simulation.space}
        return Sampling(*self, **{name: value for name, value in chosen.items() if value is not None})


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
    live: _Simulation,
    rows: _Rows,
    page: _Page,
    files: Annotated[
        list[str] | None,
        argument(
            "[FILE]…",
            "Trajectory files; or a robot, model or ensemble and recordings; with --live, a robot or model.",
            show_default=False,
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Show trajectories in 3-D, predictions beside recordings, or control a robot by sliders.

    The scene opens in the browser. A prediction of a recording is shown with the measured bodies, that of an
    ensemble with its band.

    Examples:
        view truth.nc prediction.nc
        view truth.nc --export scene.html
        view found.yaml unseen.bag --config my-recording.yaml
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
        if rows != _Rows():
            raise ValueError("--config, --start and --seconds are of recordings; --live has none")
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
            space=live.space or "lobatto2",
            title=name if name in catalog() else Path(name).name,
            port=page.port,
            open_browser=announce,
        )
        return
    if not names:
        raise ValueError("no trajectory is given; type: knode-cosserat view FILE…, or view --live ROBOT")
    require_writable(export)
    predicts = not is_recording(names[0]) and any(map(is_recording, names[1:]))
    shown: dict[str, Any]
    if predicts:
        shown = _predictions(names[0], names[1:], rows.sampling(live), live)
    else:
        if live != _Simulation() or rows != _Rows():
            raise ValueError(
                "--set, --nodes, --dt and --space change a simulation; use them with --live, or with a robot "
                "and recordings, as --config, --start and --seconds"
            )
        for file in names:
            if Path(file).is_file() and not is_trajectory(file) and not is_recording(file):
                typed = command_line("view", "--live", file)
                raise ValueError(f"{file}: not a trajectory. To show a robot or model, type: {typed}")
        shown = trajectories_by_name(names)
    if export:
        viewer.export_scene(shown, export)
        write_output(as_json, {"trajectories": list(shown)}, [], export=export)
    else:
        viewer.view(shown, port=page.port, open_browser=announce)


def _predictions(
    name: str, recordings: list[str], sampling: Sampling, it: _Simulation
) -> dict[str, Evaluation]:
    """Return the predictions of recordings by a robot, model or ensemble, beside what was measured."""
    if is_trajectory(name):
        typed = command_line("view", "ROBOT", *recordings)
        raise ValueError(
            f"{name}: this is a trajectory; a robot or model predicts recordings and comes first. "
            f"Type: {typed}"
        )
    system = load_ensemble_folder(name, it.changes) or load_system(name, it.changes, it.nodes)
    return evaluate_on_recordings(system, [Path(path) for path in recordings], sampling)
