"""The paper's study of a real robot: what its recordings teach, and how well it is predicted then.

Some recordings are learned from; every other one in the folder is predicted from rest by its tensions alone,
and compared with what motion capture saw. Everything that is chosen goes into the jobs as plain values.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from knode_cosserat.evaluation.metrics import dtw_distance, pose_mse
from knode_cosserat.learning.calibration.calibrate import Calibration, CalibrationError, calibrate
from knode_cosserat.learning.calibration.identify import NAMES, identify
from knode_cosserat.learning.config import FitConfig
from knode_cosserat.learning.files.model_file import encoded
from knode_cosserat.learning.fit import fit
from knode_cosserat.learning.knode import KNODE
from knode_cosserat.learning.training.runs import FitError
from knode_cosserat.recordings.config import RecordingConfig
from knode_cosserat.recordings.estimation.estimate import estimate_states
from knode_cosserat.recordings.load import load_recording
from knode_cosserat.recordings.measurements import Measurements
from knode_cosserat.recordings.recording import Recording
from knode_cosserat.rods.robot_file import format_robot, load_robot, parse_robot
from knode_cosserat.rods.system import System
from knode_cosserat.solvers.places import places_at, positions_at, quaternions_at
from knode_cosserat.solvers.result import SimulationError
from knode_cosserat.solvers.simulate import simulate
from knode_cosserat.studies.runner import Job, Product, StudyError

ROBOT = "delrin-tendon-robot"
#: time step of the comparison, and of the paper's models (s); the best model takes steps of a part of it
DT, FINER = 0.05, 2
#: schemes in arclength: of all models, and of the paper's
SPACE, PAPER_SPACE = "lobatto2", "euler"
#: what is learned from, if nothing else is said: the paper's two sines, and one random recording
TRAIN = ("sine_1p0", "sine_3p0", "rand_0")
#: recordings of steps are compared from their beginning; all others rest for as long (s) first
REST, STEPS = 1.0, "step"
#: recordings whose names begin so are only in Dataset B
RANDOM = "rand"
ENDINGS = (".bag", ".mcap", ".db3", ".csv", ".parquet")


class Window(NamedTuple):
    """A recording, and the part of it that is looked at (s)."""

    path: str
    start: float
    seconds: float


# the jobs


def found(folder: Path) -> dict[str, Path]:
    """The recordings in a folder by their names: bags and tables, and folders that are ROS 2 bags.

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


