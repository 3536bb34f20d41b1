"""Bill of materials of a robot: parts to make and to buy, with counts and specifications (materials.csv)."""

from __future__ import annotations

import csv
import dataclasses
import math
from pathlib import Path
from typing import Any, NamedTuple

from knode_cosserat_hardware.cad.dimensions import (
    BOARD_LIMIT,
    DEAD_TURNS,
    SHAFT_FIT,
    TENDON,
    PartDimensions,
    load_dimensions,
)
from knode_cosserat_hardware.emulation import MotorParameters


class Item(NamedTuple):
    """Line of a bill of materials."""

    part: str
    # hides the method of tuples
    count: int  # type: ignore[assignment]
    specification: str
    #: the keys of the robot file, or the reason, that the dimensions come from
    source: str


def bill_of_materials(robot: str | Path) -> tuple[Item, ...]:
    """Return what a robot is built from.

    Args:
        robot: a name of the catalog or the path of a robot file.

    Raises:
        RobotFileError: there is no such robot, or its file is invalid.
        PartError: parts of this robot cannot be made.
    """
    values = _values(load_dimensions(robot))
    with Path(__file__).with_suffix(".csv").open(encoding="utf-8", newline="") as file:
        rows = [[cell.format_map(values) for cell in row] for row in list(csv.reader(file))[1:]]
    return tuple(Item(part, int(count), specification, source) for part, count, specification, source in rows)


def _values(part: PartDimensions) -> dict[str, Any]:
    """Return counts and sizes (mm, N, A) that the table names, beside those of the parts."""
    count, spool, cell, motor = len(part.angles), part.spool, part.cell, MotorParameters()
    pull_radius = spool.drum_radius + TENDON / 2.0
    above = part.rod_length + part.base.height + part.plate.thickness + part.axis_depth
    tendon = above + part.travel + DEAD_TURNS * 2.0 * math.pi * pull_radius + 100.0
    hanging = part.plate.thickness + part.mount.height + cell.thickness + 3.0
    mounting = part.base.flange_thickness + part.plate.thickness + 4.0
    sizes = {field.name: getattr(part, field.name) for field in dataclasses.fields(part)}
    return sizes | {
        "part": part,
        "motor": motor,
        "tendons": count,
        "ribs": len(part.rib_heights),
        "legs": len(part.plate.leg_holes),
        "markers": 3 * len(part.rib_heights) + 4,
        "screws": 2 * count,
        "mounts": len(part.base.mount_holes),
        "bridges": count // 2,
        "rib_diameter": 2 * part.rib.outer_radius,
        "drum": 2 * spool.drum_radius,
        "flanges": 2 * spool.flange_radius,
        "base_diameter": 2 * part.base.flange_radius,
        "plate_diameter": 2 * part.plate.radius,
        "rod_diameter": 2 * part.rod_radius,
        "bracket_width": part.bracket.right - part.bracket.left,
        "shaft": spool.bore - SHAFT_FIT,
        "thread": TENDON,
        "tendon_length": 0.1 * math.ceil(tendon / 100.0),
        "hanging_screw": 5 * math.ceil(hanging / 5),
        "mounting_screw": 5 * math.ceil(mounting / 5),
        "bracket_screw": cell.thickness + part.bracket.foot + 3,
        "strain": 1e6 * cell.strain,
        "limit": BOARD_LIMIT,
        "breaking_load": 3 * BOARD_LIMIT,
        "torque": BOARD_LIMIT * pull_radius / 1e3,
        "current": math.ceil(count * motor.voltage / motor.resistance),
    }
