"""Commands of the studies on simulated robots: the paper's, and further ones."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from knode_cosserat.cli.arguments import Json, Progress
from knode_cosserat.cli.program import app, examples, studies
from knode_cosserat.cli.study_options import Dask, Out, Seeds, Workers, prepare, run_study, selected_names

app.add_typer(studies, name="study")


def _subset(names: str) -> Any:
    return typer.Option(metavar="A,B,…", help=f"Subset of {names}.", show_default="all")


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
    methods: Annotated[str | None, _subset("baseline, paper, calibrated, best")] = None,
    workers: Workers = None,
    dask: Dask = None,
    progress: Progress = None,
    as_json: Json = False,
) -> None:
    """Repeat the paper's simulation study, Table I.

    Four imperfect models are each trained on two short sines. Writes Table I with the paper's published
    values (table1.md, .csv, .json), figures, trajectories and models. Resumes an earlier run in the same
    folder.
    """
    prepare(out, workers, dask)
    from knode_cosserat.studies.methods import METHODS
    from knode_cosserat.studies.simulation_report import rerun

    chosen = selected_names("methods", methods, METHODS)
    run_study(
        lambda **how: rerun(out, seeds=range(seeds), methods=chosen, **how),
        {"methods": chosen, "seeds": seeds}, out, workers, dask, progress, as_json,
    )  # fmt: skip


@studies.command(
    "control", epilog=examples("study control --out results", "study control --quick --out results")
)
def closed_loop(
    out: Out,
    quick: Annotated[bool, typer.Option("--quick", help="Fewer and shorter runs: about 10 min.")] = False,
    workers: Workers = None,
    dask: Dask = None,
    progress: Progress = None,
    as_json: Json = False,
) -> None:
    """Compare controllers in closed loop, with exact and with wrong models.

    Writes tracking errors of predictive control and of its baselines, and checks of limits, observers,
    adaptation and times (control.md; control.json: check, value, limit, ok). Times are those of this machine.
    Resumes an earlier run in the same folder.
    """
    prepare(out, workers, dask)
    from knode_cosserat.studies.control import rerun

    run_study(lambda **how: rerun(out, quick, **how), {"quick": quick}, out, workers, dask, progress, as_json)


@studies.command(epilog=examples("study environments --quick --out results"))
def environments(
    out: Out,
    quick: Annotated[
        bool, typer.Option("--quick", help="Shorter trainings and sweeps: less than 10 min.")
    ] = False,
    workers: Workers = None,
    dask: Dask = None,
    progress: Progress = None,
    as_json: Json = False,
) -> None:
    """Measure environments and sweeps: rates, checks, predictive control, and a policy that PPO learns.

    Writes environments.md and environments.json (check, value, limit, ok), and the policies. It needs the
    extras rl and sweep. Resumes an earlier run in the same folder.
    """
    prepare(out, workers, dask)
    from knode_cosserat.studies.environments import rerun

    run_study(lambda **how: rerun(out, quick, **how), {"quick": quick}, out, workers, dask, progress, as_json)


@studies.command(epilog=examples("study hardware --quick --out results"))
def hardware(
    out: Out,
    quick: Annotated[bool, typer.Option("--quick", help="Shorter runs: less than 10 min.")] = False,
    workers: Workers = None,
    dask: Dask = None,
    progress: Progress = None,
    as_json: Json = False,
) -> None:
    """Try the firmware on an emulated board: tensions, faults, fuzzing, and the whole closed loop.

    Writes hardware.md and hardware.json (check, value, limit, ok). It needs the firmware's tools, as
    firmware/README.md lists them. Resumes an earlier run in the same folder.
    """
    prepare(out, workers, dask)
    from knode_cosserat.studies.hardware import rerun

    run_study(lambda **how: rerun(out, quick, **how), {"quick": quick}, out, workers, dask, progress, as_json)


@studies.command(
    epilog=examples(
        "study imperfections --out results",
        "study imperfections --out results --only 'damping,tip mass' --seeds 1",
    )
)
def imperfections(
    out: Out,
    seeds: Seeds = 1,
    only: Annotated[str | None, _subset("the imperfections, such as damping, tip mass, stiffening")] = None,
    workers: Workers = None,
    dask: Dask = None,
    progress: Progress = None,
    as_json: Json = False,
) -> None:
    """Measure errors for robots that differ from the model.

    The robots differ by more than a parameter. Each model is learned with the preset best. It is trained on
    two sines of 30 rows. It predicts 30 s of held-out controls, and of controls with twice the tension.
    Writes imperfections.md, .json and a figure. Resumes an earlier run in the same folder.
    """
    prepare(out, workers, dask)
    from knode_cosserat.studies.imperfections import IMPERFECTIONS
    from knode_cosserat.studies.imperfections_report import rerun

    chosen = selected_names("only", only, IMPERFECTIONS)
    run_study(
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
        _subset("baseline, best, paper; 'paper, no knowledge', 'network, no knowledge', 'linear (DMDc)'"),
    ] = None,
    workers: Workers = None,
    dask: Dask = None,
    progress: Progress = None,
    as_json: Json = False,
) -> None:
    """Measure errors against the amount of training data.

    Trains on 5 to 30 rows of one sine, and of two. Compares the paper's imperfect models with predictors
    without a physical model: networks of the same size and a linear predictor (needs the extra `bench`).
    Writes data.md, .json and figures. Resumes an earlier run in the same folder.
    """
    prepare(out, workers, dask)
    from knode_cosserat.studies.data_efficiency import ALL
    from knode_cosserat.studies.data_report import rerun

    chosen = selected_names("methods", methods, ALL)
    run_study(
        lambda **how: rerun(out, seeds=range(seeds), methods=chosen, **how),
        {"methods": chosen, "seeds": seeds}, out, workers, dask, progress, as_json,
    )  # fmt: skip


@studies.command(epilog=examples("study estimation --out results"))
def estimation(out: Out, as_json: Json = False) -> None:
    """Measure the error of state estimation.

    Compares the paper's method and the best one. Records the virtual robot (simulated, so its true states are
    known). Writes the errors of all quantities (estimation.md, .json), a figure, and the bags.
    """
    prepare(out, None, None)
    from knode_cosserat.studies.estimation import rerun

    run_study(
        lambda **how: rerun(out),
        {}, out, None, None, None, as_json,
    )  # fmt: skip
