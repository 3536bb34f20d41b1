"""Command that identifies a robot from recordings, and the evaluation of a robot on recordings."""

from __future__ import annotations

import functools
import math
import sys
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

from knode_cosserat.cli.arguments import (
    Nominal,
    Report,
    Sampling,
    argument,
    load_recordings,
    option,
    require_writable,
)
from knode_cosserat.cli.output import write_output
from knode_cosserat.cli.program import app, examples
from knode_cosserat.recordings.formats import read_suffixes

if TYPE_CHECKING:
    from knode_cosserat.rods.system import System

#: longest time between predicted rows (s)
FINELY = 0.0125


class _Search(NamedTuple):
    """Search, and its files."""

    out: Annotated[Path, option("FILE", "Write the identified robot to this YAML file.")]
    effects: Annotated[
        list[str] | None,
        option(
            "NAME",
            "Physical effect to identify, such as friction; may be repeated.",
            "--effect",
            show_default="selected by recordings left out",
        ),
    ] = None
    checkpoint: Annotated[
        Path | None, option("DIR", "Keep finished searches here; an interrupted run resumes.")
    ] = None


@app.command(
    epilog=examples(
        "identify delrin-tendon-robot a.bag b.bag --out found.yaml",
        "identify my-robot.yaml a.csv b.csv --config my-recording.yaml --out found.yaml",
    )
)
def identify(
    nominal: Nominal,
    recordings: Annotated[list[Path], argument("RECORDING", f"Recordings ({', '.join(read_suffixes())}).")],
    search: _Search,
    sampling: Sampling,
    report: Report,
) -> None:
    """Identify a tendon robot's parameters from recordings.

    ROBOT is the nominal robot, from measured dimensions, masses and data sheets. An effect is kept if it
    lowers the error on recordings left out of the search. The result must pass trial simulations with larger
    and with random tensions.
    """
    require_writable(search.out)
    import knode_cosserat as kc
    from knode_cosserat.identification.identify import identify as find

    system = nominal.load()
    samples = [
        recording.sampled(sampling.dt, sampling.start, sampling.end, mean=True)
        for recording in load_recordings(recordings, sampling.config)
    ]
    began = perf_counter()
    progress = functools.partial(print, file=sys.stderr, flush=True) if report.shows_progress else None
    identified = find(
        system, samples, search.effects or None, space=sampling.space, progress=progress,
        checkpoint=search.checkpoint,
    )  # fmt: skip
    kc.save_robot(identified.robot, search.out)
    facts = identified.to_dict() | {"computing_time": round(perf_counter() - began, 1)}
    write_output(report.as_json, facts, str(identified).splitlines(), out=search.out)


def evaluate_on_recordings(system: System, recordings: list[Path], sampling: Sampling, as_json: bool) -> None:
    """Predict recordings from their measured tensions; print tip RMSE and pose MSE of each.

    A prediction starts at the equilibrium under the first tensions. Rotations are relative to the start,
    because the mounting of the tracked bodies is unknown.
    """
    from knode_cosserat.identification.evaluate import evaluate as compare

    facts: dict[str, Any] = {}
    lines, dt = [], sampling.dt
    for path, recording in zip(recordings, load_recordings(recordings, sampling.config), strict=True):
        # coarse rows would lose the tensions between them: predict finely, and compare every few rows
        count = math.ceil(dt / FINELY - 1e-6) if FINELY < dt < math.inf else 1
        rows = recording.sampled(dt / count, sampling.start, sampling.end, mean=True)
        evaluation = compare(system, rows, every=1 if rows.static else count, space=sampling.space)
        facts[str(path)] = evaluation.to_dict()
        lines.append(f"{path}: {evaluation}")
    write_output(as_json, {"recordings": facts}, lines)
