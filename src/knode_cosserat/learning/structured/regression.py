"""The structured residual from samples, by least squares: material, stretch, loads and tip.

At the true states every part is linear in its weights. The residual of the constitutive law at the true
strains gives the stress, the geometry of the samples gives the stretch, and the residual of the balance
gives the loads. A scheme without stages (Euler's, the trapezoidal rule) is linear in the rates at a segment's
ends, and so in the weights. For others y_s comes from splines, and the weights are then refined on the
segments.
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
from knode_cosserat.learning.discontinuities import whole
from knode_cosserat.learning.samples import Dataset, Samples, TipSamples, end_of, start_of
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
from knode_cosserat.learning.structured.sums import (
    Counting,
    Offer,
    Target,
    fitted_load,
    fitted_stress,
    mean_of_ends,
)
from knode_cosserat.rods.layout import Layout
from knode_cosserat.rods.system import System
from knode_cosserat.rotation import rotation_matrix
from knode_cosserat.solvers import semi_discrete
from knode_cosserat.solvers.grid import ON_NODE
from knode_cosserat.solvers.semi_discrete import Point, unpacked_history
from knode_cosserat.solvers.space import SpaceScheme

#: smaller relative values are the solver's tolerance, not a load
LEAST = 1e-9
#: the solver's tolerance, in natural units, with some room
TOLERANCE = 3e-10


def solve_residuals(
    knowledge: System, data: Dataset, options: StructuredOptions, seeds: Sequence[int]
) -> list[Structured]:
    """Return the structured residuals that explain the samples, one for each seed.

    A seed only determines the row weights if rows are resampled. Targets and features are shared.
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
    """Targets and features of the regressions, which do not depend on sample weights.

    Segments are those of single strands.
    """

    def __init__(self, knowledge: System, data: Dataset, options: StructuredOptions):
        self.knowledge, self.data, self.options = knowledge, data, options
        #: the strand, whose law is learned along the rod
        self.strand = knowledge.strand
        self._along: _Along | None = None

    def along(self, residual: Structured) -> _Along:
        """Return the equations along the rod, with this residual's stress."""
        if self._along is None or self.strand.cuts:
            self._along = _Along(self, residual)
        return self._along

    @functools.cached_property
    def law(self) -> tuple[list[Offer], list[Target]]:
        """Features and targets of the constitutive law."""
        return _law(self.strand, self.data.segments, self.options)

    @functools.cached_property
    def linear(self) -> bool:
        """True if y at the end of a segment is linear in the rates at its ends."""
        return not self.data.space.formula.stages

    @functools.cached_property
    def moved(self) -> Float[np.ndarray, "S y"]:
        """y_s of each segment: its mean if the scheme is linear in rates; otherwise its initial value."""
        segments, strand = self.data.segments, self.strand
        if not self.linear:
            return np.asarray(segments.slope) / float(strand.length)
        return (segments.y_next - segments.y) * ((strand.nodes - 1) / float(strand.length))


class _Along:
    """Points along the rod for the regression of loads, with the features there.

    `points` are the starts of all segments and, if the scheme uses them, then their ends. It depends on the
    stress only where the rod has discontinuities.
    """

    def __init__(self, seen: _Seen, residual: Structured):
        strand, data = seen.strand, seen.data
        points = _points(strand, residual, data.segments, data.space)
        self.views: _Views = jax.tree.map(np.asarray, _views(strand, points))
        #: y_s of the nominal model at the true strains
        self.rates = mean_of_ends(np.asarray(_rates(strand, points)), len(data.segments.t))
        self.sides = _sides(strand, loaded(strand), points.y, self.views, seen.options.curved)


class _Sides(NamedTuple):
    """Layout of a load, its features, and the rotations (S, 3, 3) of its fields."""

    layout: Layout
    material: list[Offer]
    ambient: Offer
    frames: dict[str, Any]


def _sides(system: System, layout: Layout, y: Any, views: _Views, curved: bool) -> _Sides:
    """Return the material and ambient features of a load of this layout, and its frames."""
    material = _candidates(system, material_layout(system), layout, views, curved)
    ambient = expansion(ambient_layout(system), views.ambient, {}, layout.size)
    offers = [Offer(part, views.material) for part in material]
    return _Sides(layout, offers, Offer(ambient, views.ambient), _frames(system, layout, y))


def _counting(data: Samples | TipSamples, options: StructuredOptions, seed: int) -> Counting:
    """Return sample weights (on average one) and folds; resampled rows have random weights (bootstrap)."""
    shares = data.weight
    if options.resample:
        rows, which = np.unique(data.origin, axis=0, return_inverse=True)
        shares = shares * np.random.default_rng(seed).exponential(size=len(rows))[which.ravel()]
    return Counting(shares / np.mean(shares), folds(data.origin))


