"""Drawing data of a system beside its states: radii, tendons, ribs, obstacles, and its fields."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from knode_cosserat.rods.aspects import Drawing
from knode_cosserat.rods.layout import Field, Layout
from knode_cosserat.rods.loads import AttachedMass
from knode_cosserat.rods.surroundings import Cylinder, Obstacle, Plane, Sphere
from knode_cosserat.rods.system import System

#: default radius, as a fraction of the length
SLIM = 0.006
#: distance from the axis at which tendons without a route are drawn, in radii of the rod
BESIDE = 2.5
#: ratio of the ribs' radius to that of the tendons' circle
RIM = 1.3
#: mean tension in the paper (N)
MEAN_TENSION = 6.0
#: where sliders may end, between powers of ten
NICE = (1.0, 1.2, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)


def physics_of(system: System) -> Any:
    """Return the robot itself; for a model, its nominal robot with the model's length."""
    robot = system.nominal
    same = robot is system or float(robot.length) == float(system.length)
    return robot if same else robot.replace(length=system.length)


def drawing(system: System, nodes: np.ndarray) -> dict[str, Any]:
    """Return the page's data for drawing a system's states at the given nodes."""
    robot = physics_of(system)
    s = nodes / max(1, system.nodes - 1) * float(system.length)
    radii = _radii(robot, s)
    tendons = _tendons(robot, s, radii)
    return {
        "kind": type(robot).__name__,
        "model": robot is not system,
        "length": float(system.length),
        "up": _up(robot),
        "radii": _short(radii),
        "tendons": tendons,
        "ribs": _ribs(robot, system.nodes, tendons, float(np.mean(radii))),
        "obstacles": [_obstacle(each) for each in getattr(robot, "surroundings", ())],
    }


def _short(values: Any) -> Any:
    """Return numbers rounded to the precision of a drawing."""
    return np.round(np.asarray(values, dtype=float), 7).tolist()


def _radii(robot: Any, s: np.ndarray) -> np.ndarray:
    radius = getattr(robot, "radius", None)
    if radius is None or np.ndim(radius):
        return np.full(len(s), SLIM * float(robot.length))
    if getattr(robot, "sections", ()):
        none = np.zeros(robot.control_size)
        return np.asarray(jax.vmap(lambda at: robot.material(at, none).radius + 0.0 * at)(s))
    return np.full(len(s), float(radius))


def _up(robot: Any) -> list[float]:
    """Return the direction against gravity; z without gravity. Planar positions are drawn in x and z."""
    gravity = np.asarray(getattr(robot, "gravity", np.zeros(3)), dtype=float)
    size = np.linalg.norm(gravity) if gravity.shape == (3,) else 0.0
    return _short(-gravity / size) if size > 0.0 else [0.0, 0.0, 1.0]


def _tendons(robot: Any, s: np.ndarray, radii: np.ndarray) -> dict[str, Any] | None:
    """Return the tendons' routes (c, nodes, 3) in the material frame, their ends, and their tension."""
    if not hasattr(robot, "routes_at"):
        return None
    if robot.moment_arm is None and not float(robot.tendon_offset):
        robot = robot.replace(tendon_offset=BESIDE * float(np.max(radii)))
    where = np.stack(
        [np.broadcast_to(np.asarray(robot.routes_at(at)[0]), (robot.tendon_count, 3)) for at in s]
    )
    y, control = robot.y_layout, robot.control_layout
    array, layout = ("control", control) if "tension" in control.names else ("y", y)
    return {
        "routes": _short(np.moveaxis(where, 0, 1)),
        "ends": list(robot.tendon_ends),
        "tension": {"array": array, "offset": layout.slice("tension").start},
        "loss": {"array": "y", "offset": y.slice("loss").start} if "loss" in y.names else None,
    }


def _ribs(robot: Any, nodes: int, tendons: dict[str, Any] | None, radius: float) -> list[dict[str, Any]]:
    """Return discs that guide tendons, and masses: at the robot's masses, or else at its nodes."""
    masses = [load for load in getattr(robot, "loads", ()) if isinstance(load, AttachedMass)]
    if tendons is None:
        return [_body(load, "ball", 2.5 * radius) for load in masses]
    width = RIM * max(float(np.linalg.norm(tendons["routes"], axis=-1).max()), 2.0 * radius)
    if masses:
        return [_body(load, "rib", width) for load in masses]
    count = min(nodes, 21)
    return [{"at": k / (count - 1), "shape": "guide", "radius": width} for k in range(1, count)]


def _body(load: AttachedMass, shape: str, radius: float) -> dict[str, Any]:
    """Return an attached body: its place (part of the length), its shape, and its mass (kg)."""
    return {"at": float(load.at), "shape": shape, "radius": radius, "mass": float(load.mass)}


def _obstacle(obstacle: Obstacle) -> dict[str, Any]:
    if isinstance(obstacle, Plane):
        return {"shape": "plane", "point": _short(obstacle.point), "normal": _short(obstacle.normal)}
    if isinstance(obstacle, Sphere):
        more = {"shape": "sphere", "point": _short(obstacle.center)}
    elif isinstance(obstacle, Cylinder):
        more = {"shape": "cylinder", "point": _short(obstacle.point), "axis": _short(obstacle.axis)}
    else:  # a user-defined obstacle: only its distance is known
        return {"shape": "unknown", "name": type(obstacle).__name__}
    return {**more, "radius": float(obstacle.radius), "inside": bool(obstacle.inside)}


