"""The structured residual from samples, by least squares: material, stretch, loads and tip.

At the true states every part is linear in its weights. What the law of the strains leaves, at the true
strains, gives the stress; the geometry of the samples gives the stretch; what the balance leaves gives the
loads. Where a segment is not one Euler step, y_s comes from splines, and the weights found are then polished
on the segments.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.learning.config import StructuredOptions
from knode_cosserat.learning.samples import Dataset, Samples, TipSamples, start_of
from knode_cosserat.learning.sides import whole
from knode_cosserat.learning.structured.expansion import CURVED, DRAG, LINEAR, Expansion, expansion
from knode_cosserat.learning.structured.polish import polished
from knode_cosserat.learning.structured.residual import (
    Load,
    Structured,
    ambient_inputs,
    ambient_layout,
    geometric,
    law_inputs,
    loaded,
    material_layout,
    tip_observables,
)
from knode_cosserat.learning.structured.selection import folds
from knode_cosserat.learning.structured.sums import Counting, Offer, Target, fitted_load, fitted_stress
from knode_cosserat.rods.layout import Layout
from knode_cosserat.rods.system import System, unpacked_history
from knode_cosserat.rotation import rotation_matrix
from knode_cosserat.solvers.space import Euler

#: of the natural size of what is balanced: less than this is the solver's tolerance, not a load
LEAST = 1e-9
#: the solver's tolerance, in natural units, with some room
TOLERANCE = 3e-10


def solve(
    knowledge: System, data: Dataset, options: StructuredOptions, seeds: Sequence[int]
) -> list[Structured]:
    """The structured residuals that explain the samples, one for each seed.

    A seed says how rows count if they are resampled, and nothing else: what they have to explain, and with
    what, is found once.
    """
    seen = _Seen(knowledge, data, options)
    found: list[Structured] = []
    for seed in seeds:
        if found and not options.resample:
            found.append(found[0])
            continue
        segments, tips = (_counting(part, options, seed) for part in (data.segments, data.tips))
        residual = Structured(np.zeros(()), fitted_stress(*seen.law, segments), None, None)
        residual = _with_loads(seen, residual, segments)
        found.append(dataclasses.replace(residual, tip_load=_tip_load(seen, residual, tips)))
    return found


class _Seen:
    """What has to be explained, and what may explain it: the same however samples count.

    Its segments are those of strands.
    """

    def __init__(self, knowledge: System, data: Dataset, options: StructuredOptions):
        self.knowledge, self.data, self.options = knowledge, data, options
        #: what is learned along the rod is the law of a strand
        self.strand = knowledge.strand

    @functools.cached_property
    def law(self) -> tuple[list[Offer], list[Target]]:
        """Of the law of the strains."""
        return _law(self.strand, self.data.segments, self.options)

    @functools.cached_property
    def views(self) -> _Views:
        """Along the rod."""
        return jax.tree.map(np.asarray, _views(self.strand, self.data.segments))

    @functools.cached_property
    def rates(self) -> Float[np.ndarray, "S y"]:
        """The knowledge's y_s at the true strains."""
        return np.asarray(_rates(self.strand, self.data.segments))

    @functools.cached_property
    def along(self) -> _Sides:
        """What a load along the rod may be a sum of."""
        return _sides(self.strand, loaded(self.strand), self.data.segments.y, self.views, self.options.curved)


class _Sides(NamedTuple):
    """A load's layout, what it may be a sum of, and the rotations (S, 3, 3) of its fields."""

    layout: Layout
    material: list[Offer]
    ambient: Offer
    frames: dict[str, Any]


def _sides(system: System, layout: Layout, y: Any, views: _Views, curved: bool) -> _Sides:
    """What a load of this layout may be a sum of, of the material and ambient, and its frames."""
    material = _candidates(system, material_layout(system), layout, views, curved)
    ambient = expansion(ambient_layout(system), views.ambient, {}, layout.size)
    offers = [Offer(part, views.material) for part in material]
    return _Sides(layout, offers, Offer(ambient, views.ambient), _frames(system, layout, y))


def _counting(data: Samples | TipSamples, options: StructuredOptions, seed: int) -> Counting:
    """How much each sample counts, on average one; resampled, rows count at random (Bayesian bootstrap)."""
    shares = data.weight
    if options.resample:
        rows, which = np.unique(data.origin, axis=0, return_inverse=True)
        shares = shares * np.random.default_rng(seed).exponential(size=len(rows))[which.ravel()]
    return Counting(shares / np.mean(shares), folds(data.origin))


