"""Commands on trajectories: evaluate, plot, animate."""

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
    Space,
    ensemble_of,
    figures,
    is_trajectory,
    require_writable,
    system_of,
    trajectory_of,
    wanted,
)
from knode_cosserat.cli.identify import Config, Seconds, Start, Step, evaluate_on_recordings
from knode_cosserat.cli.program import app, examples
from knode_cosserat.cli.telling import table, tell

if TYPE_CHECKING:
    from knode_cosserat.learning.ensemble import Ensemble
    from knode_cosserat.rods.system import System
    from knode_cosserat.trajectory import Trajectory


class Kind(enum.StrEnum):
    """The figures of a trajectory that `plot` can draw."""

    overview = "overview"
    shape = "shape"
    path = "path"
    tip = "tip"
    states = "states"
    tensions = "tensions"
    error = "error"
    compare = "compare"


class Seen(enum.StrEnum):
    """From where a robot is looked at."""

    xyz = "xyz"
    xy = "xy"
    xz = "xz"
    yz = "yz"


Several = Annotated[
    list[Path], typer.Argument(metavar="TRAJECTORY…", help="Trajectory files; the first is the reference.")
]
View = Annotated[Seen, typer.Option(help="In space, or along an axis.")]
Columns = Annotated[
    int, typer.Option(min=1, max=2, metavar="N", help="As wide as one column of a paper, or as two.")
]


