"""Effects of tendons whose tensions are measured: their places, load cells, ribs and friction."""

from __future__ import annotations

from typing import Any

import numpy as np

from knode_cosserat.estimation.parameters import Effect, Number, Replace
from knode_cosserat.identification.effects import Usual, register
from knode_cosserat.rods.loads import AttachedMass
from knode_cosserat.rods.tendon_robots import RoutedTendonRobot
from knode_cosserat.rods.tendons import EarlyAnchors, LoadCells, RibSpacing, TendonFriction, Vibration

#: place of the last rib before the tip, if the robot states none
LAST_RIB = 8.0 / 9.0


@register(order=1)
def tendon_effects(nominal: RoutedTendonRobot, usual: Usual) -> list[Effect]:
    """Return the effects of tendons; a robot with reels has only those that it states."""
    pulled = nominal.drive != "reel"
    return [
        *(_place_effects(nominal) if nominal.routing is None else []),
        *(_load_cell_effects(nominal, usual.tension) if pulled else []),
        *_rib_effects(nominal, usual.bodies),
        *(_friction_effects(nominal, usual) if pulled or nominal.friction is not None else []),
    ]


def _numbers(label: str, unit: str, values: Any, *limits: Any, **options: Any) -> tuple[Number, ...]:
    """Return one number for each value."""
    return tuple(
        Number(f"{label}[{k}]", unit, float(value), *limits, **options) for k, value in enumerate(values)
    )


def _place_effects(nominal: RoutedTendonRobot) -> list[Effect]:
    offset = Number("tendon_offset", "m", float(nominal.tendon_offset) or 1e-3, 0.1, 1e-5, 1.0, True)
    return [
        Effect(
            "tendon offset", "distance of the tendons from the axis", (offset,), Replace(("tendon_offset",)),
            usual=True,
        ),
        Effect(
            "tendon angles", "angles of the tendons about the rod",
            _numbers("tendon_angles", "rad", np.asarray(nominal.tendon_angles), 0.06),
            Replace(("tendon_angles",), "vector"),
        ),
        Effect(
            "tendon twist", "turn of ribs, and the tendons in them, about the rod from base to tip",
            (Number("tendon_twist", "rad", float(nominal.tendon_twist or 0.0), 0.06),),
            Replace(("tendon_twist",)), lambda robot: robot.replace(tendon_twist=robot.tendon_twist or 0.0),
        ),
    ]  # fmt: skip


def _load_cell_effects(nominal: RoutedTendonRobot, tension: float) -> list[Effect]:
    cells = _with_cells(nominal).load_cells
    # of a usual size: a few samples of 20 to 50 Hz
    late = Number("load_cells.latency", "s", float(cells.latency), 0.02, -0.2, 0.2)
    return [
        Effect(
            "load cell gains", "ratio of each tendon's tension to the reading of its load cell",
            _numbers("load_cells.gain", "", cells.gain, 0.05, 0.1, 10.0, True),
            Replace(("load_cells.gain",), "vector"), _with_cells,
        ),
        Effect(
            "load cell offsets", "tension of each tendon at a reading of zero",
            _numbers("load_cells.offset", "N", cells.offset, 0.03 * tension),
            Replace(("load_cells.offset",), "vector"), _with_cells,
        ),
        Effect(
            "early anchors", "tendons that are anchored at the last rib before the tip",
            _numbers("anchors.share", "", np.ones(nominal.tendon_count), 0.5, 0.0, 1.0, begin=-0.3),
            Replace(("anchors.share",), "vector"), _anchored,
        ),
        Effect(
            "latency", "delay of the load cells' readings behind the poses", (late,),
            Replace(("load_cells.latency",)), _with_cells, of_recordings=True,
        ),
    ]  # fmt: skip


