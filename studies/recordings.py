"""The paper's study of a real robot: learning from recordings, and prediction of held-out ones, Table II.

Every held-out recording in the folder is predicted from rest by its tensions alone, and compared with motion
capture. All settings are passed to the jobs as plain values.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float

from knode_cosserat.figures.comparison import METHODS as LOOKS
from knode_cosserat.figures.comparison import REFERENCE, legend_below, require_some
from knode_cosserat.figures.drawing import equal_scales
from knode_cosserat.figures.style import PALETTE, TWO_COLUMNS, new_figure
from knode_cosserat.identification import IdentificationError, identify
from knode_cosserat.identification.evaluate import Evaluation, compared, predict
from knode_cosserat.identification.fit import fit as learn
from knode_cosserat.learning.config import FitConfig, FitError
from knode_cosserat.learning.knode import KNODE
from knode_cosserat.recordings.config import RecordingConfig
from knode_cosserat.recordings.estimation.estimate import estimate_states
from knode_cosserat.recordings.load import load_recording
from knode_cosserat.recordings.measurements import Measurements
from knode_cosserat.recordings.recording import Recording
from knode_cosserat.rods.robot_file import format_robot, load_robot, parse_robot
from knode_cosserat.rods.system import System
from knode_cosserat.rods.tendons import remove_delay
from knode_cosserat.schemes.result import SimulationError
from knode_cosserat.solvers.equilibrium import equilibrium
from knode_cosserat.solvers.segments import DataError
from knode_cosserat.solvers.simulate import simulate
from knode_cosserat.trajectory import Trajectory
from studies import figures, runner
from studies.methods import fitted
from studies.report import (
    MEASURES,
    PAPER_MEASURES,
    Cells,
    Report,
    as_json,
    failures,
    in_words,
    markdown_table,
    spreads,
    write_report,
)
from studies.runner import Job, Product, StudyError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ROBOT = "delrin-tendon-robot"
#: files in a folder of recordings that describe the robot, and its topics or columns
OWN_ROBOT, OWN_CONFIG = "robot.yaml", "recording.yaml"
#: time step of the comparison, and of the paper's models (s); the best model takes steps of a part of it
DT, FINER = 0.05, 4
#: schemes in arclength: of all models, and of the paper's
SPACE, PAPER_SPACE = "lobatto4", "euler"
#: default training recordings: the paper's two sines, and one random recording
TRAIN = ("sine_1p0", "sine_3p0", "rand_0")
#: recordings of steps are compared from their beginning; all others rest for as long (s) first
REST, STEPS = 1.0, "step"
#: seconds that recovery may take in a prediction, where a model needs any
RECOVERY = 2.0
#: recordings whose names begin so are only in Dataset B
RANDOM = "rand"
ENDINGS = (".bag", ".mcap", ".db3", ".csv", ".parquet")


class Window(NamedTuple):
    """Recording, and the part of it that is compared (s)."""

    path: str
    start: float
    seconds: float


def recordings_in(folder: Path) -> dict[str, Path]:
    """Return the recordings in a folder by name: bags, tables, and folders of ROS 2 bags.

    Raises:
        StudyError: there are none, or two have the same name.
    """
    if not folder.is_dir():
        raise StudyError(f"{folder}: no such folder")
    paths = [
        path
        for path in sorted(folder.iterdir())
        if path.suffix in ENDINGS or (path.is_dir() and (path / "metadata.yaml").exists())
    ]
    if not paths:
        raise StudyError(f"{folder}: no recordings there; allowed is {', '.join(ENDINGS)}, and ROS 2 bags")
    by_name: dict[str, Path] = {}
    for path in paths:
        if path.stem in by_name:
            raise StudyError(f"{folder}: {by_name[path.stem].name} and {path.name} have the same name")
        by_name[path.stem] = path
    return by_name


def described_in(folder: Path) -> dict[str, Path]:
    """Return the files in a folder that describe its recordings: "robot" and "config", if there.

    Without recording.yaml, the configuration that `robot record` wrote beside each recording is used, if it
    is the same for all.
    """
    usual = {"robot": folder / OWN_ROBOT, "config": folder / OWN_CONFIG}
    found = {what: path for what, path in usual.items() if path.is_file()}
    beside = [path.with_suffix(".yaml") for path in recordings_in(folder).values()]
    texts = {path.read_bytes() if path.is_file() else None for path in beside}
    if "config" not in found and len(texts) == 1 and None not in texts:
        found["config"] = beside[0]
    return found


def recording_split(names: Sequence[str], train: Sequence[str] | None) -> tuple[list[str], list[str]]:
    """Return the names of the training recordings and of the held-out ones.

    Raises:
        StudyError: a name does not exist, or there is no held-out recording.
    """
    wanted = list(TRAIN if train is None else train)
    missing = [name for name in wanted if name not in names]
    if missing:
        hint = "" if train else "; name those to learn from by --train"
        raise StudyError(f"there is no recording {missing[0]!r}; there are {', '.join(names)}{hint}")
    rest = [name for name in names if name not in wanted]
    if not wanted or not rest:
        raise StudyError(
            "some recordings have to be learned from, and others predicted; there is only one kind"
        )
    return wanted, rest


class RecordingsOptions(NamedTuple):
    """Options of a study of recordings."""

    robot: str = ROBOT
    config: str | None = None
    #: start of the comparison (s); None: `REST`, and 0 for steps
    start: float | None = None
    seconds: float = 10.0
    seeds: int = 5


def jobs(
    paths: Mapping[str, Path], train: Sequence[str], methods: Sequence[str], options: RecordingsOptions
) -> list[Job]:
    """Return one job for each method, with all seeds and recordings, and one for the measurements."""
    windows = {
        name: {
            "path": str(path.resolve()),
            "start": _start(name) if options.start is None else options.start,
            "seconds": options.seconds,
            "content": _checksum(path),
        }
        for name, path in paths.items()
    }
    config = None if options.config is None else RecordingConfig.load(options.config).to_dict()
    robot = format_robot(load_robot(options.robot))
    common = {"robot": robot, "config": config, "recordings": windows, "train": list(train)}
    made = [Job("measured", measured, common)]
    for method in methods:
        own = {"method": method, "seeds": list(range(options.seeds))}
        made.append(Job(method, predicted, {**common, **own}))
    return made


def _start(name: str) -> float:
    return 0.0 if name.startswith(STEPS) else REST


def _checksum(path: Path) -> str:
    files = sorted(path.rglob("*")) if path.is_dir() else [path]
    digest = hashlib.sha256()
    for file in files:
        if file.is_file():
            digest.update(file.read_bytes())
    return digest.hexdigest()


# measurements


class _Read:
    """Recordings of a job, each read once and only if needed."""

    def __init__(self, settings: Any):
        self._settings = settings
        given = settings["config"]
        self._config = None if given is None else RecordingConfig.from_dict(given)
        self._kept: dict[str, Recording] = {}

    def __getitem__(self, name: str) -> Recording:
        if name not in self._kept:
            self._kept[name] = load_recording(self.window(name).path, self._config)
        return self._kept[name]

    def window(self, name: str) -> Window:
        it = self._settings["recordings"][name]
        return Window(it["path"], it["start"], it["seconds"])

    def rows(self, name: str, finer: int = 1) -> Measurements:
        """Return the rows of a window: the paper's rows and one more. Finer rows have mean tensions."""
        _, start, seconds = self.window(name)
        return self[name].sampled(DT / finer, start, start + seconds, mean=finer > 1)


