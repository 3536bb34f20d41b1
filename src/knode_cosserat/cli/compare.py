"""Commands that compare and draw trajectories: evaluate, plot, animate."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import numpy as np

from knode_cosserat.cli.arguments import (
    Changes,
    Json,
    Picture,
    Report,
    Sampling,
    argument,
    command_line,
    figures,
    is_recording,
    is_trajectory,
    load_ensemble_folder,
    load_system,
    load_trajectory_file,
    require_writable,
    trajectories_by_name,
)
from knode_cosserat.cli.learn import evaluate_on_recordings
from knode_cosserat.cli.output import table, write_output
from knode_cosserat.cli.program import app

if TYPE_CHECKING:
    from knode_cosserat.learning.ensemble import Ensemble
    from knode_cosserat.rods.system import System
    from knode_cosserat.trajectory import Trajectory


#: kinds of figures that `plot` draws
Kind = Literal["overview", "shape", "path", "tip", "states", "tensions", "error", "compare"]
#: projections of a robot: in space, or onto a coordinate plane
Viewpoint = Literal["xyz", "xy", "xz", "yz"]
Trajectories = Annotated[list[Path], argument("TRAJECTORY…", "Trajectory files; the first is the reference.")]


class _Look(NamedTuple):
    """View and width of a figure.

    Options:
        view (--view): View in space (xyz), or projection onto a coordinate plane.
        columns (--columns N): Width of the figure: one or two columns of a paper.
    """

    view: Viewpoint = "xyz"
    columns: int = 1

    def of(self, trajectory: Trajectory) -> str | None:
        """Return the name of the view; None for the only view of a planar system."""
        is_planar = np.shape(trajectory.position)[-1] == 2
        return None if is_planar and self.view == "xyz" else self.view


class _Pace(NamedTuple):
    """Frame rate and speed of an animation.

    Options:
        fps (--fps F): Frames per second, 1 to 50.
        speed (--speed S): Playback speed: 1 is real time, 0.5 is half speed.
    """

    fps: float = 25.0
    speed: float = 1.0


class _Predictor(NamedTuple):
    """Prediction, or what predicts.

    Options:
        prediction (PREDICTION): Trajectory file; or a robot, model or ensemble (a folder; its mean is
            compared), which is simulated under the controls of each reference.
    """

    prediction: str
    changes: Changes = None

    def load(self) -> Trajectory | System | Ensemble:
        """Return the trajectory, robot, model or ensemble."""
        name, changes = self
        if not is_trajectory(name):
            return load_ensemble_folder(name, changes) or load_system(name, changes)
        if changes:
            raise ValueError(f"--set changes a robot; {name} is a trajectory")
        return load_trajectory_file(Path(name))


@app.command()
def evaluate(
    predictor: _Predictor,
    references: list[Path],
    sampling: Sampling,
    report: Report,
    rows: int | None = None,
    page: Path | None = None,
) -> None:
    """Compute the error of a prediction against references.

    Tip RMSE: root mean square distance of the tips (m). Orientations: root mean square angle between them, in
    --json as rotation_rmse (rad). Tip DTW: dynamic-time-warping distance between the tip paths (m). Pose MSE:
    mean squared error of positions and Euler angles, times 1000; the angles jump at 180 degrees. DTW and MSE
    are defined as in the paper.

    A recording is predicted from its measured controls, starting at the equilibrium under the first ones.
    Rotations are relative to the start. --config, --start, --seconds, --dt, --space and --page apply to
    recordings. An ensemble also gives the part of the measured positions inside its 90 % band.

    Options:
        references (REFERENCE): Trajectory files (.nc); or recordings: bags or tables.
        rows (--rows N≥1): Compare only the first N rows; the paper's tables use 100.
        page (--page FILE.html): Write errors, figures and conditions to this HTML file.

    Examples:
        evaluate prediction.nc truth.nc
        evaluate model truth.nc
        evaluate delrin-tendon-robot truth.nc --set youngs_modulus=10e9 --rows 100
        evaluate found.yaml unseen.bag --json
        evaluate found.yaml unseen.bag other.bag --page errors.html
        evaluate my-robot.yaml a.csv b.csv --config my-recording.yaml --start 1
    """
    import knode_cosserat as kc

    prediction, changes = predictor
    _require_one_kind(prediction, references, sampling.config)
    if sampling.config is not None or not any(is_trajectory(str(path)) for path in references):
        _require_page(page)
        system = load_ensemble_folder(prediction, changes) or load_system(prediction, changes)
        evaluations = evaluate_on_recordings(system, references, sampling, rows)
        if page:
            kc.figures.evaluation_page(evaluations, page, robot=prediction)
        facts = {"recordings": {name: it.to_dict() for name, it in evaluations.items()}}
        words = [f"{name}: {it}" for name, it in evaluations.items()]
        write_output(report.as_json, facts, words, **({"page": page} if page else {}))
        return
    if page:
        raise ValueError("--page shows predictions of recordings; the references are trajectories. Use plot")
    source = predictor.load()
    compared: list[dict[str, Any]] = []
    metrics = kc.metrics
    measures = (metrics.tip_rmse, metrics.rotation_rmse, metrics.tip_dtw, metrics.pose_mse)
    for path in references:
        reference = load_trajectory_file(path)
        try:
            predicted = (
                source[:rows]
                if isinstance(source, kc.Trajectory)
                else _simulated(source, reference, rows, report.shows_progress)
            )
            errors = {measure.__name__: measure(predicted, reference[:rows]) for measure in measures}
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None
        compared.append({"reference": str(path), "rows": len(reference.time[:rows]), **errors})
    heads = ["reference", "rows", "tip RMSE [m]", "orientations [deg]", "tip DTW [m]", "pose MSE [1e-3]"]
    lines = [heads]
    for name, count, tip, angle, *paper in (one.values() for one in compared):
        lines.append([name, str(count), *(f"{each:.4g}" for each in (tip, np.degrees(angle), *paper))])
    write_output(report.as_json, {"prediction": prediction, "references": compared}, table(lines))


@app.command()
def plot(
    trajectories: Trajectories,
    out: Annotated[Path, Picture],
    look: _Look,
    kind: Kind = "overview",
    as_json: Json = False,
) -> None:
    """Draw one trajectory, or overlay several.

    For one trajectory: overview, shape (shapes over time), tensions. For any number: path (of the tip), tip
    and states (over time). For two or more: error (distance of the tips from the first trajectory's) and
    compare (shapes and tips).

    Options:
        kind (--kind): Kind of figure. Default: overview; compare for several trajectories.

    Examples:
        plot truth.nc --out truth.png
        plot truth.nc --kind shape --view xz --out side.pdf
        plot truth.nc prediction.nc --kind error --out error.svg
    """
    require_writable(figure=out)
    drawing = figures()
    states = _distinct_trajectories(trajectories)
    first, *others = states.values()
    if others and kind == "overview":
        kind = "compare"
    if others and kind in ("shape", "tensions"):
        raise ValueError(f"--kind {kind} draws one trajectory; {len(states)} were given. Use --kind compare")
    if not others and kind in ("error", "compare"):
        raise ValueError(f"--kind {kind} needs a reference and at least one other trajectory; one was given")
    rest = dict(list(states.items())[1:])
    looks: dict[str, Any] = {"columns": look.columns}
    draw = {
        "overview": lambda: drawing.overview(first),
        "shape": lambda: drawing.shape(first, view=look.of(first), **looks),
        "path": lambda: drawing.path(states, view=look.of(first), **looks),
        "tip": lambda: drawing.tips(states, **looks),
        "states": lambda: drawing.states(states, **looks),
        "tensions": lambda: drawing.tensions(first, **looks),
        "error": lambda: drawing.error(first, rest, **looks),
        "compare": lambda: drawing.compare(first, rest),
    }
    draw[kind]().savefig(out)
    write_output(as_json, {"trajectories": [str(path) for path in trajectories], "kind": kind}, [], out=out)


@app.command()
def animate(
    trajectories: Trajectories,
    out: Path,
    pace: _Pace,
    look: _Look,
    as_json: Json = False,
) -> None:
    """Animate one trajectory, or several overlaid.

    A GIF needs matplotlib; an MP4 also needs the program ffmpeg.

    Options:
        out (--out FILE): Write the animation to this GIF or MP4 file.

    Examples:
        animate truth.nc --out truth.gif
        animate truth.nc prediction.nc --fps 20 --view xz --out both.mp4
    """
    require_writable(out)
    drawing = figures()
    states = _distinct_trajectories(trajectories)
    view = look.of(next(iter(states.values())))
    drawing.animate(states, out, fps=pace.fps, speed=pace.speed, view=view, columns=look.columns)
    write_output(as_json, {"trajectories": [str(path) for path in trajectories]}, [], out=out)


def _require_page(path: Path | None) -> None:
    """Raise `ValueError` or `ImportError` before a long computation if a page cannot be written."""
    if path is None:
        return
    if path.suffix.lower() not in (".html", ".htm"):
        raise ValueError(f"{path}: the name of a page must end in .html")
    require_writable(path)
    figures()


def _distinct_trajectories(paths: list[Path]) -> dict[str, Trajectory]:
    """Return the trajectories by name. Raises `ValueError` if one is there twice."""
    if len(set(paths)) < len(paths):
        raise ValueError(f"{paths[0]}: given twice; allowed is each file once")
    return trajectories_by_name(paths)


def _require_one_kind(prediction: str, references: list[Path], config: Path | None) -> None:
    """Raise `ValueError` with the right command if recordings and trajectories are mixed up."""
    recordings = [str(path) for path in references if is_recording(str(path))]
    others = [str(path) for path in references if str(path) not in recordings]
    read = ["--config", str(config)] if config else []
    if is_recording(prediction):
        robot = next((name for name in others if not is_trajectory(name)), "ROBOT")
        typed = command_line("evaluate", robot, prediction, *recordings, *read)
        raise ValueError(
            f"{prediction}: this is a recording; the prediction must be a robot or model, and recordings "
            f"follow it. To evaluate a robot on recordings, type: {typed}"
        )
    if recordings and is_trajectory(prediction):
        typed = command_line("evaluate", "ROBOT", *recordings, *(read or ["--config", "recording.yaml"]))
        raise ValueError(
            f"{recordings[0]}: this is a recording; only a robot or model is compared with it, not the "
            f"trajectory {prediction}. Type: {typed}"
        )
    robots = [name for name in others if not is_trajectory(name)]
    if is_trajectory(prediction) and robots:
        raise ValueError(
            f"{robots[0]}: a reference must be a trajectory or a recording; a robot or model comes "
            f"first. Type: {command_line('evaluate', robots[0], prediction)}"
        )
    trajectories = [name for name in others if is_trajectory(name)]
    if recordings and trajectories:
        typed = command_line("evaluate", prediction, *recordings, *(read or ["--config", "recording.yaml"]))
        raise ValueError(
            f"{recordings[0]} is a recording and {trajectories[0]} a trajectory; evaluate them by two "
            f"commands. For recordings, type: {typed}"
        )


def _simulated(system: System | Ensemble, reference: Trajectory, rows: int | None, progress: bool) -> Any:
    """Return the simulation under the reference's controls, with its schemes.

    It starts unstressed if the reference does, and else in its own equilibrium. For an
    ensemble it is the prediction of all members, compared by its mean.
    """
    import knode_cosserat as kc
    from knode_cosserat.learning.ensemble import Ensemble, Prediction
    from knode_cosserat.solvers.initial import named_start

    if np.ndim(reference.y) != 3 or len(reference.time) < 2:
        raise ValueError("allowed is a trajectory of one robot, with two rows or more")
    it = reference.settings or kc.solvers.Settings()
    options: Any = {
        "initial": named_start(reference),
        "time": it.time, "space": it.space, "start": it.start, "newton": it.newton, "between": it.between,
        "progress": progress,
    }  # fmt: skip
    controls, dt = reference.control[1:], reference.dt
    if isinstance(system, Ensemble):
        return Prediction([member[:rows] for member in system.predict(controls, dt, **options).members])
    return kc.simulate(system, controls, dt, **options)[:rows]
