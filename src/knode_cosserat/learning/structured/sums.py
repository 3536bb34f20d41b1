"""Which functions a load or a stress is a sum of, and their weights, by sparse regression.

The simple functions first. A field that they leave unexplained may take curved ones too, those few that
explain data held out (`selection`). Every field of vectors is one regression: what is turned (a load seen
from the material) and what is not (an ambient load) are found together.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from knode_cosserat.learning.structured.evidence import relevant
from knode_cosserat.learning.structured.expansion import Expansion
from knode_cosserat.learning.structured.residual import Load
from knode_cosserat.learning.structured.selection import held_out_error, moments, selected
from knode_cosserat.learning.structured.slopes import refined

#: a remainder below this part of the target is explained well enough by the simple functions
WELL = 1e-6
#: what part of the simple functions' held-out squared error the curved ones may leave, to be taken
WORTH = 0.8


class Target(NamedTuple):
    """One field that is to be explained: its values, and below what nothing is meant.

    `turn` has the rotation matrices from the material's frame to the values', at every point; None if that is
    the same. There may be several points to a sample, in blocks: a value is the mean of the load at them.
    """

    values: Float[Any, "S n"]
    turn: Any
    floors: Float[Any, " n"]
    #: names of the vectors of which curved functions are allowed; None: of all
    curved: tuple[str, ...] | None = None


class Counting(NamedTuple):
    """How samples count: the share of each, on average one, and the fold that each is held out with."""

    shares: Float[Any, " S"]
    fold: Any


def mean_of_ends(values: Float[np.ndarray, "P ..."], count: int) -> Float[np.ndarray, "S ..."]:
    """Return the mean over the points of each sample; of all samples the first points come first."""
    return values if len(values) == count else values.reshape(-1, count, *values.shape[1:]).mean(axis=0)


class Offer:
    """An expansion whose weights are to be found, and what it depends on, at every point."""

    def __init__(self, part: Expansion, inputs: Float[Any, "P x"]):
        self.part, self.inputs = part, inputs

    @functools.cached_property
    def features(self) -> Float[np.ndarray, "P k"]:
        """The values of its functions; the same however samples count, so that seeds share them."""
        return np.asarray(_features_of(self.part, self.inputs))

    def with_slopes(self, slopes: Any) -> Offer:
        """The same with other slopes."""
        return Offer(dataclasses.replace(self.part, slopes=slopes), self.inputs)


def fitted_load(
    material: Sequence[Offer], ambient: Offer, targets: Sequence[Target], counting: Counting
) -> Load | None:
    """The load that explains the targets: of observables, simple or curved, and of inputs."""
    own, beside = _best(material, ambient.features, targets, counting)
    outer = dataclasses.replace(ambient.part, weights=np.concatenate(beside)).pruned()
    return None if own is None and outer is None else Load(own, outer)


def fitted_stress(
    candidates: Sequence[Offer], targets: Sequence[Target], counting: Counting
) -> Expansion | None:
    """The stress that explains the targets, with the simple expansion or the curved."""
    return _best(candidates, np.ones((len(counting.shares), 1)), targets, counting)[0]


@eqx.filter_jit
def _features_of(part: Expansion, inputs: Any) -> Any:
    return jax.vmap(part.features)(inputs)


class _Fit(NamedTuple):
    """Weights on the material's and the ambient features (n, k), and how much they leave."""

    material: Float[Any, "n k"]
    ambient: Float[Any, "n a"]
    #: what is left of each regression (rms)
    left: list[float]
    #: which columns of the problem have a weight
    used: Any


