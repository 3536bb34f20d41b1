"""Numbers that data do not determine, and fields whose remaining differences are not noise."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from knode_cosserat.identification.effects import Effect
from knode_cosserat.identification.search import Point, Search

#: a combination of numbers is undetermined if its relative effect is below this
FLAT = 3e-7
#: a positive number is undetermined if the standard error of its logarithm is above this, and any other one
#: if its standard error is above its size
VAGUE, POOR = 1.0, 1.0
#: lags in rows, and the correlation above which a remainder is not noise
LAGS, ALIKE = range(3, 11), 0.3
#: scales below so many times the solver's errors are not examined
NEAR = 10.0
#: a number belongs to a combination if its share is above this part of the largest share
PART = 0.1


class Gap(NamedTuple):
    """Parameters that the data do not determine together, and the reason in words."""

    names: tuple[str, ...]
    reason: str


def gap_of(search: Search, point: Point, at_end: bool) -> Gap | None:
    """Return parameters with flat priors that the data do not determine, if any.

    At the start only those without an effect, and combinations: there a symmetry that hides a parameter is
    exact, and noise breaks it later.
    """
    model, free = search.misfit.model, point.free & (search.prior == 0.0)
    if not free.any():
        return None
    names = np.array([effect.name for effect in model.effects for _ in effect.numbers])[free]
    matrix = point.problem.matrix.sum(axis=0)[np.ix_(free, free)]
    lengths = np.sqrt(np.diag(matrix))
    if np.any(lengths == 0.0):
        idle = tuple(dict.fromkeys(names[lengths == 0.0].tolist()))
        verb = "has" if len(idle) == 1 else "have"
        return Gap(idle, f"{', '.join(idle)} {verb} no effect on these data")
    scaled = matrix / np.outer(lengths, lengths)
    squares, directions = np.linalg.eigh(scaled)
    if squares[0] < FLAT**2 * squares[-1]:
        return _together(names, np.abs(directions[:, 0]))
    if not at_end:
        return None
    covariance = np.linalg.inv(scaled) / np.outer(lengths, lengths)
    errors, largest = np.sqrt(np.diag(covariance)), _largest(model.effects, point.x)[free]
    beyond = errors / largest
    k = int(np.argmax(beyond))
    if beyond[k] <= 1.0:
        return None
    return _together(names, np.abs(covariance[k] / errors / errors[k]) ** 20)


def _largest(effects: tuple[Effect, ...], x: np.ndarray) -> np.ndarray:
    """Return the largest accepted standard error of every coordinate."""
    found, first = [], 0
    for effect in effects:
        numbers = effect.numbers
        values = [float(number.value(at)) for number, at in zip(numbers, x[first:], strict=False)]
        size = max(abs(it) for it in [*values, *(number.nominal for number in numbers)])
        size = size or numbers[0].high - numbers[0].low
        found += [VAGUE if number.logarithmic else POOR * size / number.width for number in numbers]
        first += len(numbers)
    return np.array(found)


def _together(names: np.ndarray, parts: np.ndarray) -> Gap:
    involved = tuple(dict.fromkeys(names[parts > PART * parts.max()].tolist()))
    if len(involved) == 1:
        return Gap(involved, f"these data do not determine {involved[0]}")
    listed = f"{', '.join(involved[:-1])} and {involved[-1]}"
    return Gap(involved[-1:], f"these data determine only a combination of {listed}")


def unexplained(search: Search, point: Point) -> tuple[str, ...]:
    """Return the fields whose remaining differences are not noise: rows are correlated at large lags."""
    found: dict[str, None] = {}
    rollouts = search.misfit.differences(point.x)
    for k, (data, rollout) in enumerate(zip(search.misfit.data, rollouts, strict=True)):
        if rollout is None or data.static:
            continue
        values = rollout.values[1:]
        known = np.isfinite(values)
        values = np.where(known, values, 0.0)
        for field, name in enumerate(data.fields):
            rows, least = values[:, data.groups == field], search.least[k][field]
            if point.scale[k, field] <= NEAR * least:
                continue
            for lag in LAGS:
                one, other = rows[:-lag], rows[lag:]
                size = np.sum(one**2 + other**2) / 2.0
                count = max(int(np.sum(known[lag:, data.groups == field])), 1)
                if np.abs(np.sum(one * other)) > max(ALIKE, 5.0 / np.sqrt(count)) * size:
                    several = len(search.misfit.data) > 1 and data.readings
                    found[f"{name} in {data.name}" if several else name] = None
                    break
    return tuple(found)
