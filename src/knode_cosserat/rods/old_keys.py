"""Conversion of the keys of robot files from earlier versions to today's."""

from __future__ import annotations

from typing import Any, TypeGuard

#: parts of routed tendon robots that used to be parameters: key of the part, today's parameter names
_PARTS = {
    "friction": {
        "friction_wobble": "wobble", "friction_curvature": "curvature", "friction_reach": "reach",
        "friction_at_rest": "at_rest",
    },
    "vibration": {
        "vibration_tension": "tension", "vibration_rate": "rate", "vibration_softening": "softening",
    },
}  # fmt: skip
#: a robot had the part if one of these had a value
_PRESENT = {"friction": ("friction_wobble", "friction_curvature"), "vibration": ("vibration_rate",)}


def upgraded(kind: str, values: dict[Any, Any]) -> dict[Any, Any]:
    """Return the parameters of a file with today's keys: friction, vibration and sleeve are parts.

    Friction and vibration act as before. A sleeve now stiffens shear and extension too; it used to stiffen
    bending and torsion only.
    """
    old = {key for names in _PARTS.values() for key in names} | {"sleeve_stiffening", "sleeve_length"}
    if kind != "routed-tendon-robot" or not old & set(values):
        return values
    new = {key: value for key, value in values.items() if key not in old}
    for part, names in _PARTS.items():
        given = {name: values[key] for key, name in names.items() if values.get(key) is not None}
        if part not in new and any(values.get(key) is not None for key in _PRESENT[part]):
            new[part] = {"kind": {"friction": "tendon-friction"}.get(part, part), **given}
    if values.get("sleeve_stiffening") is not None:
        reach, length = values.get("sleeve_length", 0.05), values.get("length")
        share = reach / length if _is_positive(reach) and _is_positive(length) else reach
        sleeve = {"kind": "sleeve", "stiffening": values["sleeve_stiffening"], "length": share}
        new["sections"] = [*(new.get("sections") or []), sleeve]
    return new


def _is_positive(value: Any) -> TypeGuard[float]:
    return isinstance(value, int | float) and not isinstance(value, bool) and value > 0
