"""The commands that rerun the paper's studies, and those that go beyond them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, Any

import typer

from knode_cosserat.cli.arguments import Json, Progress, figures, require_writable, wanted
from knode_cosserat.cli.program import app, examples, studies
from knode_cosserat.cli.telling import tell

if TYPE_CHECKING:
    from knode_cosserat.studies.report import Report

app.add_typer(studies, name="study")

Out = Annotated[
    Path, typer.Option(metavar="DIR", help="Folder for what is written; made if it is not there.")
]
Seeds = Annotated[int, typer.Option(metavar="N", min=1, help="How many seeds: 0 to N - 1.")]
Workers = Annotated[
    int | None,
    typer.Option(
        metavar="N", min=1, help="Processes on this machine.", show_default="one for every four cores"
    ),
]
Dask = Annotated[
    str | None,
    typer.Option(metavar="ADDRESS", help="Run the jobs on the Dask cluster with this scheduler."),
]


def _some(words: str) -> Any:
    return typer.Option(metavar="A,B,…", help=f"Some of {words}.", show_default="all")


@studies.command(
    epilog=examples(
        "study simulation --out results",
        "study simulation --out results --methods baseline,best --seeds 1",
        "study simulation --out results --dask tcp://scheduler:8786",
    )
)
def simulation(
    out: Out,
    seeds: Seeds = 5,
    methods: Annotated[str | None, _some("baseline, paper, calibrated, best")] = None,
    workers: Workers = None,
    dask: Dask = None,
    progress: Progress = None,
    as_json: Json = False,
) -> None:
    """Rerun the paper's simulation study: four imperfect models, learned from two short sines each.

    Writes Table I beside the paper's figures (table1.md, .csv, .json), figures, trajectories and models. It
    goes on where an earlier run on the same folder stopped.
    """
    _prepare(out, workers, dask)
    from knode_cosserat.studies.methods import METHODS
    from knode_cosserat.studies.simulation_report import rerun

    chosen = _chosen("methods", methods, METHODS)
    _run(
        lambda **how: rerun(out, seeds=range(seeds), methods=chosen, **how),
        {"methods": chosen, "seeds": seeds}, out, workers, dask, progress, as_json,
    )  # fmt: skip


@studies.command(
    epilog=examples(
        "study imperfections --out results",
        "study imperfections --out results --only 'damping,tip mass' --seeds 1",
    )
)
def imperfections(
    out: Out,
    seeds: Seeds = 1,
    only: Annotated[str | None, _some("the imperfections, such as damping, tip mass, stiffening")] = None,
    workers: Workers = None,
    dask: Dask = None,
    progress: Progress = None,
    as_json: Json = False,
) -> None:
    """Robots that differ from the model by more than a parameter: what the best preset leaves of the error.

    It learns from two sines of 30 rows and predicts 30 s of controls that it has not seen, and of twice the
    tension. Writes imperfections.md, .json and a figure; goes on where an earlier run on the folder stopped.
    """
    _prepare(out, workers, dask)
    from knode_cosserat.studies.imperfections import IMPERFECTIONS
    from knode_cosserat.studies.imperfections_report import rerun

    chosen = _chosen("only", only, IMPERFECTIONS)
    _run(
        lambda **how: rerun(out, seeds=range(seeds), names=chosen, **how),
        {"imperfections": chosen, "seeds": seeds}, out, workers, dask, progress, as_json,
    )  # fmt: skip


@studies.command(
    epilog=examples(
        "study data --out results",
        "study data --out results --methods baseline,best --seeds 1",
    )
)
def data(
    out: Out,
    seeds: Seeds = 3,
    methods: Annotated[
        str | None,
        _some("baseline, best, paper; 'paper, no knowledge', 'network, no knowledge', 'linear (DMDc)'"),
    ] = None,
    workers: Workers = None,
    dask: Dask = None,
    progress: Progress = None,
    as_json: Json = False,
) -> None:
    """How much data learning needs: errors from 5 to 30 rows of one sine and of two.

    With the paper's imperfect models, and without any knowledge: networks of the same size, and a linear
    predictor (needs the extra `bench`). Writes data.md, .json and figures; goes on where an earlier run on
    the folder stopped.
    """
    _prepare(out, workers, dask)
    from knode_cosserat.studies.data_efficiency import ALL
    from knode_cosserat.studies.data_report import rerun

    chosen = _chosen("methods", methods, ALL)
    _run(
        lambda **how: rerun(out, seeds=range(seeds), methods=chosen, **how),
        {"methods": chosen, "seeds": seeds}, out, workers, dask, progress, as_json,
    )  # fmt: skip


@studies.command(epilog=examples("study estimation --out results"))
def estimation(out: Out, as_json: Json = False) -> None:
    """How well full states are estimated from recordings: the paper's method, and the best.

    Records the virtual robot (simulated: its states are known) and writes the errors of every quantity
    (estimation.md, .json) and a figure; the bags stay in the folder.
    """
    _prepare(out, None, None)
    from knode_cosserat.studies.estimation import rerun

    _run(
        lambda **how: rerun(out),
        {}, out, None, None, None, as_json,
    )  # fmt: skip


@studies.command(
    epilog=examples(
        "study recordings bags/",
        "study recordings bags/ --train sine_1p0,sine_3p0,rand_0 --out results",
        "study recordings bags/ --robot my-robot.yaml --config my-recordings.yaml --train first,second",
    )
)
def recordings(
    bags: Annotated[Path, typer.Argument(metavar="BAGDIR", help="Folder with bags or tables.")],
    train: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME,…",
            help="Those to learn from, without endings; all others are predicted.",
            show_default="sine_1p0, sine_3p0, rand_0",
        ),
    ] = None,
    out: Out = Path("recordings-study"),
    robot: Annotated[
        str, typer.Option(metavar="ROBOT", help="What is known of the robot: a name or a file.")
    ] = "delrin-tendon-robot",
    config: Annotated[
        Path | None,
        typer.Option(
            metavar="YAML",
            help="What the recordings' topics or columns mean.",
            show_default="the paper's robot for bags, what it says itself for a table",
        ),
    ] = None,
    start: Annotated[
        float | None,
        typer.Option(
            metavar="S",
            min=0.0,
            help="Where predictions begin; the robot still rests there.",
            show_default="1, and 0 where the name begins with step",
        ),
    ] = None,
    seconds: Annotated[float, typer.Option(metavar="S", min=0.1, help="How long they go on.")] = 10.0,
    seeds: Seeds = 5,
    methods: Annotated[
        str,
        typer.Option(
            metavar="A,B,…",
            help="Some of those, and of what the parts of best are worth: calibrated (the model given, its "
            "numbers found), no-memory, no-vibration.",
        ),
    ] = "baseline,paper-a,paper-b,best",
    simulated: Annotated[
        bool | None,
        typer.Option(
            "--simulated/--physical",
            help="Whether the robot was a simulation.",
            show_default="what the recordings say",
        ),
    ] = None,
    workers: Workers = None,
    dask: Dask = None,
    progress: Progress = None,
    as_json: Json = False,
) -> None:
    """Learn a robot from some of its recordings, and predict the others: the paper's Table II.

    Reads the bags, estimates states, trains the paper's model without (A) and with (B) the recordings whose
    names begin with rand, and identifies the best model from measured poses alone. Writes table2.md, .json,
    figures and models; goes on where an earlier run on the folder stopped.
    """
    _prepare(out, workers, dask)
    from knode_cosserat.studies.recordings import METHODS, Options
    from knode_cosserat.studies.recordings_report import rerun

    chosen = _chosen("methods", methods, METHODS)
    names = None if train is None else [name.strip() for each in train for name in each.split(",")]
    options = Options(robot, None if config is None else str(config), start, seconds, seeds)
    _run(
        lambda **how: rerun(
            out, bags, train=names, methods=chosen, options=options, simulated=simulated, **how
        ),
        {"methods": chosen, "seeds": seeds}, out, workers, dask, progress, as_json,
    )  # fmt: skip


@studies.command(
    epilog=examples(
        "study beam recordings/ --out results",
        "study beam recordings/ --train beam_gravity_V2_b,beam_load52_V2_a --out results",
        "study beam recordings/ --load beam_run3=30 --out results",
    )
)
def beam(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="Folder with beam_gravity*.csv and beam_load<grams>*.csv.")
    ],
    out: Out = Path("beam-study"),
    train: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME,…",
            help="Those to learn from, without endings; all others are predicted.",
            show_default="beam_gravity_V2_b, beam_load52_V2_a; else one of each of the two lightest loads",
        ),
    ] = None,
    load: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=GRAMS",
            help="Load of a recording whose name does not tell it; may be repeated.",
        ),
    ] = None,
    progress: Progress = None,
    as_json: Json = False,
) -> None:
    """Identify a real silicone beam that is let go by hand, and predict its other recordings.

    Finds the release in each recording, identifies stiffness, damping and creep by least squares through
    whole rollouts of the training recordings, and writes errors of the tip markers (beam.md, .json) and a
    figure.
    """
    _prepare(out, None, None)
    from knode_cosserat.studies.beam import rerun

    names = None if train is None else _names(train)
    loads = _loads(load or [])

    def told(line: str) -> None:
        if wanted(progress):
            typer.echo(line, err=True)

    _run(
        lambda **how: rerun(out, folder, names, loads, progress=told),
        {"train": names}, out, None, None, None, as_json,
    )  # fmt: skip


@studies.command(
    epilog=examples("study cables data_set/ --out results", "study cables data_set/DLO1 --train 5 --json")
)
def cables(
    folder: Annotated[
        Path,
        typer.Argument(metavar="DIR", help="Folder with NAME/train/*.pkl and NAME/eval/*.pkl, or NAME.npz."),
    ],
    out: Out = Path("cables-study"),
    nodes: Annotated[int, typer.Option(metavar="N", min=5, help="Nodes of the rod.")] = 31,
    space: Annotated[str, typer.Option(metavar="SCHEME", help="Scheme along the rod.")] = "lobatto2",
    train: Annotated[
        int, typer.Option(metavar="N", min=2, help="Motions that are learned from, each cable.")
    ] = 10,
    seconds: Annotated[
        float, typer.Option(metavar="S", min=0.0, help="CPU time for the search of each cable.")
    ] = 400.0,
    as_json: Json = False,
) -> None:
    """Identify cables held by two grippers, and predict the motions in `eval` open loop.

    Positions of markers at 100 Hz, as in DEFORM's data set; pickles are read without running code of theirs.
    Writes cables.json, cables.md, a figure, and a scene of prediction and measurement for each cable.
    """
    _prepare(out, None, None)
    from knode_cosserat.studies.cables.study import CableOptions, rerun

    options = CableOptions(nodes=nodes, space=space, train=train, seconds=seconds)
    _run(
        lambda **how: rerun(out, folder, options=options, tell=lambda line: typer.echo(line, err=True)),
        {"train": train}, out, None, None, None, as_json,
    )  # fmt: skip


# what they share


def _names(given: Sequence[str]) -> list[str]:
    """Names separated by commas, without the endings of files."""
    return [name.strip().removesuffix(".csv") for each in given for name in each.split(",") if name.strip()]


def _loads(given: Sequence[str]) -> dict[str, float]:
    """Masses (kg) by name, from NAME=GRAMS."""
    found = {}
    for each in given:
        name, _, grams = each.rpartition("=")
        try:
            mass = 1e-3 * float(grams)
        except ValueError:
            mass = -1.0
        if not name or not 0.0 <= mass < 10.0:
            raise ValueError(
                f"--load {each!r}: allowed is NAME=GRAMS with 0 to 10000 g, such as beam_run3=30"
            )
        found[name.strip().removesuffix(".csv")] = mass
    return found


def _prepare(out: Path, workers: int | None, dask: str | None) -> None:
    """Whatever would only be noticed at the end is said at the beginning."""
    if workers and dask:
        raise ValueError("--workers is for this machine and --dask for a cluster; give one of them")
    require_writable(folders=[out])
    figures()


def _chosen(option: str, given: str | None, known: Iterable[str]) -> list[str]:
    """Those asked for, in the order of the table. A known name may itself have a comma in it."""
    if given is None:
        return list(known)
    rest = f"{given},"
    found = set()
    while rest.strip():
        # the longest, for one name may begin with another
        name = max((each for each in known if rest.startswith(f"{each},")), key=len, default=None)
        if name is None:
            wrong = rest.partition(",")[0].strip()
            raise ValueError(f"--{option}: {wrong!r} is unknown; allowed is some of {', '.join(known)}")
        found.add(name)
        rest = rest.removeprefix(f"{name},").strip()
    return [name for name in known if name in found]


def _run(
    rerun: Callable[..., Report],
    facts: dict[str, Any],
    out: Path,
    workers: int | None,
    dask: str | None,
    progress: bool | None,
    as_json: bool,
) -> None:
    """Run a study and tell what came out: its table, where things are, how long it took."""
    began = perf_counter()
    report = rerun(workers=workers, dask=dask, progress=wanted(progress))
    seconds = perf_counter() - began
    failed = sum("failed" in cell for cell in report.cells)
    facts |= {
        "cells": len(report.cells),
        "failed": failed,
        "computing_time": round(seconds, 2),
        "written": [str(path) for path in report.tables + report.figures],
    }
    lines = [
        report.tables[0].read_text(encoding="utf-8"),
        f"{len(report.cells)} cells, {failed} of them failed, in {seconds:.0f} s",
        *(f"wrote {path}" for path in report.tables),
        _told(report.figures, out),
    ]
    tell(as_json, facts, lines, out=out if as_json else None)


def _told(figures: Sequence[Path], out: Path) -> str:
    return f"wrote {len(figures)} figure{'s' * (len(figures) > 1)} to {out / 'figures'}"
