"""The structured residual from trajectories, by least squares: material, stretch, loads and tip.

At the true states every part is linear in its weights. The residual of the constitutive law at the true
strains gives the stress, the geometry of the samples gives the stretch, and the residual of the balance
gives the loads. A scheme without stages (Euler's, the trapezoidal rule) is linear in the rates at a segment's
ends, and so in the weights. For others y_s comes from splines, and the weights are then refined on the
segments.

Simple functions come first. A field that they do not explain may also take nonlinear ones, selected by
held-out error. Every vector field is one regression: loads in the material frame and ambient loads in the
global frame are found together.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Float

from knode_cosserat.learning.config import StructuredOptions
from knode_cosserat.learning.knode import KNODE
from knode_cosserat.learning.structured import regression
from knode_cosserat.learning.structured.residual import (
    CURVED,
    DRAG,
    LINEAR,
    Expansion,
    Load,
    Structured,
    expansion,
    loaded,
    material_layout,
    tip_observables,
)
from knode_cosserat.rods.aspects import Ends, Observed
from knode_cosserat.rods.layout import Layout
from knode_cosserat.rods.parts import RodPoint
from knode_cosserat.rods.strands import strand_of
from knode_cosserat.rods.system import System, unknowns_of
from knode_cosserat.rods.wrapped import with_length_factor
from knode_cosserat.rotation import rotation_matrix
from knode_cosserat.schemes import semi_discrete
from knode_cosserat.schemes.grid import ON_NODE
from knode_cosserat.schemes.space import SpaceScheme
from knode_cosserat.solvers.segments import (
    Dataset,
    Samples,
    TipSamples,
    end_point,
    predict_segment,
    rows_are_states,
    samples,
    start_point,
    strand_samples,
    tip_point,
    undivided,
)
from knode_cosserat.trajectory import Trajectory

#: number of repeated solves with states between nodes: each reduces the error to a hundredth
ROUNDS = 2
#: smaller relative values are the solver's tolerance, not a load
LEAST = 1e-9
#: the solver's tolerance, in natural units, with some room
TOLERANCE = 3e-10
#: a remainder below this part of the target is explained well enough by the simple functions
WELL = 1e-6
#: nonlinear functions are used if their held-out squared error is below this part of the simple ones'
WORTH = 0.8
#: largest number of Gauss-Newton corrections on the segments
MOST_CORRECTIONS = 8


def residuals_of(
    knowledge: System, trajectories: Sequence[Trajectory], options: StructuredOptions, seeds: Sequence[int]
) -> list[Structured]:
    """Return the structured residuals that explain the trajectories, one for each seed.

    Trajectories hold the nodes only. A scheme with stages between nodes also needs earlier states there. They
    are interpolated at first, and evaluated by the fitted model if the trajectories were simulated.

    Raises:
        DataError: a trajectory does not fit the knowledge or the others, is too short or not finite.
    """
    residuals = _solved(knowledge, samples(knowledge, trajectories), options, seeds)
    for _ in range(0 if rows_are_states(knowledge, trajectories) else ROUNDS):
        models = [KNODE(knowledge, residual) for residual in residuals]
        again = [samples(knowledge, trajectories, model=model) for model in models]
        residuals = [
            _solved(knowledge, data, options, (seed,))[0] for data, seed in zip(again, seeds, strict=True)
        ]
    return residuals


def _solved(
    knowledge: System, data: Dataset, options: StructuredOptions, seeds: Sequence[int]
) -> list[Structured]:
    """Return one residual for each seed, which only determines the row weights if rows are resampled."""
    shared = _Regressions(knowledge, strand_samples(knowledge, data), options)
    if options.resample:
        return [shared.residual(seed) for seed in seeds]
    return [shared.residual(seeds[0])] * len(seeds)


class _Counting(NamedTuple):
    """Sample weights (on average one) and cross-validation folds."""

    shares: Float[Any, " S"]
    fold: Any


class _Views(NamedTuple):
    """Inputs of loads at every sample, A + c0 B if B is not zero, and the factor of the loads."""

    material: Float[Any, "S o"]
    ambient: Float[Any, "S a"]
    matrix: Any
    factor: Any


class _Sides(NamedTuple):
    """Layout of a load, its features, and the rotations (S, 3, 3) of its fields."""

    layout: Layout
    material: list[_Offer]
    ambient: _Offer
    frames: dict[str, Any]


class _Regressions:
    """Targets and features, which do not depend on sample weights. Segments are those of single strands."""

    def __init__(self, knowledge: System, data: Dataset, options: StructuredOptions):
        self.knowledge, self.data, self.options = knowledge, data, options
        #: the strand, whose law is learned along the rod
        self.strand = strand_of(knowledge)
        #: True if y at the end of a segment is linear in the rates at its ends
        self.linear = not data.space.formula.stages
        self._along: tuple[_Views, Any, _Sides] | None = None
        self._laws: dict[float, tuple[list[_Offer], list[_Target]]] = {}

    def residual(self, seed: int) -> Structured:
        """Return the residual of one seed."""
        segments, tips = (self._counting(part, seed) for part in (self.data.segments, self.data.tips))
        residual = Structured(np.zeros(()), None, None, None)
        # the law may depend on the length, and strains before a discontinuity on the law
        for _ in range(2 if self.strand.discontinuities.places else 1):
            residual = self._with_stress(self._with_length(residual, segments), segments)
        residual = self._with_loads(residual, segments)
        residual = dataclasses.replace(residual, at_base=self._at_base(residual, segments))
        tip, views = jax.tree.map(np.asarray, _at_tip(residual.adapted(self.knowledge), self.data.tips))
        sides = _sides(self.knowledge, Ends.of(self.knowledge).layout, self.data.tips.y, views, curved=False)
        load = _load(sides, -tip, TOLERANCE * np.asarray(self.knowledge.scales().tip), tips)
        return dataclasses.replace(residual, tip_load=load)

    def _at_base(self, residual: Structured, counting: _Counting) -> Expansion | None:
        """Return the change of the law at the base."""
        aspect, data = Observed.of(self.knowledge), self.data.segments
        if not aspect.base_law:
            return None
        first, parts = data.place == 0.0, ((data.t, data.control, data.y), counting)
        at_base, counts = jax.tree.map(lambda values: values[first], parts)
        missing, inputs = map(np.asarray, _base_law(residual.adapted(self.knowledge), *at_base))
        offer = _Offer(expansion(aspect.base_layout, inputs, {}, missing.shape[1]), inputs)
        target = _Target(missing, None, np.full(missing.shape[1], TOLERANCE))
        return _best([offer], np.ones((len(missing), 1)), [target], counts)[0]

    def _counting(self, data: Samples | TipSamples, seed: int) -> _Counting:
        shares = data.weight
        if self.options.resample:  # random weights of rows (Bayesian bootstrap)
            rows, which = np.unique(data.origin, axis=0, return_inverse=True)
            shares = shares * np.random.default_rng(seed).exponential(size=len(rows))[which.ravel()]
        return _Counting(shares / np.mean(shares), regression.folds(data.origin))

    def _with_stress(self, residual: Structured, counting: _Counting) -> Structured:
        """Return the residual with its stress, of the constitutive law."""
        stretch = float(residual.stretch)
        # seeds with the same length share them
        if stretch not in self._laws:
            self._laws = {stretch: self._law(stretch)}
        offers, targets = self._laws[stretch]
        stress, _ = _best(offers, np.ones((len(counting.shares), 1)), targets, counting)
        return dataclasses.replace(residual, stress=stress)

    def _law(self, stretch: float) -> tuple[list[_Offer], list[_Target]]:
        """Return features and targets of the constitutive law."""
        strand = with_length_factor(self.strand, 1.0 + stretch)
        values, size, inputs = map(np.asarray, _law_residual(strand, self.data.segments))
        layout, both = strand.z_layout, Observed.of(strand).law_layout
        offers = [
            _Offer(expansion(both, inputs, dict.fromkeys(both.names, forms), layout.size), inputs)
            for forms in ((LINEAR, CURVED) if self.options.curved else (LINEAR,))
        ]
        floors = _floors(layout, size)
        # nonlinear in the strain itself and its rate only; other strains have a linear coupling
        targets = [
            _Target(values[:, where], None, floors[where], (name, f"{name}_t"))
            for name in layout.names
            for where in [layout.slice(name)]
        ]
        return offers, targets

    def along(self, residual: Structured) -> tuple[_Views, Float[Any, "S y"], _Sides]:
        """Return inputs, y_s and features at the ends of segments, by the law and length of a residual.

        The points are the starts of all segments and, if the scheme uses them, then their ends.
        """
        if self._along is None or residual.stretch or self.strand.discontinuities.places:
            strand = residual.adapted(self.strand)
            points, z = _points(strand, residual, self.data)
            views: _Views = jax.tree.map(np.asarray, _views(strand, points, z))
            rates = mean_of_ends(np.asarray(_rates(strand, points, z)), len(self.data.segments.t))
            sides = _sides(strand, loaded(strand), points.y, views, self.options.curved)
            self._along = views, rates, sides
        return self._along

    def _moved(self, counting: _Counting) -> tuple[Float[Any, "S y"], _Counting]:
        """Return the mean y_s of the segments by the nominal length, and the samples that count."""
        segments, length, nodes = self.data.segments, float(self.strand.length), self.strand.nodes
        if not self.linear:
            return np.asarray(segments.slope) / length, counting
        # y at the ends gives the mean rate only where no discontinuity is inside
        counts = counting.shares * undivided(self.strand, segments.place)
        if np.any(counts):
            counting = counting._replace(shares=counts / np.mean(counts))
        return (segments.y_next - segments.y) * ((nodes - 1) / length), counting

    def _with_length(self, residual: Structured, counting: _Counting) -> Structured:
        """Return the residual with its change of length, by the geometry alone."""
        moved, counting = self._moved(counting)
        strand = residual.adapted(self.strand)
        points, z = _points(strand, residual, self.data)
        factor, before = 1.0, 1.0 + float(residual.stretch)
        for _ in range(MOST_CORRECTIONS):
            values = _by_length(strand, points, z, factor)
            rates, slopes = (mean_of_ends(np.asarray(part), len(moved)) for part in values)
            change = _longer(strand, moved / before - rates, slopes, counting.shares)
            factor += change
            if abs(change) < LEAST:
                break
        return dataclasses.replace(residual, stretch=np.array(factor * before - 1.0))

    def _with_loads(self, residual: Structured, counting: _Counting) -> Structured:
        """Return the residual with its loads."""
        knowledge, data, (views, rates, sides) = self.strand, self.data, self.along(residual)
        moved, counting = self._moved(counting)
        length = float(residual.adapted(knowledge).length)
        ds = length / (knowledge.nodes - 1)
        moved = moved / (1.0 + residual.stretch)
        missing = moved - rates
        if knowledge.mixed:
            missing = np.einsum("sij,sj->si", mean_of_ends(views.matrix, len(missing)), missing)
        missing = missing / views.factor[: len(missing), None]
        floors = _floors(knowledge.y_layout, np.abs(rates) + np.abs(moved))
        floors = np.maximum(floors, TOLERANCE * np.asarray(knowledge.scales().y) / ds)
        where = knowledge.y_layout.indices(sides.layout.names)
        least = floors if self.linear else np.maximum(floors, data.doubt / length)
        load = _load(sides, missing[:, where], least[where], counting)
        residual = dataclasses.replace(residual, load=load)
        # with two ends: strains on the near side of discontinuities, and the mean of A + c0 B, are not exact
        if self.linear and not (
            data.space.implicit and (knowledge.discontinuities.places or knowledge.mixed)
        ):
            return residual
        return _polished(knowledge, data, residual, np.sqrt(counting.shares)[:, None] / (ds * floors))


# values at the samples


@jax.jit
def _law_residual(knowledge: System, data: Samples) -> tuple[Any, Any, Any]:
    """Return minus the residual of the law at the true strains, its size, and the inputs of stress."""

    def one(sample: Samples) -> Any:
        point, z = start_point(knowledge, sample), sample.z
        inputs = Observed.of(knowledge).law_inputs(point.s, point.y, point.control)(z, point.z_t(z))
        # the derivative along z gives the size of the law's terms
        residual, size = jax.jvp(functools.partial(semi_discrete.law_residual, knowledge, point), (z,), (z,))
        return -residual, size, inputs

    return jax.vmap(one)(data)


def _points(knowledge: System, residual: Structured, data: Dataset) -> tuple[Any, Any]:
    """Return points and strains at the starts of all segments and, if the scheme uses them, then the ends."""
    segments, formula = data.segments, data.space.formula
    starts = jax.vmap(lambda sample: start_point(knowledge, sample))(segments), segments.z
    if formula.stages or not data.space.implicit:
        return starts
    ends = jax.vmap(lambda sample: end_point(knowledge, sample))(segments), segments.z_next
    if knowledge.discontinuities.places:
        # z is known on the far side of a discontinuity; on the near side it is that of the corrected law
        near = _corrected_strains(KNODE(knowledge, dataclasses.replace(residual, load=None)), ends[0])
        nodes = knowledge.nodes - 1
        away = np.abs(
            np.asarray(knowledge.discontinuities.places) * nodes - (segments.place[:, None] * nodes + 1.0)
        )
        on_cut = np.min(away, axis=1)[:, None] < ON_NODE
        ends = ends[0], np.where(on_cut, np.asarray(near), segments.z_next)
    return jax.tree.map(lambda *parts: np.concatenate(parts), starts, ends)


_rotations = jax.jit(jax.vmap(rotation_matrix))


_corrected_strains = jax.jit(jax.vmap(semi_discrete.strains, in_axes=(None, 0)))
#: y_s of the nominal model at the true strains
_rates = jax.jit(jax.vmap(semi_discrete.rates, in_axes=(None, 0, 0)))


@jax.jit
def _views(knowledge: System, points: Any, z: Any) -> _Views:
    def one(point: Any, z: Any) -> Any:
        aspect = Observed.of(knowledge)
        observables = aspect.observables(
            RodPoint(knowledge, point.s, point.t, point.y, point.y_t, point.control, z=z, z_t=point.z_t(z))
        )
        matrix = semi_discrete.load_matrix(knowledge, point, z) if knowledge.mixed else None
        ambient, factor = aspect.ambient(point.s, point.control), aspect.load_factor(point.s, point.control)
        return _Views(jnp.concatenate([observables, ambient]), ambient, matrix, factor)

    return jax.vmap(one)(points, z)


@jax.jit
def _base_law(adapted: System, t: Any, control: Any, y: Any) -> tuple[Any, Any]:
    """Return the change of what follows by a law at the base, and the arguments of the law."""
    aspect = Observed.of(adapted)

    def one(t: Any, control: Any, y: Any) -> Any:
        change = y - adapted.base(t, control, unknowns_of(adapted, y))
        return change[adapted.y_layout.indices(aspect.base_law)], aspect.base_inputs(y, control)

    return jax.vmap(one)(t, control, y)


@jax.jit
def _at_tip(adapted: System, data: TipSamples) -> tuple[Any, _Views]:
    """Return the residual of the conditions at the true tip, and the inputs of a load there."""

    def one(sample: TipSamples) -> Any:
        point = tip_point(adapted, sample)
        conditions = adapted.tip(point.t, point.control, point.y, point.y_t)
        observables = tip_observables(adapted, point.y, point.y_t, point.control)
        ambient = Observed.of(adapted).ambient(point.s, point.control)
        return conditions, _Views(jnp.concatenate([observables, ambient]), ambient, None, 1.0)

    return jax.vmap(one)(data)


def _sides(system: System, layout: Layout, y: Any, views: _Views, curved: bool) -> _Sides:
    """Return the material and ambient features of a load of this layout, and its frames."""
    stated = Observed.of(system).velocities or Observed.of(system).layout.names
    forms: list[dict[str, Any]] = [
        dict.fromkeys(Observed.of(system).velocities, DRAG),
        dict.fromkeys(stated, CURVED),
    ]
    inputs = material_layout(system)
    material = [
        _Offer(expansion(inputs, views.material, form, layout.size), views.material)
        for form in forms[: 2 if curved else 1]
    ]
    ambient = expansion(Observed.of(system).ambient_layout, views.ambient, {}, layout.size)
    rotations = {
        name: np.asarray(_rotations(jnp.asarray(system.y_layout.get(y, name))))
        for name in {field.frame for field in layout.fields if field.frame}
    }
    frames = {field.name: rotations[field.frame] for field in layout.fields if field.frame}
    return _Sides(layout, material, _Offer(ambient, views.ambient), frames)


def _load(sides: _Sides, missing: Any, floors: Any, counting: _Counting) -> Load | None:
    """Return the load that explains the missing loads (S, l), from observables and inputs."""
    targets = [
        _Target(missing[:, where], sides.frames.get(name), floors[where])
        for name in sides.layout.names
        for where in [sides.layout.slice(name)]
    ]
    material, weights = _best(sides.material, sides.ambient.features, targets, counting)
    ambient = dataclasses.replace(sides.ambient.part, weights=np.concatenate(weights)).pruned()
    return None if material is None and ambient is None else Load(material, ambient)


def _floors(layout: Layout, values: Float[Any, "S n"]) -> Float[Any, " n"]:
    """Return the noise floor of each number, a small part of its field's rms."""
    floors = np.zeros(layout.size)
    for field in layout.fields:
        where = layout.slice(field.name)
        floors[where] = LEAST * np.sqrt(np.mean(np.square(values[:, where])))
    return np.maximum(floors, 1e-300)


