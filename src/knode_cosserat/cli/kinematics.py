"""Commands on inverse kinematics and the workspace: reach, workspace."""

from __future__ import annotations

from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from knode_cosserat.cli.arguments import (
    Changes,
    Json,
    Nodes,
    Picture,
    Progress,
    Robot,
    Space,
    figures,
    load_system,
    parse_limits,
    parse_numbers,
    require_writable,
    shows_progress,
)
from knode_cosserat.cli.output import vector_text, write_output
from knode_cosserat.cli.program import app, examples
from knode_cosserat.cli.summaries import stability_summary
from knode_cosserat.rods.parameters import in_other_unit

if TYPE_CHECKING:
    from knode_cosserat.rods.system import System
    from knode_cosserat.statics.reach import InverseKinematics
    from knode_cosserat.statics.workspace import Workspace

Low = Annotated[
    str,
    typer.Option(
        metavar="LIMITS",
        help="Lower limits of the controls in their units (tensions: N): one number, or one per control.",
    ),
]
High = Annotated[
    str,
    typer.Option(
        metavar="LIMITS",
        help="Upper limits of the controls in their units (tensions: N): one number, or one per control, "
        "such as 8,8,10,10.",
    ),
]


@app.command(
    epilog=examples(
        "reach delrin-tendon-robot --position 0.17404 0.0838 0.60002 --high 10",
        "reach delrin-tendon-robot --quaternion 0.98 -0.1 0.17 0 --low 1 --high 8,8,10,10 --tolerance 1e-2",
    )
)
def reach(
    robot: Robot,
    position: Annotated[
        str | None,
        typer.Option(metavar="X,Y,Z", help="Target position of the tip (m), such as 0.1,0.05,0.58."),
    ] = None,
    quaternion: Annotated[
        str | None,
        typer.Option(metavar="W,X,Y,Z", help="Target orientation of the tip: a quaternion, scalar first."),
    ] = None,
    low: Low = "0",
    high: High = "10",
    tolerance: Annotated[
        float,
        typer.Option(
            metavar="X", help="Tolerance: position error as a fraction of the length, angle error in rad."
        ),
    ] = 1e-4,
    space: Space = "lobatto2",
    changes: Changes = None,
    nodes: Nodes = None,
    as_json: Json = False,
) -> None:
    """Compute controls that move the tip to a pose at rest.

    Among several solutions it returns the one with the smallest controls above the lower limits. If the pose
    cannot be reached, it returns the nearest pose and says so.
    """
    import knode_cosserat as kc
    from knode_cosserat import named_controls

    system = load_system(robot, changes, nodes)
    size = system.control_size
    target = None if position is None else _target(position, float(system.length))
    orientation = (
        None if quaternion is None else parse_numbers("--quaternion", quaternion, 4, "0.98,-0.1,0.17,0")
    )
    found = kc.inverse_kinematics(
        system, target, orientation,
        low=parse_limits("--low", low, size), high=parse_limits("--high", high, size),
        tolerance=tolerance, space=space,
    )  # fmt: skip
    stability, warnings = _stability(found)
    facts: dict[str, Any] = {
        "robot": robot,
        "result": found.result.name.lower(),
        "converged": bool(found.converged),
        "control": found.control.tolist(),
        "names": named_controls.labels(system.control_layout),
        "units": named_controls.units(system.control_layout),
        "position": _plain(found.position),
        "quaternion": _plain(found.quaternion),
        "position_error": _number(found.position_error),
        "angle_error": _number(found.angle_error),
        "at_low": found.at_low.tolist(),
        "at_high": found.at_high.tolist(),
        "from_rest": found.from_rest,
        **stability,
        "iterations": found.iterations,
    }
    lines = [
        f"{found.result.message}; {found.iterations} equilibria computed",
        _control_text(system, facts["control"]),
    ]
    if facts["position"]:
        lines.append(f"tip: {vector_text(facts['position'])} m")
    if position is not None:
        lines.append(f"position error: {found.position_error:.3g} m")
    if quaternion is not None:
        lines.append(f"angle error: {np.degrees(found.angle_error):.3g} degrees")
    word = "tensions" if _tensions_only(system) else "controls"
    names = [str(i + 1) for i in range(system.control_size)] if _tensions_only(system) else facts["names"]
    for name, active in (("lower", found.at_low), ("upper", found.at_high)):
        if np.any(active):
            indices = np.flatnonzero(active)
            lines.append(f"at the {name} limit: {', '.join(names[i] for i in indices)}")
    lines += warnings
    if not found.from_rest and facts["position"]:
        lines.append(f"the robot has several equilibria under these {word}: start near this one to reach it")
    write_output(as_json, facts, lines)


