"""The general class of Cosserat-rod systems.

    A y_s + B y_st = f1,     C z + D z_t = f2

A system defines the layouts of y and z, these terms (or y_s and z directly), the boundary conditions at base
and tip, and the unknowns at the base. It does not depend on the nodes in between, time steps or solvers: its
equations receive rates in time, which a solver forms (`solvers.semi_discrete`).
"""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Callable
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
)
from knode_cosserat.rods.paths import with_value
from knode_cosserat.rotation import dot, rotation_matrix

#: smallest and largest number of nodes of a rod
FEWEST_NODES, MOST_NODES = 2, 10_000


class Scales(NamedTuple):
    """Natural sizes of the numbers in y (y,) and of the tip's residuals (k,), for scaled tolerances."""

    y: Float[Any, " y"]
    tip: Float[Any, " k"]


class System(Parametrised):
    """A rod robot: A y_s + B y_st = f1, C z + D z_t = f2 (paper eq. 1, general class).

    A subclass defines its layouts and `base_unknowns`, its `length`, `constitutive` and `balance`, `rest` and
    `tip`; most define `base` and `scales` too, and `mixed` where B is zero. All other members have defaults:

        ends             moving_base, end_poses, held, rest_is_guess, tip_layout
        discontinuities  cuts, jumps, jump
        several rods     strands, strand
        learning         actuation, observables, velocities, unstressed, law_factors, corrections, nominal
        drawing          positions, quaternions, curves

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

    #: True if the state at rest is a guess: a simulation then starts at the equilibrium under zero control
    rest_is_guess: ClassVar[bool] = False

    #: True if the system is constrained; without constraints an equilibrium needs loads that cancel
    held: ClassVar[bool] = True

    #: velocities among the observables, on which drag and friction depend; empty: not specified
    velocities: ClassVar[tuple[str, ...]] = ()

    #: places of discontinuity of the right-hand side or of y, as fractions of the length between 0 and 1
    cuts: ClassVar[tuple[float, ...]] = ()
    #: True if y jumps at some of them
    jumps: ClassVar[bool] = False

    if TYPE_CHECKING:  # every system has a length (m) among its own parameters
        length: Any
    #: number of nodes of the rod, both ends included
    nodes: int = eqx.field(static=True, default=10, kw_only=True)

    # strands: rods that touch each other at their ends only, such as the legs of a platform

    @property
    def strands(self) -> int:
        """Number of identical rods, joined at their ends only: y and z hold them in turn."""
        return 1

    @property
    def strand(self) -> System:
        """System of one strand, for its equations along the rod only; it receives the whole control."""
        return self

    # the equations

    def constitutive(
        self, s: Any, t: Any, y: Float[Any, " y"], y_t: Float[Any, " y"], control: Any
    ) -> tuple[Any, Any, Any] | MaterialLaw | InternalState | StressedLaw | Float[Any, " z"]:
        """Return C (z, z), D (z, z) and f2 (z,) of C z + D z_t = f2, at arclength s (m) and time t (s).

        A law of another form is a `MaterialLaw`. If z depends on no rate of z, it may be returned itself.
        """
        raise NotImplementedError(f"{type(self).__name__} gives no `constitutive`")

    def balance(
        self, s: Any, t: Any, y: Float[Any, " y"], y_t: Float[Any, " y"], z: Float[Any, " z"],
        z_t: Float[Any, " z"], control: Any,
    ) -> tuple[Any, Any, Any] | Float[Any, " y"]:  # fmt: skip
        """Return A (y, y), B (y, y) and f1 (y,) of A y_s + B y_st = f1, at arclength s (m) and time t (s).

        If B is zero, y_s may be returned itself.
        """
        raise NotImplementedError(f"{type(self).__name__} gives no `balance`")

    @property
    def corrections(self) -> tuple[Callable[..., Float[Any, " y+z"]], ...]:
        """Functions of (s, t, y, y_t, z, z_t, control) whose values add to [y_s; z] in turn; none by default.

        z is that of `constitutive`, then with the corrections before.
        """
        return ()

    def jump(
        self, acting: Float[Any, " cuts"], t: Any, y: Float[Any, " y"], y_t: Float[Any, " y"], control: Any
    ) -> Float[Any, " y"]:
        """Return y on the far side of the acting cuts (ones; zeros elsewhere), from y on the near side."""
        raise NotImplementedError(f"{type(self).__name__} has `jumps`, but gives no `jump`")

    # the two ends, and rest

    @abc.abstractmethod
    def rest(self, s: Any) -> tuple[Float[Any, " y"], Float[Any, " z"]]:
        """Return y and z at arclength s (m) of the unloaded robot at rest: the default initial state."""

    def base(self, t: Any, control: Any, unknowns: Float[Any, " k"]) -> Float[Any, " y"]:
        """Return y at s = 0: the values at rest, with the unknowns in their places."""
        fixed, _ = self.rest(jnp.zeros(()))
        return self.y_layout.replaced(jnp.asarray(fixed), self.base_unknowns, unknowns)

    def moving_base(self, y: Float[Any, " y"], y_t: Float[Any, " y"]) -> Float[Any, " y"]:
        """Return y at s = 0 with the velocities of a base whose pose has the rate in `y_t`."""
        return y

    @abc.abstractmethod
    def tip(self, t: Any, control: Any, y: Float[Any, " y"], y_t: Float[Any, " y"]) -> Float[Any, " k"]:
        """Return the residuals of the boundary conditions at s = length, as many as there are unknowns."""

    def end_poses(self, control: Any) -> tuple[Any, Any]:
        """Return the constrained poses of base and tip under a control; None for a free end."""
        return None, None

    @property
    def tip_layout(self) -> Layout:
        """Layout of the tip's residuals; one generic field by default."""
        return Layout(("tip", unknown_count(self), "", "conditions at the tip"))

    def scales(self) -> Scales:
        """Return the natural sizes of y and of the tip's residuals; ones by default."""
        return Scales(jnp.ones(self.y_layout.size), jnp.ones(unknown_count(self)))

    def eased(self, part: float) -> Self:
        """Return the system with near-discontinuities (friction, contact) spread over 1/part of their width.

        Solvers use it as an intermediate problem when the direct solution fails. By default it is the system.
        """
        return self

    # observables for learning

    def actuation(self, control: Float[Any, " c"]) -> Float[Any, " a"]:
        """Return the part of the control that enters the equations; the whole control by default."""
        return control

    @property
    def has_actuation(self) -> bool:
        """True if the actuation differs from the control."""
        return _gives(self, "actuation")

    def unstressed(self, s: Any, control: Any) -> Float[Any, " z"]:
        """Return z at s of the unstressed material under this control; by default z at rest."""
        return self.rest(s)[1]

    def law_factors(self, s: Any, control: Any) -> tuple[Any, Any] | None:
        """Return factors on C and D of the strains' law at s, for each number of z; None if uniform."""
        return None

    @property
    def observable_layout(self) -> Layout:
        """Layout of `observables`: by default y, its rate, the strains relative to rest, and their rate."""
        state, strain = self.y_layout.fields, self.z_layout.fields
        return Layout(
            *state,
            *((f"{name}_t", size, f"{unit}/s", f"rate of {name}") for name, size, unit, *_ in state),
            *strain,
            *((f"{name}_t", size, f"{unit}/s", f"rate of {name}") for name, size, unit, *_ in strain),
        )

    def observables(
        self, s: Any, y: Float[Any, " y"], y_t: Any, z: Float[Any, " z"], z_t: Any, control: Any
    ) -> Float[Any, " o"]:
        """Return the possible arguments of an unmodelled load, beside the control, in the material frame."""
        bent = z - self.unstressed(s, control)
        return jnp.concatenate([in_material_frame(self, y, y), in_material_frame(self, y, y_t), bent, z_t])

    # queries that every system answers

    def undelayed(
        self, measured: Float[np.ndarray, "T c"], dt: float, before: Float[np.ndarray, " c"] | None = None
    ) -> Float[np.ndarray, "T c"]:
        """Return the acting controls, from measured ones that are held for `dt` (s) each.

        They are equal unless the robot's sensors have a delay. `before` acted before the first row.
        """
        return measured

    @property
    def nominal(self) -> System:
        """Robot without learned residuals, whose parameters `replace` changes; by default the system."""
        return self

    def trained_range(self) -> Any:
        """Return the `TrainedRange` of a model that was learned or identified; None if there is none."""
        return None

    @property
    def control_size(self) -> int:
        """Size of a control."""
        return self.control_layout.size

    def positions(self, y: Any) -> Any:
        """Return positions (…, 3) in metres of states y (…, y)."""
        return self._named(y, "p", "position")

    def curves(self, y: Any) -> list[Any]:
        """Return lines (…, points, 3) in m for drawing the states y (…, N, y) of one robot."""
        return [np.asarray(self.positions(y))]

    def quaternions(self, y: Any) -> Any:
        """Return orientations (…, 4), scalar first, of states y (…, y)."""
        return self._named(y, "h", "orientation")

    def _named(self, y: Any, name: str, meaning: str) -> Any:
        if name not in self.y_layout.names:
            raise AttributeError(
                f"{type(self).__name__} has no {meaning}: its y has no field {name!r} "
                f"(there are {', '.join(self.y_layout.names)})"
            )
        return self.y_layout.get(y, name)

    def replace(self, **changes: Any) -> Self:
        """Return a copy with other parameters, by name; derived quantities follow.

        Parameters of parts have names with dots, and indices if there are several parts:
        `base_end.position`, `loads.0.mass`. They are passed as `replace(**{"loads.0.mass": 0.1})`.

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
        given: Any = self.nodes
        if not isinstance(given, int) or not FEWEST_NODES <= self.nodes <= MOST_NODES:
            raise ParameterError(
                f"nodes is {self.nodes!r}; allowed is a whole number from {FEWEST_NODES} to {MOST_NODES}"
            )
        check_fields(self)


def unknowns_of(system: System, y: Float[Any, "*n y"]) -> Float[Any, "*n k"]:
    """Return the unknowns of y at s = 0: the inverse of `System.base`."""
    return y[..., system.y_layout.indices(system.base_unknowns)]


def unknown_count(system: System) -> int:
    """Return the number of unknowns at the base."""
    return len(system.y_layout.indices(system.base_unknowns))


def with_length_factor(system: System, factor: Any) -> System:
    """Return the system with the length of its nominal robot multiplied by a factor."""
    return system.replace(length=system.nominal.length * factor)


def in_material_frame(system: System, y: Float[Any, " y"], vectors: Float[Any, " y"]) -> Float[Any, " y"]:
    """Return numbers with the layout of y, with vectors of the global frame in the material frame."""
    layout, parts = system.y_layout, []
    for field in layout.fields:
        part = layout.get(vectors, field.name)
        if field.frame:
            part = dot(rotation_matrix(layout.get(y, field.frame)).T, part)
        parts.append(part)
    return jnp.concatenate(parts)


def _gives(system: System, name: str) -> bool:
    """True if the class of a system defines a method that `System` only declares."""
    return getattr(type(system), name) is not getattr(System, name)


def is_traced(tree: Any) -> bool:
    """True if any leaf is a JAX tracer: inside `jit`, `grad` or `vmap` values are not available."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(tree))
