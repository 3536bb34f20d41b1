"""Identification of a robot from recordings: its physical effects, and their parameters."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from knode_cosserat._files.yaml_text import did_you_mean
from knode_cosserat.errors import KnodeCosseratError
from knode_cosserat.identification.inputs import measurements_of, names_of, padded
from knode_cosserat.identification.intervals import estimates_of
from knode_cosserat.identification.journal import Journal
from knode_cosserat.identification.misfit import Misfit, RecordingData, data_of
from knode_cosserat.identification.model import Model
from knode_cosserat.identification.result import Estimate, Identified
from knode_cosserat.identification.search import Point, Search, SearchError
from knode_cosserat.identification.selection import held_out, improved, selected, sizes
from knode_cosserat.identification.trials import failed_trial, has_coarse_rows, trained_range
from knode_cosserat.recordings.measurements import Measurements
from knode_cosserat.recordings.recording import Recording
from knode_cosserat.rods.parameters import ParameterError
from knode_cosserat.rods.system import System
from knode_cosserat.rods.tendon_rod import TendonRod
from knode_cosserat.solvers.space import SpaceScheme

log = logging.getLogger(__name__)

#: nodes are doubled so often at most
REFINEMENTS = 2
#: most corrections of a search without one recording
FOLD = (8, 5e-3)


class IdentificationError(KnodeCosseratError, ValueError):
    """A robot cannot be identified; one line says why."""

    code = "identification"


def identify(
    robot: System,
    recordings: Sequence[Recording | Measurements],
    effects: Sequence[str] | None = None,
    *,
    space: str | SpaceScheme = "lobatto2",
    progress: Callable[[str], None] | None = None,
    checkpoint: str | Path | None = None,
) -> Identified:
    """Identify a tendon robot from recordings: find its physical effects and their parameters.

    Whole simulations start in the equilibrium under the recording's initial tensions. They are compared with
    the measured positions and with the rotations since the first row; velocities, forces and strains need not
    be known. Parameters minimise robust squares, with a prior about the data sheet. An effect is kept only if
    it lowers the error of held-out recordings by more than two standard errors of the improvement. The result
    has to pass trials with larger and random tensions; effects are removed until it does.

    Time steps are short enough for vibrations (`identification.steps`), unless tensions are held from row to
    row. Effects are selected with one step from row to row, and then again with the final steps. If the grid
    is too coarse for the identified robot, its nodes are doubled and the last search is repeated: the result
    may have more nodes than the nominal robot.

    Args:
        robot: the nominal robot, from ruler, scale and data sheet; a robot with tendons.
        recordings: recordings, or their `Measurements` with mean tensions (`recording.sampled(0.0125,
            mean=True)`), each starting at rest; at least two, to select effects by held-out error.
        effects: names of effects (`effects_of`) that are all identified; None: select effects.
        space: the scheme along the rod for which the result is valid.
        progress: called with a line for each step.
        checkpoint: folder in which finished searches are kept; an interrupted run with the same arguments
            resumes from there.

    Returns:
        The `Identified` robot, with estimates, intervals, and errors of held-out recordings.

    Raises:
        IdentificationError: the robot has no tendons, or cannot be simulated under the initial tensions.
        DataError: a recording is too short, or has unknown tensions.
        ParameterError: an effect that does not exist.
    """
    tell = progress or log.info
    if not isinstance(robot, TendonRod):
        raise IdentificationError(
            f"robot is a {type(robot).__name__}; allowed is a robot with tendons (TendonRobot, "
            "RoutedTendonRobot)"
        )
    measured = measurements_of(recordings)
    journal = None if checkpoint is None else Journal(checkpoint)
    search = _search(robot, measured, space, tell, journal)
    model, data = search.misfit.model, search.misfit.data
    far = search
    if any(each.steps > 1 for each in data):
        far = Search(Misfit(model, [each._replace(steps=1) for each in data], space), tell, journal=journal)
    steps: list[str] = []
    try:
        if effects is not None:
            names = _known(effects, model)
            point = far.from_far(model.mask(names))
        else:
            names, point, taken = selected(far, tell)
            steps += taken
        if search is not far:
            point = search.run(point.x, model.mask(names))
        search, point = _refined(search, names, point, measured, steps)
        if effects is None and search is not far:
            names, point, taken = improved(search, names, point, tell, ", by the final steps")
            steps += taken
    except SearchError as error:
        raise IdentificationError(f"{error}; the data sheet's numbers are too far from the robot") from None
    return _accepted(search, names, point, search.misfit.data, steps, space, tell)


def _search(
    robot: TendonRod, measured: Sequence[Measurements], space: str | SpaceScheme,
    tell: Callable[[str], None], journal: Journal | None,
) -> Search:  # fmt: skip
    tension = np.concatenate([each.tension for each in measured])
    model = Model(robot, tension, measured[0].fractions)
    data = [data_of(each, model, name) for each, name in zip(measured, names_of(measured), strict=True)]
    return Search(Misfit(model, padded(data), space), tell, journal=journal)


def _refined(
    search: Search, names: tuple[str, ...], point: Point, measured: Sequence[Measurements], steps: list[str]
) -> tuple[Search, Point]:
    """Return the search, and its end, on a grid that is not too coarse for the robot that was found."""
    space, tell = search.misfit.settings.space, search.tell
    for _ in range(REFINEMENTS):
        model, data = search.misfit.model, search.misfit.data
        if not has_coarse_rows(model.reduced(point.x, names), data, space):
            break
        nodes = 2 * model.nominal.nodes
        tell(f"the grid of {model.nominal.nodes} nodes is too coarse: {nodes} nodes")
        search = _search(model.nominal.replace(nodes=nodes), measured, space, tell, search.journal)
        point = search.run(point.x, search.misfit.model.mask(names))
        steps.append(f"with {nodes} nodes, for the grid was too coarse: {sizes(point)}")
    return search, point


def _known(effects: Sequence[str], model: Model) -> tuple[str, ...]:
    for name in effects:
        if name not in model.names:
            raise ParameterError(
                f"there is no effect {name!r}{did_you_mean(name, model.names)}; there are "
                f"{', '.join(model.names)}"
            )
    wanted = {*effects, *(each.name for each in model.effects if each.basic)}
    return tuple(name for name in model.names if name in wanted)


def _accepted(
    search: Search, names: tuple[str, ...], point: Point, data: Sequence[RecordingData], steps: list[str],
    space: str | SpaceScheme, tell: Callable[[str], None],
) -> Identified:  # fmt: skip
    """Return the identified robot after its trials: with fewer effects if it fails, nominal if that fails."""
    model = search.misfit.model
    while True:
        found = model.reduced(point.x, names)
        reason = failed_trial(found, data, space)
        if reason is None:
            break
        added = [name for name in names if not model.effect(name).basic]
        tell(f"not accepted: {reason}")
        if not added:
            steps.append(f"the nominal robot is returned: {reason}")
            return _result(search, model.nominal, (), None, data, steps)
        fewest = _least_missed(search, point, names, added)
        steps.append(f"without {fewest}: {reason}")
        names = tuple(name for name in names if name != fewest and fewest not in model.effect(name).needs)
        point = search.run(np.where(model.mask(names), point.x, 0.0), model.mask(names), scale=point.scale)
    left_out, folds = _held_out(search, point)
    nominal = _errors(search, np.zeros(model.size))
    better = [np.inf if error is None else error for error in left_out]
    if len(data) > 1 and np.mean(better) >= np.mean([np.inf if e is None else e for e in nominal]):
        steps.append("the nominal robot is returned: it predicts held-out recordings as well")
        return _result(search, model.nominal, (), None, data, steps)
    found = found.replace(trained=trained_range(found, data, space))
    estimates = estimates_of(model, names, point, folds)
    return _result(search, found, names, point, data, steps, left_out, estimates)


def _least_missed(search: Search, point: Point, names: Sequence[str], added: Sequence[str]) -> str:
    """Return the added effect whose absence costs least, by the equations linear about the point."""
    model = search.misfit.model

    def cost(name: str) -> float:
        fewer = [each for each in names if each != name]
        return held_out(point.problem, point.x, model.mask(fewer), model)

    return min(added, key=cost)


def _held_out(search: Search, point: Point) -> tuple[list[float | None], list[np.ndarray]]:
    """Return the error (m) of each recording, predicted by a search that did not see it, and its end."""
    count = len(search.misfit.data)
    if count == 1:
        return [None], []
    errors: list[float | None] = []
    folds = []
    for k in range(count):
        fold = search.without(point, k, *FOLD)
        errors.append(None if fold is None else _errors(search, fold.x, [k])[0])
        if fold is not None:
            folds.append(fold.x)
    return errors, folds


def _errors(search: Search, x: np.ndarray, which: Sequence[int] | None = None) -> list[float | None]:
    """Return the root mean square error of the last body's position (m), by recording."""
    found = search.misfit.differences(x, which=which, derivatives=False)
    errors: list[float | None] = []
    for rollout in found:
        if rollout is None:
            errors.append(None)
            continue
        tip = np.sum(rollout.values[:, -1, :3] ** 2, axis=-1)
        errors.append(float(np.sqrt(np.nanmean(tip))))
    return errors


def _result(
    search: Search, robot: System, names: tuple[str, ...], point: Point | None, data: Sequence[RecordingData],
    steps: Sequence[str], left_out: Sequence[float | None] = (), estimates: Sequence[Estimate] = (),
) -> Identified:  # fmt: skip
    model = search.misfit.model
    recordings = [each.name for each in data]
    nominal = _errors(search, np.zeros(model.size))
    x = np.zeros(model.size) if point is None else point.x
    identified = _errors(search, x)
    return Identified(
        robot=robot,
        effects=names,
        estimates=tuple(estimates),
        nominal_error=dict(zip(recordings, nominal, strict=True)),
        error=dict(zip(recordings, identified, strict=True)),
        held_out_error=dict(zip(recordings, left_out or [None] * len(recordings), strict=True)),
        steps=tuple(steps),
    )
