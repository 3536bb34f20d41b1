"""Effects of tendons whose tensions are measured: their places, load cells, ribs and friction."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

from knode_cosserat.identification.effects import Effect, Number, Replace, ReplaceInPart, Usual, register
from knode_cosserat.rods.loads import AttachedMass
from knode_cosserat.rods.tendon_robots import RoutedTendonRobot
from knode_cosserat.rods.tendons import EarlyAnchors, LoadCells, RibSpacing, TendonFriction, Vibration

#: place of the last rib before the tip, if the robot states none
LAST_RIB = 8.0 / 9.0


@register(order=1)
def tendon_effects(nominal: RoutedTendonRobot, usual: Usual) -> list[Effect]:
    """Return the effects of tendons; a robot with reels has those only that it states."""
    pulled = nominal.drive != "reel"
    return [
        *(_place_effects(nominal) if nominal.routing is None else []),
        *(_load_cell_effects(nominal, usual.tension) if pulled else []),
        *_rib_effects(nominal, usual.bodies),
        *(_friction_effects(nominal, usual) if pulled or nominal.friction is not None else []),
    ]


def _place_effects(nominal: RoutedTendonRobot) -> list[Effect]:
    return [
        Effect(
            "tendon offset",
            "distance of the tendons from the axis",
            (Number("tendon_offset", "m", float(nominal.tendon_offset) or 1e-3, 0.1, 1e-5, 1.0, True),),
            Replace(("tendon_offset",)),
            usual=True,
        ),
        Effect(
            "tendon angles",
            "angles of the tendons about the rod",
            tuple(
                Number(f"tendon_angles[{k}]", "rad", float(angle), 0.06)
                for k, angle in enumerate(np.asarray(nominal.tendon_angles))
            ),
            _with_angles,
        ),
        Effect(
            "tendon twist",
            "angle by which ribs, and the tendons in them, turn about the rod from base to tip",
            (Number("tendon_twist", "rad", float(nominal.tendon_twist or 0.0), 0.06),),
            Replace(("tendon_twist",)),
            lambda robot: robot.replace(tendon_twist=robot.tendon_twist or 0.0),
        ),
    ]


def _load_cell_effects(nominal: RoutedTendonRobot, tensions: float) -> list[Effect]:
    count = nominal.tendon_count
    cells = nominal.load_cells or LoadCells(gain=np.ones(count), offset=np.zeros(count))
    gain, offset = (np.asarray(each, dtype=float) for each in (cells.gain, cells.offset))
    # of a usual size: a few samples of 20 to 50 Hz
    late = Number("load_cells.latency", "s", float(cells.latency), 0.02, -0.2, 0.2)
    return [
        Effect(
            "load cell gains",
            "tension of each tendon over what its load cell measures",
            tuple(
                Number(f"load_cells.gain[{k}]", "", float(gain[k]), 0.05, 0.1, 10.0, True)
                for k in range(count)
            ),
            ReplaceInPart("load_cells", ("gain",), True),
            _with_cells,
        ),
        Effect(
            "load cell offsets",
            "tension of each tendon where its load cell measures none",
            tuple(
                Number(f"load_cells.offset[{k}]", "N", float(offset[k]), 0.03 * tensions)
                for k in range(count)
            ),
            ReplaceInPart("load_cells", ("offset",), True),
            _with_cells,
        ),
        Effect(
            "early anchors",
            "tendons that are anchored at the last rib before the tip",
            tuple(Number(f"anchors.share[{k}]", "", 1.0, 0.5, 0.0, 1.0, begin=-0.3) for k in range(count)),
            ReplaceInPart("anchors", ("share",), True),
            _anchored,
        ),
        Effect(
            "latency",
            "delay of the load cells' readings behind the poses",
            (late,),
            ReplaceInPart("load_cells", ("latency",)),
            _with_cells,
            of_recordings=True,
        ),
    ]


def _rib_effects(nominal: RoutedTendonRobot, bodies: tuple[float, ...]) -> list[Effect]:
    L, stated = float(nominal.length), nominal.rib_spacing
    ribs = stated or RibSpacing(at=_ribs(nominal) or (bodies if len(bodies) > 1 else None), share=0.0)
    softening, share = float(ribs.softening), float(ribs.share)

    def ribbed(robot: Any) -> Any:
        return robot.replace(rib_spacing=ribs)

    found = [
        Effect(
            "rib spacing",
            "softer bending under tension, for tendons are straight between ribs",
            (
                Number(
                    "rib_spacing.softening", "m2", softening, (0.2 * L) ** 2 / 12.0, 0.0, L**2, begin=0.3
                ),
            ),
            ReplaceInPart("rib_spacing", ("softening",)),
            ribbed,
        ),
        Effect(
            "rib spans",
            "softer bending under tension between the ribs, or bodies, whose places are known",
            (Number("rib_spacing.share", "", share, 0.5, 0.0, 10.0, begin=0.5),),
            ReplaceInPart("rib_spacing", ("share",)),
            ribbed,
        ),
    ]  # fmt: skip
    if nominal.drive == "reel" and stated is None:
        return []
    return found if ribs.at is not None else found[:1]


def _ribs(robot: RoutedTendonRobot) -> tuple[float, ...] | None:
    """Return the places of the robot's masses, if these are several: they are its ribs, as a rule."""
    masses = [load for load in robot.loads if isinstance(load, AttachedMass)]
    found = sorted({load.at for load in masses if load.at > 0.0 and float(load.mass) > 0.0})
    return tuple(found) if len(found) > 1 else None


