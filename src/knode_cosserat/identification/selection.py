"""Selection of effects by held-out recordings: cross-validation, smallest model first."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple, Self

import numpy as np
from jaxtyping import Bool, Float

from knode_cosserat.identification.model import Model
from knode_cosserat.identification.search import Point, Problem, Search, SearchError, normal_equations

#: least reduction of the held-out cost by an effect, for each of its parameters
WORTH = 4.0
#: and in standard errors of that reduction
ERRORS = 2.0
#: smallest remaining fraction of the cost in linearised predictions
LEAST_LEFT = 1e-3
#: mean ratio of costs above which few effects are too few
MUCH_MORE = 1.3
#: number of absent effects that are tried in one round
MOST_TRIES = 3
#: corrections of a search without one recording
FOLD = (4, 1e-2)
#: corrections of a search with other effects, and the part by which the cost falls at its end
TRIED = (12, 5e-3)


class Chosen(NamedTuple):
    """Selected effects, the end of their search, and the steps of the selection, in words."""

    names: tuple[str, ...]
    point: Point
    steps: tuple[str, ...]


def held_out(
    problem: Problem, x: Float[np.ndarray, " n"], free: Bool[np.ndarray, " n"], model: Model
) -> float:
    """Return the cost of recordings that were each left out of a search, linearised about a point.

    It is -2 times the logarithm of the likelihood of differences of unknown size, by recording. Parameters
    that are not free are nominal. A single recording is divided into pieces, which are left out in turn.
    """
    total = 0.0
    for k, move in enumerate(_moves(problem, x, free, model)):
        left = problem.cost[k] + 2.0 * problem.gradient[k] @ move + move @ problem.matrix[k] @ move
        total += problem.amount[k] * np.log(max(left, LEAST_LEFT * problem.cost[k]) / problem.amount[k])
    return float(total)


def _moves(
    problem: Problem, x: Float[np.ndarray, " n"], free: Bool[np.ndarray, " n"], model: Model
) -> list[Float[np.ndarray, " n"]]:
    """Return the moves of searches that leave out one part each, linearised about a point."""
    low, high = model.bounds
    count = len(problem.cost)
    found = []
    for k in range(count):
        others = [j for j in range(count) if j != k] or [k]
        gradient, matrix = problem.gradient[others].sum(axis=0), problem.matrix[others].sum(axis=0)
        found.append(_linear(x, free, gradient, matrix, low, high))
    return found


class Left(NamedTuple):
    """Robust costs (m²) of the blocks of parts that were each left out of a search."""

    cost: Float[np.ndarray, "parts blocks"]
    #: independent differences of each part
    amount: Float[np.ndarray, " parts"]

    @classmethod
    def of(cls, point: Point, names: Iterable[str], model: Model) -> Self:
        """Return the remaining differences with the named effects, linearised about the end of a search."""
        free, blocks, count = model.mask(names), point.blocks, len(point.problem.cost)
        each = [part.reshape(count, -1, *part.shape[1:]) for part in blocks]
        scale = np.repeat(point.scale[:, 0], count // len(point.scale)) ** 2
        costs = []
        for k, move in enumerate(_moves(point.problem, point.x, free, model)):
            now, gradient, matrix = each[0][k], each[2][k], each[3][k]
            left = now + 2.0 * gradient @ move + np.einsum("i,bij,j->b", move, matrix, move)
            # linearised equations may predict more than the whole cost
            costs.append(scale[k] * np.maximum(left, LEAST_LEFT * now.sum() / len(now)))
        return cls(np.array(costs), point.problem.amount)

    def worth(self, more: Left) -> tuple[float, float]:
        """Return the reduction of the held-out cost by more effects, and its standard error.

        The cost is -2 times the logarithm of the likelihood of differences of unknown size, by part. The
        error comes from the scatter of the blocks' shares, because model errors are not random.
        """
        without, with_them = self.cost.sum(axis=1), more.cost.sum(axis=1)
        fall = np.log(without / with_them)
        even = np.abs(fall) < 1e-9
        mean = np.where(even, without, (without - with_them) / np.where(even, 1.0, fall))
        shares = self.amount[:, None] * (self.cost - more.cost) / mean[:, None]
        scatter = np.sum((shares - shares.mean(axis=1, keepdims=True)) ** 2)
        return float(shares.sum()), float(np.sqrt(scatter))

    def promise(self, more: Left, count: int) -> float:
        """Return the expected reduction of the cost by more parameters, over the least reduction."""
        worth, error = self.worth(more)
        return worth / max(WORTH * count, ERRORS * error)


def _linear(
    x: np.ndarray, free: np.ndarray, gradient: np.ndarray, matrix: np.ndarray, low: np.ndarray,
    high: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Return the move to the least cost, with the prior, of the free numbers within their bounds."""
    fixed = np.where(free, 0.0, -x)
    active = free.copy()
    for _ in range(len(x)):
        where = np.ix_(active, active)
        right = gradient[active] + (matrix @ fixed)[active] + x[active]
        move = fixed.copy()
        move[active] = -np.linalg.solve(matrix[where] + np.eye(int(active.sum())), right)
        beyond = active & ((x + move < low - 1e-9) | (x + move > high + 1e-9))
        if not beyond.any():
            return move
        fixed = np.where(beyond, np.clip(x + move, low, high) - x, fixed)
        active &= ~beyond
    return fixed


