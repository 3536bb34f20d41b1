"""A system of your own: an elastic string in the vertical plane, hung between a nail and a moving hand.

In the general class (paper eq. 1): p_s = (1 + T/EA) n/T, n_s = ρ q_t + c q - ρ g, q_s = p_st, T = |n|.
"""

from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np

import knode_cosserat as kc
from knode_cosserat.robots import Layout, Scales, parameter


class HangingString(kc.System):
    """A string pinned at the origin; the control is the position of the other end."""

    y_layout: ClassVar = Layout(("p", 2, "m", "place"), ("n", 2, "N", "force"), ("q", 2, "m/s", "speed"))
    z_layout: ClassVar = Layout(("T", 1, "N", "tension"))
    control_layout: ClassVar = Layout(("hand", 2, "m", "position of the hand"))
    base_unknowns: ClassVar = ("n",)
    length: Any = parameter("m", "unstretched length", low=0.01, high=100.0)
    density: Any = parameter("kg/m", "mass per length", low=1e-6, high=100.0)
    stiffness: Any = parameter("N", "EA", low=1e-3, high=1e9)
    friction: Any = parameter("kg/(m s)", "drag of the air", low=0.0, high=100.0, default=0.0)

    def constitutive(self, s, t, y, y_t, control):  # C z + D z_t = f2
        return jnp.eye(1), jnp.zeros((1, 1)), jnp.linalg.norm(y[2:4])[None]

    def balance(self, s, t, y, y_t, z, z_t, control):  # A y_s + B y_st = f1
        p_s = (1.0 + z / self.stiffness) * y[2:4] / z
        n_s = self.density * (y_t[4:6] + jnp.array([0.0, 9.81])) + self.friction * y[4:6]
        return jnp.eye(6), jnp.zeros((6, 6)).at[4:, :2].set(-jnp.eye(2)), jnp.stack([*p_s, *n_s, 0.0, 0.0])

    def rest(self, s):  # where iterations start: the parabola of a string that sags a little
        x = s / self.length - 0.5
        n = 9.81 * self.density * self.length * jnp.stack([1.0, x])
        return jnp.stack([s, 0.5 * self.length * (x**2 - 0.25), *n, 0.0, 0.0]), jnp.linalg.norm(n)[None]

    def tip(self, t, control, y, y_t):  # the hand holds it
        return y[:2] - control

    def scales(self):  # natural sizes of y, and of what is left at the tip
        sizes = jnp.stack([self.length, 9.81 * self.density * self.length, (9.81 * self.length) ** 0.5])
        return Scales(jnp.repeat(sizes, 2), jnp.repeat(sizes[0], 2))


def main(out: str = "hanging_string.png", steps: int = 100) -> kc.Trajectory:
    """Let the string hang, then swing it by moving the hand."""
    string = HangingString(length=1.0, density=0.1, stiffness=1e3, friction=0.05, nodes=41)
    hanging = kc.equilibrium(string, np.array([0.6, 0.0]), space="lobatto4")
    hand = [[0.6 + 0.05 * np.sin(0.04 * np.pi * i), 0.0] for i in range(1, steps + 1)]
    swing = kc.simulate(string, hand, 0.02, space="lobatto4", initial=hanging)
    kc.figures.shape(swing, count=9).savefig(out)
    return swing


if __name__ == "__main__":
    main()
