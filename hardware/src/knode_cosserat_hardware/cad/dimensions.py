"""Dimensions of all parts, from a robot and the section `hardware` of its file."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np

from knode_cosserat.rods.robot_file import load_robot
from knode_cosserat.rods.system import System
from knode_cosserat_hardware.cad import shapes
from knode_cosserat_hardware.cad.checks import (
    require_base,
    require_plate,
    require_ribs,
    require_spool,
    require_tendons,
)
from knode_cosserat_hardware.cad.shapes import HEAD, MIN_WALL, PLAY, TENDON, PartError, on_circle
from knode_cosserat_hardware.description import Dimensions, HardwareDescription, load_hardware
from knode_cosserat_hardware.lines import GRAM_FORCE

#: over-tension limit of the board: 2300 grams-force (N)
BOARD_LIMIT = 2300 * GRAM_FORCE
#: thicknesses of aluminium bar in stock (mm)
STOCK = (1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)
#: Young's modulus of aluminium (MPa), and the greatest strain allowed at a gauge
ALUMINIUM, MAX_STRAIN = 69000.0, 1.0e-3
#: angle by which the robot may bend to either side (rad), and length of tendon in reserve (mm)
BEND, RESERVE = math.pi, 20.0


@dataclasses.dataclass(frozen=True)
class PartDimensions:
    """Dimensions of all parts of a robot, in mm and rad; z = 0 is the rod's clamped end.

    Attributes:
        rod_length: length of the rod above its clamped end.
        rod_radius: radius of the rod.
        angles: angles of the tendons around the rod.
        tendon_radius: distance of the tendons from the rod's axis.
        rib_heights: heights of the upper faces of the ribs' disks.
        rib: dimensions of a rib.
        spool: dimensions of a spool.
        base: dimensions of the base.
        plate: dimensions of the motor plate.
        cell: dimensions of a load cell.
        mount: dimensions of a load-cell mount.
        bracket: dimensions of a motor bracket.
        motor_radius: radius of the motors.
        marker_diameter: diameter of the motion-capture markers.
    """

    rod_length: float
    rod_radius: float
    angles: tuple[float, ...]
    tendon_radius: float
    rib_heights: tuple[float, ...]
    rib: shapes.Rib
    spool: shapes.Spool
    base: shapes.Base
    plate: shapes.Plate
    cell: shapes.Cell
    mount: shapes.Mount
    bracket: shapes.Bracket
    motor_radius: float
    marker_diameter: float

    @property
    def axis_depth(self) -> float:
        """Depth of the motors' axes below the plate."""
        return self.mount.height + self.cell.thickness - self.bracket.axis[1]

    @property
    def face_distance(self) -> float:
        """Distance along the motor's axis from the tendon to the bracket's face."""
        return PLAY + self.spool.centre

    @property
    def leg_length(self) -> float:
        """Length of the legs below the plate, in steps of 5 mm."""
        lowest = self.axis_depth + max(self.spool.flange_radius, self.bracket.height + self.bracket.axis[1])
        return 5.0 * math.ceil((lowest + 15.0) / 5.0)

    @property
    def travel(self) -> float:
        """Length of tendon that a spool takes in or gives out if the rod bends by half a turn either way."""
        return 2.0 * self.tendon_radius * BEND + RESERVE

    @property
    def rod_stock(self) -> float:
        """Length of the rod with its part in the base's socket."""
        return self.rod_length + self.base.socket_depth


def load_dimensions(name_or_path: str | Path) -> PartDimensions:
    """Return the dimensions of a robot's parts: a name of the catalog or the path of a robot file.

    Raises:
        RobotFileError: there is no such robot, or its file is invalid.
        PartError: parts of this robot cannot be made.
    """
    return part_dimensions(load_robot(name_or_path), load_hardware(name_or_path))


