"""Passive residual: a moment in the constitutive law, from an energy and a damping.

    Rᵀm = (moment of the nominal law) + m_r,      m_r = ∂W/∂u (u; s, T) + D(s, T, n, m, q, w, λ) u_t

with the bending u relative to the unstressed rod, place s, control T (tensions), wrench n and m, velocities
q and w, and the friction loss of tension λ.

Passivity. W is a function of u at every place and under every control, and D is nonnegative for all inputs.
Both hold by construction, for all learned numbers. Per length of rod the residual absorbs the power

    m_r · u_t = dW/dt - ∂W/∂T · dT/dt + D |u_t|²

so that over any closed cycle of u under a constant control it absorbs ∮ D |u_t|² dt ≥ 0 and never supplies
energy. A changing control exchanges energy with W as tendons do with a rod: as work of the actuators. With
the least bending stiffness κ of the nominal model, the second derivative of W + ½ κ |u|² with respect to u is
positive definite. The stored energy of nominal model and residual is therefore bounded below.

W and D have a linear path and a small network each. With e = L u, σ = 2 s/L - 1, x = T over the typical
control, and x̄ the mean of x,

    W L²/κ = ½ e·(exp M - 1) e + b·e
    (M, b) = (M₁ + M₂ σ + M₃ x̄, Σⱼ xⱼ (Aⱼ + Bⱼ σ)) + Σₖ (Mₖ, bₖ) tanh(wₖ·(x, σ, 1))
    D/δ    = d₁ + d₂ (1 + σ)/2 + d₃ x̄ + Σₖ gₖ sigmoid(vₖ·(n, m, q, w, x̄, λ, σ, 1))

M is symmetric, with eigenvalues within ±`LOGARITHM`; d and g are nonnegative. w and v are drawn once and kept
fixed. Few numbers are learned, and the residual is linear in them near zero. W is quadratic in u, so that no
additional equation has to be solved: the law of u has another stiffness, damping and stress. A Maxwell branch
keeps its ratio to the stiffness.
"""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.learning.residual import Residual
from knode_cosserat.rods.aspects import Observed
from knode_cosserat.rods.law import InternalState, MaterialLaw, StressedLaw
from knode_cosserat.rods.system import System
from knode_cosserat.rods.wrapped import nominal_model
from knode_cosserat.rotation import dot, rotation_matrix

#: moment of one tendon at its typical tension, for learned numbers of 1, in units of κ/L
LEVER = 0.1
#: largest eigenvalue of M: stiffness is at most multiplied or divided by exp 2
LOGARITHM = 2.0
#: number of inputs of the damping network
SEEN = 16
#: damping ratio of the first mode added by d₁ = 1
RATIO = 0.05
#: learned parts in order, and the nonnegative parts
PARTS = ("stiffness", "levers", "energy", "damping", "dissipation")
POSITIVE = ("damping", "dissipation")


class NaturalUnits(NamedTuple):
    """Natural units of inputs and outputs: control, force (N), moment, velocity, and δ (N m² s)."""

    control: Any
    force: Any
    moment: Any
    velocity: Any
    damping: Any


