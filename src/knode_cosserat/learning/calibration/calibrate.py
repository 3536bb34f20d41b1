"""The physical parameters themselves, found from trajectories, with intervals that say how well."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from knode_cosserat.learning.calibration import search
from knode_cosserat.learning.calibration.misfit import SegmentMisfit, by_group
from knode_cosserat.learning.calibration.noise import Errors, errors_of, hidden_by_rounding
from knode_cosserat.learning.calibration.rollouts import RolloutMisfit
from knode_cosserat.learning.calibration.search import CalibrationError as CalibrationError
from knode_cosserat.learning.calibration.search import Fit, Misfit
from knode_cosserat.learning.calibration.unknowns import (
    Unknowns,
    found,
    labels,
    limits,
    logarithmic,
    owner_of,
    searched,
    units,
    unknowns_of,
    values,
    with_numbers,
)
from knode_cosserat.learning.samples import DataError
from knode_cosserat.recordings.measurements import Measurements
from knode_cosserat.rods.system import System
from knode_cosserat.solvers.space import SpaceScheme
from knode_cosserat.trajectory import Trajectory

#: noise may move an estimate by this part of it, on average, and be corrected for
MOST_SHIFT = 0.3
#: how often the search is made again with the past between nodes that the robot has which it found
MOST_ROUNDS = 8


@dataclasses.dataclass(frozen=True)
class Calibration:
    """Parameters that were found from trajectories; `print` shows them as a table.

    What is by parameter is a float, or an array for what has several numbers: the components of a vector, the
    diagonal of a matrix. A matrix that is a multiple of the identity counts as one number.
    """

    #: the robot with the estimates
    robot: System
    #: by parameter: the value before, the estimate, its standard error, and (low, high) of its interval
    before: Mapping[str, Any]
    estimates: Mapping[str, Any]
    standard_errors: Mapping[str, Any]
    intervals: Mapping[str, Any]
    #: how probable it is that an interval holds the truth, if what is left is noise
    level: float
    #: the numbers in the order of `correlation`, and their units
    labels: tuple[str, ...]
    units: tuple[str, ...]
    #: correlation of the numbers' errors
    correlation: Float[np.ndarray, "n n"]
    #: parameters that were left as they were, because the data do not determine them
    undetermined: tuple[str, ...]
    #: root mean square of what is left between prediction and data, by field
    remainder: Mapping[str, float]
    #: fields in which that is not noise: another parameter is wrong, or the equations miss something
    unexplained: tuple[str, ...]

    def __str__(self) -> str:
        def numbers(by_parameter: Mapping[str, Any]) -> list[Any]:
            return [number for value in by_parameter.values() for number in np.atleast_1d(value)]

        ends = np.concatenate([np.reshape(pair, (-1, 2)) for pair in self.intervals.values()])
        rows = [("parameter", "unit", "before", "estimate", f"{100 * self.level:g} % interval")]
        columns = map(numbers, (self.before, self.estimates, self.standard_errors))
        for label, unit, before, estimate, error, pair in zip(
            self.labels, self.units, *columns, ends, strict=True
        ):
            low, middle, high = (_as_precise_as(value, error) for value in (pair[0], estimate, pair[1]))
            rows.append((label, unit, f"{before:.6g}", middle, f"{low} to {high}"))
        widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
        lines = ["  ".join(map(str.ljust, row, widths)).rstrip() for row in rows]
        lines.insert(1, "  ".join("-" * width for width in widths))
        if self.undetermined:
            lines.append(f"left as before, not determined by these data: {', '.join(self.undetermined)}")
        if self.unexplained:
            lines.append(
                f"not explained: what is left in {', '.join(self.unexplained)} is not noise, so that the "
                "intervals do not hold: another parameter is wrong, or the equations miss something"
            )
        return "\n".join(lines)


def calibrate(
    robot: System,
    trajectories: Sequence[Trajectory] | Sequence[Measurements],
    names: Sequence[str] | None = None,
    *,
    by: Literal["segments", "rollouts"] = "segments",
    undetermined: Literal["stop", "keep"] | None = None,
    level: float = 0.95,
    space: str | SpaceScheme = "lobatto2",
) -> Calibration:
    """Find physical parameters of a robot from trajectories, by least squares.

    Args:
        robot: where the search begins; what is not named stays as it is.
        trajectories: what the real robot did; or measurements from rest on (`Recording.sampled`), which only
            "rollouts" can use.
        names: parameters by name (`System.parameters`); by default all that have a value and that the data
            determine.
        by: "segments" compares one-segment predictions from the states in the data, all of which must be
            known. It takes a fraction of a second and finds its way from far off. Noise in the states enters
            its predictions too; what that does to the estimates is taken away, to leading order in its
            variance. Between nodes, where a trajectory has no rows, the history is that of the robot that is
            found, in a few rounds. "rollouts" compares whole simulations with positions and
            orientations, and needs nothing else of trajectories that begin at rest. Its search begins where
            segments lead, if they do.
        undetermined: what to do about a parameter that the data do not determine: "stop" with an error, or
            "keep" it as it was, which `Calibration.undetermined` says. None: stop if it was named.
        level: how probable it is that an interval holds the truth.
        space: the scheme in arclength by which measurements are simulated, as in `simulate`: what is found is
            a robot for that scheme. Trajectories bring their own.

    Returns:
        The estimates, their intervals and the robot that has them. Intervals take what is left for white
        noise; `unexplained` names the fields where it is not.

    Raises:
        CalibrationError: the data do not determine a named parameter, or the search does not converge.
        ParameterError: a name that does not exist, or a parameter that cannot be calibrated.
        DataError: trajectories that do not fit the robot, or are too short or not finite.
        ValueError: a scheme that does not exist.
    """
    _check(robot, trajectories, by, level)
    if undetermined not in (None, "stop", "keep"):
        raise CalibrationError(f'undetermined is {undetermined!r}; allowed is "stop", "keep" or None')
    may_leave_out = names is None if undetermined is None else undetermined == "keep"
    unknowns = unknowns_of(robot, names)
    misfit, start = _misfit(robot, trajectories, unknowns, by, space)
    ended, errors = _ended(misfit, start, may_leave_out)
    if isinstance(misfit, SegmentMisfit):
        misfit, ended, errors = _with_its_own_past(misfit, ended, errors, may_leave_out)
    return _calibration(misfit, ended, errors, level)


def _misfit(
    robot: System, given: Any, unknowns: Unknowns, by: str, space: str | SpaceScheme
) -> tuple[Misfit, np.ndarray]:
    """What is to become small, and where the search begins."""
    start = searched(unknowns, values(robot, unknowns))
    if by == "segments":
        return SegmentMisfit(robot, given, unknowns), start
    if any(isinstance(each, Measurements) for each in given):
        return RolloutMisfit(robot, given, unknowns, near=True, space=space), start
    near = _by_segments(robot, given, unknowns)
    return RolloutMisfit(robot, given, unknowns, near is not None), start if near is None else near


def _check(robot: Any, trajectories: Any, by: Any, level: Any) -> None:
    if not isinstance(robot, System) or np.ndim(robot.length):
        raise CalibrationError(f"robot is a {type(robot).__name__}; allowed is one robot")
    if isinstance(trajectories, Trajectory) or not isinstance(trajectories, Sequence):
        raise DataError(f"trajectories is a {type(trajectories).__name__}; allowed is a list of trajectories")
    if by not in ("segments", "rollouts"):
        raise CalibrationError(f'by is {by!r}; allowed is "segments" or "rollouts"')
    measured = [isinstance(each, Measurements) for each in trajectories]
    if any(measured) and by != "rollouts":
        raise DataError('measurements are no states: calibrate(…, by="rollouts") compares poses only')
    if any(measured) and not all(measured):
        raise DataError("trajectories and measurements are mixed; allowed is a list of one kind")
    if isinstance(level, bool) or not isinstance(level, int | float) or not 0.0 < level < 1.0:
        raise CalibrationError(f"level is {level!r}; allowed is a number between 0 and 1")
    if not owner_of(robot).parameters():
        raise CalibrationError(f"{type(owner_of(robot)).__name__} has no parameters")


def _by_segments(robot: System, trajectories: Sequence[Trajectory], unknowns: Unknowns) -> np.ndarray | None:
    """Where segments lead, if they lead anywhere and all that they need was measured."""
    try:
        misfit = SegmentMisfit(robot, trajectories, unknowns)
        return search.fit(misfit, searched(unknowns, values(robot, unknowns)), may_leave_out=True).coordinates
    except (CalibrationError, DataError):
        return None


def _ended(misfit: Misfit, start: np.ndarray, may_leave_out: bool) -> tuple[Fit, Errors]:
    """Where the search ends, and with which errors: little enough for the estimates to mean something."""
    left_out: tuple[str, ...] = ()
    while True:
        ended = search.fit(misfit, start, may_leave_out, left_out)
        hidden = hidden_by_rounding(misfit, ended) & ended.free
        if may_leave_out and np.any(hidden):
            left_out = (*ended.left_out, search.labels_of(misfit.unknowns)[int(np.argmax(hidden))])
            continue
        errors = errors_of(misfit, ended)
        numbers = np.abs(found(misfit.unknowns, ended.coordinates))
        size = np.where(logarithmic(misfit.unknowns), 1.0, numbers)[ended.free]
        beyond = np.abs(errors.shift) / np.maximum(MOST_SHIFT * size, 3.0 * errors.standard)
        worst = np.flatnonzero(ended.free)[np.argmax(beyond)]
        if np.max(beyond) <= 1.0:
            return ended, errors
        if not may_leave_out:
            raise CalibrationError(
                f"noise in these states hides {labels(misfit.unknowns)[worst]} from one-segment predictions; "
                'use by="rollouts", or leave it out of names'
            )
        left_out = (*ended.left_out, search.labels_of(misfit.unknowns)[worst])


def _with_its_own_past(
    misfit: SegmentMisfit, ended: Fit, errors: Errors, may_leave_out: bool
) -> tuple[SegmentMisfit, Fit, Errors]:
    """The search again, as the robot it ended with has the past between nodes, while that explains more."""
    for _ in range(MOST_ROUNDS):
        numbers = found(misfit.unknowns, ended.coordinates)
        again = misfit.looking_back_on(with_numbers(misfit.robot, misfit.unknowns, numbers))
        if again is None:
            break
        try:
            after, of_after = _ended(again, ended.coordinates, may_leave_out)
        except CalibrationError:
            break
        if search.remainder(after) >= search.remainder(ended):
            break
        misfit, ended, errors = again, after, of_after
    return misfit, ended, errors


def _calibration(misfit: Misfit, ended: Fit, errors: Errors, level: float) -> Calibration:
    # imported here: it takes a third of a second
    from scipy.special import stdtrit

    robot, unknowns, free = misfit.robot, misfit.unknowns, ended.free
    kept = tuple(unknown for unknown in unknowns if unknown.name not in ended.left_out)
    low, high = limits(robot, kept)
    coordinates, left = ended.coordinates[free] - errors.shift, misfit(ended.coordinates).values
    numbers = np.clip(found(kept, coordinates), low, high)
    reach = stdtrit(len(left) - len(numbers), 0.5 + level / 2.0) * errors.standard
    ends = np.column_stack([np.clip(found(kept, coordinates + side * reach), low, high) for side in (-1, 1)])
    sizes = np.sqrt(by_group(np.square(left), misfit.groups))
    return Calibration(
        robot=with_numbers(robot, kept, numbers),
        before=_by_parameter(kept, values(robot, kept)),
        estimates=_by_parameter(kept, numbers),
        standard_errors=_by_parameter(kept, np.where(logarithmic(kept), numbers, 1.0) * errors.standard),
        intervals=_by_parameter(kept, ends),
        level=float(level),
        labels=labels(kept),
        units=units(robot, kept),
        correlation=errors.covariance / np.outer(errors.standard, errors.standard),
        undetermined=ended.left_out,
        remainder=dict(zip(misfit.fields, sizes.tolist(), strict=True)),
        unexplained=search.systematic(misfit, ended),
    )


def _by_parameter(unknowns: Unknowns, numbers: np.ndarray) -> dict[str, Any]:
    """Numbers (n,), or pairs of them (n, 2), by parameter."""
    result, first = {}, 0
    for unknown in unknowns:
        own = numbers[first : first + unknown.size]
        single = own[0] if own.ndim == 2 else float(own[0])
        result[unknown.name] = single if unknown.kind in ("number", "multiple") else own
        first += unknown.size
    return result


def _as_precise_as(value: float, error: float) -> str:
    """A number to two digits of its error, at most twelve."""
    if not 0.0 < error < np.inf or value == 0.0:
        return f"{value:.6g}"
    digits = int(np.floor(np.log10(abs(value)))) - int(np.floor(np.log10(error))) + 2
    return f"{value:.{min(12, max(2, digits))}g}"