class _Problem:
    """A target with its features as the columns of one regression of all its numbers, or one of each.

    Where nothing is turned every number (n,) has a regression of its own on the same columns: the material's
    features and the ambient ones but for the constant, which would be the material's. Where the load is
    turned there is one regression; a column is a feature of one of the material's numbers, or an ambient one.
    """

    def __init__(self, target: Target, material: Any, ambient: Any, counting: Counting):
        self.target, self.size, self.counts = (
            target,
            target.values.shape[1],
            (material.shape[1], ambient.shape[1]),
        )
        self.ambient, self.shares, self.fold = ambient, counting.shares, counting.fold
        self.columns = self.arranged(material)
        self.values = target.values
        self.floors = target.floors
        if target.turn is not None:
            self.shares, self.fold = (np.repeat(each, self.size) for each in counting)
            self.values = target.values.reshape(-1, 1)
            self.floors = np.array([target.floors.max()])

    def arranged(self, material: Any) -> Any:
        """The columns, from the material's features (P, k)."""
        count = len(self.target.values)
        if self.target.turn is None:
            return mean_of_ends(np.concatenate([material, self.ambient[:, 1:]], axis=1), count)
        turned = [self.target.turn[:, :, j, None] * material[:, None, :] for j in range(self.size)]
        still = [np.eye(self.size)[:, i, None] * self.ambient[:, None, :] for i in range(self.size)]
        columns = mean_of_ends(np.concatenate([*turned, *still], axis=2), count)
        return columns.reshape(-1, columns.shape[2])

    def spread(self, features: Any) -> Any:
        """Something of each of the material's features (…, k), for each column; zero for ambient ones."""
        copies = 1 if self.target.turn is None else self.size
        rest = self.columns.shape[1] - copies * self.counts[0]
        none = np.zeros((*features.shape[:-1], rest), dtype=features.dtype)
        return np.concatenate([features] * copies + [none], axis=-1)

    def solved(self, among: Any = None) -> _Fit:
        """The fit with these columns (all, by default)."""
        among = np.ones(self.columns.shape[1], dtype=bool) if among is None else among
        weights = np.zeros((len(self.floors), len(among)))
        found = relevant(self.columns[:, among], self.values, self.floors, self.shares)
        weights[:, among] = [each.values for each in found]
        left = [each.noise for each in found]
        count = self.counts[0]
        if self.target.turn is None:
            material, ambient = weights[:, :count], np.insert(weights[:, count:], 0, 0.0, axis=1)
        else:
            here = self.size * count
            material, ambient = (part.reshape(self.size, -1) for part in np.split(weights[0], [here]))
        return _Fit(material, ambient, left, np.any(weights != 0.0, axis=0))

    def unexplained(self, fit: _Fit) -> float:
        """What is left as a part of the target; zero at the floor."""
        if max(fit.left) <= 3.0 * self.floors.max():
            return 0.0
        return max(fit.left) / float(np.sqrt(np.mean(self.values**2)))

    def groups(self, part: Expansion) -> list[Any]:
        """The columns that are taken or left together: of each allowed term, and each ambient one."""
        allowed = self.target.curved
        terms = [
            where for term, where in part.columns()
            if term.form == "linear" or allowed is None or term.name in allowed
        ]  # fmt: skip
        material = []
        for where in [range(1), *terms]:
            mask = np.zeros(self.counts[0], dtype=bool)
            mask[list(where)] = True
            material.append(np.flatnonzero(self.spread(mask)))
        rest = np.arange(self.columns.shape[1] - self.spread(np.ones(self.counts[0])).astype(bool).sum())
        first = self.columns.shape[1] - len(rest)
        return [*material, *(rest.reshape(-1, max(len(rest), 1)) + first if len(rest) else [])]

    def picked(self, part: Expansion, simple: _Fit) -> Any:
        """The columns that explain most of what is held out, or none; None if the simple fit is as good."""
        root = np.sqrt(self.shares)[:, None]
        parts = moments(self.columns * root, self.values * root, self.fold)
        groups = self.groups(part)
        floor = float(np.mean(np.square(self.floors))) * self.values.size
        taken, error = selected(parts, groups, floor)
        if error > WORTH * held_out_error(parts, np.flatnonzero(simple.used)):
            return None
        among = np.zeros(self.columns.shape[1], dtype=bool)
        for k in taken:
            among[groups[k]] = True
        return among


def _best(
    candidates: Sequence[Offer], ambient: Any, targets: Sequence[Target], counting: Counting
) -> tuple[Expansion | None, list[Any]]:
    """The expansion of the fields' best fits, and their ambient weights."""
    simple, *richer = candidates
    problems = [_Problem(target, simple.features, ambient, counting) for target in targets]
    fits = [problem.solved() for problem in problems]
    needy = [k for k, fit in enumerate(fits) if problems[k].unexplained(fit) > WELL]
    if not needy:
        full = dataclasses.replace(simple.part, weights=np.concatenate([fit.material for fit in fits]))
        return full.pruned(), [fit.ambient for fit in fits]

    rich = richer[0] if richer else simple
    where = rich.part.columns_of(simple.part)
    materials = []
    for fit in fits:
        wider = np.zeros((fit.material.shape[0], rich.features.shape[1]))
        wider[:, where] = fit.material
        materials.append(wider)
    picks: dict[int, Any] = {}
    for k in needy:
        problem = _Problem(targets[k], rich.features, ambient, counting)
        known = problem.spread(np.any(materials[k] != 0.0, axis=0)).astype(bool)
        outer = np.concatenate(
            [fits[k].ambient[:, 1:]] if targets[k].turn is None else [fits[k].ambient], axis=1
        )
        known[len(known) - (outer.shape[1] if targets[k].turn is None else outer.size) :] |= (
            np.any(outer != 0.0, axis=0) if targets[k].turn is None else (outer != 0.0).ravel()
        )
        among = problem.picked(rich.part, fits[k]._replace(used=known))
        if among is not None:
            picks[k] = among
    if picks:
        rich = _with_slopes(rich, ambient, {k: targets[k] for k in picks}, picks, counting)
        for k, among in picks.items():
            fits[k] = _Problem(targets[k], rich.features, ambient, counting).solved(among)
            materials[k] = fits[k].material
    full = dataclasses.replace(rich.part, weights=np.concatenate(materials))
    return full.pruned(), [fit.ambient for fit in fits]


def _with_slopes(
    rich: Offer, ambient: Any, targets: dict[int, Target], picks: dict[int, Any], counting: Counting
) -> Offer:
    """The slopes of the saturating functions refined, on the field that they serve worst."""
    part = rich.part
    if not part.slopes.size:
        return rich
    problems = {k: _Problem(target, rich.features, ambient, counting) for k, target in targets.items()}
    fits = {k: problem.solved(picks[k]) for k, problem in problems.items()}
    k = max(fits, key=lambda k: problems[k].unexplained(fits[k]))
    problem = problems[k]
    worst = int(np.argmax(fits[k].left))
    root = np.sqrt(problem.shares)

    def build(slopes: Any) -> Any:
        return problem.arranged(rich.with_slopes(slopes).features) * root[:, None]

    owned = problem.spread(part.owned())
    target = problem.values[:, worst] * root
    return rich.with_slopes(refined(build, target, fits[k].used, part.slopes, owned, part.kinds()))
