"""Commands on equilibria: reach, modes, workspace."""

from __future__ import annotations

from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import numpy as np

from knode_cosserat._numbers import numbers_in
from knode_cosserat.cli.arguments import (
    Json,
    Model,
    Picture,
    Report,
    Space,
    figures,
    limits_of,
    parse_numbers,
    require_writable,
)
from knode_cosserat.cli.output import best_so_far, vector_text, write_output
from knode_cosserat.cli.program import app
from knode_cosserat.cli.robots import Held
from knode_cosserat.cli.summaries import stability_summary
from knode_cosserat.errors import first_line
from knode_cosserat.rods.parameters import in_other_unit

if TYPE_CHECKING:
    from knode_cosserat.rods.system import System


class _Limits(NamedTuple):
    """Limits of the controls.

    Options:
        low (--low LIMITS): Lower limits of the controls in their units: one number, or one per control.
            Default: those of the robot's file; 0 N for tensions.
        high (--high LIMITS): Upper limits of the controls in their units: one number, or one per control,
            such as 8,8,10,10. Default: those of the robot's file; 10 N for tensions.
    """

    low: str | None = None
    high: str | None = None

    def of(self, system: System) -> dict[str, Any]:
        """Return the lower and the upper limits of a robot's controls, by name."""
        return limits_of(system, low=self.low, high=self.high)


#: largest plausible distance of a target, in lengths of the robot
FARTHEST = 10.0


class TipTarget(NamedTuple):
    """Target of the tip.

    Options:
        position (--position X,Y,Z): Target position of the tip (m), such as 0.1,0.05,0.58 or 100mm,50mm,0.58.
        quaternion (--quaternion W,X,Y,Z): Target orientation of the tip: a quaternion, scalar first.
        tolerance (--tolerance X): Tolerance: position error as a fraction of the length, angle error in rad.
    """

    position: str | None = None
    quaternion: str | None = None
    tolerance: float = 1e-4

    def pose(self, length: float) -> tuple[list[float] | None, list[float] | None]:
        """Return position (m) and quaternion. Raises `ValueError` for a position that seems to be in mm."""
        orientation = None
        if self.quaternion is not None:
            orientation = parse_numbers("--quaternion", self.quaternion, 4, "0.98,-0.1,0.17,0")
        if self.position is None:
            return None, orientation
        target = parse_numbers("--position", self.position, 3, "0.1,0.05,0.25", unit="m")
        if numbers_in(self.position) is not None and np.linalg.norm(target) > FARTHEST * length:
            meant = in_other_unit(target, "m", -2.0 * length, 2.0 * length)
            if meant is not None:
                unit, values = meant
                raise ValueError(
                    f"--position must be in metres (got {self.position} for a robot of {length:g} m length). "
                    f"Did you mean {' '.join(f'{x:g}' for x in values)} ({self.position} {unit})?"
                )
        return target, orientation


@app.command()
def reach(
    model: Model, target: TipTarget, limits: _Limits, space: Space = "lobatto2", as_json: Json = False
) -> None:
    """Compute controls that move the tip to a pose at rest.

    Among several solutions it returns the one with the smallest controls above the lower limits. If the pose
    cannot be reached, it returns the nearest pose and says so.

    Examples:
        reach delrin-tendon-robot --position 0.17404 0.0838 0.60002 --high 10
        reach delrin-tendon-robot --quaternion 0.98 -0.1 0.17 0 --low 1 --high 8,8,10,10 --tolerance 1e-2
    """
    import knode_cosserat as kc
    from knode_cosserat.controls import labels, units

    system = model.load()
    found = kc.inverse_kinematics(
        system,
        *target.pose(float(system.length)),
        **limits.of(system),
        tolerance=target.tolerance,
        space=space,
    )
    try:
        decided = kc.statics.stability(found.equilibrium)
        stability, warnings = stability_summary(decided.kind, decided.reason)
    except ValueError as error:
        stability, warnings = stability_summary("undecided", first_line(error))
    facts: dict[str, Any] = {
        "robot": model.robot,
        "result": found.result.name.lower(),
        "converged": bool(found.converged),
        "control": found.control.tolist(),
        "names": labels(system.control_layout),
        "units": units(system.control_layout),
        "position": _plain(found.position),
        "quaternion": _plain(found.quaternion),
        "position_error": float(found.position_error) if np.isfinite(found.position_error) else None,
        "angle_error": float(found.angle_error) if np.isfinite(found.angle_error) else None,
        "at_low": found.at_low.tolist(),
        "at_high": found.at_high.tolist(),
        "from_rest": found.from_rest,
        **stability,
        "iterations": found.iterations,
    }
    tensions_only = system.control_layout.names == ("tension",)
    word = "tensions" if tensions_only else "controls"
    names = [str(i + 1) for i in range(len(found.control))] if tensions_only else facts["names"]
    if tensions_only:
        text = f"{vector_text(facts['control'])} N"
    else:
        # the unit of a plain number is "1"
        rows = zip(facts["names"], facts["control"], facts["units"], strict=True)
        text = ", ".join(
            f"{name}={value:.6g}{f' {unit}' if unit != '1' else ''}" for name, value, unit in rows
        )
    lines = [f"{found.result.message}; {found.iterations} equilibria computed", f"{word}: {text}"]
    if facts["position"]:
        lines.append(f"tip: {vector_text(facts['position'])} m")
    if target.position is not None:
        lines.append(f"position error: {found.position_error:.3g} m")
    if target.quaternion is not None:
        lines.append(f"angle error: {np.degrees(found.angle_error):.3g} degrees")
    for name, active in (("lower", found.at_low), ("upper", found.at_high)):
        if np.any(active):
            indices = np.flatnonzero(active)
            lines.append(f"at the {name} limit: {', '.join(names[i] for i in indices)}")
    lines += warnings
    if not found.from_rest and facts["position"]:
        lines.append(f"the robot has several equilibria under these {word}: start near this one to reach it")
    write_output(as_json, facts, lines)


