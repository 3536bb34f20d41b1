"""A robot whose tendons run through holes in its ribs: they bend it, and rub. Symbols as in `tendon_rod`.

n and m carry rod and tendons together, so that their balance has no tendon in it and the tip, where the
tendons are anchored, is free. What the tendons take of them stands in the material's law (Till 2019, after
Rucker & Webster 2011), here for tendons that run beside the rod at rᵢ, with the tangent d₃:

    Rᵀn = Kse (v - v*) + Bse v_t + Σ τᵢ d₃          Rᵀm = Kbt (u - u*) + Bbt u_t + Σ τᵢ rᵢ × d₃

Friction. A tendon that slides loses tension on its way, as in a sheath: τᵢ(s) = Tᵢ exp(-fᵢ (k s + μ α)), with
the wobble coefficient k, the curvature friction coefficient μ and the angle α by which the rod has turned,
here taken as s |u|. fᵢ, from -1 to 1, is how much of the friction holds the tendon and which way. It is a
memory, the part of z that remembers where the robot has come from: it grows as the rod bends in the tendon's
direction eᵢ, up to where the tendon slides (an elastic, perfectly plastic element: Prandtl 1928)

    fᵢ_t = eᵢ·u_t / κ₀    while |fᵢ| < 1

so that a robot that is held stays where it is, whatever noise its tensions have. (Dahl's smooth law lets it
creep: with it a step of 10 s was predicted with three times the error.) An equilibrium, with all rates zero,
is the one without friction.

Vibration. Above some tension of all tendons together robots begin to shake, and what shakes does not stick:
x, from 0 to 1, is the part of the friction that is gone. It is a memory too, x_t = k_v (Σ Tᵢ - T_v), and
takes a part c x Σ Tᵢ of the rod's stiffness with it.
"""

from __future__ import annotations

import dataclasses
from typing import Any, Self

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.parameters import parameter
from knode_cosserat.rods.system import History, Layout
from knode_cosserat.rods.tendon_rod import TendonRod
from knode_cosserat.rotation import dot, inverse, rotation_matrix

#: corrections of u at a node at most, each of which tries these parts of Newton's step
CORRECTIONS = 20
#: a correction of this part of u is the last: the step after it squares what is left
SETTLED = 1e-7
PARTS = np.array([1.0, 0.5, 0.2])
#: turns (1/m) below this hardly count in α, so that it has a slope everywhere
STRAIGHT = 1e-2


