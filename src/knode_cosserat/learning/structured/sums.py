"""Selection of the functions of a load or a stress, and their weights, by sparse regression.

Simple functions come first. A field that they do not explain may also take nonlinear ones, selected by
held-out error (`selection`). Every vector field is one regression: loads in the material frame and ambient
loads in the global frame are found together.
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
from knode_cosserat.learning.structured.selection import held_out_error, moments, selected_groups
from knode_cosserat.learning.structured.slopes import refined_slopes

#: a remainder below this part of the target is explained well enough by the simple functions
WELL = 1e-6
#: nonlinear functions are taken if their held-out squared error is below this part of the simple ones'
WORTH = 0.8


class Target(NamedTuple):
    """One target field of a regression: its values, and the floors below which they are noise.

    `turn` has the rotation matrices from the material frame to the values' frame, at every point; None if
    the frames are the same. A sample may have several points, in blocks: a value is the mean load over them.
    """

    values: Float[Any, "S n"]
    turn: Any
    floors: Float[Any, " n"]
    #: names of the vectors with nonlinear functions; None: all
    curved: tuple[str, ...] | None = None


class Counting(NamedTuple):
    """Sample weights (on average one) and cross-validation folds."""

    shares: Float[Any, " S"]
    fold: Any


def mean_of_ends(values: Float[np.ndarray, "P ..."], count: int) -> Float[np.ndarray, "S ..."]:
    """Return the mean over the points of each sample; the first points of all samples come first."""
    return values if len(values) == count else values.reshape(-1, count, *values.shape[1:]).mean(axis=0)


class Offer:
    """An expansion with unknown weights, and its inputs at every point."""

    def __init__(self, part: Expansion, inputs: Float[Any, "P x"]):
        self.part, self.inputs = part, inputs

    @functools.cached_property
    def features(self) -> Float[np.ndarray, "P k"]:
        """Values of the functions; independent of sample weights, so that seeds share them."""
        return np.asarray(_features_of(self.part, self.inputs))

    def with_slopes(self, slopes: Any) -> Offer:
        """Return a copy with other slopes."""
        return Offer(dataclasses.replace(self.part, slopes=slopes), self.inputs)


def fitted_load(
    material: Sequence[Offer], ambient: Offer, targets: Sequence[Target], counting: Counting
) -> Load | None:
    """Return the load that explains the targets, from observables (simple or nonlinear) and inputs."""
    own, beside = _best(material, ambient.features, targets, counting)
    outer = dataclasses.replace(ambient.part, weights=np.concatenate(beside)).pruned()
    return None if own is None and outer is None else Load(own, outer)


def fitted_stress(
    candidates: Sequence[Offer], targets: Sequence[Target], counting: Counting
) -> Expansion | None:
    """Return the stress that explains the targets, by the simple or the nonlinear expansion."""
    return _best(candidates, np.ones((len(counting.shares), 1)), targets, counting)[0]


@eqx.filter_jit
def _features_of(part: Expansion, inputs: Any) -> Any:
    return jax.vmap(part.features)(inputs)


class _Fit(NamedTuple):
    """Weights of the material and the ambient features (n, k), and the remainder."""

    material: Float[Any, "n k"]
    ambient: Float[Any, "n a"]
    #: remainder of each regression (rms)
    left: list[float]
    #: true for columns of the problem with a weight
    used: Any


class _Problem:
    """A target with its features as the columns of one regression of all its numbers, or one for each.

    Without rotation every number (n,) has its own regression on the same columns: the material features, and
    the ambient features without the constant, which is already a material feature. With rotation there is one
    regression; a column is a feature of one of the material's numbers, or an ambient one.
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
        """Return the columns, from the material features (P, k)."""
        count = len(self.target.values)
        if self.target.turn is None:
            return mean_of_ends(np.concatenate([material, self.ambient[:, 1:]], axis=1), count)
        turned = [self.target.turn[:, :, j, None] * material[:, None, :] for j in range(self.size)]
        still = [np.eye(self.size)[:, i, None] * self.ambient[:, None, :] for i in range(self.size)]
        columns = mean_of_ends(np.concatenate([*turned, *still], axis=2), count)
        return columns.reshape(-1, columns.shape[2])

    def spread(self, features: Any) -> Any:
        """Expand values of the material features (…, k) to all columns; zero for ambient ones."""
        copies = 1 if self.target.turn is None else self.size
        rest = self.columns.shape[1] - copies * self.counts[0]
        none = np.zeros((*features.shape[:-1], rest), dtype=features.dtype)
        return np.concatenate([features] * copies + [none], axis=-1)

    def solved(self, among: Any = None) -> _Fit:
        """Return the fit with these columns (by default all)."""
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
        """Return the remainder relative to the target; zero at the floor."""
        if max(fit.left) <= 3.0 * self.floors.max():
            return 0.0
        return max(fit.left) / float(np.sqrt(np.mean(self.values**2)))

    def groups(self, part: Expansion) -> list[Any]:
        """Return groups of columns that are selected together: each allowed term, and each ambient one."""
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
        """Return the columns with the least held-out error; None if the simple fit is nearly as good."""
        root = np.sqrt(self.shares)[:, None]
        parts = moments(self.columns * root, self.values * root, self.fold)
        groups = self.groups(part)
        floor = float(np.mean(np.square(self.floors))) * self.values.size
        taken, error = selected_groups(parts, groups, floor)
        if error > WORTH * held_out_error(parts, np.flatnonzero(simple.used)):
            return None
        among = np.zeros(self.columns.shape[1], dtype=bool)
        for k in taken:
            among[groups[k]] = True
        return among


def _best(
    candidates: Sequence[Offer], ambient: Any, targets: Sequence[Target], counting: Counting
) -> tuple[Expansion | None, list[Any]]:
    """Return the expansion of the fields' best fits, and their ambient weights."""
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
    """Return `rich` with refined slopes of the saturating functions, fitted on the worst explained field."""
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
    return rich.with_slopes(refined_slopes(build, target, fits[k].used, part.slopes, owned, part.kinds()))