@jax.jit
def _by_length(knowledge: System, points: Any, z: Any, factor: Any) -> tuple[Any, Any]:
    """Return y_s by the nominal length of a rod with its length times a factor, and the derivative by it."""

    def rates(factor: Any) -> Any:
        longer = with_length_factor(knowledge, factor)
        there = points._replace(s=factor * points.s)
        return factor * jax.vmap(semi_discrete.rates, in_axes=(None, 0, 0))(longer, there, z)

    return jax.jvp(rates, (factor,), (jnp.ones(()),))


def _longer(knowledge: System, missing: Any, slopes: Any, shares: Any) -> float:
    """Return the change of a length factor that explains missing geometric rates; 0 within their noise."""
    changes, precisions = [], []
    for name in knowledge.y_layout.names:
        if name in loaded(knowledge).names:
            continue
        where = knowledge.y_layout.slice(name)
        r, d = slopes[:, where], missing[:, where]
        size = np.sum(shares[:, None] * r * r)
        if size > 0.0:
            change = np.sum(shares[:, None] * r * d) / size
            remainder = np.sum(shares[:, None] * (d - change * r) ** 2) / d.size
            changes.append(change)
            precisions.append(1.0 / (remainder / size + LEAST**2))
    if not changes:
        return 0.0
    change = float(np.average(changes, weights=precisions))
    return change if abs(change) > 5.0 / np.sqrt(np.sum(precisions)) else 0.0


