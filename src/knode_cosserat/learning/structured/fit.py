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
from collections.abc import Mapping, Sequence
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
    is_undivided,
    predict_segment,
    rows_are_states,
    samples,
    start_point,
    strand_samples,
    tip_point,
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
#: largest number of Gauss-Newton corrections of the length, or on the segments
MOST_CORRECTIONS = 8


def residuals_of(
    knowledge: System, trajectories: Sequence[Trajectory], options: StructuredOptions, seeds: Sequence[int]
) -> list[Structured]:
    """Return the structured residuals that explain the trajectories, one for each seed.

    The seed only determines the row weights, if rows are resampled. Trajectories hold the nodes only. A
    scheme with stages between nodes also needs earlier states there. They are interpolated at first, and
    evaluated by the fitted model if the trajectories were simulated.

    Raises:
        DataError: a trajectory does not fit the nominal model or the others, is too short or not finite.
    """
    rounds = 0 if rows_are_states(knowledge, trajectories) else ROUNDS
    data = strand_samples(knowledge, samples(knowledge, trajectories))
    residuals = []
    for seed in seeds if options.resample else seeds[:1]:
        residual = _Regression(knowledge, data, options, seed).residual()
        for _ in range(rounds):
            again = samples(knowledge, trajectories, model=KNODE(knowledge, residual))
            residual = _Regression(knowledge, strand_samples(knowledge, again), options, seed).residual()
        residuals.append(residual)
    return residuals if options.resample else residuals * len(seeds)


class _Counting(NamedTuple):
    """Sample weights (on average one) and cross-validation folds."""

    shares: Float[Any, " S"]
    fold: Any


def _counting(data: Samples | TipSamples, options: StructuredOptions, seed: int) -> _Counting:
    shares = data.weight
    if options.resample:  # random weights of rows (Bayesian bootstrap)
        rows, which = np.unique(data.origin, axis=0, return_inverse=True)
        shares = shares * np.random.default_rng(seed).exponential(size=len(rows))[which.ravel()]
    return _Counting(shares / np.mean(shares), regression.folds(data.origin))


