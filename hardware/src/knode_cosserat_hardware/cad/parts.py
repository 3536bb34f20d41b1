"""Solids of the parts, by build123d. Lengths in mm."""

from __future__ import annotations

import importlib
import math
from collections.abc import Iterable
from typing import Any

from knode_cosserat_hardware.cad import shapes
from knode_cosserat_hardware.cad.dimensions import PartDimensions


def library() -> Any:
    """Return the module build123d.

    Raises:
        ImportError: it is not installed.
    """
    try:
        return importlib.import_module("build123d")
    except ImportError:
        raise ImportError("CAD models need build123d: pip install 'knode-cosserat-hardware[cad]'") from None


def cylinder(radius: float, low: float, high: float, at: tuple[float, float] = (0.0, 0.0)) -> Any:
    """Return an upright cylinder between two heights."""
    cad = library()
    solid = cad.Cylinder(radius, high - low, align=(cad.Align.CENTER, cad.Align.CENTER, cad.Align.MIN))
    return cad.Pos(*at, low) * solid


def block(low: tuple[float, float, float], high: tuple[float, float, float]) -> Any:
    """Return a box between two corners."""
    cad = library()
    size = [b - a for a, b in zip(low, high, strict=True)]
    return cad.Pos(*low) * cad.Box(*size, align=(cad.Align.MIN,) * 3)


def _radial_hole(diameter: float, reach: float, angle: float, height: float) -> Any:
    """Return a hole's cylinder from the axis outwards."""
    cad = library()
    pin = cad.Cylinder(diameter / 2.0, reach, align=(cad.Align.CENTER, cad.Align.CENTER, cad.Align.MIN))
    return cad.Pos(0, 0, height) * cad.Rot(0, 0, math.degrees(angle)) * cad.Rot(0, 90, 0) * pin


def _without(solid: Any, holes: Iterable[Any]) -> Any:
    for hole in holes:
        solid = solid - hole
    return solid


def make_rib(rib: shapes.Rib) -> Any:
    """Return a rib; z = 0 is the upper face of its disk, the hub is below."""
    cad = library()
    disk = cylinder(rib.outer_radius, -rib.thickness, 0.0)
    if rib.window is not None:
        inner, outer = rib.window
        window = cylinder(outer, -rib.thickness, 0.0) - cylinder(inner, -rib.thickness, 0.0)
        half = rib.spoke_width / 2.0
        for angle in rib.angles:
            spoke = block((0.0, -half, -rib.thickness), (outer + 1.0, half, 0.0))
            window = window - cad.Rot(0, 0, math.degrees(angle)) * spoke
        disk = disk - window
    solid = disk + cylinder(rib.hub_radius, -rib.hub_height, 0.0)
    between = sorted(angle % (2.0 * math.pi) for angle in rib.angles)
    height = -(rib.thickness + rib.hub_height) / 2.0
    return _without(
        solid,
        [
            cylinder(rib.rod_hole / 2.0, -rib.hub_height - 1.0, 1.0),
            *(cylinder(rib.tendon_hole / 2.0, -rib.thickness - 1.0, 1.0, at) for at in rib.tendon_holes),
            _radial_hole(rib.screw_hole, rib.hub_radius + 1.0, sum(between[:2]) / 2.0, height),
        ],
    )


def make_spool(spool: shapes.Spool) -> Any:
    """Return a spool along z; its hub begins at z = 0, at the motor."""
    hub, thick, width = spool.hub_length, spool.flange_thickness, spool.width
    solid = (
        cylinder(spool.hub_radius, 0.0, hub)
        + cylinder(spool.flange_radius, hub, hub + thick)
        + cylinder(spool.drum_radius, hub + thick, hub + thick + width)
        + cylinder(spool.flange_radius, hub + thick + width, spool.length)
    )
    radius = spool.bore / 2.0
    round_bore = cylinder(radius, -1.0, spool.length + 1.0)
    flat = block((spool.across_flat - radius, -radius, -2.0), (2.0 * radius, radius, spool.length + 2.0))
    tie = (spool.drum_radius + spool.flange_radius) / 2.0
    return _without(
        solid,
        [
            round_bore - flat,
            cylinder(spool.tie_hole / 2.0, hub - 1.0, hub + thick + 0.5, (0.0, tie)),
            _radial_hole(spool.screw_hole, spool.hub_radius + 1.0, 0.0, hub / 2.0),
        ],
    )