def _with_needs(names: Iterable[str], model: Model) -> tuple[str, ...]:
    """Return the effects that have all that they need, in the model's order."""
    found = set(names)
    while True:
        kept = {name for name in found if set(model.effect(name).needs) <= found}
        if kept == found:
            return tuple(name for name in model.names if name in found)
        found = kept


def selected(search: Search, tell: Callable[[str], None]) -> Chosen:
    """Return the selected effects, and the end of their common search.

    One search from the nominal robot uses few effects, another uses all. A search with few effects converges
    more reliably; the selection continues from all effects only if few leave a much larger error.
    """
    model = search.misfit.model
    usual = tuple(effect.name for effect in model.effects if effect.basic or effect.usual)
    names, point = _better(search, usual, model.names, tell)
    found = improved(search, names, point, tell)
    return found._replace(steps=(f"from {len(names)} effects: {sizes(point)}", *found.steps))


def improved(
    search: Search, names: tuple[str, ...], point: Point, tell: Callable[[str], None], why: str = ""
) -> Chosen:
    """Return better effects than the given ones, and the end of their common search.

    Effects without a significant improvement are removed one by one, and absent effects with the largest
    expected improvement of held-out recordings are added. The next search decides if a change is kept, and
    for an addition also searches that leave one recording out each, because a model that is not complete may
    be linear about one end only. An added effect stays, and a refused one is not tried again, so that the
    selection ends.
    """
    steps: list[str] = []
    added: set[str] = set()
    refused: set[str] = set()
    while True:
        names, point, gone = without_idle(search, names, point, added)
        if gone:
            steps.append(f"without {', '.join(gone)}{why}: {sizes(point)}")
            tell(steps[-1])
        found = _with_another(search, names, point, refused)
        if found is None:
            return Chosen(names, point, tuple(steps))
        more = [name for name in found[0] if name not in names]
        names, point = found
        added |= set(more)
        steps.append(f"with {', '.join(more)}{why}: {sizes(point)}")
        tell(steps[-1])


def _better(
    search: Search, few: tuple[str, ...], many: tuple[str, ...], tell: Callable[[str], None]
) -> tuple[tuple[str, ...], Point]:
    """Return few effects and the end of their search, or many if few leave a much larger error."""
    ends: dict[tuple[str, ...], Point] = {}
    for names in (few, many):
        try:
            ends[names] = search.from_far(search.misfit.model.mask(names))
        except SearchError as error:
            tell(f"{len(names)} effects: {error}")
            continue
        tell(f"{len(names)} effects: {sizes(ends[names])}")
    if not ends:
        raise SearchError("the robot that the search begins from cannot be simulated")
    much_more = len(ends) == 2 and np.mean(np.log(ends[few].scale / ends[many].scale)) > np.log(MUCH_MORE)
    names = many if much_more or few not in ends else few
    return names, ends[names]


def sizes(point: Point) -> str:
    """Return the usual differences of each recording, in words."""
    return ", ".join(f"{1e3 * size:.1f}" for size in point.scale[:, 0]) + " mm"


