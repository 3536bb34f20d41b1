"""What the commands tell: facts of trajectories and systems, ready for JSON."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from knode_cosserat.solvers.result import Result

if TYPE_CHECKING:
    from knode_cosserat.rods.system import System
    from knode_cosserat.trajectory import Trajectory


#: how many terms of a residual are told in words
MOST_FINDINGS = 24


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
        "largest_position_error": _largest_error(trajectory),
        "extrapolated": _extrapolated(trajectory),
        "tip_position": np.asarray(trajectory.tip_position)[valid][-1].tolist(),
    }


def _extrapolated(trajectory: Trajectory) -> int | None:
    """Return the number of rows outside the range of the training data; None if no range is known."""
    rows = trajectory.extrapolated
    return None if rows is None else int(np.count_nonzero(rows))


def _largest_error(trajectory: Trajectory) -> float | None:
    """Return the largest estimated position error (m) of the solved rows; None where it is unknown."""
    if trajectory.position_error is None:
        return None
    largest = float(np.asarray(trajectory.position_error)[np.asarray(trajectory.valid)].max())
    return largest if np.isfinite(largest) else None


def error_text(error: float | None, length: float) -> str:
    """Return a position error in words: in mm, and as a share of the length."""
    if error is None:
        return "unknown"
    return f"{1e3 * error:.2g} mm ({100 * error / length:.2g} % of the length)"


def at_rest(rest: Trajectory) -> dict[str, Any]:
    """The shape of an equilibrium, and what holds it (m, rad, N, N·m)."""
    position, (w, x, y, z) = np.asarray(rest.position)[0], np.asarray(rest.quaternion)[0, -1]
    facts = {
        "control": np.asarray(rest.control)[0].tolist(),
        "position": position.tolist(),
        "tip_position": position[-1].tolist(),
        "tip_inclination": float(2 * np.arctan2(np.hypot(x, y), np.hypot(w, z))),
        "residual": float(rest.residual[0]),
        "position_error": _largest_error(rest),
        "extrapolated": _extrapolated(rest),
        "result": Result(int(rest.result[0])).message,
    }
    if "tension" in rest.system.control_layout.names:
        facts["tension"] = rest.system.control_layout.get(np.asarray(rest.control)[0], "tension").tolist()
    elif "tension" in rest.system.y_layout.names:
        facts["tension"] = np.asarray(rest.part("tension"))[0, 0].tolist()
    if {"n", "m"} <= set(rest.system.y_layout.names):
        facts["base_force"] = np.asarray(rest.force)[0, 0].tolist()
        facts["base_moment"] = np.asarray(rest.moment)[0, 0].tolist()
    return facts


def parameters(system: System) -> dict[str, dict[str, Any]]:
    """Every parameter by name, with its value, unit and meaning; of a model, those of its knowledge."""
    system = system.nominal
    stated = {name: (getattr(system, name), it.unit, it.meaning) for name, it in system.parameters().items()}
    nodes = {"nodes": (system.nodes, "1", "nodes along the rod, base and tip included")}
    return {name: _quantity(*parts) for name, parts in (stated | nodes).items()}


def derived(system: System) -> dict[str, dict[str, Any]]:
    """What follows from the parameters, in the same form."""
    from knode_cosserat.rods.loads import AttachedMass
    from knode_cosserat.rods.rod import Rod

    system = system.nominal
    if not isinstance(system, Rod):
        return {}
    Kse, Kbt, mass = np.asarray(system.Kse), np.asarray(system.Kbt), system.mass_per_length * system.length
    attached = sum(float(load.mass) for load in system.loads if isinstance(load, AttachedMass))
    # 1.875… is the first root of cos(x) cosh(x) = -1
    frequency = 1.875104068711961**2 / (2 * np.pi) * np.sqrt(Kbt[0, 0] / (mass * system.length**3))
    return {
        "G": _quantity(system.G, "Pa", "shear modulus"),
        "Kse": _quantity(np.diag(Kse), "N", "stiffness of shear, shear and extension"),
        "Kbt": _quantity(np.diag(Kbt), "N m2", "stiffness of bending, bending and twisting"),
        "mass": _quantity(mass, "kg", "mass of the rod"),
        **({"attached_mass": _quantity(attached, "kg", "mass of what is on it")} if attached else {}),
        "frequency": _quantity(frequency, "Hz", "first bending mode of the bare rod, by beam theory"),
    }


def driven_by(system: System) -> dict[str, dict[str, str]]:
    """Every control, by the name that `--controls` and `--control` take, with its unit and meaning."""
    from knode_cosserat import named_controls

    layout = system.control_layout
    meanings = [field.meaning for field in layout.fields for _ in range(field.size)]
    each = zip(named_controls.labels(layout), named_controls.units(layout), meanings, strict=True)
    return {name: {"unit": unit, "meaning": meaning} for name, unit, meaning in each}


def more_lines(system: System) -> list[str]:
    """Choices and parts of a robot that are not as they are by default, as its file would have them."""
    from knode_cosserat.rods.robot_file import KINDS, RobotFileError, more_of

    system = system.nominal
    try:
        return more_of(system) if type(system) in KINDS.values() else []
    except RobotFileError as error:
        return [f"  {error}"]


def _quantity(value: Any, unit: str, meaning: str) -> dict[str, Any]:
    plain = value if value is None or isinstance(value, int) else np.asarray(value, dtype=float).tolist()
    return {"value": plain, "unit": unit, "meaning": meaning}


def learned(system: System) -> tuple[dict[str, Any], list[str]]:
    """What a model learned, as facts and in words; nothing of a system that is not a model."""
    from knode_cosserat.learning.explain import explain
    from knode_cosserat.learning.knode import KNODE
    from knode_cosserat.learning.structured.residual import Structured

    if not isinstance(system, KNODE):
        return {}, []
    facts: dict[str, Any] = {"residual": type(system.residual).__name__}
    lines = [f"residual: {facts['residual']}"]
    for stage in ("segments", "rollouts"):
        losses = system.about.facts.get(stage, {}).get("loss", ())
        if len(losses):
            facts[stage] = {"steps": len(losses), "loss": float(losses[-1])}
            lines.append(f"{stage}: loss {losses[-1]:.4g} at step {len(losses)}")
    if isinstance(system.residual, Structured):
        found = explain(system)
        facts["found"] = [finding._asdict() for finding in found]
        lines += [f"  {finding}" for finding in found[:MOST_FINDINGS]] or ["  nothing is missing"]
        if len(found) > MOST_FINDINGS:
            lines.append(f"  … and {len(found) - MOST_FINDINGS} more; --json has all of them")
    return facts, lines
