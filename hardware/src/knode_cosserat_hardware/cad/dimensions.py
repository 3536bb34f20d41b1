"""Dimensions of all parts (mm and rad) from a robot and its section `hardware`, and their checks."""

from __future__ import annotations

import dataclasses
import itertools
import math
from pathlib import Path

import numpy as np

from knode_cosserat.errors import KnodeCosseratError
from knode_cosserat.rods.robot_file import load_robot
from knode_cosserat.rods.system import System
from knode_cosserat_hardware.description import Dimensions, HardwareDescription, load_hardware
from knode_cosserat_hardware.lines import GRAM_FORCE

#: least thickness of a wall (mm)
MIN_WALL = 1.0
#: clearance holes of M3 screws, and holes that an M3 screw or its insert cuts a thread into (mm)
M3_CLEARANCE, M3_THREAD = 3.4, 2.5
#: height of a screw's head or nut with its washer (mm)
HEAD = 4.0
#: diameter of the tendons, a braided line (mm)
TENDON = 0.5
#: outer diameter of the sleeves that lead the tendons through the base (mm)
SLEEVE = 2.0
#: nominal gear motor JGA25-371 (mm): shaft, its flat, boss, screws, length of gear and motor
SHAFT_LENGTH, SHAFT_CUT = 10.0, 0.5
BOSS, SCREW_SPACING, MOTOR_LENGTH = 7.0, 17.0, 56.0
#: difference of the diameters of a spool's bore and the shaft, after printing (mm)
SHAFT_FIT = 0.1
#: play between a spool's hub and the bracket (mm)
PLAY = 0.5

Points = tuple[tuple[float, float], ...]


class PartError(KnodeCosseratError, ValueError):
    """A robot whose parts cannot be made: one line with the dimension at fault and the likely fix."""

    code = "part"


def on_circle(radius: float, angles: tuple[float, ...]) -> Points:
    """Return the points of a circle at some angles."""
    return tuple((radius * math.cos(angle), radius * math.sin(angle)) for angle in angles)


@dataclasses.dataclass(frozen=True)
class Rib:
    """A disk with a hub that is clamped on the rod; the tendons run through the ends of its spokes."""

    outer_radius: float
    thickness: float
    rod_hole: float
    hub_radius: float
    #: height of disk and hub together
    hub_height: float
    tendon_hole: float
    tendon_radius: float
    angles: tuple[float, ...]
    spoke_width: float
    #: inner and outer radius of the windows between the spokes; None without windows
    window: tuple[float, float] | None
    screw_hole: float = M3_THREAD

    @property
    def tendon_holes(self) -> Points:
        """Centres of the tendons' holes."""
        return on_circle(self.tendon_radius, self.angles)


@dataclasses.dataclass(frozen=True)
class Spool:
    """A reel on a motor's shaft: hub with a set screw, flange, drum, flange."""

    #: radius of the drum; the tendon's centre line is at the spool's radius
    drum_radius: float
    width: float
    flange_radius: float
    flange_thickness: float
    hub_radius: float
    hub_length: float
    bore: float
    #: distance from the bore's flat to its opposite side
    across_flat: float
    tie_hole: float
    screw_hole: float = M3_THREAD

    @property
    def length(self) -> float:
        """Length along the shaft."""
        return self.hub_length + 2.0 * self.flange_thickness + self.width

    @property
    def centre(self) -> float:
        """Distance from the hub's end to the middle of the drum."""
        return self.hub_length + self.flange_thickness + self.width / 2.0


@dataclasses.dataclass(frozen=True)
class Base:
    """A column on a flange. It holds the rod in a socket; the disk on its top leads the tendons."""

    flange_radius: float
    flange_thickness: float
    height: float
    column_radius: float
    top_radius: float
    top_thickness: float
    rod_hole: float
    socket_depth: float
    #: holes of the top disk, for sleeves, and wide holes of the flange
    eyelet: float
    passage: float
    tendon_radius: float
    angles: tuple[float, ...]
    mount_radius: float
    mount_hole: float
    mount_angles: tuple[float, ...]
    #: depths below the top of the two pairs of set screws that hold the rod
    screw_depths: tuple[float, float]
    screw_angle: float
    screw_hole: float = M3_THREAD

    @property
    def eyelets(self) -> Points:
        """Centres of the holes that lead the tendons."""
        return on_circle(self.tendon_radius, self.angles)

    @property
    def mount_holes(self) -> Points:
        """Centres of the mounting holes."""
        return on_circle(self.mount_radius, self.mount_angles)


