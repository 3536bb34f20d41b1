"""Scene of the page: trajectories as compact arrays, with the data to draw and to plot them.

Arrays are float32, their bytes sorted by significance and compressed, in base64: 500 steps of the paper's
robot take 0.5 MB at most. Longer trajectories are thinned: at most 41 nodes of a rod are kept, and rows are
evenly selected (with the last one) so that a trajectory takes 2 MB before compression, but at least 200. The
page reports it. A scene contains only numbers and texts, and texts are never interpreted as markup.
"""

from __future__ import annotations

import base64
import gzip
import reprlib
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, runtime_checkable

import jax
import numpy as np

from knode_cosserat.rods.aspects import Drawing
from knode_cosserat.rods.layout import Field, Layout
from knode_cosserat.rods.shapes import LOOKS, Shape
from knode_cosserat.rods.strands import strand_of
from knode_cosserat.rods.surroundings import Cylinder, Obstacle, Plane, Sphere
from knode_cosserat.rods.system import System
from knode_cosserat.rods.wrapped import nominal_model
from knode_cosserat.schemes.result import Result
from knode_cosserat.trajectory import Trajectory

if TYPE_CHECKING:
    from knode_cosserat.identification import Comparison
    from knode_cosserat.recordings.measurements import Measurements
    from knode_cosserat.recordings.recording import Recording

#: largest number of trajectories in a view
MOST = 12
#: limits for long trajectories: most nodes, most numbers in all rows, and least rows
MOST_NODES, MOST_NUMBERS, LEAST_ROWS = 41, 500_000, 200

#: largest distance of a target from the origin, in lengths of the longest robot
FARTHEST_TARGET = 20.0


@runtime_checkable
class EvaluationLike(Protocol):
    """Protocol of an `Evaluation`: its prediction is drawn with the measured bodies."""

    @property
    def comparison(self) -> Comparison | None:
        """The recording beside its prediction."""

    @property
    def failed(self) -> str | None:
        """Why there is no prediction, or None."""


One = Trajectory | EvaluationLike
Given = One | Sequence[One] | Mapping[str, One]
Point = Sequence[float] | np.ndarray


class Shown(NamedTuple):
    """A trajectory, and the comparison with the recording that it predicts, or None."""

    trajectory: Trajectory
    comparison: Comparison | None = None


def named(
    given: Given, measured: Recording | Measurements | None = None
) -> tuple[dict[str, Shown], list[str]]:
    """Return what is drawn, by name, and the names and reasons of predictions that failed; a batch is split.

    Raises:
        ValueError: a value is neither trajectory nor evaluation, there are none or too many, all predictions
            failed, or a trajectory has other rows than the recording.
    """
    if isinstance(given, Trajectory):
        given = {"trajectory": given}
    elif isinstance(given, EvaluationLike):
        given = {"prediction": given}
    if not isinstance(given, Mapping):
        values: Any = given
        values = list(values) if isinstance(values, Sequence) else [values]
        given = {f"trajectory {k + 1}": value for k, value in enumerate(values)}
    by_name: dict[str, Shown] = {}
    failed: list[str] = []
    for name, value in given.items():
        if isinstance(value, EvaluationLike):
            found = value.comparison
            if found is None or found.trajectory is None:
                failed.append(f"{name}: no prediction: {value.failed}")
            else:
                by_name[str(name)] = Shown(found.trajectory, found)
            continue
        if not isinstance(value, Trajectory):
            raise ValueError(f"{name} is a {type(value).__name__}; allowed is a Trajectory or an Evaluation")
        single = np.ndim(value.y) == 3
        names = {str(name): value} if single else {f"{name} [{k}]": value[k] for k in range(len(value.y))}
        by_name |= {each: _beside(it, measured, each) for each, it in names.items()}
    if failed and not by_name:
        raise ValueError(failed[0])
    if not 1 <= len(by_name) <= MOST:
        raise ValueError(
            f"there are {len(by_name)} trajectories, those of batches counted singly; allowed is 1 to {MOST}"
        )
    return by_name, failed


