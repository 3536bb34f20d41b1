"""Calibration of physical parameters from trajectories, with confidence intervals."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from knode_cosserat._reprs import robot_text, wrapped
from knode_cosserat.learning.calibration import search
from knode_cosserat.learning.calibration.misfit import SegmentMisfit, by_group
from knode_cosserat.learning.calibration.noise import CoordinateErrors, errors_of, hidden_by_rounding
from knode_cosserat.learning.calibration.rollouts import RolloutMisfit
from knode_cosserat.learning.calibration.search import CalibrationError as CalibrationError
from knode_cosserat.learning.calibration.search import Misfit, SearchResult
from knode_cosserat.learning.calibration.unknowns import (
    Unknowns,
    limits,
    logarithmic,
    number_names,
    number_units,
    searched,
    searched_numbers,
    unknowns_of,
    values,
    with_numbers,
)
from knode_cosserat.recordings.measurements import Measurements
from knode_cosserat.rods.system import System
from knode_cosserat.solvers.segments import DataError
from knode_cosserat.solvers.space import SpaceScheme
from knode_cosserat.trajectory import Trajectory

#: largest relative bias of an estimate by noise that is corrected
MOST_SHIFT = 0.3
#: largest number of repeated searches with the history between nodes from the calibrated robot
MOST_ROUNDS = 8


@dataclasses.dataclass(frozen=True)
class Calibration:
    """Result of a calibration; `print` shows it as a table.

    Values by parameter are floats, or arrays for parameters with several numbers: the components of a vector,
    the diagonal of a matrix. A matrix that is a multiple of the identity counts as one number.
    """

    #: the robot with the estimates
    robot: System
    #: by parameter: the value before, the estimate, its standard error, and (low, high) of its interval
    before: Mapping[str, Any]
    estimates: Mapping[str, Any]
    standard_errors: Mapping[str, Any]
    intervals: Mapping[str, Any]
    #: confidence level of the intervals, if the remainder is noise
    level: float
    #: names of the numbers in the order of `correlation`, and their units
    labels: tuple[str, ...]
    units: tuple[str, ...]
    #: correlation of the numbers' errors
    correlation: Float[np.ndarray, "n n"]
    #: parameters that were not changed, because the data do not determine them
    undetermined: tuple[str, ...]
    #: root mean square of the remaining differences between prediction and data, by field
    remainder: Mapping[str, float]
    #: fields whose remainder is not noise: another parameter is wrong, or the equations lack an effect
    unexplained: tuple[str, ...]

    def __repr__(self) -> str:
        ends = np.concatenate([np.reshape(pair, (-1, 2)) for pair in self.intervals.values()])
        values = [number for value in self.estimates.values() for number in np.atleast_1d(value)]
        found = [
            f"{label} = {value:.6g} {unit}".rstrip() + f" ({low:.6g} to {high:.6g})"
            for label, unit, value, (low, high) in zip(self.labels, self.units, values, ends, strict=True)
        ]
        return wrapped(
            f"Calibration of a {robot_text(self.robot)}, with {100 * self.level:g} % intervals: "
            + ("; ".join(found) or "nothing")
        )

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
        robot: initial robot of the search; parameters that are not named stay unchanged.
        trajectories: full states of the real robot; or measurements that start at rest, in the equilibrium
            under their `initial_tension` or else under the first tension (`Recording.sampled`), which only
            "rollouts" can use.
        names: parameters by name (`System.parameters`), those of parts with dots, such as `loads.0.mass`; by
            default all of the robot's own that have a value and that the data determine.
        by: "segments" compares one-segment predictions from the full states in the data. It takes a fraction
            of a second and converges from a distant start. Noise in the states also enters the predictions;
            the resulting bias is corrected to leading order in the variance. The history between nodes is
            evaluated by the calibrated robot, in a few rounds. "rollouts" compares whole simulations with
            positions and orientations, and needs no other data of trajectories that start at rest. Its search
            starts at the result of "segments", if there is one.
        undetermined: action for a parameter that the data do not determine: "stop" with an error, or "keep"
            its value, listed in `Calibration.undetermined`. None: stop if `names` was given, else keep.
        level: confidence level of the intervals.
        space: scheme in arclength for the simulation of measurements, as in `simulate`; the calibrated robot
            is for that scheme. Trajectories have their own scheme.

    Returns:
        The estimates, their intervals and the calibrated robot. Intervals assume that the remainder is white
        noise; `unexplained` names the fields where it is not.

    Raises:
        CalibrationError: the data do not determine a named parameter, or the search does not converge.
        ParameterError: a name that does not exist, or a parameter that cannot be calibrated.
        DataError: trajectories that do not fit the robot, are too short or not finite, or do not start at
            rest although "rollouts" needs it.
        ValueError: a scheme that does not exist.
    """
    _check(robot, trajectories, by, level)
    if undetermined not in (None, "stop", "keep"):
        raise CalibrationError(f'undetermined is {undetermined!r}; allowed is "stop", "keep" or None')
    may_leave_out = names is None if undetermined is None else undetermined == "keep"
    unknowns = unknowns_of(robot, names)
    misfit, start = _misfit(robot, trajectories, unknowns, by, space)
    if isinstance(misfit, SegmentMisfit):
        ended, errors = _ended(misfit, start, may_leave_out)
        misfit, ended, errors = _with_its_own_past(misfit, ended, errors, may_leave_out)
    else:
        try:
            ended, errors = _ended(misfit, start, may_leave_out)
        except CalibrationError:
            misfit.require_start(start)
            raise
        misfit.require_start(ended.coordinates)
    return _calibration(misfit, ended, errors, level)


