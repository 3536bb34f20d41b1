"""The general class of Cosserat-rod systems.

    A y_s + B y_st = f1,     C z + D z_t = f2

A system defines the layouts of y and z, these terms (or y_s and z directly), the boundary conditions at base
and tip, and the unknowns at the base. It does not depend on the nodes in between, time steps or solvers: its
equations receive rates in time, which a solver forms (`schemes.semi_discrete`).
"""

from __future__ import annotations

import abc
import dataclasses
import math
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.law import InternalState, MaterialLaw, StressedLaw
from knode_cosserat.rods.layout import Layout
from knode_cosserat.rods.parameters import (
    ParameterError,
    Parametrised,
    check_fields,
    parameters_of,
    unknown_parameter,
    with_value,
)

if TYPE_CHECKING:
    from knode_cosserat.rods.passport import Passport

#: smallest and largest number of nodes of a rod, and the number that is chosen if its parts need no more
FEWEST_NODES, MOST_NODES, USUAL_NODES = 2, 10_000, 10
#: angle (rad) through which parts turn in one segment: of the nodes that are chosen, and the largest at which
#: an estimate of errors sees the turns
CHOSEN_TURN, SEEN_TURN = math.pi / 3.0, math.pi


class ChosenNodes(int):
    """Number of nodes that the user did not state: solvers may refine it."""


class Scales(NamedTuple):
    """Natural sizes of the numbers in y (y,) and of the tip's residuals (k,), for scaled tolerances."""

    y: Float[Any, " y"]
    tip: Float[Any, " k"]


class Discontinuities(NamedTuple):
    """Places where the right-hand side or y is discontinuous."""

    #: fractions of the length, between 0 and 1, in order
    places: tuple[float, ...] = ()
    #: function (acting, t, y, y_t, control) that returns y on the far side of the acting places (ones; zeros
    #: elsewhere) from y on the near side; None if y does not jump
    jump: Any = None


