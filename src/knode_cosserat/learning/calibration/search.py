"""Least-squares search for parameters: weights, convergence, and undetermined parameters."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from knode_cosserat.errors import KnodeCosseratError
from knode_cosserat.learning.calibration.misfit import SegmentMisfit, by_group
from knode_cosserat.learning.calibration.rollouts import RolloutMisfit
from knode_cosserat.learning.calibration.unknowns import (
    Unknowns,
    limits,
    logarithmic,
    number_names,
    searched,
    searched_numbers,
    values,
)

Misfit = SegmentMisfit | RolloutMisfit

#: largest number of updates of the fields' weights
PASSES = 5
#: relative change of the weights at convergence
SETTLED = 0.02
#: largest number of paths of a search from a distant start, tried if the first remainder is not noise
MOST_WAYS = 3
#: largest number of evaluations of one search
MOST_EVALUATIONS = 100


class SearchTolerances(NamedTuple):
    """Stopping tolerances of a search: step, in natural sizes, and relative decrease of the squares."""

    step: float
    fall: float


#: tolerances of the final search, of preliminary ones, and of the final one for a real robot
FINE, ROUGH, PLAIN = (
    SearchTolerances(1e-12, 1e-15),
    SearchTolerances(1e-3, 1e-6),
    SearchTolerances(1e-3, 1e-3),
)
#: a combination of parameters is undetermined if its relative effect is below this
FLAT = 1e-8
#: a positive parameter is undetermined if the standard error of its logarithm is above this
VAGUE = 1.0
#: any other parameter is undetermined if its standard error is above this multiple of its size (before or
#: after); the second limit is for parameters that were not named
HOPELESS, POOR = 10.0, 1.0
#: lags in rows, beyond the memory of BDF2, and the correlation above which a remainder is not noise
LAGS = range(3, 11)
ALIKE = 0.3
#: a parameter belongs to a combination if its share is above this part of the largest share
PART = 0.1


class CalibrationError(KnodeCosseratError, ValueError):
    """Parameters that cannot be found. The message is one line: the parameters and the reason."""

    code = "calibration"


class SearchResult(NamedTuple):
    """Result of a search."""

    coordinates: Float[np.ndarray, " n"]
    #: true for the coordinates that were searched
    free: np.ndarray
    #: parameters that were not searched, because the data do not determine them
    left_out: tuple[str, ...]
    #: sizes of the differences by field, at least those caused by the solver's tolerance
    sizes: Float[np.ndarray, " G"]
    #: true for fields whose size is that lower bound
    exact: np.ndarray

    def weights(self, misfit: Misfit) -> Float[np.ndarray, " M"]:
        """Return one over the size of each difference; zero if the size is zero."""
        return _inverse(self.sizes)[misfit.groups]


class Gap(NamedTuple):
    """Parameters that the data do not determine together, and the reason in words."""

    names: tuple[str, ...]
    reason: str
    #: true if all of them must be left out, false if one suffices
    every: bool


def search_coordinates(
    misfit: Misfit, start: Float[np.ndarray, " n"], may_leave_out: bool, left_out: tuple[str, ...] = ()
) -> SearchResult:
    """Search from a start, with weights from the remaining differences.

    Parameters in `left_out` are not searched; `may_leave_out` allows further ones to be left out.

    Raises:
        CalibrationError: no convergence, or an undetermined parameter that may not be left out.
    """
    unknowns = misfit.unknowns
    while True:
        free = np.array([name not in left_out for name in labels_of(unknowns)])
        if not free.any():
            raise CalibrationError(f"these data determine none of {', '.join(left_out)}")
        # checked at the start: there a symmetry that hides a parameter is exact, later noise breaks it
        gap = _gap(misfit, SearchResult(start, free, (), misfit.first_sizes(), np.zeros(0)), np.inf)
        if gap is None:
            converged, ended = _search(misfit, start, free)
            gap = _gap(misfit, ended, np.inf if not converged else POOR if may_leave_out else HOPELESS)
            if gap is None and converged:
                _check_range(misfit, ended)
                return ended._replace(left_out=left_out)
        if gap is None:
            raise CalibrationError(
                f"the search did not converge in {MOST_EVALUATIONS} evaluations; begin closer to the data"
            )
        if not may_leave_out:
            which = "it" if len(gap.names) == 1 else ", ".join(gap.names) if gap.every else "one of them"
            raise CalibrationError(f"{gap.reason}; leave {which} out of names")
        left_out = (*left_out, *(gap.names if gap.every else gap.names[-1:]))


def labels_of(unknowns: Unknowns) -> tuple[str, ...]:
    """Return the parameter name of each number."""
    return tuple(unknown.name for unknown in unknowns for _ in range(unknown.size))


def _search(misfit: Misfit, start: np.ndarray, free: np.ndarray) -> tuple[bool, SearchResult]:
    """Return the result of the first path that leaves only noise, else the best of all paths.

    With noise the first rows of a rollout may mislead the search, while another number of rows does not.
    """
    beginnings = misfit.beginnings()
    best: tuple[bool, SearchResult] | None = None
    for skipped in range(0, len(beginnings) + 1, max(1, len(beginnings) // MOST_WAYS)):
        converged, ended = _one_way(misfit, start, free, beginnings[skipped:])
        if best is None or (converged, -remainder(ended)) > (best[0], -remainder(best[1])):
            best = converged, ended
        if converged and not systematic(misfit, ended):
            break
    assert best is not None  # the loop has one path at least
    return best


def remainder(ended: SearchResult) -> float:
    """Return the total log size of the remaining differences over all fields; smaller is better."""
    return float(np.sum(np.log(np.maximum(ended.sizes, 1e-300))))


def _one_way(
    misfit: Misfit, start: np.ndarray, free: np.ndarray, beginnings: Any
) -> tuple[bool, SearchResult]:
    """Run searches in sequence, each weighted by the remaining differences of the last one."""
    sizes, least = misfit.first_sizes(), np.zeros(len(misfit.fields))
    coordinates, converged, left = start, True, sizes
    for mask in beginnings:
        _, coordinates = _least_squares(misfit, coordinates, free, sizes, mask, ROUGH)
    rough = isinstance(misfit, RolloutMisfit) and misfit.rough
    last, settled = (PLAIN, 5.0 * SETTLED) if rough else (FINE, SETTLED)
    for _ in range(PASSES):
        converged, coordinates = _least_squares(misfit, coordinates, free, sizes, end=last)
        least = misfit.least_sizes(coordinates)
        left = np.sqrt(by_group(np.square(misfit(coordinates).values), misfit.groups))
        before, sizes = sizes, np.maximum(left, least)
        if not converged or np.all(np.abs(sizes - before) <= settled * before):
            break
    return converged, SearchResult(coordinates, free, (), sizes, left <= least)


def _least_squares(
    misfit: Misfit,
    start: np.ndarray,
    free: np.ndarray,
    sizes: np.ndarray,
    mask: Any = 1.0,
    end: SearchTolerances = FINE,
) -> tuple[bool, np.ndarray]:
    """Run one least-squares search: return a convergence flag and the coordinates."""
    # imported here: it takes a third of a second
    from scipy.optimize import least_squares

    weights = mask * _inverse(sizes)[misfit.groups]
    low, high = (searched(misfit.unknowns, bound)[free] for bound in limits(misfit.robot, misfit.unknowns))
    begin = np.clip(start[free], low, high)
    origin, reach = np.zeros(len(begin)), np.ones(len(begin))
    last: dict[bytes, np.ndarray] = {}

    def whole(x: np.ndarray) -> np.ndarray:
        full = start.copy()
        full[free] = np.clip(origin + x * reach, low, high)
        return full

    def reduced(x: np.ndarray) -> np.ndarray:
        """Return slopes and values reduced to a square matrix by QR, with the same sums of squares."""
        if x.tobytes() not in last:
            there = misfit(whole(x))
            columns = np.column_stack([there.slopes[:, free] * reach, there.values]) * weights[:, None]
            triangle: Any = np.full((len(x) + 1, len(x) + 1), np.inf)
            if np.all(np.isfinite(columns)):
                triangle = np.linalg.qr(columns, mode="r")
            last.clear()
            last[x.tobytes()] = triangle
        return last[x.tobytes()]

    def heights(x: np.ndarray) -> np.ndarray:
        return reduced(x)[:, -1]

    def slopes(x: np.ndarray) -> np.ndarray:
        return reduced(x)[:, :-1]

    first = reduced(begin)
    if not np.all(np.isfinite(first)):
        raise CalibrationError("the robot that the search begins from has no solution under these controls")
    if misfit.cautious:
        # the first step of the search has length one: a factor of e, a number's own size or, if that is zero,
        # its own one-dimensional Gauss-Newton step
        alone = np.linalg.norm(first[:, -1]) * _inverse(np.linalg.norm(first[:, :-1], axis=0))
        own = np.where(begin != 0.0, np.abs(begin), np.where(alone > 0.0, alone, 1.0))
        origin, reach = begin, np.where(logarithmic(misfit.unknowns)[free], 1.0, own)
        last.clear()
    ended = least_squares(
        heights, (begin - origin) / reach, slopes, ((low - origin) / reach, (high - origin) / reach),
        x_scale=1.0 if misfit.cautious else "jac", ftol=end.fall, xtol=end.step,
        gtol=1e-15, max_nfev=MOST_EVALUATIONS,
    )  # fmt: skip
    return ended.status > 0, whole(ended.x)


def _gap(misfit: Misfit, ended: SearchResult, worst: float) -> Gap | None:
    """Return the undetermined parameters, if any; `worst` limits errors relative to the values."""
    unknowns, free = misfit.unknowns, ended.free
    names = np.array(labels_of(unknowns))[free]
    weighted = misfit(ended.coordinates).slopes[:, free] * ended.weights(misfit)[:, None]
    lengths = np.linalg.norm(weighted, axis=0)
    if np.any(lengths == 0.0):
        idle = tuple(dict.fromkeys(names[lengths == 0.0].tolist()))
        verb = "has" if len(idle) == 1 else "have"
        return Gap(idle, f"{', '.join(idle)} {verb} no effect on these data", every=True)
    _, parts, directions = np.linalg.svd(weighted / lengths, full_matrices=False)
    if parts[-1] < FLAT * parts[0]:
        return _together(names, np.abs(directions[-1]))
    if np.isinf(worst):
        return None
    covariance = (directions.T / parts**2) @ directions / np.outer(lengths, lengths)
    errors = np.sqrt(np.diag(covariance))
    too_much = np.where(logarithmic(unknowns), VAGUE, worst * _magnitudes(misfit, ended))[free]
    if np.all(errors <= too_much):
        return None
    k = int(np.argmax(errors / too_much))
    return _together(names, np.abs(covariance[k] / errors / errors[k]) ** 20)


def _magnitudes(misfit: Misfit, ended: SearchResult) -> Float[np.ndarray, " n"]:
    """Return the largest size of each number's parameter, before or after; its range if all are zero."""
    unknowns = misfit.unknowns
    names = np.array(labels_of(unknowns))
    largest = np.maximum(
        np.abs(values(misfit.robot, unknowns)), np.abs(searched_numbers(unknowns, ended.coordinates))
    )
    low, high = limits(misfit.robot, unknowns)
    largest = np.array([np.max(largest[names == name]) for name in names])
    return np.where(largest > 0.0, largest, high - low)


