"""Fitting from full states or from measured poses."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from knode_cosserat._arguments import check_arguments
from knode_cosserat.estimation.parameters import ParameterModel
from knode_cosserat.identification.effects import library_model
from knode_cosserat.identification.evaluate import evaluate
from knode_cosserat.identification.experiments import (
    experiments_of,
    measured_rows,
    names_of,
    poses_of_nodes,
)
from knode_cosserat.identification.identify import identify
from knode_cosserat.identification.journal import Journal, SearchError
from knode_cosserat.identification.misfit import Misfit
from knode_cosserat.identification.residual import LearnedResidual, learn_residual, residual_model
from knode_cosserat.identification.result import Identified
from knode_cosserat.identification.search import ParameterSearch
from knode_cosserat.learning.config import FitConfig, FitError, PassiveOptions, StructuredOptions
from knode_cosserat.learning.ensemble import Ensemble
from knode_cosserat.learning.knode import KNODE, About
from knode_cosserat.learning.passive import Passive, passive
from knode_cosserat.learning.residual import Nothing
from knode_cosserat.learning.states import BEST, fit_states, require_allowed
from knode_cosserat.recordings.measurements import DT, Measurements
from knode_cosserat.recordings.recording import Recording
from knode_cosserat.rods.system import System
from knode_cosserat.schemes.space import SpaceScheme
from knode_cosserat.solvers.segments import DataError
from knode_cosserat.trajectory import Trajectory

log = logging.getLogger(__name__)

#: widths of the priors of a network's residual, wide enough for the errors of a crude nominal model
WIDE = {"stiffness": 0.5, "levers": 3.0, "energy": 0.5, "damping": 3.0, "dissipation": 3.0}

Tell = Callable[[str], None]


def fit(
    knowledge: System,
    data: Sequence[Trajectory | Recording | Measurements],
    config: FitConfig = BEST,
    *,
    held_out: Sequence[Any] = (),
    space: str | SpaceScheme = "lobatto4",
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
        options: for trajectories only: `checkpoint`, `checkpoint_every`, `log_dir` and `verify` of
            `learning.states.fit_states`.

    Returns:
        A `KNODE`, or an `Ensemble` of one for each seed if `config.seed` is several: from recordings, random
        samples of the robots that agree with them, with a spread that covers held-out recordings. From
        recordings, `about.facts` has "given" (the use of each), "steps" (in words), "identified" (see
        `Identified.to_dict`), "residual" (true if it was kept) and "held_out_error" (m) by recording.

    Raises:
        DataError: recordings or trajectories that cannot be used.
        FitError: data without anything to learn, or a config that needs full states.
        IdentificationError: the robot cannot be identified.
    """
    check_arguments(fit, locals())
    # motions of trial models that diverge are refused by their results, not by floating-point warnings
    with np.errstate(all="ignore"):
        listed: Any = data
        several = isinstance(listed, Iterable) and not isinstance(listed, str | Trajectory)
        listed = list(listed) if several else listed
        if not several or all(isinstance(it, Trajectory) for it in listed):
            return fit_states(knowledge, listed, config, held_out=held_out, progress=progress, **options)
        if options:
            raise FitError(
                f"{next(iter(options))} is for trajectories; from recordings there are no checkpoints"
            )
        if not isinstance(getattr(config, "residual", None), StructuredOptions | PassiveOptions):
            raise FitError(
                "this config needs full states, and recordings have none: estimate them first "
                "(kc.estimate_states), or use FitConfig() or FitConfig.network_recordings()"
            )
        tell: Tell = (lambda line: print(line, file=sys.stderr, flush=True)) if progress else log.info
        measured, use = _measured(listed)
        for line in use:
            tell(line)
        poses = _Poses(measured, use, _measured(held_out)[0] if held_out else [], space)
        if isinstance(config.residual, PassiveOptions):
            return _with_network(knowledge, poses, config, tell)
        if len(measured) == 1 and isinstance(config.seed, tuple):
            raise FitError(
                "there is one recording; an ensemble needs two at least, for its spread is held out"
            )
        identified = identify(knowledge, measured, space=space, progress=tell)
        facts: dict[str, Any] = {"given": use, "identified": identified.to_dict(), "residual": False}
        if len(measured) == 1:
            facts["steps"] = [*identified.steps, "no residual: there is one recording, and none to hold out"]
            return _named(identified.robot, config, {**facts, **poses.unseen_error(identified.robot)})
        learned = with_residual(knowledge, measured, identified, space=space, progress=tell)
        errors = {name: {"identified": errors.tip} for name, errors in learned.without.items()}
        for name, residual_errors in learned.with_residual.items():
            errors[name]["residual"] = residual_errors.tip
        steps = [*identified.steps, *learned.steps]
        facts |= {"steps": steps, "residual": learned.kept, "held_out_error": errors}
        return _models(learned, poses, config, facts)