# regressions of a load or a stress


class _Target(NamedTuple):
    """One target field of a regression: its values, and the floors below which they are noise.

    `turn` has the rotation matrices from the material frame to the values' frame, at every point; None if
    the frames are the same. A sample may have several points, in blocks: a value is the mean load over them.
    """

    values: Float[Any, "S n"]
    turn: Any
    floors: Float[Any, " n"]
    #: names of the vectors with nonlinear functions; None: all
    curved: tuple[str, ...] | None = None


def mean_of_ends(values: Float[np.ndarray, "P ..."], count: int) -> Float[np.ndarray, "S ..."]:
    """Return the mean over the points of each sample; the first points of all samples come first."""
    return values if len(values) == count else values.reshape(-1, count, *values.shape[1:]).mean(axis=0)


class _Offer:
    """An expansion with unknown weights, and its inputs at every point."""

    def __init__(self, part: Expansion, inputs: Float[Any, "P x"]):
        self.part, self.inputs = part, inputs

    @functools.cached_property
    def features(self) -> Float[np.ndarray, "P k"]:
        """Values of the functions; independent of sample weights, so that seeds share them."""
        return np.asarray(_features_of(self.part, self.inputs))

    def with_slopes(self, slopes: Any) -> _Offer:
        """Return a copy with other slopes."""
        return _Offer(dataclasses.replace(self.part, slopes=slopes), self.inputs)


