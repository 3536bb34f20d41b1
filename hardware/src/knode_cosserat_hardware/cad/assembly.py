"""The assembled robot: all parts in their places, with plain models of rod, motors and tendons."""

from __future__ import annotations

import math
from typing import Any

from knode_cosserat_hardware.cad.dimensions import PartDimensions
from knode_cosserat_hardware.cad.parts import cylinder, library, make_motor, make_parts
from knode_cosserat_hardware.cad.shapes import TENDON


def place_parts(part: PartDimensions) -> list[tuple[str, Any]]:
    """Return names and solids of all bodies of the robot; z = 0 is the rod's clamped end."""
    made = make_parts(part)
    cad, plate_top = library(), -part.base.height
    below = plate_top - part.plate.thickness
    bodies = [
        ("rod", cylinder(part.rod_radius, -part.base.socket_depth, part.rod_length)),
        ("base", made["base"]),
        ("motor-plate", cad.Pos(0, 0, plate_top) * made["motor-plate"]),
    ]
    bodies += [(f"rib-{k + 1}", cad.Pos(0, 0, z) * made["rib"]) for k, z in enumerate(part.rib_heights)]
    motor = make_motor(part)
    for k, angle in enumerate(part.angles):
        frame = cad.Pos(0, 0, below) * cad.Rot(0, 0, math.degrees(angle)) * cad.Pos(part.tendon_radius, 0, 0)
        bodies += [(f"{name}-{k + 1}", frame * each) for name, each in _drive(part, made, motor)]
        at = part.plate.passages[k]
        bodies.append(
            (f"tendon-{k + 1}", cylinder(TENDON / 2.0, below - part.axis_depth, part.rod_length, at))
        )
    bodies += [
        (f"leg-{k + 1}", cylinder(4.0, below - part.leg_length, below, at))
        for k, at in enumerate(part.plate.leg_holes)
    ]
    return bodies


def _drive(part: PartDimensions, made: dict[str, Any], motor: Any) -> list[tuple[str, Any]]:
    """Return the bodies of one tendon below the plate, in its frame: x radial, y tangential, z up."""
    cad, face = library(), part.face_distance
    start, top = face + part.bracket.face, -part.mount.height
    foot = top - part.cell.thickness
    axis = (part.bracket.axis[0], foot + part.bracket.axis[1])
    # z of spool and motor points from the motor to the tendon: along -y
    turned = cad.Rot(90, 0, 0)
    return [
        (
            "load-cell-mount",
            cad.Pos(0, start + part.cell.length - part.mount.length, 0) * made["load-cell-mount"],
        ),
        ("load-cell", cad.Pos(0, start, top) * made["load-cell"]),
        ("motor-bracket", cad.Pos(0, face, foot) * made["motor-bracket"]),
        ("spool", cad.Pos(axis[0], part.spool.centre, axis[1]) * turned * made["spool"]),
        ("motor", cad.Pos(axis[0], start, axis[1]) * turned * motor),
    ]


def make_assembly(part: PartDimensions) -> Any:
    """Return the assembled robot as one compound with named children."""
    cad = library()
    children = []
    for name, solid in place_parts(part):
        solid.label = name
        children.append(solid)
    return cad.Compound(label="robot", children=children)