class _Poses(NamedTuple):
    """Recordings to learn from, the use of each in words, held-out ones, and the scheme along the rod."""

    measured: list[Measurements]
    use: list[str]
    unseen: list[Measurements]
    space: str | SpaceScheme

    def unseen_error(self, robot: System) -> dict[str, Any]:
        """Return errors of held-out data, if there are any."""
        errors = [evaluate(robot, it, space=self.space).tip_rmse for it in self.unseen]
        return {"unseen_error": dict(zip(names_of(self.unseen), errors, strict=True))} if errors else {}


def with_residual(
    nominal: System,
    recordings: Sequence[Recording | Measurements],
    identified: Identified,
    *,
    space: str | SpaceScheme = "lobatto4",
    progress: Tell | None = None,
) -> LearnedResidual:
    """Learn a passive residual on an identified robot from the recordings that it was identified from.

    Args:
        nominal: the robot that the identification began from.
        recordings: at least two recordings, because each is held out in turn.
        identified: the identification.
        space: the scheme along the rod.
        progress: called with a line for each step.

    Raises:
        DataError: there is one recording only, or they cannot be used.
    """
    check_arguments(with_residual, locals())
    measured = measured_rows(recordings)
    if len(measured) < 2:
        raise DataError("there is one recording; a residual needs two at least, for one is left out in turn")
    tension = np.concatenate([it.control for it in measured])
    model = library_model(nominal, tension, measured[0].fractions)  # type: ignore[arg-type]
    x = coordinates_of(model, identified)
    effects = (*identified.effects, *identified.undecided)
    residual = passive(model.reduced(x, effects), tension)
    both = residual_model(model, effects, residual)
    begin = np.zeros(both.size)
    begin[: np.sum(model.mask(effects))] = x[model.mask(effects)]
    data = experiments_of(measured, model, space)
    return learn_residual(both, begin, data, space, Journal(progress or log.info))


def coordinates_of(model: ParameterModel, identified: Identified) -> np.ndarray:
    """Return the coordinates of an identified robot, by its estimates."""
    values = {it.label: it.value for it in identified.estimates}
    return np.array([it.coordinate(values[it.label]) if it.label in values else 0.0 for it in model.numbers])


def _measured(data: Sequence[Any]) -> tuple[list[Measurements], list[str]]:
    """Return the poses in all data, and the use of each, in words."""
    measured, words = [], []
    for k, it in enumerate(data):
        if isinstance(it, Trajectory):
            measured.append(poses_of_nodes(it, f"trajectory {k}"))
            words.append(f"trajectory {k}: poses of its {len(it.time)} rows, not its other states")
            continue
        (rows,) = measured_rows([it])
        measured.append(rows)
        how = f"a recording, rows of {DT:g} s with mean tensions" if isinstance(it, Recording) else "rows"
        words.append(f"{names_of([rows])[0]}: {how}, {len(rows.time)} of them, poses and tensions")
    return measured_rows(measured), words


def _models(learned: LearnedResidual, poses: _Poses, config: FitConfig, facts: dict[str, Any]) -> Any:
    """Return the learned model, or one drawn for each of several seeds."""
    if isinstance(config.seed, tuple):
        return Ensemble(_named(learned.member(seed), config, {**facts, "seed": seed}) for seed in config.seed)
    robot = learned.robot
    return _named(robot, config, {**facts, "seed": config.seed, **poses.unseen_error(robot)})


def _named(system: System, config: FitConfig, facts: dict[str, Any]) -> KNODE:
    """Return a model with its metadata, and without parts of its residual that have no effect."""
    about = About({**facts, "config": config.to_dict()})
    if not isinstance(system, KNODE):
        return KNODE(system, Nothing(), about)
    residual = system.residual
    return KNODE(system.knowledge, residual.pruned() if isinstance(residual, Passive) else residual, about)


def _with_network(knowledge: System, poses: _Poses, config: FitConfig, tell: Tell) -> Any:
    """Return the knowledge with a passive network, searched from zero over horizons that grow."""
    require_allowed(knowledge, config)
    tension = np.concatenate([it.control for it in poses.measured])
    options = config.residual
    assert isinstance(options, PassiveOptions)
    model = residual_model(
        ParameterModel(knowledge, ()), (), passive(knowledge, tension, 0, options.hidden), WIDE
    )
    search = ParameterSearch(Misfit(model, experiments_of(poses.measured, model, poses.space)), Journal(tell))
    try:
        point = search.from_far(model.mask(model.names))
    except SearchError as error:
        raise FitError(f"{error}: the knowledge is too far from the robot") from None
    learned = LearnedResidual(model, point.x, point.covariance())
    return _models(learned, poses, config, {"given": poses.use, "residual": True})
