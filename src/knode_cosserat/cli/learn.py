"""Command that learns a residual model from trajectories: fit."""

from __future__ import annotations

import enum
import re
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated

import typer

from knode_cosserat._numbers import numbers_in
from knode_cosserat.cli.arguments import (
    Changes,
    Json,
    Picture,
    Progress,
    Robot,
    argument,
    command_line,
    figures,
    is_recording,
    load_system,
    load_trajectory_file,
    option,
    require_writable,
    shows_progress,
)
from knode_cosserat.cli.output import write_output
from knode_cosserat.cli.program import app, examples
from knode_cosserat.cli.summaries import residual_summary

if TYPE_CHECKING:
    from knode_cosserat.learning.config import FitConfig


class Preset(enum.StrEnum):
    """Presets of the learning method."""

    best = "best"
    paper = "paper"
    network = "network"


@app.command(
    epilog=examples(
        "fit delrin-tendon-robot a.nc b.nc --set youngs_modulus=10e9 --out model",
        "fit my-robot.yaml a.nc b.nc --preset paper --seeds 0,1,2 --checkpoint saved --out model",
    )
)
def fit(
    robot: Robot,
    trajectories: Annotated[
        list[Path], argument("TRAJECTORY", "Training trajectories (.nc) with full states.")
    ],
    out: Annotated[
        Path, option("PATH", "Write the model to this file; with --seeds, write an ensemble to this folder.")
    ],
    preset: Annotated[
        Preset,
        typer.Option(
            help="best: structured residual by sparse regression. paper: the paper's network and training. "
            "network: a network without the paper's constraints."
        ),
    ] = Preset.best,
    seed: Annotated[int | None, option("N", "Random seed.", show_default="0")] = None,
    seeds: Annotated[str | None, option("N,N,…", "Several random seeds: train one model for each.")] = None,
    epochs: Annotated[
        int | None, option("N", "Training epochs of a network.", show_default="the preset's")
    ] = None,
    rows: Annotated[
        int | None, option("N", "Use the first N rows of each trajectory only; the paper uses 30.", min=1)
    ] = None,
    changes: Changes = None,
    held_out: Annotated[
        list[Path] | None, option("FILE", "Validation trajectory for early stopping; may be repeated.")
    ] = None,
    checkpoint: Annotated[
        Path | None, option("DIR", "Save the training state in this folder, and resume from it.")
    ] = None,
    log: Annotated[Path | None, option("DIR", "Write TensorBoard event files to this folder.")] = None,
    figure: Annotated[Path | None, Picture] = None,
    progress: Progress = None,
    as_json: Json = False,
) -> None:
    """Learn a residual model from trajectories.

    The residual is the difference between the robot's physics and the trajectories. Trajectories have full
    states, from a simulation or from state estimation; use `identify` for recordings. The resulting model is
    accepted wherever a robot is.
    """
    recordings = [path for path in trajectories if is_recording(str(path))]
    if recordings:
        typed = command_line("identify", robot, *recordings, "--out", out.with_suffix(".yaml"))
        raise ValueError(
            f"{recordings[0]}: this is a recording or table; fit needs trajectories (.nc) with full states. "
            f"To identify the robot from recordings, type: {typed} (with --config recording.yaml if the "
            "file does not state the meaning of its columns)"
        )
    numbers: int | tuple[int, ...] = seed or 0
    if seeds is not None:
        if seed is not None:
            raise ValueError("--seed is for one model and --seeds for several; give one of them")
        values = numbers_in(seeds)
        if values is None or not all(value.is_integer() for value in values):
            raise ValueError(f"--seeds must be whole numbers, such as 0,1,2 (got {seeds!r})")
        numbers = tuple(map(int, values))
    several = isinstance(numbers, tuple)
    if several and out.exists() and not out.is_dir():
        raise ValueError(f"{out}: this is a file; with several seeds --out must be a folder")
    require_writable(None if several else out, figure, (out if several else None, checkpoint, log))
    if figure:
        figures()
    from knode_cosserat.learning.states import fit_states as learn
    from knode_cosserat.solvers.segments import DataError

    nominal = load_system(robot, changes)
    config = _config(preset, numbers, epochs)
    training = [load_trajectory_file(path) for path in trajectories]
    training = [states if states.y.ndim != 3 else states[:rows] for states in training]
    validation = [load_trajectory_file(path) for path in held_out or ()]
    began = perf_counter()
    try:
        result = learn(
            nominal, training, config, held_out=validation, checkpoint=checkpoint, log_dir=log,
            progress=shows_progress(progress),
        )  # fmt: skip
    except DataError as error:
        # files' names instead of the numbers of trajectories
        names = dict(enumerate(map(str, trajectories)))
        text = re.sub(r"\btrajectory (\d+)\b", lambda match: names.get(int(match[1]), match[0]), str(error))
        raise ValueError(text) from None
    seconds = perf_counter() - began
    result.save(out)
    if figure:
        from knode_cosserat.evaluation.learning_figures import residual

        residual(next(iter(result)) if several else result, training[0]).savefig(figure)
    count = sum(len(one.time) for one in training)
    files = "1 trajectory" if len(training) == 1 else f"{len(training)} trajectories"
    lines = [
        f"learned a residual model of {robot} from {files} ({count} rows): "
        f"preset {preset.value}, {seconds:.2f} s"
    ]
    models = []
    for model in result if several else [result]:
        facts, words = residual_summary(model)
        models.append({"seed": model.about.facts["seed"], **facts})
        lines += [*([f"seed {models[-1]['seed']}:"] if several else []), *words]
    write_output(
        as_json,
        {
            "robot": robot, "preset": preset.value, "trajectories": [str(path) for path in trajectories],
            "rows": count, "computing_time": round(seconds, 4), "models": models,
        },
        lines,
        out=out,
        figure=figure,
    )  # fmt: skip


def _config(preset: Preset, seed: int | tuple[int, ...], epochs: int | None) -> FitConfig:
    import dataclasses

    from knode_cosserat.learning.config import FitConfig, StructuredOptions

    if preset is Preset.best:
        if epochs is not None:
            raise ValueError(
                "--epochs is for networks; the preset best has none. Use --preset paper or --preset network"
            )
        return FitConfig(StructuredOptions(resample=isinstance(seed, tuple)), seed=seed)
    config = FitConfig.paper(seed) if preset is Preset.paper else FitConfig.network(seed)
    if epochs is None or config.segments is None:
        return config
    return dataclasses.replace(config, segments=dataclasses.replace(config.segments, epochs=epochs))
