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
from typing import Any

import jax
import numpy as np

from knode_cosserat.rods.system import System
from knode_cosserat.solvers.result import Result
from knode_cosserat.trajectory import Trajectory
from knode_cosserat.viewer.drawing import (
    drawing,
    drawn_lines,
    fields,
    offset_of,
    positions_of,
    quaternions_of,
)

#: largest number of trajectories in a view
MOST = 12
#: limits for long trajectories: most nodes, most numbers in all rows, and least rows
MOST_NODES, MOST_NUMBERS, LEAST_ROWS = 41, 500_000, 200

#: largest distance of a target from the origin, in lengths of the longest robot
FARTHEST_TARGET = 20.0

Given = Trajectory | Sequence[Trajectory] | Mapping[str, Trajectory]
Point = Sequence[float] | np.ndarray


def named(trajectories: Given) -> dict[str, Trajectory]:
    """Return trajectories of one robot each, by name; a batch is split.

    Raises:
        ValueError: a value is not a trajectory, or there are none or too many.
    """
    if isinstance(trajectories, Trajectory):
        trajectories = {"trajectory": trajectories}
    if not isinstance(trajectories, Mapping):
        given: Any = trajectories
        given = list(given) if isinstance(given, Sequence) else [given]
        trajectories = {f"trajectory {k + 1}": each for k, each in enumerate(given)}
    found: dict[str, Trajectory] = {}
    for name, each in trajectories.items():
        if not isinstance(each, Trajectory):
            raise ValueError(f"{name} is a {type(each).__name__}; allowed is a Trajectory")
        if np.ndim(each.y) == 3:
            found[str(name)] = each
        else:
            found |= {f"{name} [{k}]": _one(each, k) for k in range(len(each.y))}
    if not 1 <= len(found) <= MOST:
        raise ValueError(
            f"there are {len(found)} trajectories, those of batches counted singly; allowed is 1 to {MOST}"
        )
    return found


def _one(batch: Trajectory, k: int) -> Trajectory:
    one: Trajectory = batch[k]
    return one


def scene(trajectories: Given, title: str | None = None, target: Point | None = None) -> dict[str, Any]:
    """Return the page's scene as plain values for JSON. `target` is a position (x, y, z) in m to be marked.

    Raises:
        ValueError: no trajectory, too many, one that has nothing to be drawn, or an impossible target.
    """
    by_name = named(trajectories)
    tracks = []
    for name, each in by_name.items():
        try:
            tracks.append(track(each, name))
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from None
    marked = checked_target(target, [each.system for each in by_name.values()])
    return {"title": title or ", ".join(by_name), "tracks": tracks, "target": marked}


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
    unsolved = np.flatnonzero(result < 0)
    return {
        "name": name,
        "time": encoded_array(np.asarray(trajectory.time)[rows], "f8"),
        "result": encoded_array(result[rows], "f4"),
        "position_error": encoded_array(_position_error(trajectory)[rows], "f4"),
        "arrays": {key: encoded_array(value, "f4") for key, value in arrays.items()},
        "all_rows": len(result),
        "all_nodes": int(system.nodes),
        "failure": _failure(trajectory, unsolved),
        **drawn,
    }


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
    arrays = {
        "y": y[:, nodes],
        "z": np.asarray(trajectory.z, dtype=float)[rows][:, nodes],
        "control": np.asarray(trajectory.control, dtype=float)[rows],
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
        "drawing": drawing(system, nodes),
        "fields": fields(system),
        "arclength": np.round(np.asarray(trajectory.arclength, dtype=float)[nodes], 7).tolist(),
    }


def last_row(system: System, trajectory: Trajectory, names: Sequence[str]) -> np.ndarray:
    """Return the values of a trajectory's last row, array after array, for the live page."""
    nodes, _ = kept(np.shape(trajectory.y), system.z_layout.size)
    y = np.asarray(trajectory.y)[-1:]
    curves = list(system.drawing.curves(y)) if any(name.startswith("curve") for name in names) else []
    own = {"y": lambda: y[:, nodes], "z": lambda: np.asarray(trajectory.z)[-1:, nodes],
           "control": lambda: np.asarray(trajectory.control)[-1:],
           "position": lambda: positions_of(system, y)[:, nodes],
           "orientation": lambda: np.asarray(system.drawing.quaternions(y))[:, nodes]}  # fmt: skip
    parts = []
    for name in names:
        if name in own:
            values = own[name]()
        else:
            values = np.asarray(curves[int(name.removeprefix("curve"))])
            values = values[:, nodes] if values.shape[1] == system.nodes else values
        parts.append(np.asarray(values, dtype=np.float32).reshape(-1))
    return np.concatenate(parts)


def _position_error(trajectory: Trajectory) -> np.ndarray:
    """Return the estimated discretisation error (m) of each row; NaN where unknown."""
    rows = np.shape(trajectory.result)
    error = trajectory.position_error
    return np.full(rows, np.nan) if error is None else np.asarray(error, dtype=float)


def _failure(trajectory: Trajectory, unsolved: np.ndarray) -> dict[str, Any] | None:
    """Return the time and the reason of the first unsolved row, or None."""
    if len(unsolved) == 0:
        return None
    first = int(unsolved[0])
    result = Result(int(np.asarray(trajectory.result)[first]))
    return {"time": float(np.asarray(trajectory.time)[first]), "message": result.message}


def encoded_array(values: Any, kind: str) -> dict[str, Any]:
    """An array as the page reads it: its shape, its type, and its bytes."""
    values = np.ascontiguousarray(jax.device_get(values), dtype=f"<{kind}")
    # bytes of one significance side by side: neighbours in time are alike in the high ones
    flat = values.reshape(len(values), int(np.prod(values.shape[1:]))).T
    shuffled = np.ascontiguousarray(flat).view(np.uint8).reshape(-1, values.itemsize).T.tobytes()
    text = base64.b64encode(gzip.compress(shuffled, 6, mtime=0)).decode("ascii")
    return {"shape": list(values.shape), "type": kind, "bytes": text}