def measured(settings: Any) -> Product:
    """Return the measurements: tip paths, and the origin of the recordings."""
    read = _Read(settings)
    facts: dict[str, Any] = {}
    for name in settings["recordings"]:
        # the rows that the paper keeps: rest, and the states after all controls but the last
        rows = read.rows(name).rows(0, round(read.window(name).seconds / DT))
        facts[name] = {
            "time": _plain(rows.time, 6),
            "tip": _plain(rows.tip_position, 6),
            "simulated": rows.simulated,
            "findings": [f"{it.topic}: {it.message}" for it in read[name].findings if it.severity != "note"],
        }
    return Product(facts, {})


def _plain(values: Any, digits: int) -> Any:
    """Return rounded values for JSON; None for values that are not finite."""
    plain = np.round(np.asarray(values, dtype=float), digits).astype(object)
    plain[~np.isfinite(np.asarray(values, dtype=float))] = None
    return plain.tolist()


# learning


class TrainedSystems(NamedTuple):
    """System for each seed, or the reason of its failure."""

    systems: dict[int, System | str]
    #: steps of the model in one of the comparison, and its scheme in arclength
    finer: int = 1
    space: str = SPACE
    loss: Mapping[str, list[float]] = {}
    #: report of the fit, a text
    told: str = ""
    #: nominal robot of the paper's models, in whose rest they start; None: each starts in its own equilibrium
    resting: System | None = None


