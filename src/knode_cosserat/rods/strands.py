"""Systems of several identical rods that are joined at their ends only, such as the legs of a platform."""

from __future__ import annotations

import abc
import functools
from typing import Any, ClassVar

from knode_cosserat.rods.layout import Layout
from knode_cosserat.rods.system import System, array_module


@functools.singledispatch
def strand_count(system: Any) -> int:
    """Return the number of identical rods of a system, joined at their ends only; 1 but for a `Bundle`."""
    return 1


@functools.singledispatch
def strand_of(system: Any) -> Any:
    """Return the system of one strand, for its equations along the rod; it receives the whole control."""
    return system


def in_strands(system: System, packed: Any) -> Any:
    """Return a packed y, z or vector of unknowns (…, n) split by strand: (…, strands, n / strands)."""
    count = strand_count(system)
    return packed.reshape(*packed.shape[:-1], count, packed.shape[-1] // count)


def of_rods(system: System, y: Any, name: str) -> Any:
    """Return a field of y of all strands, or rods of an assembly: (…, y) becomes (…, rods, size)."""
    strands, places = in_strands(system, y), strand_of(system).y_layout.ranges(name)
    numeric = array_module(y)
    return numeric.concatenate([strands[..., rows.start : rows.stop] for rows in places], axis=-2)


class Bundle(System):
    """Identical rods in parallel: y, z and the unknowns hold the values of the first rod, then of the next.

    A subclass defines `strand` (the equations along a rod), `strands`, `rest`, `base`, `tip` and its other
    particulars. A field's name is the strand's with the rod's number appended: `p1`, `n6`.
    """

    #: the strand's class: a batch of robots has only this, no `strand`
    strand_class: ClassVar[type[System]]

    @property
    @abc.abstractmethod
    def strands(self) -> int:
        """Number of rods."""

    @property
    @abc.abstractmethod
    def strand(self) -> System:
        """Equations along a rod; all rods share them."""

    @property
    def y_layout(self) -> Layout:  # type: ignore[override]
        """The strand's layout of y, numbered for each rod."""
        return number_fields(self.strand_class.y_layout, self.strands)

    @property
    def z_layout(self) -> Layout:  # type: ignore[override]
        """The strand's layout of z, numbered for each rod."""
        return number_fields(self.strand_class.z_layout, self.strands)

    @property
    def base_unknowns(self) -> tuple[str, ...]:  # type: ignore[override]
        """The strand's unknown fields at the base, numbered for each rod."""
        names = self.strand_class.base_unknowns
        return tuple(f"{name}{k + 1}" for k in range(self.strands) for name in names)

    @property
    def mixed(self) -> bool:  # type: ignore[override]
        """True if B of the strand is not zero."""
        return self.strand_class.mixed


@strand_count.register
def _(system: Bundle) -> int:
    return system.strands


@strand_of.register
def _(system: Bundle) -> System:
    return system.strand


@functools.lru_cache(maxsize=64)
def number_fields(layout: Layout, count: int) -> Layout:
    """Return the fields of `count` strands with this layout."""
    return Layout(
        *(
            field._replace(
                name=f"{field.name}{k}",
                meaning=f"{field.meaning}, {k}",
                frame=field.frame and f"{field.frame}{k}",
            )
            for k in range(1, count + 1)
            for field in layout.fields
        )
    )
