"""Constitutive laws at one point of a rod, stated in time: they contain rates, and no time scheme.

A system states its law in one of these forms (`System.constitutive`):

    LinearLaw     C z + D z_t = f2, the general class
    MaterialLaw   K ε + B ε_t + … = σ for each strain ε of z, and laws of evolution for internal variables
    StressedLaw   one of these, with another stress of all of z and z_t
    JointLaw      laws of several rods, whose z follow one another
    an array      z itself, if it depends on no rate of z
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.tree_util import Partial
from jaxtyping import Float

from knode_cosserat.rods.layout import Layout
from knode_cosserat.rotation import dot, inverse

#: values of fields of z, by name
Fields = dict[str, Any]


class LinearLaw(NamedTuple):
    """C z + D z_t = f2 (paper's general class)."""

    C: Float[Any, "z z"]
    D: Float[Any, "z z"]
    f2: Float[Any, " z"]


class Evolution(NamedTuple):
    """Law of an internal variable x: x_t = rate while low < x < high."""

    rate: Any
    #: value in an equilibrium, where no rate determines it
    at_rest: Any
    low: float
    high: float


class MaxwellBranch(NamedTuple):
    """A spring in series with a dashpot, beside a strain's law: it adds r K (ε - x), with T x_t = ε - x."""

    #: field of z with the dashpot's strain x
    field: str
    #: r K (N, N m²)
    stiffness: Float[Any, "3 3"]
    #: relaxation time T (s)
    time: Any


class Viscoelastic(NamedTuple):
    """Law of one strain ε: (K - softening) ε + B ε_t + branch + moment(ε, ε_t) = stress."""

    stiffness: Float[Any, "3 3"]
    damping: Float[Any, "3 3"]
    stress: Float[Any, "3"]
    #: loss of stiffness that depends on the state; None: none
    softening: Any = None
    branch: MaxwellBranch | None = None
    #: nonlinear part of ε and ε_t, a pytree (`jax.tree_util.Partial`); None: none
    moment: Any = None

    @property
    def softened(self) -> Float[Any, "3 3"]:
        """Stiffness less the softening."""
        return self.stiffness if self.softening is None else self.stiffness - self.softening

    def soften(self, loss: Float[Any, "3 3"]) -> Viscoelastic:
        """Return the law with another loss of stiffness."""
        return self._replace(softening=loss if self.softening is None else self.softening + loss)


class Elastic(NamedTuple):
    """Elastic law of one strain ε: (K - softening) ε = stress."""

    stiffness: Float[Any, "3 3"]
    stress: Float[Any, "3"]
    softening: Any = None

    @property
    def softened(self) -> Float[Any, "3 3"]:
        """Stiffness with the softening."""
        return self.stiffness if self.softening is None else self.stiffness - self.softening

    def strain(self) -> Float[Any, "3"]:
        """Return ε."""
        return dot(inverse(self.softened), self.stress)

    def residual(self, strain: Float[Any, "3"]) -> Float[Any, "3"]:
        """Return K ε less the stress, at any ε."""
        return dot(self.softened, strain) - self.stress


class MaterialLaw(NamedTuple):
    """Laws of the strains of z, with their coupling, and of internal variables that depend on them."""

    strains: dict[str, Viscoelastic]
    #: nonlinear elastic part that couples the strains, such as `tendon_law.Tendons`: `strains` of the elastic
    #: laws with it, and its `stresses` for strains
    coupling: Any = None
    #: evolutions by field of z, from the strains and their rates
    internal: Callable[[Fields, Fields], dict[str, Evolution]] | None = None

    def with_strain(self, name: str, strain: Viscoelastic) -> MaterialLaw:
        """Return the law with another law of one strain.

        The strains are "v" of shear and extension, and "u" of bending and twisting.

        Raises:
            ValueError: a strain that the law has not, or a moment that is no `Partial` or no vector.
        """
        if name not in self.strains:
            raise ValueError(f"strain is {name!r}; allowed is {', '.join(self.strains)}")
        if strain.moment is not None:
            _check_moment(strain.moment)
        return self._replace(strains={**self.strains, name: strain})

    def with_internal(self, internal: Callable[[Fields, Fields], dict[str, Evolution]]) -> MaterialLaw:
        """Return the law with further internal variables that depend on the strains and their rates."""
        others = self.internal
        if others is None:
            return self._replace(internal=internal)
        return self._replace(internal=lambda *strains: others(*strains) | internal(*strains))


def _check_moment(moment: Any) -> None:
    if not isinstance(moment, Partial):
        raise ValueError(
            "moment is a function; allowed is jax.tree_util.Partial(function, parameters), which is called as"
            " function(parameters, strain, rate), so that derivatives reach the parameters"
        )
    found = jax.eval_shape(moment, jnp.zeros(3), jnp.zeros(3))
    if getattr(found, "shape", None) != (3,):
        raise ValueError(f"moment returns {found}; allowed is an array of shape (3,)")


class InternalState(NamedTuple):
    """Internal variables that depend on y and control only, and the law of the strains under their values."""

    evolutions: dict[str, Evolution]
    law: Callable[[Fields], MaterialLaw]


class StressedLaw(NamedTuple):
    """A law with another stress: (residual of the law) + stress(z, z_t) = 0."""

    law: Any
    #: stress (z,) of z and z_t, in the units of the law's rows
    stress: Callable[[Any, Any], Float[Any, " z"]]
    #: True if the stress is linear
    linear: bool = False


class JointLaw(NamedTuple):
    """Laws of several rods at one place of the grid; z holds that of the first rod, then of the next."""

    #: laws of the rods, with the layout of z and the length (m) of each
    laws: tuple[tuple[Any, Layout, Any], ...]