def _friction_effects(nominal: RoutedTendonRobot, sizes: Usual) -> list[Effect]:
    """Return friction, and its loss where tensions are measured."""
    L, known = float(nominal.length), nominal.friction or TendonFriction()
    wobble, curvature, at_rest = map(float, (known.wobble, known.curvature, known.at_rest))
    reach = float(known.reach) if wobble or curvature else 0.06 / L
    # above the usual tension: a robot that shakes at rest has no friction to be found
    highest = sizes.highest
    shaking = 0.5 * (sizes.tension * nominal.tendon_count + highest)
    shaking_width = max(0.5 * (highest - shaking), 0.05 * highest)
    found = [
        Effect(
            "friction",
            "friction of the tendons by their length, with its hysteresis",
            (
                Number("friction.wobble", "1/m", wobble, 0.2 / L, 0.0, 100.0, begin=0.5),
                Number("friction.reach", "1/m", reach, 1.0, 1e-4, 100.0, True),
                Number("friction.at_rest", "", at_rest, 1.0, -1.0, 1.0, begin=0.3),
            ),
            ReplaceInPart("friction", ("wobble", "reach", "at_rest")),
            _rubbing,
            usual=True,
        ),
        Effect(
            "friction by curvature",
            "friction of the tendons by the angle they turn",
            (Number("friction.curvature", "1/rad", curvature, 0.1, 0.0, 10.0, begin=0.3),),
            ReplaceInPart("friction", ("curvature",)),
            _rubbing,
            needs=("friction",),
            usual=True,
        ),
        Effect(
            "vibration",
            "loss of friction where high tensions make the robot shake",
            (
                Number("vibration.tension", "N", shaking, shaking_width, 0.0, 1e6),
                Number("vibration.rate", "1/(N s)", 0.0, 0.5, 0.0, 1e3, begin=0.5),
                Number("vibration.softening", "m2", 0.0, (0.1 * L) ** 2 / 12.0, 0.0, L**2, begin=0.3),
            ),
            ReplaceInPart("vibration", ("tension", "rate", "softening")),
            _shaken,
            needs=("friction",),
            usual=True,
        ),
    ]
    return found if nominal.drive != "reel" else found[:2]


def _with_angles(robot: Any, values: list[Any]) -> Any:
    return robot.replace(tendon_angles=jnp.stack(values))


def _with_cells(robot: Any) -> Any:
    count = robot.tendon_count
    return robot.replace(
        load_cells=robot.load_cells or LoadCells(gain=np.ones(count), offset=np.zeros(count))
    )


def _anchored(robot: Any) -> Any:
    """Return the robot with anchors at the last mass before the tip, or at a usual place."""
    ribs = [load.at for load in robot.loads if isinstance(load, AttachedMass) and 0.0 < load.at < 1.0]
    anchors = EarlyAnchors(at=max(ribs, default=LAST_RIB), share=np.ones(robot.tendon_count))
    return robot.replace(anchors=robot.anchors or anchors)


def _rubbing(robot: Any) -> Any:
    return robot.replace(friction=robot.friction or TendonFriction())


def _shaken(robot: Any) -> Any:
    return robot.replace(vibration=robot.vibration or Vibration(tension=1e6, rate=0.0))