class RoutedTendonRobot(TendonRod):
    """A clamped, round, straight rod with tendons beside it that bend it, with friction where they run.

    Without friction and vibration (the defaults) it has no memory beyond that of its damping. The module's
    head has the equations.
    """

    sleeve_stiffening: Any = parameter(
        "", "how much stiffer against bending the rod is at its base, as a part", low=0.0, high=1e4,
        default=0.0,
    )  # fmt: skip
    sleeve_length: Any = parameter(
        "m", "where that ends: exp(-(s / length)^4) of it are left at s", low=1e-4, high=20.0, default=0.05
    )
    friction_wobble: Any = parameter(
        "1/m", "k, friction of the tendons by the way they run", low=0.0, high=100.0, default=0.0
    )
    friction_curvature: Any = parameter(
        "1/rad", "μ, friction of the tendons by the angle they turn", low=0.0, high=10.0, default=0.0
    )
    friction_reach: Any = parameter(
        "1/m", "κ₀, change of curvature that builds friction up", low=1e-4, high=100.0, default=0.1
    )
    vibration_tension: Any = parameter(
        "N", "T_v, tension of all tendons together above which vibration grows", low=0.0, high=1e6,
        default=1e6,
    )  # fmt: skip
    vibration_rate: Any = parameter(
        "1/(N s)", "k_v, how fast it grows; none at 0", low=0.0, high=1e3, default=0.0
    )
    vibration_softening: Any = parameter(
        "m2", "c, loss of bending stiffness by vibration, by tension", low=0.0, high=1.0, default=0.0
    )

    @classmethod
    def like(cls, robot: TendonRod, **changes: Any) -> Self:
        """A robot with the rod of another, and with tendons at the same places.

        Raises:
            ParameterError: a change that is not allowed.
        """
        same = {field.name: getattr(robot, field.name) for field in dataclasses.fields(TendonRod)}
        return cls(**same).replace(**changes)

    @property
    def z_layout(self) -> Layout:  # type: ignore[override]
        """Strains, friction of each tendon, and vibration."""
        return Layout(
            *TendonRod.z_layout.fields,
            (
                "f",
                self.control_size,
                "1",
                "part of the friction that holds each tendon, and which way",
            ),
            ("x", 1, "1", "part of the friction that vibration has taken away"),
        )

    # what the tendons do

    @property
    def bending_directions(self) -> Float[Any, "c 3"]:
        """eᵢ: the direction of u in which each tendon bends the rod, material frame."""
        angles = jnp.asarray(self.tendon_angles)
        return jnp.stack([-jnp.sin(angles), jnp.cos(angles), jnp.zeros_like(angles)], axis=-1)

    def actuation(self, control: Float[Any, " c"]) -> Float[Any, "3"]:
        """Σ Tᵢ d₃ × rᵢ: how the tendons would bend the rod without friction (N·m), material frame."""
        return self.tendon_offset * dot(self.bending_directions.T, control)

    def rest(self, s: Any) -> tuple[Float[Any, " y"], Float[Any, " z"]]:
        """Straight up along z, unloaded, at rest, and no friction."""
        y, z = super().rest(s)
        return y, jnp.concatenate([z, np.zeros(self.control_size + 1)])

    def bending_stiffness_at(self, s: Any) -> Float[Any, "3 3"]:
        """Kbt (N·m²) at arclength s (m), the sleeve included."""
        return self.Kbt * (1.0 + self.sleeve_stiffening * jnp.exp(-((s / self.sleeve_length) ** 4)))

    def strains(
        self, s: Any, t: Any, y: Float[Any, " y"], control: Any, history: History
    ) -> Float[Any, " z"]:
        """v, u, f and x: the material's law solved for them."""
        c0 = history.c0
        hv, hu, _, hx = self.z_layout.split(history.z)
        R = rotation_matrix(self.y_layout.get(y, "h"))
        n, m = dot(R.T, self.y_layout.get(y, "n")), dot(R.T, self.y_layout.get(y, "m"))
        growth = self.vibration_rate * (jnp.sum(control) - self.vibration_tension)
        # at rest (c0 = 0) it has grown as far as it will
        x = jnp.where(c0 > 0.0, (growth - hx) / jnp.where(c0 > 0.0, c0, 1.0), jnp.sign(growth))
        x = jnp.clip(x, 0.0, 1.0)
        u = self._curvature(s, m, control, x, history)
        pulled = n - jnp.sum(control) * self.v_star
        Kse, Bse = self.Kse, self.shear_damping
        v = dot(inverse(Kse + c0 * Bse), pulled + dot(Kse, self.v_star) - dot(Bse, hv))
        f = self._friction(c0 * u + hu, history)
        return jnp.concatenate([v, u, f, x])

    def _friction(self, u_t: Float[Any, "3"], history: History) -> Float[Any, " c"]:
        rate = dot(self.bending_directions, u_t) / self.friction_reach
        moving = history.c0 > 0.0
        held = (rate - self.z_layout.get(history.z, "f")) / jnp.where(moving, history.c0, 1.0)
        return jnp.where(moving, jnp.clip(held, -1.0, 1.0), 0.0)

    def _moment(self, s: Any, u: Float[Any, "3"], control: Any, x: Any, history: History) -> Any:
        """Rᵀm by the material's law where the curvature is u."""
        u_t = history.c0 * u + self.z_layout.get(history.z, "u")
        bent = u
        turn = s * (jnp.sqrt(jnp.sum(u[:2] ** 2) + STRAIGHT**2) - STRAIGHT)
        path = self.friction_wobble * s + self.friction_curvature * turn
        tension = control * jnp.exp(-(1.0 - x) * path * self._friction(u_t, history))
        soft = self.vibration_softening * x * jnp.sum(control) * bent * np.array([1.0, 1.0, 0.0])
        elastic = dot(self.bending_stiffness_at(s), bent) + dot(self.bending_damping, u_t)
        return elastic - soft - self.actuation(tension)

    def _curvature(
        self, s: Any, m: Float[Any, "3"], control: Any, x: Any, history: History
    ) -> Float[Any, "3"]:
        """u where the material's law gives the moment m: Newton's method, then one step that has slopes.

        That step makes derivatives those of the solution, whatever way Newton's method went.
        """
        fixed = jax.lax.stop_gradient((self, s, m, control, x, history))

        def left(u: Any) -> Any:
            robot, s, m, control, x, history = fixed
            return robot._moment(s, u, control, x, history) - m

        def goes_on(reached: Any) -> Any:
            count, u, moved = reached
            return (count < CORRECTIONS) & (moved > SETTLED * (1.0 + jnp.max(jnp.abs(u))))

        def corrected(reached: Any) -> Any:
            count, u, _ = reached
            tried = u - PARTS[:, None] * dot(inverse(jax.jacfwd(left)(u)), left(u))
            best = tried[jnp.argmin(jnp.sum(jax.vmap(left)(tried) ** 2, axis=1))]
            return count + 1, best, jnp.max(jnp.abs(best - u))

        B, hu = self.bending_damping, self.z_layout.get(history.z, "u")
        smooth = inverse(self.bending_stiffness_at(s) + history.c0 * B)
        start = dot(smooth, m + self.actuation(control) - dot(B, hu))
        begun = (0, jax.lax.stop_gradient(start), jnp.inf)
        _, u, _ = jax.lax.while_loop(goes_on, corrected, begun)
        slope = jax.lax.stop_gradient(inverse(jax.jacfwd(left)(u)))
        return u - dot(slope, self._moment(s, u, control, x, history) - m)