@dataclasses.dataclass(frozen=True)
class Plate:
    """A round plate. The base stands on it; load cells and motors hang below."""

    radius: float
    thickness: float
    passages: Points
    passage: float
    mount_holes: Points
    mount_hole: float
    #: screws of the load-cell mounts
    cell_holes: Points
    leg_holes: Points
    leg_hole: float = 5.5
    cell_hole: float = M3_CLEARANCE


@dataclasses.dataclass(frozen=True)
class Cell:
    """A bending beam with a strain gauge in its middle: one end at the mount, the bracket at the other."""

    length: float
    width: float
    thickness: float
    #: length that bracket and mount cover at the ends
    end: float
    #: distance from the gauge to the tendon
    lever: float
    #: strain at the gauge under the greatest tension, of an aluminium beam
    strain: float
    hole: float = M3_CLEARANCE

    @property
    def holes(self) -> tuple[float, ...]:
        """Distances of the screws from the bracket's end."""
        quarter = self.end / 4.0
        return (quarter, 3.0 * quarter, self.length - 3.0 * quarter, self.length - quarter)


@dataclasses.dataclass(frozen=True)
class Mount:
    """The block between the plate and the fixed end of a load cell."""

    length: float
    width: float
    height: float
    holes: tuple[float, ...]
    hole: float = M3_CLEARANCE


@dataclasses.dataclass(frozen=True)
class Bracket:
    """An angle that holds a motor below a load cell: face, foot and gussets.

    Its x axis points from the tendon to the motor's axis, z up; y = 0 is the side of the face at the spool.
    """

    left: float
    right: float
    face: float
    foot: float
    foot_length: float
    height: float
    #: position of the motor's axis: distance from the tendon, and below the foot's upper side
    axis: tuple[float, float]
    foot_holes: tuple[float, ...]
    motor_radius: float
    boss_hole: float = BOSS + 0.4
    screw_spacing: float = SCREW_SPACING
    screw_hole: float = M3_CLEARANCE
    foot_hole: float = M3_CLEARANCE
    gusset: float = 3.0


#: turns that stay on a spool, so that the tendon's knot carries little
DEAD_TURNS = 3
#: tolerance of comparisons (mm)
EPSILON = 1e-9


def _require(is_met: bool, message: str) -> None:
    if not is_met:
        raise PartError(message)


def _metres(length: float) -> str:
    """Return a length in mm as text in m, as it is written in robot files."""
    return f"{length / 1e3:.4g}"


def _gap(points: tuple[tuple[float, float], ...]) -> float:
    """Return the least distance of two points."""
    return min((math.dist(a, b) for a, b in itertools.combinations(points, 2)), default=math.inf)


def require_tendons(rib: Rib, rod_radius: float) -> None:
    """Check the walls of a rib between rod, tendons and rim.

    Raises:
        PartError: a wall is thinner than 1 mm.
    """
    hole = rib.tendon_hole / 2.0
    least = 2.0 * (rib.tendon_radius + hole + MIN_WALL)
    _require(
        2.0 * rib.outer_radius >= least - EPSILON,
        f"hardware.rib_diameter must be at least {_metres(least)} m, for walls of {MIN_WALL:g} mm around the "
        f"tendons' holes (got {_metres(2.0 * rib.outer_radius)}); or reduce tendon_offset",
    )
    least = rib.hub_radius + hole + MIN_WALL
    _require(
        rib.tendon_radius >= least - EPSILON,
        f"tendon_offset must be at least {_metres(least)} m, for a hub around the rod of radius "
        f"{_metres(rod_radius)} m (got {_metres(rib.tendon_radius)})",
    )
    least = rib.tendon_hole + MIN_WALL
    _require(
        _gap(rib.tendon_holes) >= least - EPSILON,
        f"tendon_angles must keep holes {_metres(least)} m apart (got {_metres(_gap(rib.tendon_holes))}); "
        f"tendons must not share a hole",
    )


