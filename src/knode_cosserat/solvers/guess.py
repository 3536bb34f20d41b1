"""Initial guesses of a shape: through measured positions, or between the poses of two held ends."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from knode_cosserat.engine.pattern import values_along
from knode_cosserat.rods.aspects import Ends
from knode_cosserat.rods.ends import AXES, Clamped, Pinned, Pose, Universal
from knode_cosserat.rods.rod import SlenderRod
from knode_cosserat.rods.section import ALONG
from knode_cosserat.rods.strands import strand_count
from knode_cosserat.rods.system import System, array_module
from knode_cosserat.rods.wrapped import nominal_model
from knode_cosserat.schemes.grid import grid_of
from knode_cosserat.solvers.rest import rest_record

#: fewest positions that define a curve, and number of positions along a curve between held ends
FEWEST, POINTS = 2, 65
#: reaches of the curves between held ends, as multiples of the natural reach
REACHES = (1.0, 0.3, 3.0)
#: largest rotation (rad) of an end from one solution to the next where turns are kept by small parts
LARGEST_TURN = 1.0
#: a time step that turns an end by more (rad) is solved in parts: Newton's method loses turns from about 2.3
LARGEST_JUMP = 0.5 * np.pi
#: where tangents of two shapes are more opposite than this cosine, the turns between them are not determined
OPPOSITE = -0.9


class _HeldEnd(NamedTuple):
    """Pose of a held end under a control."""

    p: Float[np.ndarray, "3"]
    #: orientation (quaternion, scalar first); None for a pinned end
    h: Float[np.ndarray, "4"] | None
    #: rotation vector (rad) by which the control turns the end, with all its turns
    turn: Float[np.ndarray, "3"]

    @property
    def tangent(self) -> Float[np.ndarray, "3"] | None:
        """Direction of the rod at the end; None for a pinned end."""
        return None if self.h is None else rotations(self.h).apply(ALONG)

    @property
    def spin(self) -> float:
        """Rotation (rad) of the end about the rod's direction, with all its turns."""
        # along a turn about a constant axis, the component along the tangent is constant
        return 0.0 if self.h is None else float(self.turn @ self.tangent)


def held_ends(system: System, control: Any) -> tuple[_HeldEnd | None, _HeldEnd | None]:
    """Return the poses in which base and tip are held under a control; None for an end that is free."""
    columns, control = turn_columns(system), np.asarray(control, dtype=float)
    turns = np.where(columns < 0, 0.0, np.append(control, 0.0)[columns])
    found: list[_HeldEnd | None] = []
    for pose, pinned, turn in zip(*_poses(system, jnp.asarray(control)), turns, strict=True):
        held = pose or pinned
        if held is None:
            found.append(None)
        else:
            found.append(_HeldEnd(np.asarray(held.p), None if held.h is None else np.asarray(held.h), turn))
    return found[0], found[1]


@jax.jit
def _poses(system: System, control: Any) -> Any:
    """Return the poses of clamped ends and of pinned ends."""
    rod, pinned = nominal_model(system), list[Any]((None, None))
    for k, end in enumerate((rod.base_end, rod.tip_end) if isinstance(rod, SlenderRod) else ()):
        if isinstance(end, Pinned):
            p, h = rod.y_layout.split(rod.rest(k * jnp.asarray(rod.length))[0])[:2]
            pinned[k] = Pose(end.pose(Pose(p, h), control[:0]).p, None)
    return Ends.of(system).poses(control), tuple(pinned)


def turn_columns(system: System) -> Int[np.ndarray, "2 3"]:
    """Return the indices in a control of the rotations of base and tip about x, y, z; -1 if not driven."""
    layout, rod, found = system.control_layout, nominal_model(system), np.full((2, 3), -1)
    for end, prefix in enumerate(("base", "tip") if isinstance(rod, SlenderRod) else ()):
        for k, axis in enumerate(AXES[3:]):
            if f"{prefix}_{axis}" in layout.names:
                found[end, k] = layout.slice(f"{prefix}_{axis}").start
    return found


def largest_turns(system: System, changes: Any) -> Any:
    """Return the largest angle (rad) by which changes of control (..., c) turn an end of a rod.

    It is zero for one rod with an end that cannot hold its turns, such as a free tip.
    """
    numeric = array_module(changes)
    angles = [numeric.sum(changes[..., columns] ** 2, axis=-1) ** 0.5 for columns in turning_ends(system)]
    return functools.reduce(numeric.maximum, angles, np.zeros(np.shape(changes)[:-1]))


