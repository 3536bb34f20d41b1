"""The commands that rerun the paper's studies on simulations, and those that go beyond them."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from knode_cosserat.cli.arguments import Json, Progress
from knode_cosserat.cli.program import app, examples, studies
from knode_cosserat.cli.study_options import Dask, Out, Seeds, Workers, chosen_of, prepare, run_study

app.add_typer(studies, name="study")


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
    prepare(out, workers, dask)
    from knode_cosserat.studies.methods import METHODS
    from knode_cosserat.studies.simulation_report import rerun

    chosen = chosen_of("methods", methods, METHODS)
    run_study(
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
    prepare(out, workers, dask)
    from knode_cosserat.studies.imperfections import IMPERFECTIONS
    from knode_cosserat.studies.imperfections_report import rerun

    chosen = chosen_of("only", only, IMPERFECTIONS)
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
        _some("baseline, best, paper; 'paper, no knowledge', 'network, no knowledge', 'linear (DMDc)'"),
    ] = None,
    workers: Workers = None,
    dask: Dask = None,
    progress: Progress = None,
    as_json: Json = False,
) -> None:
    """Study how much data learning needs: errors from 5 to 30 rows of one sine and of two.

    With the paper's imperfect models, and without any knowledge: networks of the same size, and a linear
    predictor (needs the extra `bench`). Writes data.md, .json and figures; goes on where an earlier run on
    the folder stopped.
    """
    prepare(out, workers, dask)
    from knode_cosserat.studies.data_efficiency import ALL
    from knode_cosserat.studies.data_report import rerun

    chosen = chosen_of("methods", methods, ALL)
    run_study(
        lambda **how: rerun(out, seeds=range(seeds), methods=chosen, **how),
        {"methods": chosen, "seeds": seeds}, out, workers, dask, progress, as_json,
    )  # fmt: skip


@studies.command(epilog=examples("study estimation --out results"))
def estimation(out: Out, as_json: Json = False) -> None:
    """Study the accuracy of states estimated from recordings: the paper's method, and the best.

    Records the virtual robot (simulated: its states are known) and writes the errors of every quantity
    (estimation.md, .json) and a figure; the bags stay in the folder.
    """
    prepare(out, None, None)
    from knode_cosserat.studies.estimation import rerun

    run_study(
        lambda **how: rerun(out),
        {}, out, None, None, None, as_json,
    )  # fmt: skip
