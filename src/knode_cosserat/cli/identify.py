"""Command that identifies a robot from recordings, and the part of `evaluate` that compares with them."""

from __future__ import annotations

import sys
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, Any

import typer

from knode_cosserat.cli.arguments import (
    Changes,
    Json,
    Progress,
    Robot,
    Space,
    require_writable,
    system_of,
    wanted,
)
from knode_cosserat.cli.program import app, examples
from knode_cosserat.cli.telling import tell

if TYPE_CHECKING:
    from knode_cosserat.recordings.config import RecordingConfig
    from knode_cosserat.recordings.recording import Recording
    from knode_cosserat.rods.system import System

Recordings = Annotated[
    list[Path],
    typer.Argument(metavar="RECORDING", help="Bags (.bag, .mcap, .db3) or tables (.csv, .parquet)."),
]
Config = Annotated[
    Path | None,
    typer.Option(metavar="YAML", help="How recordings are read.", show_default="the paper's robot"),
]
Start = Annotated[
    float | None, typer.Option(metavar="S", help="First row, in s; the robot rests there.", show_default="0")
]
Seconds = Annotated[float | None, typer.Option(metavar="S", help="Length, in s.", show_default="to the end")]

Step = Annotated[float, typer.Option(metavar="S", help="Time step of the simulation, in s.")]


@app.command(
    epilog=examples(
        "identify delrin-tendon-robot a.bag b.bag --out found.yaml",
        "identify my-robot.yaml a.csv b.csv --config my-recording.yaml --out found.yaml",
    )
)
def identify(
    robot: Robot,
    recordings: Recordings,
    out: Annotated[Path, typer.Option(metavar="FILE", help="Write the identified robot to this YAML file.")],
    config: Config = None,
    start: Start = None,
    seconds: Seconds = None,
    dt: Step = 0.0125,
    effects: Annotated[
        list[str] | None,
        typer.Option(
            "--effect",
            metavar="NAME",
            help="Effect to identify; repeat for several.",
            show_default="those worth their place",
        ),
    ] = None,
    checkpoint: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Keep finished searches here; an interrupted run resumes."),
    ] = None,
    space: Space = "lobatto2",
    changes: Changes = None,
    progress: Progress = None,
    as_json: Json = False,
) -> None:
    """Identify a tendon robot from recordings: which effects it has, and their numbers.

    ROBOT is the robot as ruler, scale and data sheet have it. Effects are kept that lower the error of
    recordings left out of the search; the result has to pass trials with larger and random tensions.
    """
    require_writable(out)
    import knode_cosserat as kc
    from knode_cosserat.identification.identify import identify as find

    nominal = system_of(str(robot), changes)
    given = [
        each.sampled(dt, start, None if seconds is None else (start or 0.0) + seconds, mean=True)
        for each in _read(recordings, config)
    ]
    began = perf_counter()
    say = _on_stderr if wanted(progress) else None
    found = find(nominal, given, effects or None, space=space, progress=say, checkpoint=checkpoint)
    kc.save_robot(found.robot, out)
    facts = found.to_dict() | {"computing_time": round(perf_counter() - began, 1)}
    tell(as_json, facts, str(found).splitlines(), out=out)


def evaluate_on_recordings(
    system: System, recordings: list[Path], config: Path | None, start: float | None, seconds: float | None,
    dt: float, space: str, as_json: bool,
) -> None:  # fmt: skip
    """Predict recordings by their measured tensions, and compare: tip RMSE and pose MSE of each.

    A prediction begins in the equilibrium under the tensions at its start. Rotations are those since then,
    for how motion capture's bodies are mounted is not known.
    """
    from knode_cosserat.identification.evaluate import evaluate as compare

    facts: dict[str, Any] = {}
    lines = []
    for path, recording in zip(recordings, _read(recordings, config), strict=True):
        end = None if seconds is None else (start or 0.0) + seconds
        rows = recording.sampled(dt, start, end, mean=True)
        found = compare(system, rows, space=space)
        facts[str(path)] = found.to_dict()
        lines.append(f"{path}: {found}")
    tell(as_json, {"recordings": facts}, lines)


def _read(paths: list[Path], config: Path | None) -> list[Recording]:
    from knode_cosserat.recordings.config import RecordingConfig
    from knode_cosserat.recordings.load import load_recording

    chosen: RecordingConfig | None = None if config is None else RecordingConfig.load(config)
    return [load_recording(path, chosen) for path in paths]


def _on_stderr(line: str) -> None:
    print(line, file=sys.stderr, flush=True)
