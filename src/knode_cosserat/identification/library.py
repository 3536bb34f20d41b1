"""Library of identifiable effects: which of them a robot may have."""

from __future__ import annotations

from knode_cosserat.identification.effects import Effect
from knode_cosserat.identification.reel_effects import reel_effects, routing_effects
from knode_cosserat.identification.rod_effects import rod_effects
from knode_cosserat.identification.tendon_effects import tendon_effects
from knode_cosserat.rods.routed_robot import RoutedTendonRobot

#: effects of measured tensions, which a robot with reels does not have
OF_TENSIONS = ("load cell gains", "load cell offsets", "early anchors", "vibration", "latency")
#: effects of tendons that are given by their offset and angles, and of friction
OF_ANGLES = ("tendon offset", "tendon angles", "tendon twist")
OF_FRICTION = ("friction", "friction by curvature")
#: uncertainty of the clamped end's position, as a fraction of the length
PLACED_BY_REELS = 0.03
#: the same of a robot whose tensions are measured
PLACED = 0.004


def effects_of(nominal: RoutedTendonRobot, tensions: float, highest: float) -> list[Effect]:
    """Return the effects that a robot may have, depending on the drive of its tendons.

    Args:
        nominal: the robot as it is known, with the parts that effects need (see `model.extended`).
        tensions: a usual tension of one tendon (N).
        highest: the highest tension of all tendons together (N).
    """
    pulled = nominal.drive != "reel"
    gone = set() if nominal.routing is None else {*OF_ANGLES}
    if nominal.rib_spacing is None or nominal.rib_spacing.at is None:
        gone |= {"rib spans"}
    if not pulled:
        gone |= {*OF_TENSIONS}
        # effects that cost time in each step are candidates only if the nominal robot states them
        gone |= set() if nominal.friction is not None else {*OF_FRICTION}
        gone |= set() if nominal.rib_spacing is not None else {"rib spacing"}
    known = [
        *rod_effects(nominal, PLACED if pulled else PLACED_BY_REELS),
        *tendon_effects(nominal, tensions, highest),
    ]
    own = routing_effects(nominal) if pulled else reel_effects(nominal)
    return [*(each for each in known if each.name not in gone), *own]
