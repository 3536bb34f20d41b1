"""Solids of the parts, by build123d. Lengths in mm."""

from __future__ import annotations

import importlib
import math
from pathlib import Path
from typing import Any

from knode_cosserat_hardware.cad.dimensions import (
    BOSS,
    MOTOR_LENGTH,
    SHAFT_CUT,
    SHAFT_FIT,
    SHAFT_LENGTH,
    TENDON,
    Base,
    Bracket,
    Cell,
    Mount,
    PartDimensions,
    Plate,
    Points,
    Rib,
    Spool,
    load_dimensions,
)


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


def _holes(diameter: float, low: float, high: float, points: Points = ((0.0, 0.0),)) -> list[Any]:
    """Return the cylinders of upright holes."""
    return [cylinder(diameter / 2.0, low, high, point) for point in points]


def _radial_hole(diameter: float, reach: float, angle: float, height: float) -> Any:
    """Return a hole's cylinder from the axis outwards."""
    cad = library()
    turned = cad.Rot(0, 0, math.degrees(angle)) * cad.Rot(0, 90, 0)
    return cad.Pos(0, 0, height) * turned * cylinder(diameter / 2.0, 0.0, reach)


def _without(solid: Any, *holes: Any) -> Any:
    for hole in holes:
        solid = solid - hole
    return solid


def make_rib(rib: Rib) -> Any:
    """Return a rib; z = 0 is the upper face of its disk, the hub is below."""
    cad, low = library(), -rib.thickness
    disk = cylinder(rib.outer_radius, low, 0.0)
    if rib.window is not None:
        inner, outer = rib.window
        window = cylinder(outer, low, 0.0) - cylinder(inner, low, 0.0)
        half = rib.spoke_width / 2.0
        spoke = block((0.0, -half, low), (outer + 1.0, half, 0.0))
        disk = disk - _without(window, *(cad.Rot(0, 0, math.degrees(angle)) * spoke for angle in rib.angles))
    around = sorted(angle % (2.0 * math.pi) for angle in rib.angles)
    height = -(rib.thickness + rib.hub_height) / 2.0
    return _without(
        disk + cylinder(rib.hub_radius, -rib.hub_height, 0.0),
        *_holes(rib.rod_hole, -rib.hub_height - 1.0, 1.0),
        *_holes(rib.tendon_hole, low - 1.0, 1.0, rib.tendon_holes),
        _radial_hole(rib.screw_hole, rib.hub_radius + 1.0, sum(around[:2]) / 2.0, height),
    )


def make_spool(spool: Spool) -> Any:
    """Return a spool along z; its hub begins at z = 0, at the motor."""
    hub, thick, width = spool.hub_length, spool.flange_thickness, spool.width
    solid = (
        cylinder(spool.hub_radius, 0.0, hub)
        + cylinder(spool.flange_radius, hub, hub + thick)
        + cylinder(spool.drum_radius, hub + thick, hub + thick + width)
        + cylinder(spool.flange_radius, hub + thick + width, spool.length)
    )
    radius, tie = spool.bore / 2.0, (spool.drum_radius + spool.flange_radius) / 2.0
    flat = block((spool.across_flat - radius, -radius, -2.0), (2.0 * radius, radius, spool.length + 2.0))
    return _without(
        solid,
        cylinder(radius, -1.0, spool.length + 1.0) - flat,
        *_holes(spool.tie_hole, hub - 1.0, hub + thick + 0.5, ((0.0, tie),)),
        _radial_hole(spool.screw_hole, spool.hub_radius + 1.0, 0.0, hub / 2.0),
    )


def make_base(base: Base) -> Any:
    """Return the base; z = 0 is its top, where the rod leaves the socket."""
    low, flange, reach = -base.height, -base.height + base.flange_thickness, base.column_radius + 1.0
    solid = (
        cylinder(base.flange_radius, low, flange)
        + cylinder(base.column_radius, low, 0.0)
        + cylinder(base.top_radius, -base.top_thickness, 0.0)
    )
    return _without(
        solid,
        *_holes(base.rod_hole, -base.socket_depth, 1.0),
        *_holes(base.eyelet, -base.top_thickness - 1.0, 1.0, base.eyelets),
        *_holes(base.passage, low - 1.0, flange + 1.0, base.eyelets),
        *_holes(base.mount_hole, low - 1.0, flange + 1.0, base.mount_holes),
        *(
            _radial_hole(base.screw_hole, reach, base.screw_angle + turn, -depth)
            for depth in base.screw_depths
            for turn in (0.0, math.pi / 2.0)
        ),
    )


def make_plate(plate: Plate) -> Any:
    """Return the motor plate; z = 0 is its upper side."""
    low = -plate.thickness
    return _without(
        cylinder(plate.radius, low, 0.0),
        *_holes(plate.passage, low - 1.0, 1.0, plate.passages),
        *_holes(plate.mount_hole, low - 1.0, 1.0, plate.mount_holes),
        *_holes(plate.cell_hole, low - 1.0, 1.0, plate.cell_holes),
        *_holes(plate.leg_hole, low - 1.0, 1.0, plate.leg_holes),
    )


