"""Selection of effects: the most probable ones, searched again until their set stays the same."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from knode_cosserat.identification.posterior import Posterior
from knode_cosserat.identification.search import Point, Search, SearchError

#: most searches with other effects
MOST = 4
#: evaluations of these searches, and the part by which the cost falls at their end
TRIED = (15, 2e-3)
#: the same of the first search, with all effects
FIRST = (6, 1e-2)


class Selection(NamedTuple):
    """Selected effects, the end of their search, and the steps of the selection, in words."""

    names: tuple[str, ...]
    point: Point
    steps: tuple[str, ...] = ()


def from_far(search: Search) -> Point:
    """Return the end of a search with all effects or, if that has no begin, with few.

    Raises:
        SearchError: the nominal robot cannot be simulated.
    """
    model = search.misfit.model
    try:
        return search.from_far(model.mask(model.names), effort=FIRST)
    except SearchError as error:
        search.tell(f"all effects: {error}")
    few = model.mask(effect.name for effect in model.effects if effect.basic or effect.usual)
    point = search.from_far(few)
    try:
        return search.run(
            np.where(few, point.x, 0.1 * model.begin), np.ones(model.size, dtype=bool), every=True
        )
    except SearchError as error:
        search.tell(f"all effects: {error}")
    return point


def selected(search: Search, point: Point) -> Selection:
    """Return the effects that are more probable than not, and the end of their search.

    The probabilities belong to equations that are linear about a point (`Posterior`), so the search with the
    selected effects gives new ones, until no other set is selected.

    Raises:
        SearchError: no set of effects can be searched.
    """
    model, steps, searched = search.misfit.model, list[str](), list[tuple[str, ...]]()
    begin, posterior = np.where(point.free, point.x, model.begin), Posterior.of(model, point)
    while posterior.names() not in searched and len(searched) < MOST:
        end = search_of(search, posterior, begin)
        if end is None:
            break
        searched.append(posterior.names())
        steps.append(f"with {', '.join(searched[-1])}: {sizes(end)}")
        search.tell(steps[-1])
        posterior = Posterior.of(model, end)
    if not searched:
        raise SearchError("no set of effects can be searched")
    return Selection(searched[-1], posterior.point, tuple(steps))


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
            return search.run(start, free, effort=TRIED, every=True)
        except SearchError as error:
            search.tell(f"{len(names)} effects: {error}")
    return None


def sizes(point: Point) -> str:
    """Return the usual differences of each recording, in words."""
    return ", ".join(f"{1e3 * size:.1f}" for size in point.scale[:, 0]) + " mm"