class Passive(Residual):
    """Passive residual of a rod (see the module). If all learned numbers are zero, it has no effect.

    Parts that are None cost nothing: without `dissipation` the damping does not depend on the state.
    """

    fixed: ClassVar[tuple[str, ...]] = ("sizes", "energy_weights", "damping_weights")
    linear_in: ClassVar[tuple[str, ...]] = PARTS

    #: (terms, 3): coefficients of 1, σ and x̄; each a symmetric matrix ((a + b, c), (c, a - b))
    stiffness: Float[Any, "3 3"]
    #: (terms, 2, controls): coefficients of 1 and σ
    levers: Float[Any, "2 2 c"]
    #: (units, 5): coefficients of a symmetric matrix and a vector
    energy: Float[Any, "units 5"]
    damping: Float[Any, "3"]
    dissipation: Float[Any, " units"] | None
    sizes: NaturalUnits
    energy_weights: Float[Any, "units inputs"]
    damping_weights: Float[Any, "units inputs"] | None

    def constitutive(self, knowledge: System, s: Any, t: Any, y: Any, y_t: Any, control: Any) -> Any:
        """Return the law with the stiffness and the moment of W, and the damping D.

        Raises:
            TypeError: the nominal law is no `MaterialLaw`.
        """
        rest = knowledge.z_layout.get(Observed.of(knowledge).unstressed(s, control), "u")
        stiffness, damping, moment = self.terms(knowledge, s, y, control)

        def changed(law: Any) -> Any:
            if isinstance(law, StressedLaw):
                return law._replace(law=changed(law.law))
            if isinstance(law, InternalState):
                return InternalState(law.evolutions, lambda internal: changed(law.law(internal)))
            if not isinstance(law, MaterialLaw):
                raise TypeError(
                    f"{type(nominal_model(knowledge)).__name__} states its law as a {type(law).__name__}; a "
                    "passive residual is a term of a MaterialLaw"
                )
            u = law.strains["u"]
            stress = u.stress + dot(stiffness, rest) - moment
            branch = u.branch
            if branch is not None:
                ratio = branch.stiffness[0, 0] / u.stiffness[0, 0]
                branch = branch._replace(stiffness=branch.stiffness + ratio * stiffness)
            u = u._replace(
                stiffness=u.stiffness + stiffness, damping=u.damping + damping, stress=stress, branch=branch
            )
            return law._replace(strains={**law.strains, "u": u})

        return changed(knowledge.constitutive(s, t, y, y_t, control))

    def terms(
        self, knowledge: System, s: Any, y: Float[Any, " y"], control: Any
    ) -> tuple[Float[Any, "3 3"], Float[Any, "3 3"], Float[Any, "3"]]:
        """Return the stiffness κ S (N m²), the damping D (N m² s) and the moment κ b/L (N m) at a point."""
        L, kappa = knowledge.length, _least(nominal_model(knowledge).Kbt)
        sigma, x = 2.0 * s / L - 1.0, jnp.asarray(control) / self.sizes.control
        S, b = self.spring(sigma, x)
        stiffness = kappa * jnp.zeros((3, 3)).at[:2, :2].set(S)
        damping = self.damped(self._seen(knowledge, y), sigma, x) * np.diag([1.0, 1.0, 0.0])
        factors = Observed.of(knowledge).law_factors(s, control)
        if factors is not None:
            # the section's, as for the rod itself
            first, second = (knowledge.z_layout.get(factor, "u") for factor in factors)
            stiffness, damping = stiffness * first, damping * second
        return stiffness, damping, kappa / L * jnp.concatenate([b, jnp.zeros(1)])

    def spring(self, sigma: Any, x: Float[Any, " c"]) -> tuple[Float[Any, "2 2"], Float[Any, "2"]]:
        """Return S = exp M - 1 and b of W L²/κ = ½ e·S e + b·e."""
        mean = jnp.mean(x)
        units = jnp.tanh(self.energy_weights @ jnp.concatenate([x, jnp.stack([sigma, jnp.ones(())])]))
        network = units @ self.energy
        M = self.stiffness[0] + self.stiffness[1] * sigma + self.stiffness[2] * mean + network[:3]
        # |eigenvalues| of ((a + b, c), (c, a - b)) are at most √(2 (a² + b² + c²))
        a, b, c = M / jnp.sqrt(1.0 + 2.0 * jnp.sum(M * M) / LOGARITHM**2)
        turned = jnp.sqrt(b * b + c * c + 1e-24)
        even, odd = jnp.exp(a) * jnp.cosh(turned) - 1.0, jnp.exp(a) * jnp.sinh(turned) / turned
        S = jnp.stack([jnp.stack([even + odd * b, odd * c]), jnp.stack([odd * c, even - odd * b])])
        levers = self.levers[0] + self.levers[1] * sigma
        return S, LEVER * (jnp.sum(levers * x, axis=1) + network[3:])

    def damped(self, seen: Float[Any, " seen"], sigma: Any, x: Float[Any, " c"]) -> Any:
        """Return D (N m² s), nonnegative."""
        mean = jnp.mean(x)
        simple = jnp.stack([jnp.ones(()), 0.5 * (1.0 + sigma), jnp.maximum(mean, 0.0)])
        total = jnp.sum(_not_negative(self.damping) * simple)
        if self.dissipation is not None and self.damping_weights is not None:
            inputs = jnp.concatenate([seen, jnp.stack([mean, sigma, jnp.ones(())])])
            units = jax.nn.sigmoid(self.damping_weights @ inputs)
            total = total + jnp.sum(_not_negative(self.dissipation) * units)
        return self.sizes.damping * total

    def clamped(self) -> Self:
        """Return the nearest residual with nonnegative damping coefficients."""
        used = [name for name in POSITIVE if getattr(self, name) is not None]
        return eqx.tree_at(lambda it: [getattr(it, name) for name in used], self, replace_fn=_not_negative)

    def _seen(self, knowledge: System, y: Float[Any, " y"]) -> Float[Any, " seen"]:
        """Return wrench and velocities in the material frame, and the mean loss of tension."""
        layout, sizes = knowledge.y_layout, self.sizes
        frame = rotation_matrix(layout.get(y, "h")).T
        n, m = dot(frame, layout.get(y, "n")), dot(frame, layout.get(y, "m"))
        q, w = layout.get(y, "q"), layout.get(y, "w")
        lost = jnp.mean(layout.get(y, "loss")) if "loss" in layout.names else jnp.zeros(())
        turned = w * knowledge.length / sizes.velocity
        parts = [n / sizes.force, m / sizes.moment, q / sizes.velocity, turned, lost[None]]
        return jnp.concatenate(parts)

    def pruned(self) -> Self:
        """Return a copy without the damping network if that is zero."""
        if self.dissipation is None or np.any(np.asarray(self.dissipation) > 0.0):
            return self
        none = [None, None]
        return eqx.tree_at(lambda it: [it.dissipation, it.damping_weights], self, none)


