"""Commands that learn: fit, from trajectories or recordings; identify; evaluation on recordings."""

from __future__ import annotations

import dataclasses
import functools
import math
import re
import sys
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

from knode_cosserat._numbers import numbers_in
from knode_cosserat.cli.arguments import (
    Nominal,
    Picture,
    Report,
    Sampling,
    argument,
    figures,
    is_recording,
    load_recordings,
    load_trajectory_file,
    require_writable,
)
from knode_cosserat.cli.output import best_so_far, write_output
from knode_cosserat.cli.program import app
from knode_cosserat.cli.summaries import residual_summary
from knode_cosserat.recordings.formats import read_suffixes

if TYPE_CHECKING:
    from knode_cosserat.identification import Evaluation
    from knode_cosserat.learning.config import FitConfig
    from knode_cosserat.learning.ensemble import Ensemble
    from knode_cosserat.rods.system import System


class _Data(NamedTuple):
    """Training and validation data.

    Options:
        trajectories (DATA): Training trajectories (.nc) with full states, or recordings.
        rows (--rows N≥1): Use the first N rows of each trajectory only; the paper uses 30.
        held_out (--held-out FILE): Validation trajectory for early stopping; may be repeated.
    """

    trajectories: list[Path]
    rows: int | None = None
    held_out: list[Path] | None = None


class _FitMethod(NamedTuple):
    """Method of learning.

    Options:
        preset (--preset): Training configuration. best: structured residual by sparse regression. paper:
            the paper's network and training. network: a network without the paper's constraints.
        seed (--seed N): Random seed. Default: 0.
        seeds (--seeds N,N,…): Several random seeds: train one model for each.
        epochs (--epochs N): Training epochs of a network. Default: the configuration's.
    """

    preset: Literal["best", "paper", "network"] = "best"
    seed: int | None = None
    seeds: str | None = None
    epochs: int | None = None

    def numbers(self) -> int | tuple[int, ...]:
        """Return the seed of one model, or the seeds of several."""
        if self.seeds is None:
            return self.seed or 0
        if self.seed is not None:
            raise ValueError("--seed is for one model and --seeds for several; give one of them")
        values = numbers_in(self.seeds)
        if values is None or not all(value.is_integer() for value in values):
            raise ValueError(f"--seeds must be whole numbers, such as 0,1,2 (got {self.seeds!r})")
        return tuple(map(int, values))

    def config(self) -> FitConfig:
        """Return the settings of the fit."""
        from knode_cosserat.learning.config import FitConfig, StructuredOptions

        seed = self.numbers()
        if self.preset == "best":
            if self.epochs is not None:
                raise ValueError(
                    "--epochs is for networks; the training configuration best has none. Use --preset paper "
                    "or --preset network"
                )
            return FitConfig(StructuredOptions(resample=isinstance(seed, tuple)), seed=seed)
        config = FitConfig.paper(seed) if self.preset == "paper" else FitConfig.network(seed)
        if self.epochs is None or config.segments is None:
            return config
        segments = dataclasses.replace(config.segments, epochs=self.epochs)
        return dataclasses.replace(config, segments=segments)


class _FitFiles(NamedTuple):
    """Files of a fit.

    Options:
        out (--out PATH): Write the model to this file; with --seeds, write an ensemble to this folder.
        checkpoint (--checkpoint DIR): Save the training state in this folder, and resume from it.
        minutes (--minutes MINUTES): From recordings: end after this time, without a residual if none is
            found. Default: no limit.
        log (--log DIR): Write TensorBoard event files to this folder.
    """

    out: Path
    checkpoint: Path | None = None
    minutes: float = math.inf
    log: Path | None = None
    figure: Annotated[Path | None, Picture] = None


