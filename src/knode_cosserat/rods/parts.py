"""Parts of a robot: routings of tendons, loads, ends, obstacles, sections. Each is a small class of a family.

A family is an abstract class. Its subclasses with a `kind` can be named in a robot's file. A part has its own
parameters, and may be driven by entries of the robot's control.
"""

from __future__ import annotations

import inspect
from typing import Any, ClassVar

from knode_cosserat.rods.layout import Field
from knode_cosserat.rods.parameters import ParameterError, Parametrised, check_fields


class Part(Parametrised):
    """Base class of parts."""

    #: name in robot files; empty if the part cannot be written to one
    kind: ClassVar[str] = ""

    @property
    def control_fields(self) -> tuple[Field, ...]:
        """Fields of the robot's control that drive this part; the robot prefixes their names."""
        return ()

    def __check_init__(self) -> None:
        try:
            check_fields(self)
        except ParameterError as error:
            raise ParameterError(f"{type(self).__name__}: {error}") from None


def require_stretch(begin: Any, end: Any, who: str) -> None:
    """Raise `ParameterError` unless a section of the rod ends beyond its beginning."""
    if not end > begin:
        raise ParameterError(f"{who}: end is {end:g}; allowed is a place beyond begin, {begin:g}")


def kinds_of(family: type) -> dict[str, type[Part]]:
    """Return the classes of a family that robot files can name: the family and its subclasses."""
    found: dict[str, type[Part]] = {}
    cls: Any = family
    each: Any
    if getattr(cls, "kind", "") and not inspect.isabstract(cls):
        found[cls.kind] = cls
    for each in family.__subclasses__():
        found |= kinds_of(each)
    return dict(sorted(found.items()))


def prefixed_fields(fields: tuple[Field, ...], prefix: str) -> tuple[Field, ...]:
    """Return fields with their part's prefix before their names."""
    return tuple(field._replace(name=f"{prefix}_{field.name}") for field in fields)


def shares(parts: tuple[Any, ...], first: int) -> list[slice]:
    """Return each part's slice of the robot's control; the first begins at `first`."""
    found = []
    for each in parts:
        last = first + sum(field.size for field in each.control_fields)
        found.append(slice(first, last))
        first = last
    return found