def _misfit(
    robot: System, given: Any, unknowns: Unknowns, by: str, space: str | SpaceScheme
) -> tuple[Misfit, np.ndarray]:
    """Return the misfit to be minimised, and the initial coordinates of the search."""
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
        raise DataError(
            'calibrate needs full states (got Measurements); use calibrate(…, by="rollouts"), identify, '
            "or estimate_states first"
        )
    if any(measured) and not all(measured):
        raise DataError("trajectories and measurements are mixed; allowed is a list of one kind")
    if isinstance(level, bool) or not isinstance(level, int | float) or not 0.0 < level < 1.0:
        raise CalibrationError(f"level is {level!r}; allowed is a number between 0 and 1")
    if not robot.nominal.parameters():
        raise CalibrationError(f"{type(robot.nominal).__name__} has no parameters")


def _by_segments(robot: System, trajectories: Sequence[Trajectory], unknowns: Unknowns) -> np.ndarray | None:
    """Return the coordinates from a calibration by segments; None if it fails or the data do not suffice."""
    try:
        misfit = SegmentMisfit(robot, trajectories, unknowns)
        return search.search_coordinates(
            misfit, searched(unknowns, values(robot, unknowns)), may_leave_out=True
        ).coordinates
    except (CalibrationError, DataError):
        return None


def _ended(misfit: Misfit, start: np.ndarray, may_leave_out: bool) -> tuple[SearchResult, CoordinateErrors]:
    """Return the result of the search and its errors; undetermined parameters are left out or raise."""
    left_out: tuple[str, ...] = ()
    while True:
        ended = search.search_coordinates(misfit, start, may_leave_out, left_out)
        hidden = hidden_by_rounding(misfit, ended) & ended.free
        if may_leave_out and np.any(hidden):
            left_out = (*ended.left_out, search.labels_of(misfit.unknowns)[int(np.argmax(hidden))])
            continue
        errors = errors_of(misfit, ended)
        numbers = np.abs(searched_numbers(misfit.unknowns, ended.coordinates))
        size = np.where(logarithmic(misfit.unknowns), 1.0, numbers)[ended.free]
        beyond = np.abs(errors.shift) / np.maximum(MOST_SHIFT * size, 3.0 * errors.standard)
        worst = np.flatnonzero(ended.free)[np.argmax(beyond)]
        if np.max(beyond) <= 1.0:
            return ended, errors
        if not may_leave_out:
            raise CalibrationError(
                f"noise in these states hides {number_names(misfit.unknowns)[worst]} from one-segment "
                'predictions; use by="rollouts", or leave it out of names'
            )
        left_out = (*ended.left_out, search.labels_of(misfit.unknowns)[worst])


def _with_its_own_past(
    misfit: SegmentMisfit, ended: SearchResult, errors: CoordinateErrors, may_leave_out: bool
) -> tuple[SegmentMisfit, SearchResult, CoordinateErrors]:
    """Repeat the search with the history between nodes from the calibrated robot, while the fit improves."""
    for _ in range(MOST_ROUNDS):
        numbers = searched_numbers(misfit.unknowns, ended.coordinates)
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


def _calibration(misfit: Misfit, ended: SearchResult, errors: CoordinateErrors, level: float) -> Calibration:
    # imported here: it takes a third of a second
    from scipy.special import stdtrit

    robot, unknowns, free = misfit.robot, misfit.unknowns, ended.free
    kept = tuple(unknown for unknown in unknowns if unknown.name not in ended.left_out)
    low, high = limits(robot, kept)
    coordinates, left = ended.coordinates[free] - errors.shift, misfit(ended.coordinates).values
    numbers = np.clip(searched_numbers(kept, coordinates), low, high)
    reach = stdtrit(len(left) - len(numbers), 0.5 + level / 2.0) * errors.standard
    ends = np.column_stack(
        [np.clip(searched_numbers(kept, coordinates + side * reach), low, high) for side in (-1, 1)]
    )
    sizes = np.sqrt(by_group(np.square(left), misfit.groups))
    return Calibration(
        robot=with_numbers(robot, kept, numbers),
        before=_by_parameter(kept, values(robot, kept)),
        estimates=_by_parameter(kept, numbers),
        standard_errors=_by_parameter(kept, np.where(logarithmic(kept), numbers, 1.0) * errors.standard),
        intervals=_by_parameter(kept, ends),
        level=float(level),
        labels=number_names(kept),
        units=number_units(robot, kept),
        correlation=errors.covariance / np.outer(errors.standard, errors.standard),
        undetermined=ended.left_out,
        remainder=dict(zip(misfit.fields, sizes.tolist(), strict=True)),
        unexplained=search.systematic(misfit, ended),
    )


def _by_parameter(unknowns: Unknowns, numbers: np.ndarray) -> dict[str, Any]:
    """Return numbers (n,), or pairs of them (n, 2), by parameter."""
    result, first = {}, 0
    for unknown in unknowns:
        own = numbers[first : first + unknown.size]
        single = own[0] if own.ndim == 2 else float(own[0])
        result[unknown.name] = single if unknown.kind in ("number", "multiple") else own
        first += unknown.size
    return result


def _as_precise_as(value: float, error: float) -> str:
    """Format a number to two digits of its error, with at most twelve digits."""
    if not 0.0 < error < np.inf or value == 0.0:
        return f"{value:.6g}"
    digits = int(np.floor(np.log10(abs(value)))) - int(np.floor(np.log10(error))) + 2
    return f"{value:.{min(12, max(2, digits))}g}"