def _paper(knowledge: System, train: Sequence[str], read: _Read, seeds: Sequence[int]) -> TrainedSystems:
    states = []
    for name in train:
        _, start, seconds = read.window(name)
        states.append(estimate_states(read[name], knowledge, "paper", DT, start, start + seconds))
    learned = fitted(knowledge, states, FitConfig.paper_recordings(seed=tuple(seeds)))
    return TrainedSystems(learned.systems, space=PAPER_SPACE, loss=learned.loss, resting=knowledge)


def _best(knowledge: System, rows: Sequence[Measurements]) -> tuple[System, str]:
    """Return the identified robot."""
    found = identify(knowledge, rows, space=SPACE)
    return found.robot, str(found)


def _calibrated(knowledge: System, rows: Sequence[Measurements]) -> tuple[System, str]:
    """Return the nominal robot with five identified parameters."""
    names = ("youngs_modulus", "density", "bending_damping", "drag", "gravity")
    found = identify(knowledge, rows, parameters=names, space=SPACE)
    return found.robot, str(found)


def _residual(knowledge: System, rows: Sequence[Measurements]) -> tuple[System, str]:
    """Return the identified robot, with a residual if this predicts recordings better that were left out."""
    found = identify(knowledge, rows, space=SPACE)
    model = learn(found, rows, space=SPACE)
    return model, "\n".join(f"- {step}" for step in (*found.steps, *model.about.facts["steps"]))


#: methods that learn from measured poses alone, without chance: system and report
LEARNERS = {"best": _best, "residual": _residual, "calibrated": _calibrated}
#: those of the paper's Table II, and ablations of the best method, each without all later parts
METHODS = ("baseline", "paper-a", "paper-b", *LEARNERS)


def trained(
    method: str, knowledge: System, train: Sequence[str], read: _Read, seeds: Sequence[int]
) -> TrainedSystems:
    """Return the systems of a method."""
    if method == "baseline":
        return TrainedSystems({0: knowledge})
    if method == "paper-a":
        train = [name for name in train if not name.startswith(RANDOM)] or train
    if method not in LEARNERS:
        return _paper(knowledge, train, read, seeds)
    try:
        system, told = LEARNERS[method](knowledge, [read.rows(name, FINER) for name in train])
    except (IdentificationError, FitError, DataError) as error:
        return TrainedSystems({0: str(error)}, FINER)
    return TrainedSystems({0: system}, FINER, told=told)


# predicting


def predicted(settings: Any) -> Product:
    """Return a method's metrics for every recording and seed."""
    read, knowledge = _Read(settings), parse_robot(settings["robot"], "the robot")
    method = settings["method"]
    learned = trained(method, knowledge, settings["train"], read, settings["seeds"])
    cells: list[dict[str, Any]] = []
    tips: dict[str, Any] = {}
    outcomes = {
        seed: _outcomes(system, read, settings["recordings"], learned)
        for seed, system in learned.systems.items()
    }
    for name in settings["recordings"]:
        for seed in learned.systems:
            outcome = outcomes[seed][name]
            cells.append({"recording": name, "method": method, "seed": seed, **outcome.to_dict()})
            if outcome.tip is not None:
                tips.setdefault(name, _plain(outcome.tip, 6))
    files = {}
    for seed, system in learned.systems.items():
        if isinstance(system, KNODE):
            files[f"models/{method}-{seed}"] = system.to_bytes()
        elif isinstance(system, System) and method != "baseline":
            about = f"identified from {', '.join(settings['train'])}, for space={learned.space!r}"
            files[f"models/{method}.yaml"] = format_robot(system, about).encode()
    facts = {"cells": cells, "tips": tips, "loss": learned.loss, "told": learned.told}
    return Product(facts, files)


def _outcomes(
    system: System | str, read: _Read, names: Sequence[str], learned: TrainedSystems
) -> dict[str, Evaluation]:
    """Return a model's metrics for all recordings.

    The first attempt has no recovery from failed steps, because its compilation is slow. Failed recordings
    are repeated with recovery. A learned model is not repeated if it fails on all recordings, or once
    recovery has not helped.
    """
    found = {name: _outcome(system, read, name, learned, 0.0) for name in names}
    failed = [name for name in names if found[name].failed is not None]
    impatient = isinstance(system, str | KNODE)
    if impatient and len(failed) == len(found):
        return found
    for name in failed:
        found[name] = _outcome(system, read, name, learned, RECOVERY)
        if impatient and found[name].failed is not None:
            break
    return found


