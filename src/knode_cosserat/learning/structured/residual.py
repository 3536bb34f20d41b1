"""Structured residual: mechanical corrections of length, constitutive law, loads and tip.

    length      L (1 + γ)
    material    C z + D z_t + σ(z - z*, z_t) = f2: the strains are corrected before the kinematics use them
    loads       + R f(material-frame observables) + g(control): on the balance equations only
    tip         + the same two at the tip: a mass, a weight, a force that the nominal model lacks

The geometry (p_s, h_s, q_s, ω_s of a rod) stays exact, and the laws do not depend on the time step. Each of
σ, f and g is an `Expansion`. A system's layouts mark loads and rotated fields (`Field.frame`,
`Field.load`); without such marks every rate may be corrected.
"""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.learning.residual import Residual
from knode_cosserat.learning.structured.expansion import Expansion
from knode_cosserat.rods.layout import Field, Layout
from knode_cosserat.rods.system import System, with_length_factor
from knode_cosserat.rotation import dot, rotation_matrix, small_inverse
from knode_cosserat.solvers import semi_discrete
from knode_cosserat.solvers.semi_discrete import Point

#: largest number of Newton corrections of a nonlinear law, and the damping factors tried for each
MOST_CORRECTIONS = 40
PARTS = np.array([1.0, 0.5, 0.2, 0.05])
#: a law is solved when its residual is this part of its terms
SOLVED = 1e-12


class Load(eqx.Module):
    """A load in the material frame, of observables and control, and a global load, of the control."""

    material: Expansion | None
    ambient: Expansion | None

    def __call__(
        self, layout: Layout, frames: Layout, y: Float[Any, " y"], observables: Any, control: Any
    ) -> Float[Any, " l"]:
        """Return the load, laid out by `layout`, in the frames of the equations."""
        total = jnp.zeros(layout.size)
        if self.material is not None:
            total = turned_back(layout, frames, y, self.material(jnp.concatenate([observables, control])))
        if self.ambient is not None:
            total = total + self.ambient(control)
        return total


class _Law(NamedTuple):
    """Sum of the nominal law and σ(z - z*, c0 z + ʰz), for the strains z at one point."""

    stress: Expansion
    #: derivative of the nominal law at z0; the whole law if it is linear
    M: Float[Any, "z z"]
    c0: Any
    z_rest: Float[Any, " z"]
    z0: Float[Any, " z"]
    hz: Float[Any, " z"]

    #: factors of strain and rate at the point (see `law_inputs`); None: one
    factors: Any = None
    #: the nominal model and its arguments, if its law is nonlinear
    point: Any = None

    def left(self, z: Float[Any, " z"]) -> Float[Any, " z"]:
        """Return the residual of the law."""
        strain, rate = z - self.z_rest, self.c0 * z + self.hz
        if self.factors is not None:
            strain, rate = strain * self.factors[0], rate * self.factors[1]
        return self._own(z) + self.stress(jnp.concatenate([strain, rate]))

    def _own(self, z: Float[Any, " z"]) -> Any:
        if self.point is None:
            return dot(self.M, z - self.z0)
        knowledge, point = self.point
        return semi_discrete.law_residual(knowledge, point, z)


def solved_strains(law: _Law) -> Float[Any, " z"]:
    """Return the strains of a nonlinear law, by damped Newton's method from z0; NaN if it fails.

    Each correction uses the damping factor with the least residual: with friction, laws are so steep that
    full corrections always overshoot.
    """
    n = law.z0.shape[0]
    # natural size of the law's terms, for each number
    enough = SOLVED * jnp.sum(jnp.abs(law.M) * (jnp.abs(law.z0) + jnp.abs(law.z_rest) + 1e-3), axis=1)

    def size(left: Any) -> Any:
        return jnp.max(jnp.abs(left) / enough)

    def going(state: Any) -> Any:
        count, _, left = state
        return (size(left) > 1.0) & (count < MOST_CORRECTIONS)

    def corrected(state: Any) -> Any:
        count, z, left = state
        step = dot(small_inverse(jax.jacfwd(law.left)(z)), left)
        tried = z - PARTS[:, None] * step
        leaves = jax.vmap(law.left)(tried)
        best = jnp.argmin(jnp.where(jnp.isfinite(jax.vmap(size)(leaves)), jax.vmap(size)(leaves), jnp.inf))
        return count + 1, tried[best], leaves[best]

    _, z, left = jax.lax.while_loop(going, corrected, (0, law.z0, law.left(law.z0)))
    return jnp.where(size(left) <= 1e4, z, jnp.full(n, jnp.nan))


