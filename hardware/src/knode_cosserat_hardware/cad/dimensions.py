"""Dimensions of all parts (mm and rad) from a robot and its section `hardware`, and their checks."""

from __future__ import annotations

import dataclasses
import itertools
import math
from pathlib import Path
from typing import Any

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

    @property
    def face_distance(self) -> float:
        """Distance along the motor's axis from the tendon to the bracket's face."""
        return PLAY + self.centre


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
#: over-tension limit of the board: 2300 grams-force (N)
BOARD_LIMIT = 2300 * GRAM_FORCE
#: thicknesses of aluminium bar in stock (mm)
STOCK = (1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)
#: Young's modulus of aluminium (MPa), and the greatest strain allowed at a gauge
ALUMINIUM, MAX_STRAIN = 69000.0, 1.0e-3
#: angle by which the robot may bend to either side (rad), and length of tendon in reserve (mm)
BEND, RESERVE = math.pi, 20.0
#: outlines of a tendon's spool, and of its motor with the load cell: corners in the robot's frame
Outlines = tuple[np.ndarray, np.ndarray]


@dataclasses.dataclass(frozen=True)
class PartDimensions:
    """Dimensions of all parts of a robot, in mm and rad; z = 0 is the rod's clamped end."""

    #: length of the rod above its clamped end, and its radius
    rod_length: float
    rod_radius: float
    #: angles of the tendons around the rod, and their distance from its axis
    angles: tuple[float, ...]
    tendon_radius: float
    #: heights of the upper faces of the ribs' disks
    rib_heights: tuple[float, ...]
    rib: Rib
    spool: Spool
    base: Base
    plate: Plate
    cell: Cell
    mount: Mount
    bracket: Bracket
    motor_radius: float
    #: diameter of the motion-capture markers
    marker_diameter: float

    @property
    def axis_depth(self) -> float:
        """Depth of the motors' axes below the plate."""
        return self.mount.height + self.cell.thickness - self.bracket.axis[1]

    @property
    def leg_length(self) -> float:
        """Length of the legs below the plate, in steps of 5 mm."""
        lowest = self.axis_depth + max(self.spool.flange_radius, self.bracket.height + self.bracket.axis[1])
        return 5.0 * math.ceil((lowest + 15.0) / 5.0)

    @property
    def travel(self) -> float:
        """Length of tendon that a spool takes in or gives out if the rod bends by half a turn either way."""
        return _travel(self.tendon_radius)

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
    sizes = hardware.dimensions
    length, radius, offset, angles = _tendons(robot)
    rib = _rib(sizes, radius, offset, angles)
    heights = _rib_heights(robot, sizes, length, rib.hub_height)
    spool = _spool(sizes, _travel(offset))
    base = _base(sizes, rib)
    cell = _cell(max(hardware.tension.high, BOARD_LIMIT), spool.face_distance)
    bracket = _bracket(1e3 * sizes.spool_radius, 500.0 * sizes.motor_diameter, cell)
    height = max(2.0 * HEAD, spool.flange_radius + 2.0 - (cell.thickness - bracket.axis[1]))
    mount = Mount(cell.end, cell.width, height, (cell.end / 4, 0.75 * cell.end))
    return PartDimensions(
        length,
        radius,
        angles,
        offset,
        heights,
        rib,
        spool,
        base,
        _plate(base, spool, cell, bracket),
        cell,
        mount,
        bracket,
        bracket.motor_radius,
        1e3 * sizes.marker_diameter,
    )


def _require(is_met: Any, message: str) -> None:
    if not is_met:
        raise PartError(message)


def _require_least(name: str, value: float, least: float, reason: str, fix: str = "") -> None:
    """Check that a length (mm), which robot files have in m under this name, is large enough."""
    message = f"{name} must be at least {_metres(least)} m, {reason} (got {_metres(value)})"
    _require(value >= least - EPSILON, f"{message}; {fix}" if fix else message)


def _metres(length: float) -> str:
    """Return a length in mm as text in m, as it is written in robot files."""
    return f"{length / 1e3:.4g}"


def _gap(points: Points) -> float:
    """Return the least distance of two points."""
    return min((math.dist(a, b) for a, b in itertools.combinations(points, 2)), default=math.inf)


def _travel(tendon_radius: float) -> float:
    return 2.0 * tendon_radius * BEND + RESERVE


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
    _require(
        len(around) == 4, f"tendon_angles must have 4 angles: the board drives 4 motors (got {len(around)})"
    )
    length, radius = float(np.asarray(robot.length)), float(np.asarray(getattr(robot, "radius", np.nan)))
    return 1e3 * length, 1e3 * radius, 1e3 * float(np.asarray(offset)), around