def turning_ends(system: System) -> list[list[int]]:
    """Return the indices in a control of each driven end's rotations, if rods between ends hold turns."""
    layout, rod, found = system.control_layout, nominal_model(system), dict[str, list[int]]()
    held = isinstance(rod, SlenderRod) and (
        isinstance(rod.base_end, Clamped) and isinstance(rod.tip_end, Clamped | Universal)
    )
    for name in layout.names if held or not isinstance(rod, SlenderRod) else ():
        end, _, axis = name.rpartition("_")
        if axis in AXES[3:]:
            found.setdefault(end, []).append(layout.slice(name).start)
    return list(found.values())


def turns_within(system: System, controls: Any, before: Any) -> Any:
    """Return the largest angles (..., T) (rad) by which each of controls (..., T, c) turns an end.

    `before` (..., c) precedes the first one. Controls at several stages of a step count as the last one.
    """
    numeric = array_module((controls, before))
    rows = controls[..., -system.control_layout.size :]
    earlier = numeric.concatenate([numeric.asarray(before)[..., None, :], rows[..., :-1, :]], axis=-2)
    return largest_turns(system, rows - earlier)


def turns_between(system: System, before: Any, after: Any) -> int:
    """Return the number of turns by which two shapes differ beyond the rotation of the ends.

    The shapes are records at the nodes. The frames of the first are rotated to the tangents of the other. The
    angle between frames is then counted along the rod, and compared with its value at the tip within half a
    turn. It is zero unless both ends of a rod are clamped.
    """
    if not are_clamped(system):
        return 0
    h = system.y_layout.slice("h")
    one, other = (rotations(continuous(records[:, h])) for records in (before, after))
    t, r = one.apply([0.0, 0.0, 1.0]), other.apply([0.0, 0.0, 1.0])
    cosine = np.sum(t * r, axis=1)
    if np.min(cosine) < OPPOSITE:
        return 0
    # the shortest rotation from one tangent to the other
    swing = np.concatenate([1.0 + cosine[:, None], np.cross(t, r)], axis=1)
    over = ((rotations(swing) * one).inv() * other).as_quat()
    angle = np.unwrap(2.0 * np.arctan2(over[:, 2], over[:, 3]))
    return int(np.round((angle[-1] - angle[0]) / (2.0 * np.pi)))


def are_clamped(system: System) -> bool:
    """True if the orientation of both ends is prescribed."""
    rod = nominal_model(system)
    return isinstance(rod, SlenderRod) and all(
        isinstance(end, Clamped) for end in (rod.base_end, rod.tip_end)
    )


def state_from_positions(
    system: System, positions: Float[np.ndarray, "M 3"], control: Any
) -> Float[np.ndarray, "nodes x"]:
    """Return y and z at the nodes of a rod whose centreline goes through these positions.

    The positions are assumed evenly spaced along the rod, from base to tip, and are joined by a spline. The
    frames follow the rod's twist at rest. A held tip determines the twist up to whole turns: the nearest to
    rest is taken, plus the turns by the control. What the tip adds is spread evenly. Moments follow from the
    material's law; forces are zero. Accepts systems of one rod with positions p, orientations h and
    curvatures u.

    Raises:
        ValueError: the positions are no curve, or the system is not accepted.
    """
    from scipy.interpolate import make_interp_spline

    positions = np.asarray(positions, dtype=float)
    y_layout, z_layout = system.y_layout, system.z_layout
    if strand_count(system) > 1 or not {"p", "h"} <= set(y_layout.names) or "u" not in z_layout.names:
        raise ValueError(
            f"initial holds positions, and a {type(system).__name__} is not one rod with p, h and u; "
            "give a Trajectory"
        )
    if positions.ndim != 2 or positions.shape[1] != 3 or len(positions) < FEWEST:
        raise ValueError(
            f"initial has shape {positions.shape}; allowed is (M, 3) positions in m, M from {FEWEST}"
        )
    if not np.all(np.isfinite(positions)) or np.any(np.all(np.diff(positions, axis=0) == 0.0, axis=1)):
        raise ValueError("initial holds positions that are not finite, or that repeat")
    record = np.array(rest_record(system))
    s = np.linspace(0.0, 1.0, system.nodes)
    order, along = min(3, len(positions) - 1), np.linspace(0.0, 1.0, len(positions))
    spline = make_interp_spline(along, positions, k=order)
    p, tangent = spline(s), spline.derivative()(s)
    tangent = tangent / np.linalg.norm(tangent, axis=1, keepdims=True)
    base, tip = held_ends(system, control)
    ny, material = y_layout.size, None
    u_rows = slice(ny + z_layout.slice("u").start, ny + z_layout.slice("u").stop)
    u_rest = record[:, u_rows].copy()
    if hasattr(system, "material"):
        material = materials(system, s * float(system.length), np.asarray(control))
        u_rest = np.asarray(material.u_star)
    h = _transport_frames(
        record[0, y_layout.slice("h")] if base is None or base.h is None else base.h, tangent
    )
    spin = (0.0 if tip is None else tip.spin) - (0.0 if base is None else base.spin)
    h = _twist_frames(h, None if tip is None else tip.h, u_rest[:, 2] * float(system.length), spin)
    frames = rotations(h)
    between = (frames[:-1].inv() * frames[1:]).as_rotvec() / (float(system.length) / (system.nodes - 1))
    u = np.concatenate([between[:1], 0.5 * (between[:-1] + between[1:]), between[-1:]])
    record[:, y_layout.slice("p")], record[:, y_layout.slice("h")] = p, h
    record[:, u_rows] = u
    if "m" in y_layout.names and material is not None:
        Kbt = np.asarray(material.Kbt)
        record[:, y_layout.slice("m")] = frames.apply(np.einsum("kij,kj->ki", Kbt, u - u_rest))
    return record


