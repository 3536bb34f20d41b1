"""Selection of effects: the most probable ones, and of several such sets the one that predicts best."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from knode_cosserat.estimation.parameters import Model
from knode_cosserat.identification.posterior import Posterior
from knode_cosserat.identification.result import variance_ratio
from knode_cosserat.identification.search import HORIZONS, ROUGH, Point, Search, SearchError, Subset
from knode_cosserat.identification.undetermined import unexplained

#: most searches with other effects
MOST = 4
#: evaluations of these searches, and the part by which the cost falls at their end
TRIED = (15, 2e-3)
#: the same of the first search, with all effects, and of searches without one recording
FIRST, FOLD = (6, 1e-2), (8, 5e-3)
#: part of the motion that the first answer is searched in
SEEN = 0.25
#: a set of effects is not searched if the logarithm of its probability is larger by less
HARDLY = 1.0
#: most selections by what recordings disagree about
SELECTIONS = 3
#: a set of effects, or their average, is not used if the logarithm of the differences' size is larger by this
WORSE = 0.02


class Selection(NamedTuple):
    """Selected effects, and the end of their search, with the ends without one recording each."""

    names: tuple[str, ...]
    point: Point
    folds: tuple[Point | None, ...] = ()
    #: differences (rows, e) of each recording, in the search without it
    held_out: tuple[Float[np.ndarray, "rows e"], ...] = ()
    #: logarithm of the usual size of these differences
    unseen: Float[np.ndarray, " R"] = np.zeros(0)

    @classmethod
    def of(cls, search: Search, names: tuple[str, ...], point: Point) -> Selection:
        """Return the selection after searches without one recording each."""
        count = len(search.misfit.data)
        folds = [search.without(point, k, FOLD, "none") for k in range(count)] if count > 1 else []
        unseen, held_out = np.full(len(folds), np.inf), [np.zeros((0, 0))] * len(folds)
        for k, fold in enumerate(folds):
            rollouts = None if fold is None else search.solved(fold.x, Subset(None, [k]))
            if rollouts is not None:
                unseen[k] = np.mean(np.log(search.scales_of(rollouts, [k])))
                held_out[k] = rollouts[0].values
        return cls(names, point, tuple(folds), tuple(held_out), unseen)

    def posterior(self, model: Model, known: bool = False) -> Posterior:
        """Return the probabilities of effects, in view of what recordings disagree about."""
        scatter = variance_ratio(self.point, [fold.x for fold in self.folds if fold is not None])
        return Posterior.of(model, self.point.scattered(scatter), self.names if known else None)


def first_answer(search: Search) -> tuple[Point, int]:
    """Return the end of a search with all effects over the first rows, and the number of these rows.

    Shapes stay over short horizons, where noise makes motions unstable.

    Raises:
        SearchError: the nominal robot cannot be simulated.
    """
    model, rows = search.misfit.model, search.rows_of(SEEN)
    every = np.ones(model.size, dtype=bool)
    x = search.over(model.begin, every & ~model.shapes, [part for part in HORIZONS if part < SEEN])
    return search.run(x, every, Subset(rows), ROUGH, equations="all"), rows


def from_far(search: Search, first: Point | None) -> Point:
    """Return the end of the first search that explains the data, or of the best search.

    `first` is the end of a search over some rows, if there is one.

    Raises:
        SearchError: the nominal robot cannot be simulated.
    """
    points, errors = list[Point](), list[SearchError]()
    for begin in (None,) if first is None else (first, None):
        try:
            points.append(_with_few_first(search) if begin is None else _with_all(search, begin))
        except SearchError as error:
            search.tell(f"all effects: {error}")
            errors.append(error)
            continue
        if not unexplained(search, points[-1].x):
            break
    if not points:
        raise errors[-1]
    return min(points, key=lambda point: float(np.sum(np.log(point.scale))))


def _with_all(search: Search, first: Point) -> Point:
    """Search with all effects, over more rows and then all."""
    x = search.over(first.x, first.free, [part for part in HORIZONS if part > SEEN])
    return search.run(x, first.free, effort=FIRST, equations="all")


def _with_few_first(search: Search) -> Point:
    """Search with the usual effects, and then with all if there is such a robot."""
    model = search.misfit.model
    few = model.mask(effect.name for effect in model.effects if effect.basic or effect.usual)
    point = search.from_far(few)
    try:
        start = np.where(few, point.x, 0.1 * model.begin)
        return search.run(start, np.ones(model.size, dtype=bool), effort=FIRST, equations="all")
    except SearchError as error:
        search.tell(f"all effects: {error}")
        return point


def selected(search: Search, point: Point, tell: Callable[[str], None]) -> tuple[tuple[str, ...], Point]:
    """Return the effects that are more probable than not, and the end of their search.

    The probabilities belong to equations that are linear about a point (`Posterior`), so the search with the
    selected effects gives new ones, until no other set is selected that is clearly more probable.

    Raises:
        SearchError: no set of effects can be searched.
    """
    model, searched = search.misfit.model, list[tuple[str, ...]]()
    begin, posterior = np.where(point.free, point.x, model.begin), Posterior.of(model, point)
    while posterior.names() not in searched and len(searched) < MOST:
        if searched and not is_clearly_better(posterior, searched[-1]):
            break
        end = search_of(search, posterior, begin)
        if end is None:
            break
        searched.append(posterior.names())
        tell(f"with {', '.join(searched[-1])}: {sizes(end)}")
        posterior = Posterior.of(model, end)
    if not searched:
        raise SearchError("no set of effects can be searched")
    return searched[-1], posterior.point


def best_predicting(search: Search, selection: Selection, tell: Callable[[str], None]) -> Selection:
    """Return a selection in view of what recordings disagree about, as long as it predicts as well.

    Each set is selected about the end of the last one, and has to predict as well as that the recordings that
    were left out of the searches.
    """
    for _ in range(SELECTIONS):
        posterior, last = selection.posterior(search.misfit.model), selection.point
        if not is_clearly_better(posterior, selection.names):
            break
        end = search_of(search, posterior, np.where(last.free, last.x, search.misfit.model.begin))
        if end is None:
            break
        other = Selection.of(search, posterior.names(), end)
        words = f"with {', '.join(other.names)}, as recordings differ: {sizes(end)}"
        if np.mean(other.unseen - selection.unseen) > WORSE:
            tell(f"not {words}; it predicts held-out recordings worse")
            break
        tell(words)
        selection = other
    return selection


def is_clearly_better(posterior: Posterior, names: tuple[str, ...]) -> bool:
    """Return True if the selected effects are clearly more probable than others."""
    return posterior.score(posterior.names()) > posterior.score(names) + HARDLY


def search_of(search: Search, posterior: Posterior, begin: Float[np.ndarray, " n"]) -> Point | None:
    """Return the end of a search with the effects that are more probable than not; None if it has none.

    It begins at the most probable coordinates, or else at those of the last search. Numbers that were absent
    there and have no derivative, such as friction, `begin` at other coordinates.
    """
    names, point = posterior.names(), posterior.point
    free, nearest = search.misfit.model.mask(names), posterior.mode(names)
    for x, known in ((nearest, point.free | (nearest != 0.0)), (point.x, point.free)):
        try:
            start = np.where(free, np.where(known, x, begin), 0.0)
            return search.run(start, free, effort=TRIED, equations="all", near=point.x)
        except SearchError as error:
            search.tell(f"{len(names)} effects: {error}")
    return None


def sizes(point: Point) -> str:
    """Return the usual differences of each recording, in words."""
    return ", ".join(f"{1e3 * size:.1f}" for size in point.scale[:, 0]) + " mm"
