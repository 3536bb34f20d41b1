"""Result of an identification."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

from knode_cosserat._reprs import robot_text, wrapped
from knode_cosserat.rods.system import System


class Estimate(NamedTuple):
    """One identified number; `held` is true if the recordings say little about it beyond its prior."""

    effect: str
    label: str
    unit: str
    nominal: float
    value: float
    interval: tuple[float, float]
    held: bool


@dataclasses.dataclass(frozen=True)
class Identified:
    """A robot identified from recordings; `print` shows a table.

    Attributes:
        robot: the identified robot; a controls row is the measured tensions.
        effects: the effects that it has.
        estimates: their numbers with 95 % intervals.
        nominal_error: by recording, root mean square error of the tip of the nominal robot (m).
        error: the same of the identified robot.
        held_out_error: the same of a robot identified without that recording.
        steps: selection and rejection of effects, in words.
    """

    robot: System
    effects: tuple[str, ...]
    estimates: tuple[Estimate, ...]
    nominal_error: Mapping[str, float | None]
    error: Mapping[str, float | None]
    held_out_error: Mapping[str, float | None]
    steps: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return everything but the robot, as JSON has it."""
        return {
            "effects": list(self.effects),
            "estimates": [each._asdict() | {"interval": list(each.interval)} for each in self.estimates],
            "nominal_error": dict(self.nominal_error),
            "error": dict(self.error),
            "held_out_error": dict(self.held_out_error),
            "steps": list(self.steps),
        }

    def __repr__(self) -> str:
        parts = [f"Identified {robot_text(self.robot)}", f"effects: {', '.join(self.effects) or 'none'}"]
        for name, errors in (
            ("nominal", self.nominal_error), ("identified", self.error), ("held out", self.held_out_error),
        ):  # fmt: skip
            known = [error for error in errors.values() if error is not None]
            if known:
                parts.append(f"tip error, {name}: {1e3 * sum(known) / len(known):.3g} mm")
        return wrapped("; ".join(parts))

    def __str__(self) -> str:
        rows: list[tuple[str, ...]] = [
            ("effect", "number", "unit", "nominal", "estimate", "95 % interval", "")
        ]
        for each in self.estimates:
            low, high = each.interval
            rows.append(
                (
                    each.effect, each.label, each.unit, f"{each.nominal:.4g}", f"{each.value:.4g}",
                    f"{low:.4g} to {high:.4g}", "held by its prior" if each.held else "",
                )
            )  # fmt: skip
        lines = _table(rows)
        lines.append("")
        errors: list[tuple[str, ...]] = [("tip error (mm)", "nominal", "identified", "held out")]
        for name in self.error:
            found = (self.nominal_error[name], self.error[name], self.held_out_error[name])
            errors.append((name, *("-" if error is None else f"{1e3 * error:.2f}" for error in found)))
        lines += _table(errors)
        lines += [f"- {step}" for step in self.steps]
        return "\n".join(lines)


def _table(rows: list[tuple[str, ...]]) -> list[str]:
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    lines = ["  ".join(map(str.ljust, row, widths)).rstrip() for row in rows]
    lines.insert(1, "  ".join("-" * width for width in widths if width))
    return lines
