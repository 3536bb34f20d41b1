"""The paper's study of a real robot: learning from recordings, and prediction of held-out ones.

Every held-out recording in the folder is predicted from rest by its tensions alone, and compared with motion
capture. All settings are passed to the jobs as plain values.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from knode_cosserat.identification.evaluate import Evaluation, compared, predict
from knode_cosserat.identification.fit import fit as learn
from knode_cosserat.identification.identify import IdentificationError, identify
from knode_cosserat.learning.config import FitConfig, FitError
from knode_cosserat.learning.knode import KNODE
from knode_cosserat.learning.states import fit_states
from knode_cosserat.recordings.config import RecordingConfig
from knode_cosserat.recordings.estimation.estimate import estimate_states
from knode_cosserat.recordings.load import load_recording
from knode_cosserat.recordings.measurements import Measurements
from knode_cosserat.recordings.recording import Recording
from knode_cosserat.rods.robot_file import format_robot, load_robot, parse_robot
from knode_cosserat.rods.system import System
from knode_cosserat.rods.tendons import undelayed
from knode_cosserat.solvers.equilibrium import equilibrium
from knode_cosserat.solvers.result import SimulationError
from knode_cosserat.solvers.segments import DataError
from knode_cosserat.solvers.simulate import simulate
from knode_cosserat.trajectory import Trajectory
from studies.runner import Job, Product, StudyError

ROBOT = "delrin-tendon-robot"
#: files in a folder of recordings that describe the robot, and its topics or columns
OWN_ROBOT, OWN_CONFIG = "robot.yaml", "recording.yaml"
#: time step of the comparison, and of the paper's models (s); the best model takes steps of a part of it
DT, FINER = 0.05, 4
#: schemes in arclength: of all models, and of the paper's
SPACE, PAPER_SPACE = "lobatto2", "euler"
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


# the jobs


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
    """Return the measurements: tip paths, tensions, and the origin of the recordings."""
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
    """Return the rows that the paper keeps: rest, and the states after all controls but the last."""
    return rows.rows(0, round(seconds / DT))


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


def _baseline(knowledge: System, train: Sequence[str], read: _Read, seeds: Sequence[int]) -> TrainedSystems:
    return TrainedSystems({0: knowledge})


def _paper_a(knowledge: System, train: Sequence[str], read: _Read, seeds: Sequence[int]) -> TrainedSystems:
    return _paper(knowledge, [name for name in train if not name.startswith(RANDOM)] or train, read, seeds)


def _paper(knowledge: System, train: Sequence[str], read: _Read, seeds: Sequence[int]) -> TrainedSystems:
    states = []
    for name in train:
        _, start, seconds = read.window(name)
        states.append(estimate_states(read[name], knowledge, "paper", DT, start, start + seconds))
    config = FitConfig.paper_recordings(seed=tuple(seeds))
    try:
        models = fit_states(knowledge, states, config)
    except FitError as error:
        return TrainedSystems(dict.fromkeys(seeds, str(error)))
    losses = {
        str(model.about.facts["seed"]): np.asarray(model.about.facts["segments"]["loss"]).tolist()
        for model in models
    }
    systems = dict(zip(seeds, models, strict=True))
    return TrainedSystems(systems, space=PAPER_SPACE, loss=losses, resting=knowledge)


def _best(knowledge: System, train: Sequence[str], read: _Read, seeds: Sequence[int]) -> TrainedSystems:
    """Return the identified robot; identification is deterministic, so there is one seed."""
    try:
        found = identify(knowledge, [read.rows(name, FINER) for name in train], space=SPACE)
    except IdentificationError as error:
        return TrainedSystems({0: str(error)}, FINER)
    return TrainedSystems({0: found.robot}, FINER, told=str(found))


def _calibrated(knowledge: System, train: Sequence[str], read: _Read, seeds: Sequence[int]) -> TrainedSystems:
    names = ("youngs_modulus", "density", "bending_damping", "drag", "gravity")
    rows = [read.rows(name, FINER) for name in train]
    try:
        found = identify(knowledge, rows, parameters=names, space=SPACE)
    except IdentificationError as error:
        return TrainedSystems({0: str(error)}, FINER)
    return TrainedSystems({0: found.robot}, FINER, told=str(found))


def _network(knowledge: System, train: Sequence[str], read: _Read, seeds: Sequence[int]) -> TrainedSystems:
    """Return a passive network on the nominal model; its training is deterministic too."""
    try:
        model = learn(
            knowledge, [read.rows(name, FINER) for name in train], FitConfig.network_recordings(), space=SPACE
        )
    except (FitError, DataError) as error:
        return TrainedSystems({0: str(error)}, FINER)
    return TrainedSystems({0: model}, FINER)


def _residual(knowledge: System, train: Sequence[str], read: _Read, seeds: Sequence[int]) -> TrainedSystems:
    """Return the identified robot, with a passive residual if this improves held-out recordings."""
    try:
        model = learn(knowledge, [read.rows(name, FINER) for name in train], space=SPACE)
    except (IdentificationError, FitError, DataError) as error:
        return TrainedSystems({0: str(error)}, FINER)
    return TrainedSystems(
        {0: model}, FINER, told="\n".join(f"- {step}" for step in model.about.facts["steps"])
    )


#: methods of the paper's Table II, and ablations of the best method, each without all later parts
TABLE = ("baseline", "paper-a", "paper-b", "best")
METHODS: dict[str, Callable[[System, Sequence[str], _Read, Sequence[int]], TrainedSystems]] = {
    "baseline": _baseline,
    "paper-a": _paper_a,
    "paper-b": _paper,
    "network": _network,
    "best": _best,
    "residual": _residual,
    "calibrated": _calibrated,
}


# predicting


def predicted(settings: Any) -> Product:
    """Return a method's metrics for every recording and seed."""
    read, knowledge = _Read(settings), parse_robot(settings["robot"], "the robot")
    method = settings["method"]
    learned = METHODS[method](knowledge, settings["train"], read, settings["seeds"])
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


def _paper_motion(
    system: System, resting: System, measured: Measurements, recovery: float
) -> Trajectory:  # fmt: skip
    """Return a motion by the paper's schemes: as in its simulations, all models start in the same rest.

    That is the equilibrium of the nominal robot: the paper's robot points up there, others may sag.
    """
    before = measured.initial_tension
    rest = None if before is None else equilibrium(resting, before, space=PAPER_SPACE)
    acting = undelayed(system, measured.tension[:-1], measured.dt, before)
    return simulate(
        system, acting, measured.dt, time="bdf2", space=PAPER_SPACE, start="paper", initial=rest,
        recovery_budget=recovery,
    )  # fmt: skip