class _Regression:
    """The residual of one seed, part by part. Segments are those of single strands."""

    def __init__(self, knowledge: System, data: Dataset, options: StructuredOptions, seed: int):
        self.knowledge, self.data, self.options = knowledge, data, options
        #: the strand, whose law is learned along the rod
        self.strand = strand_of(knowledge)
        self.counting, self.tip_counting = (
            _counting(part, options, seed) for part in (data.segments, data.tips)
        )
        #: True if y at the end of a segment is linear in the rates at its ends
        self.linear = not data.space.formula.stages

    def residual(self) -> Structured:
        """Return the residual."""
        residual = Structured(np.zeros(()), None, None, None)
        # the law may depend on the length, and strains before a discontinuity on the law
        for _ in range(2 if self.strand.discontinuities.places else 1):
            residual = dataclasses.replace(residual, stretch=self.stretch(residual))
            residual = dataclasses.replace(residual, stress=self.stress(residual))
        residual = self.with_loads(residual)
        residual = dataclasses.replace(residual, at_base=self.at_base(residual))
        return dataclasses.replace(residual, tip_load=self.tip_load(residual))

    def stretch(self, residual: Structured) -> Any:
        """Return the change of length that the geometry alone gives; 0 within its noise."""
        moved, counting = self._moved()
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
        return np.array(factor * before - 1.0)

    def stress(self, residual: Structured) -> Expansion | None:
        """Return the missing stress of the constitutive law."""
        strand = with_length_factor(self.strand, 1.0 + float(residual.stretch))
        values, size, inputs = map(np.asarray, _law_residual(strand, self.data.segments))
        layout, both = strand.z_layout, Observed.of(strand).law_layout
        simple: dict[str, Sequence[str]] = dict.fromkeys(both.names, LINEAR)
        curved = dict.fromkeys(both.names, CURVED) if self.options.curved else simple
        library = _Library(expansion(both, inputs, curved, layout.size), inputs, simple)
        floors = _floors(layout, size)
        # nonlinear in the strain itself and its rate only; other strains have a linear coupling
        targets = [
            _RegressionTarget(values[:, where], None, floors[where], (name, f"{name}_t"))
            for name in layout.names
            for where in [layout.slice(name)]
        ]
        return _fitted(library, None, targets, self.counting)[0]

    def with_loads(self, residual: Structured) -> Structured:
        """Return the residual with its loads."""
        data, layout = self.data, loaded(self.strand)
        strand = residual.adapted(self.strand)
        points, z = _points(strand, residual, data)
        views: _Views = jax.tree.map(np.asarray, _views(strand, points, z))
        rates = mean_of_ends(np.asarray(_rates(strand, points, z)), len(data.segments.t))
        moved, counting = self._moved()
        length = float(strand.length)
        ds = length / (strand.nodes - 1)
        moved = moved / (1.0 + residual.stretch)
        missing = moved - rates
        if strand.mixed:
            missing = np.einsum("sij,sj->si", mean_of_ends(views.matrix, len(missing)), missing)
        missing = missing / views.factor[: len(missing), None]
        floors = _floors(strand.y_layout, np.abs(rates) + np.abs(moved))
        floors = np.maximum(floors, TOLERANCE * np.asarray(strand.scales().y) / ds)
        where = strand.y_layout.indices(layout.names)
        least = floors if self.linear else np.maximum(floors, data.doubt / length)
        libraries = _libraries(strand, layout, views, self.options.curved)
        targets = _targets(strand, layout, points.y, missing[:, where], least[where])
        load = _load(*_fitted(*libraries, targets, counting))
        residual = dataclasses.replace(residual, load=load)
        # with two ends: strains on the near side of discontinuities, and the mean of A + c0 B, are not exact
        if self.linear and not (data.space.implicit and (strand.discontinuities.places or strand.mixed)):
            return residual
        return _polished(self.strand, data, residual, np.sqrt(counting.shares)[:, None] / (ds * floors))

    def at_base(self, residual: Structured) -> Expansion | None:
        """Return the change of the law at the base."""
        aspect, data = Observed.of(self.knowledge), self.data.segments
        if not aspect.base_law:
            return None
        first, parts = data.place == 0.0, ((data.t, data.control, data.y), self.counting)
        at_base, counting = jax.tree.map(lambda values: values[first], parts)
        missing, inputs = map(np.asarray, _base_law(residual.adapted(self.knowledge), *at_base))
        layout, size = aspect.base_layout, missing.shape[1]
        library = _Library(expansion(layout, inputs, {}, size), inputs, dict.fromkeys(layout.names, LINEAR))
        return _fitted(library, None, [_RegressionTarget(missing, None, np.full(size, TOLERANCE))], counting)[
            0
        ]

    def tip_load(self, residual: Structured) -> Load | None:
        """Return the missing load at the tip."""
        tip, views = jax.tree.map(np.asarray, _at_tip(residual.adapted(self.knowledge), self.data.tips))
        layout, floors = Ends.of(self.knowledge).layout, TOLERANCE * np.asarray(self.knowledge.scales().tip)
        libraries = _libraries(self.knowledge, layout, views, curved=False)
        targets = _targets(self.knowledge, layout, self.data.tips.y, -tip, floors)
        return _load(*_fitted(*libraries, targets, self.tip_counting))

    def _moved(self) -> tuple[Float[Any, "S y"], _Counting]:
        """Return the mean y_s of the segments by the nominal length, and the samples that count."""
        segments, length, nodes = self.data.segments, float(self.strand.length), self.strand.nodes
        if not self.linear:
            return np.asarray(segments.slope) / length, self.counting
        # y at the ends gives the mean rate only where no discontinuity is inside
        counting, counts = self.counting, self.counting.shares * is_undivided(self.strand, segments.place)
        if np.any(counts):
            counting = counting._replace(shares=counts / np.mean(counts))
        return (segments.y_next - segments.y) * ((nodes - 1) / length), counting


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


