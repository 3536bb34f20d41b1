"""Solids of the parts, by build123d. Lengths in mm."""

from __future__ import annotations

import importlib
import math
from collections.abc import Iterable
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


def _radial_hole(diameter: float, reach: float, angle: float, height: float) -> Any:
    """Return a hole's cylinder from the axis outwards."""
    cad = library()
    pin = cad.Cylinder(diameter / 2.0, reach, align=(cad.Align.CENTER, cad.Align.CENTER, cad.Align.MIN))
    return cad.Pos(0, 0, height) * cad.Rot(0, 0, math.degrees(angle)) * cad.Rot(0, 90, 0) * pin


def _without(solid: Any, holes: Iterable[Any]) -> Any:
    for hole in holes:
        solid = solid - hole
    return solid


def make_rib(rib: Rib) -> Any:
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


def make_spool(spool: Spool) -> Any:
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


def make_base(base: Base) -> Any:
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


def make_plate(plate: Plate) -> Any:
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


def make_cell(cell: Cell) -> Any:
    """Return a load cell's beam along y; z = 0 is its upper side, y = 0 its end at the motor."""
    half = cell.width / 2.0
    beam = block((-half, 0.0, -cell.thickness), (half, cell.length, 0.0))
    return _without(
        beam, [cylinder(cell.hole / 2.0, -cell.thickness - 1.0, 1.0, (0.0, y)) for y in cell.holes]
    )


def make_mount(mount: Mount) -> Any:
    """Return a load-cell mount along y; z = 0 is its upper side, at the plate."""
    half = mount.width / 2.0
    solid = block((-half, 0.0, -mount.height), (half, mount.length, 0.0))
    return _without(
        solid, [cylinder(mount.hole / 2.0, -mount.height - 1.0, 1.0, (0.0, y)) for y in mount.holes]
    )


def make_bracket(bracket: Bracket) -> Any:
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
        "load-cell": make_cell(part.cell),
        "load-cell-mount": make_mount(part.mount),
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
