"""Constitutive laws in a time scheme: z_t = c0 z + ʰz replaces the rates of strains and internal variables.

A viscoelastic law K ε + B ε_t = σ becomes the elastic law (K + c0 B) ε = σ - B ʰε. `rods.law` has the laws in
time.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.law import (
    Elastic,
    Evolution,
    Fields,
    InternalState,
    JointLaw,
    LinearLaw,
    MaterialLaw,
    StressedLaw,
    Viscoelastic,
)
from knode_cosserat.rods.layout import Layout
from knode_cosserat.rotation import dot, inverse, small_inverse

#: largest number of Newton corrections of a strain with a nonlinear moment; the result is then NaN
CORRECTIONS = 60
#: fractions of a correction that are tried: full corrections overshoot under steep friction
PARTS = 0.5 ** np.arange(8)
#: a strain is solved when the residual is at most this fraction of the law's terms
TOLERANCE = 1e-12
#: the same numbers for a law with another stress, and the fraction above which it counts as unsolved
STRESSED_CORRECTIONS, STRESSED_PARTS, UNSOLVED = 40, np.array([1.0, 0.5, 0.2, 0.05]), 1e-8


class DiscreteLaw(Protocol):
    """Law of z at one point, for one time step."""

    @property
    def linear(self) -> bool:
        """True if the residual is linear in z."""

    def strains(self) -> Float[Any, " z"]:
        """Return z."""

    def residual(self, z: Float[Any, " z"]) -> Float[Any, " z"]:
        """Return the residual of the law at any z."""

    def matrix(self, z: Float[Any, " z"]) -> Float[Any, "z z"]:
        """Return the derivative of the residual by z."""


def discrete_law(law: Any, layout: Layout, c0: Any, hz: Float[Any, " z"], length: Any = 1.0) -> DiscreteLaw:
    """Return a law in time (`System.constitutive`) for one time step; `layout` is that of z.

    The rod's `length` (m) is a scale: curvatures are found to a small part of 1 / length.
    """
    if isinstance(law, StressedLaw):
        return _StressedStep(discrete_law(law.law, layout, c0, hz, length), law, c0, hz)
    if isinstance(law, JointLaw):
        ends = np.cumsum([layout.size for _, layout, _ in law.laws])
        parts = zip(law.laws, jnp.split(hz, ends[:-1]), strict=True)
        return _JointStep([discrete_law(own, each, c0, h, size) for (own, each, size), h in parts], ends)
    if isinstance(law, InternalState):
        internal = {
            name: integrate_variable(evolution, layout.get(hz, name), c0)
            for name, evolution in law.evolutions.items()
        }
        return MaterialStep(law.law(internal), layout, c0, hz, internal, length)
    if isinstance(law, MaterialLaw):
        return MaterialStep(law, layout, c0, hz, {}, length)
    if isinstance(law, tuple):
        return DiscreteLinearLaw(LinearLaw(*law), c0, hz)
    return _StatedStrains(law)


def integrate_variable(evolution: Evolution, h: Any, c0: Any) -> Any:
    """Return an internal variable from its rate and history h; in an equilibrium, c0 = 0, its value at rest.

    The variable is kept within its bounds.
    """
    moving = c0 > 0.0
    free = jnp.where(moving, (evolution.rate - h) / jnp.where(moving, c0, 1.0), evolution.at_rest)
    return jnp.clip(free, evolution.low, evolution.high)


@dataclasses.dataclass(frozen=True)
class _StatedStrains:
    """Strains that the system states directly."""

    z: Float[Any, " z"]
    linear = True

    def strains(self) -> Float[Any, " z"]:
        """Return z."""
        return self.z

    def residual(self, z: Float[Any, " z"]) -> Float[Any, " z"]:
        """Return the difference from the stated strains."""
        return z - self.z

    def matrix(self, z: Float[Any, " z"]) -> Float[Any, "z z"]:
        """Return the identity."""
        return jnp.eye(self.z.shape[0])


@dataclasses.dataclass(frozen=True)
class DiscreteLinearLaw:
    """C z + D z_t = f2 with z_t = c0 z + ʰz."""

    law: LinearLaw
    c0: Any
    hz: Float[Any, " z"]
    linear = True

    def strains(self) -> Float[Any, " z"]:
        """Return (C + c0 D)⁻¹ (f2 - D ʰz)."""
        C, D, f2 = self.law
        return jnp.linalg.solve(C + self.c0 * D, f2 - D @ self.hz)

    def residual(self, z: Float[Any, " z"]) -> Float[Any, " z"]:
        """Return C z + D z_t - f2."""
        C, D, f2 = self.law
        return C @ z + D @ (self.c0 * z + self.hz) - f2

    def matrix(self, z: Float[Any, " z"]) -> Float[Any, "z z"]:
        """Return C + c0 D."""
        return self.law.C + self.c0 * self.law.D


@dataclasses.dataclass
class MaterialStep:
    """Strains by their elastic laws of this step, then internal variables."""

    law: MaterialLaw
    layout: Layout
    c0: Any
    hz: Float[Any, " z"]
    #: internal variables that do not depend on the strains
    internal: Fields
    #: length of the rod (m)
    length: Any

    def __post_init__(self) -> None:
        #: history of each field of z
        self.history: Fields = dict(zip(self.layout.names, self.layout.split(self.hz), strict=True))
        self.elastic = {name: self._elastic(name, strain) for name, strain in self.law.strains.items()}

    @property
    def linear(self) -> bool:
        """True without a coupling, nonlinear moments and internal variables with bounds."""
        moments = any(strain.moment is not None for strain in self.law.strains.values())
        return not (moments or self.internal or self.law.coupling or self.law.internal)

    def _elastic(self, name: str, strain: Viscoelastic) -> Elastic:
        """Return (K + c0 B) ε = σ - B ʰε, with the branch's dashpot eliminated."""
        stiffness = strain.stiffness + self.c0 * strain.damping
        stress = strain.stress - dot(strain.damping, self.history[name])
        if strain.branch is not None:
            # r K (ε - x) = damping (c0 ε + ʰx)
            time = strain.branch.time
            damping = time / (1.0 + self.c0 * time) * strain.branch.stiffness
            stiffness = stiffness + self.c0 * damping
            stress = stress - dot(damping, self.history[strain.branch.field])
        return Elastic(stiffness, stress, strain.softening)

    def strains(self) -> Float[Any, " z"]:
        """Return strains and internal variables in the order of z."""
        if self.law.coupling is None:
            strains = {name: self._strain(name) for name in self.elastic}
        elif moments := {name: it.moment for name, it in self.law.strains.items() if it.moment is not None}:
            law = _CoupledStrains(
                self.elastic, moments, self.law.coupling, self.c0, self.history, self.length
            )
            strains = law.split(_solution(law))
        else:
            strains = self.law.coupling.strains(self.elastic)
        values = strains | self._internal(strains)
        return jnp.concatenate([values[name] for name in self.layout.names])

    def residual(self, z: Float[Any, " z"]) -> Float[Any, " z"]:
        """Return the residual of the elastic laws, and the errors of the internal variables."""
        values: Fields = dict(zip(self.layout.names, self.layout.split(z), strict=True))
        strains = {name: values[name] for name in self.elastic}
        left = {name: elastic.residual(strains[name]) for name, elastic in self.elastic.items()}
        if self.law.coupling is not None:
            stresses = self.law.coupling.stresses(strains)
            left = {name: value + stresses[name] for name, value in left.items()}
        for name, strain in self.law.strains.items():
            if strain.moment is not None:
                left[name] = left[name] + strain.moment(strains[name], self._rate(name, strains[name]))
        left |= {name: values[name] - value for name, value in self._internal(strains).items()}
        return jnp.concatenate([left[name] for name in self.layout.names])

    def matrix(self, z: Float[Any, " z"]) -> Float[Any, "z z"]:
        """Return the derivative of the residual by z."""
        return jax.jacfwd(self.residual)(jnp.zeros_like(z) if self.linear else z)

    def _rate(self, name: str, value: Any) -> Any:
        return self.c0 * value + self.history[name]

    def _strain(self, name: str) -> Float[Any, "3"]:
        strain, elastic = self.law.strains[name], self.elastic[name]
        if strain.moment is None:
            return elastic.strain()
        return _solution(_NonlinearStrain(elastic, strain.moment, self.c0, self.history[name], self.length))

    def _internal(self, strains: Fields) -> Fields:
        """Return all internal variables for these strains."""
        found = dict(self.internal)
        for name, strain in self.law.strains.items():
            if (branch := strain.branch) is not None:
                # T x_t = ε - x
                moved = strains[name] - branch.time * self.history[branch.field]
                found[branch.field] = moved / (1.0 + self.c0 * branch.time)
        if self.law.internal is not None:
            rates = {name: self._rate(name, value) for name, value in strains.items()}
            for name, evolution in self.law.internal(strains, rates).items():
                found[name] = integrate_variable(evolution, self.history[name], self.c0)
        return found