def part_dimensions(robot: System, hardware: HardwareDescription | None = None) -> PartDimensions:
    """Return the dimensions of a robot's parts.

    Args:
        robot: a robot with straight tendons at one distance from the rod, such as `TendonRobot`.
        hardware: dimensions of the parts around the rod, and the tensions that the load cells carry.

    Raises:
        PartError: parts of this robot cannot be made.
    """
    hardware = HardwareDescription() if hardware is None else hardware
    given = hardware.dimensions
    length, radius, offset, angles = _tendons(robot)
    rib = _rib(given, radius, offset, angles)
    heights = _rib_heights(robot, given, length)
    require_tendons(rib, radius)
    require_ribs(rib, heights, length)
    spool = _spool(given)
    require_spool(spool, given, 2.0 * offset * BEND + RESERVE)
    base = _base(given, rib)
    require_base(base)
    motor_radius = 500.0 * given.motor_diameter
    cell = _cell(max(hardware.tension.high, BOARD_LIMIT), PLAY + spool.centre)
    bracket = _bracket(1e3 * given.spool_radius, motor_radius, cell)
    depth = cell.thickness - bracket.axis[1]
    mount = shapes.Mount(
        cell.end,
        cell.width,
        max(2.0 * HEAD, spool.flange_radius + 2.0 - depth),
        (cell.end / 4, 0.75 * cell.end),
    )
    plate = _plate(base, spool, cell, bracket)
    require_plate(plate, base, _rectangles(base, spool, cell, bracket))
    return PartDimensions(
        length, radius, angles, offset, heights, rib, spool, base, plate, cell, mount, bracket,
        motor_radius, 1e3 * given.marker_diameter,
    )  # fmt: skip


def _tendons(robot: System) -> tuple[float, float, float, tuple[float, ...]]:
    """Return length, radius, offset of the tendons (mm), and their angles."""
    offset, angles = getattr(robot, "tendon_offset", None), getattr(robot, "tendon_angles", None)
    bent = getattr(robot, "routing", None) is not None or getattr(robot, "tendon_twist", None) is not None
    if offset is None or angles is None or bent:
        raise PartError(
            f"parts are made for robots with straight tendons, of kind tendon-robot or routed-tendon-robot "
            f"with tendon_offset and tendon_angles (got {type(robot).__name__})"
        )
    around = tuple(float(angle) for angle in np.asarray(angles))
    if len(around) != 4:
        raise PartError(f"tendon_angles must have 4 angles: the board drives 4 motors (got {len(around)})")
    length, radius = float(np.asarray(robot.length)), float(np.asarray(getattr(robot, "radius", np.nan)))
    return 1e3 * length, 1e3 * radius, 1e3 * float(np.asarray(offset)), around


def _rib_heights(robot: System, given: Dimensions, length: float) -> tuple[float, ...]:
    """Return the positions of ribs: those of attached masses, or equal distances up to the tip (mm)."""
    at = [
        float(np.asarray(load.at))
        for load in getattr(robot, "loads", ())
        if getattr(load, "kind", "") == "attached-mass"
    ]
    fractions = sorted(at) or [(k + 1) / given.rib_count for k in range(given.rib_count)]
    return tuple(length * fraction for fraction in fractions)


def _rib(given: Dimensions, radius: float, offset: float, angles: tuple[float, ...]) -> shapes.Rib:
    rod_hole = 2.0 * radius + 1e3 * given.rod_clearance
    outer, thickness, hole = 500 * given.rib_diameter, 1e3 * given.rib_thickness, 1e3 * given.hole_diameter
    hub = rod_hole / 2.0 + 3.0
    window = (hub + 1.0, outer - max(2.5, 2.0 * MIN_WALL))
    return shapes.Rib(
        outer_radius=outer,
        thickness=thickness,
        rod_hole=rod_hole,
        hub_radius=hub,
        hub_height=thickness + 5.0,
        tendon_hole=hole,
        tendon_radius=offset,
        angles=angles,
        spoke_width=max(6.0, hole + 4.0 * MIN_WALL),
        window=window if window[1] - window[0] >= 4.0 else None,
    )


def _spool(given: Dimensions) -> shapes.Spool:
    radius, bore = 1e3 * given.spool_radius, 1e3 * given.shaft_diameter + shapes.SHAFT_FIT
    return shapes.Spool(
        drum_radius=radius - TENDON / 2.0,
        width=1e3 * given.spool_width,
        flange_radius=radius + 1e3 * given.flange_height,
        flange_thickness=1.5,
        hub_radius=bore / 2.0 + 3.5,
        hub_length=6.0,
        bore=bore,
        across_flat=bore - shapes.SHAFT_CUT,
        tie_hole=2.0 * TENDON + 0.2,
    )


def _base(given: Dimensions, rib: shapes.Rib) -> shapes.Base:
    height, passage, offset = 1e3 * given.base_height, 4.0, rib.tendon_radius
    between = sorted(angle % (2.0 * math.pi) for angle in rib.angles)
    first = (between[0] + between[1]) / 2.0
    socket = min(40.0, height - 8.0)
    count = given.mount_hole_count
    return shapes.Base(
        flange_radius=500.0 * given.base_diameter,
        flange_thickness=6.0,
        height=height,
        column_radius=min(rib.rod_hole / 2.0 + 7.0, offset - passage / 2.0 - 0.5),
        top_radius=rib.outer_radius,
        top_thickness=8.0,
        rod_hole=rib.rod_hole,
        socket_depth=socket,
        eyelet=shapes.SLEEVE,
        passage=passage,
        tendon_radius=offset,
        angles=rib.angles,
        mount_radius=500.0 * given.mount_diameter,
        mount_hole=1e3 * given.mount_hole_diameter,
        mount_angles=tuple(first + 2.0 * math.pi * k / count for k in range(count)),
        screw_depths=(13.0, socket - 6.0),
        screw_angle=first,
    )


