"""Commands on what a robot reaches at rest: reach, workspace."""

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
    require_writable,
    system_of,
    wanted,
)
from knode_cosserat.cli.program import app, examples
from knode_cosserat.cli.telling import tell, vector

if TYPE_CHECKING:
    from knode_cosserat.rods.system import System
    from knode_cosserat.statics.reach import InverseKinematics
    from knode_cosserat.statics.workspace import Workspace

Low = Annotated[
    str,
    typer.Option(
        metavar="LIMIT[,LIMIT,…]",
        help="Lower limit of the controls, in their units (tensions: N): one, or one each.",
    ),
]
High = Annotated[
    str,
    typer.Option(
        metavar="LIMIT[,LIMIT,…]",
        help="Upper limit of the controls, in their units (tensions: N): one, or one each.",
    ),
]


@app.command(
    epilog=examples(
        "reach delrin-tendon-robot --position 0.2063 0.1032 0.58 --high 10",
        "reach delrin-tendon-robot --quaternion 0.98 -0.1 0.17 0 --low 1 --high 8,8,10,10 --tolerance 1e-2",
    )
)
def reach(
    robot: Robot,
    position: Annotated[
        tuple[float, float, float] | None, typer.Option(metavar="X Y Z", help="Where the tip is to be (m).")
    ] = None,
    quaternion: Annotated[
        tuple[float, float, float, float] | None,
        typer.Option(metavar="W X Y Z", help="How the tip is to be turned, scalar first."),
    ] = None,
    low: Low = "0",
    high: High = "10",
    tolerance: Annotated[
        float, typer.Option(metavar="PART", help="How near is reached: in parts of the length, and in rad.")
    ] = 1e-4,
    space: Space = "lobatto2",
    changes: Changes = None,
    nodes: Nodes = None,
    as_json: Json = False,
) -> None:
    """Find the tensions, or other controls, that bring a robot's tip to a pose at rest.

    Of all that do, the least beyond the lower limits. A pose that cannot be reached gives the nearest, and
    says so.
    """
    import knode_cosserat as kc
    from knode_cosserat import named_controls

    system = system_of(robot, changes, nodes)
    found = kc.inverse_kinematics(
        system, position, quaternion, low=_limits("--low", low), high=_limits("--high", high),
        tolerance=tolerance, space=space,
    )  # fmt: skip
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
        "unstable": _unstable(found),
        "iterations": found.iterations,
    }
    lines = [
        f"{found.result.message}; {found.iterations} equilibria were looked at",
        _held(system, facts["control"]),
    ]
    if facts["position"]:
        lines.append(f"tip: {vector(facts['position'])} m")
    if position is not None:
        lines.append(f"off by {found.position_error:.3g} m")
    if quaternion is not None:
        lines.append(f"turned from it by {np.degrees(found.angle_error):.3g} degrees")
    word = "tensions" if _tensions_only(system) else "controls"
    called = [str(i + 1) for i in range(system.control_size)] if _tensions_only(system) else facts["names"]
    for name, active in (("lower", found.at_low), ("upper", found.at_high)):
        if np.any(active):
            which = [called[i] for i in np.flatnonzero(active)]
            lines.append(f"at the {name} limit: {', '.join(which)}")
    if facts["unstable"]:
        lines.append("UNSTABLE: the least push, and the robot leaves this shape")
    if not found.from_rest and facts["position"]:
        lines.append(f"the robot has several shapes under these {word}: it has to be led to this one")
    tell(as_json, facts, lines)


@app.command(
    epilog=examples(
        "workspace delrin-tendon-robot --count 100000 --out workspace.nc",
        "workspace my-robot.yaml --high 8 --count 4096 --out workspace.csv --picture workspace.png",
    )
)
def workspace(
    robot: Robot,
    out: Annotated[
        Path, typer.Option(metavar="FILE", help="Write controls and poses to this .nc, .csv or .npz file.")
    ],
    count: Annotated[int, typer.Option(metavar="N", help="How many equilibria.")] = 10_000,
    low: Low = "0",
    high: High = "10",
    seed: Annotated[int, typer.Option(metavar="N", min=0, help="Seed of the samples.")] = 0,
    space: Space = "lobatto2",
    changes: Changes = None,
    nodes: Nodes = None,
    picture: Annotated[Path | None, Picture] = None,
    progress: Progress = None,
    as_json: Json = False,
) -> None:
    """Find where a robot's tip can be at rest: poses under controls spread evenly between limits."""
    from knode_cosserat.statics.workspace import FORMATS

    require_writable(out, picture)
    if out.suffix not in FORMATS:
        raise ValueError(f"{out}: allowed is a name that ends in {', '.join(FORMATS)}")
    if picture:
        figures()
    import knode_cosserat as kc

    system = system_of(robot, changes, nodes)
    began = perf_counter()
    found = kc.workspace(
        system, _limits("--low", low), _limits("--high", high), count, seed=seed, space=space,
        progress=wanted(progress),
    )  # fmt: skip
    seconds = perf_counter() - began
    found.save(out)
    if picture:
        _drawn(found).savefig(picture)
    inside = found.position[found.valid]
    box = [inside.min(axis=0).tolist(), inside.max(axis=0).tolist()] if len(inside) else None
    facts = {
        "robot": robot, "count": count, "unsolved": found.unsolved, "seed": seed, "box": box,
        "computing_time": round(seconds, 3),
    }  # fmt: skip
    lines = [f"{count} equilibria in {seconds:.1f} s of computing; not solved: {found.unsolved}"]
    if box:
        lines.append(f"the tip is between {vector(box[0])} and {vector(box[1])} m")
    tell(as_json, facts, lines, out=out, picture=picture)


def _limits(name: str, text: str) -> float | list[float]:
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        raise ValueError(
            f"{name} {text!r}: allowed is a number, or one for each control, such as 8,8,10,10"
        ) from None
    return values[0] if len(values) == 1 else values


def _tensions_only(system: System) -> bool:
    return system.control_layout.names == ("tension",)


def _held(system: System, control: list[float]) -> str:
    """The controls in words: tensions, or by name and unit."""
    from knode_cosserat import named_controls

    if _tensions_only(system):
        return f"tensions: {vector(control)} N"
    layout = system.control_layout
    each = zip(named_controls.labels(layout), control, named_controls.units(layout), strict=True)
    # a number without a unit has the unit 1
    words = (f"{name}={value:.6g}" + (f" {unit}" if unit != "1" else "") for name, value, unit in each)
    return "controls: " + ", ".join(words)


def _unstable(found: InverseKinematics) -> bool | None:
    """True if the pose is an unstable equilibrium; None where `kc.statics.stability` cannot decide."""
    import knode_cosserat as kc

    try:
        return not kc.statics.stability(found.equilibrium).stable
    except ValueError:
        return None


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _plain(values: Any) -> list[float] | None:
    return None if values is None or not np.all(np.isfinite(values)) else np.asarray(values).tolist()


def _drawn(found: Workspace) -> Any:
    from knode_cosserat.evaluation.workspace_figures import workspace_seen

    return workspace_seen(found)
