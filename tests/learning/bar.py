"""The smallest rod: a bar that is pulled at its end, for tests in which the robot does not matter."""

from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np

import knode_cosserat as kc


class Bar(kc.System):
    """Clamped at s = 0 and pulled at the other end; it stretches, swings and is slowed down by the air."""

    y_layout: ClassVar = kc.robots.Layout(
        ("p", 1, "m", "position"), ("n", 1, "N", "internal force"), ("q", 1, "m/s", "velocity")
    )
    z_layout: ClassVar = kc.robots.Layout(("v", 1, "1", "stretch"))
    control_layout: ClassVar = kc.robots.Layout(("pull", 1, "N", "force at the end"))
    base_unknowns: ClassVar = ("n",)
    mixed: ClassVar = False

    length: Any = kc.robots.parameter("m", "length", low=0.01, high=100.0)
    density: Any = kc.robots.parameter("kg/m", "mass per length", low=1e-6, high=100.0)
    stiffness: Any = kc.robots.parameter("N", "EA", low=1e-3, high=1e9)
    damping: Any = kc.robots.parameter("N s", "of the material", low=0.0, high=1e3, default=0.0)
    drag: Any = kc.robots.parameter("kg/m2", "of the air, square law", low=0.0, high=100.0, default=0.0)

    def constitutive(self, s, t, y, y_t, control):
        return self.stiffness * jnp.eye(1), self.damping * jnp.eye(1), y[1:2] + self.stiffness

    def balance(self, s, t, y, y_t, z, z_t, control):
        q = y[2:]
        return jnp.concatenate([z, self.density * y_t[2:] + self.drag * q * jnp.abs(q), z_t])

    def rest(self, s):
        return jnp.stack([jnp.asarray(s, dtype=float), jnp.zeros(()), jnp.zeros(())]), jnp.ones(1)

    def tip(self, t, control, y, y_t):
        return control - y[1:2]


BAR = Bar(length=1.0, density=1.0, stiffness=20.0, damping=0.4, drag=0.5, nodes=6)
#: too stiff, and in a vacuum
WRONG = BAR.replace(stiffness=30.0, drag=0.0)


def pulled(period: float, steps: int = 20, robot: kc.System = BAR, **options: Any) -> kc.Trajectory:
    """What a bar does when it is pulled to and fro."""
    pull = 2.0 * np.sin(2 * np.pi * np.arange(1, steps + 1) * 0.1 / period)[:, None]
    return kc.simulate(robot, pull, 0.1, **options)