def chosen(names: Sequence[str], train: Sequence[str] | None) -> tuple[list[str], list[str]]:
    """Which recordings are learned from, and which are predicted.

    Raises:
        StudyError: a name is not there, or nothing is left to predict.
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


class Options(NamedTuple):
    """What a study of recordings can be asked for."""

    robot: str = ROBOT
    config: str | None = None
    #: where the comparison begins (s); None: at `REST`, and at 0 for steps
    start: float | None = None
    seconds: float = 10.0
    seeds: int = 5


def jobs(
    paths: Mapping[str, Path], train: Sequence[str], methods: Sequence[str], options: Options
) -> list[Job]:
    """One job for each method, with all seeds and recordings, and one for what was measured."""
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


# what was measured


class _Read:
    """The recordings of a job, each read once and only if it is needed."""

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
        """The rows of a window: as many as the paper keeps, and the one after them. Finer ones with means."""
        _, start, seconds = self.window(name)
        return self[name].sampled(DT / finer, start, start + seconds, mean=finer > 1)


def measured(settings: Any) -> Product:
    """What was measured: paths of the tips, tensions, and where the robot came from."""
    read = _Read(settings)
    facts: dict[str, Any] = {}
    for name in settings["recordings"]:
        rows = _compared(read.rows(name), read.window(name).seconds)
        command = None
        if read[name].command is not None:
            _, start, seconds = read.window(name)
            asked = read[name].sampled(DT, start, start + seconds, "commanded")
            command = _plain(_compared(asked, seconds).tension, 3)
        facts[name] = {
            "time": _plain(rows.time, 6), "tip": _plain(rows.tip_position, 6), "command": command,
            "tension": _plain(rows.tension, 3), "simulated": rows.simulated,
            "findings": [f"{it.topic}: {it.message}" for it in read[name].findings if it.severity != "note"],
        }  # fmt: skip
    return Product(facts, {})


def _compared(rows: Measurements, seconds: float) -> Measurements:
    """The paper keeps the state at rest and those after all controls but the last."""
    return rows.rows(0, round(seconds / DT))


def _plain(values: Any, digits: int) -> Any:
    """As JSON has it; None for what is not known."""
    plain = np.round(np.asarray(values, dtype=float), digits).astype(object)
    plain[~np.isfinite(np.asarray(values, dtype=float))] = None
    return plain.tolist()


# learning


class Learned(NamedTuple):
    """A system for each seed, or why there is none."""

    systems: dict[int, System | str]
    #: steps of the model in one of the comparison, and its scheme in arclength
    finer: int = 1
    space: str = SPACE
    loss: Mapping[str, list[float]] = {}
    #: what is told of the fit, a text
    told: str = ""


def _baseline(knowledge: System, train: Sequence[str], read: _Read, seeds: Sequence[int]) -> Learned:
    return Learned({0: knowledge})


def _paper_a(knowledge: System, train: Sequence[str], read: _Read, seeds: Sequence[int]) -> Learned:
    return _paper(knowledge, [name for name in train if not name.startswith(RANDOM)] or train, read, seeds)


def _paper(knowledge: System, train: Sequence[str], read: _Read, seeds: Sequence[int]) -> Learned:
    states = []
    for name in train:
        _, start, seconds = read.window(name)
        states.append(estimate_states(read[name], knowledge, "paper", DT, start, start + seconds))
    config = FitConfig.paper_recordings(seed=tuple(seeds))
    try:
        models = fit(knowledge, states, config)
    except FitError as error:
        return Learned(dict.fromkeys(seeds, str(error)))
    losses = {
        str(model.about.facts["seed"]): np.asarray(model.about.facts["segments"]["loss"]).tolist()
        for model in models
    }
    return Learned(dict(zip(seeds, models, strict=True)), space=PAPER_SPACE, loss=losses)


def _best(knowledge: System, train: Sequence[str], read: _Read, seeds: Sequence[int]) -> Learned:
    return _identified(knowledge, train, read, None)


def _no_vibration(knowledge: System, train: Sequence[str], read: _Read, seeds: Sequence[int]) -> Learned:
    return _identified(knowledge, train, read, NAMES)


def _no_memory(knowledge: System, train: Sequence[str], read: _Read, seeds: Sequence[int]) -> Learned:
    return _identified(
        knowledge, train, read, tuple(name for name in NAMES if not name.startswith("friction"))
    )


def _identified(
    knowledge: System,
    train: Sequence[str],
    read: _Read,
    names: tuple[str, ...] | None,
) -> Learned:
    return _found(lambda rows: identify(knowledge, rows, names, space=SPACE), train, read)


def _calibrated(knowledge: System, train: Sequence[str], read: _Read, seeds: Sequence[int]) -> Learned:
    names = ("youngs_modulus", "density", "bending_damping", "drag", "gravity")
    return _found(
        lambda rows: calibrate(knowledge, rows, names, by="rollouts", undetermined="keep", space=SPACE),
        train,
        read,
    )


def _found(
    search: Callable[[list[Measurements]], Calibration],
    train: Sequence[str],
    read: _Read,
) -> Learned:
    """Return the model of a search; there is no chance in it: one seed."""
    try:
        calibration = search([read.rows(name, FINER) for name in train])
    except CalibrationError as error:
        return Learned({0: str(error)}, FINER)
    return Learned({0: calibration.robot}, FINER, told=str(calibration))


#: those of the paper's Table II, and what of the best each part of it buys, which is without all later ones
TABLE = ("baseline", "paper-a", "paper-b", "best")
METHODS: dict[str, Callable[[System, Sequence[str], _Read, Sequence[int]], Learned]] = {
    "baseline": _baseline,
    "paper-a": _paper_a,
    "paper-b": _paper,
    "best": _best,
    "calibrated": _calibrated,
    "no-memory": _no_memory,
    "no-vibration": _no_vibration,
}


# predicting


def predicted(settings: Any) -> Product:
    """A method's figures for every recording, from every seed."""
    read, knowledge = _Read(settings), parse_robot(settings["robot"], "the robot")
    method = settings["method"]
    learned = METHODS[method](knowledge, settings["train"], read, settings["seeds"])
    cells: list[dict[str, Any]] = []
    tips: dict[str, Any] = {}
    for name in settings["recordings"]:
        for seed, system in learned.systems.items():
            outcome = _outcome(system, read, name, learned.finer, learned.space)
            cells.append({"recording": name, "method": method, "seed": seed, **outcome.figures})
            if outcome.tip is not None:
                tips.setdefault(name, _plain(outcome.tip, 6))
    files = {}
    for seed, system in learned.systems.items():
        if isinstance(system, KNODE):
            files[f"models/{method}-{seed}"] = encoded(system, f"{method}-{seed}")
        elif isinstance(system, System) and method != "baseline":
            about = f"identified from {', '.join(settings['train'])}, for space={learned.space!r}"
            files[f"models/{method}.yaml"] = format_robot(system, about).encode()
    facts = {"cells": cells, "tips": tips, "loss": learned.loss, "told": learned.told}
    return Product(facts, files)


class _Outcome(NamedTuple):
    figures: dict[str, Any]
    tip: Float[np.ndarray, "T 3"] | None


class _Poses(NamedTuple):
    position: Float[np.ndarray, "T M 3"]
    quaternion: Float[np.ndarray, "T M 4"]


def _outcome(system: System | str, read: _Read, name: str, finer: int, space: str) -> _Outcome:
    """Return the three figures over the rows in which everything was seen, or the cause of a failure."""
    none = {"tip_dtw": None, "pose_mse": None, "tip_rmse": None}
    if isinstance(system, str):
        return _Outcome({**none, "failed": system}, None)
    driven = read.rows(name, finer)
    rows = _compared(read.rows(name), read.window(name).seconds)
    try:
        trajectory = simulate(system, driven.tension[:-1], driven.dt, space=space)
    except SimulationError as error:
        return _Outcome({**none, "failed": str(error)}, None)
    y = np.asarray(trajectory.y)[::finer][: len(rows.time)]
    places = places_at(rows.fractions, system.nodes)
    position, quaternion = (np.asarray(part(system, y, places)) for part in (positions_at, quaternions_at))
    known = rows.complete
    off = position[known, -1] - rows.position[known, -1]
    figures: dict[str, Any] = {
        "tip_dtw": dtw_distance(position[known, -1], rows.position[known, -1]),
        "pose_mse": None,
        "tip_rmse": float(np.sqrt(np.mean(np.sum(off**2, axis=1)))),
    }
    turned = np.isfinite(rows.quaternion).all(axis=(1, 2)) & known
    if turned.any():
        figures["pose_mse"] = pose_mse(
            _Poses(position[turned], quaternion[turned]),
            _Poses(rows.position[turned], rows.quaternion[turned]),
        )
    return _Outcome(figures, position[:, -1])
