"""Layouts of packed vectors: y, z, a control, the tip's conditions."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from knode_cosserat._numbers import real_array

#: units of displacements and rotations
MOVING = ("m", "rad")


class Field(NamedTuple):
    """A named part of y or z: its size, unit and meaning.

    `frame` names the orientation (a quaternion in y) whose rotation takes a vector of the global frame to the
    material frame; it is empty for a field that is not rotated. `load` is the unit of the load that balances
    the field's rate along s, such as N/m for an internal force. It is empty for a field whose rate is
    geometry. For a strain, it is the unit of its stress. `low` and `high` are a control's limits; `moves` is
    true for one that is no displacement or rotation, but cannot jump either, such as a velocity.
    """

    name: str
    size: int
    unit: str
    meaning: str
    frame: str = ""
    load: str = ""
    low: float = -np.inf
    high: float = np.inf
    moves: bool = False


@dataclasses.dataclass(frozen=True)
class Layout:
    """The fields of a packed vector, in order."""

    fields: tuple[Field, ...]

    def __init__(self, *fields: tuple[Any, ...]):
        object.__setattr__(self, "fields", tuple(Field(*field) for field in fields))

    @functools.cached_property
    def size(self) -> int:
        """Size of a packed vector."""
        return sum(field.size for field in self.fields)

    @property
    def moving(self) -> np.ndarray:
        """True for each number that cannot jump: displacements and rotations (in m or rad), and others."""
        return np.array(
            [field.unit in MOVING or field.moves for field in self.fields for _ in range(field.size)],
            dtype=bool,
        )

    @property
    def names(self) -> tuple[str, ...]:
        """The fields' names, in order."""
        return tuple(field.name for field in self.fields)

    def slice(self, name: str) -> slice:
        """Return the slice of a field in a packed vector. `KeyError` if there is no such field."""
        start = 0
        for field in self.fields:
            if field.name == name:
                return slice(start, start + field.size)
            start += field.size
        raise KeyError(f"no field {name!r}; there are {', '.join(self.names)}")

    def ranges(self, name: str) -> list[range]:
        """Return the places of the fields of this name, one of each rod of an assembly."""
        names = (each for each in self.names if each == name or each.endswith(f"_{name}"))
        return [range(self.slice(each).start, self.slice(each).stop) for each in names]

    def get(self, packed: Any, name: str) -> Any:
        """Return one field of a packed vector (or of an array of them: the last axis is packed)."""
        where = self.slice(name)
        if isinstance(packed, jax.core.Tracer):  # brackets take ten times as long to trace
            return jax.lax.slice_in_dim(packed, where.start, where.stop, axis=-1)
        return packed[..., where]

    @property
    def labels(self) -> list[str]:
        """Name of every number: its field's, numbered from 1 in a field of several."""
        return [
            field.name if field.size == 1 else f"{field.name}_{k + 1}"
            for field in self.fields
            for k in range(field.size)
        ]

    def numbers_of(self, values: Any) -> np.ndarray:
        """Return packed vectors (…, size) from numbers, or from a table by the names of its columns.

        A table (pandas, polars), or one row of it, has the columns `labels`, perhaps with units such as
        `tension_1 [N]`, in any order. Columns that are numbered, not named, keep their order.

        Raises:
            ValueError: no numbers, or other columns; a phrase that follows "they".
        """
        columns = getattr(values, "columns", getattr(values, "index", None))
        if columns is None or callable(columns) or not hasattr(values, "to_numpy"):
            return real_array(values)
        units = [field.unit for field in self.fields for _ in range(field.size)]
        places = {label: k for k, label in enumerate(self.labels)}
        places |= {
            f"{label} [{unit}]": k for (label, k), unit in zip(list(places.items()), units, strict=True)
        }
        if list(columns) == list(range(len(columns))):
            return real_array(values.to_numpy())
        order = [places.get(str(name), -1) for name in columns]
        if sorted(order) != list(range(self.size)):
            raise ValueError(
                f"their columns are {', '.join(map(str, columns))}; allowed are {', '.join(self.labels)}, "
                "once each"
            )
        return real_array(values.to_numpy())[..., np.argsort(order)]

    def split(self, packed: Any) -> tuple[Any, ...]:
        """Return all fields of a packed vector, in order."""
        return tuple(self.get(packed, field.name) for field in self.fields)

    def indices(self, names: tuple[str, ...]) -> np.ndarray:
        """Return the indices of the named fields in the packed vector."""
        every = np.arange(self.size)
        return np.concatenate([every[self.slice(name)] for name in names])

    def replaced(self, packed: Any, names: tuple[str, ...], values: Any) -> Any:
        """Return a packed vector with other values of the named fields; `values` is their concatenation."""
        parts, at = {}, 0
        for name in names:
            where = self.slice(name)
            parts[name] = values[at : at + where.stop - where.start]
            at += where.stop - where.start
        # as a concatenation: XLA fuses it with later operations, unlike a scatter
        return jnp.concatenate([parts.get(field.name, self.get(packed, field.name)) for field in self.fields])

    def beyond(self, packed: Any) -> str:
        """Describe the first control (…, size) outside its field's limits; empty if all are within."""
        for field in self.fields:
            if field.low == -np.inf and field.high == np.inf:
                continue
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
