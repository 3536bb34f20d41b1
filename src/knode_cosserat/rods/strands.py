"""Systems of several identical rods that are joined at their ends only."""

from __future__ import annotations

import abc
import functools
from typing import Any, ClassVar

from knode_cosserat.rods.layout import Field, Layout
from knode_cosserat.rods.system import System


def in_strands(system: System, packed: Any) -> Any:
    """Return a packed y, z or vector of unknowns (…, n) split by strand: (…, strands, n / strands)."""
    return packed.reshape(*packed.shape[:-1], system.strands, packed.shape[-1] // system.strands)


class Bundle(System):
    """Identical rods in parallel: y, z and the unknowns hold the values of the first rod, then of the next.

    A subclass defines `strand` (the equations along a rod), `strands`, `rest`, `base`, `tip` and its other
    particulars. A field's name is the strand's with the rod's number appended: `p1`, `n6`.
    """

    #: the strand's class: a batch of robots has only this, no `strand`
    strand_class: ClassVar[type[System]]

    @property
    @abc.abstractmethod
    def strand(self) -> System:
        """Equations along a rod; all rods share them."""

    @property
    def y_layout(self) -> Layout:  # type: ignore[override]
        """The strand's layout of y, numbered for each rod."""
        return numbered(self.strand_class.y_layout, self.strands)

    @property
    def z_layout(self) -> Layout:  # type: ignore[override]
        """The strand's layout of z, numbered for each rod."""
        return numbered(self.strand_class.z_layout, self.strands)

    @property
    def base_unknowns(self) -> tuple[str, ...]:  # type: ignore[override]
        """The strand's unknown fields at the base, numbered for each rod."""
        names = self.strand_class.base_unknowns
        return tuple(f"{name}{k + 1}" for k in range(self.strands) for name in names)

    @property
    def mixed(self) -> bool:  # type: ignore[override]
        """True if B of the strand is not zero."""
        return self.strand_class.mixed


@functools.lru_cache(maxsize=64)
def numbered(layout: Layout, count: int) -> Layout:
    """Return the fields of `count` strands with this layout."""

    def field(given: Field, k: int) -> Field:
        frame = f"{given.frame}{k}" if given.frame else ""
        return given._replace(name=f"{given.name}{k}", meaning=f"{given.meaning}, {k}", frame=frame)

    return Layout(*(field(given, k + 1) for k in range(count) for given in layout.fields))