def require_ribs(rib: Rib, heights: tuple[float, ...], length: float) -> None:
    """Check that the ribs are on the rod and do not touch each other.

    Raises:
        PartError: ribs overlap, or one is not on the rod.
    """
    for below, height in itertools.pairwise((0.0, *heights)):
        _require(
            height <= length + EPSILON and height - rib.hub_height >= below + MIN_WALL - EPSILON,
            f"ribs must be at least {_metres(rib.hub_height + MIN_WALL)} m apart, above the base and below "
            f"the tip at {_metres(length)} m (got {_metres(below)} and {_metres(height)}); use fewer ribs",
        )


def capacity(spool: Spool) -> float:
    """Return the length of tendon that fits on a spool in one layer (mm)."""
    turns = math.floor(spool.width / TENDON + EPSILON) - DEAD_TURNS
    return max(turns, 0) * 2.0 * math.pi * (spool.drum_radius + TENDON / 2.0)


def require_spool(spool: Spool, given: Dimensions, travel: float) -> None:
    """Check a spool's walls and its capacity.

    Raises:
        PartError: a wall is too thin, or the tendon's travel does not fit on it.
    """
    least = spool.bore / 2.0 + MIN_WALL + TENDON / 2.0
    _require(
        spool.drum_radius - spool.bore / 2.0 >= MIN_WALL - EPSILON,
        f"hardware.spool_radius must be at least {_metres(least)} m for the shaft "
        f"(got {given.spool_radius:g})",
    )
    least = spool.tie_hole + 2.0 * MIN_WALL
    _require(
        1e3 * given.flange_height >= least - EPSILON,
        f"hardware.flange_height must be at least {_metres(least)} m, for the hole that ties the tendon "
        f"(got {given.flange_height:g})",
    )
    _require(
        capacity(spool) >= travel - EPSILON,
        f"hardware.spool_width must hold {_metres(travel)} m of tendon in one layer (got room for "
        f"{_metres(capacity(spool))} m); use a wider spool or a larger spool_radius",
    )
    _require(
        spool.across_flat - spool.bore / 2.0 >= MIN_WALL / 2.0 and spool.hub_length <= SHAFT_LENGTH,
        f"hardware.shaft_diameter must be at least 0.002 m (got {given.shaft_diameter:g})",
    )


def require_base(base: Base) -> None:
    """Check the base's walls, socket and mounting holes.

    Raises:
        PartError: a wall is thinner than allowed, or holes touch.
    """
    least = base.rod_hole / 2.0 + 4.0 + base.passage / 2.0 + 0.5
    _require(
        base.column_radius - base.rod_hole / 2.0 >= 4.0 - EPSILON,
        f"tendon_offset must be at least {_metres(least)} m, for the base's column between the tendons "
        f"(got {_metres(base.tendon_radius)})",
    )
    _require(
        base.screw_depths[1] >= base.screw_depths[0] + 6.0 - EPSILON,
        f"hardware.base_height must be at least 0.033 m, for the rod's socket (got {_metres(base.height)})",
    )
    least = 2.0 * (base.tendon_radius + base.eyelet / 2.0 + MIN_WALL)
    _require(
        2.0 * base.top_radius >= least - EPSILON,
        f"hardware.rib_diameter must be at least {_metres(least)} m: the base's top has this diameter and "
        f"leads the tendons (got {_metres(2.0 * base.top_radius)})",
    )
    _require(
        _gap(base.eyelets) >= base.passage + MIN_WALL,
        f"tendon_angles must keep the base's passages {_metres(base.passage + MIN_WALL)} m apart "
        f"(got {_metres(_gap(base.eyelets))})",
    )
    rim = max(base.mount_radius + base.mount_hole / 2.0, base.tendon_radius + base.passage / 2.0) + MIN_WALL
    _require(
        base.flange_radius >= rim - EPSILON,
        f"hardware.base_diameter must be at least {_metres(2.0 * rim)} m, for its holes "
        f"(got {_metres(2.0 * base.flange_radius)})",
    )
    _require_mount_holes(base)