def curve_guesses(system: System, control: Any) -> list[Float[Any, "points y"]]:
    """Return y at all points on curves of the rod's length between its held ends; none if an end is free."""
    found = []
    for reach in dict.fromkeys(min(1.0, part * natural_reach(system)) for part in REACHES):
        points = hanging_curve(system, control, reach)
        if points is not None:
            record = state_from_positions(system, points, control)
            found.append(grid_of(system).spread(record[:, : system.y_layout.size]))
    return found


def materials(system: Any, s: Any, control: Any) -> Any:
    """Return section and material at places (m) along a rod."""
    return values_along(_material, system, s, control)


def _material(system: Any, s: Any, control: Any) -> Any:
    return system.material(s, control)


def rotations(h: Any) -> Any:
    """Return SciPy's rotations of quaternions, scalar first."""
    # imported here: it would double this package's import time
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat(np.roll(h, -1, axis=-1))


def _transport_frames(base: Any, tangents: Any) -> Any:
    """Return twist-free orientations (quaternions, scalar first) along tangents, starting at the base's."""
    from scipy.spatial.transform import Rotation

    frame = rotations(base)
    found = []
    for tangent in tangents:
        axis = frame.apply([0.0, 0.0, 1.0])
        across, along = np.cross(axis, tangent), float(np.dot(axis, tangent))
        size = float(np.linalg.norm(across))
        if size < 1e-12 and along < 0.0:  # tangent reversed: rotate about any perpendicular axis
            across, size = frame.apply([1.0, 0.0, 0.0]), 1.0
            turn = np.pi * across
        else:
            turn = across * (np.arctan2(size, along) / size if size > 0.0 else 0.0)
        frame = Rotation.from_rotvec(turn) * frame
        found.append(np.roll(frame.as_quat(), 1))
    return continuous(np.array(found))


def continuous(h: Float[np.ndarray, "nodes 4"]) -> Float[np.ndarray, "nodes 4"]:
    """Return quaternions, each with the sign nearest to the one before."""
    signs = np.where(np.sum(h[1:] * h[:-1], axis=1) < 0.0, -1.0, 1.0)
    return h * np.cumprod(np.concatenate([[1.0], signs]))[:, None]


def _twist_frames(h: Any, tip: Any, rate: Any, spin: float) -> Any:
    """Return orientations twisted about their tangents as at rest, and then evenly to meet the tip's.

    `rate` is the twist at rest (rad over the whole length) at the nodes. Of the windings that meet the tip's
    orientation, the nearest to the twist at rest plus the `spin` (rad) of the ends is taken.
    """
    from scipy.spatial.transform import Rotation

    frames, part = rotations(h), 1.0 / (len(h) - 1)
    twist = np.concatenate([[0.0], np.cumsum((rate[1:] + rate[:-1]) * part / 2.0)])
    wanted = twist[-1] + spin
    if tip is not None:
        over = (frames[-1].inv() * rotations(tip)).as_quat()
        angle = 2.0 * np.arctan2(over[2], over[3])
        wanted = angle + 2.0 * np.pi * np.round((wanted - angle) / (2.0 * np.pi))
    turns = np.zeros((len(h), 3))
    turns[:, 2] = twist + np.linspace(0.0, wanted - twist[-1], len(h))
    return continuous(np.roll((frames * Rotation.from_rotvec(turns)).as_quat(), 1, axis=1))


