"""Base of systems that wrap another one, such as a nominal model with a learned residual."""

from __future__ import annotations

import abc
import inspect
from typing import TYPE_CHECKING, Any, Self

import jax
import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.parts import eased
from knode_cosserat.rods.system import System

#: members of `Wrapped.knowledge`: layouts, and facts that no parameter of the equations changes
FACTS = (
    "y_layout", "z_layout", "control_layout", "base_unknowns", "mixed", "cuts", "strands", "nominal", "ends",
    "drawing",
)  # fmt: skip
#: members of `Wrapped.adapted`: equations and other members that depend on parameters
EQUATIONS = ("constitutive", "balance", "corrections", "base", "scales", "observed")


class Wrapped(System):
    """System that delegates its whole interface to another system; a subclass overrides what it changes.

    A subclass has the wrapped system as its field `knowledge`, and defines `around`. `FACTS` are those of
    `knowledge`. `EQUATIONS` are those of `adapted`, which is `knowledge` unless the subclass changes its
    parameters. `adapted` does not exist for a batch.
    """

    if TYPE_CHECKING:  # a field of every subclass
        knowledge: System

    @abc.abstractmethod
    def around(self, knowledge: System) -> Self:
        """Return a copy of this system around another wrapped system."""

    @property
    def adapted(self) -> System:
        """Wrapped system with the parameters of the equations."""
        return self.knowledge

    @property
    def strand(self) -> System:
        """Strand of the wrapped system, wrapped too."""
        return self if self.strands == 1 else self.around(self.knowledge.strand)

    @property  # type: ignore[misc]
    def length(self) -> Any:
        """Length of the rod (m); one value each in a batch."""
        if np.ndim(self.knowledge.length):
            return jax.vmap(lambda system: system.adapted.length)(self)
        return self.adapted.length

    def rest(self, s: Any) -> tuple[Float[Any, " y"], Float[Any, " z"]]:
        """Return the state at rest of the wrapped system."""
        return self.adapted.rest(s)

    def tip(self, t: Any, control: Any, y: Float[Any, " y"], y_t: Float[Any, " y"]) -> Float[Any, " k"]:
        """Return the residuals of the boundary conditions at the tip, from the wrapped system."""
        return self.adapted.tip(t, control, y, y_t)

    @property
    def jump(self) -> Any:
        """Jump of the wrapped system; None if its y does not jump."""
        return None if self.knowledge.jump is None else self.adapted.jump

    def replace(self, **changes: Any) -> Self:
        """Return a copy in which the wrapped system has other parameters (or nodes), by name."""
        return self.around(self.knowledge.replace(**changes))


def _delegated(name: str, owner: str) -> Any:
    """Return a method, or a property, that is that of the wrapped system."""
    stated = inspect.getattr_static(System, name, None)
    if not inspect.isfunction(stated):
        return property(lambda self: getattr(getattr(self, owner), name), doc=inspect.getdoc(stated))

    def method(self: Wrapped, *arguments: Any, **options: Any) -> Any:
        return getattr(getattr(self, owner), name)(*arguments, **options)

    method.__name__, method.__qualname__, method.__doc__ = name, f"Wrapped.{name}", stated.__doc__
    return method


for _owner, _names in (("knowledge", FACTS), ("adapted", EQUATIONS)):
    for _name in _names:
        setattr(Wrapped, _name, _delegated(_name, _owner))


@eased.register
def _(system: Wrapped, part: float) -> Wrapped:
    easier = eased(system.knowledge, part)
    return system if easier is system.knowledge else system.around(easier)