def _outcome(
    system: System | str, read: _Read, name: str, learned: TrainedSystems, recovery: float
) -> Evaluation:
    """Return a model's metrics for a recording, or the cause of a failure."""
    if isinstance(system, str):
        return Evaluation(failed=system)
    measured = read.rows(name, learned.finer)
    try:
        moved = (
            predict(system, measured, space=learned.space, recovery=recovery)
            if learned.resting is None
            else _paper_motion(system, learned.resting, measured, recovery)
        )
    except SimulationError as error:
        return Evaluation(failed=str(error))
    rows = round(read.window(name).seconds / DT)
    return compared(system, moved, measured, every=learned.finer, last=rows)


def _paper_motion(system: System, resting: System, measured: Measurements, recovery: float) -> Trajectory:
    """Return a motion by the paper's schemes: as in its simulations, all models start in the same rest.

    That is the equilibrium of the nominal robot: the paper's robot points up there, others may sag.
    """
    before = measured.initial_control
    rest = None if before is None else equilibrium(resting, before, space=PAPER_SPACE)
    acting = remove_delay(system, measured.control[:-1], measured.dt, before)
    return simulate(
        system,
        acting,
        measured.dt,
        time="bdf2",
        space=PAPER_SPACE,
        start="paper",
        initial="unstressed" if rest is None else rest,
        recovery_budget=recovery,
    )


TIP = {"tip_rmse": ("Tip RMSE [cm]", 100.0)}
Facts = Mapping[str, Mapping[str, Any]]

#: percent by which the paper improves tip DTW and pose MSE on average, on its own robot, from Dataset B
PAPER_GAIN = 58.7


def rerun(
    out: Path,
    folder: Path,
    *,
    train: Sequence[str] | None,
    methods: Sequence[str],
    options: RecordingsOptions,
    simulated: bool | None = None,
    **how: Any,
) -> Report:
    """Learn from some recordings of a folder, predict the others, and write Table II and its figures.

    Args:
        out: the output folder; an earlier run in it is continued.
        folder: the folder of bags and tables.
        train: names (without suffixes) of the training recordings; None: the paper's.
        methods: some of `METHODS`.
        options: robot, configuration, windows and seeds.
        simulated: True if the robot was simulated; None: as stated by the recordings.
        how: `workers`, `dask`, `progress` as `runner.run` has them.

    Raises:
        StudyError: recordings are not there, or as in `runner.run`.
        RecordingError: a recording cannot be read.
    """
    paths = recordings_in(folder)
    learned, rest = recording_split(list(paths), train)
    ordered = {name: paths[name] for name in (*rest, *learned)}
    facts = runner.run(jobs(ordered, learned, methods, options), out, **how)
    every = [cell for method in methods for cell in facts[method]["cells"]]
    cells = [cell for name in rest for cell in every if cell["recording"] == name]
    seen = [cell for name in learned for cell in every if cell["recording"] == name]
    said = _said(facts["measured"], simulated)
    text = as_markdown(cells, seen, facts, methods, said)
    training = {"training.json": as_json(seen)}
    return write_report(out, "table2", cells, text, draw(facts, methods, rest), training)


def _said(measured: Mapping[str, Any], simulated: bool | None) -> str:
    """Return a sentence that states if the recordings are of a simulated or a physical robot."""
    said = {it["simulated"] for it in measured.values()} if simulated is None else {simulated}
    if said == {True}:
        return "**These recordings are of a simulated robot, not of a physical one.**"
    if said == {False}:
        return "These recordings are of a physical robot."
    if said == {None}:
        return (
            "**It is not stated whether these recordings are of a physical or of a simulated robot** "
            "(state it with `--simulated`, `--physical`, or `simulated` in their configuration)."
        )
    return "**Some of these recordings are of a simulated robot.**"


# the table


