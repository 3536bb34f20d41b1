"""Selection of effects by held-out recordings: cross-validation, smallest model first."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple, Self

import numpy as np
from jaxtyping import Bool, Float

from knode_cosserat.estimation.parameters import Model
from knode_cosserat.identification.search import (
    Point,
    Problem,
    Search,
    SearchError,
    Subset,
    normal_equations,
)

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


class Selection(NamedTuple):
    """Selected effects, the end of their search (None: nominal), and the steps of the selection, in words."""

    names: tuple[str, ...]
    point: Point | None
    steps: tuple[str, ...] = ()


def held_out(
    problem: Problem,
    x: Float[np.ndarray, " n"],
    free: Bool[np.ndarray, " n"],
    bounds: Float[np.ndarray, "2 n"],
) -> float:
    """Return the cost of recordings that were each left out of a search, linearised about a point.

    It is -2 times the logarithm of the likelihood of differences of unknown size, by recording. Parameters
    that are not free are nominal. A single recording is divided into pieces, which are left out in turn.
    """
    total = 0.0
    for k, move in enumerate(_moves(problem, x, free, bounds)):
        cost = problem.cost[k] + 2.0 * problem.gradient[k] @ move + move @ problem.matrix[k] @ move
        total += problem.amount[k] * np.log(max(cost, LEAST_LEFT * problem.cost[k]) / problem.amount[k])
    return float(total)


def _moves(
    problem: Problem,
    x: Float[np.ndarray, " n"],
    free: Bool[np.ndarray, " n"],
    bounds: Float[np.ndarray, "2 n"],
) -> list[Float[np.ndarray, " n"]]:
    """Return the moves of searches that leave out one part each, linearised about a point."""
    count = len(problem.cost)
    moves = []
    for k in range(count):
        others = [j for j in range(count) if j != k] or [k]
        gradient, matrix = problem.gradient[others].sum(axis=0), problem.matrix[others].sum(axis=0)
        moves.append(_linear(x, free, gradient, matrix, bounds))
    return moves


def _linear(
    x: np.ndarray, free: np.ndarray, gradient: np.ndarray, matrix: np.ndarray, bounds: np.ndarray
) -> np.ndarray:
    """Return the move to the least cost, with the prior, of the free numbers within their bounds."""
    fixed, (low, high) = np.where(free, 0.0, -x), bounds
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


class HeldOutCosts(NamedTuple):
    """Robust costs (m²) of the blocks of parts that were each left out of a search."""

    cost: Float[np.ndarray, "parts blocks"]
    #: independent differences of each part
    amount: Float[np.ndarray, " parts"]

    @classmethod
    def of(cls, point: Point, names: Iterable[str], model: Model) -> Self:
        """Return the costs with the named effects, linearised about the end of a search."""
        count = len(point.problem.cost)
        cost, _, gradient, matrix = (part.reshape(count, -1, *part.shape[1:]) for part in point.blocks)
        scale = np.repeat(point.scale[:, 0], count // len(point.scale)) ** 2
        costs = []
        for k, move in enumerate(_moves(point.problem, point.x, model.mask(names), model.bounds)):
            blocks = cost[k] + 2.0 * gradient[k] @ move + np.einsum("i,bij,j->b", move, matrix[k], move)
            # linearised equations may predict more than the whole cost
            costs.append(scale[k] * np.maximum(blocks, LEAST_LEFT * cost[k].sum() / len(cost[k])))
        return cls(np.array(costs), point.problem.amount)

    def worth(self, more: HeldOutCosts) -> tuple[float, float]:
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

    def promise(self, more: HeldOutCosts, count: int) -> float:
        """Return the expected reduction of the cost by more parameters, over the least reduction."""
        worth, error = self.worth(more)
        return worth / max(WORTH * count, ERRORS * error)


def _with_needs(names: Iterable[str], model: Model) -> tuple[str, ...]:
    """Return the effects whose required effects are present, in the model's order."""
    present = set(names)
    while True:
        kept = {name for name in present if set(model.effect(name).needs) <= present}
        if kept == present:
            return tuple(name for name in model.names if name in kept)
        present = kept


def selected(search: Search, tell: Callable[[str], None]) -> Selection:
    """Return the selected effects, and the end of their common search.

    One search from the nominal robot uses few effects, another uses all. A search with few effects converges
    more reliably; the selection continues from all effects only if few leave a much larger error.
    """
    model = search.misfit.model
    few = tuple(effect.name for effect in model.effects if effect.basic or effect.usual)
    ends: dict[tuple[str, ...], Point] = {}
    for names in (few, model.names):
        try:
            ends[names] = search.from_far(model.mask(names))
        except SearchError as error:
            tell(f"{len(names)} effects: {error}")
            continue
        tell(f"{len(names)} effects: {sizes(ends[names])}")
    if not ends:
        raise SearchError("the robot that the search begins from cannot be simulated")
    names = few if few in ends else model.names
    if len(ends) == 2 and np.mean(np.log(ends[few].scale / ends[model.names].scale)) > np.log(MUCH_MORE):
        names = model.names
    first = f"from {len(names)} effects: {sizes(ends[names])}"
    return improved(search, Selection(names, ends[names], (first,)), tell)


