"""Selection of effects: the most probable ones, searched again until their set stays the same."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

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


def from_far(search: Search, tell: Callable[[str], None]) -> Point:
    """Return the end of a search with all effects or, if that has no begin, with few.

    Raises:
        SearchError: the nominal robot cannot be simulated.
    """
    model = search.misfit.model
    try:
        return search.from_far(model.mask(model.names), effort=FIRST)
    except SearchError as error:
        tell(f"all effects: {error}")
    few = model.mask(effect.name for effect in model.effects if effect.basic or effect.usual)
    point = search.from_far(few)
    try:
        return search.run(
            np.where(few, point.x, 0.1 * model.begin), np.ones(model.size, dtype=bool), every=True
        )
    except SearchError as error:
        tell(f"all effects: {error}")
    return point


def selected(search: Search, point: Point, tell: Callable[[str], None]) -> Selection:
    """Return the effects that are more probable than not, and the end of their search.

    The probabilities belong to equations that are linear about a point (`Posterior`), so the search with the
    selected effects gives new ones, until no other set is selected. An effect without a derivative where it
    is absent, such as friction, begins where the first point has it.
    """
    model, first = search.misfit.model, point.x
    begin = np.where(point.free, first, model.begin)
    steps: list[str] = []
    searched: list[tuple[str, ...]] = []
    names = Posterior.of(model, point).names()
    while names not in searched and len(searched) < MOST:
        free, nearest = model.mask(names), Posterior.of(model, point).mode(names)
        end = None
        for x in (
            np.where(point.free | (nearest != 0.0), nearest, begin),
            np.where(point.free, point.x, begin),
        ):
            try:
                end = search.run(np.where(free, x, 0.0), free, effort=TRIED, every=True)
                break
            except SearchError as error:
                tell(f"{len(names)} effects: {error}")
        if end is None:
            break
        point = end
        searched.append(names)
        steps.append(f"with {', '.join(names)}: {sizes(point)}")
        tell(steps[-1])
        names = Posterior.of(model, point).names()
    if not searched:
        raise SearchError("no set of effects can be searched")
    return Selection(searched[-1], point, tuple(steps))


def sizes(point: Point) -> str:
    """Return the usual differences of each recording, in words."""
    return ", ".join(f"{1e3 * size:.1f}" for size in point.scale[:, 0]) + " mm"
