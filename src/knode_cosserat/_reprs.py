"""Short texts of objects, for `repr`: the main values with their units, and no arrays at length."""

from __future__ import annotations

import contextlib
import dataclasses
import reprlib
import textwrap
from collections.abc import Iterable
from typing import Any

import jax
import numpy as np

#: largest number of characters in a line, and of numbers that are listed
WIDTH, MOST = 100, 6
#: numbers below this part of the largest beside them are shown as zero
ROUNDING = 1e-12
_SHOWN = (str, int, float, tuple, list, np.ndarray, np.generic, jax.Array)
#: a space at which a line does not break
_GLUE = "\u00a0"


def quantity(value: Any, unit: str = "", digits: int = 4) -> str:
    """Return a number, or a few, with the unit; for an array its range and shape. A tracer has no value."""
    if isinstance(value, jax.core.Tracer):
        return "traced"
    array = np.asarray(value)
    if array.dtype.kind not in "fiub":
        return reprlib.repr(value)
    shown = f" {unit}" if unit else ""
    if array.shape == (3, 3) and not np.any(array - np.diag(np.diag(array))):
        array = np.diag(array)
        if np.all(array == array[0]):
            return f"{array[0]:.{digits}g}{shown}"
    if array.ndim == 0:
        return f"{array:.{digits}g}{shown}"
    if array.ndim == 1 and array.size <= MOST:
        size = np.max(np.abs(array), initial=0.0)
        rounded = np.where(np.abs(array) < ROUNDING * size, 0.0, array)
        return "[" + ", ".join(f"{number:.{digits}g}" for number in rounded) + "]" + shown
    known = array[np.isfinite(array)]
    if not known.size:
        return f"no values {array.shape}"
    return f"{known.min():.{digits}g} to {known.max():.{digits}g}{shown} {array.shape}"


def field_text(value: Any, unit: str = "") -> str:
    """Return the text of a field: a number with its unit, words, or the classes of parts."""
    if isinstance(value, tuple | list) and not all(isinstance(one, int | float) for one in value):
        return "(" + ", ".join(map(field_text, value)) + ")"
    if isinstance(value, _SHOWN):
        return quantity(value, unit)
    return str(getattr(value, "__name__", type(value).__name__))


def object_text(owner: Any, units: dict[str, str], always: Iterable[str] = ()) -> str:
    """Return `Class(field=value unit, …)` of a dataclass, without the fields at their defaults.

    Args:
        owner: the object.
        units: units of its fields, by name.
        always: fields that are shown at their defaults too.
    """
    parts = []
    for field in dataclasses.fields(owner):
        value = getattr(owner, field.name, None)
        if value is None or (isinstance(value, tuple) and not value):
            continue
        if field.name not in always and _is_default(value, field.default):
            continue
        text = type(value).__name__
        # a field of a class that is not ours may hold anything; `repr` must not fail
        with contextlib.suppress(Exception):
            text = field_text(value, units.get(field.name, ""))
        parts.append(f"{field.name}={text}".replace(" ", _GLUE))
    return wrap_lines(f"{type(owner).__name__}({', '.join(parts)})")


def _is_default(value: Any, default: Any) -> bool:
    if default is dataclasses.MISSING or isinstance(value, jax.core.Tracer):
        return False
    with contextlib.suppress(Exception):
        return bool(np.array_equal(np.asarray(value), np.broadcast_to(np.asarray(default), np.shape(value))))
    return False


def wrap_lines(text: str) -> str:
    """Return a text in lines of at most `WIDTH` characters."""
    lines = textwrap.wrap(
        text, WIDTH, subsequent_indent="    ", break_long_words=False, break_on_hyphens=False
    )
    return "\n".join(lines).replace(_GLUE, " ")


def packed_text(layout: Any, packed: Any) -> str:
    """Return the fields of a packed vector, such as a control, with their units."""
    texts = [quantity(layout.get(packed, field.name), field.unit) for field in layout.fields]
    return ", ".join(f"{name} {text}" for name, text in zip(layout.names, texts, strict=True))


def robot_text(system: Any) -> str:
    """Return class, length and nodes of a system, such as "TendonRobot, 0.635 m, 10 nodes"."""
    text = type(system).__name__
    with contextlib.suppress(Exception):
        text += f", {quantity(system.length, 'm')}"
    return f"{text}, {getattr(system, 'nodes', 0)} nodes"


def count_of(number: int, noun: str, plural: str | None = None) -> str:
    """Return a number and its noun: "1 row", "2 rows"."""
    return f"{number} {noun if number == 1 else plural or noun + 's'}"