@app.command()
def fit(
    nominal: Nominal, data: _Data, method: _FitMethod, files: _FitFiles, sampling: Sampling, report: Report
) -> None:
    """Learn a residual model from trajectories, or from recordings of an identified robot.

    The residual is the difference between the robot's physics and the data. Trajectories have full states,
    from a simulation or from state estimation. From recordings, of any drive and also of a tip alone, a
    residual is learned on the robot as it is: `identify` it before. It is kept only if rows that were left
    out are predicted better. The resulting model is accepted wherever a robot is.

    Examples:
        fit delrin-tendon-robot a.nc b.nc --set youngs_modulus=10e9 --out model
        fit my-robot.yaml a.nc b.nc --preset paper --seeds 0,1,2 --checkpoint saved --out model
        fit found.yaml a.csv b.csv --config my-recording.yaml --minutes 10 --out model
    """
    robot, out, figure = nominal.robot, files.out, files.figure
    recordings = [path for path in data.trajectories if is_recording(str(path))]
    if recordings:
        _fit_recordings(nominal, data, method, files, sampling, report)
        return
    if sampling != Sampling() or files.minutes != math.inf:
        raise ValueError(
            "--config, --start, --seconds, --dt, --space and --minutes are for recordings; "
            f"{data.trajectories[0]} is none"
        )
    several = isinstance(method.numbers(), tuple)
    if several and out.exists() and not out.is_dir():
        raise ValueError(f"{out}: this is a file; with several seeds --out must be a folder")
    require_writable(
        None if several else out, figure, (out if several else None, files.checkpoint, files.log)
    )
    drawing = figures() if figure else None
    from knode_cosserat.learning.states import fit_states as learn
    from knode_cosserat.solvers.segments import DataError

    system, config = nominal.load(), method.config()
    training = [load_trajectory_file(path) for path in data.trajectories]
    training = [states if states.y.ndim != 3 else states[: data.rows] for states in training]
    validation = [load_trajectory_file(path) for path in data.held_out or ()]
    began = perf_counter()
    try:
        result = best_so_far(
            lambda: learn(
                system,
                training,
                config,
                held_out=validation,
                checkpoint=files.checkpoint,
                log_dir=files.log,
                progress=report.shows_progress,
            )
        )
    except DataError as error:
        # files' names instead of the numbers of trajectories
        names = dict(enumerate(map(str, data.trajectories)))
        text = re.sub(r"\btrajectory (\d+)\b", lambda match: names.get(int(match[1]), match[0]), str(error))
        raise ValueError(text) from None
    seconds = perf_counter() - began
    sources = [*data.trajectories, *(data.held_out or ())]
    named: list[Any] = [_with_names(model, sources) for model in (result if several else [result])]
    result = type(result)(named) if several else named[0]
    result.save(out)
    if drawing:
        drawing.residual(next(iter(result)) if several else result, training[0]).savefig(figure)
    count = sum(len(one.time) for one in training)
    subject = "1 trajectory" if len(training) == 1 else f"{len(training)} trajectories"
    lines = [
        f"learned a residual model of {robot} from {subject} ({count} rows): "
        f"training configuration {method.preset}, {seconds:.2f} s"
    ]
    models = []
    for model in result if several else [result]:
        facts, words = residual_summary(model)
        models.append({"seed": model.about.facts["seed"], **facts})
        lines += [*([f"seed {models[-1]['seed']}:"] if several else []), *words]
    write_output(
        report.as_json,
        {
            "robot": robot, "preset": method.preset,
            "trajectories": [str(path) for path in data.trajectories], "rows": count,
            "computing_time": round(seconds, 4), "models": models,
        },
        lines,
        out=out,
        figure=figure,
    )  # fmt: skip


def _with_names(model: System, files: list[Path]) -> Any:
    """Return a model whose passport names the files of its trajectories."""
    from knode_cosserat.rods.passport import with_passport

    assert model.passport is not None
    pairs = zip(model.passport.origins, files, strict=True)
    origins = tuple(dataclasses.replace(origin, name=file.name) for origin, file in pairs)
    return with_passport(model, dataclasses.replace(model.passport, origins=origins))


def _fit_recordings(
    nominal: Nominal, data: _Data, method: _FitMethod, files: _FitFiles, sampling: Sampling, report: Report
) -> None:
    """Learn a residual on an identified robot from recordings."""
    given = {
        "--rows": data.rows, "--held-out": data.held_out, "--seeds": method.seeds, "--epochs": method.epochs,
        "--log": files.log, "--figure": files.figure,
        "--preset": None if method.preset == "best" else method.preset,
    }  # fmt: skip
    for option, value in given.items():
        if value is not None:
            raise ValueError(f"{option} is for trajectories; {data.trajectories[0]} is a recording")
    for path in data.trajectories:
        if not is_recording(str(path)):
            raise ValueError(f"{path}: this is no recording; allowed is one kind of data, recordings here")
    require_writable(files.out, None, (files.checkpoint,))
    import knode_cosserat as kc

    system = nominal.load()
    samples = [
        recording.sampled(sampling.dt, sampling.start, sampling.end, mean=True)
        for recording in load_recordings(data.trajectories, sampling.config)
    ]
    began = perf_counter()
    progress = functools.partial(print, file=sys.stderr, flush=True) if report.shows_progress else False
    model = kc.fit(
        system,
        samples,
        method.config(),
        space=sampling.space,
        progress=progress,
        checkpoint=files.checkpoint,
        minutes=files.minutes,
    )
    model.save(files.out)
    facts = model.about.facts
    lines = [*facts["given"], *facts["steps"]]
    lines.append("kept" if facts["residual"] else "the model is the robot as it was: no residual was kept")
    write_output(
        report.as_json,
        {"robot": nominal.robot, **facts, "computing_time": round(perf_counter() - began, 1)},
        lines,
        out=files.out,
    )