def natural_reach(system: System) -> float:
    """Return the distance over which an end of the rod keeps its direction, as a part of the length.

    It is twice the gravity-bending length (EI/ρAg)^⅓, at most 1: for a stiff rod, or without gravity.
    """
    gravity = float(np.linalg.norm(np.asarray(getattr(system, "gravity", 0.0))))
    if gravity == 0.0 or not (hasattr(system, "Kbt") and hasattr(system, "mass_per_length")):
        return 1.0
    weight = float(system.mass_per_length) * gravity
    bending = float(np.min(np.linalg.eigvalsh(np.asarray(system.Kbt))))
    return min(1.0, 2.0 * float(np.cbrt(bending / weight)) / float(system.length))


def hanging_curve(system: System, control: Any, reach: float) -> Float[np.ndarray, "M 3"] | None:
    """Return positions on a smooth curve of the rod's length between its held ends; None if an end is free.

    It sags along gravity. It leaves both ends along their tangents, further for a larger `reach` (parts of
    the length): far for a stiff rod, hardly for a floppy one. If the ends are farther apart than the
    length, the curve is longer than the rod.
    """
    base, tip = held_ends(system, control)
    if base is None or tip is None:
        return None
    length = float(system.length)
    chord = tip.p - base.p
    down = _sagging(system, chord, base)
    # a pinned end points along the side of a triangle of the rod's length
    along = chord / length
    aside = np.sqrt(max(0.0, 1.0 - along @ along)) * down
    ends = [
        (end.p, along + sign * aside if end.tangent is None else end.tangent)
        for end, sign in ((base, 1.0), (tip, -1.0))
    ]
    x = np.linspace(0.0, 1.0, POINTS)[:, None]
    bump = 16.0 * x * x * (1.0 - x) ** 2

    def curve(reach: float, sag: float) -> Any:
        (p, t), (q, r) = ends
        blend = x * x * (3.0 - 2.0 * x)
        hermite = p + blend * (q - p) + reach * (x * (1.0 - x) ** 2 * t - x * x * (1.0 - x) * r)
        return hermite + sag * bump * down

    def excess(points: Any) -> float:
        return float(np.sum(np.linalg.norm(np.diff(points, axis=0), axis=1))) - length

    most = reach * length
    if excess(curve(most, 0.0)) > 0.0:
        found = curve(_root(lambda reach: excess(curve(reach, 0.0)), most), 0.0)
    else:
        found = curve(most, _root(lambda sag: -excess(curve(most, sag)), length))
    # at even distances along the polygon
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(found, axis=0), axis=1))])
    at = np.linspace(0.0, along[-1], len(found))
    return np.stack([np.interp(at, along, column) for column in found.T], axis=1)


def _sagging(system: System, chord: Any, base: _HeldEnd) -> Any:
    """Return a unit vector normal to the chord: along gravity, else where the rod bends easily, else any."""
    ways = [getattr(nominal_model(system), "gravity", np.zeros(3))]
    if base.h is not None and hasattr(nominal_model(system), "Kbt"):
        # bending about an axis moves the rod across it
        axis = np.linalg.eigh(np.asarray(nominal_model(system).Kbt)[:2, :2])[1][:, 0]
        ways.append(rotations(base.h).apply(np.cross([*axis, 0.0], ALONG)))
    for way in (*ways, *([] if base.tangent is None else [base.tangent]), *np.eye(3)):
        way = np.asarray(way, dtype=float)
        across = way - chord * np.dot(way, chord) / max(np.dot(chord, chord), 1e-300)
        if np.linalg.norm(across) > 1e-6 * float(np.linalg.norm(way)):
            return across / np.linalg.norm(across)
    return np.eye(3)[2]


def _root(growing: Any, high: float) -> float:
    """Return the sign change of a function between 0 and high, by bisection; an end if there is none."""
    low, rises = 0.0, growing(high) > 0.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if (growing(middle) > 0.0) == rises else (middle, high)
    return 0.5 * (low + high)
