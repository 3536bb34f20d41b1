"""Identification by the library of effects, which are selected by their probabilities and by predictions."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from knode_cosserat._files.yaml_text import did_you_mean
from knode_cosserat.estimation.parameters import ParameterModel
from knode_cosserat.identification.journal import STAGES, SearchError
from knode_cosserat.identification.next_experiment import next_experiment
from knode_cosserat.identification.posterior import UNLIKELY, Posterior
from knode_cosserat.identification.result import (
    IdentificationError,
    Identified,
    estimates_of,
    variance_ratio,
)
from knode_cosserat.identification.samples import sampled
from knode_cosserat.identification.search import HORIZONS, ROUGH, ParameterSearch, SearchEnd, Subset
from knode_cosserat.identification.trials import failed_trial, has_coarse_rows
from knode_cosserat.rods.parameters import ParameterError
from knode_cosserat.rods.system import System
from knode_cosserat.schemes.space import SpaceScheme

#: nodes are doubled so often at most
REFINEMENTS = 2
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


def identify_effects(
    searched: Callable[[System], ParameterSearch],
    robot: System,
    effects: Sequence[str] | None,
    space: str | SpaceScheme,
) -> Identified:
    """Return the robot with the named effects, or with selected ones.

    Args:
        searched: returns the search of a robot in the recordings.
        robot: nominal robot.
        effects: names of effects; None: select them.
        space: scheme along the rod.
    """
    search = searched(robot)
    journal, model = search.journal, search.misfit.model
    try:
        if effects is not None:
            names = _known(effects, model)
            point = search.from_far(model.mask(names))
        else:
            point = _with_all_effects(search)
        for refinements in range(REFINEMENTS + 1):
            if effects is None:
                journal.begin("selection of effects")
                names, point = selected(search, point)
            elif refinements:
                point = search.run(point.x, model.mask(names))
            if not has_coarse_rows(search.misfit.system(point.x), search.misfit.data, space):
                break
            nodes = 2 * model.nominal.nodes
            journal.step(f"{nodes} nodes, for the grid was too coarse")
            search = searched(model.nominal.replace(nodes=nodes))
            model = search.misfit.model
    except SearchError as error:
        raise IdentificationError(f"{error}; the data sheet's numbers are too far from the robot") from None
    journal.begin("held-out recordings")
    selection = Selection.of(search, names, point)
    if effects is None and selection.folds:
        selection = best_predicting(search, selection)
        journal.last = search, selection.point
    return _accepted(search, selection, effects is not None, space)


def _known(effects: Sequence[str], model: ParameterModel) -> tuple[str, ...]:
    for name in effects:
        if name not in model.names:
            raise ParameterError(
                f"there is no effect {name!r}{did_you_mean(name, model.names)}; there are "
                f"{', '.join(model.names)}"
            )
    wanted = {*effects, *(effect.name for effect in model.effects if effect.basic)}
    return tuple(name for name in model.names if name in wanted)


def _with_all_effects(search: ParameterSearch) -> SearchEnd:
    """Return the end of a search with all effects, begun in a part of the rows, or with the usual effects.

    The first answer is told; shapes stay over short horizons, where noise makes motions unstable.
    """
    model, journal, rows = search.misfit.model, search.journal, search.rows_of(SEEN)
    every = np.ones(model.size, dtype=bool)

    def usual_first() -> SearchEnd:
        few = model.mask(effect.name for effect in model.effects if effect.basic or effect.usual)
        point = search.from_far(few)
        try:
            start = np.where(few, point.x, 0.1 * model.begin)
            return search.run(start, every, effort=FIRST, equations="all")
        except SearchError as error:
            journal.tell(f"all effects: {error}")
            return point

    def longer() -> SearchEnd:
        x = search.over(first.x, first.free, [part for part in HORIZONS if part > SEEN])
        return search.run(x, first.free, effort=FIRST, equations="all")

    journal.begin("first answer")
    searches = [usual_first]
    try:
        x = search.over(model.begin, every & ~model.shapes, [part for part in HORIZONS if part < SEEN])
        first = search.run(x, every, Subset(rows), ROUGH, equations="all")
    except SearchError as error:
        journal.tell(f"no first answer: {error}")
    else:
        searches = [longer, usual_first]
        pairs = zip(search.misfit.data, search.misfit.errors(first.x, after=rows), strict=True)
        errors = [it for data, it in pairs if it is not None and data.positions(data.data) is not None]
        found = estimates_of(Posterior.of(model, first, model.names), first.x, model.names)
        basic = [it for it in found if model.effect(it.effect).basic]
        words = ", ".join(f"{it.label} {it.value:.3g} ± {it.error:.2g} {it.unit}" for it in basic)
        size = 1e3 * np.mean(errors or np.nan)
        journal.step(f"first answer, tip error in held-out rows {size:.3g} mm: {words}")
    journal.begin("all effects")
    return search.first_explaining(*searches)


class Selection(NamedTuple):
    """Selected effects, and the end of their search, with the ends without one recording each."""

    names: tuple[str, ...]
    point: SearchEnd
    folds: tuple[SearchEnd | None, ...] = ()
    #: differences (rows, e) of each recording, in the search without it
    held_out: tuple[Float[np.ndarray, "rows e"], ...] = ()
    #: logarithm of the usual size of these differences
    unseen: Float[np.ndarray, " R"] = np.zeros(0)

    @classmethod
    def of(cls, search: ParameterSearch, names: tuple[str, ...], point: SearchEnd) -> Selection:
        """Return the selection after searches without one recording each."""
        count = len(search.misfit.data)
        folds = [search.without(point, k, FOLD, "none") for k in range(count)] if count > 1 else []
        unseen, held_out = np.full(len(folds), np.inf), [np.zeros((0, 0))] * len(folds)
        for k, fold in enumerate(folds):
            rollouts = None if fold is None else search.solved(fold.x, Subset(None, [k]))
            if rollouts is not None:
                unseen[k] = np.mean(np.log(search.scales_of(rollouts)))
                held_out[k] = rollouts[0].values
        return cls(names, point, tuple(folds), tuple(held_out), unseen)

    def posterior(self, model: ParameterModel, known: bool = False) -> Posterior:
        """Return the probabilities of effects, in view of what recordings disagree about."""
        scatter = variance_ratio(self.point, [fold.x for fold in self.folds if fold is not None])
        return Posterior.of(model, self.point.scattered(scatter), self.names if known else None)


def selected(search: ParameterSearch, point: SearchEnd) -> tuple[tuple[str, ...], SearchEnd]:
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
        search.journal.step(f"with {', '.join(searched[-1])}: {sizes(end)}")
        posterior = Posterior.of(model, end)
    if not searched:
        raise SearchError("no set of effects can be searched")
    return searched[-1], posterior.point


def best_predicting(search: ParameterSearch, selection: Selection) -> Selection:
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
            search.journal.step(f"not {words}; it predicts held-out recordings worse")
            break
        search.journal.step(words)
        selection = other
    return selection


def is_clearly_better(posterior: Posterior, names: tuple[str, ...]) -> bool:
    """Return True if the selected effects are clearly more probable than others."""
    return posterior.score(posterior.names()) > posterior.score(names) + HARDLY


def search_of(
    search: ParameterSearch, posterior: Posterior, begin: Float[np.ndarray, " n"]
) -> SearchEnd | None:
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
            search.journal.tell(f"{len(names)} effects: {error}")
    return None


def sizes(point: SearchEnd) -> str:
    """Return the usual differences of each recording, in words."""
    return "usual differences " + ", ".join(f"{1e3 * size:.2g}" for size in point.scale[:, 0]) + " mm"


def _accepted(
    search: ParameterSearch, selection: Selection, known: bool, space: str | SpaceScheme
) -> Identified:
    """Return the identified robot after its trials: with fewer effects if it fails, nominal if that fails.

    The effects are `known` if they were not selected.
    """
    misfit, journal, model = search.misfit, search.journal, search.misfit.model
    while True:
        journal.begin("trials")
        names, point, folds, *_ = selection
        x, kept, posterior = _averaged(search, selection, selection.posterior(model, known))
        reason = failed_trial(misfit.system(x), misfit.data, space)
        if reason is None:
            break
        added = [name for name in names if not model.effect(name).basic]
        journal.tell(f"not accepted: {reason}")
        if not added:
            journal.step(f"the nominal robot is returned: {reason}")
            return _nominal(search)
        fewer = {
            name: tuple(it for it in names if name not in (it, *model.effect(it).needs)) for name in added
        }
        weakest = max(added, key=lambda name: posterior.evidence(fewer[name]))
        journal.step(f"without {weakest}: {reason}")
        names, known = fewer[weakest], True
        free = model.mask(names)
        selection = Selection.of(search, names, search.run(np.where(free, point.x, 0.0), free))
    errors: list[float | None] = [None]
    if folds:
        errors = [None if it is None else misfit.errors(it.x, [k])[0] for k, it in enumerate(folds)]
        nominal = misfit.errors(np.zeros(model.size))
        unseen, before = ([np.inf if it is None else it for it in values] for values in (errors, nominal))
        if np.mean(unseen) >= np.mean(before):
            journal.step("the nominal robot is returned: it predicts held-out recordings as well")
            return _nominal(search)
    pairs = zip(misfit.data, errors, strict=True)
    held_out = {it.name: None if it.positions(it.data) is None else error for it, error in pairs}
    result = Identified.of(search, x, kept, posterior, held_out_error=held_out)
    journal.result = result
    journal.begin(STAGES[-1])
    undecided = tuple(result.undecided)
    return dataclasses.replace(
        result,
        next_experiment=next_experiment(search, posterior, x, undecided) if undecided else None,
        ensemble=sampled(search, (x, kept), posterior, selection.held_out),
    )


def _averaged(
    search: ParameterSearch, selection: Selection, posterior: Posterior
) -> tuple[np.ndarray, tuple[str, ...], Posterior]:
    """Return the mean coordinates over all sets of effects, the probable effects, and their distribution.

    If the robot with them is further from the data than the selected effects, it is those and about them.
    """
    model, point = search.misfit.model, selection.point
    kept = posterior.names(UNLIKELY)
    x = np.where(model.mask(kept), posterior.mean, 0.0)
    if set(kept) != set(selection.names):
        rollouts = search.solved(x)
        if rollouts is None or np.mean(np.log(search.scales_of(rollouts) / point.scale)) > WORSE:
            x = np.where(point.free, point.x, 0.0)
            return x, selection.names, posterior.about(x)
    return x, kept, posterior


def _nominal(search: ParameterSearch) -> Identified:
    misfit = search.misfit
    errors = misfit.tip_errors(np.zeros(misfit.model.size))
    steps = tuple(search.journal.steps)
    return Identified(misfit.model.nominal, nominal_error=errors, error=errors, steps=steps)
