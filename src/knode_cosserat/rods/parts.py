"""Parts of a robot: routings of tendons, loads, ends, obstacles, sections. Each is a small class of a family.

A family is an abstract class; what can stand in a robot's file is its subclasses with a `kind`. A part has
parameters of its own, and may be driven by numbers of the robot's control.
"""

from __future__ import annotations

import inspect
from typing import Any, ClassVar

from knode_cosserat.rods.layout import Field
from knode_cosserat.rods.parameters import ParameterError, Parametrised, check_fields


class Part(Parametrised):
    """What all parts have in common."""

    #: how robot files call it; none: it cannot be written to one
    kind: ClassVar[str] = ""

    @property
    def control_fields(self) -> tuple[Field, ...]:
        """What of the robot's control is this part's own; the robot puts its place before the names."""
        return ()

    def __check_init__(self) -> None:
        try:
            check_fields(self)
        except ParameterError as error:
            raise ParameterError(f"{type(self).__name__}: {error}") from None


def require_stretch(begin: Any, end: Any, who: str) -> None:
    """Raise `ParameterError` unless a stretch of the rod ends beyond where it begins."""
    if not end > begin:
        raise ParameterError(f"{who}: end is {end:g}; allowed is a place beyond begin, {begin:g}")


def kinds_of(family: type) -> dict[str, type[Part]]:
    """The classes of a family that robot files can name."""
    found: dict[str, type[Part]] = {}
    cls: Any
    for cls in family.__subclasses__():
        found |= kinds_of(cls)
        if getattr(cls, "kind", "") and not inspect.isabstract(cls):
            found[cls.kind] = cls
    return dict(sorted(found.items()))


def placed(fields: tuple[Field, ...], prefix: str) -> tuple[Field, ...]:
    """Fields with the place of their part before their names."""
    return tuple(field._replace(name=f"{prefix}_{field.name}") for field in fields)


def shares(parts: tuple[Any, ...], first: int) -> list[slice]:
    """Where the control of each part stands in the robot's, the first one's at `first`."""
    found = []
    for each in parts:
        last = first + sum(field.size for field in each.control_fields)
        found.append(slice(first, last))
        first = last
    return found