@dataclasses.dataclass(frozen=True)
class _JointStep:
    """Laws of several rods, and the ends of their z."""

    laws: list[DiscreteLaw]
    ends: np.ndarray

    @property
    def linear(self) -> bool:
        """True if all laws are."""
        return all(law.linear for law in self.laws)

    def _split(self, z: Float[Any, " z"]) -> Any:
        return zip(self.laws, jnp.split(z, self.ends[:-1]), strict=True)

    def strains(self) -> Float[Any, " z"]:
        """Return z of all rods."""
        return jnp.concatenate([law.strains() for law in self.laws])

    def residual(self, z: Float[Any, " z"]) -> Float[Any, " z"]:
        """Return the residuals of all laws."""
        return jnp.concatenate([law.residual(part) for law, part in self._split(z)])

    def matrix(self, z: Float[Any, " z"]) -> Float[Any, "z z"]:
        """Return the blocks of all laws on the diagonal."""
        return jax.scipy.linalg.block_diag(*(law.matrix(part) for law, part in self._split(z)))


class _NonlinearStrain(NamedTuple):
    """Law of one strain with a nonlinear moment, for one time step."""

    elastic: Elastic
    moment: Any
    c0: Any
    h: Float[Any, "3"]
    #: length of the rod (m)
    length: Any

    def residual(self, strain: Float[Any, "3"]) -> Float[Any, "3"]:
        """Return the residual of the law."""
        return self.elastic.residual(strain) + self.moment(strain, self.c0 * strain + self.h)

    def correction(self, strain: Float[Any, "3"]) -> Float[Any, "3"]:
        """Return Newton's correction."""
        return -dot(inverse(jax.jacfwd(self.residual)(strain)), self.residual(strain))

    @property
    def start(self) -> Float[Any, "3"]:
        """Strain from which it is searched: without sliding, friction makes no correction overshoot."""
        moving = self.c0 > 0.0
        return jnp.where(moving, -self.h / jnp.where(moving, self.c0, 1.0), self.elastic.strain())

    def size(self, strain: Float[Any, "3"]) -> Any:
        """Return the size of the terms of the law."""
        nonlinear = jnp.abs(self.moment(strain, jnp.zeros_like(strain)))
        return jnp.max(_sizes(self.elastic, strain, self.length) + nonlinear)