@app.command(
    epilog=examples(
        "evaluate prediction.nc truth.nc",
        "evaluate model truth.nc",
        "evaluate delrin-tendon-robot truth.nc --set youngs_modulus=10e9 --rows 100",
        "evaluate found.yaml unseen.bag --json",
        "evaluate my-robot.yaml a.csv b.csv --config my-recording.yaml --start 1",
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
    references: Annotated[
        list[Path],
        typer.Argument(metavar="REFERENCE", help="Trajectory files; or recordings: bags or tables."),
    ],
    changes: Changes = None,
    rows: Annotated[
        int | None,
        typer.Option(metavar="N", min=1, help="Compare the first N rows only; the paper's tables: 100."),
    ] = None,
    config: Config = None,
    start: Start = None,
    seconds: Seconds = None,
    dt: Step = 0.0125,
    space: Space = "lobatto2",
    progress: Progress = None,
    as_json: Json = False,
) -> None:
    """Measure how far a prediction is from references.

    Tip DTW is the dynamic-time-warping distance between the tip paths in m, pose MSE the mean squared error
    of positions and Euler angles times 1000 (both as in the paper), tip RMSE the root mean square distance of
    the tips in m. Recordings are predicted by their measured tensions, from the equilibrium at their start;
    rotations are those since then, and the options from --config to --space are theirs.
    """
    import knode_cosserat as kc

    if config is not None or not any(is_trajectory(str(path)) for path in references):
        system = system_of(prediction, changes)
        return evaluate_on_recordings(system, references, config, start, seconds, dt, space, as_json)
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


@app.command(
    epilog=examples(
        "plot truth.nc --out truth.png",
        "plot truth.nc --kind shape --view xz --out side.pdf",
        "plot truth.nc prediction.nc --kind error --out error.svg",
    )
)
def plot(
    trajectories: Several,
    out: Annotated[Path, Picture],
    kind: Annotated[
        Kind, typer.Option(help="What to draw.", show_default="overview, and compare of several")
    ] = Kind.overview,
    view: View = Seen.xyz,
    columns: Columns = 1,
    as_json: Json = False,
) -> None:
    """Draw one trajectory, or several over each other.

    One: its shapes over time, tensions, or an overview. Any number: path of the tip, the tip or the states
    over time. Two or more: how far the tips are from the first one's (error), or shapes and tips (compare).
    """
    require_writable(figure=out)
    drawing = figures()
    states = _by_stem(trajectories)
    first, *others = states.values()
    if others and kind is Kind.overview:
        kind = Kind.compare
    if others and kind in (Kind.shape, Kind.tensions):
        raise ValueError(f"--kind {kind} draws one trajectory; {len(states)} were given")
    if not others and kind in (Kind.error, Kind.compare):
        raise ValueError(f"--kind {kind} needs a reference and one trajectory or more; one was given")
    rest = dict(list(states.items())[1:])
    draw = {
        Kind.overview: lambda: drawing.overview(first),
        Kind.shape: lambda: drawing.shape(first, view=_seen(first, view), columns=columns),
        Kind.path: lambda: drawing.path(states, view=_seen(first, view), columns=columns),
        Kind.tip: lambda: drawing.tips(states, columns=columns),
        Kind.states: lambda: drawing.states(states, columns=columns),
        Kind.tensions: lambda: drawing.tensions(first, columns=columns),
        Kind.error: lambda: drawing.error(first, rest, columns=columns),
        Kind.compare: lambda: drawing.compare(first, rest),
    }
    draw[kind]().savefig(out)
    tell(as_json, {"trajectories": [str(path) for path in trajectories], "kind": kind.value}, [], out=out)


@app.command(
    epilog=examples(
        "animate truth.nc --out truth.gif", "animate truth.nc prediction.nc --fps 20 --view xz --out both.mp4"
    )
)
def animate(
    trajectories: Several,
    out: Annotated[Path, typer.Option(metavar="FILE", help="Write the motion to this GIF or MP4 file.")],
    fps: Annotated[float, typer.Option(metavar="F", help="Pictures a second, 1 to 50.")] = 25.0,
    speed: Annotated[float, typer.Option(metavar="S", help="1 is real time, 0.5 half as fast.")] = 1.0,
    view: View = Seen.xyz,
    columns: Columns = 1,
    as_json: Json = False,
) -> None:
    """Show how robots move: one trajectory, or several over each other, in real time.

    A GIF needs matplotlib only, an MP4 the program ffmpeg.
    """
    require_writable(out)
    drawing = figures()
    states = _by_stem(trajectories)
    seen = _seen(next(iter(states.values())), view)
    drawing.animate(states, out, fps=fps, speed=speed, view=seen, columns=columns)
    tell(as_json, {"trajectories": [str(path) for path in trajectories]}, [], out=out)


def _by_stem(paths: list[Path]) -> dict[str, Trajectory]:
    """Trajectories by their files' names, or whole paths where names are the same."""
    stems = [path.stem for path in paths]
    names = stems if len(set(stems)) == len(stems) else [str(path) for path in paths]
    if len(set(names)) < len(names):
        raise ValueError(f"{names[0]}: given twice")
    return {name: trajectory_of(path) for name, path in zip(names, paths, strict=True)}


def _seen(trajectory: Trajectory, view: Seen) -> str | None:
    """Return the requested view; for a planar system, its only view."""
    return None if np.shape(trajectory.position)[-1] == 2 and view is Seen.xyz else view.value


def _measures() -> tuple[Any, ...]:
    import knode_cosserat as kc

    return kc.metrics.tip_dtw, kc.metrics.pose_mse, kc.metrics.tip_rmse


def _driven(system: System | Ensemble, reference: Trajectory, rows: int | None, progress: bool) -> Any:
    """From rest under the controls of the reference, by the same schemes; an ensemble's mean."""
    import knode_cosserat as kc
    from knode_cosserat.learning.ensemble import Ensemble, Prediction

    if np.ndim(reference.y) != 3 or len(reference.time) < 2:
        raise ValueError("allowed is a trajectory of one robot, of two rows or more")
    it = reference.settings or kc.solvers.Settings()
    options: Any = {
        "time": it.time, "space": it.space, "start": it.start, "newton": it.newton, "progress": progress,
    }  # fmt: skip
    controls, dt = reference.control[1:], reference.dt
    if isinstance(system, Ensemble):
        return Prediction([member[:rows] for member in system.predict(controls, dt, **options).members])
    return kc.simulate(system, controls, dt, **options)[:rows]