class System(Parametrised):
    """A rod robot: A y_s + B y_st = f1, C z + D z_t = f2 (paper eq. 1, general class).

    A subclass defines its layouts and `base_unknowns`, its `length`, `constitutive` and `balance`, `rest` and
    `tip`; most define `scales` too, and `mixed` where B is zero. Classes beside it state what differs from
    the defaults: `aspects` for its ends, drawing and observables, `Bundle` for several rods, and `Wrapped`
    for learned residuals.

    Its numeric parameters are leaves of a JAX pytree: one compiled program serves all their values, batches,
    and derivatives.
    """

    y_layout: ClassVar[Layout]
    z_layout: ClassVar[Layout]
    control_layout: ClassVar[Layout]
    #: unknown fields of y at the base; the number of tip conditions is equal
    base_unknowns: ClassVar[tuple[str, ...]]
    #: True if B is not zero: time schemes then store y_s
    mixed: ClassVar[bool] = True
    discontinuities: ClassVar[Discontinuities] = Discontinuities()

    if TYPE_CHECKING:  # every system has a length (m) among its own parameters
        length: Any
    #: number of nodes of the rod, both ends included; by default `needed_nodes`, as `ChosenNodes`
    nodes: int = eqx.field(static=True, default=None, kw_only=True)
    #: what it was learned from, and the range of controls and strains there; None if it was not
    passport: Passport | None = eqx.field(default=None, kw_only=True)

    # the equations

    def constitutive(
        self, s: Any, t: Any, y: Float[Any, " y"], y_t: Float[Any, " y"], control: Any
    ) -> tuple[Any, Any, Any] | MaterialLaw | InternalState | StressedLaw | Float[Any, " z"]:
        """Return C (z, z), D (z, z) and f2 (z,) of C z + D z_t = f2, at arclength s (m) and time t (s).

        A law of another form is a `MaterialLaw`. If z depends on no rate of z, it may be returned itself.
        """
        raise NotImplementedError(f"{type(self).__name__} gives no `constitutive`")

    def balance(
        self,
        s: Any,
        t: Any,
        y: Float[Any, " y"],
        y_t: Float[Any, " y"],
        z: Float[Any, " z"],
        z_t: Float[Any, " z"],
        control: Any,
    ) -> tuple[Any, Any, Any] | Float[Any, " y"]:
        """Return A (y, y), B (y, y) and f1 (y,) of A y_s + B y_st = f1, at arclength s (m) and time t (s).

        If B is zero, y_s may be returned itself.
        """
        raise NotImplementedError(f"{type(self).__name__} gives no `balance`")

    # the two ends, and rest

    @abc.abstractmethod
    def rest(self, s: Any) -> tuple[Float[Any, " y"], Float[Any, " z"]]:
        """Return y and z at arclength s (m) of the unloaded robot at rest: the default initial state."""

    def base(self, t: Any, control: Any, unknowns: Float[Any, " k"]) -> Float[Any, " y"]:
        """Return y at s = 0: the values at rest, with the unknowns in their places."""
        fixed, _ = self.rest(jnp.zeros(()))
        return self.y_layout.replaced(jnp.asarray(fixed), self.base_unknowns, unknowns)

    @abc.abstractmethod
    def tip(self, t: Any, control: Any, y: Float[Any, " y"], y_t: Float[Any, " y"]) -> Float[Any, " k"]:
        """Return the residuals of the boundary conditions at s = length, as many as there are unknowns."""

    def scales(self) -> Scales:
        """Return the natural sizes of y and of the tip's residuals; ones by default."""
        return Scales(jnp.ones(self.y_layout.size), jnp.ones(unknown_count(self)))

    # the grid

    @property
    def winding(self) -> float:
        """Angle (rad) through which parts turn along the rod at rest, at their highest rate, such as helices.

        Parameters that are traced count as zero.
        """
        return 0.0

    @property
    def needed_nodes(self) -> int:
        """Number of nodes that the parts need."""
        return max(USUAL_NODES, 1 + math.ceil(self.winding / CHOSEN_TURN))

    def replace(self, **changes: Any) -> Self:
        """Return a copy with other parameters, by name; derived quantities follow.

        The nodes stay, unless other parts need more and nobody stated them.

        Parameters of parts have names with dots. One of several parts is named by its number, or by its kind
        if no other is of that kind: `base_end.position`, `loads.0.mass`, `loads.attached-mass.mass`. They are
        passed as `replace(**{"loads.0.mass": 0.1})`.

        Raises `ParameterError` for a name that does not exist or a value that is not allowed. Values may be
        JAX tracers: `replace` is differentiable with respect to a parameter.
        """
        for name in [name for name in changes if "." in name]:
            first, _, rest = name.partition(".")
            owner = changes.get(first, getattr(self, first, None))
            changes[first] = with_value(owner, rest, changes.pop(name), name)
        known = parameters_of(type(self))
        settable = [*known, *(f.name for f in dataclasses.fields(self) if f.name not in known)]
        for name in changes:
            if name not in settable:
                raise ParameterError(unknown_parameter(type(self), name, settable))
        return dataclasses.replace(self, **changes)

    def __check_init__(self) -> None:
        check_fields(self)
        count: Any = self.nodes
        if count is None or isinstance(count, ChosenNodes):
            count = min(MOST_NODES, max(count or 0, self.needed_nodes))
            object.__setattr__(self, "nodes", ChosenNodes(count))
        elif not isinstance(count, int) or not FEWEST_NODES <= self.nodes <= MOST_NODES:
            raise ParameterError(
                f"nodes is {self.nodes!r}; allowed is a whole number from {FEWEST_NODES} to {MOST_NODES}"
            )


def nodes_text(system: System) -> str:
    """Return the number of nodes in words, and whether it was chosen."""
    return f"{system.nodes} nodes" + (", chosen" if isinstance(system.nodes, ChosenNodes) else "")


def unknowns_of(system: System, y: Float[Any, "*n y"]) -> Float[Any, "*n k"]:
    """Return the unknowns of y at s = 0: the inverse of `System.base`."""
    return y[..., system.y_layout.indices(system.base_unknowns)]


def unknown_count(system: System) -> int:
    """Return the number of unknowns at the base."""
    return len(system.y_layout.indices(system.base_unknowns))


def is_traced(tree: Any) -> bool:
    """True if any leaf is a JAX tracer: inside `jit`, `grad` or `vmap` values are not available."""
    # the instance check of JAX's abstract class takes ten times as long
    return any(jax.core.Tracer in type(leaf).__mro__ for leaf in jax.tree.leaves(tree))


def array_module(tree: Any) -> Any:
    """Return `jax.numpy` for arrays inside JAX's transformations, and `numpy` for others."""
    return jnp if is_traced(tree) else np
