"""Effects of robots with reels or stated routing: geometry, springs, and the lengths that reels take in.

Angles and poses alone do not determine the scale of forces: stiffness, springs and masses can grow together.
The specified weights (density, masses) determine it.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np

from knode_cosserat.estimation.parameters import Number, PossibleEffect, numbers_at
from knode_cosserat.identification.effects import Usual, register
from knode_cosserat.rods.routing import Straight
from knode_cosserat.rods.tendon_robots import RoutedTendonRobot
from knode_cosserat.rods.tendons import Reels

#: uncertainty of the wound-up length, as a fraction of the rod's length, and of tendon angles (rad)
TAKEN_IN, TURN = 0.01, 0.1


@register(order=2, of=RoutedTendonRobot)
def reel_effects(nominal: RoutedTendonRobot, usual: Usual) -> list[PossibleEffect]:
    """Return the effects of a robot with reels, or with stated routing."""
    if nominal.drive != "reel":
        return routing_effects(nominal)
    L, tendons = float(nominal.length), nominal.tendon_count
    reels = nominal.reels or Reels(motors=np.arange(1.0, tendons + 1.0))
    ends = np.array([routing.end for routing in nominal.routings])
    # tendons that end together
    levels, inverse = np.unique(ends, return_inverse=True)
    level_of = tuple(inverse.ravel().tolist())
    zero, taken_in, compliance = (
        np.zeros(count) if stated is None else np.asarray(stated)
        for stated, count in (
            (reels.zero, reels.motor_count(tendons)),
            (reels.taken_in, tendons),
            (reels.compliance, tendons),
        )
    )
    radii = None if reels.radius is None else np.asarray(reels.radius, dtype=float)
    widths = np.broadcast_to(TAKEN_IN * L / (1.0 if radii is None else radii), zero.shape)
    lengths = tuple(
        Number(f"taken_in to {end:g} L", "m", float(np.mean(taken_in[ends == end])), TAKEN_IN * L)
        for end in levels
    )
    springs = tuple(
        _spring(f"compliance to {end:g} L", float(np.mean(compliance[ends == end])), nominal)
        for end in levels
    )
    unit = "m" if radii is None else "rad"
    zeros = tuple(
        Number(f"reels.zero[{k}]", unit, float(zero[k]), float(widths[k])) for k in range(len(zero))
    )
    axial = (Number("shear_stiffness", "", 1.0, 1.0, 1e-6, 1e6, True),)
    elastic = (_spring("tendon_compliance", float(nominal.tendon_compliance), nominal),)
    effects = [
        PossibleEffect("length", numbers_at(nominal, "length", 0.05, logarithmic=True)),
        PossibleEffect("axial stiffness", axial, _with_axial_stiffness),
        PossibleEffect("motor zeros", zeros, part=_with_part("zero", zero)),
        PossibleEffect(
            "taken in", lengths, _ByLevel("reels.taken_in", level_of), _with_part("taken_in", taken_in)
        ),
        PossibleEffect(
            "springs", springs, _ByLevel("reels.compliance", level_of), _with_part("compliance", compliance)
        ),
        PossibleEffect("tendon elasticity", elastic),
    ]
    if radii is not None:
        single = numbers_at(nominal, "reels.radius", 0.05, low=1e-6, high=1.0, logarithmic=True)
        common = (Number("reels.radius", "", 1.0, 0.2, 0.01, 100.0, True),)
        effects += [
            PossibleEffect("reel radius", common, _with_radius),
            PossibleEffect(
                "reel radii", single, lambda robot, v: _with_radius(robot, [jnp.stack(v) / radii])
            ),
        ]
    return [*effects, *routing_effects(nominal)]


def routing_effects(nominal: RoutedTendonRobot) -> list[PossibleEffect]:
    """Return effects that move straight tendons about the rod, if the robot states where they run."""
    routing = nominal.routing
    if routing is None or not all(isinstance(tendon, Straight) for tendon in routing):
        return []
    reels = nominal.reels
    motors = np.arange(1, len(routing) + 1) if reels is None else np.abs(np.asarray(reels.motors)).astype(int)

    def turned(robot: Any, scale: Any, angles: list[Any]) -> Any:
        tendons = []
        for tendon, angle in zip(robot.routing, angles, strict=True):
            c, s = scale * jnp.cos(angle), scale * jnp.sin(angle)
            x, y = c * tendon.x - s * tendon.y, s * tendon.x + c * tendon.y
            tendons.append(dataclasses.replace(tendon, x=x, y=y))
        return robot.replace(routing=tuple(tendons))

    together = (
        Number("routing.offset", "", 1.0, 0.1, 0.01, 100.0, True),
        Number("routing.turn", "rad", 0.0, TURN),
    )
    single = tuple(Number(f"routing.turn[{k}]", "rad", 0.0, 0.5 * TURN) for k in range(motors.max()))
    return [
        PossibleEffect("routing", together, lambda robot, v: turned(robot, v[0], [v[1]] * len(routing))),
        PossibleEffect(
            "routing by motor", single, lambda robot, v: turned(robot, 1.0, [v[k - 1] for k in motors])
        ),
    ]


@dataclasses.dataclass(frozen=True)
class _ByLevel:
    """Replaces a parameter of all tendons by numbers of their levels: where they end."""

    parameter: str
    level_of: tuple[int, ...]

    def __call__(self, robot: Any, values: list[Any]) -> Any:
        """Return the robot with these values."""
        return robot.replace(**{self.parameter: jnp.stack([values[k] for k in self.level_of])})


def _with_axial_stiffness(robot: Any, values: list[Any]) -> Any:
    return robot.replace(shear_stiffness=robot.Kse * values[0])


def _with_radius(robot: Any, values: list[Any]) -> Any:
    return robot.replace(**{"reels.radius": robot.reels.radius * values[0]})


def _with_part(name: str, value: Any) -> Any:
    """Return a function that gives a robot reels with a parameter."""

    def added(robot: Any) -> Any:
        reels = robot.reels or Reels(motors=np.arange(1.0, robot.tendon_count + 1.0))
        return robot.replace(reels=dataclasses.replace(reels, **{name: value}))

    return added


def _spring(label: str, stated: float, robot: RoutedTendonRobot) -> Number:
    """Return the compliance of springs; beside a usual one the rod bends by as much again."""
    if stated:
        return Number(label, "m/N", stated, 0.7, 0.0, 1.0, True)
    offset = float(np.mean([np.linalg.norm([float(at) for at in it.at(0.0)]) for it in robot.routings]))
    usual = offset**2 * float(robot.length) / float(robot.Kbt[0, 0])
    return Number(label, "m/N", 0.0, usual, 0.0, 1.0, begin=0.3)