def fields(system: System) -> list[dict[str, Any]]:
    """Return the fields that can be plotted: every field of y, z and the control, with component names."""
    layouts = (("y", system.y_layout), ("z", system.z_layout), ("control", system.control_layout))
    return [
        {
            "array": array, "name": field.name, "unit": field.unit, "meaning": field.meaning,
            "offset": layout.slice(field.name).start, "components": _components(field, array == "control"),
        }
        for array, layout in layouts
        for field in layout.fields
    ]  # fmt: skip


def _components(field: Field, control: bool) -> list[str]:
    """Return the names of a field's components, as in a trajectory's file."""
    if field.size == 1:
        return [""]
    if field.size == 4 and field.name.rstrip("0123456789") == "h":
        return ["w", "x", "y", "z"]
    if field.size == 3 and not control:
        return ["x", "y", "z"]
    return [str(k + 1) for k in range(field.size)]


def sliders(system: System) -> list[dict[str, Any]]:
    """Return a slider for each component of the control: names, unit, range and initial value."""
    found = []
    for field in system.control_layout.fields:
        low, high, start = _range(system, field)
        for component in _components(field, control=True):
            name = f"{field.name} {component}".strip()
            found.append(
                {"name": name, "group": field.name, "label": component, "unit": field.unit,
                 "meaning": field.meaning, "low": low, "high": high, "start": start,
                 "step": (high - low) / 500.0}
            )  # fmt: skip
    return found


def _range(system: System, field: Field) -> tuple[float, float, float]:
    robot = physics_of(system)
    length = float(robot.length)
    if field.name == "tension" and hasattr(robot, "routes_at"):
        bending = float(np.asarray(robot.Kbt)[0, 0])
        if robot.moment_arm is not None:  # one radian by a single tendon
            return 0.0, _nice(bending / (length * max(robot.moment_arm, 1e-6))), 0.0
        # about two radians by a load of so many N/m: twice the paper's mean tension for its robot. The
        # stiffness that a model begins with may be far from the robot's.
        high = 2.0 * MEAN_TENSION if robot is not system else _nice(12.0 * bending / length**3)
        return 0.0, high, high / 2.0
    if field.unit == "N":
        high = _nice(2.0 * float(np.max(np.abs(np.asarray(robot.scales().y)))))
        return -high, high, 0.0
    if field.name == "reel":
        return 0.0, _nice(1.2 * robot.moment_arm), 0.0
    if field.unit == "m":
        reach = _nice(0.2 * length)
        return -reach, reach, 0.0
    return (-0.8, 0.8, 0.0) if field.unit == "rad" else (-1.0, 1.0, 0.0)


def _nice(value: float) -> float:
    """Return a round number, not below the given one."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(next(step * power for step in NICE if step * power >= value * (1.0 - 1e-9)))


def positions_of(system: System, y: np.ndarray) -> np.ndarray:
    """Return the positions (T, N, 3) of states; planar positions are put into x and z.

    Raises:
        ValueError: the system does not define positions.
    """
    try:
        found = np.asarray(system.drawing.positions(y), dtype=float)
    except AttributeError as error:
        raise ValueError(f"{error}; without positions there is nothing to draw") from None
    if found.ndim == 3 and found.shape[-1] == 2:
        found = np.stack([found[..., 0], np.zeros(found.shape[:-1]), found[..., 1]], axis=-1)
    if found.ndim != 3 or found.shape[-1] != 3:
        raise ValueError(
            f"a {type(system).__name__} gives positions of shape {found.shape}; "
            "allowed is (T, N, 3) or (T, N, 2)"
        )
    return found


def quaternions_of(system: System, y: np.ndarray) -> np.ndarray | None:
    """Return the orientations (T, N, 4), scalar first, or None if the system has none."""
    try:
        return np.asarray(system.drawing.quaternions(y), dtype=float)
    except AttributeError:
        return None


def drawn_lines(system: System, y: np.ndarray, positions: np.ndarray) -> list[dict[str, Any]]:
    """Lines to be drawn beside that of the positions, if there are others: rods, and outlines that close."""
    flat = type(system.drawing).curves is Drawing.curves
    found = [] if flat else [np.asarray(curve, dtype=float) for curve in system.drawing.curves(y)]
    if not found or (len(found) == 1 and np.array_equal(found[0], positions, equal_nan=True)):
        return []
    rods = system.strands if system.strands > 1 else len(found)
    return [{"shape": "rod" if k < rods else "outline", "points": curve} for k, curve in enumerate(found)]


def offset_of(layout: Layout, packed: np.ndarray, values: np.ndarray) -> int | None:
    """Return the offset of equal values in packed numbers, to avoid sending them twice; None if absent."""
    start = 0
    for field in layout.fields:
        stop = start + field.size
        if field.size == values.shape[-1] and np.array_equal(packed[..., start:stop], values, equal_nan=True):
            return start
        start = stop
    return None