_features_of = eqx.filter_jit(lambda part, inputs: jax.vmap(part.features)(inputs))


class _Fit(NamedTuple):
    """Weights of the material and the ambient features (n, k), and the remainder."""

    material: Float[Any, "n k"]
    ambient: Float[Any, "n a"]
    #: remainder of each regression (rms)
    remainder: list[float]
    #: true for columns of the problem with a weight
    used: Any


class _Problem:
    """A target with its features as the columns of one regression of all its numbers, or one for each.

    Without rotation every number (n,) has its own regression on the same columns: the material features, and
    the ambient features without the constant, which is already a material feature. With rotation there is one
    regression; a column is a feature of one of the material's numbers, or an ambient one.
    """

    def __init__(self, target: _Target, material: Any, ambient: Any, counting: _Counting):
        self.target, self.ambient, self.size = target, ambient, target.values.shape[1]
        self.turned, self.count = target.turn is not None, material.shape[1]
        self.columns = self.arranged(material)
        self.values, self.floors, (self.shares, self.fold) = target.values, target.floors, counting
        if self.turned:
            self.shares, self.fold = (np.repeat(part, self.size) for part in counting)
            self.values = target.values.reshape(-1, 1)
            self.floors = np.array([target.floors.max()])

    def arranged(self, material: Any) -> Any:
        """Return the columns, from the material features (P, k)."""
        count = len(self.target.values)
        if not self.turned:
            return mean_of_ends(np.concatenate([material, self.ambient[:, 1:]], axis=1), count)
        turned = [self.target.turn[:, :, j, None] * material[:, None, :] for j in range(self.size)]
        still = [np.eye(self.size)[:, i, None] * self.ambient[:, None, :] for i in range(self.size)]
        columns = mean_of_ends(np.concatenate([*turned, *still], axis=2), count)
        return columns.reshape(-1, columns.shape[2])

    def mask(self, material: Any, ambient: Any = None) -> Any:
        """Return the columns of material features (k,) and of nonzero ambient weights (n, a)."""
        if ambient is None:
            ambient = np.zeros((self.size, self.ambient.shape[1]))
        if not self.turned:
            return np.concatenate([material, np.any(ambient[:, 1:] != 0.0, axis=0)])
        return np.concatenate([np.tile(material, self.size), (ambient != 0.0).ravel()])

    def solved(self, among: Any = None) -> _Fit:
        """Return the fit with these columns (by default all)."""
        among = np.ones(self.columns.shape[1], dtype=bool) if among is None else among
        weights = np.zeros((len(self.floors), len(among)))
        weights[:, among], remainder = regression.relevant(
            self.columns[:, among], self.values, self.floors, self.shares
        )
        if self.turned:
            parts = np.split(weights[0], [self.size * self.count])
            material, ambient = (part.reshape(self.size, -1) for part in parts)
        else:
            material, ambient = weights[:, : self.count], np.insert(weights[:, self.count :], 0, 0.0, axis=1)
        return _Fit(material, ambient, remainder, np.any(weights != 0.0, axis=0))

    def unexplained(self, fit: _Fit) -> float:
        """Return the remainder relative to the target; zero at the floor."""
        if max(fit.remainder) <= 3.0 * self.floors.max():
            return 0.0
        return max(fit.remainder) / float(np.sqrt(np.mean(self.values**2)))

    def selected(self, part: Expansion, simple: Any) -> Any:
        """Return the columns with the least held-out error; None if `simple` columns are nearly as good.

        Columns of a term are selected together: each allowed one, and each ambient feature.
        """
        allowed, features = self.target.curved, np.arange(self.count)
        terms = [
            where for term, where in part.columns()
            if term.form == "linear" or allowed is None or term.name in allowed
        ]  # fmt: skip
        groups = [np.flatnonzero(self.mask(np.isin(features, where))) for where in [range(1), *terms]]
        ambient = np.arange(self.count * (self.size if self.turned else 1), self.columns.shape[1])
        groups += [ambient] if len(ambient) else []
        root = np.sqrt(self.shares)[:, None]
        parts = regression.moments(self.columns * root, self.values * root, self.fold)
        floor = float(np.mean(np.square(self.floors))) * self.values.size
        best, error = regression.selected_groups(parts, groups, floor)
        if error > WORTH * regression.held_out_error(parts, np.flatnonzero(simple)):
            return None
        return np.isin(np.arange(self.columns.shape[1]), np.concatenate([[-1], *(groups[k] for k in best)]))


