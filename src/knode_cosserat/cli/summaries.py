"""Summaries of trajectories and systems, as values for JSON and lines of text."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from knode_cosserat.rods.system import ChosenNodes, nodes_text
from knode_cosserat.rods.wrapped import nominal_model
from knode_cosserat.schemes.result import Result, Verdict

if TYPE_CHECKING:
    from knode_cosserat.rods.passport import Origin
    from knode_cosserat.rods.system import System
    from knode_cosserat.trajectory import Trajectory


#: largest number of residual terms in the text output
MOST_FINDINGS = 24


def motion_summary(trajectory: Trajectory) -> dict[str, Any]:
    """Return the results of the time steps, and the tip position after the last solved step."""
    codes = np.asarray(trajectory.result)
    valid = codes >= 0
    failure = None
    if not valid.all():
        row = int(np.argmin(valid))
        message = Result(int(codes[row])).message
        failure = {"step": row, "time": float(trajectory.time[row]), "message": message}
    kinds, counts = np.unique(codes[1:], return_counts=True)
    return {
        "results": {Result(int(code)).name.lower(): int(n) for code, n in zip(kinds, counts, strict=True)},
        "all_solved": bool(valid.all()),
        "first_failure": failure,
        "largest_residual": float(np.asarray(trajectory.residual)[valid].max()),
        "largest_position_error": _largest_error(trajectory.position_error, trajectory.valid),
        "largest_time_error": _largest_error(trajectory.time_error, trajectory.valid),
        "extrapolated": _extrapolated(trajectory),
        "tip_position": np.asarray(trajectory.tip_position)[valid][-1].tolist(),
        **grid_facts(trajectory.system),
    }


def grid_facts(system: System) -> dict[str, Any]:
    """Return the number of nodes, and whether it was chosen."""
    return {"nodes": int(system.nodes), "nodes_chosen": isinstance(system.nodes, ChosenNodes)}


def _extrapolated(trajectory: Trajectory) -> int | None:
    """Return the number of rows outside the range of the training data; None if no range is known."""
    rows = trajectory.extrapolated
    return None if rows is None else int(np.count_nonzero(rows))


def _largest_error(errors: Any, valid: Any) -> float | None:
    """Return the largest estimated error of positions (m) of the solved rows; None where it is unknown."""
    if errors is None:
        return None
    largest = float(np.asarray(errors)[np.asarray(valid)].max())
    return largest if np.isfinite(largest) else None


def error_text(error: float | None, length: float, system: System | None = None) -> str:
    """Return a position error as text: in mm, as a percentage of the length, and the nodes if chosen."""
    chosen = system is not None and isinstance(system.nodes, ChosenNodes)
    grid = f" with {nodes_text(system)}" if chosen and system is not None else ""
    if error is None:
        return f"no estimate{grid}"
    return f"{1e3 * error:.2g} mm ({100 * error / length:.2g} % of the length){grid}"


def equilibrium_summary(rest: Trajectory) -> dict[str, Any]:
    """Return the shape of an equilibrium, its control, and the reaction at the base (m, rad, N, N m)."""
    position, (w, x, y, z) = np.asarray(rest.position)[0], np.asarray(rest.quaternion)[0, -1]
    facts = {
        "control": np.asarray(rest.control)[0].tolist(),
        "position": position.tolist(),
        "tip_position": position[-1].tolist(),
        "tip_inclination": float(2 * np.arctan2(np.hypot(x, y), np.hypot(w, z))),
        "residual": float(rest.residual[0]),
        "position_error": _largest_error(rest.position_error, rest.valid),
        "extrapolated": _extrapolated(rest),
        **grid_facts(rest.system),
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


def stability_summary(kind: str, reason: str = "") -> tuple[dict[str, Any], list[str]]:
    """Return facts and a line on a kind of `kc.statics.Stability`, "undecided" with its reason."""
    lines = {
        "stable": Verdict.STABLE.message,
        "neutral": "stable, with directions in which it moves at no cost",
        "divergence": Verdict.UNSTABLE.message,
        "flutter": Verdict.FLUTTER.message,
        "undecided": f"stability not tested: {reason}",
    }
    unstable = None if kind == "undecided" else kind in ("divergence", "flutter")
    return {"unstable": unstable, "stability": kind}, [lines[kind]]


def verdict_summary(rest: Trajectory) -> tuple[dict[str, Any], list[str]]:
    """Return facts and a line on the stability of an equilibrium."""
    verdict = Verdict(int(rest.stability[0]))
    kinds = {Verdict.STABLE: "stable", Verdict.UNSTABLE: "divergence", Verdict.FLUTTER: "flutter"}
    return stability_summary(kinds.get(verdict, "undecided"), verdict.reason)


def parameters(system: System) -> dict[str, dict[str, Any]]:
    """Return the parameters by name, with value, unit and meaning; for a model, of its nominal robot."""
    system = nominal_model(system)
    stated = {name: (getattr(system, name), it.unit, it.meaning) for name, it in system.parameters().items()}
    chosen = ", chosen; solutions may use more" if isinstance(system.nodes, ChosenNodes) else ""
    nodes = {"nodes": (int(system.nodes), "1", f"nodes along the rod, base and tip included{chosen}")}
    return {name: _quantity(*parts) for name, parts in (stated | nodes).items()}


def derived(system: System) -> dict[str, dict[str, Any]]:
    """Return quantities that follow from the parameters, in the same form."""
    import jax

    from knode_cosserat.rods.loads import AttachedMass
    from knode_cosserat.rods.rod import SlenderRod

    system = nominal_model(system)
    if not isinstance(system, SlenderRod):
        return {}
    Kse, Kbt, mass = np.asarray(system.Kse), np.asarray(system.Kbt), system.mass_per_length * system.length
    if not system.is_uniform:
        still, s = np.zeros(system.control_layout.size), (np.arange(1000.0) + 0.5) / 1000.0 * system.length
        mass = np.mean(jax.vmap(lambda at: system.material(at, still).rhoA + 0.0 * at)(s)) * system.length
    attached = sum(float(load.mass) for load in system.loads if isinstance(load, AttachedMass))
    return {
        **({} if system.youngs_modulus is None else {"G": _quantity(system.G, "Pa", "shear modulus")}),
        "Kse": _quantity(np.diag(Kse), "N", "stiffness of shear, shear and extension"),
        "Kbt": _quantity(np.diag(Kbt), "N m2", "stiffness of bending, bending and torsion"),
        "mass": _quantity(mass, "kg", "mass of the rod"),
        **({"attached_mass": _quantity(attached, "kg", "mass of the attached bodies")} if attached else {}),
        "frequency": _quantity(
            system.bending_frequency, "Hz", "first bending frequency of the bare rod, by beam theory"
        ),
    }


def control_summary(system: System) -> dict[str, dict[str, str]]:
    """Return the controls by the names that `--controls` and `--control` accept, with unit and meaning."""
    from knode_cosserat.controls import labels, units

    layout = system.control_layout
    meanings = [field.meaning for field in layout.fields for _ in range(field.size)]
    rows = zip(labels(layout), units(layout), meanings, strict=True)
    return {name: {"unit": unit, "meaning": meaning} for name, unit, meaning in rows}


def more_lines(system: System) -> list[str]:
    """Return the choices and parts of a robot that differ from the defaults, as lines of a robot file."""
    from knode_cosserat.rods.robot_file import KINDS, RobotFileError, more_of

    system = nominal_model(system)
    try:
        return more_of(system) if type(system) in KINDS.values() else []
    except RobotFileError as error:
        return [f"  {error}"]


def _quantity(value: Any, unit: str, meaning: str) -> dict[str, Any]:
    plain = value if value is None or isinstance(value, int) else np.asarray(value, dtype=float).tolist()
    return {"value": plain, "unit": unit, "meaning": meaning}


def passport_summary(system: System, recordings: Sequence[Path] = ()) -> tuple[dict[str, Any], list[str]]:
    """Return the passport of a model, and of the robot within it, as values and as text.

    Recordings or trajectories are compared with those that it names.
    """
    passports = [system.passport] if system.passport is not None else []
    inner = getattr(system, "knowledge", None)
    while inner is not None:
        known = inner.passport
        if known is not None and all(known.to_dict() != it.to_dict() for it in passports):
            passports.append(known)
        inner = getattr(inner, "knowledge", None)
    if not passports and recordings:
        raise ValueError("--recording is for what was learned; this robot has no passport")
    facts: dict[str, Any] = {} if not passports else {"passport": passports[0].to_dict()}
    lines = []
    for k, passport in enumerate(passports):
        first, *others = str(passport).splitlines()
        lines += [f"passport{' of the robot within' if k else ''}: {first}", *others]
    verdicts = {
        str(path): _verdict(path, [it for one in passports for it in one.origins]) for path in recordings
    }
    if verdicts:
        facts["recordings"] = verdicts
        lines += [f"{path}: {verdict}" for path, verdict in verdicts.items()]
    return facts, lines


def _verdict(path: Path, origins: Sequence[Origin]) -> str:
    """Return the use of a recording or trajectory in the learning of a model, in words."""
    from knode_cosserat._files.reading import file_hash
    from knode_cosserat.cli.arguments import files_of, is_recording, load_trajectory_file
    from knode_cosserat.learning.training.checkpoint import data_hash

    files = files_of(path)
    missing = next((file for file in files if not file.exists()), None)
    if missing is not None:
        raise ValueError(f"{missing}: no such file")
    if all(is_recording(str(file)) or file.is_dir() for file in files):
        whole = "+".join(map(file_hash, files))
        hashes = {origin.rows: whole for origin in origins}
    else:
        motion = load_trajectory_file(path)
        hashes = {origin.rows: data_hash(motion[: origin.rows]) for origin in origins}
    for origin in origins:
        if origin.sha256 == hashes[origin.rows]:
            return "learned from, unchanged" if origin.learned else "held out, unchanged"
    names = [file.name for file in files]
    if any(name in origin.name for origin in origins for name in names):
        return "not what the model learned from: a recording of this name had other content"
    return "not among these recordings"


def residual_summary(system: System) -> tuple[dict[str, Any], list[str]]:
    """Return the residual of a model as values and as text; both are empty for a robot."""
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
        terms = explain(system)
        facts["found"] = [term._asdict() for term in terms]
        lines += [f"  {term}" for term in terms[:MOST_FINDINGS]] or ["  no terms: the residual is zero"]
        if len(terms) > MOST_FINDINGS:
            lines.append(f"  … and {len(terms) - MOST_FINDINGS} more; --json prints all")
    return facts, lines
