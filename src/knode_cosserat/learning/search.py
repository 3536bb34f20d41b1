"""The search for parameters by least squares: weights, convergence, and what the data do not determine."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from knode_cosserat.learning.misfit import SegmentMisfit, by_group
from knode_cosserat.learning.rollouts import RolloutMisfit
from knode_cosserat.learning.unknowns import Unknowns, found, labels, limits, logarithmic, searched

Misfit = SegmentMisfit | RolloutMisfit

#: how often the weights of the fields are set anew
PASSES = 5
#: evaluations of one search
MOST_EVALUATIONS = 100
#: a combination of parameters is not determined if it does less than this part of what each does alone
FLAT = 1e-8
#: nor is a positive parameter if the standard error of its logarithm is above this
VAGUE = 1.0
#: rows apart, beyond the memory of every scheme in time, and the correlation there that noise does not have
LAG = 3
ALIKE = 0.3
#: what takes part in a combination: more than this part of what takes part most
PART = 0.1


class CalibrationError(ValueError):
    """The parameters cannot be found; one line says which and why."""


class Fit(NamedTuple):
    """Where the search ended."""

    coordinates: Float[np.ndarray, " n"]
    #: which of the coordinates were searched
    free: np.ndarray
    #: parameters that were not, because the data do not determine them
    left_out: tuple[str, ...]
    #: sizes of the differences by field, never less than what the solver's tolerance makes of them
    sizes: Float[np.ndarray, " G"]
    #: which of them are that little
    exact: np.ndarray

    def weights(self, misfit: Misfit) -> Float[np.ndarray, " M"]:
        """One over the size of each difference; zero where a field tells nothing."""
        return _inverse(self.sizes)[misfit.groups]


class Gap(NamedTuple):
    """Parameters that the data do not determine together, and why, in words."""

    names: tuple[str, ...]
    reason: str
    #: whether all of them have to be left out, or one
    every: bool


def fit(misfit: Misfit, start: Float[np.ndarray, " n"], may_leave_out: bool) -> Fit:
    """Search from a start, with weights that follow from the differences that are left.

    Raises:
        CalibrationError: no convergence, or something is not determined that may not be left out.
    """
    unknowns = misfit.unknowns
    left_out: tuple[str, ...] = ()
    while True:
        free = np.array([name not in left_out for name in labels_of(unknowns)])
        if not free.any():
            raise CalibrationError(f"these data determine none of {', '.join(left_out)}")
        # a symmetry that hides something is exact where the search begins, and not quite where noise leads it
        gap = _gap(misfit, Fit(start, free, (), misfit.first_sizes(), np.zeros(0)), vague=False)
        if gap is None:
            converged, ended = _search(misfit, start, free)
            gap = _gap(misfit, ended)
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
    """The parameter that each number belongs to."""
    return tuple(unknown.name for unknown in unknowns for _ in range(unknown.size))


def _search(misfit: Misfit, start: np.ndarray, free: np.ndarray) -> tuple[bool, Fit]:
    """Searches one after the other, each with the sizes of what the last one left as weights."""
    sizes, least = misfit.first_sizes(), np.zeros(len(misfit.fields))
    coordinates, converged, left = start, True, sizes
    for _ in range(PASSES):
        converged, coordinates = _least_squares(misfit, coordinates, free, sizes)
        least = misfit.least_sizes(coordinates)
        left = np.sqrt(by_group(np.square(misfit(coordinates).values), misfit.groups))
        before, sizes = sizes, np.maximum(left, least)
        if not converged or np.all(np.abs(sizes - before) <= 0.02 * before):
            break
    return converged, Fit(coordinates, free, (), sizes, left <= least)


def _least_squares(
    misfit: Misfit, start: np.ndarray, free: np.ndarray, sizes: np.ndarray
) -> tuple[bool, np.ndarray]:
    """Whether the search converged, and where it ended."""
    # imported here: it takes a third of a second
    from scipy.optimize import least_squares

    weights = _inverse(sizes)[misfit.groups]
    low, high = (searched(misfit.unknowns, end)[free] for end in limits(misfit.robot, misfit.unknowns))
    last: dict[bytes, np.ndarray] = {}

    def whole(x: np.ndarray) -> np.ndarray:
        full = start.copy()
        full[free] = x
        return full

    def reduced(x: np.ndarray) -> np.ndarray:
        """Slopes and values, of thousands of rows, turned into as many rows as columns: the same squares."""
        if x.tobytes() not in last:
            values, slopes = misfit(whole(x))
            columns = np.column_stack([slopes[:, free], values]) * weights[:, None]
            last.clear()
            triangle: Any = np.full((len(x) + 1, len(x) + 1), np.inf)
            if np.all(np.isfinite(columns)):
                triangle = np.linalg.qr(columns, mode="r")
            last[x.tobytes()] = triangle
        return last[x.tobytes()]

    begin = np.clip(start[free], low, high)
    if not np.all(np.isfinite(reduced(begin))):
        raise CalibrationError("the robot that the search begins from has no solution under these controls")

    def values(x: np.ndarray) -> np.ndarray:
        return reduced(x)[:, -1]

    def slopes(x: np.ndarray) -> np.ndarray:
        return reduced(x)[:, :-1]

    ended = least_squares(
        values, begin, slopes, (low, high), x_scale="jac", ftol=1e-15, xtol=1e-12, gtol=1e-15,
        max_nfev=MOST_EVALUATIONS,
    )  # fmt: skip
    return ended.status > 0, whole(ended.x)


def _gap(misfit: Misfit, ended: Fit, vague: bool = True) -> Gap | None:
    """What the data do not determine, if anything; `vague`: nor well enough."""
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
    if not vague:
        return None
    covariance = (directions.T / parts**2) @ directions / np.outer(lengths, lengths)
    errors = np.sqrt(np.diag(covariance))
    low, high = limits(misfit.robot, unknowns)
    too_much = np.where(logarithmic(unknowns), VAGUE, (high - low) / 2)[free]
    if np.all(errors < too_much):
        return None
    worst = int(np.argmax(errors / too_much))
    return _together(names, np.abs(covariance[worst] / errors / errors[worst]) ** 20)


def _together(names: np.ndarray, parts: np.ndarray) -> Gap:
    involved = tuple(dict.fromkeys(names[parts > PART * parts.max()].tolist()))
    if len(involved) == 1:
        return Gap(involved, f"these data do not determine {involved[0]}", every=True)
    listed = f"{', '.join(involved[:-1])} and {involved[-1]}"
    return Gap(involved, f"these data determine only a combination of {listed}", every=False)


def _check_range(misfit: Misfit, ended: Fit) -> None:
    """Raise if a number ended where its allowed range does; zero is a value like others."""
    unknowns = misfit.unknowns
    low, high = limits(misfit.robot, unknowns)
    values = found(unknowns, ended.coordinates)
    for k, label in enumerate(labels(unknowns)):
        end = high[k] if high[k] - values[k] < values[k] - low[k] else low[k]
        if ended.free[k] and end != 0.0 and abs(values[k] - end) <= 1e-6 * abs(end):
            raise CalibrationError(
                f"{label} ran to the end of its allowed range, {end:g}: the data ask for more"
            )


def _inverse(sizes: np.ndarray) -> np.ndarray:
    return np.where(sizes > 0.0, 1.0 / np.where(sizes > 0.0, sizes, 1.0), 0.0)


def systematic(misfit: Misfit, ended: Fit) -> tuple[str, ...]:
    """Fields in which what is left is not noise: it is alike three rows apart, beyond any scheme's memory."""
    left = misfit(ended.coordinates).values
    alike, size, count = np.zeros((3, len(misfit.fields)))
    for fields, rows in misfit.blocks(left):
        one, other = rows[:-LAG], rows[LAG:]
        alike += np.bincount(fields, np.sum(one * other, axis=0), len(alike))
        size += np.bincount(fields, np.sum(one**2 + other**2, axis=0) / 2, len(size))
        count += np.bincount(fields, minlength=len(count)) * len(one)
    enough = np.maximum(ALIKE, 4.0 / np.sqrt(np.maximum(count, 1.0)))
    which = ~ended.exact & (alike > enough * size)
    return tuple(field for field, one in zip(misfit.fields, which, strict=True) if one)
