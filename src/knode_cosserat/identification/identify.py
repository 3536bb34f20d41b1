"""Identification of a robot from data: its physical effects, and their parameters."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from knode_cosserat._arguments import check_arguments
from knode_cosserat._files.yaml_text import did_you_mean
from knode_cosserat.errors import KnodeCosseratError
from knode_cosserat.estimation.outputs import Several, States
from knode_cosserat.estimation.parameters import Model
from knode_cosserat.identification.effects import library_model, parameter_effects, place_effects
from knode_cosserat.identification.experiments import Experiment, experiments_of, listed_rows, measured_rows
from knode_cosserat.identification.misfit import Misfit, Rollout
from knode_cosserat.identification.next_experiment import next_experiment
from knode_cosserat.identification.posterior import SURE, Posterior
from knode_cosserat.identification.result import Identified, estimates_of
from knode_cosserat.identification.samples import sampled
from knode_cosserat.identification.search import OutOfTimeError, Point, Search, SearchError, clock
from knode_cosserat.identification.selection import (
    WORSE,
    Selection,
    best_predicting,
    first_answer,
    from_far,
    selected,
)
from knode_cosserat.identification.trials import failed_trial, has_coarse_rows, trained_range
from knode_cosserat.identification.undetermined import gap_of, unexplained
from knode_cosserat.learning.training.checkpoint import Checkpoints
from knode_cosserat.recordings.measurements import Measurements
from knode_cosserat.recordings.recording import Recording
from knode_cosserat.rods.parameters import ParameterError
from knode_cosserat.rods.system import System
from knode_cosserat.rods.tendon_robots import TendonRod
from knode_cosserat.schemes.space import SpaceScheme
from knode_cosserat.solvers.segments import DataError
from knode_cosserat.trajectory import Trajectory

log = logging.getLogger(__name__)

#: nodes are doubled so often at most
REFINEMENTS = 2
#: numbers of first horizons that searches without priors leave out, one after the other
SKIPPED = (0, 3, 9)
#: row 0 disagrees with the initial equilibrium if it is further away than this part of the length, and than
#: this part of the motion's root mean square
AWAY, OF_MOTION = 0.01, 0.25

Tell = Callable[[str], None]


class IdentificationError(KnodeCosseratError, ValueError):
    """A robot cannot be identified; one line says why."""

    code = "identification"


def identify(
    robot: System,
    data: Sequence[Recording | Measurements | Trajectory | Experiment],
    effects: Sequence[str] | None = None,
    *,
    parameters: Sequence[str] | Literal["all"] | None = None,
    space: str | SpaceScheme = "lobatto4",
    progress: Tell | None = None,
    checkpoint: str | Path | None = None,
    minutes: float = np.inf,
) -> Identified:
    """Find physical effects and parameters of a robot from recordings or trajectories, by least squares.

    Whole simulations, which start as the data do, are compared with everything that was measured: positions
    and rotations since the first row of recordings, all states of trajectories, or any `Output` of an
    `Experiment`. Unknown numbers are those of library effects, with priors about the data sheet, or plain
    parameters of any system, without priors. One objective serves all: robust squares of differences, each
    kind in units of its usual size, and the priors.

    Without `effects` and `parameters`, effects of a tendon robot are selected by their probabilities
    (`identification.posterior`). Where the data do not decide, the robot has the mean over all sets of
    effects. A robot with effects has to pass trials with larger and random tensions; effects are removed
    until it does. Between continuous tensions the differences are those of infinitely short time steps, by
    extrapolation. If the grid is too coarse, its nodes are doubled: the result may have more nodes than the
    nominal robot.

    The first answer, with all effects, is found from the first quarter of the motions and predicts the other
    rows, which are held out. Where the time is over, the best robot so far is returned, `complete` is
    false, and `steps` say what was not done. Such a result depends on the machine's speed; any other is the
    same in every run. An interruption by Ctrl-C is a `KeyboardInterrupt`, whose `best` is this robot.

    Args:
        robot: nominal robot, where the search begins; effects need a robot with tendons.
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
        IdentificationError: the robot has no tendons but effects are wanted, it cannot be simulated, the data
            determine no parameter, or the search does not converge within the allowed ranges.
        DataError: data that are too short, do not fit the robot, or do not start at rest.
        ParameterError: an effect or a parameter that does not exist, or cannot be searched.
    """
    check_arguments(identify, locals())
    if np.ndim(robot.length):
        raise IdentificationError("robot is a batch; allowed is one robot")
    named = effects is None and parameters is not None
    if not named and not isinstance(robot, TendonRod):
        raise IdentificationError(
            f"robot is a {type(robot).__name__}; allowed is a robot with tendons (TendonRobot, "
            'RoutedTendonRobot), or name `parameters`, such as parameters="all"'
        )
    if not minutes > 0.0:
        raise IdentificationError(f"minutes is {minutes}; allowed is a number above zero")
    course = _Course(progress or log.info, clock() + 60.0 * minutes)
    journal = None if checkpoint is None else Checkpoints(checkpoint)
    data = listed_rows(data)
    plain = [] if parameters is None else parameter_effects(robot, parameters)
    rows = [it for it in data if isinstance(it, Measurements)]
    plain += place_effects(rows, flat=named)
    measured = [] if named else measured_rows(data)

    def searched(robot: Any) -> Search:
        if named:
            model = Model(robot, plain)
            experiments = experiments_of(data, model, space)
        else:
            tension = np.concatenate([rows.tension for rows in measured])
            model = library_model(robot, tension, measured[0].fractions, plain)
            experiments = [it.rough() for it in experiments_of(measured, model, space)]
        misfit = Misfit(model, experiments)
        course.search = Search(misfit, course.tell_left, journal=journal, deadline=course.deadline)
        return course.search

    search = searched(robot)
    try:
        if named:
            return _with_parameters(search)
        wanted = None if effects is None else [*effects, *(it.name for it in plain)]
        found = _with_effects(search, course, wanted, space, searched)
    except OutOfTimeError:
        return course.best("the time is over")
    except KeyboardInterrupt as stop:
        stop.best = course.best("interrupted")  # type: ignore[attr-defined]
        raise
    return dataclasses.replace(found, steps=tuple(course.steps))


#: stages of an identification by effects
STAGES = (
    "first answer", "all effects", "selection of effects", "held-out recordings", "trials",
    "next experiment and band of predictions",
)  # fmt: skip


@dataclasses.dataclass
class _Course:
    """Course of an identification: its stage, its selections in words, and the result of the trials."""

    tell: Tell
    deadline: float
    steps: list[str] = dataclasses.field(default_factory=list)
    stage: str = ""
    search: Any = None
    result: Identified | None = None

    def tell_left(self, line: str) -> None:
        """Tell a line, with the time left."""
        left = self.deadline - clock()
        self.tell(f"{line}, {max(left, 0.0):.0f} s left" if left < np.inf else line)

    def step(self, line: str) -> None:
        """Tell a line that belongs to the result."""
        self.steps.append(line)
        self.tell_left(line)

    def begin(self, stage: str) -> None:
        """Begin a stage, if there is time."""
        self.stage = stage
        self.tell_left(f"stage {STAGES.index(stage) + 1} of {len(STAGES)}, {stage}")
        if clock() > self.deadline:
            raise OutOfTimeError

    def best(self, reason: str) -> Identified:
        """Return the best robot so far: of the last search, or else the nominal one."""
        search, found = self.search, self.result
        model, last = search.misfit.model, search.last
        if found is None and last is not None:
            names = [it.name for it in model.effects if last.free[model.slice(it.name)].any()]
            search.deadline = np.inf
            point = search.run(last.x, last.free, effort=(0, 0.0))
            posterior = Posterior.of(model, point, names)
            found = _result(search, model.reduced(last.x, names), (last.x, names), posterior)
        missing = ", ".join(STAGES[STAGES.index(self.stage) :]) if self.stage else "the search"
        self.step(f"not complete, {reason}; not done: {missing}")
        found = found or Identified(model.nominal)
        return dataclasses.replace(found, steps=tuple(self.steps), complete=False)


def _with_effects(
    search: Search, course: _Course, effects: Sequence[str] | None, space: str | SpaceScheme,
    searched: Callable[[Any], Search],
) -> Identified:  # fmt: skip
    """Return the robot with the named effects, or with selected ones."""
    model = search.misfit.model
    try:
        if effects is not None:
            names = _known(effects, model)
            point = search.from_far(model.mask(names))
        else:
            first = _first_answer(search, course)
            course.begin("all effects")
            point = from_far(search, first)
        for refinements in range(REFINEMENTS + 1):
            if effects is None:
                course.begin("selection of effects")
                names, point = selected(search, point, course.step)
            elif refinements:
                point = search.run(point.x, model.mask(names))
            if not has_coarse_rows(search.misfit.system(point.x), search.misfit.data, space):
                break
            nodes = 2 * model.nominal.nodes
            course.step(f"{nodes} nodes, for the grid was too coarse")
            search = searched(model.nominal.replace(nodes=nodes))
            model = search.misfit.model
    except SearchError as error:
        raise IdentificationError(f"{error}; the data sheet's numbers are too far from the robot") from None
    course.begin("held-out recordings")
    selection = Selection.of(search, names, point)
    if effects is None and selection.folds:
        selection = best_predicting(search, selection, course.step)
        search.last = selection.point
    return _accepted(search, selection, effects is not None, space, course)


def _first_answer(search: Search, course: _Course) -> Point | None:
    """Tell the numbers of the robot of the first rows, and its error in the held-out rows after them."""
    course.begin("first answer")
    model = search.misfit.model
    try:
        point, rows = first_answer(search)
    except SearchError as error:
        search.tell(f"no first answer: {error}")
        return None
    errors = [error for error in _errors(search, point.x, rows=rows) if error is not None]
    found = estimates_of(Posterior.of(model, point, model.names), point.x, model.names)
    words = ", ".join(f"{it.label} {it.value:.3g} ± {it.error:.2g} {it.unit}" for it in found
                      if model.effect(it.effect).basic)  # fmt: skip
    course.step(f"first answer, tip error in held-out rows {1e3 * np.mean(errors or np.nan):.3g} mm: {words}")
    return point


# plain parameters


def _with_parameters(search: Search) -> Identified:
    """Return the robot with parameters that have flat priors; undetermined ones stay as they are."""
    model = search.misfit.model
    names, steps = model.names, list[str]()
    while True:
        if not names:
            raise IdentificationError(f"these data determine none of {', '.join(model.names)}: {steps[-1]}")
        try:
            gap = None
            with contextlib.suppress(SearchError):  # whole motions of a distant robot may have no solution
                start = search.run(np.zeros(model.size), model.mask(names), effort=(0, 0.0))
                gap = gap_of(search, start, False)
            if gap is None:
                point = _from_far(search, model.mask(names))
                gap = gap_of(search, point, True)
        except SearchError as error:
            _require_start(search, np.zeros(model.size))
            raise IdentificationError(str(error)) from None
        if gap is None:
            break
        missing, reason = gap
        steps.append(reason)
        search.tell(reason)
        names = tuple(name for name in names if name not in missing)
    _require_start(search, point.x)
    if not point.converged:
        raise IdentificationError("the search did not converge; begin closer to the data")
    _require_range(model, names, point)
    posterior = Posterior.of(model, point, names)
    result = _result(search, model.reduced(point.x, names), (point.x, names), posterior)
    undetermined = tuple(name for name in model.names if name not in names)
    return dataclasses.replace(result, undetermined=undetermined, steps=tuple(steps))


def _from_far(search: Search, free: np.ndarray) -> Point:
    """Return the end of the first search whose remaining differences are noise, or of the best search.

    With noise the first rows of a motion may mislead a search, while another number of rows does not.
    """
    points: list[Point] = []
    for skipped in SKIPPED:
        try:
            point = search.from_far(free, skipped)
        except SearchError:
            if not points and skipped == SKIPPED[-1]:
                raise
            continue
        points.append(point)
        if point.converged and not unexplained(search, point.x):
            return point
    return min(points, key=lambda point: (not point.converged, float(np.sum(np.log(point.scale)))))


def _require_start(search: Search, x: np.ndarray) -> None:
    """Raise `DataError` if row 0 is not the equilibrium that an experiment starts from."""
    length = float(np.asarray(search.misfit.model.nominal.length))
    for data, rollout in zip(search.misfit.data, search.misfit.differences(x, 0), strict=True):
        places = _places(data)
        if data.held is None or rollout is None or places is None:
            continue
        apart = np.linalg.norm(_positions(rollout, data)[:1], axis=-1)
        moved = np.sum((places(data.data) - places(data.data)[:1]) ** 2, axis=-1)
        count = np.maximum(np.isfinite(moved).sum(axis=0), 1)
        away, usual = np.max(np.nan_to_num(apart)), np.max(np.sqrt(np.nansum(moved, axis=0) / count))
        if away > max(AWAY * length, OF_MOTION * usual):
            raise DataError(
                f"{data.name}: row 0 is {1e3 * away:.3g} mm from the equilibrium under "
                f"{np.round(data.held, 4).tolist()}; allowed is data that start at rest. Use the rows "
                "after the robot has settled, state initial_tension, give full states, or correct what is "
                "not identified, such as the length"
            )


def _require_range(model: Model, names: Sequence[str], point: Point) -> None:
    """Raise if a number ended at a limit of its allowed range; a limit of zero is accepted."""
    for number, value, free in zip(model.numbers, model.values(point.x), model.mask(names), strict=True):
        for end in (number.low, number.high):
            if free and end != 0.0 and abs(value - end) <= 1e-6 * abs(end):
                raise IdentificationError(
                    f"{number.label} ran to the end of its allowed range, {end:g}; leave it out"
                )


# library effects


def _known(effects: Sequence[str], model: Model) -> tuple[str, ...]:
    for name in effects:
        if name not in model.names:
            raise ParameterError(
                f"there is no effect {name!r}{did_you_mean(name, model.names)}; there are "
                f"{', '.join(model.names)}"
            )
    wanted = {*effects, *(effect.name for effect in model.effects if effect.basic)}
    return tuple(name for name in model.names if name in wanted)


def _accepted(
    search: Search, selection: Selection, known: bool, space: str | SpaceScheme, course: _Course
) -> Identified:
    """Return the identified robot after its trials: with fewer effects if it fails, nominal if that fails.

    The effects are `known` if they were not selected.
    """
    model, data = search.misfit.model, search.misfit.data
    while True:
        course.begin("trials")
        names, point, folds, *_ = selection
        x, kept, posterior = _averaged(search, selection, selection.posterior(model, known))
        system, motions = search.misfit.system(x), list[Trajectory]()
        reason = failed_trial(system, data, space, motions)
        if reason is None:
            break
        added = [name for name in names if not model.effect(name).basic]
        search.tell(f"not accepted: {reason}")
        if not added:
            course.step(f"the nominal robot is returned: {reason}")
            return _nominal(search)
        fewer = {
            name: tuple(it for it in names if name not in (it, *model.effect(it).needs)) for name in added
        }
        weakest = max(added, key=lambda name: posterior.evidence(fewer[name]))
        course.step(f"without {weakest}: {reason}")
        names, known = fewer[weakest], True
        free = model.mask(names)
        selection = Selection.of(search, names, search.run(np.where(free, point.x, 0.0), free))
    errors: list[float | None] = [None]
    if folds:
        errors = [None if it is None else _errors(search, it.x, [k], False)[0] for k, it in enumerate(folds)]
        nominal = _errors(search, np.zeros(model.size), tip=False)
        unseen, before = ([np.inf if it is None else it for it in values] for values in (errors, nominal))
        if np.mean(unseen) >= np.mean(before):
            course.step("the nominal robot is returned: it predicts held-out recordings as well")
            return _nominal(search)
    robot = model.reduced(x, kept)
    robot = robot.replace(trained=trained_range(robot, system, motions))
    result = _result(search, robot, (x, kept), posterior)
    held_out = {it.name: _places(it) and error for it, error in zip(data, errors, strict=True)}
    result = dataclasses.replace(result, held_out_error=held_out)
    course.result = result
    course.begin(STAGES[-1])
    undecided = tuple(result.undecided)
    return dataclasses.replace(
        result,
        next_experiment=next_experiment(search, posterior, x, undecided) if undecided else None,
        ensemble=sampled(search, (x, kept), posterior, selection.held_out, robot.trained),
    )


def _averaged(
    search: Search, selection: Selection, posterior: Posterior
) -> tuple[np.ndarray, tuple[str, ...], Posterior]:
    """Return the mean coordinates over all sets of effects, the probable effects, and their distribution.

    If the robot with them is further from the data than the selected effects, it is those and about them.
    """
    model, point = search.misfit.model, selection.point
    kept = posterior.names(1.0 - SURE)
    x = np.where(model.mask(kept), posterior.mean, 0.0)
    if set(kept) != set(selection.names):
        rollouts = search.solved(x)
        if rollouts is None or np.mean(np.log(search.scales_of(rollouts) / point.scale)) > WORSE:
            x = np.where(point.free, point.x, 0.0)
            return x, selection.names, posterior.about(x)
    return x, kept, posterior


def _nominal(search: Search) -> Identified:
    errors = _errors_by_name(search, np.zeros(search.misfit.model.size))
    return Identified(search.misfit.model.nominal, nominal_error=errors, error=errors)


# errors of the tip


def _places(data: Experiment) -> Callable[[np.ndarray], np.ndarray] | None:
    """Return a function from numbers in rows to positions (rows, M, d); None if the data have none."""
    output = data.output
    if isinstance(output, States):
        fields = [name for name, _ in output.y_names]
        if "p" not in fields:
            return None
        sizes = [size for _, size in output.y_names]
        first = sum(sizes[: fields.index("p")])
        count, size = sum(sizes), sizes[fields.index("p")]
        return lambda rows: rows[:, : output.nodes * count].reshape(len(rows), output.nodes, count)[
            ..., first : first + size
        ]
    poses = output.outputs[0] if isinstance(output, Several) else output
    bodies = len(getattr(poses, "fractions", ()))
    if not bodies or not poses.labels[0].startswith("position"):
        return None
    last = 6 * bodies if hasattr(poses, "sigma_rotation") else data.data.shape[1]
    return lambda rows: rows[:, :last].reshape(len(rows), bodies, -1)[..., :3]


def _positions(rollout: Rollout, data: Experiment) -> np.ndarray:
    places = _places(data)
    assert places is not None
    return places(rollout.values * data.noise)


def _errors(
    search: Search, x: np.ndarray, which: Sequence[int] | None = None, tip: bool = True,
    rows: int | None = None,
) -> list[float | None]:  # fmt: skip
    """Return the root mean square error of the last body's position (m), by experiment.

    Without positions it is None if `tip`, or else that of all differences. It is that after some `rows` in
    motion, or in all.
    """
    chosen = [search.misfit.data[k] for k in (range(len(search.misfit.data)) if which is None else which)]
    errors: list[float | None] = []
    for data, rollout in zip(chosen, search.misfit.whole(x, which), strict=True):
        seen = _places(data) is not None
        if rollout is None or (tip and not seen):
            errors.append(None)
            continue
        squares = np.sum(_positions(rollout, data)[:, -1] ** 2, axis=-1) if seen else rollout.values**2
        squares = squares[0 if rows is None else data.moves + rows + 1 :]
        errors.append(float(np.sqrt(np.nanmean(squares))) if np.isfinite(squares).any() else None)
    return errors


def _errors_by_name(search: Search, x: np.ndarray) -> dict[str, float | None]:
    return dict(zip((data.name for data in search.misfit.data), _errors(search, x), strict=True))


def _result(
    search: Search, robot: System, at: tuple[np.ndarray, Sequence[str]], posterior: Posterior
) -> Identified:
    """Return the result with an identified robot, `at` coordinates of some effects."""
    (x, names), estimates = at, estimates_of(posterior, *at)
    possible = {
        name: share for name, share in posterior.probability.items() if name in names or share >= 1.0 - SURE
    }
    return Identified(
        robot=robot,
        effects=tuple(name for name, share in possible.items() if share >= SURE),
        undecided={name: share for name, share in possible.items() if share < SURE},
        estimates=estimates,
        correlation=posterior.correlation([it.label for it in estimates]),
        nominal_error=_errors_by_name(search, np.zeros(len(x))),
        error=_errors_by_name(search, x),
        unexplained=unexplained(search, x),
    )
