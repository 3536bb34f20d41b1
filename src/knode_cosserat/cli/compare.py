"""Commands on trajectories: evaluate, plot."""

from __future__ import annotations

import enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from knode_cosserat.cli.arguments import (
    Changes,
    Json,
    Picture,
    Progress,
    ensemble_of,
    figures,
    is_trajectory,
    require_writable,
    system_of,
    trajectory_of,
    wanted,
)
from knode_cosserat.cli.program import app, examples
from knode_cosserat.cli.telling import table, tell

if TYPE_CHECKING:
    from knode_cosserat.learning.ensemble import Ensemble
    from knode_cosserat.rods.system import System
    from knode_cosserat.trajectory import Trajectory


class Kind(enum.StrEnum):
    """The figures of a trajectory that `plot` can draw."""

    overview = "overview"
    rods = "rods"
    tip = "tip"
    tensions = "tensions"


@app.command(
    epilog=examples(
        "evaluate prediction.nc truth.nc",
        "evaluate model truth.nc",
        "evaluate delrin-tendon-robot truth.nc --set youngs_modulus=10e9 --rows 100",
    )
)
def evaluate(
    prediction: Annotated[
        str,
        typer.Argument(
            metavar="PREDICTION",
            help="A trajectory file; or a model, an ensemble (a folder; its mean counts) or a robot, "
            "which is simulated under each reference's controls.",
        ),
    ],
    references: Annotated[list[Path], typer.Argument(metavar="REFERENCE", help="Trajectory files.")],
    changes: Changes = None,
    rows: Annotated[
        int | None,
        typer.Option(metavar="N", min=1, help="Compare the first N rows only; the paper's tables: 100."),
    ] = None,
    progress: Progress = None,
    as_json: Json = False,
) -> None:
    """Measure how far a prediction is from references.

    Tip DTW is the dynamic-time-warping distance between the tip paths in m, pose MSE the mean squared error
    of positions and Euler angles times 1000 (both as in the paper), tip RMSE the root mean square distance of
    the tips in m.
    """
    import knode_cosserat as kc

    given: Trajectory | System | Ensemble
    if not is_trajectory(prediction):
        given = ensemble_of(prediction, changes) or system_of(prediction, changes)
    elif changes:
        raise ValueError(f"--set changes a robot; {prediction} is a trajectory")
    else:
        given = trajectory_of(Path(prediction))
    found = []
    for path in references:
        reference = trajectory_of(path)
        try:
            own = (
                given[:rows]
                if isinstance(given, kc.Trajectory)
                else _driven(given, reference, rows, wanted(progress))
            )
            measures = {measure.__name__: measure(own, reference[:rows]) for measure in _measures()}
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None
        found.append({"reference": str(path), "rows": len(reference.time[:rows]), **measures})
    rows_told: list[list[str]] = [["reference", "rows", "tip DTW [m]", "pose MSE [1e-3]", "tip RMSE [m]"]]
    for name, count, *numbers in (one.values() for one in found):
        rows_told.append([name, str(count), *(f"{number:.4g}" for number in numbers)])
    tell(as_json, {"prediction": prediction, "references": found}, table(rows_told))


@app.command(epilog=examples("plot truth.nc --out truth.png", "plot truth.nc --kind rods --out rods.pdf"))
def plot(
    trajectory: Annotated[Path, typer.Argument(metavar="TRAJECTORY", help="A trajectory file.")],
    out: Annotated[Path, Picture],
    kind: Annotated[Kind, typer.Option(help="What to draw.")] = Kind.overview,
    as_json: Json = False,
) -> None:
    """Draw a trajectory.

    The rod's shapes over time, the path of its tip, the tensions, or an overview of all three.
    """
    require_writable(figure=out)
    drawing = figures()
    states = trajectory_of(trajectory)
    if kind is Kind.tip:
        figure = drawing.tip_path({trajectory.stem: states})
    else:
        draw = {
            Kind.overview: drawing.overview,
            Kind.rods: drawing.rod_shapes,
            Kind.tensions: drawing.tensions,
        }
        figure = draw[kind](states)
    figure.savefig(out)
    tell(as_json, {"trajectory": str(trajectory), "kind": kind.value}, [], out=out)


def _measures() -> tuple[Any, ...]:
    import knode_cosserat as kc

    return kc.tip_dtw, kc.pose_mse, kc.tip_rmse


def _driven(system: System | Ensemble, reference: Trajectory, rows: int | None, progress: bool) -> Any:
    """From rest under the controls of the reference, by the same schemes; an ensemble's mean."""
    import knode_cosserat as kc
    from knode_cosserat.learning.ensemble import Ensemble, Prediction

    if np.ndim(reference.y) != 3 or len(reference.time) < 2:
        raise ValueError("allowed is a trajectory of one robot, of two rows or more")
    it = reference.settings or kc.Settings()
    options: Any = {
        "time": it.time, "space": it.space, "start": it.start, "newton": it.newton, "progress": progress,
    }  # fmt: skip
    controls, dt = reference.control[1:], reference.dt
    if isinstance(system, Ensemble):
        return Prediction([member[:rows] for member in system.predict(controls, dt, **options).members])
    return kc.simulate(system, controls, dt, **options)[:rows]