def _cell(force: float, face: float) -> shapes.Cell:
    """Return the thinnest beam of stock that carries a force (N)."""
    width, end, free, bracket_face = 12.0, 18.0, 24.0, 3.0
    lever = face + bracket_face + end + free / 2.0
    for thickness in STOCK:
        strain = 6.0 * force * lever / (width * thickness**2 * ALUMINIUM)
        if strain <= MAX_STRAIN:
            return shapes.Cell(2.0 * end + free, width, thickness, end, lever, strain)
    most = MAX_STRAIN * width * STOCK[-1] ** 2 * ALUMINIUM / (6.0 * lever)
    raise PartError(
        f"hardware.tension.high must be at most {most:.0f} N: no beam of {width:g} mm x {STOCK[-1]:g} mm "
        f"carries more (got {force:g})"
    )


def _bracket(spool_radius: float, motor_radius: float, cell: shapes.Cell) -> shapes.Bracket:
    face, foot, gap, gusset = 3.0, 4.0, 3.0, 3.0
    half = (shapes.SCREW_SPACING + shapes.M3_CLEARANCE) / 2.0 + 2.0 * MIN_WALL
    return shapes.Bracket(
        left=min(-cell.width / 2.0, spool_radius - half),
        right=spool_radius + max(motor_radius + 0.5, half) + gusset,
        face=face,
        foot=foot,
        foot_length=face + cell.end,
        height=foot + gap + 2.0 * motor_radius + 1.5,
        axis=(spool_radius, -(foot + gap + motor_radius)),
        foot_holes=tuple(face + y for y in cell.holes[:2]),
        motor_radius=motor_radius,
        gusset=gusset,
    )


def placed(x: float, y: float, angle: float, base: shapes.Base) -> tuple[float, float]:
    """Return a point of a tendon's frame (x radial from the tendon, y tangential) in the robot's frame."""
    cos, sin = math.cos(angle), math.sin(angle)
    radial = base.tendon_radius + x
    return radial * cos - y * sin, radial * sin + y * cos


def _corners(
    angle: float, base: shapes.Base, low: tuple[float, float], high: tuple[float, float]
) -> np.ndarray:
    at = [(low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1])]
    return np.array([placed(x, y, angle, base) for x, y in at])


def _rectangles(
    base: shapes.Base, spool: shapes.Spool, cell: shapes.Cell, bracket: shapes.Bracket
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the outlines below the plate of each tendon's spool and of its motor with the load cell."""
    face, axis = PLAY + spool.centre, bracket.axis[0]
    left = min(bracket.left, axis - bracket.motor_radius)
    far = face + bracket.face + max(cell.length, shapes.MOTOR_LENGTH)
    return [
        (
            _corners(
                angle, base, (axis - spool.flange_radius, face - PLAY - spool.length),
                (axis + spool.flange_radius, face),
            ),
            _corners(angle, base, (left, face), (bracket.right, far)),
        )
        for angle in base.angles
    ]  # fmt: skip


def _plate(
    base: shapes.Base, spool: shapes.Spool, cell: shapes.Cell, bracket: shapes.Bracket
) -> shapes.Plate:
    outlines = np.concatenate([part for pair in _rectangles(base, spool, cell, bracket) for part in pair])
    radius = max(float(np.linalg.norm(outlines, axis=1).max()) + 5.0, base.flange_radius + 10.0)
    radius = 5.0 * math.ceil(radius / 5.0)
    start = PLAY + spool.centre + bracket.face
    around = sorted(angle % (2.0 * math.pi) for angle in base.angles)
    turns = np.diff([*around, around[0] + 2.0 * math.pi])
    middle = tuple(float(angle + turn / 2.0) for angle, turn in zip(around, turns, strict=True))
    return shapes.Plate(
        radius=radius,
        thickness=6.0,
        passages=on_circle(base.tendon_radius, base.angles),
        passage=base.passage,
        mount_holes=base.mount_holes,
        mount_hole=base.mount_hole,
        cell_holes=tuple(
            placed(0.0, start + y, angle, base) for angle in base.angles for y in cell.holes[2:]
        ),
        leg_holes=on_circle(radius - 9.0, middle),
    )