def _require_mount_holes(base: Base) -> None:
    holes, head = base.mount_holes, 2.0 * base.mount_hole
    near = min(math.dist(a, b) for a in holes for b in base.eyelets)
    apart = near >= (base.mount_hole + base.passage) / 2.0 + MIN_WALL
    _require(
        apart
        and _gap(holes) >= base.mount_hole + MIN_WALL
        and base.mount_radius >= base.column_radius + head / 2.0,
        f"hardware.mount_diameter must keep the mounting holes clear of the tendons, the column and each "
        f"other (got {_metres(2.0 * base.mount_radius)}); change mount_diameter or mount_hole_count",
    )


def require_plate(plate: Plate, base: Base, outlines: list[tuple[np.ndarray, np.ndarray]]) -> None:
    """Check that motors, spools, legs and screws below the plate do not touch.

    Args:
        plate: the motor plate.
        base: the base that stands on it.
        outlines: corners of each tendon's spool, and of its motor with the load cell.

    Raises:
        PartError: two of them overlap.
    """
    for (k, first), (j, second) in itertools.combinations(enumerate(outlines), 2):
        touch = any(_overlap(a, b) for a in first for b in second)
        _require(
            not touch,
            f"tendon_offset must be larger: motors {k + 1} and {j + 1} overlap below the plate "
            f"(got {_metres(base.tendon_radius)} m); or use a smaller motor or spool, or even tendon_angles",
        )
    for hole in plate.leg_holes:
        leg = np.asarray(hole) + 5.0 * np.asarray(on_circle(math.sqrt(2.0), tuple(_SQUARE)))
        _require(
            not any(_overlap(leg, part) for pair in outlines for part in pair),
            f"tendon_angles must leave room for legs between the motors (got a plate of radius "
            f"{_metres(plate.radius)} m); use even angles or a smaller motor_diameter",
        )


_SQUARE = [math.pi * (0.25 + 0.5 * k) for k in range(4)]


