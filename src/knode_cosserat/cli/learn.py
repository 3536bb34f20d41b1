"""The command that learns a model from trajectories."""

from __future__ import annotations

import enum
import re
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated

import typer

from knode_cosserat.cli.arguments import (
    Changes,
    Json,
    Picture,
    Progress,
    Robot,
    figures,
    require_writable,
    system_of,
    trajectory_of,
    wanted,
)
from knode_cosserat.cli.facts import learned
from knode_cosserat.cli.program import app, examples
from knode_cosserat.cli.telling import tell

if TYPE_CHECKING:
    from knode_cosserat.learning.config import FitConfig
    from knode_cosserat.learning.knode import KNODE
    from knode_cosserat.trajectory import Trajectory


class Preset(enum.StrEnum):
    """Presets of a fit."""

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
        list[Path], typer.Argument(metavar="TRAJECTORY", help="Trajectory files to learn from.")
    ],
    out: Annotated[
        Path,
        typer.Option(
            metavar="PATH",
            help="Write the model to this file; with several seeds, an ensemble to this folder.",
        ),
    ],
    preset: Annotated[
        Preset,
        typer.Option(
            help="best: a structured residual by sparse regression. paper: the paper's network and training. "
            "network: one without its constraints."
        ),
    ] = Preset.best,
    seed: Annotated[
        int | None, typer.Option(metavar="N", help="Of what is random.", show_default="0")
    ] = None,
    seeds: Annotated[
        str | None, typer.Option(metavar="N,N,…", help="Several seeds, trained side by side: a model each.")
    ] = None,
    epochs: Annotated[
        int | None, typer.Option(metavar="N", help="Epochs of training.", show_default="the preset's")
    ] = None,
    rows: Annotated[
        int | None,
        typer.Option(metavar="N", min=1, help="Learn from the first N rows only; the paper's study: 30."),
    ] = None,
    changes: Changes = None,
    held_out: Annotated[
        list[Path] | None,
        typer.Option(metavar="FILE", help="A trajectory that training is stopped by; may be repeated."),
    ] = None,
    checkpoint: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Keep the state of the training there, and go on from it."),
    ] = None,
    log: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Write event files for TensorBoard there.")
    ] = None,
    figure: Annotated[Path | None, Picture] = None,
    progress: Progress = None,
    as_json: Json = False,
) -> None:
    """Learn from trajectories what a robot's physics misses.

    The result is a model, which can be used wherever a robot can.
    """
    numbers = _seeds(seed, seeds)
    several = isinstance(numbers, tuple)
    if several and out.exists() and not out.is_dir():
        raise ValueError(f"{out}: this is a file; allowed with several seeds is a folder")
    require_writable(None if several else out, figure, (out if several else None, checkpoint, log))
    if figure:
        figures()
    from knode_cosserat.learning.fit import fit as learn
    from knode_cosserat.learning.samples import DataError

    knowledge = system_of(robot, changes)
    config = _config(preset, numbers, epochs)
    given = [_loaded(path, rows) for path in trajectories]
    others = [_loaded(path, None) for path in held_out or ()]
    began = perf_counter()
    try:
        found = learn(
            knowledge, given, config, held_out=others, checkpoint=checkpoint, log_dir=log,
            progress=wanted(progress),
        )  # fmt: skip
    except DataError as error:
        raise ValueError(_named(str(error), trajectories)) from None
    seconds = perf_counter() - began
    found.save(out)
    if figure:
        _draw(next(iter(found)) if several else found, given[0], figure)
    count = sum(len(one.time) for one in given)
    lines = [
        f"learned what {robot} misses from {len(given)} trajectories of {count} rows in all: "
        f"preset {preset.value}, {seconds:.2f} s"
    ]
    told = []
    for model in found if several else [found]:
        facts, words = learned(model)
        told.append({"seed": model.about.facts["seed"], **facts})
        lines += [*([f"seed {told[-1]['seed']}:"] if several else []), *words]
    tell(
        as_json,
        {
            "robot": robot, "preset": preset.value, "trajectories": [str(path) for path in trajectories],
            "rows": count, "computing_time": round(seconds, 4), "models": told,
        },
        lines,
        out=out,
        figure=figure,
    )  # fmt: skip


def _draw(model: KNODE, states: Trajectory, path: Path) -> None:
    """Draw the correction of the nominal model, at the states of a trajectory."""
    from knode_cosserat.evaluation.learning_figures import residual

    residual(model, states).savefig(path)


def _seeds(seed: int | None, seeds: str | None) -> int | tuple[int, ...]:
    if seeds is None:
        return 0 if seed is None else seed
    if seed is not None:
        raise ValueError("--seed is for one model and --seeds for several; give one of them")
    try:
        return tuple(int(part) for part in seeds.split(","))
    except ValueError:
        raise ValueError(f"--seeds {seeds!r}: allowed is whole numbers, such as 0,1,2") from None


def _config(preset: Preset, seed: int | tuple[int, ...], epochs: int | None) -> FitConfig:
    import dataclasses

    from knode_cosserat.learning.config import FitConfig, StructuredOptions

    if preset is Preset.best:
        if epochs is not None:
            raise ValueError(
                "--epochs is for networks; the preset best has none, for it solves for its weights"
            )
        return FitConfig(StructuredOptions(resample=isinstance(seed, tuple)), seed=seed)
    config = FitConfig.paper(seed) if preset is Preset.paper else FitConfig.network(seed)
    if epochs is None or config.segments is None:
        return config
    return dataclasses.replace(config, segments=dataclasses.replace(config.segments, epochs=epochs))


def _loaded(path: Path, rows: int | None) -> Trajectory:
    states = trajectory_of(path)
    return states if rows is None or states.y.ndim != 3 else states[:rows]


def _named(message: str, paths: list[Path]) -> str:
    """Return a message with the names of files in place of "trajectory 0", "trajectory 1", …."""

    def path(found: re.Match[str]) -> str:
        number = int(found[1])
        return str(paths[number]) if number < len(paths) else found[0]

    return re.sub(r"\btrajectory (\d+)\b", path, message)
