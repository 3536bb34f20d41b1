"""Dimensions of the single parts, in mm and rad. CAD files are in mm, too."""

from __future__ import annotations

import dataclasses
import math

from knode_cosserat.errors import KnodeCosseratError

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