@app.command()
def modes(
    model: Model,
    held: Held,
    number: int = 10,
    picture: Annotated[Path | None, Picture] = None,
    as_json: Json = False,
) -> None:
    """Compute the modes of vibration about the equilibrium under a constant control.

    Options:
        number (--count N≥1): Largest number of modes.

    Examples:
        modes delrin-routed-tendon-robot --tension 7,5,5,7
        modes my-rod.yaml --control base_z=0.1 --count 4 --picture modes.png
    """
    require_writable(picture)
    drawing = figures() if picture else None
    import knode_cosserat as kc

    system = model.load()
    found = kc.statics.modes(kc.equilibrium(system, held.of(system), space="lobatto4"), count=number)
    if drawing:
        drawing.vibration(found).savefig(picture)
    facts = {
        "robot": model.robot,
        "frequency": found.frequency.tolist(),
        "damping": found.damping.tolist(),
        "growth_rate": found.values.real.tolist(),
        "error": found.error.tolist(),
    }
    write_output(as_json, facts, repr(found).splitlines(), picture=picture)


class _SampleFiles(NamedTuple):
    """Sampled equilibria and their files.

    Options:
        out (--out FILE): Write controls and tip poses to this .nc, .csv or .npz file.
        number (--count N): Number of equilibria to compute.
        seed (--seed N≥0): Random seed of the samples.
    """

    out: Path
    picture: Annotated[Path | None, Picture] = None
    number: int = 10_000
    seed: int = 0


@app.command()
def workspace(
    model: Model, samples: _SampleFiles, limits: _Limits, report: Report, space: Space = "lobatto2"
) -> None:
    """Sample the tip poses that a robot reaches at rest.

    Controls are distributed evenly between their limits.

    Examples:
        workspace delrin-tendon-robot --count 100000 --out workspace.nc
        workspace my-robot.yaml --high 8 --count 4096 --out workspace.csv --picture workspace.png
    """
    from knode_cosserat.statics.workspace import FORMATS

    out, picture, count, seed = samples
    require_writable(out, picture)
    if out.suffix not in FORMATS:
        raise ValueError(f"{out}: the name must end in {', '.join(FORMATS)}")
    drawing = figures() if picture else None
    import knode_cosserat as kc

    system = model.load()
    within = limits.of(system)
    began = perf_counter()
    found = best_so_far(
        lambda: kc.workspace(
            system, **within, count=count, seed=seed, space=space, progress=report.shows_progress
        )
    )
    count = len(found.controls)
    seconds = perf_counter() - began
    found.save(out)
    if drawing:
        drawing.workspace(found).savefig(picture)
    inside = found.position[found.valid]
    box = [inside.min(axis=0).tolist(), inside.max(axis=0).tolist()] if len(inside) else None
    facts = {
        "robot": model.robot,
        "count": count,
        "unsolved": found.unsolved,
        "seed": seed,
        "box": box,
        "computing_time": round(seconds, 3),
    }
    lines = [f"{count} equilibria computed in {seconds:.1f} s; not solved: {found.unsolved}"]
    if box:
        lines.append(f"tip positions between {vector_text(box[0])} and {vector_text(box[1])} m")
    write_output(report.as_json, facts, lines, out=out, picture=picture)


def _plain(values: Any) -> list[float] | None:
    return None if values is None or not np.all(np.isfinite(values)) else np.asarray(values).tolist()
