"""Effects of tendons whose tensions are measured: their places, load cells, ribs and friction."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np

from knode_cosserat.identification.effects import Effect, Number, Replace, ReplaceInPart
from knode_cosserat.rods.load_cells import LoadCells
from knode_cosserat.rods.rib_spacing import RibSpacing
from knode_cosserat.rods.routed_robot import RoutedTendonRobot
from knode_cosserat.rods.tendon_friction import TendonFriction


def tendon_effects(nominal: RoutedTendonRobot, tensions: float, highest: float) -> list[Effect]:
    """Return the effects of tendons.

    Args:
        nominal: the robot with all parts that effects need.
        tensions: a usual tension of one tendon (N).
        highest: the highest tension of all tendons together (N).
    """
    return [
        *_place_effects(nominal), *_load_cell_effects(nominal, tensions), *_rib_effects(nominal),
        *_friction_effects(nominal, tensions * nominal.tendon_count, highest),
    ]  # fmt: skip


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
            _with_gains,
        ),
        Effect(
            "load cell offsets",
            "tension of each tendon where its load cell measures none",
            tuple(
                Number(f"load_cells.offset[{k}]", "N", float(offset[k]), 0.03 * tensions)
                for k in range(count)
            ),
            _with_offsets,
        ),
        Effect(
            "early anchors",
            "tendons that are anchored at the last rib before the tip",
            tuple(Number(f"anchors.share[{k}]", "", 1.0, 0.5, 0.0, 1.0, begin=-0.3) for k in range(count)),
            _with_anchors,
        ),
        Effect(
            "latency",
            "delay of the load cells' readings behind the poses",
            (late,),
            _with_latency,
            of_recordings=True,
        ),
    ]


def _rib_effects(nominal: RoutedTendonRobot) -> list[Effect]:
    L, ribs = float(nominal.length), nominal.rib_spacing or RibSpacing(share=0.0)
    softening, share = float(ribs.softening), float(ribs.share)
    return [
        Effect(
            "rib spacing",
            "softer bending under tension, for tendons are straight between ribs",
            (
                Number(
                    "rib_spacing.softening", "m2", softening, (0.2 * L) ** 2 / 12.0, 0.0, L**2, begin=0.3
                ),
            ),
            ReplaceInPart("rib_spacing", ("softening",)),
        ),
        Effect(
            "rib spans",
            "softer bending under tension between the ribs, or bodies, whose places are known",
            (Number("rib_spacing.share", "", share, 0.5, 0.0, 10.0, begin=0.5),),
            ReplaceInPart("rib_spacing", ("share",)),
        ),
    ]  # fmt: skip


def _friction_effects(nominal: RoutedTendonRobot, usual: float, highest: float) -> list[Effect]:
    """Return friction and its loss; `usual` and `highest` are tensions (N) of all tendons together."""
    L, known = float(nominal.length), nominal.friction or TendonFriction()
    wobble, curvature, at_rest = (float(each) for each in (known.wobble, known.curvature, known.at_rest))
    reach = float(known.reach) if wobble or curvature else 0.06 / L
    # above the usual tension: a robot that shakes at rest has no friction to be found
    shaking = 0.5 * (usual + highest)
    shaking_width = max(0.5 * (highest - shaking), 0.05 * highest)
    return [
        Effect(
            "friction",
            "friction of the tendons by their length, with its hysteresis",
            (
                Number("friction.wobble", "1/m", wobble, 0.2 / L, 0.0, 100.0, begin=0.5),
                Number("friction.reach", "1/m", reach, 1.0, 1e-4, 100.0, True),
                Number("friction.at_rest", "", at_rest, 1.0, -1.0, 1.0, begin=0.3),
            ),
            ReplaceInPart("friction", ("wobble", "reach", "at_rest")),
            usual=True,
        ),
        Effect(
            "friction by curvature",
            "friction of the tendons by the angle they turn",
            (Number("friction.curvature", "1/rad", curvature, 0.1, 0.0, 10.0, begin=0.3),),
            ReplaceInPart("friction", ("curvature",)),
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
            needs=("friction",),
            usual=True,
        ),
    ]


def _with_angles(robot: Any, values: list[Any]) -> Any:
    return robot.replace(tendon_angles=jnp.stack(values))


def _load_cells(robot: Any, **changes: Any) -> Any:
    return robot.replace(load_cells=dataclasses.replace(robot.load_cells, **changes))


def _with_gains(robot: Any, values: list[Any]) -> Any:
    return _load_cells(robot, gain=jnp.stack(values))


def _with_offsets(robot: Any, values: list[Any]) -> Any:
    return _load_cells(robot, offset=jnp.stack(values))


def _with_latency(robot: Any, values: list[Any]) -> Any:
    return _load_cells(robot, latency=values[0])


def _with_anchors(robot: Any, values: list[Any]) -> Any:
    return robot.replace(anchors=dataclasses.replace(robot.anchors, share=jnp.stack(values)))