def _best(
    candidates: Sequence[_Offer], ambient: Any, targets: Sequence[_Target], counting: _Counting
) -> tuple[Expansion | None, list[Any]]:
    """Return the expansion of the fields' best fits, and their ambient weights."""
    simple, rich = candidates[0], candidates[-1]
    problems = [_Problem(target, simple.features, ambient, counting) for target in targets]
    fits = [problem.solved() for problem in problems]
    needy = [k for k, fit in enumerate(fits) if problems[k].unexplained(fit) > WELL]
    if not needy:
        full = dataclasses.replace(simple.part, weights=np.concatenate([fit.material for fit in fits]))
        return full.pruned(), [fit.ambient for fit in fits]
    materials = [np.zeros((len(fit.material), rich.features.shape[1])) for fit in fits]
    for wider, fit in zip(materials, fits, strict=True):
        wider[:, rich.part.columns_of(simple.part)] = fit.material
    selections: dict[int, Any] = {}
    for k in needy:
        problem = _Problem(targets[k], rich.features, ambient, counting)
        known = problem.mask(np.any(materials[k] != 0.0, axis=0), fits[k].ambient)
        columns = problem.selected(rich.part, known)
        if columns is not None:
            selections[k] = columns
    if selections:
        rich = _with_slopes(rich, ambient, targets, selections, counting)
        for k, columns in selections.items():
            fits[k] = _Problem(targets[k], rich.features, ambient, counting).solved(columns)
            materials[k] = fits[k].material
    full = dataclasses.replace(rich.part, weights=np.concatenate(materials))
    return full.pruned(), [fit.ambient for fit in fits]