def _overlap(a: np.ndarray, b: np.ndarray) -> bool:
    """True if two convex outlines overlap: no edge of either separates them."""
    for outline in (a, b):
        edges = np.roll(outline, -1, axis=0) - outline
        normals = np.stack([-edges[:, 1], edges[:, 0]], axis=1)
        along_a, along_b = a @ normals.T, b @ normals.T
        if np.any((along_a.max(0) <= along_b.min(0)) | (along_b.max(0) <= along_a.min(0))):
            return False
    return True


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
    rib: Rib
    spool: Spool
    base: Base
    plate: Plate
    cell: Cell
    mount: Mount
    bracket: Bracket
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
    mount = Mount(
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


def _rib(given: Dimensions, radius: float, offset: float, angles: tuple[float, ...]) -> Rib:
    rod_hole = 2.0 * radius + 1e3 * given.rod_clearance
    outer, thickness, hole = 500 * given.rib_diameter, 1e3 * given.rib_thickness, 1e3 * given.hole_diameter
    hub = rod_hole / 2.0 + 3.0
    window = (hub + 1.0, outer - max(2.5, 2.0 * MIN_WALL))
    return Rib(
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


def _spool(given: Dimensions) -> Spool:
    radius, bore = 1e3 * given.spool_radius, 1e3 * given.shaft_diameter + SHAFT_FIT
    return Spool(
        drum_radius=radius - TENDON / 2.0,
        width=1e3 * given.spool_width,
        flange_radius=radius + 1e3 * given.flange_height,
        flange_thickness=1.5,
        hub_radius=bore / 2.0 + 3.5,
        hub_length=6.0,
        bore=bore,
        across_flat=bore - SHAFT_CUT,
        tie_hole=2.0 * TENDON + 0.2,
    )


def _base(given: Dimensions, rib: Rib) -> Base:
    height, passage, offset = 1e3 * given.base_height, 4.0, rib.tendon_radius
    between = sorted(angle % (2.0 * math.pi) for angle in rib.angles)
    first = (between[0] + between[1]) / 2.0
    socket = min(40.0, height - 8.0)
    count = given.mount_hole_count
    return Base(
        flange_radius=500.0 * given.base_diameter,
        flange_thickness=6.0,
        height=height,
        column_radius=min(rib.rod_hole / 2.0 + 7.0, offset - passage / 2.0 - 0.5),
        top_radius=rib.outer_radius,
        top_thickness=8.0,
        rod_hole=rib.rod_hole,
        socket_depth=socket,
        eyelet=SLEEVE,
        passage=passage,
        tendon_radius=offset,
        angles=rib.angles,
        mount_radius=500.0 * given.mount_diameter,
        mount_hole=1e3 * given.mount_hole_diameter,
        mount_angles=tuple(first + 2.0 * math.pi * k / count for k in range(count)),
        screw_depths=(13.0, socket - 6.0),
        screw_angle=first,
    )


def _cell(force: float, face: float) -> Cell:
    """Return the thinnest beam of stock that carries a force (N)."""
    width, end, free, bracket_face = 12.0, 18.0, 24.0, 3.0
    lever = face + bracket_face + end + free / 2.0
    for thickness in STOCK:
        strain = 6.0 * force * lever / (width * thickness**2 * ALUMINIUM)
        if strain <= MAX_STRAIN:
            return Cell(2.0 * end + free, width, thickness, end, lever, strain)
    most = MAX_STRAIN * width * STOCK[-1] ** 2 * ALUMINIUM / (6.0 * lever)
    raise PartError(
        f"hardware.tension.high must be at most {most:.0f} N: no beam of {width:g} mm x {STOCK[-1]:g} mm "
        f"carries more (got {force:g})"
    )


def _bracket(spool_radius: float, motor_radius: float, cell: Cell) -> Bracket:
    face, foot, gap, gusset = 3.0, 4.0, 3.0, 3.0
    half = (SCREW_SPACING + M3_CLEARANCE) / 2.0 + 2.0 * MIN_WALL
    return Bracket(
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


def placed(x: float, y: float, angle: float, base: Base) -> tuple[float, float]:
    """Return a point of a tendon's frame (x radial from the tendon, y tangential) in the robot's frame."""
    cos, sin = math.cos(angle), math.sin(angle)
    radial = base.tendon_radius + x
    return radial * cos - y * sin, radial * sin + y * cos


def _corners(angle: float, base: Base, low: tuple[float, float], high: tuple[float, float]) -> np.ndarray:
    at = [(low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1])]
    return np.array([placed(x, y, angle, base) for x, y in at])


def _rectangles(
    base: Base, spool: Spool, cell: Cell, bracket: Bracket
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the outlines below the plate of each tendon's spool and of its motor with the load cell."""
    face, axis = PLAY + spool.centre, bracket.axis[0]
    left = min(bracket.left, axis - bracket.motor_radius)
    far = face + bracket.face + max(cell.length, MOTOR_LENGTH)
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


def _plate(base: Base, spool: Spool, cell: Cell, bracket: Bracket) -> Plate:
    outlines = np.concatenate([part for pair in _rectangles(base, spool, cell, bracket) for part in pair])
    radius = max(float(np.linalg.norm(outlines, axis=1).max()) + 5.0, base.flange_radius + 10.0)
    radius = 5.0 * math.ceil(radius / 5.0)
    start = PLAY + spool.centre + bracket.face
    around = sorted(angle % (2.0 * math.pi) for angle in base.angles)
    turns = np.diff([*around, around[0] + 2.0 * math.pi])
    middle = tuple(float(angle + turn / 2.0) for angle, turn in zip(around, turns, strict=True))
    return Plate(
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