@app.command(
    epilog=examples(
        "workspace delrin-tendon-robot --count 100000 --out workspace.nc",
        "workspace my-robot.yaml --high 8 --count 4096 --out workspace.csv --picture workspace.png",
    )
)
def workspace(
    robot: Robot,
    out: Annotated[
        Path,
        typer.Option(metavar="FILE", help="Write controls and tip poses to this .nc, .csv or .npz file."),
    ],
    count: Annotated[int, typer.Option(metavar="N", help="Number of equilibria to compute.")] = 10_000,
    low: Low = "0",
    high: High = "10",
    seed: Annotated[int, typer.Option(metavar="N", min=0, help="Random seed of the samples.")] = 0,
    space: Space = "lobatto2",
    changes: Changes = None,
    nodes: Nodes = None,
    picture: Annotated[Path | None, Picture] = None,
    progress: Progress = None,
    as_json: Json = False,
) -> None:
    """Sample the tip poses that a robot reaches at rest.

    Controls are distributed evenly between their limits.
    """
    from knode_cosserat.statics.workspace import FORMATS

    require_writable(out, picture)
    if out.suffix not in FORMATS:
        raise ValueError(f"{out}: the name must end in {', '.join(FORMATS)}")
    if picture:
        figures()
    import knode_cosserat as kc

    system = load_system(robot, changes, nodes)
    size = system.control_size
    began = perf_counter()
    found = kc.workspace(
        system, parse_limits("--low", low, size), parse_limits("--high", high, size), count,
        seed=seed, space=space, progress=shows_progress(progress),
    )  # fmt: skip
    seconds = perf_counter() - began
    found.save(out)
    if picture:
        _figure(found).savefig(picture)
    inside = found.position[found.valid]
    box = [inside.min(axis=0).tolist(), inside.max(axis=0).tolist()] if len(inside) else None
    facts = {
        "robot": robot, "count": count, "unsolved": found.unsolved, "seed": seed, "box": box,
        "computing_time": round(seconds, 3),
    }  # fmt: skip
    lines = [f"{count} equilibria computed in {seconds:.1f} s; not solved: {found.unsolved}"]
    if box:
        lines.append(f"tip positions between {vector_text(box[0])} and {vector_text(box[1])} m")
    write_output(as_json, facts, lines, out=out, picture=picture)


#: largest plausible distance of a target, in lengths of the robot
FARTHEST = 10.0


def _target(text: str, length: float) -> list[float]:
    """Return a target position (m). Raises `ValueError` if it seems to be in another unit."""
    target = parse_numbers("--position", text, 3, "0.1,0.05,0.25")
    if np.linalg.norm(target) > FARTHEST * length:
        meant = in_other_unit(target, "m", -2.0 * length, 2.0 * length)
        if meant is not None:
            unit, values = meant
            raise ValueError(
                f"--position must be in metres (got {text} for a robot of {length:g} m length). "
                f"Did you mean {' '.join(f'{x:g}' for x in values)} ({text} {unit})?"
            )
    return target


def _tensions_only(system: System) -> bool:
    return system.control_layout.names == ("tension",)


def _control_text(system: System, control: list[float]) -> str:
    """Return a control as text: tensions, or names with values and units."""
    from knode_cosserat import named_controls

    if _tensions_only(system):
        return f"tensions: {vector_text(control)} N"
    layout = system.control_layout
    each = zip(named_controls.labels(layout), control, named_controls.units(layout), strict=True)
    # the unit of a plain number is "1"
    words = (f"{name}={value:.6g}" + (f" {unit}" if unit != "1" else "") for name, value, unit in each)
    return "controls: " + ", ".join(words)


def _stability(found: InverseKinematics) -> tuple[dict[str, Any], list[str]]:
    """Return facts and lines on the stability of the equilibrium, if `kc.statics.stability` applies."""
    import knode_cosserat as kc

    try:
        decided = kc.statics.stability(found.equilibrium)
    except ValueError:
        return stability_summary(None)
    return stability_summary(decided.kind, decided.reason)


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _plain(values: Any) -> list[float] | None:
    return None if values is None or not np.all(np.isfinite(values)) else np.asarray(values).tolist()


def _figure(found: Workspace) -> Any:
    from knode_cosserat.evaluation.workspace_figures import workspace_seen

    return workspace_seen(found)