def _with_slopes(
    rich: _Offer, ambient: Any, targets: Sequence[_Target], selections: dict[int, Any], counting: _Counting
) -> _Offer:
    """Return `rich` with refined slopes of the saturating functions, fitted on the worst explained field."""
    part = rich.part
    if not part.slopes.size:
        return rich
    problems = {k: _Problem(targets[k], rich.features, ambient, counting) for k in selections}
    fits = {k: problem.solved(selections[k]) for k, problem in problems.items()}
    worst = max(fits, key=lambda k: problems[k].unexplained(fits[k]))
    problem, fit = problems[worst], fits[worst]
    root = np.sqrt(problem.shares)

    def build(slopes: Any) -> Any:
        return (problem.arranged(rich.with_slopes(slopes).features) * root[:, None])[:, fit.used]

    owners = {term.slope: (term, where) for term, where in part.columns() if term.slope >= 0}
    features = np.arange(problem.count)
    free = [k for k in sorted(owners) if np.any(problem.mask(np.isin(features, owners[k][1])) & fit.used)]
    kinds = [(owners[k][0].name, owners[k][0].form) for k in free]
    target = problem.values[:, int(np.argmax(fit.remainder))] * root
    return rich.with_slopes(regression.refined_slopes(build, target, part.slopes, free, kinds))