def _floors(layout: Layout, values: Float[Any, "S n"]) -> Float[Any, " n"]:
    """For each number, the part of its field's natural size below which nothing is meant."""
    floors = np.zeros(layout.size)
    for field in layout.fields:
        where = layout.slice(field.name)
        floors[where] = LEAST * np.sqrt(np.mean(np.square(values[:, where])))
    return np.maximum(floors, 1e-300)


# the material


@jax.jit
def _left_of_law(knowledge: System, data: Samples) -> tuple[Any, Any, Any]:
    """What the law leaves at the true strains, its natural size, and what stress may depend on."""

    def one(sample: Samples) -> Any:
        s = start_of(knowledge, sample.place)
        history = unpacked_history(knowledge, sample.c0, sample.history[0])
        z, z_t = sample.z, sample.c0 * sample.z + history.z
        inputs = law_inputs(knowledge, s, sample.control, z, z_t)

        def law(z: Any) -> Any:
            return knowledge.left_of_law(s, sample.t, sample.y, z, sample.control, history)

        # its slope along z sums up what the law's terms are made of
        left, size = jax.jvp(law, (z,), (z,))
        return -left, size, inputs

    return jax.vmap(one)(data)


def _law(knowledge: System, data: Samples, options: StructuredOptions) -> tuple[list[Offer], list[Target]]:
    left, size, inputs = (np.asarray(part) for part in _left_of_law(knowledge, data))
    fields = knowledge.z_layout.fields
    layout = Layout(*fields, *((f"{name}_t", *rest) for name, *rest in fields))
    offers = [
        Offer(expansion(layout, inputs, dict.fromkeys(layout.names, forms), left.shape[1]), inputs)
        for forms in ((LINEAR, CURVED) if options.curved else (LINEAR,))
    ]
    floors = _floors(knowledge.z_layout, size)
    spots = [knowledge.z_layout.slice(field.name) for field in fields]
    # curved in the strain itself and its rate only: what the others do is no more than a linear coupling
    targets = [
        Target(left[:, spot], None, floors[spot], (field.name, f"{field.name}_t"))
        for field, spot in zip(fields, spots, strict=True)
    ]
    return offers, targets


# the loads


class _Views(NamedTuple):
    """What loads may depend on, at every sample, and A + c0 B if B is not zero."""

    material: Float[Any, "S o"]
    ambient: Float[Any, "S a"]
    matrix: Any


@jax.jit
def _views(knowledge: System, data: Samples) -> _Views:
    def one(sample: Samples) -> Any:
        s = start_of(knowledge, sample.place)
        history = unpacked_history(knowledge, sample.c0, sample.history[0])
        y_t, z_t = sample.c0 * sample.y + history.y, sample.c0 * sample.z + history.z
        observables = knowledge.observables(s, sample.y, y_t, sample.z, z_t, sample.control)
        matrix = None
        if knowledge.mixed:
            A, B, _ = knowledge.balance(s, sample.t, sample.y, y_t, sample.z, z_t, sample.control)
            matrix = A + sample.c0 * B
        ambient = ambient_inputs(knowledge, sample.control)
        return _Views(jnp.concatenate([observables, ambient]), ambient, matrix)

    return jax.vmap(one)(data)


@jax.jit
def _rates(knowledge: System, data: Samples) -> Any:
    """The knowledge's y_s at the true strains."""

    def one(sample: Samples) -> Any:
        history = unpacked_history(knowledge, sample.c0, sample.history[0])
        return knowledge.rates(
            start_of(knowledge, sample.place), sample.t, sample.y, sample.z, sample.control, history
        )

    return jax.vmap(one)(data)