def _floors(layout: Layout, values: Float[Any, "S n"]) -> Float[Any, " n"]:
    """Return the noise floor of each number, a small part of its field's rms."""
    floors = np.zeros(layout.size)
    for field in layout.fields:
        where = layout.slice(field.name)
        floors[where] = LEAST * np.sqrt(np.mean(np.square(values[:, where])))
    return np.maximum(floors, 1e-300)


# the material


@jax.jit
def _law_residual(knowledge: System, data: Samples) -> tuple[Any, Any, Any]:
    """Return the residual of the law at the true strains, its natural size, and the inputs of stress."""

    def one(sample: Samples) -> Any:
        s = start_of(knowledge, sample.place)
        history = unpacked_history(knowledge, sample.c0, sample.history[0])
        z, z_t = sample.z, history.z_t(sample.z)
        inputs = law_inputs(knowledge, s, sample.control, z, z_t)
        point = Point(s, sample.t, sample.y, sample.control, history)

        def law(z: Any) -> Any:
            return semi_discrete.law_residual(knowledge, point, z)

        # the derivative along z gives the size of the law's terms
        left, size = jax.jvp(law, (z,), (z,))
        return -left, size, inputs

    return jax.vmap(one)(data)


def _law(knowledge: System, data: Samples, options: StructuredOptions) -> tuple[list[Offer], list[Target]]:
    left, size, inputs = (np.asarray(part) for part in _law_residual(knowledge, data))
    fields = knowledge.z_layout.fields
    layout = Layout(*fields, *((f"{name}_t", *rest) for name, *rest in fields))
    offers = [
        Offer(expansion(layout, inputs, dict.fromkeys(layout.names, forms), left.shape[1]), inputs)
        for forms in ((LINEAR, CURVED) if options.curved else (LINEAR,))
    ]
    floors = _floors(knowledge.z_layout, size)
    spots = [knowledge.z_layout.slice(field.name) for field in fields]
    # nonlinear in the strain itself and its rate only; other strains have a linear coupling
    targets = [
        Target(left[:, spot], None, floors[spot], (field.name, f"{field.name}_t"))
        for field, spot in zip(fields, spots, strict=True)
    ]
    return offers, targets


# the loads


class _Views(NamedTuple):
    """Inputs of loads at every sample, and A + c0 B if B is not zero."""

    material: Float[Any, "S o"]
    ambient: Float[Any, "S a"]
    matrix: Any


class Points(NamedTuple):
    """Points along the rod (P) where the equations are evaluated."""

    s: Float[Any, " P"]
    t: Float[Any, " P"]
    c0: Float[Any, " P"]
    y: Float[Any, "P y"]
    z: Float[Any, "P z"]
    control: Float[Any, "P c"]
    history: Float[Any, "P x"]


def starts_of(knowledge: System, data: Samples) -> Points:
    """Return the starts of all segments."""
    s = start_of(knowledge, data.place)
    return Points(s, data.t, data.c0, data.y, data.z, data.control, data.history[:, 0])


def _points(knowledge: System, residual: Structured, data: Samples, space: SpaceScheme) -> Points:
    """Return the starts of all segments and, if the scheme uses them and has no stages, then their ends."""
    starts = starts_of(knowledge, data)
    if space.formula.stages or not space.implicit:
        return starts
    s, z = end_of(knowledge, data.place), data.z_next
    if knowledge.cuts:
        # z is known on the far side of a discontinuity; on the near side it is that of the corrected law
        near = _near_strains(knowledge, residual, s, data)
        nodes = knowledge.nodes - 1
        on_cut = np.min(
            np.abs(np.asarray(knowledge.cuts) * nodes - (data.place[:, None] * nodes + 1.0)), axis=1
        )
        z = np.where(on_cut[:, None] < ON_NODE, np.asarray(near), z)
    ends = Points(s, data.t, data.c0, data.y_next, z, data.control, data.history[:, 1])
    return Points(*(np.concatenate(each) for each in zip(starts, ends, strict=True)))


@jax.jit
def _near_strains(knowledge: System, residual: Structured, s: Any, data: Samples) -> Any:
    def one(s: Any, sample: Samples) -> Any:
        history = unpacked_history(knowledge, sample.c0, sample.history[1])
        return residual.strains(knowledge, Point(s, sample.t, sample.y_next, sample.control, history))

    return jax.vmap(one)(s, data)


def _point(knowledge: System, row: Points) -> Point:
    history = unpacked_history(knowledge, row.c0, row.history)
    return Point(row.s, row.t, row.y, row.control, history)