def _beside(trajectory: Trajectory, measured: Recording | Measurements | None, name: str) -> Shown:
    """Return a trajectory, row by row beside a recording, if there is one."""
    if measured is None:
        return Shown(trajectory)
    from knode_cosserat.identification.evaluate import compared
    from knode_cosserat.recordings.measurements import Measurements

    rows = Measurements.of(measured)
    if len(rows.time) != len(trajectory.time):
        raise ValueError(
            f"{name} has {len(trajectory.time)} rows and the recording {len(rows.time)}; both must have the "
            "same number, as identification.predict(robot, measured) has"
        )
    found = compared(trajectory.system, trajectory, rows).comparison
    return (
        Shown(trajectory, found)
        if found is None or found.trajectory is None
        else Shown(found.trajectory, found)
    )


def scene(
    given: Given,
    title: str | None = None,
    target: Point | None = None,
    measured: Recording | Measurements | None = None,
) -> dict[str, Any]:
    """Return the page's scene as plain values for JSON.

    Args:
        given: trajectories or evaluations, also by name.
        title: heading of the page; by default the names.
        target: position (x, y, z) in m to be marked.
        measured: recording that the trajectories predict, row by row.

    Raises:
        ValueError: nothing to show, too much, a trajectory that has nothing to be drawn, or an impossible
            target.
    """
    by_name, failed = named(given, measured)
    tracks = []
    for name, (trajectory, comparison) in by_name.items():
        try:
            tracks.append(track(trajectory, name))
            if comparison is not None:
                tracks[-1]["measured"] = bodies(comparison, trajectory)
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from None
    marked = checked_target(target, [it.trajectory.system for it in by_name.values()])
    return {"title": title or ", ".join(by_name), "tracks": tracks, "target": marked, "notes": failed}


def bodies(comparison: Comparison, trajectory: Trajectory) -> dict[str, Any]:
    """Return the page's data of measured bodies and of the band of their predictions."""
    _, rows = kept(np.shape(trajectory.y), trajectory.system.z_layout.size)
    arrays = {"seen": comparison.seen, "predicted": np.asarray(comparison.position)}
    if comparison.band is not None:
        arrays |= {"low": comparison.band.low, "high": comparison.band.high}
    return {
        "source": comparison.measured.source,
        "arrays": {name: encoded_array(in_space(points[rows]), "f4") for name, points in arrays.items()},
        "level": comparison.band and comparison.band.level,
    }


def checked_target(target: Point | None, systems: Sequence[System]) -> list[float] | None:
    """Return a target (x, y, z) in m as a list; None without a target.

    Raises:
        ValueError: not three finite numbers, or a position far out of every robot's reach.
    """
    if target is None:
        return None
    try:
        point = np.array(target, dtype=float)
    except (TypeError, ValueError, OverflowError):
        point = np.empty(0)
    if point.shape != (3,) or not np.all(np.isfinite(point)):
        raise ValueError(
            f"target must be a position (x, y, z) of three finite numbers in m (got {reprlib.repr(target)})"
        )
    length = max(float(np.max(system.length)) for system in systems)
    distance = float(np.linalg.norm(point))
    if distance > FARTHEST_TARGET * length:
        guess = ", ".join(f"{x:g}" for x in point / 1000.0)
        farthest = FARTHEST_TARGET * length
        raise ValueError(
            f"target must be within {farthest:.3g} m of the origin, {FARTHEST_TARGET:g} times the robot's "
            f"length (got {distance:.3g} m). Positions are in m: did you mean ({guess})?"
        )
    return [float(x) for x in point]


def track(trajectory: Trajectory, name: str) -> dict[str, Any]:
    """Return the page's data of one trajectory."""
    if not np.any(trajectory.valid):
        raise ValueError("no row is solved; there is nothing to draw")
    system = trajectory.system
    nodes, rows = kept(np.shape(trajectory.y), system.z_layout.size)
    arrays, drawn = arrays_of(trajectory, nodes, rows)
    result = np.asarray(trajectory.result)
    time, error, failure = np.asarray(trajectory.time), trajectory.position_error, None
    if np.any(result < 0):
        first = int(np.argmax(result < 0))
        failure = {"time": float(time[first]), "message": Result(int(result[first])).message}
    # NaN: the discretisation error is unknown
    error = np.full(len(result), np.nan) if error is None else np.asarray(error, dtype=float)
    return {
        "name": name, "time": encoded_array(time[rows], "f8"), "result": encoded_array(result[rows], "f4"),
        "position_error": encoded_array(error[rows], "f4"),
        "arrays": {key: encoded_array(value, "f4") for key, value in arrays.items()},
        "all_rows": len(result), "all_nodes": int(system.nodes), "failure": failure, **drawn,
    }  # fmt: skip


