"""Parameters of a robot and of its parts, by names with dots such as `loads.0.mass`."""

from __future__ import annotations

import dataclasses
from typing import Any

from knode_cosserat.rods.parameters import Parameter, ParameterError, parameters_of


def value_at(owner: Any, path: str) -> Any:
    """Return a parameter, or a part, at a path such as `loads.0.mass`.

    Raises:
        ParameterError: it does not exist; the message lists the names that do.
    """
    for part in path.split("."):
        owner = _entry(owner, part, path)
    return owner


def owner_at(owner: Any, path: str) -> tuple[Any, str]:
    """Return the robot or part that a parameter belongs to, and the parameter's own name.

    Raises:
        ParameterError: there is no such part.
    """
    place, _, last = path.rpartition(".")
    return (value_at(owner, place) if place else owner), last


def parameter_at(owner: Any, path: str) -> Parameter | None:
    """Return the statement of a parameter; None if there is no such parameter or part."""
    try:
        found, name = owner_at(owner, path)
    except ParameterError:
        return None
    return parameters_of(type(found)).get(name) if dataclasses.is_dataclass(found) else None


def with_value(owner: Any, path: str, value: Any, name: str) -> Any:
    """Return a part, or a tuple of parts, with another value at a path such as `0.mass`.

    `name` is the whole name, for the error.
    """
    first, _, rest = path.partition(".")
    inner = _entry(owner, first, name)
    changed = with_value(inner, rest, value, name) if rest else value
    if isinstance(owner, tuple):
        return tuple(changed if k == int(first) else each for k, each in enumerate(owner))
    return dataclasses.replace(owner, **{first: changed})


def _entry(owner: Any, part: str, name: str) -> Any:
    """Return a field of a robot or part, or an entry of a tuple of parts. Raises `ParameterError`."""
    several = isinstance(owner, tuple)
    stated = dataclasses.fields(owner) if dataclasses.is_dataclass(owner) else ()
    known = [str(k) for k in range(len(owner))] if several else [field.name for field in stated]
    if part not in known:
        raise ParameterError(
            f"there is no parameter {name!r}: no {part!r} among {', '.join(known) or 'nothing'}"
        )
    return owner[int(part)] if several else getattr(owner, part)