def _rib_effects(nominal: RoutedTendonRobot, bodies: tuple[float, ...]) -> list[Effect]:
    L, stated = float(nominal.length), nominal.rib_spacing
    if nominal.drive == "reel" and stated is None:
        return []
    masses = [load for load in nominal.loads if isinstance(load, AttachedMass)]
    places = sorted({load.at for load in masses if load.at > 0.0 and float(load.mass) > 0.0})
    # several masses are ribs, as a rule
    ribs = stated or RibSpacing(
        at=next((tuple(it) for it in (places, bodies) if len(it) > 1), None), share=0.0
    )

    def ribbed(robot: Any) -> Any:
        return robot.replace(rib_spacing=ribs)

    softening = Number(
        "rib_spacing.softening", "m2", float(ribs.softening), (0.2 * L) ** 2 / 12.0, 0.0, L**2, begin=0.3
    )
    share = Number("rib_spacing.share", "", float(ribs.share), 0.5, 0.0, 10.0, begin=0.5)
    effects = [
        Effect(
            "rib spacing", "softer bending under tension, because tendons are straight between ribs",
            (softening,), Replace(("rib_spacing.softening",)), ribbed,
        ),
        Effect(
            "rib spans", "softer bending under tension between ribs, or bodies, of known places", (share,),
            Replace(("rib_spacing.share",)), ribbed,
        ),
    ]  # fmt: skip
    return effects if ribs.at is not None else effects[:1]


def _friction_effects(nominal: RoutedTendonRobot, usual: Usual) -> list[Effect]:
    """Return friction, and its loss where tensions are measured."""
    L, known = float(nominal.length), nominal.friction or TendonFriction()
    wobble, curvature, at_rest = map(float, (known.wobble, known.curvature, known.at_rest))
    reach = float(known.reach) if wobble or curvature else 0.06 / L
    # above the usual tension: a robot that shakes at rest has no friction to identify
    shaking = 0.5 * (usual.tension * nominal.tendon_count + usual.highest)
    width = max(0.5 * (usual.highest - shaking), 0.05 * usual.highest)
    friction = (
        Number("friction.wobble", "1/m", wobble, 0.2 / L, 0.0, 100.0, begin=0.5),
        Number("friction.reach", "1/m", reach, 1.0, 1e-4, 100.0, True, shape=True),
        Number("friction.at_rest", "", at_rest, 1.0, -1.0, 1.0, begin=0.3, shape=True),
    )
    vibration = (
        Number("vibration.tension", "N", shaking, width, 0.0, 1e6, shape=True),
        Number("vibration.rate", "1/(N s)", 0.0, 0.5, 0.0, 1e3, begin=0.5),
        Number("vibration.softening", "m2", 0.0, (0.1 * L) ** 2 / 12.0, 0.0, L**2, begin=0.3),
    )
    effects = [
        Effect(
            "friction", "friction of the tendons by their length, with its hysteresis", friction,
            Replace(("friction.wobble", "friction.reach", "friction.at_rest")), _rubbing, usual=True,
        ),
        Effect(
            "friction by curvature", "friction of the tendons by the angle they turn",
            (Number("friction.curvature", "1/rad", curvature, 0.1, 0.0, 10.0, begin=0.3),),
            Replace(("friction.curvature",)), _rubbing, needs=("friction",), usual=True,
        ),
        Effect(
            "vibration", "loss of friction where high tensions make the robot shake", vibration,
            Replace(("vibration.tension", "vibration.rate", "vibration.softening")),
            lambda robot: robot.replace(vibration=robot.vibration or Vibration(tension=1e6, rate=0.0)),
            needs=("friction",), usual=True,
        ),
    ]  # fmt: skip
    return effects if nominal.drive != "reel" else effects[:2]


# parts that effects change, where a robot lacks them


def _with_cells(robot: Any) -> Any:
    count = robot.tendon_count
    cells = robot.load_cells or LoadCells(gain=np.ones(count), offset=np.zeros(count))
    return robot.replace(load_cells=cells)


def _anchored(robot: Any) -> Any:
    """Return the robot with anchors at the last mass before the tip, or at a usual place."""
    ribs = [load.at for load in robot.loads if isinstance(load, AttachedMass) and 0.0 < load.at < 1.0]
    anchors = EarlyAnchors(at=max(ribs, default=LAST_RIB), share=np.ones(robot.tendon_count))
    return robot.replace(anchors=robot.anchors or anchors)


def _rubbing(robot: Any) -> Any:
    return robot.replace(friction=robot.friction or TendonFriction())
