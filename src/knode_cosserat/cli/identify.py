"""Command that identifies a robot from recordings, and the evaluation of a robot on recordings."""

from __future__ import annotations

import functools
import math
import sys
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, Any

from knode_cosserat.cli.arguments import (
    Changes,
    Json,
    Progress,
    Robot,
    Space,
    argument,
    load_recordings,
    load_system,
    option,
    require_writable,
    shows_progress,
)
from knode_cosserat.cli.output import write_output
from knode_cosserat.cli.program import app, examples
from knode_cosserat.recordings.formats import read_suffixes

if TYPE_CHECKING:
    from knode_cosserat.rods.system import System

Recordings = Annotated[list[Path], argument("RECORDING", f"Recordings ({', '.join(read_suffixes())}).")]
Config = Annotated[
    Path | None,
    option(
        "YAML",
        "Meaning of the recordings' topics or columns.",
        show_default="the paper's robot for bags; titles and comments for tables",
    ),
]
Start = Annotated[
    float | None, option("S", "Start time in the recording (s), at which the robot rests.", show_default="0")
]
Seconds = Annotated[float | None, option("S", "Duration used (s).", show_default="to the end")]

#: longest time between predicted rows (s)
FINELY = 0.0125
Step = Annotated[float, option("S", "Time step of the simulation (s).")]


@app.command(
    epilog=examples(
        "identify delrin-tendon-robot a.bag b.bag --out found.yaml",
        "identify my-robot.yaml a.csv b.csv --config my-recording.yaml --out found.yaml",
    )
)
def identify(
    robot: Robot,
    recordings: Recordings,
    out: Annotated[Path, option("FILE", "Write the identified robot to this YAML file.")],
    config: Config = None,
    start: Start = None,
    seconds: Seconds = None,
    dt: Step = 0.0125,
    effects: Annotated[
        list[str] | None,
        option(
            "NAME",
            "Physical effect to identify, such as friction; may be repeated.",
            "--effect",
            show_default="selected by recordings left out",
        ),
    ] = None,
    checkpoint: Annotated[
        Path | None, option("DIR", "Keep finished searches here; an interrupted run resumes.")
    ] = None,
    space: Space = "lobatto2",
    changes: Changes = None,
    progress: Progress = None,
    as_json: Json = False,
) -> None:
    """Identify a tendon robot's parameters from recordings.

    ROBOT is the nominal robot, from measured dimensions, masses and data sheets. An effect is kept if it
    lowers the error on recordings left out of the search. The result must pass trial simulations with larger
    and with random tensions.
    """
    require_writable(out)
    import knode_cosserat as kc
    from knode_cosserat.identification.identify import identify as find

    nominal = load_system(str(robot), changes)
    samples = [
        recording.sampled(dt, start, None if seconds is None else (start or 0.0) + seconds, mean=True)
        for recording in load_recordings(recordings, config)
    ]
    began = perf_counter()
    report = functools.partial(print, file=sys.stderr, flush=True) if shows_progress(progress) else None
    identified = find(nominal, samples, effects or None, space=space, progress=report, checkpoint=checkpoint)
    kc.save_robot(identified.robot, out)
    facts = identified.to_dict() | {"computing_time": round(perf_counter() - began, 1)}
    write_output(as_json, facts, str(identified).splitlines(), out=out)


def evaluate_on_recordings(
    system: System, recordings: list[Path], config: Path | None, start: float | None, seconds: float | None,
    dt: float, space: str, as_json: bool,
) -> None:  # fmt: skip
    """Predict recordings from their measured tensions; print tip RMSE and pose MSE of each.

    A prediction starts at the equilibrium under the first tensions. Rotations are relative to the start,
    because the mounting of the tracked bodies is unknown.
    """
    from knode_cosserat.identification.evaluate import evaluate as compare

    facts: dict[str, Any] = {}
    lines = []
    for path, recording in zip(recordings, load_recordings(recordings, config), strict=True):
        end = None if seconds is None else (start or 0.0) + seconds
        # coarse rows would lose the tensions between them: predict finely, and compare every few rows
        count = math.ceil(dt / FINELY - 1e-6) if FINELY < dt < math.inf else 1
        rows = recording.sampled(dt / count, start, end, mean=True)
        evaluation = compare(system, rows, every=1 if rows.static else count, space=space)
        facts[str(path)] = evaluation.to_dict()
        lines.append(f"{path}: {evaluation}")
    write_output(as_json, {"recordings": facts}, lines)
