"""Base of systems that wrap another one, such as a nominal model with a learned residual."""

from __future__ import annotations

import abc
import operator
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Self

import jax
import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.aspects import Drawing, Ends, Observed
from knode_cosserat.rods.parts import ease
from knode_cosserat.rods.strands import strand_count, strand_of
from knode_cosserat.rods.system import Discontinuities, System


def _member(path: str) -> Any:
    """Return a property: a member of the wrapped system."""
    return property(operator.attrgetter(path), doc=f"Member `{path}`.")


class Wrapped(System):
    """System that delegates its whole interface to another system; a subclass overrides what it changes.

    A subclass has the wrapped system as its field `knowledge`, and defines `around`. Layouts are those of
    `knowledge`. Equations are those of `adapted`, which is `knowledge` unless the subclass changes its
    parameters. `adapted` does not exist for a batch.
    """

    if TYPE_CHECKING:  # a field of every subclass
        knowledge: System

    y_layout = _member("knowledge.y_layout")
    z_layout = _member("knowledge.z_layout")
    control_layout = _member("knowledge.control_layout")
    base_unknowns = _member("knowledge.base_unknowns")
    mixed = _member("knowledge.mixed")
    winding = _member("knowledge.winding")
    needed_nodes = _member("knowledge.needed_nodes")
    constitutive = _member("adapted.constitutive")
    balance = _member("adapted.balance")
    rest = _member("adapted.rest")
    base = _member("adapted.base")
    tip = _member("adapted.tip")
    scales = _member("adapted.scales")

    @abc.abstractmethod
    def around(self, knowledge: System) -> Self:
        """Return a copy of this system around another wrapped system."""

    @property
    def adapted(self) -> System:
        """Wrapped system with the parameters of the equations."""
        return self.knowledge

    @property
    def corrections(self) -> tuple[Callable[..., Float[Any, " y+z"]], ...]:
        """Functions of (s, t, y, y_t, z, z_t, control) whose values add to [y_s; z] in turn.

        z is that of `constitutive`, then with the corrections before.
        """
        return corrections_of(self.adapted)

    @property
    def discontinuities(self) -> Discontinuities:  # type: ignore[override]
        """Places of the wrapped system, and its jump with the parameters of the equations."""
        places, jump = self.knowledge.discontinuities
        if jump is None:
            return Discontinuities(places)
        return Discontinuities(places, lambda *terms: self.adapted.discontinuities.jump(*terms))

    @property  # type: ignore[misc]
    def length(self) -> Any:
        """Length of the rod (m); one value each in a batch."""
        if np.ndim(self.knowledge.length):
            return jax.vmap(lambda system: system.adapted.length)(self)
        return self.adapted.length

    def replace(self, **changes: Any) -> Self:
        """Return a copy in which the wrapped system has other parameters (or nodes), by name."""
        return self.around(self.knowledge.replace(**changes))


def nominal_model(system: System) -> Any:
    """Return the innermost wrapped system, whose parameters `replace` changes; else the system itself."""
    while isinstance(system, Wrapped):
        system = system.knowledge
    return system


def corrections_of(system: System) -> tuple[Callable[..., Float[Any, " y+z"]], ...]:
    """Return the corrections of a wrapped system; none for others."""
    return system.corrections if isinstance(system, Wrapped) else ()


def with_length_factor(system: System, factor: Any) -> System:
    """Return the system with the length of its nominal model multiplied by a factor."""
    return system.replace(length=nominal_model(system).length * factor)


Ends.register(Wrapped, lambda system: Ends.of(system.knowledge))
Drawing.register(Wrapped, lambda system: Drawing.of(system.knowledge))
Observed.register(Wrapped, lambda system: Observed.of(system.adapted))


@strand_count.register
def _(system: Wrapped) -> int:
    return strand_count(system.knowledge)


@strand_of.register
def _(system: Wrapped) -> System:
    return system if strand_count(system) == 1 else system.around(strand_of(system.knowledge))


@ease.register
def _(system: Wrapped, part: float) -> Wrapped:
    easier = ease(system.knowledge, part)
    return system if easier is system.knowledge else system.around(easier)
