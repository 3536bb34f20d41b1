"""Values of a recording's settings, checked: text, numbers, quaternions, intervals."""

from __future__ import annotations

import fractions
import math
from typing import Any

from knode_cosserat._files.yaml_text import shown
from knode_cosserat.recordings.findings import RecordingError

Vector = tuple[float, ...]
#: placeholder of the numbers in a command's text, or of the number or topic in a title
PLACE = "{}"


def checked_text(value: Any, name: str) -> str:
    """Return text on one line; `RecordingError` for anything else."""
    if not isinstance(value, str) or not value.strip() or not value.isprintable():
        raise RecordingError(f"{name} is {shown(value)}; allowed is text on one line")
    return value


def checked_choice(value: Any, name: str, allowed: Any) -> None:
    """Raise `RecordingError` unless the value is one of the allowed words."""
    if not isinstance(value, str) or value not in allowed:
        raise RecordingError(f"{name} is {shown(value)}; allowed is {' or '.join(allowed)}")


def checked_number(value: Any, name: str, low: float, high: float, unit: str = "") -> float:
    """Return a number between two limits; `RecordingError` for anything else."""
    number = _fraction(value)
    if number is None or not low <= number <= high:
        words = f"a number from {low:g} to {high:g} {unit}".strip()
        raise RecordingError(f"{name} is {shown(value)}; allowed is {words}")
    return number


def _fraction(value: Any) -> float | None:
    """Return a finite number, also from text such as 3/9; None for anything else."""
    try:
        if isinstance(value, str) and value.count("/") == 1 and len(value) < 40:
            return float(fractions.Fraction(value.replace(" ", "")))
        if isinstance(value, bool | str) or value is None:
            return None
        number = float(value)
    except (TypeError, ValueError, OverflowError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) else None


def checked_numbers(value: Any, name: str, count: int, words: str) -> Vector:
    """Return `count` numbers; `RecordingError` for anything else."""
    numbers = [_fraction(each) for each in value] if isinstance(value, list | tuple) else []
    if len(numbers) != count or None in numbers:
        raise RecordingError(f"{name} is {shown(value)}; allowed is {words}")
    return tuple(number for number in numbers if number is not None)


def checked_quaternion(value: Any, name: str) -> Vector:
    """Return a quaternion of length one; `RecordingError` for anything else."""
    words = "a quaternion of length 1, scalar first"
    numbers = checked_numbers(value, name, 4, words)
    size = math.hypot(*numbers)
    if abs(size - 1.0) > 1e-3:
        raise RecordingError(f"{name} is {shown(value)}; allowed is {words}")
    # a quaternion written with few digits has length 1 only to these digits
    return numbers if abs(size - 1.0) < 1e-12 else tuple(number / size for number in numbers)


def checked_order(value: Any) -> tuple[int, ...]:
    """Return the tendons 1, 2, 3, … in any order; `RecordingError` for anything else."""
    given = tuple(value) if isinstance(value, list | tuple) else ()
    whole = all(isinstance(each, int) and not isinstance(each, bool) for each in given)
    if not given or not whole or sorted(given) != list(range(1, len(given) + 1)):
        raise RecordingError(
            f"order is {shown(value)}; allowed is the tendons 1, 2, 3, … in the order of the wire"
        )
    return given


def checked_interval(value: Any, name: str, *, open_ended: bool) -> tuple[float | None, float | None]:
    """Return start and end (s), None where it is open; `RecordingError` for anything else."""
    words = "[start, end] in s, start before end" + (", either of them null" if open_ended else "")
    pair = list(value) if isinstance(value, list | tuple) else []
    ends = [None if end is None and open_ended else _fraction(end) for end in pair]
    wrong = [
        end is None and not (given is None and open_ended) for given, end in zip(pair, ends, strict=True)
    ]
    if len(ends) != 2 or any(wrong) or (None not in ends and not ends[0] < ends[1]):  # type: ignore[operator]
        raise RecordingError(f"{name} is {shown(value)}; allowed is {words}")
    return ends[0], ends[1]


def checked_column_titles(value: Any, name: str, counts: tuple[int, ...] | None = None) -> tuple[str, ...]:
    """Return titles, or numbers, of columns as text; `RecordingError` for another count of them."""
    given = tuple(value) if isinstance(value, list | tuple) else ()
    fair = all(isinstance(each, str | int) and not isinstance(each, bool) for each in given)
    titles = tuple(str(each).strip() for each in given)
    if not given or not fair or len(set(titles)) < len(titles) or (counts and len(given) not in counts):
        words = f"{' or '.join(map(str, counts))} titles" if counts else "a list of titles"
        raise RecordingError(f"{name} is {shown(value)}; allowed is {words} of columns, each once")
    return titles


def checked_titles(value: Any, name: str, count: int) -> tuple[str, ...]:
    """Return titles of columns, each with a place for a number or a topic."""
    given = tuple(value) if isinstance(value, list | tuple) else ()
    if len(given) != count or any(not isinstance(each, str) or each.count(PLACE) != 1 for each in given):
        words = "text" if count == 1 else f"{count} texts"
        raise RecordingError(f"{name} is {shown(value)}; allowed is {words}, with one {PLACE} in each")
    return given
