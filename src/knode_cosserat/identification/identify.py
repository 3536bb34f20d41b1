"""Identification of a robot from data: its physical effects, and their parameters."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from knode_cosserat._arguments import check_arguments
from knode_cosserat.estimation.parameters import ParameterModel
from knode_cosserat.identification.effects import clock_effects, library_model, place_effects
from knode_cosserat.identification.experiments import (
    Experiment,
    experiments_of,
    in_parts,
    listed_rows,
    measured_rows,
    names_of,
)
from knode_cosserat.identification.free_parameters import identify_parameters, parameter_effects
from knode_cosserat.identification.journal import STAGES, Journal, OutOfTimeError, SearchError
from knode_cosserat.identification.library import identify_effects
from knode_cosserat.identification.misfit import Misfit
from knode_cosserat.identification.passports import passport_of
from knode_cosserat.identification.posterior import Posterior
from knode_cosserat.identification.result import IdentificationError, Identified
from knode_cosserat.identification.search import ParameterSearch
from knode_cosserat.learning.ensemble import Ensemble
from knode_cosserat.learning.knode import KNODE
from knode_cosserat.recordings.measurements import Measurements
from knode_cosserat.recordings.recording import Recording
from knode_cosserat.rods.passport import with_passport
from knode_cosserat.rods.system import System
from knode_cosserat.schemes.space import SpaceScheme
from knode_cosserat.trajectory import Trajectory

#: least part of the length by which all tendons are taken in if the zeros of motors are wrong
LARGEST_TAKEN = 0.05

log = logging.getLogger(__name__)


def identify(
    robot: System,
    data: Sequence[Recording | Measurements | Trajectory | Experiment],
    effects: Sequence[str] | None = None,
    *,
    parameters: Sequence[str] | Literal["all"] | None = None,
    space: str | SpaceScheme = "lobatto4",
    progress: Callable[[str], None] | None = None,
    checkpoint: str | Path | None = None,
    minutes: float = np.inf,
) -> Identified:
    """Find physical effects and parameters of a robot from recordings or trajectories, by least squares.

    Whole simulations, which start as the data do, are compared with everything that was measured: positions
    and rotations since the first row of recordings, all states of trajectories, or any `Output` of an
    `Experiment`. Unknown numbers are those of library effects, with priors about the data sheet, or plain
    parameters of any system, without priors. One objective serves all: robust squares of differences, each
    kind in units of its usual size, and the priors.

    Without `effects` and `parameters`, effects are selected by their probabilities
    (`identification.posterior`): those of the library, and the parameters of which the robot's parts state a
    `Doubt`. Of one recording of equilibria, parts are held out in turn. Where the data do not decide, the
    robot has the mean over all sets of effects. A robot with effects has to pass trials with larger and
    random controls; effects are removed until it does. Between continuous tensions the differences are those
    of infinitely short time steps, by extrapolation. If the grid is too coarse, its nodes are doubled: the
    result may have more nodes than the nominal robot.

    The first answer, with all effects, is found from the first quarter of the motions and predicts the other
    rows, which are held out. Where the time is over, the best robot so far is returned, `complete` is
    false, and `steps` say what was not done. Such a result depends on the machine's speed; any other is the
    same in every run. An interruption by Ctrl-C is a `KeyboardInterrupt`, whose `best` is this robot.

    Args:
        robot: nominal robot, where the search begins. A `TendonRobot`, whose tendons push it sideways, is
            searched as a `RoutedTendonRobot`, whose tendons bend it.
        data: recordings (`load_recording`, or rows of them, `Recording.sampled(0.0125, mean=True)`), each
            starting at rest, at least two to select effects; full states; or experiments.
        effects: names of effects (`effects_of`) that are all identified; None: select effects, unless there
            are `parameters`.
        parameters: parameters by name (`System.parameters`), those of parts with dots, such as
            `loads.0.mass`; "all": all of the robot's own that the data determine.
        space: scheme along the rod of recordings, for which the result is valid; trajectories have their own.
        progress: called with a line for each step.
        checkpoint: folder in which finished searches are kept; an interrupted run with the same arguments
            resumes from there, also one whose time was over.
        minutes: time that it may take, but for the last simulations of the best robot, some seconds.

    Returns:
        The `Identified` robot, with estimates, 95 % intervals, parameters that the data do not determine, and
        errors of held-out recordings.

    Raises:
        IdentificationError: the robot's parts state no doubts and nothing is named, it cannot be simulated,
            the data determine no parameter, or the search does not converge within the allowed ranges.
        DataError: data that are too short, do not fit the robot, or do not start at rest.
        ParameterError: an effect or a parameter that does not exist, or cannot be searched.
    """
    check_arguments(identify, locals())
    if np.ndim(robot.length):
        raise IdentificationError("robot is a batch; allowed is one robot")
    named = effects is None and parameters is not None
    if not minutes > 0.0:
        raise IdentificationError(f"minutes is {minutes}; allowed is a number above zero")
    journal = Journal(progress or log.info, checkpoint, minutes)
    rows: Any = listed_rows(data) if named else in_parts(measured_rows(data))
    plain = [] if parameters is None else parameter_effects(robot, parameters)
    measured = [it for it in rows if isinstance(it, Measurements)]
    plain += place_effects(measured, flat=named)
    if not named:
        _require_zeros(robot, measured)
        # without priors, and without the effects that they lack, plain parameters would make up for delays
        plain += clock_effects(
            {name: it.clock_deviation for name, it in zip(names_of(measured), measured, strict=True)}
        )

    def searched(robot: Any) -> ParameterSearch:
        if named:
            model = ParameterModel(robot, plain)
            experiments = experiments_of(rows, model, space)
        else:
            static = all(it.static for it in rows)
            model = library_model(
                robot, np.concatenate([it.control for it in rows]), rows[0].fractions, plain, static
            )
            if not model.effects:
                raise IdentificationError(
                    f"a {type(robot).__name__} states no doubt of a parameter (`Doubt`); allowed is to name "
                    '`parameters`, such as parameters="all"'
                )
            experiments = [it.rough() for it in experiments_of(rows, model, space)]
        return ParameterSearch(Misfit(model, experiments), journal)

    try:
        if named:
            found = identify_parameters(searched(robot))
        else:
            wanted = None if effects is None else [*effects, *(it.name for it in plain)]
            found = identify_effects(searched, robot, wanted, space)
    except OutOfTimeError:
        found = _best(robot, journal, "the time is over")
    except KeyboardInterrupt as stop:
        found = _best(robot, journal, "interrupted")
        stop.best = _with_passport(found, listed_rows(data), space)  # type: ignore[attr-defined]
        raise
    return _with_passport(found, listed_rows(data), space)


def _with_passport(found: Identified, rows: Sequence[Any], space: str | SpaceScheme) -> Identified:
    """Return the result with the passport of its robot and ensemble; the nominal robot learned nothing."""
    if not found.estimates:
        return found
    passport = passport_of("identify", found.robot, rows, space, found.held_out_error)
    robot, members = with_passport(found.robot, passport), None
    if found.ensemble is not None:
        members = Ensemble(
            KNODE(with_passport(it.knowledge, passport), it.residual, it.about) for it in found.ensemble
        )
    return dataclasses.replace(found, robot=robot, ensemble=members)


def _require_zeros(robot: System, rows: Sequence[Measurements]) -> None:
    """Raise `IdentificationError` if motors always hold all tendons far from their lengths at rest.

    No search finds such zeros, and a robot whose tendons are all taken in by much has no equilibrium.
    """
    if getattr(robot, "reels", None) is None:
        return
    taken_in: Any = robot.taken_in  # type: ignore[attr-defined]
    for name, it in zip(names_of(rows), rows, strict=True):
        known = it.control[np.isfinite(it.control).all(axis=1)]
        shares = np.array([taken_in(row) for row in known[:: max(1, len(known) // 100)]]) / robot.length
        if len(shares) and (shares.min() > LARGEST_TAKEN or shares.max() < -LARGEST_TAKEN):
            first = ", ".join(f"{number:.4g}" for number in known[0])
            raise IdentificationError(
                f"{name}: all tendons are {'taken in' if shares.min() > 0.0 else 'let out'} by "
                f"{100.0 * np.abs(shares).min():.2g} % of the length or more in every row; the motors of the "
                f"straight robot are not at reels.zero. If it is straight in the first row: zero: [{first}]"
            )


def _best(nominal: System, journal: Journal, reason: str) -> Identified:
    """Return the best robot so far: of the last search, or else the nominal one."""
    found = journal.result or Identified(nominal)
    if journal.result is None and journal.last is not None:
        search, last = journal.last
        model, journal.deadline = search.misfit.model, np.inf
        names = [it.name for it in model.effects if last.free[model.slice(it.name)].any()]
        try:
            point = search.run(last.x, last.free, effort=(0, 0.0))
            found = Identified.of(search, last.x, names, Posterior.of(model, point, names))
        except SearchError as error:  # it was searched in a part of the rows only
            journal.step(f"the nominal robot is returned: {error}")
    missing = ", ".join(STAGES[STAGES.index(journal.stage) :]) if journal.stage else "the search"
    journal.step(f"not complete, {reason}; not done: {missing}")
    return dataclasses.replace(found, steps=tuple(journal.steps), complete=False)