def make_bar(part: Cell | Mount) -> Any:
    """Return a load cell's beam or its mount along y; z = 0 is the upper side, y = 0 the end at the motor."""
    half, low = part.width / 2.0, -(part.thickness if isinstance(part, Cell) else part.height)
    bar = block((-half, 0.0, low), (half, part.length, 0.0))
    return _without(bar, *_holes(part.hole, low - 1.0, 1.0, tuple((0.0, y) for y in part.holes)))


def make_bracket(bracket: Bracket) -> Any:
    """Return a motor bracket; x = 0 at the tendon, y = 0 at the spool's side, z = 0 at the foot's top."""
    cad = library()
    (x, z), depth, face = bracket.axis, bracket.height, bracket.face
    corners = ((0.0, 0.0), (bracket.foot_length, 0.0), (face, -depth), (0.0, -depth))
    gusset = cad.extrude(cad.Plane.YZ * cad.make_face(cad.Polyline(*corners, close=True)), bracket.gusset)
    solid = (
        block((bracket.left, 0.0, -depth), (bracket.right, face, 0.0))
        + block((bracket.left, 0.0, -bracket.foot), (bracket.right, bracket.foot_length, 0.0))
        + cad.Pos(bracket.right - bracket.gusset, 0, 0) * gusset
    )
    if x - bracket.motor_radius - 0.5 >= bracket.left + bracket.gusset:
        solid = solid + cad.Pos(bracket.left, 0, 0) * gusset
    screws = tuple((x + side * bracket.screw_spacing / 2.0, -z) for side in (-1.0, 1.0))
    through = [
        *_holes(bracket.boss_hole, -1.0, face + 1.0, ((x, -z),)),
        *_holes(bracket.screw_hole, -1.0, face + 1.0, screws),
    ]
    return _without(
        solid,
        *(cad.Rot(-90, 0, 0) * hole for hole in through),
        *_holes(bracket.foot_hole, -bracket.foot - 1.0, 1.0, tuple((0.0, y) for y in bracket.foot_holes)),
    )


def make_motor(part: PartDimensions) -> Any:
    """Return a plain model of a gear motor along z; z = 0 is the gear's face, the shaft points up."""
    radius = (part.spool.bore - SHAFT_FIT) / 2.0
    flat = block((radius - SHAFT_CUT, -radius, 2.5), (2.0 * radius, radius, SHAFT_LENGTH + 1.0))
    return (
        cylinder(part.motor_radius, -MOTOR_LENGTH, 0.0)
        + cylinder(BOSS / 2.0, 0.0, 2.5)
        + (cylinder(radius, 0.0, SHAFT_LENGTH) - flat)
    )


def make_parts(part: PartDimensions) -> dict[str, Any]:
    """Return the solids of the parts to be made, by name."""
    return {
        "rib": make_rib(part.rib),
        "spool": make_spool(part.spool),
        "base": make_base(part.base),
        "motor-plate": make_plate(part.plate),
        "load-cell": make_bar(part.cell),
        "load-cell-mount": make_bar(part.mount),
        "motor-bracket": make_bracket(part.bracket),
    }


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
    cad, face = library(), part.spool.face_distance
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


#: greatest distance between the surface and its triangles (mm), and angle of neighbouring triangles (rad)
CHORD, ANGLE = 0.05, 0.2


def export_parts(robot: str | Path, folder: str | Path) -> dict[str, Path]:
    """Write the parts of a robot as STEP and STL files, and the assembled robot as a STEP file.

    Existing files of these names are replaced. Lengths in the files are in mm.

    Args:
        robot: a name of the catalog or the path of a robot file.
        folder: folder of the files; it is created if it does not exist.

    Returns:
        The files by their names, such as "rib.step".

    Raises:
        RobotFileError: there is no such robot, or its file is invalid.
        PartError: parts of this robot cannot be made.
        ImportError: build123d is not installed.
    """
    dimensions = load_dimensions(robot)
    cad = library()
    out = Path(folder)
    out.mkdir(parents=True, exist_ok=True)
    written: dict[str, Path] = {}
    for name, solid in make_parts(dimensions).items():
        written[f"{name}.step"] = _step(cad, solid, out / f"{name}.step")
        path = out / f"{name}.stl"
        if not cad.export_stl(solid, str(path), tolerance=CHORD, angular_tolerance=ANGLE):
            raise OSError(f"{path}: the STL file was not written")
        written[path.name] = path
    written["robot.step"] = _step(cad, make_assembly(dimensions), out / "robot.step")
    return written


def _step(cad: Any, solid: Any, path: Path) -> Path:
    # without its time, equal parts give equal files
    if not cad.export_step(solid, str(path), timestamp="2000-01-01T00:00:00"):
        raise OSError(f"{path}: the STEP file was not written")
    return path