def _with_loads(seen: _Seen, residual: Structured, counting: Counting) -> Structured:
    """The residual with its stretch and its loads."""
    knowledge, data, rates = seen.strand, seen.data, seen.rates
    length = float(knowledge.length)
    if isinstance(data.space, Euler):
        # only of a segment that is one step its ends tell the slope
        counts = counting.shares * whole(knowledge, data.segments.place)
        counting = counting._replace(shares=counts / np.mean(counts))
    moved, doubt = data.segments.slope / length, data.doubt / length
    longer = _longer(knowledge, moved, rates, counting.shares)
    missing = moved / longer - rates
    if knowledge.mixed:
        missing = np.einsum("sij,sj->si", seen.views.matrix, missing)
    ds = length / (knowledge.nodes - 1)
    floors = _floors(knowledge.y_layout, np.abs(rates) + np.abs(moved))
    floors = np.maximum(floors, TOLERANCE * np.asarray(knowledge.scales().y) / ds)
    where = knowledge.y_layout.indices(seen.along.layout.names)
    load = _load(seen.along, missing[:, where], np.maximum(floors, doubt)[where], counting)
    residual = dataclasses.replace(residual, stretch=np.array(longer - 1.0), load=load)
    if isinstance(data.space, Euler):
        return residual
    return polished(knowledge, data, residual, ds * floors, counting.shares)


def _longer(knowledge: System, moved: Any, rates: Any, shares: Any) -> float:
    """How much longer the rod is than the knowledge has it, from the rates that are geometry."""
    ratios, precisions = [], []
    for name in geometric(knowledge):
        where = knowledge.y_layout.slice(name)
        r, d = rates[:, where], moved[:, where]
        size = np.sum(shares[:, None] * r * r)
        if size > 0.0:
            ratio = np.sum(shares[:, None] * r * d) / size
            left = np.sum(shares[:, None] * (d - ratio * r) ** 2) / d.size
            ratios.append(ratio)
            precisions.append(1.0 / (left / size + (LEAST * ratio) ** 2))
    if not ratios:
        return 1.0
    ratio = float(np.average(ratios, weights=precisions))
    return ratio if abs(ratio - 1.0) > 5.0 / np.sqrt(np.sum(precisions)) else 1.0


def _candidates(
    knowledge: System, inputs: Layout, layout: Layout, views: _Views, curved: bool
) -> list[Expansion]:
    """What a load may be a sum of: at first, and if that is not enough."""
    stated = knowledge.velocities or knowledge.observable_layout.names
    simple: dict[str, Sequence[str]] = dict.fromkeys(knowledge.velocities, DRAG)
    rich: dict[str, Sequence[str]] = dict.fromkeys(stated, CURVED)
    return [
        expansion(inputs, views.material, forms, layout.size)
        for forms in ([simple, rich] if curved else [simple])
    ]


def _load(sides: _Sides, missing: Any, floors: Any, counting: Counting) -> Load | None:
    """The load that explains what is missing (S, l)."""
    targets = [
        Target(missing[:, spot], sides.frames.get(name), floors[spot])
        for name in sides.layout.names
        for spot in [sides.layout.slice(name)]
    ]
    return fitted_load(sides.material, sides.ambient, targets, counting)


@functools.lru_cache(maxsize=1)
def _turns() -> Callable[[Any], Any]:
    return jax.jit(jax.vmap(rotation_matrix))


def _frames(knowledge: System, layout: Layout, y: Any) -> dict[str, Any]:
    """The rotation matrices (S, 3, 3) of each field that is turned."""
    found = {
        name: np.asarray(_turns()(knowledge.y_layout.get(y, name)))
        for name in {field.frame for field in layout.fields if field.frame}
    }
    return {field.name: found[field.frame] for field in layout.fields if field.frame}


# the tip


@jax.jit
def _at_tip(adapted: System, data: TipSamples) -> tuple[Any, _Views]:
    """What is left of the conditions at the true tip, and what a load there may depend on."""

    def one(sample: TipSamples) -> Any:
        history = unpacked_history(adapted, sample.c0, sample.history)
        left = adapted.tip(sample.t, sample.control, sample.y, history)
        observables = tip_observables(adapted, sample.y, sample.control, history)
        ambient = ambient_inputs(adapted, sample.control)
        return left, _Views(jnp.concatenate([observables, ambient]), ambient, None)

    return jax.vmap(one)(data)


def _tip_load(seen: _Seen, residual: Structured, counting: Counting) -> Load | None:
    knowledge, tips = seen.knowledge, seen.data.tips
    left, views = jax.tree.map(np.asarray, _at_tip(residual.adapted(knowledge), tips))
    sides = _sides(knowledge, knowledge.tip_layout, tips.y, views, curved=False)
    return _load(sides, -left, TOLERANCE * np.asarray(knowledge.scales().tip), counting)