def _sizes(elastic: Elastic, strain: Float[Any, "3"], length: Any) -> Float[Any, "3"]:
    """Return the sizes of the terms of an elastic law."""
    # a straight rod at rest has no moments, only rounding errors of the tendons' that cancel
    return dot(jnp.abs(elastic.softened), jnp.abs(strain) + 1.0 / length) + jnp.abs(elastic.stress)


class _CoupledStrains(NamedTuple):
    """Laws of strains with a coupling and nonlinear moments, for one time step."""

    elastic: dict[str, Elastic]
    #: of the strains that have one
    moments: dict[str, Any]
    coupling: Any
    c0: Any
    history: Fields
    #: length of the rod (m)
    length: Any

    def split(self, strains: Float[Any, "6"]) -> Fields:
        """Return the strains by their names."""
        return {"v": strains[:3], "u": strains[3:]}

    def residual(self, strains: Float[Any, "6"]) -> Float[Any, "6"]:
        """Return the residual of the laws."""
        values = self.split(strains)
        stresses = self.coupling.stresses(values)
        left = {name: self.elastic[name].residual(value) + stresses[name] for name, value in values.items()}
        for name, moment in self.moments.items():
            left[name] = left[name] + moment(values[name], self.c0 * values[name] + self.history[name])
        return jnp.concatenate([left["v"], left["u"]])

    def correction(self, strains: Float[Any, "6"]) -> Float[Any, "6"]:
        """Return Newton's correction."""
        return -dot(small_inverse(jax.jacfwd(self.residual)(strains)), self.residual(strains))

    @property
    def start(self) -> Float[Any, "6"]:
        """Strains from which they are searched: those without moments."""
        found = self.coupling.strains(self.elastic)
        return jnp.concatenate([found["v"], found["u"]])

    def size(self, strains: Float[Any, "6"]) -> Float[Any, "6"]:
        """Return the sizes of the terms of the laws."""
        values = self.split(strains).items()
        largest = [jnp.max(_sizes(self.elastic[name], value, self.length)) for name, value in values]
        return jnp.concatenate([jnp.stack([each] * 3) for each in largest])


