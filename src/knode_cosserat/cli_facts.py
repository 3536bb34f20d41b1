"""What the commands tell: facts of trajectories and robots, as JSON or in words."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import typer

from knode_cosserat.solvers.result import Result

if TYPE_CHECKING:
    from knode_cosserat.rods.system import System
    from knode_cosserat.trajectory import Trajectory


# finding out


def outcome(trajectory: Trajectory) -> dict[str, Any]:
    """What came of the steps, and where the tip was after the last that was solved."""
    codes = np.asarray(trajectory.result)
    valid = codes >= 0
    failure = None
    if not valid.all():
        row = int(np.argmin(valid))
        message = Result(int(codes[row])).message
        failure = {"step": row, "time": float(trajectory.time[row]), "message": message}
    found, counts = np.unique(codes[1:], return_counts=True)
    return {
        "results": {Result(int(code)).name.lower(): int(n) for code, n in zip(found, counts, strict=True)},
        "all_solved": bool(valid.all()),
        "first_failure": failure,
        "largest_residual": float(np.asarray(trajectory.residual)[valid].max()),
        "tip_position": np.asarray(trajectory.tip_position)[valid][-1].tolist(),
    }


def at_rest(rest: Trajectory) -> dict[str, Any]:
    """The shape of an equilibrium, and what holds it (m, rad, N, N·m)."""
    position, (w, x, y, z) = np.asarray(rest.position)[0], np.asarray(rest.quaternion)[0, -1]
    return {
        "tension": np.asarray(rest.tension)[0].tolist(),
        "position": position.tolist(),
        "tip_position": position[-1].tolist(),
        "tip_inclination": float(2 * np.arctan2(np.hypot(x, y), np.hypot(w, z))),
        "base_force": np.asarray(rest.force)[0, 0].tolist(),
        "base_moment": np.asarray(rest.moment)[0, 0].tolist(),
        "residual": float(rest.residual[0]),
    }


def parameters(system: System) -> dict[str, dict[str, Any]]:
    """Every parameter by name, with its value, unit and meaning."""
    stated = {name: (getattr(system, name), it.unit, it.meaning) for name, it in system.parameters().items()}
    nodes = {"nodes": (system.nodes, "1", "nodes along the rod, base and tip included")}
    return {name: _quantity(*parts) for name, parts in (stated | nodes).items()}


def derived(system: System) -> dict[str, dict[str, Any]]:
    """What follows from the parameters, in the same form."""
    from knode_cosserat.rods.tendon_robot import TendonRobot

    if not isinstance(system, TendonRobot):
        return {}
    Kse, Kbt, mass = np.asarray(system.Kse), np.asarray(system.Kbt), system.mass_per_length * system.length
    # 1.875… is the first root of cos(x) cosh(x) = -1
    frequency = 1.875104068711961**2 / (2 * np.pi) * np.sqrt(Kbt[0, 0] / (mass * system.length**3))
    return {
        "G": _quantity(system.G, "Pa", "shear modulus"),
        "Kse": _quantity(np.diag(Kse), "N", "stiffness of shear, shear and extension"),
        "Kbt": _quantity(np.diag(Kbt), "N m2", "stiffness of bending, bending and twisting"),
        "mass": _quantity(mass, "kg", "mass of the rod"),
        "frequency": _quantity(
            frequency, "Hz", "first bending mode, by beam theory without damping, drag and gravity"
        ),
    }


def _quantity(value: Any, unit: str, meaning: str) -> dict[str, Any]:
    plain = value if value is None or isinstance(value, int) else np.asarray(value, dtype=float).tolist()
    return {"value": plain, "unit": unit, "meaning": meaning}


# telling it


def tell(as_json: bool, facts: dict[str, Any], lines: list[str], **written: Path | None) -> None:
    """Facts as JSON, or the same in words; and the files that were written."""
    if as_json:
        files = {name: str(path) if path else None for name, path in written.items()}
        typer.echo(json.dumps(facts | files, allow_nan=False))
        return
    for line in [*lines, *(f"wrote {path}" for path in written.values() if path)]:
        typer.echo(line)


def table(rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines with the cells of each column below each other."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    padded = ((cell.ljust(width) for cell, width in zip(row, widths, strict=True)) for row in rows)
    return ["  ".join(row).rstrip() for row in padded]


def vector(values: list[float]) -> str:
    """Numbers in words, without those that are rounding errors beside the largest."""
    size = max(map(abs, values))
    return "(" + ", ".join(f"{value if abs(value) > 1e-9 * size else 0.0:.6g}" for value in values) + ")"


def shown(value: Any) -> str:
    """A parameter's value in words."""
    if value is None:
        return "not given"
    array = np.asarray(value)
    if array.ndim == 2 and np.array_equal(array, np.diag(np.diag(array))):
        return f"diag {shown(np.diag(array).tolist())}"
    if array.ndim:
        return "[" + ", ".join(shown(each) for each in value) + "]"
    return f"{value:.6g}"