def kept(shape: Sequence[int], strains: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the kept nodes and rows of a trajectory with y of this shape (T, N, y); see the module."""
    rows, nodes, size = shape
    few = np.unique(np.linspace(0, nodes - 1, min(nodes, MOST_NODES)).round().astype(int))
    most = max(LEAST_ROWS, MOST_NUMBERS // (len(few) * (size + strains)))
    return few, np.unique(np.linspace(0, rows - 1, min(rows, most)).round().astype(int))


def arrays_of(
    trajectory: Trajectory, nodes: np.ndarray, rows: np.ndarray
) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Arrays (rows, …) of a trajectory's states, and how they are to be read and drawn.

    Positions and orientations that stand in y as they are, are not sent twice.
    """
    system = trajectory.system
    y = np.asarray(trajectory.y, dtype=float)[rows]
    position = positions_of(system, y)
    orientation = quaternions_of(system, y)
    curves = drawn_lines(system, y, position)
    control = np.asarray(trajectory.control, dtype=float)[rows]
    shapes = separate_shapes(system, y, control)
    arrays = {
        "y": y[:, nodes],
        "z": np.asarray(trajectory.z, dtype=float)[rows][:, nodes],
        "control": control,
        **shape_arrays(shapes),
    }
    where: dict[str, Any] = {}
    for name, values in (("position", position), ("orientation", orientation)):
        if values is None:
            continue
        offset = offset_of(system.y_layout, y, values)
        if offset is None:
            arrays[name] = values[:, nodes]
        where[name] = {"array": name, "offset": 0} if offset is None else {"array": "y", "offset": offset}
    for k, curve in enumerate(curves):
        points = curve["points"]
        few = nodes if points.shape[1] == system.nodes else np.arange(points.shape[1])
        arrays[f"curve{k}"] = points[:, few]
    return arrays, {
        **where,
        "curves": [{"shape": curve["shape"], "array": f"curve{k}"} for k, curve in enumerate(curves)],
        "drawing": drawing(system, nodes)
        | {"shapes": [described(k, shape) for k, shape in enumerate(shapes)]},
        "fields": fields(system),
        "arclength": np.round(np.asarray(trajectory.arclength, dtype=float)[nodes], 7).tolist(),
    }


def last_row(system: System, trajectory: Trajectory, names: Sequence[str]) -> np.ndarray:
    """Return the values of a trajectory's last row, array after array, for the live page."""
    nodes, _ = kept(np.shape(trajectory.y), system.z_layout.size)
    y = np.asarray(trajectory.y)[-1:]
    curves = list(Drawing.of(system).curves(y)) if any(name.startswith("curve") for name in names) else []
    control = np.asarray(trajectory.control)[-1:]
    shapes = separate_shapes(system, y, control) if "values" in names else []
    shown = shape_arrays(shapes)
    functions = {
        "y": lambda: y[:, nodes],
        "z": lambda: np.asarray(trajectory.z)[-1:, nodes],
        "control": lambda: np.asarray(trajectory.control)[-1:],
        "position": lambda: positions_of(system, y)[:, nodes],
        "orientation": lambda: np.asarray(Drawing.of(system).quaternions(y))[:, nodes],
    }
    parts = []
    for name in names:
        if name in functions:
            values = functions[name]()
        elif name in shown:
            values = shown[name]
        else:
            values = np.asarray(curves[int(name.removeprefix("curve"))])
            values = values[:, nodes] if values.shape[1] == system.nodes else values
        parts.append(np.asarray(values, dtype=np.float32).reshape(-1))
    return np.concatenate(parts)


def encoded_array(values: Any, kind: str) -> dict[str, Any]:
    """An array as the page reads it: its shape, its type, and its bytes."""
    values = np.ascontiguousarray(jax.device_get(values), dtype=f"<{kind}")
    # bytes of one significance side by side: neighbours in time are alike in the high ones
    flat = values.reshape(len(values), int(np.prod(values.shape[1:]))).T
    shuffled = np.ascontiguousarray(flat).view(np.uint8).reshape(-1, values.itemsize).T.tobytes()
    text = base64.b64encode(gzip.compress(shuffled, 6, mtime=0)).decode("ascii")
    return {"shape": list(values.shape), "type": kind, "bytes": text}


# drawing of a system beside its states

#: default radius, as a fraction of the length
SLIM = 0.006
#: mean tension in the paper (N)
MEAN_TENSION = 6.0
#: where sliders may end, between powers of ten
NICE = (1.0, 1.2, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)


def physics_of(system: System) -> Any:
    """Return the robot itself; for a model, its nominal robot with the model's length."""
    robot = nominal_model(system)
    same = robot is system or float(robot.length) == float(system.length)
    return robot if same else robot.replace(length=system.length)


def drawing(system: System, nodes: np.ndarray) -> dict[str, Any]:
    """Return the page's data for drawing a system's states at the given nodes."""
    robot = physics_of(system)
    at = nodes / max(1, system.nodes - 1)
    # up is against gravity; planar positions are drawn in x and z
    gravity = np.asarray(getattr(robot, "gravity", np.zeros(3)), dtype=float)
    size = np.linalg.norm(gravity) if gravity.shape == (3,) else 0.0
    return {
        "kind": type(robot).__name__, "model": robot is not system, "length": float(system.length),
        "up": _short(-gravity / size) if size > 0.0 else [0.0, 0.0, 1.0],
        "radii": _short(_radii(robot, at)), "tendons": _tendons(robot, at), "ribs": _ribs(robot, at),
        "obstacles": [_obstacle(obstacle) for obstacle in getattr(robot, "surroundings", ())],
    }  # fmt: skip


def _short(values: Any) -> Any:
    """Return numbers rounded to the precision of a drawing."""
    return np.round(np.asarray(values, dtype=float), 7).tolist()


def _parts(robot: Any, at: np.ndarray) -> list[Shape]:
    """Return the shapes beside a rod with nodes at these fractions, without control."""
    return Drawing.of(robot).parts(at, np.zeros((1, robot.control_layout.size)))


def _radii(robot: Any, at: np.ndarray) -> np.ndarray:
    """Return the radius of the rod at each node; of the thinnest tube, in robots of tubes."""
    found = [shape.radius for shape in _parts(strand_of(robot), at) if shape.kind in ("rod", "tube")]
    if not found:
        found = [float(getattr(robot, "radius", SLIM * float(robot.length)))]
    return np.broadcast_to(min(found, key=np.max), len(at))


def _tendons(robot: Any, at: np.ndarray) -> dict[str, Any] | None:
    """Return the tendons' routes (c, nodes, 3) in the material frame, their ends, and their tension."""
    routes = [shape.offset for shape in _parts(robot, at) if shape.kind == "tendon"]
    if not routes:
        return None
    y, control = robot.y_layout, robot.control_layout
    array, layout = ("control", control) if "tension" in control.names else ("y", y)
    return {
        "routes": [_short(route) for route in routes],
        "ends": list(robot.tendon_ends),
        "tension": {"array": array, "offset": layout.slice("tension").start},
        "loss": {"array": "y", "offset": y.slice("loss").start} if "loss" in y.names else None,
    }


def _ribs(robot: Any, at: np.ndarray) -> list[dict[str, Any]]:
    """Return discs that guide tendons, and masses."""
    names = {"disk": "rib", "mass": "ball", "guide": "guide"}
    found = []
    for shape in _parts(robot, at):
        if shape.kind in names:
            about = {
                "at": float(shape.at[0]),
                "shape": names[shape.kind],
                "radius": float(np.max(shape.radius)),
            }
            found.append(about if shape.value is None else about | {"mass": float(shape.value)})
    return found


def separate_shapes(system: System, y: np.ndarray, control: np.ndarray) -> list[Shape]:
    """Return the shapes for states (T, N, y) that the page does not draw from the states of one rod."""
    shapes = Drawing.of(system).shapes(y, control)
    single = bool(Drawing.of(system).parts(np.linspace(0.0, 1.0, 2), control[:1])) if shapes else False
    drawn = {"rod", "tendon", "guide", "disk", "mass"} if single else {"rod", "guide"}
    return [shape for shape in shapes if shape.kind not in drawn]


def _few(count: int) -> np.ndarray:
    return np.unique(np.linspace(0, count - 1, min(count, MOST_NODES)).round().astype(int))


def shape_arrays(shapes: Sequence[Shape]) -> dict[str, np.ndarray]:
    """Return the positions of the points of each shape, and the values that colour them."""
    if not shapes:
        return {}
    rows = len(shapes[0].offset)
    values = [np.broadcast_to(0.0 if shape.value is None else shape.value, rows) for shape in shapes]
    points = {f"shape{k}": shape.offset[:, _few(shape.offset.shape[1])] for k, shape in enumerate(shapes)}
    return {"values": np.stack(values, axis=1), **points}


def described(k: int, shape: Shape) -> dict[str, Any]:
    """Return the page's data of the k-th shape."""
    look, count = LOOKS[shape.kind], shape.offset.shape[1]
    radii = np.broadcast_to(shape.radius, count)[_few(count)]
    return {
        "kind": shape.kind, "name": shape.name, "array": f"shape{k}", "radii": _short(radii),
        "colour": look.colour, "opacity": look.opacity, "group": look.group, "shade": shape.shade,
        "unit": shape.unit, "ramp": look.is_ramp and shape.value is not None,
    }  # fmt: skip


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
            "array": array,
            "name": field.name,
            "unit": field.unit,
            "meaning": field.meaning,
            "offset": layout.slice(field.name).start,
            "components": _components(field, array == "control"),
        }
        for array, layout in layouts
        for field in layout.fields
    ]


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
    return [
        {
            "name": f"{field.name} {component}".strip(),
            "group": field.name,
            "label": component,
            "unit": field.unit,
            "meaning": field.meaning,
            "low": low,
            "high": high,
            "start": start,
            "step": (high - low) / 500.0,
        }
        for field in system.control_layout.fields
        for low, high, start in [_range(system, field)]
        for component in _components(field, control=True)
    ]


