"""Robots with effects that the library does not have, each a part or a load of the test's own."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial

import knode_cosserat as kc
from knode_cosserat.robots import Effect, RoutedTendonRobot, Wrench, loads, parameter
from knode_cosserat.rods.parts import Stretched

ROBOT = RoutedTendonRobot.like(kc.load_robot("delrin-tendon-robot")).replace(
    length=0.4, radius=0.003, youngs_modulus=2.0e9, tendon_offset=0.02, nodes=13
)
#: fractions of the length that are measured
FRACTIONS = np.array([4.0, 8.0, 12.0]) / 12.0
NOISE = 2e-4


class Kink(Stretched, Effect):
    """A kink in the sheath of the first tendon: it loses tension there, by how far the rod bends."""

    wall: Any = parameter("1/rad", "loss by the angle that the rod bends there", low=0.0, high=100.0)

    def y_fields(self, rod):
        return (("kink", 1, "1", "logarithm of the tension that the first tendon has lost"),)

    def rates(self, point):
        x, y, _ = point.get("u")
        bend = jnp.sqrt(x * x + y * y + 1e-4) - 1e-2
        return {"kink": jnp.reshape(self.indicator(point) * self.wall * bend, (1,))}

    def transmitted(self, point, tension):
        return tension.at[0].multiply(jnp.exp(-point.get("kink")[0]))


class LooseRib(Stretched, Effect):
    """A rib with play: the tendons together push it, and themselves, to the side on which they pull."""

    play: Any = parameter("m", "way of the rib to each side", low=0.0, high=0.1)
    moment: Any = parameter("N m", "moment of the tendons that holds it at an end", low=1e-6, high=1.0)

    def law(self, point, law, internal):
        r, T = law.coupling.r, law.coupling.tension
        pull = jnp.sum(T[:, None] * r, axis=0)
        way = self.play * pull / jnp.sqrt(jnp.sum(pull * pull) + self.moment**2)
        return law._replace(coupling=law.coupling._replace(r=r + self.indicator(point) * way))


class Cable(loads.PointLoad):
    """A cable from the tip to a place beside the base: elastic, slack below its length, and its weight."""

    stiffness: Any = parameter("N/m", "of the cable", low=0.0, high=1e6)
    free: Any = parameter("m", "its length", low=0.0, high=10.0)
    weight: Any = parameter("N", "part of its weight that hangs on the tip", low=0.0, high=10.0)
    anchor: Any = parameter("m", "its other end", shape="vector", low=-10.0, high=10.0)

    def wrench(self, motion, control):
        way = self.anchor - motion.p
        far = jnp.sqrt(jnp.sum(way * way) + 1e-8)
        taut = far - self.free
        taut = 0.5 * (taut + jnp.sqrt(taut**2 + 1e-6))
        down = self.weight * np.array([0.0, 0.0, -1.0])
        return Wrench(self.stiffness * taut / far * way + down, jnp.zeros(3))


class OneWay(Effect):
    """Bending that is stiffer where the curvature about the first axis is positive."""

    stiffer: Any = parameter("N m2", "stiffness more", low=0.0, high=1e3)

    def law(self, point, law, internal):
        return law.with_strain("u", law.strains["u"]._replace(moment=Partial(one_way, self.stiffer)))


def one_way(stiffer, u, u_t):
    """Return the moment of the stiffness that is there in one sense only."""
    return stiffer * jnp.stack([jnp.maximum(u[0], 0.0), 0.0, 0.0])


ROBOTS = {
    "kink": ROBOT.replace(effects=(Kink(wall=12.0, begin=0.3, end=0.45),)),
    "rib": ROBOT.replace(effects=(LooseRib(play=0.004, moment=0.004, begin=0.45, end=0.6),)),
    "cable": ROBOT.replace(
        loads=(*ROBOT.loads, Cable(stiffness=12.0, free=0.465, weight=0.01, anchor=(0.25, 0.05, 0.02)))
    ),
    "one way": ROBOT.replace(effects=(OneWay(stiffer=0.06),)),
}


def equilibria(robot, seed, count, high=6.0):
    """Noisy poses of a robot in equilibria under random tensions (N)."""
    rng = np.random.default_rng(seed)
    control = rng.uniform(0.0, high, (count, 4))
    states = kc.equilibrium(robot, control, space="lobatto4")
    nodes = np.round(FRACTIONS * (robot.nodes - 1)).astype(int)
    position = np.asarray(states.position)[:, 0, nodes]
    return kc.recordings.Measurements(
        time=np.arange(count, dtype=float),
        control=control,
        fractions=FRACTIONS,
        position=position + NOISE * rng.normal(size=position.shape),
        quaternion=np.full((*position.shape[:2], 4), np.nan),
        measured=np.ones(position.shape[:2], dtype=bool),
        simulated=True,
        static=True,
        source=f"equilibria {seed}",
    )