def _rib(sizes: Dimensions, radius: float, offset: float, angles: tuple[float, ...]) -> Rib:
    rod_hole = 2.0 * radius + 1e3 * sizes.rod_clearance
    outer, thickness, hole = 500 * sizes.rib_diameter, 1e3 * sizes.rib_thickness, 1e3 * sizes.hole_diameter
    hub = rod_hole / 2.0 + 3.0
    window = (hub + 1.0, outer - max(2.5, 2.0 * MIN_WALL))
    rib = Rib(
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
    _require_least(
        "hardware.rib_diameter",
        2.0 * outer,
        2.0 * (offset + hole / 2.0 + MIN_WALL),
        f"for walls of {MIN_WALL:g} mm around the tendons' holes",
        "or reduce tendon_offset",
    )
    _require_least(
        "tendon_offset",
        offset,
        hub + hole / 2.0 + MIN_WALL,
        f"for a hub around the rod of radius {_metres(radius)} m",
    )
    least, gap = hole + MIN_WALL, _gap(rib.tendon_holes)
    _require(
        gap >= least - EPSILON,
        f"tendon_angles must keep holes {_metres(least)} m apart (got {_metres(gap)}); "
        "tendons must not share a hole",
    )
    return rib


def _rib_heights(robot: System, sizes: Dimensions, length: float, hub: float) -> tuple[float, ...]:
    """Return the positions of ribs: those of attached masses, or equal distances up to the tip (mm)."""
    masses = [load for load in getattr(robot, "loads", ()) if getattr(load, "kind", "") == "attached-mass"]
    fractions = sorted(float(np.asarray(mass.at)) for mass in masses)
    fractions = fractions or [(k + 1) / sizes.rib_count for k in range(sizes.rib_count)]
    heights = tuple(length * fraction for fraction in fractions)
    for below, height in itertools.pairwise((0.0, *heights)):
        _require(
            height <= length + EPSILON and height - hub >= below + MIN_WALL - EPSILON,
            f"ribs must be at least {_metres(hub + MIN_WALL)} m apart, above the base and below "
            f"the tip at {_metres(length)} m (got {_metres(below)} and {_metres(height)}); use fewer ribs",
        )
    return heights


def capacity(spool: Spool) -> float:
    """Return the length of tendon that fits on a spool in one layer (mm)."""
    turns = math.floor(spool.width / TENDON + EPSILON) - DEAD_TURNS
    return max(turns, 0) * 2.0 * math.pi * (spool.drum_radius + TENDON / 2.0)


def _spool(sizes: Dimensions, travel: float) -> Spool:
    radius, bore = 1e3 * sizes.spool_radius, 1e3 * sizes.shaft_diameter + SHAFT_FIT
    spool = Spool(
        drum_radius=radius - TENDON / 2.0,
        width=1e3 * sizes.spool_width,
        flange_radius=radius + 1e3 * sizes.flange_height,
        flange_thickness=1.5,
        hub_radius=bore / 2.0 + 3.5,
        hub_length=6.0,
        bore=bore,
        across_flat=bore - SHAFT_CUT,
        tie_hole=2.0 * TENDON + 0.2,
    )
    _require_least(
        "hardware.spool_radius", radius, bore / 2.0 + MIN_WALL + TENDON / 2.0, "for the motor's shaft"
    )
    _require_least(
        "hardware.flange_height",
        1e3 * sizes.flange_height,
        spool.tie_hole + 2.0 * MIN_WALL,
        "for the hole that ties the tendon",
    )
    _require(
        capacity(spool) >= travel - EPSILON,
        f"hardware.spool_width must hold {_metres(travel)} m of tendon in one layer (got room for "
        f"{_metres(capacity(spool))} m); use a wider spool or a larger spool_radius",
    )
    _require(
        spool.across_flat - bore / 2.0 >= MIN_WALL / 2.0 and spool.hub_length <= SHAFT_LENGTH,
        f"hardware.shaft_diameter must be at least 0.002 m (got {sizes.shaft_diameter:g})",
    )
    return spool


def _base(sizes: Dimensions, rib: Rib) -> Base:
    height, passage, offset = 1e3 * sizes.base_height, 4.0, rib.tendon_radius
    around = sorted(angle % (2.0 * math.pi) for angle in rib.angles)
    first = (around[0] + around[1]) / 2.0
    socket, count = min(40.0, height - 8.0), sizes.mount_hole_count
    base = Base(
        flange_radius=500.0 * sizes.base_diameter,
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
        mount_radius=500.0 * sizes.mount_diameter,
        mount_hole=1e3 * sizes.mount_hole_diameter,
        mount_angles=tuple(first + 2.0 * math.pi * k / count for k in range(count)),
        screw_depths=(13.0, socket - 6.0),
        screw_angle=first,
    )
    least = base.rod_hole / 2.0 + 4.0 + passage / 2.0 + 0.5
    _require_least("tendon_offset", offset, least, "for the base's column between the tendons")
    _require(
        base.screw_depths[1] >= base.screw_depths[0] + 6.0 - EPSILON,
        f"hardware.base_height must be at least 0.033 m, for the rod's socket (got {_metres(height)})",
    )
    _require_least(
        "hardware.rib_diameter",
        2.0 * base.top_radius,
        2.0 * (offset + base.eyelet / 2.0 + MIN_WALL),
        "the diameter of the base's top, which leads the tendons",
    )
    gap = _gap(base.eyelets)
    _require(
        gap >= passage + MIN_WALL,
        f"tendon_angles must keep the base's passages {_metres(passage + MIN_WALL)} m apart "
        f"(got {_metres(gap)})",
    )
    rim = max(base.mount_radius + base.mount_hole / 2.0, offset + passage / 2.0) + MIN_WALL
    _require_least("hardware.base_diameter", 2.0 * base.flange_radius, 2.0 * rim, "for its holes")
    holes = base.mount_holes
    _require(
        min(math.dist(a, b) for a in holes for b in base.eyelets)
        >= (base.mount_hole + passage) / 2.0 + MIN_WALL
        and _gap(holes) >= base.mount_hole + MIN_WALL
        and base.mount_radius >= base.column_radius + base.mount_hole,
        f"hardware.mount_diameter must keep the mounting holes clear of the tendons, the column and each "
        f"other (got {_metres(2.0 * base.mount_radius)}); change mount_diameter or mount_hole_count",
    )
    return base


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


def _placed(x: float, y: float, angle: float, base: Base) -> tuple[float, float]:
    """Return a point of a tendon's frame (x radial from the tendon, y tangential) in the robot's frame."""
    cos, sin = math.cos(angle), math.sin(angle)
    radial = base.tendon_radius + x
    return radial * cos - y * sin, radial * sin + y * cos


def _outlines(base: Base, spool: Spool, cell: Cell, bracket: Bracket) -> list[Outlines]:
    """Return the outlines below the plate for each tendon."""
    face, axis = spool.face_distance, bracket.axis[0]
    left, far = min(bracket.left, axis - bracket.motor_radius), max(cell.length, MOTOR_LENGTH)
    boxes = (
        (axis - spool.flange_radius, face - PLAY - spool.length, axis + spool.flange_radius, face),
        (left, face, bracket.right, face + bracket.face + far),
    )
    found = []
    for angle in base.angles:
        corners = [[(a, b), (c, b), (c, d), (a, d)] for a, b, c, d in boxes]
        first, second = (np.array([_placed(x, y, angle, base) for x, y in box]) for box in corners)
        found.append((first, second))
    return found


def _plate(base: Base, spool: Spool, cell: Cell, bracket: Bracket) -> Plate:
    outlines = _outlines(base, spool, cell, bracket)
    reach = max(float(np.linalg.norm(part, axis=1).max()) for pair in outlines for part in pair)
    radius = 5.0 * math.ceil(max(reach + 5.0, base.flange_radius + 10.0) / 5.0)
    start = spool.face_distance + bracket.face
    around = sorted(angle % (2.0 * math.pi) for angle in base.angles)
    turns = np.diff([*around, around[0] + 2.0 * math.pi])
    middle = tuple(float(angle + turn / 2.0) for angle, turn in zip(around, turns, strict=True))
    plate = Plate(
        radius=radius,
        thickness=6.0,
        passages=base.eyelets,
        passage=base.passage,
        mount_holes=base.mount_holes,
        mount_hole=base.mount_hole,
        cell_holes=tuple(
            _placed(0.0, start + y, angle, base) for angle in base.angles for y in cell.holes[2:]
        ),
        leg_holes=on_circle(radius - 9.0, middle),
    )
    for (k, first), (j, second) in itertools.combinations(enumerate(outlines), 2):
        _require(
            not any(_overlap(a, b) for a in first for b in second),
            f"tendon_offset must be larger: motors {k + 1} and {j + 1} overlap below the plate "
            f"(got {_metres(base.tendon_radius)} m); or use a smaller motor or spool, or even tendon_angles",
        )
    square = on_circle(5.0 * math.sqrt(2.0), tuple(math.pi * (0.25 + 0.5 * k) for k in range(4)))
    for hole in plate.leg_holes:
        leg = np.asarray(hole) + np.asarray(square)
        _require(
            not any(_overlap(leg, part) for pair in outlines for part in pair),
            f"tendon_angles must leave room for legs between the motors (got a plate of radius "
            f"{_metres(radius)} m); use even angles or a smaller motor_diameter",
        )
    return plate


def _overlap(a: np.ndarray, b: np.ndarray) -> bool:
    """True if two convex outlines overlap: no edge of either separates them."""
    for outline in (a, b):
        edges = np.roll(outline, -1, axis=0) - outline
        normals = np.stack([-edges[:, 1], edges[:, 0]], axis=1)
        along_a, along_b = a @ normals.T, b @ normals.T
        if np.any((along_a.max(0) <= along_b.min(0)) | (along_b.max(0) <= along_a.min(0))):
            return False
    return True