def make_base(base: shapes.Base) -> Any:
    """Return the base; z = 0 is its top, where the rod leaves the socket."""
    low, flange = -base.height, -base.height + base.flange_thickness
    solid = (
        cylinder(base.flange_radius, low, flange)
        + cylinder(base.column_radius, low, 0.0)
        + cylinder(base.top_radius, -base.top_thickness, 0.0)
    )
    holes = [cylinder(base.rod_hole / 2.0, -base.socket_depth, 1.0)]
    holes += [cylinder(base.eyelet / 2.0, -base.top_thickness - 1.0, 1.0, at) for at in base.eyelets]
    holes += [cylinder(base.passage / 2.0, low - 1.0, flange + 1.0, at) for at in base.eyelets]
    holes += [cylinder(base.mount_hole / 2.0, low - 1.0, flange + 1.0, at) for at in base.mount_holes]
    holes += [
        _radial_hole(base.screw_hole, base.column_radius + 1.0, base.screw_angle + turn, -depth)
        for depth in base.screw_depths
        for turn in (0.0, math.pi / 2.0)
    ]
    return _without(solid, holes)


def make_plate(plate: shapes.Plate) -> Any:
    """Return the motor plate; z = 0 is its upper side."""
    low = -plate.thickness
    sizes = [
        (plate.passage, plate.passages),
        (plate.mount_hole, plate.mount_holes),
        (plate.cell_hole, plate.cell_holes),
        (plate.leg_hole, plate.leg_holes),
    ]
    holes = [cylinder(size / 2.0, low - 1.0, 1.0, at) for size, points in sizes for at in points]
    return _without(cylinder(plate.radius, low, 0.0), holes)


def make_cell(cell: shapes.Cell) -> Any:
    """Return a load cell's beam along y; z = 0 is its upper side, y = 0 its end at the motor."""
    half = cell.width / 2.0
    beam = block((-half, 0.0, -cell.thickness), (half, cell.length, 0.0))
    return _without(
        beam, [cylinder(cell.hole / 2.0, -cell.thickness - 1.0, 1.0, (0.0, y)) for y in cell.holes]
    )


def make_mount(mount: shapes.Mount) -> Any:
    """Return a load-cell mount along y; z = 0 is its upper side, at the plate."""
    half = mount.width / 2.0
    solid = block((-half, 0.0, -mount.height), (half, mount.length, 0.0))
    return _without(
        solid, [cylinder(mount.hole / 2.0, -mount.height - 1.0, 1.0, (0.0, y)) for y in mount.holes]
    )


def make_bracket(bracket: shapes.Bracket) -> Any:
    """Return a motor bracket; x = 0 at the tendon, y = 0 at the spool's side, z = 0 at the foot's top."""
    cad = library()
    x, z = bracket.axis
    face = block((bracket.left, 0.0, -bracket.height), (bracket.right, bracket.face, 0.0))
    foot = block((bracket.left, 0.0, -bracket.foot), (bracket.right, bracket.foot_length, 0.0))
    corners = (
        (0.0, 0.0),
        (bracket.foot_length, 0.0),
        (bracket.face, -bracket.height),
        (0.0, -bracket.height),
    )
    triangle = cad.Plane.YZ * cad.make_face(cad.Polyline(*corners, close=True))
    gusset = cad.extrude(triangle, bracket.gusset)
    solid = face + foot + cad.Pos(bracket.right - bracket.gusset, 0, 0) * gusset
    if x - bracket.motor_radius - 0.5 >= bracket.left + bracket.gusset:
        solid = solid + cad.Pos(bracket.left, 0, 0) * gusset
    sizes = [
        (bracket.boss_hole, x),
        (bracket.screw_hole, x - bracket.screw_spacing / 2.0),
        (bracket.screw_hole, x + bracket.screw_spacing / 2.0),
    ]
    through = cad.Rot(-90, 0, 0)
    holes = [
        cad.Pos(at, 0, z) * through * cylinder(size / 2.0, -1.0, bracket.face + 1.0) for size, at in sizes
    ]
    holes += [
        cylinder(bracket.foot_hole / 2.0, -bracket.foot - 1.0, 1.0, (0.0, y)) for y in bracket.foot_holes
    ]
    return _without(solid, holes)


def make_motor(part: PartDimensions) -> Any:
    """Return a plain model of a gear motor along z; z = 0 is the gear's face, the shaft points up."""
    radius = (part.spool.bore - shapes.SHAFT_FIT) / 2.0
    flat = block((radius - shapes.SHAFT_CUT, -radius, 2.5), (2.0 * radius, radius, shapes.SHAFT_LENGTH + 1.0))
    return (
        cylinder(part.motor_radius, -shapes.MOTOR_LENGTH, 0.0)
        + cylinder(shapes.BOSS / 2.0, 0.0, 2.5)
        + (cylinder(radius, 0.0, shapes.SHAFT_LENGTH) - flat)
    )


def make_parts(part: PartDimensions) -> dict[str, Any]:
    """Return the solids of the parts to be made, by name."""
    return {
        "rib": make_rib(part.rib),
        "spool": make_spool(part.spool),
        "base": make_base(part.base),
        "motor-plate": make_plate(part.plate),
        "load-cell": make_cell(part.cell),
        "load-cell-mount": make_mount(part.mount),
        "motor-bracket": make_bracket(part.bracket),
    }
