"""Commands of the studies on recordings: robots, a beam, cables, virtual robots."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from knode_cosserat.cli.arguments import Json, Progress, shows_progress
from knode_cosserat.cli.program import examples, studies
from knode_cosserat.cli.study_options import Dask, Out, Seeds, Workers, prepare, run_study, selected_names


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
            help="Training recordings: file names without endings. All others are predicted.",
            show_default="sine_1p0, sine_3p0, rand_0",
        ),
    ] = None,
    out: Out = Path("recordings-study"),
    robot: Annotated[
        str | None,
        typer.Option(
            metavar="ROBOT",
            help="Nominal robot: a catalog name or a file.",
            show_default="robot.yaml in BAGDIR, or delrin-tendon-robot",
        ),
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option(
            metavar="YAML",
            help="Meaning of the recordings' topics or columns.",
            show_default="recording.yaml in BAGDIR, or NAME.yaml of robot record; else the paper's robot for "
            "bags, titles for tables",
        ),
    ] = None,
    start: Annotated[
        float | None,
        typer.Option(
            metavar="S",
            min=0.0,
            help="Start time of predictions (s), at which the robot rests.",
            show_default="1, and 0 for names that begin with step",
        ),
    ] = None,
    seconds: Annotated[float, typer.Option(metavar="S", min=0.1, help="Duration of predictions (s).")] = 10.0,
    seeds: Seeds = 5,
    methods: Annotated[
        str,
        typer.Option(
            metavar="A,B,…",
            help="Subset of: baseline (nominal model), paper-a, paper-b, best (identified model), network "
            "(passive network on the nominal model), residual (passive network on the best model), "
            "calibrated (nominal model with five identified parameters).",
        ),
    ] = "baseline,paper-a,paper-b,best",
    simulated: Annotated[
        bool | None,
        typer.Option(
            "--simulated/--physical",
            help="Label the robot as simulated or physical in the report.",
            show_default="stated by the recordings",
        ),
    ] = None,
    workers: Workers = None,
    dask: Dask = None,
    progress: Progress = None,
    as_json: Json = False,
) -> None:
    """Learn a robot from recordings, as in the paper's Table II.

    Predicts the recordings that are not used for training. Estimates states, trains the paper's model without
    (A) and with (B) the recordings named rand*, and identifies the best model from measured poses alone.
    Files robot.yaml and recording.yaml in BAGDIR are the defaults of --robot and --config. Writes table2.md,
    .json, figures and models. Resumes an earlier run in the same folder.
    """
    prepare(out, workers, dask)
    from knode_cosserat.studies.recordings import METHODS, ROBOT, RecordingsOptions, described_in
    from knode_cosserat.studies.recordings_report import rerun

    chosen = selected_names("methods", methods, METHODS)
    names = None if train is None else [name.strip() for each in train for name in each.split(",")]
    defaults = described_in(bags)
    used = [
        defaults[key]
        for key, option in (("robot", robot), ("config", config))
        if key in defaults and option is None
    ]
    if used:
        typer.echo(f"using {' and '.join(path.name for path in used)} of {bags}", err=True)
    files = {key: str(path) for key, path in defaults.items()}
    nominal = files.get("robot", ROBOT) if robot is None else robot
    columns = files.get("config") if config is None else str(config)
    options = RecordingsOptions(nominal, columns, start, seconds, seeds)
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
            help="Training recordings: file names without endings. All others are predicted.",
            show_default="beam_gravity_V2_b, beam_load52_V2_a; else one for each of the two lightest loads",
        ),
    ] = None,
    load: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=GRAMS",
            help="Load (g) of a recording whose file name does not state it; may be repeated.",
        ),
    ] = None,
    progress: Progress = None,
    as_json: Json = False,
) -> None:
    """Identify a silicone beam from recordings.

    The beam is real and released by hand; recordings not used for training are predicted. Detects the release
    in each recording, and identifies stiffness, damping and creep by least squares over whole rollouts of the
    training recordings. Writes the errors of the tip markers (beam.md, .json) and a figure.
    """
    prepare(out, None, None)
    from knode_cosserat.studies.beam import rerun

    names = None if train is None else _names(train)
    loads = _loads(load or [])

    def report(line: str) -> None:
        if shows_progress(progress):
            typer.echo(line, err=True)

    run_study(
        lambda **how: rerun(out, folder, names, loads, progress=report),
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
    nodes: Annotated[int, typer.Option(metavar="N", min=5, help="Number of nodes of the rod.")] = 31,
    space: Annotated[str, typer.Option(metavar="SCHEME", help="Scheme along the rod.")] = "lobatto2",
    train: Annotated[
        int, typer.Option(metavar="N", min=2, help="Number of training motions of each cable.")
    ] = 10,
    seconds: Annotated[
        float, typer.Option(metavar="S", min=0.0, help="CPU time of the search for each cable (s).")
    ] = 400.0,
    as_json: Json = False,
) -> None:
    """Identify cables held by two grippers.

    Predicts the motions in `eval` open loop. Reads marker positions at 100 Hz in the format of the DEFORM
    data set; pickle files are read without running code from them. Writes cables.json, cables.md, a figure,
    and a 3-D scene of prediction and measurement for each cable.
    """
    prepare(out, None, None)
    from knode_cosserat.studies.cables.study import CableOptions, rerun

    options = CableOptions(nodes=nodes, space=space, train=train, seconds=seconds)
    run_study(
        lambda **how: rerun(out, folder, options=options, tell=lambda line: typer.echo(line, err=True)),
        {"train": train}, out, None, None, None, as_json,
    )  # fmt: skip


def _names(options: Sequence[str]) -> list[str]:
    """Return names separated by commas, without file endings."""
    return [
        name.strip().removesuffix(".csv") for option in options for name in option.split(",") if name.strip()
    ]


def _loads(options: Sequence[str]) -> dict[str, float]:
    """Return masses (kg) by name, from NAME=GRAMS."""
    masses = {}
    for option in options:
        name, _, grams = option.rpartition("=")
        try:
            mass = 1e-3 * float(grams)
        except ValueError:
            mass = -1.0
        if not name or not 0.0 <= mass < 10.0:
            raise ValueError(
                f"--load must be NAME=GRAMS with 0 to 10000 g, such as beam_run3=30 (got {option!r})"
            )
        masses[name.strip().removesuffix(".csv")] = mass
    return masses


@studies.command(
    "virtual-robots",
    epilog=examples("study virtual-robots --robots 20 --out results"),
)
def virtual_robots(
    out: Out = Path("virtual-robots-study"),
    robots: Annotated[int, typer.Option(metavar="N", min=1, help="Number of robots: seeds 0 to N - 1.")] = 20,
    workers: Workers = None,
    dask: Dask = None,
    progress: Progress = None,
    as_json: Json = False,
) -> None:
    """Identify virtual robots with random, known imperfections.

    Each robot is recorded with noise, identified from three recordings, and evaluated on two others. Writes
    the improvement over the nominal robot, missed and false effects, and the coverage of confidence intervals
    (virtual_robots.md, .json). A robot takes some minutes. Resumes an earlier run in the same folder.
    """
    prepare(out, workers, dask)
    from knode_cosserat.studies.virtual_robots import rerun

    run_study(
        lambda **how: rerun(out, range(robots), **how),
        {"robots": robots}, out, workers, dask, progress, as_json,
    )  # fmt: skip