def as_markdown(cells: Cells, seen: Cells, facts: Facts, methods: Sequence[str], said: str) -> str:
    """Return a table for each metric, the improvements, and the reports of the fits."""
    trained = ", ".join(dict.fromkeys(cell["recording"] for cell in seen))
    parts = [
        "# Table II: recordings that were not learned from",
        said,
        f"Learned from {trained}. Each recording is predicted from rest by its measured tensions alone, "
        f"compared every {DT:g} s.\npaper-a and paper-b: the paper's network and training, without and with "
        "the random recordings.\nMean and standard deviation over seeds; in brackets, how much less than the "
        "baseline.",
    ]
    for measure, (title, factor) in (MEASURES | TIP).items():
        parts += [f"## {title}", table_of(cells, measure, factor, methods)]
    gains = _gains(cells, methods)
    if gains:
        listed = "\n".join(f"- {method}: {gain:.1f} %" for method, gain in gains.items())
        parts += [
            "## Average improvement of tip DTW and pose MSE on the baseline",
            f"{listed}\n\nThe paper's, on its own robot: {PAPER_GAIN} %.",
        ]
    parts += ["## The recordings that were learned from: tip RMSE [cm]"]
    parts.append(table_of(seen, "tip_rmse", 100.0, methods))
    told = facts.get("best", {}).get("told")
    if told:
        parts += ["## What `best` found", f"```\n{told}\n```"]
    failed = failures([*cells, *seen], "recording", "method", "seed")
    for title, lines in (("What failed", failed), ("What was mended", _mended(facts))):
        if lines:
            parts += [f"## {title}", "\n".join(lines)]
    return "\n\n".join(parts) + "\n"


def table_of(cells: Cells, measure: str, factor: float, methods: Sequence[str]) -> str:
    """Return a Markdown table of one metric for all recordings and methods."""
    rows = []
    for (name,), spread in spreads(cells, measure, factor, by=("recording",)).items():
        base = spread["baseline"].mean if "baseline" in spread else None
        row = [name]
        for method in methods:
            less, mean = "", spread[method].mean
            if method != "baseline" and base and mean is not None:
                less = f" ({_in_percent(1.0 - mean / base)})"
            row.append(in_words(spread[method]) + less)
        rows.append(row)
    return markdown_table(["recording", *methods], rows)


def _in_percent(part: float) -> str:
    """Return a fraction as text in whole percent, with one decimal above 99.5 %."""
    return f"{100.0 * part:.0f} %" if part < 0.995 else f"{100.0 * part:.1f} %"


def _gains(cells: Cells, methods: Sequence[str]) -> dict[str, float]:
    """Return each method's mean improvement over recordings and both metrics; failed methods have none."""
    found: dict[str, float] = {}
    cases = [each for name in PAPER_MEASURES for each in spreads(cells, name, by=("recording",)).values()]
    for method in methods:
        gains = []
        for spread in cases:
            base, mine = spread["baseline"].mean if "baseline" in spread else None, spread[method]
            if base and mine.mean is not None and not mine.failures:
                gains.append(100.0 * (1.0 - mine.mean / base))
        if method != "baseline" and len(gains) == len(cases):
            found[method] = float(np.mean(gains))
    return found


def _mended(facts: Facts) -> list[str]:
    return [f"- {name}: {line}" for name, it in facts["measured"].items() for line in it["findings"]]


# the figures


def draw(facts: Facts, methods: Sequence[str], names: Sequence[str]) -> dict[str, Figure]:
    """Return figures of paths, tip x, error over the horizon, and losses if any."""
    seen = {name: _predicted(facts, methods, name) for name in names}
    drawn = {"paths": paths(seen), "tip-x": tip_x(seen), "horizon": horizon(seen)}
    losses = {method: list(facts[method]["loss"].values()) for method in methods if facts[method]["loss"]}
    if losses:
        drawn["loss"] = figures.losses(losses)
    return drawn


def _predicted(facts: Facts, methods: Sequence[str], name: str) -> Predicted:
    it = facts["measured"][name]
    tips = {
        method: np.array(facts[method]["tips"][name], dtype=float)
        for method in methods
        if name in facts[method]["tips"]
    }
    time, tip = (np.array(it[key], dtype=float) for key in ("time", "tip"))
    return Predicted(time, tip, tips)


#: line style of each method
LINES: dict[str, dict[str, Any]] = {
    "baseline": LOOKS["baseline"],
    "paper-a": {"color": PALETTE[5], "linestyle": "-", "linewidth": 1.1},
    "paper-b": LOOKS["paper"],
    "best": LOOKS["best"],
    "calibrated": LOOKS["calibrated"],
}
MEASURED = {**REFERENCE, "label": "measured"}
COLUMNS = 2