def mean_of_ends(values: Float[np.ndarray, "P ..."], count: int) -> Float[np.ndarray, "S ..."]:
    """Return the mean over the points of each sample; the first points of all samples come first."""
    return values if len(values) == count else values.reshape(-1, count, *values.shape[1:]).mean(axis=0)


_rotations = jax.jit(jax.vmap(rotation_matrix))
_corrected_strains = jax.jit(jax.vmap(semi_discrete.strains, in_axes=(None, 0)))
#: y_s of the nominal model at the true strains
_rates = jax.jit(jax.vmap(semi_discrete.rates, in_axes=(None, 0, 0)))
_features_of = eqx.filter_jit(lambda part, inputs: jax.vmap(part.features)(inputs))


class _Views(NamedTuple):
    """Inputs of loads at every point, A + c0 B if B is not zero, and the factor of the loads."""

    material: Float[Any, "P o"]
    ambient: Float[Any, "P a"]
    matrix: Any
    factor: Any


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


class _RegressionTarget(NamedTuple):
    """One target field of a regression: its values, and the floors below which they are noise.

    `frames` has the rotation matrices from the material frame to the values' frame, at every point; None if
    the frames are the same. A sample may have several points, in blocks: a value is the mean load over them.
    """

    values: Float[Any, "S n"]
    frames: Any
    floors: Float[Any, " n"]
    #: names of the vectors with nonlinear functions; None: all
    curved: tuple[str, ...] | None = None


class _Library(NamedTuple):
    """An expansion with unknown weights, its inputs at every point, and the simple functions by vector."""

    part: Expansion
    inputs: Float[Any, "P x"]
    simple: Mapping[str, Sequence[str]]


def _libraries(system: System, layout: Layout, views: _Views, curved: bool) -> tuple[_Library, _Library]:
    """Return the functions of a load of this layout: of observables and inputs, and of inputs alone."""
    aspect, inputs = Observed.of(system), material_layout(system)
    simple: dict[str, Sequence[str]] = {
        **dict.fromkeys(inputs.names, LINEAR),
        **dict.fromkeys(aspect.velocities, DRAG),
    }
    forms = simple | (dict.fromkeys(aspect.velocities or aspect.layout.names, CURVED) if curved else {})
    material = expansion(inputs, views.material, forms, layout.size)
    ambient = expansion(aspect.ambient_layout, views.ambient, {}, layout.size)
    return _Library(material, views.material, simple), _Library(ambient, views.ambient, {})


def _targets(system: System, layout: Layout, y: Any, missing: Any, floors: Any) -> list[_RegressionTarget]:
    """Return the fields of a missing load (S, l) of this layout."""
    rotations = {
        name: np.asarray(_rotations(jnp.asarray(system.y_layout.get(y, name))))
        for name in {field.frame for field in layout.fields if field.frame}
    }
    return [
        _RegressionTarget(missing[:, where], rotations.get(field.frame), floors[where])
        for field in layout.fields
        for where in [layout.slice(field.name)]
    ]


def _load(material: Expansion | None, ambient: Expansion | None) -> Load | None:
    return None if material is None and ambient is None else Load(material, ambient)


def _fitted(
    material: _Library, ambient: _Library | None, targets: Sequence[_RegressionTarget], counting: _Counting
) -> tuple[Expansion | None, Expansion | None]:
    """Return the expansions, in the material and the global frame, that explain the targets."""
    libraries = [library for library in (material, ambient) if library]
    features = [np.asarray(_features_of(library.part, library.inputs)) for library in libraries]
    weights = [_weights(material, features, target, counting) for target in targets]
    found = [
        dataclasses.replace(library.part, weights=np.concatenate(rows)).pruned()
        for library, rows in zip(libraries, zip(*weights, strict=True), strict=True)
    ]
    return found[0], found[1] if ambient else None