class Structured(Residual):
    """Structured residual (see the module). Unused parts are None, and cost nothing."""

    linear_in: ClassVar[tuple[str, ...]] = (
        "stretch", "stress.weights", "load.material.weights", "load.ambient.weights",
        "tip_load.material.weights", "tip_load.ambient.weights",
    )  # fmt: skip

    stretch: Float[Any, ""]
    stress: Expansion | None
    load: Load | None
    tip_load: Load | None

    def adapted(self, knowledge: System) -> System:
        """Return the nominal model with corrected length."""
        return with_length_factor(knowledge, 1.0 + self.stretch)

    def derivatives(self, knowledge: System, point: Point) -> tuple[Float[Any, " y"], Float[Any, " z"]]:
        """Return y_s and z: strains are corrected first, then loads are added to the balance equations."""
        z = self.strains(knowledge, point)
        return self.rates(knowledge, point, z), z

    def rates(self, knowledge: System, point: Point, z: Float[Any, " z"]) -> Float[Any, " y"]:
        """Return y_s at strains z: the nominal model's, with the learned loads."""
        y_s = semi_discrete.rates(knowledge, point, z)
        if self.load is None:
            return y_s
        observed = self._observed(self.load, knowledge, point, z)
        layout, inputs = loaded(knowledge), ambient_inputs(knowledge, point.control)
        load = self.load(layout, knowledge.y_layout, point.y, observed, inputs)
        added = jnp.zeros(point.y.shape[0]).at[knowledge.y_layout.indices(layout.names)].set(load)
        if knowledge.mixed:
            added = jnp.linalg.solve(semi_discrete.load_matrix(knowledge, point, z), added)
        return y_s + added

    def strains(self, knowledge: System, point: Point) -> Float[Any, " z"]:
        """Return z of the corrected law, the nominal one plus σ(z - z*, c0 z + ʰz), from the nominal z0."""
        nominal = semi_discrete.law(knowledge, point)
        z0 = nominal.strains()
        if self.stress is None:
            return z0
        s, _, _, control, history = point
        observed = knowledge.observed
        z_rest, factors = observed.unstressed(s, control), observed.law_factors(s, control)
        M, linear = nominal.matrix(z0), nominal.linear
        whole = None if linear else (knowledge, point)
        law = _Law(self.stress, M, history.c0, z_rest, z0, history.z, factors, whole)
        if linear and not self.stress.curved:
            # linear: one correction from z0 is exact, and its matrix is the same along the whole rod
            n = jnp.zeros_like(z_rest)
            inverse = small_inverse(jax.jacfwd(law._replace(z0=n, hz=n).left)(n))
            return z0 - dot(inverse, law.left(z0))
        # the iteration is not differentiated: at the solution one more correction changes nothing, but has
        # the derivatives of the implicit function
        z = solved_strains(jax.lax.stop_gradient(law))
        inverse = jax.lax.stop_gradient(small_inverse(jax.jacfwd(law.left)(z)))
        return z - dot(inverse, law.left(z))

    def law_residual(self, knowledge: System, point: Point, z: Float[Any, " z"]) -> Float[Any, " z"]:
        """Return the residual of the nominal law at z, plus the learned stress."""
        left = semi_discrete.law_residual(knowledge, point, z)
        if self.stress is None:
            return left
        return left + self.stress(law_inputs(knowledge, point.s, point.control, z, point.history.z_t(z)))

    @property
    def linear(self) -> bool:
        """True if the learned stress is linear."""
        return self.stress is None or not self.stress.curved

    def tip(
        self, knowledge: System, t: Any, control: Any, y: Float[Any, " y"], y_t: Float[Any, " y"]
    ) -> Float[Any, " k"]:
        """Return the nominal model's conditions at the tip plus the learned tip load."""
        conditions = knowledge.tip(t, control, y, y_t)
        if self.tip_load is None:
            return conditions
        observed = tip_observables(knowledge, y, y_t, control)
        layout, inputs = knowledge.ends.layout, ambient_inputs(knowledge, control)
        return conditions + self.tip_load(layout, knowledge.y_layout, y, observed, inputs)

    @staticmethod
    def _observed(load: Load, knowledge: System, point: Point, z: Any) -> Any:
        if load.material is None:
            return None
        s, _, y, control, history = point
        return knowledge.observed.observables(s, y, history.y_t(y), z, history.z_t(z), control)


def law_inputs(knowledge: System, s: Any, control: Any, z: Any, z_t: Any) -> Float[Any, " 2z"]:
    """Return the inputs of stress: strain and rate, scaled by the local factors of the section."""
    observed = knowledge.observed
    strain, factors = z - observed.unstressed(s, control), observed.law_factors(s, control)
    if factors is None:
        return jnp.concatenate([strain, z_t])
    return jnp.concatenate([strain * factors[0], z_t * factors[1]])


def tip_observables(knowledge: System, y: Float[Any, " y"], y_t: Any, control: Any) -> Any:
    """Return the observables for a tip load, without the strains there, which it determines itself."""
    s = knowledge.length
    _, z = knowledge.rest(s)
    return knowledge.observed.observables(s, y, y_t, z, jnp.zeros_like(z), control)


def loaded(knowledge: System) -> Layout:
    """Return the fields of y whose rates balance loads; all fields if none is marked."""
    stated = tuple(field for field in knowledge.y_layout.fields if field.load)
    return Layout(*stated) if stated else knowledge.y_layout


def geometric(knowledge: System) -> tuple[str, ...]:
    """Return the fields of y with geometric rates; none if no loads are marked."""
    names = knowledge.y_layout.names
    return tuple(name for name in names if name not in loaded(knowledge).names)


def material_layout(knowledge: System) -> Layout:
    """Return the input layout of a material-frame load: the observables, and the ambient inputs."""
    return knowledge.observed.layout + ambient_layout(knowledge)


def ambient_layout(knowledge: System) -> Layout:
    """Return the input layout of an ambient load: the control, and its actuation if that differs."""
    if not knowledge.observed.has_actuation:
        return knowledge.control_layout
    size = jax.eval_shape(knowledge.observed.actuation, np.zeros(knowledge.control_size)).shape[0]
    actuation = Field("actuation", size, "", "what of the control enters the equations")
    return knowledge.control_layout + Layout(actuation)


def ambient_inputs(knowledge: System, control: Any) -> Any:
    """Return the numbers laid out by `ambient_layout`."""
    if not knowledge.observed.has_actuation:
        return control
    return jnp.concatenate([control, knowledge.observed.actuation(control)])


def turned_back(layout: Layout, frames: Layout, y: Any, load: Any) -> Any:
    """Return a material-frame load in the frames of the equations."""
    parts = []
    for field in layout.fields:
        part = layout.get(load, field.name)
        if field.frame:
            part = dot(rotation_matrix(frames.get(y, field.frame)), part)
        parts.append(part)
    return jnp.concatenate(parts)