def passive(knowledge: System, controls: Float[np.ndarray, "T c"], seed: int = 0, hidden: int = 4) -> Passive:
    """Return a residual for a rod, with all learned numbers zero.

    Args:
        knowledge: a rod with bending stiffness and damping.
        controls: typical controls.
        seed: seed of the networks' fixed weights.
        hidden: number of units of each network.

    Raises:
        TypeError: the knowledge is no such rod (`require_bending`).
    """
    require_bending(knowledge)
    layout, natural = knowledge.y_layout, np.asarray(knowledge.scales().y)
    force, moment, velocity = (float(natural[layout.slice(name)][0]) for name in ("n", "m", "q"))
    length, count = float(knowledge.length), np.shape(controls)[1]
    damping = 2.0 * RATIO * moment * length**2 / (3.516 * velocity)
    sizes = NaturalUnits(float(np.nanmean(np.abs(controls))) or 1.0, force, moment, velocity, damping)
    rng = np.random.default_rng(seed)
    return Passive(
        jnp.zeros((3, 3)),
        jnp.zeros((2, 2, count)),
        jnp.zeros((hidden, 5)),
        jnp.zeros(3),
        jnp.zeros(hidden),
        sizes,
        rng.normal(size=(hidden, count + 2)),
        rng.normal(size=(hidden, SEEN)),
    )


def require_bending(knowledge: System) -> None:
    """Raise `TypeError` unless a nominal model has the parameters and states that the residual needs."""
    needed = ("bending_stiffness", "bending_damping", "h", "n", "m", "q", "w", "u")
    has = (*nominal_model(knowledge).parameters(), *knowledge.y_layout.names, *knowledge.z_layout.names)
    missing = [name for name in needed if name not in has]
    if not missing and not hasattr(nominal_model(knowledge), "Kbt"):
        missing = ["Kbt"]
    if missing:
        raise TypeError(
            f"knowledge is a {type(nominal_model(knowledge)).__name__} without {', '.join(missing)}; a "
            "passive residual is for a rod with bending stiffness, such as a TendonRobot or a "
            "RoutedTendonRobot"
        )


def _not_negative(values: Any) -> Any:
    """Return values with negative ones set to zero; the derivative at zero is one."""
    return jnp.where(values >= 0.0, values, 0.0)


def _least(K: Float[Any, "3 3"]) -> Any:
    """Return the least bending stiffness."""
    a, b, c = K[0, 0], K[0, 1], K[1, 1]
    return 0.5 * (a + c) - jnp.sqrt(0.25 * (a - c) ** 2 + b * b + 1e-24 * a * a)
