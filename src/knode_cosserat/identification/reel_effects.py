"""Effects of robots with reels or stated routing: geometry, springs, and the lengths that reels take in.

Angles and poses alone do not determine the scale of forces: stiffness, springs and masses can grow together.
The specified weights (density, masses) determine it.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np

from knode_cosserat.identification.effects import Effect, Number, ReplaceInPart, Usual, register
from knode_cosserat.rods.routing import Straight
from knode_cosserat.rods.tendon_robots import RoutedTendonRobot
from knode_cosserat.rods.tendons import Reels

#: uncertainty of the wound-up length, as a fraction of the rod's length, and of tendon angles (rad)
TAKEN_IN, TURN = 0.01, 0.1


@register(order=2)
def reel_effects(nominal: RoutedTendonRobot, usual: Usual) -> list[Effect]:
    """Return the effects of a robot with reels, or with stated routing."""
    if nominal.drive != "reel":
        return routing_effects(nominal)
    L, tendons = float(nominal.length), nominal.tendon_count
    reels = nominal.reels or Reels(motors=np.arange(1.0, tendons + 1.0))
    motors, levels = reels.motor_count(tendons), _levels(nominal)
    zero = np.zeros(motors) if reels.zero is None else np.asarray(reels.zero)
    taken_in = np.zeros(tendons) if reels.taken_in is None else np.asarray(reels.taken_in)
    compliance = np.zeros(tendons) if reels.compliance is None else np.asarray(reels.compliance)
    zero_width = np.full(motors, TAKEN_IN * L)
    zero_width = zero_width if reels.radius is None else zero_width / np.asarray(reels.radius)
    effects = [
        Effect(
            "length",
            "length of the rod",
            (Number("length", "m", L, 0.05, 1e-3, 20.0, True),),
            lambda robot, v: robot.replace(length=v[0]),
        ),
        Effect(
            "axial stiffness",
            "stiffness against extension and shear over that of the section",
            (Number("shear_stiffness", "", 1.0, 1.0, 1e-6, 1e6, True),),
            lambda robot, v: robot.replace(shear_stiffness=robot.Kse * v[0]),
        ),
        Effect(
            "motor zeros",
            "angle of each motor at which its reel has taken in nothing",
            tuple(
                Number(f"reels.zero[{k}]", "rad" if reels.radius is not None else "m", float(at), width)
                for k, (at, width) in enumerate(zip(zero, zero_width, strict=True))
            ),
            ReplaceInPart("reels", ("zero",), True),
            _with_part("zero", zero),
        ),
        Effect(
            "taken in",
            "length of tendons that is taken in at the motors' zeros, by where they end",
            tuple(
                Number(f"taken_in to {end:g} L", "m", float(np.mean(taken_in[group])), TAKEN_IN * L)
                for end, group in levels
            ),
            lambda robot, v: _reels(robot, taken_in=_by_level(v, levels, tendons)),
            _with_part("taken_in", taken_in),
        ),
        Effect(
            "springs",
            "compliance of the springs in series with tendons, by where these end",
            tuple(_spring(end, float(np.mean(compliance[group])), nominal) for end, group in levels),
            lambda robot, v: _reels(robot, compliance=_by_level(v, levels, tendons)),
            _with_part("compliance", compliance),
        ),
    ]
    if reels.radius is not None:
        radii = np.asarray(reels.radius, dtype=float)
        effects += [
            Effect(
                "reel radius",
                "radius of all reels over what is known of it",
                (Number("reels.radius", "", 1.0, 0.2, 0.01, 100.0, True),),
                lambda robot, v: _reels(robot, radius=robot.reels.radius * v[0]),
            ),
            Effect(
                "reel radii",
                "radius of each reel",
                tuple(
                    Number(f"reels.radius[{k}]", "m", float(at), 0.05, 1e-6, 1.0, True)
                    for k, at in enumerate(radii)
                ),
                lambda robot, v: _reels(robot, radius=jnp.stack(v) * (robot.reels.radius / radii)),
            ),
        ]
    return [*effects, *routing_effects(nominal)]


def routing_effects(nominal: RoutedTendonRobot) -> list[Effect]:
    """Return effects that move straight tendons about the rod, if the robot states where they run."""
    routing = nominal.routing
    if routing is None or not all(isinstance(each, Straight) for each in routing):
        return []
    reels = nominal.reels
    motors = np.arange(1, len(routing) + 1) if reels is None else np.abs(np.asarray(reels.motors)).astype(int)

    def turned(robot: Any, scale: Any, angles: list[Any]) -> Any:
        found = []
        for each, angle in zip(robot.routing, angles, strict=True):
            c, s = scale * jnp.cos(angle), scale * jnp.sin(angle)
            found.append(dataclasses.replace(each, x=c * each.x - s * each.y, y=s * each.x + c * each.y))
        return robot.replace(routing=tuple(found))

    return [
        Effect(
            "routing",
            "distance of all tendons from the axis over what is known of it, and their rotation about it",
            (
                Number("routing.offset", "", 1.0, 0.1, 0.01, 100.0, True),
                Number("routing.turn", "rad", 0.0, TURN),
            ),
            lambda robot, v: turned(robot, v[0], [v[1]] * len(routing)),
        ),
        Effect(
            "routing by motor",
            "rotation of each motor's tendons, or of each tendon, about the axis",
            tuple(Number(f"routing.turn[{k}]", "rad", 0.0, 0.5 * TURN) for k in range(motors.max())),
            lambda robot, v: turned(robot, 1.0, [v[k - 1] for k in motors]),
        ),
    ]


def _reels(robot: Any, **changes: Any) -> Any:
    return robot.replace(reels=dataclasses.replace(robot.reels, **changes))


def _with_part(name: str, value: Any) -> Any:
    """Return a function that gives a robot reels with a part."""

    def added(robot: Any) -> Any:
        reels = robot.reels or Reels(motors=np.arange(1.0, robot.tendon_count + 1.0))
        return robot.replace(reels=dataclasses.replace(reels, **{name: value}))

    return added


def _levels(robot: RoutedTendonRobot) -> list[tuple[float, np.ndarray]]:
    """Return where tendons end, and which do there."""
    ends = np.array([each.end for each in robot.routings])
    return [(float(end), np.flatnonzero(ends == end)) for end in np.unique(ends)]


def _by_level(values: list[Any], levels: list[tuple[float, np.ndarray]], count: int) -> Any:
    found = [jnp.zeros(())] * count
    for value, (_, group) in zip(values, levels, strict=True):
        for k in group:
            found[k] = value
    return jnp.stack(found)


def _spring(end: float, given: float, robot: RoutedTendonRobot) -> Number:
    """Return the compliance of springs: none is none, and beside a usual one the rod bends as much."""
    label = f"compliance to {end:g} L"
    if given:
        return Number(label, "m/N", given, 0.7, 0.0, 1.0, True)
    offset = float(np.mean([np.linalg.norm([float(at) for at in each.at(0.0)]) for each in robot.routings]))
    usual = offset**2 * float(robot.length) / float(robot.Kbt[0, 0])
    return Number(label, "m/N", 0.0, usual, 0.0, 1.0, begin=0.3)
