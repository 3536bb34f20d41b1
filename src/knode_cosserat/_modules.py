"""Equinox modules from checked fields."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, TypeVar

import equinox as eqx

Module = TypeVar("Module", bound=eqx.Module)


def module_of(cls: type[Module], **fields: Any) -> Module:
    """Return a module from fields that need no check: Equinox's own take longer than several time steps."""
    found = object.__new__(cls)
    found.__dict__.update(_defaults(cls))
    found.__dict__.update(fields)
    return found


@functools.cache
def _defaults(cls: Any) -> dict[str, Any]:
    known = {field.name: field.default for field in dataclasses.fields(cls)}
    return {name: value for name, value in known.items() if value is not dataclasses.MISSING}