# recordings

#: longest time between predicted rows (s)
FINELY = 0.0125


class _SearchOptions(NamedTuple):
    """Search, and its files.

    Options:
        out (--out FILE): Write the identified robot to this YAML file.
        effects (--effect NAME): Physical effect to identify, such as friction; may be repeated. Default:
            selected by recordings left out.
        parameters (--parameter NAME): Parameter to identify without a prior, such as loads.0.mass, or all;
            may be repeated. With --effect: beside these effects.
        checkpoint (--checkpoint DIR): Keep finished searches here; an interrupted run resumes.
        minutes (--minutes MINUTES): End after this time with the best robot so far. Default: no limit.
    """

    out: Path
    effects: list[str] | None = None
    parameters: list[str] | None = None
    checkpoint: Path | None = None
    minutes: float = math.inf


@app.command()
def identify(
    nominal: Nominal,
    recordings: Annotated[
        list[Path],
        argument(
            "RECORDING",
            f"Recordings ({', '.join(read_suffixes())}); motors.csv+mocap.csv is one in two files.",
        ),
    ],
    search: _SearchOptions,
    sampling: Sampling,
    report: Report,
) -> None:
    """Identify a robot's parameters from recordings.

    ROBOT is the nominal robot, from measured dimensions, masses and data sheets. An effect is kept if it
    lowers the error on recordings left out of the search. The result must pass trial simulations with larger
    and with random tensions. When --minutes are over, or at Ctrl-C, the best robot so far is written.

    Examples:
        identify delrin-tendon-robot a.bag b.bag --out found.yaml
        identify my-robot.yaml a.csv b.csv --config my-recording.yaml --out found.yaml
        identify arm.yaml train.csv --out found.yaml --parameter youngs_modulus --parameter effects.0.radius
    """
    require_writable(search.out)
    import knode_cosserat as kc
    from knode_cosserat.identification.identify import identify as find

    system = nominal.load()
    samples = [
        recording.sampled(sampling.dt, sampling.start, sampling.end, mean=True)
        for recording in load_recordings(recordings, sampling.config)
    ]
    began = perf_counter()
    progress = functools.partial(print, file=sys.stderr, flush=True) if report.shows_progress else None
    identified = best_so_far(
        lambda: find(
            system,
            samples,
            search.effects or None,
            parameters="all" if search.parameters == ["all"] else search.parameters or None,
            space=sampling.space,
            progress=progress,
            checkpoint=search.checkpoint,
            minutes=search.minutes,
        )
    )
    kc.save_robot(identified.robot, search.out)
    facts = identified.to_dict() | {"computing_time": round(perf_counter() - began, 1)}
    write_output(report.as_json, facts, str(identified).splitlines(), out=search.out)


def evaluate_on_recordings(
    system: System | Ensemble, recordings: list[Path], sampling: Sampling, most: int | None = None
) -> dict[str, Evaluation]:
    """Return the evaluations of predictions of recordings from their measured controls, by path.

    At most `most` rows are compared.

    A prediction starts at the equilibrium under the first controls. Rotations are relative to the start,
    because the mounting of the tracked bodies is unknown.
    """
    from knode_cosserat.identification.evaluate import evaluate as compare

    evaluations, dt = {}, sampling.dt
    for path, recording in zip(recordings, load_recordings(recordings, sampling.config), strict=True):
        # coarse rows would lose the controls between them: predict finely, and compare every few rows
        count = math.ceil(dt / FINELY - 1e-6) if FINELY < dt < math.inf else 1
        rows = recording.sampled(dt / count, sampling.start, sampling.end, mean=True)
        every = 1 if rows.static else count
        evaluations[str(path)] = compare(
            system, rows, every=every, last=most, space=sampling.space, recovery=None
        )
    return evaluations
