"""Bill of materials of a robot: parts to make and to buy, with counts and specifications."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

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
    part = load_dimensions(robot)
    return (*_made(part), *_drive_parts(part), *_mechanics(part), *_screws(part), *_electronics(part))


def materials_table(items: Sequence[Item]) -> str:
    """Return a bill of materials as a table in Markdown."""
    rows = [f"| {item.part} | {item.count} | {item.specification} | {item.source} |" for item in items]
    return "\n".join(["| part | count | specification | source |", "| --- | ---: | --- | --- |", *rows])


def _made(part: PartDimensions) -> list[Item]:
    count, rib, spool, base = len(part.angles), part.rib, part.spool, part.base
    drum = part.spool.drum_radius
    return [
        Item(
            "rib",
            len(part.rib_heights),
            f"printed; diameter {2 * rib.outer_radius:g} mm, disk {rib.thickness:g} mm, rod hole "
            f"{rib.rod_hole:.2f} mm, {count} tendon holes of {rib.tendon_hole:g} mm at radius "
            f"{rib.tendon_radius:g} mm",
            "`tendon_offset`, `tendon_angles`, `radius`, `rib_diameter`, `rib_thickness`, `hole_diameter`, "
            "`rod_clearance`; count and places: attached masses, else `rib_count`",
        ),
        Item(
            "spool",
            count,
            f"printed; drum {2 * drum:g} mm x {spool.width:g} mm, flanges {2 * spool.flange_radius:g} mm, "
            f"D bore {spool.bore:g} mm, {spool.across_flat:.1f} mm across the flat",
            "`spool_radius`, `spool_width`, `flange_height`, `shaft_diameter`",
        ),
        Item(
            "base",
            1,
            f"printed; flange {2 * base.flange_radius:g} mm, height {base.height:g} mm, socket "
            f"{base.rod_hole:.2f} mm x {base.socket_depth:g} mm, {count} eyelets of {base.eyelet:g} mm",
            "`base_diameter`, `base_height`, `mount_diameter`, `mount_hole_diameter`, `mount_hole_count`, "
            "`tendon_offset`",
        ),
    ]


def _drive_parts(part: PartDimensions) -> list[Item]:
    count, cell, bracket = len(part.angles), part.cell, part.bracket
    return [
        Item(
            "motor plate",
            1,
            f"plywood, aluminium or printed; diameter {2 * part.plate.radius:g} mm, "
            f"thickness {part.plate.thickness:g} mm",
            "room for the motors: `tendon_offset`, `spool_radius`, `motor_diameter`",
        ),
        Item(
            "load-cell beam",
            count,
            f"aluminium bar {cell.width:g} mm x {cell.thickness:g} mm, length {cell.length:g} mm; "
            f"computed strain {1e6 * cell.strain:.0f} µm/m at the greatest tension",
            f"`tension: high`, at least the board's limit of {BOARD_LIMIT:.1f} N",
        ),
        Item(
            "load-cell mount",
            count,
            f"printed; {part.mount.length:g} mm x {part.mount.width:g} mm x {part.mount.height:g} mm",
            "load-cell beam",
        ),
        Item(
            "motor bracket",
            count,
            f"printed; {bracket.right - bracket.left:g} mm x {bracket.foot_length:g} mm x "
            f"{bracket.height:g} mm, 2 holes {bracket.screw_spacing:g} mm apart",
            "`motor_diameter`, `spool_radius`",
        ),
    ]


def _mechanics(part: PartDimensions) -> list[Item]:
    count, spool = len(part.angles), part.spool
    turns = DEAD_TURNS * 2.0 * math.pi * (spool.drum_radius + TENDON / 2.0)
    above = part.rod_length + part.base.height + part.plate.thickness + part.axis_depth
    tendon = 0.1 * math.ceil((above + part.travel + turns + 100.0) / 100.0)
    return [
        Item(
            "rod", 1,
            f"Delrin (acetal), diameter {2 * part.rod_radius:g} mm, length {part.rod_stock:g} mm",
            "`length` and the base's socket; `radius`",
        ),
        Item(
            "tendon", count,
            f"braided line, diameter {TENDON:g} mm, length {tendon:.1f} m each, breaking load above "
            f"{3 * BOARD_LIMIT:.0f} N",
            "way from spool to tip, travel, dead turns; breaking load: 3 times the board's limit",
        ),
        Item(
            "eyelet sleeve", count,
            f"PTFE tube, {part.base.eyelet:g} mm x 1 mm, length {part.base.top_thickness:g} mm",
            "base",
        ),
        Item(
            "leg", len(part.plate.leg_holes),
            f"M5 spacer or threaded rod, length {part.leg_length:g} mm",
            "depth of motors and spools below the plate",
        ),
        Item(
            "motion-capture marker", 3 * len(part.rib_heights) + 4,
            f"diameter {part.marker_diameter:g} mm, glued to ribs (3 each) and base (4)",
            "`marker_diameter`; only with motion capture",
        ),
    ]  # fmt: skip


def _screws(part: PartDimensions) -> list[Item]:
    count, base, cell = len(part.angles), part.base, part.cell
    hanging = part.plate.thickness + part.mount.height + cell.thickness + 3.0
    mounting = base.flange_thickness + part.plate.thickness + 4.0
    return [
        Item(
            "screw with nut", 2 * count,
            f"M3 x {5 * math.ceil(hanging / 5):g} mm: plate, mount and load-cell beam",
            "thickness of the parts",
        ),
        Item(
            "screw with nut", 2 * count,
            f"M3 x {cell.thickness + part.bracket.foot + 3:g} mm: load-cell beam and bracket; "
            "heads at the plate",
            "thickness of the parts",
        ),
        Item("screw", 2 * count, "M3 x 6 mm: bracket and motor", "thickness of the bracket; motor"),
        Item(
            "screw with nut", len(base.mount_holes),
            f"for holes of {base.mount_hole:g} mm, length {5 * math.ceil(mounting / 5):g} mm: base and plate",
            "`mount_hole_count`, `mount_hole_diameter`",
        ),
        Item("set screw", len(part.rib_heights), "M3 x 4 mm: ribs on the rod", "hub of the rib"),
        Item("set screw", count, "M3 x 4 mm: spools on the shafts", "hub of the spool"),
        Item("set screw", 4, "M3 x 8 mm, with a soft tip: rod in the base", "column of the base"),
    ]  # fmt: skip


def _electronics(part: PartDimensions) -> list[Item]:
    count, motor = len(part.angles), MotorParameters()
    torque = BOARD_LIMIT * (part.spool.drum_radius + TENDON / 2.0) / 1e3
    current = count * motor.voltage / motor.resistance
    firmware = "firmware"
    return [
        Item(
            "gear motor", count,
            f"JGA25-371, 12 V, shaft {part.spool.bore - SHAFT_FIT:g} mm with flat, stall torque "
            f"above {torque:.2f} N m",
            "torque: the board's limit on `spool_radius`",
        ),
        Item("dual H-bridge", count // 2, "XY-160D, 12 V, logic 5 V", firmware),
        Item("microcontroller board", 1, "Arduino Mega 2560, with USB cable", firmware),
        Item("strain gauge", count, "BF350-3AA, 350 ohm", "the paper's robot"),
        Item(
            "amplifier", count,
            "module for one BF350 gauge, supply 5 V, analog output 0 to 5 V; slack 0.5 V, 1.2 V per kg",
            "the firmware's default calibration",
        ),
        Item("resistor", count, "100 kohm, from each analog input to GND", "a torn wire reads 0 V"),
        Item(
            "supply", 1, f"12 V, at least {math.ceil(current):g} A, with a current limit",
            f"{count} stalled motors of {motor.resistance:g} ohm (nominal)",
        ),
        Item("fuse with holder", 1, f"{math.ceil(current):g} A, slow", "supply"),
        Item(
            "emergency-stop switch", 1,
            f"latching; two normally closed contacts: {math.ceil(current):g} A at 12 V DC, and a signal "
            "contact (5 mA) for D18",
            "supply; firmware",
        ),
        Item("pull-up resistor", 1, "1 kohm, from D18 to 5 V: wets the contact", "emergency stop"),
        Item("capacitor", 1, "100 nF, from D18 to GND, at the board", "emergency stop"),
    ]  # fmt: skip
