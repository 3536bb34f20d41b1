"""Checks of dimensions: parts with thin walls, spools without room, motors in the same place are refused."""

from __future__ import annotations

import itertools
import math

import numpy as np

from knode_cosserat_hardware.cad.shapes import (
    MIN_WALL,
    SHAFT_LENGTH,
    TENDON,
    Base,
    PartError,
    Plate,
    Rib,
    Spool,
    on_circle,
)
from knode_cosserat_hardware.description import Dimensions

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