#: number of the ambient features' columns, which are no material feature
AMBIENT = -1


def _weights(
    material: _Library, features: Sequence[Any], target: _RegressionTarget, counting: _Counting
) -> list[Float[Any, "n k"]]:
    """Return the weights of the material and the ambient features (n, k) for one target.

    Numbers of one frame each have their own regression, on the material features. With rotation there is one
    regression of all numbers; a column is a feature of one of the material's numbers, or an ambient one.
    """
    (count, size), own = target.values.shape, features[0].shape[1]
    if target.frames is None:
        columns, owner = mean_of_ends(features[0], count), np.arange(own)
        values, floors, (shares, fold) = target.values, target.floors, counting
    else:
        frames = [target.frames, np.broadcast_to(np.eye(size), target.frames.shape)]
        columns = np.concatenate(list(map(_turned, features, frames, [count, count])), axis=1)
        owner = np.full(columns.shape[1], AMBIENT)
        owner[: size * own] = np.tile(np.arange(own), size)
        values, floors = target.values.reshape(-1, 1), np.array([target.floors.max()])
        shares, fold = (np.repeat(part, size) for part in counting)

    def solved(among: Any) -> tuple[Any, list[float]]:
        weights = np.zeros((len(floors), len(owner)))
        weights[:, among], remainder = regression.relevant(columns[:, among], values, floors, shares)
        return weights, remainder

    terms = material.part.columns()
    simple = [k for term, where in terms if term.form in material.simple[term.name] for k in where]
    weights, remainder = solved(np.isin(owner, [AMBIENT, 0, *simple]))
    enough = max(3.0 * floors.max(), WELL * float(np.sqrt(np.mean(values**2))))
    if len(simple) + 1 < own and max(remainder) > enough:
        groups = [np.flatnonzero(owner == AMBIENT), np.flatnonzero(owner == 0)] + [
            np.flatnonzero(np.isin(owner, where))
            for term, where in terms
            if term.form == "linear" or target.curved is None or term.name in target.curved
        ]
        root = np.sqrt(shares)[:, None]
        moments = regression.moments(columns * root, values * root, fold)
        selected, error = regression.selected_columns(
            moments, [group for group in groups if len(group)], float(np.mean(floors**2)) * values.size
        )
        if error <= WORTH * regression.held_out_error(
            moments, np.flatnonzero(np.any(weights != 0.0, axis=0))
        ):
            weights, _ = solved(selected)
    if target.frames is None:
        return [weights, *(np.zeros((size, part.shape[1])) for part in features[1:])]
    return [part.reshape(size, -1) for part in np.split(weights[0], [size * own])]


def _turned(features: Float[Any, "P k"], frames: Float[Any, "P n m"], count: int) -> Float[Any, "S*n m*k"]:
    """Return the columns of a vector that is turned: every feature of each of its numbers."""
    columns = np.einsum("pnm,pk->pnmk", frames, features).reshape(len(features), frames.shape[1], -1)
    return mean_of_ends(columns, count).reshape(count * frames.shape[1], -1)


# refinement on the segments


def _polished(knowledge: System, data: Dataset, residual: Structured, root: Float[Any, "S y"]) -> Structured:
    """Return the residual with its nonzero stretch and load weights refined to fit y at the segments' ends.

    With stages, or a discontinuity inside a segment, y at its end is not linear in the weights; they are
    corrected by Gauss-Newton. `root` (S, y) are the weights of the misfit.
    """
    flat, _ = ravel_pytree(_movable(residual))
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


def _movable(residual: Structured) -> dict[str, Any]:
    """Return the coefficients of stretch and loads along the rod."""
    movable = residual.coefficients().items()
    return {name: jnp.asarray(value) for name, value in movable if name.startswith(("stretch", "load"))}


def _moved(residual: Structured, free: Any, move: Any) -> Structured:
    flat, unravel = ravel_pytree(_movable(residual))
    return residual.with_coefficients(unravel(flat.at[free].add(move)))


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
