"""Learning from full states, or from whatever was measured of an identified robot."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from knode_cosserat._arguments import check_arguments
from knode_cosserat.estimation.parameters import ParameterModel
from knode_cosserat.identification.evaluate import evaluate
from knode_cosserat.identification.experiments import (
    Experiment,
    experiments_of,
    listed_rows,
    names_of,
    poses_of_nodes,
)
from knode_cosserat.identification.journal import Journal, OutOfTimeError, SearchError
from knode_cosserat.identification.passports import passport_of
from knode_cosserat.identification.residual import LearnedResidual, learn_residual
from knode_cosserat.identification.result import Identified
from knode_cosserat.learning.config import FitConfig, FitError, StructuredOptions
from knode_cosserat.learning.knode import KNODE, About
from knode_cosserat.learning.origins import origin_of
from knode_cosserat.learning.residual import Nothing
from knode_cosserat.learning.states import BEST, fit_states
from knode_cosserat.recordings.measurements import Measurements
from knode_cosserat.recordings.recording import Recording
from knode_cosserat.rods.system import System, is_traced
from knode_cosserat.schemes.space import SpaceScheme
from knode_cosserat.trajectory import Trajectory

log = logging.getLogger(__name__)


def fit(
    knowledge: System | Identified,
    data: Sequence[Trajectory | Recording | Measurements | Experiment],
    config: FitConfig = BEST,
    *,
    held_out: Sequence[Any] = (),
    space: str | SpaceScheme = "lobatto4",
    progress: bool | Callable[[str], None] = False,
    checkpoint: str | Path | None = None,
    minutes: float = np.inf,
    **options: Any,
) -> Any:
    """Learn the errors of a model from trajectories of full states, or from recordings.

    From recordings (or `Measurements`, or a mixture with trajectories) of any kind of drive, motions or
    equilibria, also of a tip alone, a residual is learned on the robot as it is: identify it before. Parts of
    the residual and their sizes are chosen by blocks of rows, recordings or parts of them, that are left out
    in turn. It is kept only if these are predicted better, and no recording worse.

    Args:
        knowledge: the robot: from recordings an identified one (the result of `identify`, or its robot), or
            any system; from trajectories the imperfect model.
        data: trajectories of full states at the nodes of the nominal model, or recordings.
        config: settings of the fit; those of networks are for trajectories.
        held_out: data that are not used for learning; the model's error on them is reported.
        space: the scheme along the rod, for recordings.
        progress: show progress; from recordings also a function that is called with each line.
        checkpoint: folder where finished work is kept; the same call resumes from there.
        minutes: from recordings, the time after which the robot is returned as it is.
        options: for trajectories only: `checkpoint_every`, `log_dir` and `verify` of
            `learning.states.fit_states`.

    Returns:
        A `KNODE`, or from trajectories an `Ensemble` of one for each seed if `config.seed` is several. From
        recordings, `about.facts` has "given" (the use of each), "steps" (in words), "residual" (true if it
        was kept), "held_out_error" (by block that was left out, m, without and with it), "complete" (false if
        the time was over) and "unseen_error" (m, of `held_out`).

    Raises:
        DataError: recordings or trajectories that cannot be used.
        FitError: data without anything to learn, a config that needs full states, or a robot that cannot be
            simulated.
    """
    check_arguments(fit, locals())
    robot = knowledge.robot if isinstance(knowledge, Identified) else knowledge
    # motions of trial models that diverge are refused by their results, not by floating-point warnings
    with np.errstate(all="ignore"):
        listed: Any = data
        several = isinstance(listed, Iterable) and not isinstance(listed, str | Trajectory)
        listed = list(listed) if several else listed
        if not several or all(isinstance(it, Trajectory) for it in listed):
            return fit_states(
                robot,
                listed,
                config,
                held_out=held_out,
                progress=bool(progress),
                checkpoint=checkpoint,
                **options,
            )
        return _fit_recordings(robot, listed, config, held_out, space, progress, checkpoint, minutes, options)


def _fit_recordings(
    robot: System,
    data: list[Any],
    config: FitConfig,
    held_out: Sequence[Any],
    space: str | SpaceScheme,
    progress: bool | Callable[[str], None],
    checkpoint: str | Path | None,
    minutes: float,
    options: dict[str, Any],
) -> KNODE:
    if options:
        raise FitError(f"{next(iter(options))} is for trajectories")
    if not isinstance(config.residual, StructuredOptions):
        raise FitError(
            "this config needs full states, and recordings have none: estimate them first "
            "(kc.estimate_states), or use FitConfig()"
        )
    if isinstance(config.seed, tuple):
        raise FitError(
            f"config.seed is {config.seed}; from recordings allowed is one seed: the spread of robots that "
            "agree with recordings is identify(...).ensemble"
        )
    if is_traced(robot) or np.ndim(robot.length):
        raise FitError("knowledge is a batch or inside jit, grad or vmap; allowed is one robot")
    if not minutes > 0.0:
        raise FitError(f"minutes is {minutes}; allowed is a number above zero")
    shown = (lambda line: print(line, file=sys.stderr, flush=True)) if progress is True else log.info
    journal = Journal(progress if callable(progress) else shown, checkpoint, minutes)
    rows = listed_rows([poses_of_nodes(it, f"trajectory {k}") if isinstance(it, Trajectory) else it
                        for k, it in enumerate(data)])  # fmt: skip
    experiments = [it.rough() for it in experiments_of(rows, ParameterModel(robot, ()), space)]
    given = [
        f"{it.name}: {len(np.flatnonzero(np.isfinite(it.data[1:]).any(axis=1)))} rows" for it in experiments
    ]
    complete = True
    try:
        learned = learn_residual(robot, experiments, space, journal)
    except OutOfTimeError:
        journal.step("no residual: the time is over")
        learned, complete = LearnedResidual(robot, steps=tuple(journal.steps)), False
    except SearchError as error:
        raise FitError(str(error)) from None
    errors = [*learned.without], [*learned.with_residual]
    facts: dict[str, Any] = {
        "given": given,
        "steps": [*learned.steps],
        "residual": learned.kept,
        "complete": complete,
        "held_out_error": dict(zip(("without", "with"), errors, strict=True)),
        "seed": config.seed,
        "config": config.to_dict(),
    }
    tested = []
    if held_out:
        unseen = [Measurements.of(it) for it in held_out]
        found = [evaluate(learned.robot, it, space=space).tip_rmse for it in unseen]
        facts["unseen_error"] = dict(zip(names_of(unseen), found, strict=True))
        tested = [
            origin_of(it, name, learned=False, held_out_error=facts["unseen_error"][name])
            for it, name in zip(unseen, names_of(unseen), strict=True)
        ]
    if not (isinstance(learned.robot, KNODE) and learned.kept):
        return KNODE(robot, Nothing(), About(facts))
    passport = passport_of("fit", learned.robot, rows, space, learned.held_out_error(experiments), tested)
    return KNODE(robot, learned.robot.residual, About(facts), passport)
