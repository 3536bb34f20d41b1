"""Initial guesses of a shape: through measured positions, or between the poses of two held ends."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.section import ALONG
from knode_cosserat.rods.system import System
from knode_cosserat.rotation import turned
from knode_cosserat.solvers.history import rest_record

#: fewest positions that define a curve, and number of positions along a curve between held ends
FEWEST, POINTS = 2, 65


def state_from_positions(
    system: System, positions: Float[np.ndarray, "M 3"], control: Any
) -> Float[np.ndarray, "nodes x"]:
    """Return y and z at the nodes of a rod whose centreline goes through these positions.

    The positions are assumed evenly spaced along the rod, from base to tip, and are joined by a spline. The
    base frame is transported along it without twist; the twist of a held tip is spread evenly. Moments
    follow from the material's law; forces are zero. Accepts systems of one rod with positions p,
    orientations h and curvatures u.

    Raises:
        ValueError: the positions are no curve, or the system is not accepted.
    """
    positions = np.asarray(positions, dtype=float)
    y_layout, z_layout = system.y_layout, system.z_layout
    if system.strands > 1 or not {"p", "h"} <= set(y_layout.names) or "u" not in z_layout.names:
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
    p, tangent = _curve(positions, s)
    base, tip = system.end_poses(np.asarray(control))
    h = _carried(record[0, y_layout.slice("h")] if base is None else np.asarray(base.h), tangent)
    if tip is not None:
        h = _twisted(h, np.asarray(tip.h))
    u = _curvatures(h, float(system.length) / (system.nodes - 1))
    ny = y_layout.size
    record[:, y_layout.slice("p")], record[:, y_layout.slice("h")] = p, h
    u_rows = slice(ny + z_layout.slice("u").start, ny + z_layout.slice("u").stop)
    record[:, u_rows] = u
    if "m" in y_layout.names and hasattr(system, "material"):
        record[:, y_layout.slice("m")] = _moments(system, control, h, u)
    return record


def _curve(positions: Any, s: Any) -> tuple[Any, Any]:
    """Return positions and unit tangents of a spline at parts of the length."""
    from scipy.interpolate import make_interp_spline

    spline = make_interp_spline(
        np.linspace(0.0, 1.0, len(positions)), positions, k=min(3, len(positions) - 1)
    )
    tangent = spline.derivative()(s)
    return spline(s), tangent / np.linalg.norm(tangent, axis=1, keepdims=True)


def _carried(base: Any, tangents: Any) -> Any:
    """Return twist-free orientations (quaternions, scalar first) along tangents, starting at the base's."""
    from scipy.spatial.transform import Rotation

    frame = Rotation.from_quat(np.roll(base, -1))
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
    h = np.array(found)
    for k in range(1, len(h)):  # choose the sign nearest to the previous quaternion
        h[k] *= 1.0 if np.dot(h[k], h[k - 1]) >= 0.0 else -1.0
    return h


def _twisted(h: Any, tip: Any) -> Any:
    """Return orientations twisted evenly about their tangents; the last one is nearest to the tip's."""
    from scipy.spatial.transform import Rotation

    frames = Rotation.from_quat(np.roll(h, -1, axis=1))
    over = (frames[-1].inv() * Rotation.from_quat(np.roll(tip, -1))).as_quat()
    angle = 2.0 * np.arctan2(over[2], over[3])
    angle = (angle + np.pi) % (2.0 * np.pi) - np.pi
    turns = np.zeros((len(h), 3))
    turns[:, 2] = np.linspace(0.0, angle, len(h))
    found = np.roll((frames * Rotation.from_rotvec(turns)).as_quat(), 1, axis=1)
    for k in range(1, len(found)):
        found[k] *= 1.0 if np.dot(found[k], found[k - 1]) >= 0.0 else -1.0
    return found


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
    base, tip = system.end_poses(np.asarray(control))
    if base is None or tip is None:
        return None
    length = float(system.length)
    ends = [(np.asarray(each.p), np.asarray(turned(jnp.asarray(each.h), ALONG))) for each in (base, tip)]
    down = _sagging(system, ends[1][0] - ends[0][0], ends[0][1])
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
    return _evenly(found)


def _sagging(system: System, chord: Any, tangent: Any) -> Any:
    """Return a unit vector normal to the chord: along gravity, else along the first tangent, else any."""
    for way in (getattr(system, "gravity", np.zeros(3)), tangent, np.eye(3)[0], np.eye(3)[1]):
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


def _evenly(points: Any) -> Any:
    """Return points at even distances along a polygon."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    at = np.linspace(0.0, along[-1], len(points))
    return np.stack([np.interp(at, along, column) for column in points.T], axis=1)


def _curvatures(h: Any, ds: float) -> Any:
    """Return curvatures (1/m), in the material frame, from orientations at the nodes."""
    from scipy.spatial.transform import Rotation

    frames = Rotation.from_quat(np.roll(h, -1, axis=1))
    between = (frames[:-1].inv() * frames[1:]).as_rotvec() / ds
    return np.concatenate([between[:1], 0.5 * (between[:-1] + between[1:]), between[-1:]])


def _moments(system: Any, control: Any, h: Any, u: Any) -> Any:
    from scipy.spatial.transform import Rotation

    s = np.linspace(0.0, 1.0, system.nodes) * float(system.length)
    control = jnp.asarray(control)
    found = []
    for place, frame, own in zip(s, Rotation.from_quat(np.roll(h, -1, axis=1)), u, strict=True):
        material = system.material(place, control)
        found.append(frame.apply(np.asarray(material.Kbt) @ (own - np.asarray(material.u_star))))
    return np.array(found)