def _with_another(
    search: Search, names: tuple[str, ...], point: Point, refused: set[str]
) -> tuple[tuple[str, ...], Point] | None:
    """Return the effects with the most promising one that keeps its promise; None if there is none.

    Effects that do not are added to `refused`.
    """
    model = search.misfit.model
    left, without = Left.of(point, names, model), None
    for promise, name, more in _promises(point, names, left, model)[:MOST_TRIES]:
        if promise <= 1.0:
            break
        if name in refused:
            continue
        there = _searched(search, point, more)
        count = _count(model, set(more) - set(names))
        if there is not None and left.promise(Left.of(there, more, model), count) >= 1.0:
            if len(search.misfit.data) == 1:  # nothing else is left out
                return more, there
            without = left_out(search, point) if without is None else without
            if left_out(search, there) < without - WORTH * count:
                return more, there
        refused.add(name)
    return None


def left_out(search: Search, point: Point) -> float:
    """Return the cost of recordings that were each left out of a search from a point, as `held_out`.

    It is infinite if a search fails.
    """
    total = 0.0
    for k in range(len(search.misfit.data)):
        fold = search.without(point, k, *FOLD)
        if fold is None:
            return np.inf
        (rollout,) = search.misfit.differences(fold.x, which=[k])
        if rollout is None:
            return np.inf
        units = search.units(point.scale[[k]], [k])
        found = normal_equations([rollout], units, search.thinned(), derivatives=False)
        cost, amount = float(found.cost[0]), float(found.amount[0])
        # costs are in units of the scale, and each point has its own
        total += amount * np.log(cost * point.scale[k, 0] ** 2 / amount)
    return total


def _count(model: Model, names: Iterable[str]) -> int:
    return sum(len(model.effect(name).numbers) for name in names)


def _promises(
    point: Point, names: tuple[str, ...], left: Left, model: Model
) -> list[tuple[float, str, tuple[str, ...]]]:
    """Return absent effects by expected over required reduction of the cost, the largest first."""
    found = []
    for name in model.names:
        if name in names:
            continue
        more = _with_needs([*names, name, *model.effect(name).needs], model)
        count = _count(model, set(more) - set(names))
        found.append((left.promise(Left.of(point, more, model), count), name, more))
    return sorted(found, reverse=True)


def _searched(search: Search, point: Point, names: tuple[str, ...]) -> Point | None:
    """Return the end of a search with these effects; None if there is none.

    It begins where the linearised equations have their least cost without the effects that are removed, and
    with new effects where those begin.
    """
    model = search.misfit.model
    free = model.mask(names)
    total = point.problem.gradient.sum(axis=0), point.problem.matrix.sum(axis=0)
    nearest = point.x + _linear(point.x, free & point.free, *total, *model.bounds)
    for old, begin in ((nearest, model.begin), (point.x, 0.1 * model.begin)):
        x = np.where(free, np.where(point.free, old, begin), 0.0)
        try:
            return search.run(x, free, None, *TRIED)
        except SearchError:
            continue
    return None


def without_idle(
    search: Search, names: tuple[str, ...], point: Point, kept: Iterable[str] = ()
) -> tuple[tuple[str, ...], Point, list[str]]:
    """Return the effects with a significant improvement, and the removed ones; `kept` effects stay.

    All others are removed at once, by the linearised equations. A search without them tests the removal; if
    it fails, half as many are removed.
    """
    model = search.misfit.model
    gone: list[str] = []
    stay = set(kept)
    most = len(names)
    while True:
        fewer = _without_least(point, names, stay, model, most)
        dropped = [name for name in names if name not in fewer]
        if not dropped:
            return names, point, gone
        there = _searched(search, point, fewer)
        left, count = Left.of(point, names, model), _count(model, dropped)
        if there is not None and Left.of(there, fewer, model).promise(left, count) < 1.0:
            gone += dropped
            names, point = fewer, there
        elif most > 1:
            most = max(1, min(most, len(dropped)) // 2)
        else:
            stay |= set(dropped)


def _without_least(
    point: Point, names: tuple[str, ...], stay: set[str], model: Model, most: int
) -> tuple[str, ...]:
    """Return the effects without the weakest ones, at most so many of them."""
    for _ in range(most):
        left = Left.of(point, names, model)
        options = []
        for name in names:
            if name in stay or model.effect(name).basic:
                continue
            fewer = _with_needs([each for each in names if each != name], model)
            count = _count(model, set(names) - set(fewer))
            if not stay & (set(names) - set(fewer)):
                options.append((Left.of(point, fewer, model).promise(left, count), name, fewer))
        if not options or min(options)[0] >= 1.0:
            break
        names = min(options)[2]
    return names