def _range(system: System, field: Field) -> tuple[float, float, float]:
    robot = physics_of(system)
    length = float(robot.length)
    for part in getattr(robot, "parts", {}).values():
        usual = [
            part.usual_control(robot, one) for one in part.control_fields if field.name.endswith(one.name)
        ]
        if usual and usual[0] is not None:
            return 0.0, min(_nice(usual[0]), field.high), 0.0
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
        points = np.asarray(Drawing.of(system).positions(y), dtype=float)
    except AttributeError as error:
        raise ValueError(f"{error}; without positions there is nothing to draw") from None
    points = in_space(points)
    if points.ndim != 3 or points.shape[-1] != 3:
        raise ValueError(
            f"a {type(system).__name__} gives positions of shape {points.shape}; "
            "allowed is (T, N, 3) or (T, N, 2)"
        )
    return points


def in_space(points: np.ndarray) -> np.ndarray:
    """Return points (T, N, 3); those in a plane are put into x and z."""
    if points.ndim == 3 and points.shape[-1] == 2:
        return np.stack([points[..., 0], np.zeros(points.shape[:-1]), points[..., 1]], axis=-1)
    return points


def quaternions_of(system: System, y: np.ndarray) -> np.ndarray | None:
    """Return the orientations (T, N, 4), scalar first, or None if the system has none."""
    try:
        return np.asarray(Drawing.of(system).quaternions(y), dtype=float)
    except AttributeError:
        return None


def drawn_lines(system: System, y: np.ndarray, positions: np.ndarray) -> list[dict[str, Any]]:
    """Lines to be drawn beside that of the positions, if there are others: rods, and outlines that close."""
    flat = type(Drawing.of(system)).curves is Drawing.curves
    curves = [] if flat else [np.asarray(curve, dtype=float) for curve in Drawing.of(system).curves(y)]
    if not curves or (len(curves) == 1 and np.array_equal(curves[0], positions, equal_nan=True)):
        return []
    rods = len(curves) - Drawing.of(system).outlines
    return [{"shape": "rod" if k < rods else "outline", "points": curve} for k, curve in enumerate(curves)]


def offset_of(layout: Layout, packed: np.ndarray, values: np.ndarray) -> int | None:
    """Return the offset of equal values in packed numbers, to avoid sending them twice; None if absent."""
    start = 0
    for field in layout.fields:
        stop = start + field.size
        if field.size == values.shape[-1] and np.array_equal(packed[..., start:stop], values, equal_nan=True):
            return start
        start = stop
    return None
