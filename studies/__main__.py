"""Studies of the paper, further ones, and those of recordings: `python -m studies NAME`, in a clone.

Modules with a long import time are imported inside the commands.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, Any

import typer

from knode_cosserat.cli import program
from knode_cosserat.cli.arguments import Json, Progress, figures, require_writable, shows_progress
from knode_cosserat.cli.control import PLANTS, control
from knode_cosserat.cli.output import write_output

if TYPE_CHECKING:
    from studies.report import Report


class _Program(program.CommandGroup):
    program = "python -m studies"
    plugins = ""


def _examples(*commands: str) -> str:
    return program.examples(*commands, program=_Program.program)


app = program.command_group(cls=_Program)

Out = Annotated[Path, typer.Option(metavar="DIR", help="Output folder; created if it does not exist.")]
Seeds = Annotated[int, typer.Option(metavar="N", min=1, help="Number of random seeds, 0 to N - 1.")]
WORKERS = typer.Option(
    metavar="N", min=1, help="Worker processes on this machine.", show_default="one per four cores"
)
DASK = typer.Option(
    metavar="ADDRESS", help="Run on the Dask cluster of this scheduler, such as tcp://host:8786."
)
#: options of all studies with jobs: type and default
JOBS: dict[str, tuple[Any, Any]] = {
    "workers": (Annotated[int | None, WORKERS], None),
    "dask": (Annotated[str | None, DASK], None),
    "progress": (Progress, None),
}
ROBOTS = "The paper's robot, three-chamber-arm or three-tube-robot."
#: function that runs a study, and facts on it
Study = tuple[Callable[[], Any], dict[str, Any]]


def _quick(text: str) -> Any:
    return typer.Option("--quick", help=text)


def _subset(names: str) -> Any:
    return typer.Option(metavar="A,B,…", help=f"Subset of {names}.", show_default="all")


@app.callback()
def studies(verbose: program.Verbose = False) -> None:
    """Repeat a study of the paper, or of a folder of recordings."""
    if verbose:
        program.log_details("knode_cosserat", "studies")


# before and after a study


def _prepare(out: Path, workers: int | None = None, dask: str | None = None) -> None:
    """Check options, output folder and matplotlib before a long run."""
    if workers and dask:
        raise ValueError("--workers is for this machine and --dask for a cluster; give one of them")
    require_writable(folders=[out])
    figures()


def _selected(option: str, names: str | None, known: Iterable[str]) -> list[str]:
    """Return the selected names in the order of the table. A known name may contain a comma."""
    if names is None:
        return list(known)
    rest = f"{names},"
    selected = set()
    while rest.strip():
        # the longest match: one name may begin with another
        name = max((each for each in known if rest.startswith(f"{each},")), key=len, default=None)
        if name is None:
            wrong = rest.partition(",")[0].strip()
            raise ValueError(f"--{option}: {wrong!r} is unknown; allowed is a subset of {', '.join(known)}")
        selected.add(name)
        rest = rest.removeprefix(f"{name},").strip()
    return [name for name in known if name in selected]


def _names(options: Sequence[str] | None) -> list[str] | None:
    """Return names separated by commas, without endings of tables; None if the option is not given."""
    if options is None:
        return None
    names = (name.strip().removesuffix(".csv") for option in options for name in option.split(","))
    return [name for name in names if name]


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


def _study(*examples: str, name: str | None = None) -> Callable[[Callable[..., Study]], None]:
    """Return a decorator that makes a command of a study, with the options and the output of all studies.

    A study with the arguments `how` has jobs, and the options of `JOBS`.
    """

    def register(study: Callable[..., Study]) -> None:
        signature = inspect.signature(study, eval_str=True)
        own = [each for each in signature.parameters.values() if each.kind is not each.VAR_KEYWORD]
        with_jobs = len(own) < len(signature.parameters)
        more = (JOBS if with_jobs else {}) | {"as_json": (Json, False)}

        def command(**given: Any) -> None:
            as_json, out = given.pop("as_json"), given["out"]
            _prepare(out, given.get("workers"), given.get("dask"))
            if with_jobs:
                given["progress"] = shows_progress(given["progress"])
            _report(*study(**given), out, as_json)

        own += [
            inspect.Parameter(key, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=kind)
            for key, (kind, default) in more.items()
        ]
        command.__signature__ = inspect.Signature(own)  # type: ignore[attr-defined]
        command.__annotations__ = {each.name: each.annotation for each in own}
        command.__name__, command.__doc__ = study.__name__, study.__doc__
        app.command(name, epilog=_examples(*examples))(command)

    return register


def _report(run: Callable[[], Report], facts: dict[str, Any], out: Path, as_json: bool) -> None:
    """Run a study; print its table, the files written and the computing time."""
    began = perf_counter()
    report = run()
    seconds = perf_counter() - began
    failed = sum("failed" in cell for cell in report.cells)
    facts |= {
        "cells": len(report.cells),
        "failed": failed,
        "computing_time": round(seconds, 2),
        "written": [str(path) for path in report.tables + report.figures],
    }
    count = len(report.figures)
    lines = [
        report.tables[0].read_text(encoding="utf-8"),
        f"{len(report.cells)} cells ({failed} failed) in {seconds:.0f} s",
        *(f"wrote {path}" for path in report.tables),
        f"wrote {count} figure{'s' * (count > 1)} to {out / 'figures'}",
    ]
    write_output(as_json, facts, lines, out=out if as_json else None)


@_study(
    "simulation --out results",
    "simulation --out results --methods baseline,best --seeds 1",
    "simulation --out results --robot three-chamber-arm --methods baseline,paper,best",
    "simulation --out results --dask tcp://scheduler:8786",
)
def simulation(
    out: Out,
    seeds: Seeds = 5,
    methods: Annotated[str | None, _subset("baseline, paper, calibrated, best")] = None,
    robot: Annotated[str, typer.Option(metavar="NAME", help=ROBOTS)] = "delrin-tendon-robot",
    **how: Any,
) -> Study:
    """Repeat the paper's simulation study, Table I, of its robot or of another one.

    Four imperfect models are each trained on two short sines. Writes Table I with the paper's published
    values (table1.md, .csv, .json), figures, trajectories and models. Resumes an earlier run in the same
    folder.
    """
    from studies.methods import METHODS
    from studies.simulation import SETTINGS, rerun

    chosen = _selected("methods", methods, METHODS)
    _selected("robot", robot, SETTINGS)
    facts = {"methods": chosen, "seeds": seeds, "robot": robot}
    return lambda: rerun(out, seeds=range(seeds), methods=chosen, robot=robot, **how), facts


@_study("control --out results", "control --quick --out results", name="control")
def closed_loop(
    out: Out, quick: Annotated[bool, _quick("Fewer and shorter runs: about 10 min.")] = False, **how: Any
) -> Study:
    """Compare controllers in closed loop, with exact and with wrong models.

    Writes tracking errors of predictive control and of its baselines, and checks of limits, observers,
    adaptation and times (control.md; control.json: check, value, limit, ok). Times are those of this machine.
    Resumes an earlier run in the same folder.
    """
    from studies.control import rerun

    return lambda: rerun(out, quick, **how), {"quick": quick}


@_study("environments --quick --out results")
def environments(
    out: Out,
    quick: Annotated[bool, _quick("Shorter trainings and sweeps: less than 10 min.")] = False,
    **how: Any,
) -> Study:
    """Measure environments and sweeps: rates, checks, predictive control, and a policy that PPO learns.

    Writes environments.md and environments.json (check, value, limit, ok), and the policies. It needs the
    extras rl and sweep. Resumes an earlier run in the same folder.
    """
    from studies.environments import rerun

    return lambda: rerun(out, quick, **how), {"quick": quick}


@_study("hardware --quick --out results")
def hardware(
    out: Out, quick: Annotated[bool, _quick("Shorter runs: less than 10 min.")] = False, **how: Any
) -> Study:
    """Try the firmware on an emulated board: tensions, faults, fuzzing, and the whole closed loop.

    Writes hardware.md and hardware.json (check, value, limit, ok). It needs the firmware's tools, as
    firmware/README.md lists them. Resumes an earlier run in the same folder.
    """
    from studies.hardware import rerun

    return lambda: rerun(out, quick, **how), {"quick": quick}


@_study("imperfections --out results", "imperfections --out results --only 'damping,tip mass' --seeds 1")
def imperfections(
    out: Out,
    seeds: Seeds = 1,
    only: Annotated[str | None, _subset("the imperfections, such as damping, tip mass, stiffening")] = None,
    **how: Any,
) -> Study:
    """Measure errors for robots that differ from the model.

    The robots differ by more than a parameter. Each model is learned with the training configuration best,
    from two sines of 30 rows. It predicts 30 s of held-out controls, and of controls with twice the tension.
    Writes imperfections.md, .json and a figure. Resumes an earlier run in the same folder.
    """
    from studies.imperfections import IMPERFECTIONS, rerun

    chosen = _selected("only", only, IMPERFECTIONS)
    facts = {"imperfections": chosen, "seeds": seeds}
    return lambda: rerun(out, seeds=range(seeds), names=chosen, **how), facts


@_study("data --out results", "data --out results --methods baseline,best --seeds 1")
def data(
    out: Out,
    seeds: Seeds = 3,
    methods: Annotated[
        str | None,
        _subset("baseline, best, paper; 'paper, no knowledge', 'network, no knowledge', 'linear (DMDc)'"),
    ] = None,
    **how: Any,
) -> Study:
    """Measure errors against the amount of training data.

    Trains on 5 to 30 rows of one sine, and of two. Compares the paper's imperfect models with predictors
    without a physical model: networks of the same size and a linear predictor (needs the extra `studies`).
    Writes data.md, .json and figures. Resumes an earlier run in the same folder.
    """
    from studies.data_efficiency import ALL, rerun

    chosen = _selected("methods", methods, ALL)
    facts = {"methods": chosen, "seeds": seeds}
    return lambda: rerun(out, seeds=range(seeds), methods=chosen, **how), facts


@_study("estimation --out results")
def estimation(out: Out) -> Study:
    """Measure the error of state estimation.

    Compares the paper's method and the best one. Records the test robot (simulated, so its true states are
    known). Writes the errors of all quantities (estimation.md, .json), a figure, and the bags.
    """
    from studies.estimation import rerun

    return lambda: rerun(out), {}


@_study(
    "recordings bags/",
    "recordings bags/ --train sine_1p0,sine_3p0,rand_0 --out results",
    "recordings bags/ --robot my-robot.yaml --config my-recordings.yaml --train first,second",
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
            help="Subset of: baseline (nominal model), paper-a, paper-b, best (identified model), residual "
            "(a residual on the best model), "
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
    **how: Any,
) -> Study:
    """Learn a robot from recordings, as in the paper's Table II.

    Predicts the recordings that are not used for training. Estimates states, trains the paper's model without
    (A) and with (B) the recordings named rand*, and identifies the best model from measured poses alone.
    Files robot.yaml and recording.yaml in BAGDIR are the defaults of --robot and --config. Writes table2.md,
    .json, figures and models. Resumes an earlier run in the same folder.
    """
    from studies.recordings import METHODS, ROBOT, RecordingsOptions, described_in, rerun

    chosen = _selected("methods", methods, METHODS)
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
    choices: dict[str, Any] = {"train": names, "methods": chosen, "options": options, "simulated": simulated}
    return lambda: rerun(out, bags, **choices, **how), {"methods": chosen, "seeds": seeds}


@_study(
    "beam recordings/ --out results",
    "beam recordings/ --train beam_gravity_V2_b,beam_load52_V2_a --out results",
    "beam recordings/ --load beam_run3=30 --out results",
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
) -> Study:
    """Identify a silicone beam from recordings.

    The beam is real and released by hand; recordings not used for training are predicted. Detects the release
    in each recording, and identifies stiffness, damping and creep by least squares over whole rollouts of the
    training recordings. Writes the errors of the tip markers (beam.md, .json) and a figure.
    """
    from studies.beam import rerun

    names = _names(train)

    def tell(line: str) -> None:
        if shows_progress(progress):
            typer.echo(line, err=True)

    loads = _loads(load or [])
    return lambda: rerun(out, folder, names, loads, tell=tell), {"train": names}


@_study("cables data_set/ --out results", "cables data_set/DLO1 --train 5 --json")
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
) -> Study:
    """Identify cables held by two grippers.

    Predicts the motions in `eval` open loop. Reads marker positions at 100 Hz in the format of the DEFORM
    data set; pickle files are read without running code from them. Writes cables.json, cables.md, a figure,
    and a 3-D scene of prediction and measurement for each cable.
    """
    from studies.cables.study import CableOptions, rerun

    options = CableOptions(nodes=nodes, space=space, train=train, seconds=seconds)

    def tell(line: str) -> None:
        typer.echo(line, err=True)

    return lambda: rerun(out, folder, options=options, tell=tell), {"train": train}


@_study("virtual-robots --robots 20 --out results", name="virtual-robots")
def virtual_robots(
    out: Out = Path("virtual-robots-study"),
    robots: Annotated[int, typer.Option(metavar="N", min=1, help="Number of robots.")] = 20,
    first: Annotated[int, typer.Option(metavar="SEED", min=0, help="Seed of the first one.")] = 0,
    arms: Annotated[bool, typer.Option("--arms", help="Arms with chambers, in equilibria.")] = False,
    **how: Any,
) -> Study:
    """Identify test robots with random, known imperfections.

    Each robot is recorded with noise, identified from three recordings, and evaluated on two others. Writes
    the improvement over the nominal robot, missed and false effects, and the coverage of intervals and bands
    (virtual_robots.md, .json). A robot takes some minutes; --arms, less. Resumes an
    earlier run in the same folder.
    """
    from studies.virtual_robots import rerun

    seeds = range(first, first + robots)
    return lambda: rerun(out, seeds, arms, **how), {"robots": robots, "first": first, "arms": arms}


# a loop around another simulator's robot


def _elastica(text: str, dt: float, sensor: Any) -> Any:
    from studies.elastica.plant import parsed_plant

    return parsed_plant(text, dt, sensor)


PLANTS["elastica"] = _elastica
app.command(
    "loop",
    help="Close a loop as `knode-cosserat control` does; --plant elastica:ROBOT,lag=0.1 is a robot that "
    "PyElastica simulates, with friction and lag (extra `studies`).",
    epilog=_examples(
        "loop found.yaml --plant elastica:my-robot.yaml,friction=0.2 --lag 0.06 --reference path.csv"
    ),
)(control)


if __name__ == "__main__":
    program.main(app)
