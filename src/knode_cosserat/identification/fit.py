"""Fitting from full states or from measured poses."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from knode_cosserat.identification.evaluate import evaluate
from knode_cosserat.identification.experiments import (
    DT,
    experiments_of,
    measured_rows,
    names_of,
    poses_of_nodes,
)
from knode_cosserat.identification.identify import identify
from knode_cosserat.identification.misfit import Misfit
from knode_cosserat.identification.model import Model
from knode_cosserat.identification.residual import LearnedResidual, learn_residual
from knode_cosserat.identification.residual_model import FixedModel, ResidualModel
from knode_cosserat.identification.result import Identified
from knode_cosserat.identification.search import Search, SearchError
from knode_cosserat.learning.config import FitConfig, PassiveOptions, StructuredOptions
from knode_cosserat.learning.ensemble import Ensemble
from knode_cosserat.learning.fit import BEST, require_allowed
from knode_cosserat.learning.fit import fit as fit_states
from knode_cosserat.learning.knode import KNODE, About
from knode_cosserat.learning.passive import PARTS, Passive, passive
from knode_cosserat.learning.residual import Nothing
from knode_cosserat.learning.training.runs import FitError
from knode_cosserat.recordings.measurements import Measurements
from knode_cosserat.recordings.recording import Recording
from knode_cosserat.rods.system import System
from knode_cosserat.solvers.segments import DataError
from knode_cosserat.solvers.space import SpaceScheme
from knode_cosserat.trajectory import Trajectory

log = logging.getLogger(__name__)

#: widths of the priors of a network's residual, wide enough for the errors of a crude nominal model
WIDE = {"stiffness": 0.5, "levers": 3.0, "energy": 0.5, "damping": 3.0, "dissipation": 3.0}


def fit(
    knowledge: System,
    data: Sequence[Trajectory | Recording | Measurements],
    config: FitConfig = BEST,
    *,
    held_out: Sequence[Any] = (),
    space: str | SpaceScheme = "lobatto2",
    progress: bool = False,
    **options: Any,
) -> Any:
    """Learn the errors of an imperfect model from trajectories of full states, or from recordings of poses.

    From recordings (or their `Measurements`, or a mixture with trajectories) the robot is identified
    (`identify`), then a residual is learned on top, through rollouts and from measured poses alone. It is
    passive: it cannot add energy. It is kept only if it improves the prediction of held-out recordings.
    `FitConfig.network_recordings` learns a passive network on the nominal model, without identification.

    Args:
        knowledge: the imperfect (nominal) model.
        data: trajectories of full states at the nodes of the nominal model, or recordings that begin at rest;
            several recordings, because held-out ones decide if the residual is kept.
        config: settings of the fit.
        held_out: data that are not used for learning; the model's error on them is reported.
        space: the scheme along the rod, for recordings.
        progress: show progress.
        options: for trajectories only: `checkpoint`, `checkpoint_every` and `log_dir` of `learning.fit.fit`.

    Returns:
        A `KNODE`, or an `Ensemble` of one for each seed if `config.seed` is several: from recordings, random
        samples of the robots that agree with them, with a spread that covers held-out recordings. From
        recordings, `about.facts` has "given" (the use of each), "steps" (in words), "identified" (see
        `Identified.to_dict`), "residual" (true if it was kept) and "held_out_error" (m) by recording.

    Raises:
        DataError: recordings or trajectories that cannot be used.
        FitError: there is nothing to be learned from, or a config that needs full states.
        IdentificationError: the robot cannot be identified.
    """
    listed: Any = data
    several = isinstance(listed, Iterable) and not isinstance(listed, str | Trajectory)
    listed = list(listed) if several else listed
    if not several or all(isinstance(each, Trajectory) for each in listed):
        return fit_states(knowledge, listed, config, held_out=held_out, progress=progress, **options)
    if options:
        raise FitError(f"{next(iter(options))} is for trajectories; from recordings there are no checkpoints")
    if not isinstance(getattr(config, "residual", None), StructuredOptions | PassiveOptions):
        raise FitError(
            "this config needs full states, and recordings have none: estimate them first "
            "(kc.estimate_states), or use FitConfig() or FitConfig.network_recordings()"
        )
    tell = _teller(progress)
    measured, given = _measured(listed)
    for line in given:
        tell(line)
    others, _ = _measured(held_out) if held_out else ([], [])
    if isinstance(config.residual, PassiveOptions):
        return _network(knowledge, measured, others, config, given, space, tell)
    if len(measured) == 1 and isinstance(config.seed, tuple):
        raise FitError("there is one recording; an ensemble needs two at least, for its spread is held out")
    return _identified(knowledge, measured, others, config, given, space, tell)


def _identified(
    knowledge: System, measured: Sequence[Measurements], others: Sequence[Measurements], config: FitConfig,
    given: list[str], space: str | SpaceScheme, tell: Callable[[str], None],
) -> Any:  # fmt: skip
    """Return the identified robot, with a residual if that is kept."""
    found = identify(knowledge, measured, space=space, progress=tell)
    facts: dict[str, Any] = {"given": given, "identified": found.to_dict(), "residual": False}
    if len(measured) == 1:
        facts["steps"] = [*found.steps, "no residual: there is one recording, and none to hold out"]
        return _named(found.robot, config, {**facts, **_unseen(found.robot, others, space)})
    learned = with_residual(knowledge, measured, found, space=space, progress=tell)
    errors = {name: {"identified": own.tip, **_with(learned, name)} for name, own in learned.without.items()}
    facts |= {
        "steps": [*found.steps, *learned.steps], "residual": learned.kept, "held_out_error": errors,
    }  # fmt: skip
    return _models(learned, config, facts, others, space)


def with_residual(
    nominal: System, recordings: Sequence[Recording | Measurements], found: Identified, *,
    space: str | SpaceScheme = "lobatto2", progress: Callable[[str], None] | None = None, hidden: int = 4,
    seed: int = 0,
) -> LearnedResidual:  # fmt: skip
    """Learn a passive residual on an identified robot from the recordings that it was identified from.

    Args:
        nominal: the robot that the identification began from.
        recordings: at least two recordings, because each is held out in turn.
        found: the identification.
        space: the scheme along the rod.
        progress: called with a line for each step.
        hidden: units of the residual's networks.
        seed: of the networks' fixed weights.

    Raises:
        DataError: there is one recording only, or they cannot be used.
    """
    measured = measured_rows(recordings)
    if len(measured) < 2:
        raise DataError("there is one recording; a residual needs two at least, for one is left out in turn")
    tension = np.concatenate([each.tension for each in measured])
    model = Model.of_library(nominal, tension, measured[0].fractions)  # type: ignore[arg-type]
    x = coordinates_of(model, found)
    robot = model.reduced(x, found.effects)
    both = ResidualModel(model, found.effects, passive(robot, tension, seed, hidden))
    data = experiments_of(measured, model, space)
    return learn_residual(both, x, data, space, progress or log.info)


def coordinates_of(model: Model, found: Identified) -> np.ndarray:
    """Return the coordinates of an identified robot, by its estimates."""
    x = np.zeros(model.size)
    for name in found.effects:
        values = [each.value for each in found.estimates if each.effect == name]
        for k, value in zip(range(*model.slice(name).indices(model.size)), values, strict=True):
            x[k] = model.numbers[k].coordinate(value)
    return x


def _teller(progress: bool) -> Callable[[str], None]:
    return (lambda line: print(line, file=sys.stderr, flush=True)) if progress else log.info


def _measured(given: Sequence[Any]) -> tuple[list[Measurements], list[str]]:
    """Return the poses in all data, and the use of each, in words."""
    found, words = [], []
    for k, each in enumerate(given):
        if isinstance(each, Trajectory):
            found.append(poses_of_nodes(each, f"trajectory {k}"))
            words.append(f"trajectory {k}: poses of its {len(each.time)} rows, not its other states")
            continue
        (rows,) = measured_rows([each])
        found.append(rows)
        how = f"a recording, rows of {DT:g} s with mean tensions" if isinstance(each, Recording) else "rows"
        words.append(f"{names_of([rows])[0]}: {how}, {len(rows.time)} of them, poses and tensions")
    return measured_rows(found), words


def _with(learned: LearnedResidual, name: str) -> dict[str, float]:
    return {"residual": learned.with_residual[name].tip} if name in learned.with_residual else {}


def _models(
    learned: LearnedResidual, config: FitConfig, facts: dict[str, Any], others: Sequence[Measurements],
    space: str | SpaceScheme,
) -> Any:  # fmt: skip
    """Return the learned model, or one drawn for each of several seeds."""
    if isinstance(config.seed, tuple):
        return Ensemble(_named(learned.member(seed), config, {**facts, "seed": seed}) for seed in config.seed)
    told = _unseen(learned.robot, others, space)
    return _named(learned.robot, config, {**facts, "seed": config.seed, **told})


def _unseen(robot: System, others: Sequence[Measurements], space: str | SpaceScheme) -> dict[str, Any]:
    """Return errors of held-out data, if there are any."""
    errors = [evaluate(robot, each, space=space).tip_rmse for each in others]
    return {"unseen_error": dict(zip(names_of(others), errors, strict=True))} if others else {}


def _named(system: System, config: FitConfig, facts: dict[str, Any]) -> KNODE:
    """Return a model with its metadata, and without parts of its residual that have no effect."""
    about = About({**facts, "config": config.to_dict()})
    if not isinstance(system, KNODE):
        return KNODE(system, Nothing(), about)
    residual = system.residual
    return KNODE(system.knowledge, residual.pruned() if isinstance(residual, Passive) else residual, about)


def _network(
    knowledge: System, measured: Sequence[Measurements], others: Sequence[Measurements], config: FitConfig,
    given: list[str], space: str | SpaceScheme, tell: Callable[[str], None],
) -> Any:  # fmt: skip
    """Return the knowledge with a passive network, searched from zero over horizons that grow."""
    require_allowed(knowledge, config)
    tension = np.concatenate([each.tension for each in measured])
    options = config.residual
    assert isinstance(options, PassiveOptions)
    model = ResidualModel(FixedModel(knowledge), (), passive(knowledge, tension, 0, options.hidden), WIDE)
    # it has the members of a Model
    misfit = Misfit(model, experiments_of(measured, model, space))  # type: ignore[arg-type]
    search = Search(misfit, tell)
    try:
        point = search.from_far(model.mask(PARTS))
    except SearchError as error:
        raise FitError(f"{error}: the knowledge is too far from the robot") from None
    robot = model.robot(point.x)
    learned = LearnedResidual(robot, True, {}, {}, (), point.x, point.covariance(), model)
    return _models(learned, config, {"given": given, "residual": True}, others, space)
