"""The commands of studies on measured data: recordings of robots, a beam, cables."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from knode_cosserat.cli.arguments import Json, Progress, wanted
from knode_cosserat.cli.program import examples, studies
from knode_cosserat.cli.study_options import Dask, Out, Seeds, Workers, chosen_of, prepare, run_study


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
        str | None,
        typer.Option(
            metavar="ROBOT",
            help="Nominal robot: a name or a file.",
            show_default="robot.yaml in BAGDIR, or delrin-tendon-robot",
        ),
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option(
            metavar="YAML",
            help="What the recordings' topics or columns mean.",
            show_default="recording.yaml in BAGDIR; or the paper's robot for bags, a table's own titles",
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
            help="Some of those; network: a passive network on the nominal model; residual: one on the best; "
            "calibrated: the nominal model with five of its numbers found.",
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
    names begin with rand, and identifies the best model from measured poses alone. The folder's robot.yaml
    and recording.yaml are taken for --robot and --config unless these are given. Writes table2.md, .json,
    figures and models; goes on where an earlier run on the folder stopped.
    """
    prepare(out, workers, dask)
    from knode_cosserat.studies.recordings import METHODS, ROBOT, Options, described_in
    from knode_cosserat.studies.recordings_report import rerun

    chosen = chosen_of("methods", methods, METHODS)
    names = None if train is None else [name.strip() for each in train for name in each.split(",")]
    own = described_in(bags)
    taken = [
        own[what] for what, given in (("robot", robot), ("config", config)) if what in own and given is None
    ]
    if taken:
        typer.echo(f"taken from {bags}: {' and '.join(path.name for path in taken)}", err=True)
    files = {what: str(path) for what, path in own.items()}
    known = files.get("robot", ROBOT) if robot is None else robot
    columns = files.get("config") if config is None else str(config)
    options = Options(known, columns, start, seconds, seeds)
    run_study(
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
    prepare(out, None, None)
    from knode_cosserat.studies.beam import rerun

    names = None if train is None else _names(train)
    loads = _loads(load or [])

    def told(line: str) -> None:
        if wanted(progress):
            typer.echo(line, err=True)

    run_study(
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
    prepare(out, None, None)
    from knode_cosserat.studies.cables.study import CableOptions, rerun

    options = CableOptions(nodes=nodes, space=space, train=train, seconds=seconds)
    run_study(
        lambda **how: rerun(out, folder, options=options, tell=lambda line: typer.echo(line, err=True)),
        {"train": train}, out, None, None, None, as_json,
    )  # fmt: skip


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


@studies.command(
    "virtual-robots",
    epilog=examples("study virtual-robots --robots 20 --out results"),
)
def virtual_robots(
    out: Out = Path("virtual-robots-study"),
    robots: Annotated[int, typer.Option(metavar="N", min=1, help="Number of robots, seeds 0 to N - 1.")] = 20,
    workers: Workers = None,
    dask: Dask = None,
    progress: Progress = None,
    as_json: Json = False,
) -> None:
    """Identify virtual robots with random imperfections, whose truth is known.

    Each is recorded with noise, identified from three recordings, and predicts two others. Writes how much
    better than the data sheet, which effects are missed or false, and whether intervals hold the true values
    (virtual_robots.md, .json). Some minutes for each robot; goes on where an earlier run stopped.
    """
    prepare(out, workers, dask)
    from knode_cosserat.studies.virtual_robots import rerun

    run_study(
        lambda **how: rerun(out, range(robots), **how),
        {"robots": robots}, out, workers, dask, progress, as_json,
    )  # fmt: skip