def _solution(law: Any) -> Float[Any, " n"]:
    """Return the solution of a law with nonlinear moments, with its derivatives."""
    # the search is not differentiated: one more correction has the derivatives of the implicit function
    found = _search(jax.lax.stop_gradient(law))
    return found + law.correction(found)


def _search(law: Any) -> Float[Any, " n"]:
    """Return the strains by Newton's method with a line search; NaN if it does not converge."""
    start = law.start
    size = law.size(start)

    def unsolved(strain: Any) -> Any:
        return ~(jnp.max(jnp.abs(law.residual(strain)) - TOLERANCE * size) <= 0.0)

    def continues(state: Any) -> Any:
        strain, count = state
        return unsolved(strain) & (count < CORRECTIONS)

    def corrected(state: Any) -> Any:
        strain, count = state
        tried = strain + PARTS[:, None] * law.correction(strain)
        left = jax.vmap(lambda strain: jnp.sum((law.residual(strain) / size) ** 2))(tried)
        return tried[jnp.argmin(left)], count + 1

    strain, _ = jax.lax.while_loop(continues, corrected, (start, 0))
    return jnp.where(unsolved(strain), jnp.nan, strain)


@dataclasses.dataclass(frozen=True)
class _StressedStep:
    """A law with another stress of all of z and z_t = c0 z + ʰz."""

    nominal: DiscreteLaw
    law: StressedLaw
    c0: Any
    hz: Float[Any, " z"]

    @property
    def linear(self) -> bool:
        """True if both parts are."""
        return self.nominal.linear and self.law.linear

    def _stress(self, z: Float[Any, " z"]) -> Float[Any, " z"]:
        return self.law.stress(z, self.c0 * z + self.hz)

    def residual(self, z: Float[Any, " z"]) -> Float[Any, " z"]:
        """Return the residual of the law without the stress, plus the stress."""
        return self.nominal.residual(z) + self._stress(z)

    def matrix(self, z: Float[Any, " z"]) -> Float[Any, "z z"]:
        """Return the derivative of the residual by z."""
        return jax.jacfwd(self.residual)(jnp.zeros_like(z) if self.linear else z)

    def strains(self) -> Float[Any, " z"]:
        """Return z, by corrections of the strains without the stress; NaN if Newton's method fails."""
        z0 = self.nominal.strains()
        if self.linear:
            # one correction is exact, and its matrix is the same along the whole rod
            return z0 - dot(small_inverse(self.matrix(z0)), self._stress(z0))
        M = self.nominal.matrix(z0)

        def residual(z: Any) -> Any:
            own = dot(M, z - z0) if self.nominal.linear else self.nominal.residual(z)
            return own + self._stress(z)

        # the search is not differentiated: one more correction has the derivatives of the implicit function
        function, constants = jax.closure_convert(residual, z0)
        constants = jax.lax.stop_gradient(constants)
        size = jnp.sum(jnp.abs(M) * (2.0 * jnp.abs(z0) + 1e-3), axis=1)
        z = _stressed_strains(
            lambda z: function(z, *constants), *jax.lax.stop_gradient((z0, TOLERANCE * size))
        )
        return z - dot(jax.lax.stop_gradient(small_inverse(jax.jacfwd(residual)(z))), residual(z))


def _stressed_strains(residual: Any, z0: Float[Any, " z"], tolerance: Float[Any, " z"]) -> Float[Any, " z"]:
    """Return the root by Newton's method with a line search: with friction, full corrections overshoot."""

    def size(values: Any) -> Any:
        return jnp.max(jnp.abs(values) / tolerance)

    def continues(state: Any) -> Any:
        count, _, values = state
        return (size(values) > 1.0) & (count < STRESSED_CORRECTIONS)

    def corrected(state: Any) -> Any:
        count, z, values = state
        tried = z - STRESSED_PARTS[:, None] * dot(small_inverse(jax.jacfwd(residual)(z)), values)
        results = jax.vmap(residual)(tried)
        sizes = jax.vmap(size)(results)
        best = jnp.argmin(jnp.where(jnp.isfinite(sizes), sizes, jnp.inf))
        return count + 1, tried[best], results[best]

    _, z, values = jax.lax.while_loop(continues, corrected, (0, z0, residual(z0)))
    return jnp.where(size(values) <= UNSOLVED / TOLERANCE, z, jnp.nan)
