"""A system of your own: an elastic string in the vertical plane, hung between a nail and a moving hand.

The general class (paper eqs. 1-4) needs A, B, f1 of  A y_s + B y_st = f1  and C, D, f2 of  C z + D z_t = f2,
what y and z hold, and what is known at the two ends. Simulation, equilibrium, derivatives and batches follow.

    p  position (m)     n  tension as a vector (N)     q  velocity (m/s)     T  tension (N)

    p_s = (1 + T/EA) n/T            n_s = ρ q_t + c q - ρ g            q_s = p_st            T = |n|
"""

from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
import typer

import knode_cosserat as kc


class HangingString(kc.System):
    """Pinned at the origin; the control is where the hand holds the other end."""

    y_layout: ClassVar = kc.Layout(
        ("p", 2, "m", "position"), ("n", 2, "N", "tension"), ("q", 2, "m/s", "velocity")
    )
    z_layout: ClassVar = kc.Layout(("T", 1, "N", "tension"))
    control_layout: ClassVar = kc.Layout(("hand", 2, "m", "position of the hand"))
    base_unknowns: ClassVar = ("n",)

    length: Any = kc.parameter("m", "unstretched length", low=0.01, high=100.0)
    density: Any = kc.parameter("kg/m", "mass per length", low=1e-6, high=100.0)
    stiffness: Any = kc.parameter("N", "EA", low=1e-3, high=1e9)
    friction: Any = kc.parameter("kg/(m s)", "drag of the air", low=0.0, high=100.0, default=0.0)

    def constitutive(self, s, t, y, y_t, control):  # C z + D z_t = f2
        n = self.y_layout.get(y, "n")
        return jnp.eye(1), jnp.zeros((1, 1)), jnp.sqrt(jnp.sum(n**2))[None]

    def balance(self, s, t, y, y_t, z, z_t, control):  # A y_s + B y_st = f1
        n, q, q_t = (self.y_layout.get(part, name) for part, name in ((y, "n"), (y, "q"), (y_t, "q")))
        B = jnp.zeros((6, 6)).at[4:, :2].set(-jnp.eye(2))
        weight = self.density * jnp.array([0.0, -9.81])
        p_s = (1.0 + z / self.stiffness) * n / z
        return (
            jnp.eye(6),
            B,
            jnp.concatenate([p_s, self.density * q_t + self.friction * q - weight, jnp.zeros(2)]),
        )

    def rest(self, s):  # where iterations start: a catenary, pulled with a fifth of its weight
        a, x = 0.2 * self.length, s - 0.5 * self.length
        span = a * (jnp.arcsinh(x / a) + jnp.arcsinh(0.5 * self.length / a))
        drop = jnp.hypot(x, a) - jnp.hypot(0.5 * self.length, a)
        n = 9.81 * self.density * jnp.stack([a, x])
        return jnp.concatenate([jnp.stack([span, drop]), n, jnp.zeros(2)]), jnp.sqrt(jnp.sum(n**2))[None]

    def tip(self, t, control, y, history):  # the hand holds it
        return self.y_layout.get(y, "p") - control

    def scales(self):
        weight, speed = self.density * 9.81 * self.length, jnp.sqrt(9.81 * self.length)
        sizes = jnp.stack([jnp.asarray(x, dtype=float) for x in (self.length, weight, speed)])
        return kc.Scales(jnp.repeat(sizes, 2), jnp.full(2, self.length))


def main(out: str = "hanging_string.png", steps: int = 100) -> kc.Trajectory:
    """Let the string hang, then swing it by moving the hand."""
    string = HangingString(length=1.0, density=0.1, stiffness=1e3, friction=0.05, nodes=41)
    hanging = kc.equilibrium(string, np.array([0.6, 0.0]), space="rk4")
    t = np.arange(1, steps + 1) * 0.02
    hand = np.stack([0.6 + 0.05 * np.sin(2 * np.pi * t), np.zeros_like(t)], axis=1)
    swing = kc.simulate(string, hand, 0.02, space="rk4", initial=hanging)
    kc.figures.shape(swing, count=9).savefig(out)
    print(f"lowest point at rest {hanging.part('p')[0, :, 1].min():.4f} m; picture: {out}")
    return swing


if __name__ == "__main__":
    typer.run(main)
