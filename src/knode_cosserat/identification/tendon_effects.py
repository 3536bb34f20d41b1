"""Effects of tendons whose tensions are measured: their places, load cells, ribs and friction."""

from __future__ import annotations

from typing import Any

import numpy as np

from knode_cosserat.estimation.parameters import Number, PossibleEffect, numbers_at
from knode_cosserat.identification.effects import Usual, register
from knode_cosserat.rods.loads import AttachedMass
from knode_cosserat.rods.tendon_robots import RoutedTendonRobot
from knode_cosserat.rods.tendons import EarlyAnchors, LoadCells, RibSpacing, TendonFriction, Vibration

#: place of the last rib before the tip, if the robot states none
LAST_RIB = 8.0 / 9.0
#: range of numbers that only their priors bound
UNBOUNDED = {"low": -np.inf, "high": np.inf}


@register(order=1, of=RoutedTendonRobot)
def tendon_effects(nominal: RoutedTendonRobot, usual: Usual) -> list[PossibleEffect]:
    """Return the effects of tendons; a robot with reels has only those that it states."""
    pulled = nominal.drive != "reel"
    return [
        *(_place_effects(nominal) if nominal.routing is None else []),
        *(_load_cell_effects(nominal, usual.tension) if pulled else []),
        *_rib_effects(nominal, usual.bodies),
        *(_friction_effects(nominal, usual) if pulled or nominal.friction is not None else []),
    ]


def _place_effects(nominal: RoutedTendonRobot) -> list[PossibleEffect]:
    offset = Number("tendon_offset", "m", float(nominal.tendon_offset) or 1e-3, 0.1, 1e-5, 1.0, True)
    twisted = nominal.replace(tendon_twist=nominal.tendon_twist or 0.0)
    return [
        PossibleEffect("tendon offset", (offset,), usual=True),
        PossibleEffect("tendon angles", numbers_at(nominal, "tendon_angles", 0.06, **UNBOUNDED)),
        PossibleEffect(
            "tendon twist",
            numbers_at(twisted, "tendon_twist", 0.06, **UNBOUNDED),
            part=lambda robot: robot.replace(tendon_twist=robot.tendon_twist or 0.0),
        ),
    ]


def _load_cell_effects(nominal: RoutedTendonRobot, tension: float) -> list[PossibleEffect]:
    cells = _with_cells(nominal)
    gain = numbers_at(cells, "load_cells.gain", 0.05, low=0.1, high=10.0, logarithmic=True)
    # of a usual size: a few samples of 20 to 50 Hz
    late = numbers_at(cells, "load_cells.latency", 0.02, low=-0.2, high=0.2)
    share = numbers_at(_anchored(nominal), "anchors.share", 0.5, nominal=1.0, low=0.0, high=1.0, begin=-0.3)
    return [
        PossibleEffect("load cell gains", gain, part=_with_cells),
        PossibleEffect(
            "load cell offsets",
            numbers_at(cells, "load_cells.offset", 0.03 * tension, **UNBOUNDED),
            part=_with_cells,
        ),
        PossibleEffect("early anchors", share, part=_anchored),
        PossibleEffect("latency", late, part=_with_cells, of_recordings=True),
    ]


def _rib_effects(nominal: RoutedTendonRobot, bodies: tuple[float, ...]) -> list[PossibleEffect]:
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

    usual = (0.2 * L) ** 2 / 12.0
    softening = numbers_at(ribbed(nominal), "rib_spacing.softening", usual, high=L**2, begin=0.3)
    share = numbers_at(ribbed(nominal), "rib_spacing.share", 0.5, begin=0.5)
    effects = [
        PossibleEffect("rib spacing", softening, part=ribbed),
        PossibleEffect("rib spans", share, part=ribbed),
    ]
    return effects if ribs.at is not None else effects[:1]


def _friction_effects(nominal: RoutedTendonRobot, usual: Usual) -> list[PossibleEffect]:
    """Return friction, and its loss where tensions are measured."""
    L, rubbing = float(nominal.length), _rubbing(nominal)
    known = rubbing.friction
    reach = float(known.reach) if float(known.wobble) or float(known.curvature) else 0.06 / L
    # above the usual tension: a robot that shakes at rest has no friction to identify
    shaking = 0.5 * (usual.tension * nominal.tendon_count + usual.highest)
    width = max(0.5 * (usual.highest - shaking), 0.05 * usual.highest)
    friction = (
        *numbers_at(rubbing, "friction.wobble", 0.2 / L, begin=0.5),
        *numbers_at(rubbing, "friction.reach", 1.0, nominal=reach, logarithmic=True, shape=True),
        *numbers_at(rubbing, "friction.at_rest", 1.0, begin=0.3, shape=True),
    )
    curvature = numbers_at(rubbing, "friction.curvature", 0.1, begin=0.3)
    vibration = (
        Number("vibration.tension", "N", shaking, width, 0.0, 1e6, shape=True),
        Number("vibration.rate", "1/(N s)", 0.0, 0.5, 0.0, 1e3, begin=0.5),
        Number("vibration.softening", "m2", 0.0, (0.1 * L) ** 2 / 12.0, 0.0, L**2, begin=0.3),
    )
    effects = [
        PossibleEffect("friction", friction, part=_rubbing, usual=True),
        PossibleEffect("friction by curvature", curvature, part=_rubbing, needs=("friction",), usual=True),
        PossibleEffect("vibration", vibration, part=_vibrating, needs=("friction",), usual=True),
    ]
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


def _vibrating(robot: Any) -> Any:
    return robot.replace(vibration=robot.vibration or Vibration(tension=1e6, rate=0.0))