class Predicted(NamedTuple):
    """Recording with its measured tip, and each method's prediction with its first seed."""

    time: Float[np.ndarray, " T"]
    measured: Float[np.ndarray, "T 3"]
    predicted: Mapping[str, Float[np.ndarray, "T 3"]]


def tip_x(recordings: Mapping[str, Predicted]) -> Figure:
    """Return a figure of x of the tips over time.

    Raises:
        ImportError: matplotlib is not installed; from every function here.
        ValueError: there is nothing to draw; from every function here.
    """
    require_some(recordings)
    columns = 1 if len(recordings) < 3 else 2
    rows = -(-len(recordings) // columns)
    with new_figure(TWO_COLUMNS, 1.61 * rows + 0.5) as figure:
        panels = figure.subplots(rows, columns, squeeze=False).ravel()
        # one scale for all panels, so that motions are comparable; predictions far off leave the axes
        reach = 2.5 * max(float(np.nanmax(np.abs(it.measured[:, 0]))) for it in recordings.values())
        for axes, (name, it) in zip(panels, recordings.items(), strict=False):
            axes.plot(it.time, it.measured[:, 0], **MEASURED)
            for method, tip in it.predicted.items():
                axes.plot(it.time, tip[:, 0], label=method, **LINES.get(method, {}))
            axes.set(title=name, ylabel="tip x [m]", ylim=(-reach, reach))
            axes.margins(x=0.0)
        for axes in panels[len(recordings) :]:
            axes.remove()
        for axes in panels[: len(recordings)][-2:]:
            axes.set_xlabel("time [s]")
        legend_below(figure, panels[: len(recordings)])
    return figure


def paths(recordings: Mapping[str, Predicted]) -> Figure:
    """Return a figure of the paths of the tips in space."""
    require_some(recordings)
    columns = min(COLUMNS, len(recordings))
    rows = -(-len(recordings) // columns)
    with new_figure(TWO_COLUMNS, 2.6 * rows + 0.4) as figure:
        grid = figure.subplots(rows, columns, subplot_kw={"projection": "3d"}, squeeze=False).ravel()
        for axes, (name, it) in zip(grid, recordings.items(), strict=False):
            axes.plot(*it.measured.T, **MEASURED)
            for method, tip in it.predicted.items():
                axes.plot(*tip.T, label=method, **LINES.get(method, {}))
            axes.set_title(name, y=0.94)
            axes.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")
            axes.locator_params(nbins=4)
            points = np.concatenate([it.measured, *it.predicted.values()])
            equal_scales(axes, points[None, np.isfinite(points).all(axis=1)], 0.85)
        for axes in grid[len(recordings) :]:
            axes.remove()
        legend_below(figure, grid[: len(recordings)])
    return figure


def horizon(recordings: Mapping[str, Predicted]) -> Figure:
    """Return a figure of the tip error over the horizon: RMS over the recordings, and their range."""
    require_some(recordings)
    with new_figure(TWO_COLUMNS, 3.2) as figure:
        axes = figure.subplots()
        methods = list(dict.fromkeys(method for it in recordings.values() for method in it.predicted))
        for method in methods:
            several = [it for it in recordings.values() if method in it.predicted]
            length = min(len(it.time) for it in several)
            off = np.array(
                [
                    np.linalg.norm(it.predicted[method][:length] - it.measured[:length], axis=1)
                    for it in several
                ]
            )
            time = several[0].time[:length] - several[0].time[0]
            # average over the last second, for smoother lines
            means = np.array(
                [np.sqrt(np.nanmean(off[:, max(0, i - 20) : i + 1] ** 2)) for i in range(length)]
            )
            look = LINES.get(method, {})
            axes.plot(time, 100.0 * means, label=method, **look)
            axes.fill_between(
                time,
                100.0 * np.nanmin(off, axis=0),
                100.0 * np.nanmax(off, axis=0),
                color=look.get("color"),
                alpha=0.12,
                linewidth=0,
            )
        axes.set(
            xlabel="time since the prediction began [s]", ylabel="distance of the tips [cm]", yscale="log"
        )
        axes.set_title("Lines: root mean square of all recordings over the last second; bands: least to most")
        axes.margins(x=0.0)
        legend_below(figure, [axes])
    return figure