def _together(names: np.ndarray, parts: np.ndarray) -> Gap:
    involved = tuple(dict.fromkeys(names[parts > PART * parts.max()].tolist()))
    if len(involved) == 1:
        return Gap(involved, f"these data do not determine {involved[0]}", every=True)
    listed = f"{', '.join(involved[:-1])} and {involved[-1]}"
    return Gap(involved, f"these data determine only a combination of {listed}", every=False)


def _check_range(misfit: Misfit, ended: SearchResult) -> None:
    """Raise if a number ended at a limit of its allowed range; a limit of zero is accepted."""
    unknowns = misfit.unknowns
    low, high = limits(misfit.robot, unknowns)
    numbers = searched_numbers(unknowns, ended.coordinates)
    for k, label in enumerate(number_names(unknowns)):
        end = high[k] if high[k] - numbers[k] < numbers[k] - low[k] else low[k]
        if ended.free[k] and end != 0.0 and abs(numbers[k] - end) <= 1e-6 * abs(end):
            raise CalibrationError(
                f"{label} ran to the end of its allowed range, {end:g}; leave it out of names"
            )


def _inverse(sizes: np.ndarray) -> np.ndarray:
    return np.where(sizes > 0.0, 1.0 / np.where(sizes > 0.0, sizes, 1.0), 0.0)


def systematic(misfit: Misfit, ended: SearchResult) -> tuple[str, ...]:
    """Return the fields whose remainder is not noise: its rows are correlated at large lags."""
    blocks = misfit.blocks(misfit(ended.coordinates).values)
    which = np.zeros(len(misfit.fields), dtype=bool)
    for lag in LAGS:
        alike, size, count = np.zeros((3, len(misfit.fields)))
        for fields, rows in blocks:
            one, other = rows[:-lag], rows[lag:]
            alike += np.bincount(fields, np.sum(one * other, axis=0), len(alike))
            size += np.bincount(fields, np.sum(one**2 + other**2, axis=0) / 2, len(size))
            count += np.bincount(fields, minlength=len(count)) * len(one)
        which |= np.abs(alike) > np.maximum(ALIKE, 5.0 / np.sqrt(np.maximum(count, 1.0))) * size
    which &= ~ended.exact
    return tuple(field for field, one in zip(misfit.fields, which, strict=True) if one)