def improved(search: Search, selection: Selection, tell: Callable[[str], None], why: str = "") -> Selection:
    """Return a selection with better effects.

    Effects without a significant improvement are removed one by one, and absent effects with the largest
    expected improvement of held-out recordings are added. The next search decides if a change is kept, and
    for an addition also searches that leave one recording out each, because a model that is not complete may
    be linear about one end only. An added effect stays, and a refused one is not tried again, so that the
    selection ends.
    """
    names, point, steps = selection.names, selection.point, list(selection.steps)
    assert point is not None
    added: set[str] = set()
    refused: set[str] = set()
    while True:
        names, point, removed = without_idle(search, names, point, added)
        if removed:
            steps.append(f"without {', '.join(removed)}{why}: {sizes(point)}")
            tell(steps[-1])
        extension = _extended(search, names, point, refused)
        if extension is None:
            return Selection(names, point, tuple(steps))
        more = [name for name in extension[0] if name not in names]
        names, point = extension
        added |= set(more)
        steps.append(f"with {', '.join(more)}{why}: {sizes(point)}")
        tell(steps[-1])


def sizes(point: Point) -> str:
    """Return the usual differences of each recording, in words."""
    return ", ".join(f"{1e3 * size:.1f}" for size in point.scale[:, 0]) + " mm"


def _extended(
    search: Search, names: tuple[str, ...], point: Point, refused: set[str]
) -> tuple[tuple[str, ...], Point] | None:
    """Return the effects with one more, and the end of their search; None if no effect improves enough.

    The effect with the largest expected improvement that a search confirms is added; effects whose
    improvement is not confirmed are added to `refused`.
    """
    model = search.misfit.model
    costs, without = HeldOutCosts.of(point, names, model), None
    options = []
    for name in model.names:
        if name not in names:
            more = _with_needs([*names, name, *model.effect(name).needs], model)
            count = _count(model, set(more) - set(names))
            options.append((costs.promise(HeldOutCosts.of(point, more, model), count), name, more, count))
    for promise, name, more, count in sorted(options, reverse=True)[:MOST_TRIES]:
        if promise <= 1.0:
            break
        if name in refused:
            continue
        end = _searched(search, point, more)
        if end is not None and costs.promise(HeldOutCosts.of(end, more, model), count) >= 1.0:
            if len(search.misfit.data) == 1:  # there is no other recording to leave out
                return more, end
            without = held_out_cost(search, point) if without is None else without
            if held_out_cost(search, end) < without - WORTH * count:
                return more, end
        refused.add(name)
    return None


def held_out_cost(search: Search, point: Point) -> float:
    """Return the cost of recordings that were each left out of a search from a point, as `held_out`.

    It is infinite if a search fails.
    """
    total = 0.0
    for k in range(len(search.misfit.data)):
        fold = search.without(point, k, FOLD)
        rollouts = None if fold is None else search.solved(fold.x, Subset(None, [k]))
        if rollouts is None:
            return np.inf
        units = search.units(point.scale[[k]], [k])
        problem = normal_equations(rollouts, units, search.thinned(), derivatives=False)
        cost, amount = float(problem.cost[0]), float(problem.amount[0])
        # costs are in units of the scale, and each point has its own
        total += amount * np.log(cost * point.scale[k, 0] ** 2 / amount)
    return total


def _count(model: Model, names: Iterable[str]) -> int:
    return sum(len(model.effect(name).numbers) for name in names)


def _searched(search: Search, point: Point, names: tuple[str, ...]) -> Point | None:
    """Return the end of a search with these effects; None if there is none.

    It begins at the least cost of the linearised equations without the removed effects; new effects begin at
    their own initial coordinates.
    """
    model = search.misfit.model
    free = model.mask(names)
    total = point.problem.gradient.sum(axis=0), point.problem.matrix.sum(axis=0)
    nearest = point.x + _linear(point.x, free & point.free, *total, model.bounds)
    for old, begin in ((nearest, model.begin), (point.x, 0.1 * model.begin)):
        x = np.where(free, np.where(point.free, old, begin), 0.0)
        try:
            return search.run(x, free, effort=TRIED)
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
    removed: list[str] = []
    stay = set(kept)
    most = len(names)
    while True:
        fewer = _without_least(point, names, stay, model, most)
        dropped = [name for name in names if name not in fewer]
        if not dropped:
            return names, point, removed
        end = _searched(search, point, fewer)
        costs, count = HeldOutCosts.of(point, names, model), _count(model, dropped)
        if end is not None and HeldOutCosts.of(end, fewer, model).promise(costs, count) < 1.0:
            removed += dropped
            names, point = fewer, end
        elif most > 1:
            most = max(1, min(most, len(dropped)) // 2)
        else:
            stay |= set(dropped)


def _without_least(
    point: Point, names: tuple[str, ...], stay: set[str], model: Model, most: int
) -> tuple[str, ...]:
    """Return the effects without the weakest ones, at most so many of them."""
    for _ in range(most):
        costs = HeldOutCosts.of(point, names, model)
        options = []
        for name in names:
            if name in stay or model.effect(name).basic:
                continue
            fewer = _with_needs([it for it in names if it != name], model)
            dropped = set(names) - set(fewer)
            if not stay & dropped:
                fewer_costs = HeldOutCosts.of(point, fewer, model)
                options.append((fewer_costs.promise(costs, _count(model, dropped)), name, fewer))
        if not options or min(options)[0] >= 1.0:
            break
        names = min(options)[2]
    return names
