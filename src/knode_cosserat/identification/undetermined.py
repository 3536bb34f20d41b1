"""Numbers that data do not determine, and fields whose remaining differences are not noise."""

from __future__ import annotations

import numpy as np

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


def gap_of(search: Search, point: Point, at_end: bool) -> tuple[tuple[str, ...], str] | None:
    """Return parameters with flat priors that the data do not determine, and the reason in words; None: none.

    At the start these are only parameters without an effect, and combinations: there a symmetry that hides a
    parameter is exact, and noise breaks it later.
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
        return idle, f"{', '.join(idle)} {verb} no effect on these data"
    scaled = matrix / np.outer(lengths, lengths)
    squares, directions = np.linalg.eigh(scaled)
    if squares[0] < FLAT**2 * squares[-1]:
        return _combination(names, np.abs(directions[:, 0]))
    if not at_end:
        return None
    covariance = np.linalg.inv(scaled) / np.outer(lengths, lengths)
    errors, largest = np.sqrt(np.diag(covariance)), []
    for effect in model.effects:
        # the largest accepted standard error of every coordinate
        values = [
            number.value(at)
            for number, at in zip(effect.numbers, point.x[model.slice(effect.name)], strict=True)
        ]
        size = max(abs(it) for it in [*values, *(number.nominal for number in effect.numbers)])
        size = size or effect.numbers[0].high - effect.numbers[0].low
        largest += [VAGUE if it.logarithmic else POOR * size / it.width for it in effect.numbers]
    beyond = errors / np.array(largest)[free]
    k = int(np.argmax(beyond))
    if beyond[k] <= 1.0:
        return None
    return _combination(names, np.abs(covariance[k] / errors / errors[k]) ** 20)


def _combination(names: np.ndarray, parts: np.ndarray) -> tuple[tuple[str, ...], str]:
    involved = tuple(dict.fromkeys(names[parts > PART * parts.max()].tolist()))
    if len(involved) == 1:
        return involved, f"these data do not determine {involved[0]}"
    listed = f"{', '.join(involved[:-1])} and {involved[-1]}"
    return involved[-1:], f"these data determine only a combination of {listed}"


def unexplained(search: Search, x: np.ndarray) -> tuple[str, ...]:
    """Return the fields whose remaining differences are not noise: rows are correlated at large lags."""
    fields: dict[str, None] = {}
    for k, (data, rollout) in enumerate(zip(search.misfit.data, search.misfit.whole(x), strict=True)):
        if rollout is None or data.static:
            continue
        [scale] = search.scales_of([rollout], [k])
        values = rollout.values[1:]
        known = np.isfinite(values)
        values = np.where(known, values, 0.0)
        for field, name in enumerate(data.fields):
            rows, least = values[:, data.groups == field], search.least[k][field]
            if scale[field] <= NEAR * least:
                continue
            for lag in LAGS:
                one, other = rows[:-lag], rows[lag:]
                size = np.sum(one**2 + other**2) / 2.0
                count = max(int(np.sum(known[lag:, data.groups == field])), 1)
                if np.abs(np.sum(one * other)) > max(ALIKE, 5.0 / np.sqrt(count)) * size:
                    several = len(search.misfit.data) > 1 and data.readings
                    fields[f"{name} in {data.name}" if several else name] = None
                    break
    return tuple(fields)