@jax.jit
def _views(knowledge: System, points: Points) -> _Views:
    def one(row: Points) -> Any:
        point, z = _point(knowledge, row), row.z
        z_t = point.history.z_t(z)
        observables = knowledge.observed.observables(point.s, point.y, point.y_t, z, z_t, point.control)
        matrix = None
        if knowledge.mixed:
            matrix = semi_discrete.load_matrix(knowledge, point, z)
        ambient = ambient_inputs(knowledge, point.control)
        return _Views(jnp.concatenate([observables, ambient]), ambient, matrix)

    return jax.vmap(one)(points)


@jax.jit
def _rates(knowledge: System, points: Points) -> Any:
    """Return y_s of the nominal model at the true strains."""

    def one(row: Points) -> Any:
        return semi_discrete.rates(knowledge, _point(knowledge, row), row.z)

    return jax.vmap(one)(points)


def _with_loads(seen: _Seen, residual: Structured, counting: Counting) -> Structured:
    """Return the residual with its stretch and its loads."""
    knowledge, data, along = seen.strand, seen.data, seen.along(residual)
    length, rates, moved = float(knowledge.length), along.rates, seen.moved
    if seen.linear:
        # y at the ends gives the mean rate only where no discontinuity is inside
        counts = counting.shares * whole(knowledge, data.segments.place)
        if np.any(counts):
            counting = counting._replace(shares=counts / np.mean(counts))
    longer = _longer(knowledge, moved, rates, counting.shares)
    missing = moved / longer - rates
    if knowledge.mixed:
        matrix = mean_of_ends(along.views.matrix, len(missing))
        missing = np.einsum("sij,sj->si", matrix, missing)
    ds = length / (knowledge.nodes - 1)
    floors = _floors(knowledge.y_layout, np.abs(rates) + np.abs(moved))
    floors = np.maximum(floors, TOLERANCE * np.asarray(knowledge.scales().y) / ds)
    where = knowledge.y_layout.indices(along.sides.layout.names)
    least = floors if seen.linear else np.maximum(floors, data.doubt / length)
    load = _load(along.sides, missing[:, where], least[where], counting)
    residual = dataclasses.replace(residual, stretch=np.array(longer - 1.0), load=load)
    # with two ends: strains on the near side of discontinuities, and the mean of A + c0 B, are not exact
    if seen.linear and not (data.space.implicit and (knowledge.cuts or knowledge.mixed)):
        return residual
    return polished(knowledge, data, residual, ds * floors, counting.shares)


def _longer(knowledge: System, moved: Any, rates: Any, shares: Any) -> float:
    """Return the ratio of the rod's length to the nominal length, from the geometric rates."""
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
    """Return the candidate expansions of a load: a simple one, and a nonlinear one if `curved`."""
    stated = knowledge.observed.velocities or knowledge.observed.layout.names
    simple: dict[str, Sequence[str]] = dict.fromkeys(knowledge.observed.velocities, DRAG)
    rich: dict[str, Sequence[str]] = dict.fromkeys(stated, CURVED)
    return [
        expansion(inputs, views.material, forms, layout.size)
        for forms in ([simple, rich] if curved else [simple])
    ]


def _load(sides: _Sides, missing: Any, floors: Any, counting: Counting) -> Load | None:
    """Return the load that explains the missing loads (S, l)."""
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
    """Return the rotation matrices (S, 3, 3) of each field in a rotated frame."""
    found = {
        name: np.asarray(_turns()(knowledge.y_layout.get(y, name)))
        for name in {field.frame for field in layout.fields if field.frame}
    }
    return {field.name: found[field.frame] for field in layout.fields if field.frame}


# the tip


@jax.jit
def _at_tip(adapted: System, data: TipSamples) -> tuple[Any, _Views]:
    """Return the residual of the conditions at the true tip, and the inputs of a load there."""

    def one(sample: TipSamples) -> Any:
        history = unpacked_history(adapted, sample.c0, sample.history)
        left = semi_discrete.tip(adapted, sample.t, sample.control, sample.y, history)
        observables = tip_observables(adapted, sample.y, history.y_t(sample.y), sample.control)
        ambient = ambient_inputs(adapted, sample.control)
        return left, _Views(jnp.concatenate([observables, ambient]), ambient, None)

    return jax.vmap(one)(data)


def _tip_load(seen: _Seen, residual: Structured, counting: Counting) -> Load | None:
    knowledge, tips = seen.knowledge, seen.data.tips
    left, views = jax.tree.map(np.asarray, _at_tip(residual.adapted(knowledge), tips))
    sides = _sides(knowledge, knowledge.ends.layout, tips.y, views, curved=False)
    return _load(sides, -left, TOLERANCE * np.asarray(knowledge.scales().tip), counting)
