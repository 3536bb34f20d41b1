"""What the numbers of a packed vector are: y, z, a control, the tip's conditions."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np


class Field(NamedTuple):
    """A named part of y or z: its size, unit and meaning.

    `frame` names the orientation (a quaternion in y) by whose rotation a vector of the global frame is seen
    from the material; none for what is not turned. `load` is the unit of the load that the field's rate along
    s balances, such as N/m of an internal force, none for a field whose rate is geometry; of a strain, the
    unit of its stress. `low` and `high` are what a control has to stay between.
    """

    name: str
    size: int
    unit: str
    meaning: str
    frame: str = ""
    load: str = ""
    low: float = -np.inf
    high: float = np.inf


@dataclasses.dataclass(frozen=True)
class Layout:
    """The fields of a packed vector, in order."""

    fields: tuple[Field, ...]

    def __init__(self, *fields: tuple[Any, ...]):
        object.__setattr__(self, "fields", tuple(Field(*field) for field in fields))

    @property
    def size(self) -> int:
        """How many numbers a packed vector has."""
        return sum(field.size for field in self.fields)

    @property
    def names(self) -> tuple[str, ...]:
        """The fields' names, in order."""
        return tuple(field.name for field in self.fields)

    def slice(self, name: str) -> slice:
        """Where a field stands in a packed vector. `KeyError` if there is no such field."""
        start = 0
        for field in self.fields:
            if field.name == name:
                return slice(start, start + field.size)
            start += field.size
        raise KeyError(f"no field {name!r}; there are {', '.join(self.names)}")

    def get(self, packed: Any, name: str) -> Any:
        """One field of a packed vector (or of an array of them: the last axis is packed)."""
        where = self.slice(name)
        if isinstance(packed, jax.core.Tracer):  # brackets take ten times as long to trace
            return jax.lax.slice_in_dim(packed, where.start, where.stop, axis=-1)
        return packed[..., where]

    def split(self, packed: Any) -> tuple[Any, ...]:
        """All fields of a packed vector, in order."""
        return tuple(self.get(packed, field.name) for field in self.fields)

    def indices(self, names: tuple[str, ...]) -> np.ndarray:
        """Positions in the packed vector of the numbers of the named fields."""
        every = np.arange(self.size)
        return np.concatenate([every[self.slice(name)] for name in names])

    def replaced(self, packed: Any, names: tuple[str, ...], values: Any) -> Any:
        """Return a packed vector with other values of the named fields, given one after the other."""
        given, at = {}, 0
        for name in names:
            where = self.slice(name)
            given[name] = values[at : at + where.stop - where.start]
            at += where.stop - where.start
        # as a concatenation: XLA fuses it with what follows, unlike a scatter
        return jnp.concatenate([given.get(each.name, self.get(packed, each.name)) for each in self.fields])

    def beyond(self, packed: Any) -> str:
        """What of some controls (…, size) is outside its field's limits, in words; empty if nothing is."""
        for field in self.fields:
            values = np.asarray(self.get(packed, field.name))
            wrong = (values < field.low) | (values > field.high)
            if np.any(wrong):
                *row, k = (int(i) for i in np.argwhere(wrong)[0])
                name = field.name if field.size == 1 else f"{field.name}_{k + 1}"
                where = f" at index {tuple(row)}" if row else ""
                value = values[(*row, k)]
                limit = f"above {field.low:.6g}" if value < field.low else f"below {field.high:.6g}"
                return f"{name} is {value:.6g} {field.unit}{where}; allowed is {limit}"
        return ""

    def __add__(self, other: Layout) -> Layout:
        return Layout(*self.fields, *other.fields)