# refinement on the segments


def _polished(knowledge: System, data: Dataset, residual: Structured, root: Float[Any, "S y"]) -> Structured:
    """Return the residual with its nonzero stretch and load weights refined to fit y at the segments' ends.

    With stages, or a discontinuity inside a segment, y at its end is not linear in the weights; they are
    corrected by Gauss-Newton. `root` (S, y) are the weights of the misfit.
    """
    flat, _ = ravel_pytree(jax.tree.map(jnp.asarray, _movable(residual)))
    free = np.flatnonzero(np.asarray(flat))
    if not len(free):
        return residual
    best, kept = np.inf, residual
    for _ in range(MOST_CORRECTIONS):
        misfit, slopes = _linearised(knowledge, residual, data.space, data.segments, free)
        misfit = np.asarray(misfit) * root
        error = float(np.sqrt(np.mean(misfit**2)))
        if not error < 0.9 * best:
            break
        best, kept = error, residual
        columns = (np.asarray(slopes) * root).reshape(len(free), -1).T
        move, *_ = np.linalg.lstsq(columns, misfit.ravel(), rcond=1e-14)
        residual = _moved(residual, free, move)
    return kept


def _movable(residual: Structured) -> list[Any]:
    load = residual.load
    parts = (
        [] if load is None else [part.weights for part in (load.material, load.ambient) if part is not None]
    )
    return [residual.stretch, *parts]


def _moved(residual: Structured, free: Any, move: Any) -> Structured:
    flat, unravel = ravel_pytree(jax.tree.map(jnp.asarray, _movable(residual)))
    return eqx.tree_at(_movable, residual, unravel(flat.at[free].add(move)))


@functools.partial(jax.jit, static_argnames="space")
def _linearised(
    knowledge: System, residual: Structured, space: SpaceScheme, data: Samples, free: Any
) -> tuple[Any, Any]:
    """Return the misfit of the segments (S, y), and the derivatives of y by each free weight (w, S, y)."""

    def predicted(move: Any) -> Any:
        model = KNODE(knowledge, _moved(residual, free, move))
        return jax.vmap(lambda sample: predict_segment(model, space, sample)[0])(data)

    here, along = jax.linearize(predicted, jnp.zeros(free.shape[0]))
    return data.y_next - here, jax.vmap(along)(jnp.eye(free.shape[0]))
