"""The general class of Cosserat-rod systems (paper eqs. 1-4).

    A y_s + B y_st = f1,     C z + D z_t = f2

An implicit time scheme, y_t = c0 y + ʰy, turns it into an ordinary differential equation along the rod:

    z   = (C + c0 D)⁻¹ (f2 - D ʰz)
    y_s = (A + c0 B)⁻¹ (f1 - B ʰy_s)

A system says which numbers y and z hold, gives these terms (or z and y_s directly), what holds at the base
and at the tip, and what is unknown at the base. It knows nothing of nodes in between, time steps or solvers.
"""

from __future__ import annotations

import abc
import dataclasses
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.layout import Layout
from knode_cosserat.rods.parameters import (
    ParameterError,
    Parametrised,
    check_fields,
    parameters_of,
    unknown_parameter,
)
from knode_cosserat.rotation import dot, rotation_matrix

#: how many nodes a rod may be divided into
FEWEST_NODES, MOST_NODES = 2, 10_000


class History(NamedTuple):
    """What an implicit time scheme knows of the past at one point of the rod.

    With it, y_t = c0 y + ʰy, z_t = c0 z + ʰz and y_st = c0 y_s + ʰy_s. At rest c0 and all three are zero.
    """

    c0: Float[Any, ""]
    y: Float[Any, " y"]
    z: Float[Any, " z"]
    y_s: Float[Any, " y"]


def unpacked_history(system: System, c0: Any, record: Float[Any, " x"]) -> History:
    """The history at one point from a packed record of it: y, z and, if B is not zero, y_s."""
    ny, nz = system.y_layout.size, system.z_layout.size
    y_s = record[ny + nz :] if system.mixed else jnp.zeros(ny)
    return History(c0, record[:ny], record[ny : ny + nz], y_s)


def in_strands(system: System, packed: Any) -> Any:
    """Numbers (…, y), or z or the unknowns, strand by strand: (…, strands, those of one)."""
    return packed.reshape(*packed.shape[:-1], system.strands, packed.shape[-1] // system.strands)


def records_in_strands(system: System, records: Any) -> Any:
    """Packed records of history (…, x), strand by strand: (…, strands, x of one)."""
    if system.strands == 1:
        return in_strands(system, records)
    ny, nz = system.y_layout.size, system.z_layout.size
    parts = jnp.split(records, [ny, ny + nz], axis=-1)
    return jnp.concatenate([in_strands(system, part) for part in parts], axis=-1)


def of_strands(
    system: System, s: Any, t: Any, y: Float[Any, " y"], control: Any, history: History
) -> tuple[Float[Any, " y"], Float[Any, " z"]]:
    """y_s and z of a system at one place, from the equations of its strands."""
    strand = system.strand
    own = [in_strands(system, part) for part in (y, history.y, history.z, history.y_s)]

    def each(y: Any, *past: Any) -> Any:
        return strand.derivatives(s, t, y, control, History(history.c0, *past))

    y_s, z = jax.vmap(each)(*own)
    return y_s.reshape(-1), z.reshape(-1)


class Scales(NamedTuple):
    """Natural sizes of the numbers in y (y,) and of the tip's residuals (k,): what "small" is measured by."""

    y: Float[Any, " y"]
    tip: Float[Any, " k"]


class System(Parametrised):
    """A rod robot of the general class.

    A subclass states the layouts below, `rest`, `base`, `tip`, and either `constitutive` and `balance`
    (the general form) or `strains` and `rates` (z and y_s directly). Its numeric parameters are leaves of a
    JAX pytree, so that one compiled program serves every value of them, batches, and their derivatives.
    """

    y_layout: ClassVar[Layout]
    z_layout: ClassVar[Layout]
    control_layout: ClassVar[Layout]
    #: fields of y that are unknown at the base; the tip has as many conditions
    base_unknowns: ClassVar[tuple[str, ...]]
    #: whether B is not zero: the history of y_s is then kept
    mixed: ClassVar[bool] = True

    #: whether the state at rest is a guess: a simulation then begins in the equilibrium under no control
    rest_is_guess: ClassVar[bool] = False

    #: whether anything holds it in its place: it has no equilibrium else, unless what loads it cancels out
    held: ClassVar[bool] = True

    #: whether `left_of_law` is linear in the strains
    linear_law: ClassVar[bool] = True

    #: observables that are velocities, on which drag and friction depend; none: the system does not say
    velocities: ClassVar[tuple[str, ...]] = ()

    #: places, as parts of the length between 0 and 1, where the right-hand side or y jumps
    cuts: ClassVar[tuple[float, ...]] = ()
    #: whether y jumps at some of them
    jumps: ClassVar[bool] = False

    if TYPE_CHECKING:  # every system has a length (m) among its own parameters
        length: Any
    #: how many nodes the rod is divided into, both ends counted
    nodes: int = eqx.field(static=True, default=10, kw_only=True)

    # strands: rods that touch each other at their ends only, such as the legs of a platform

    @property
    def strands(self) -> int:
        """Of how many rods alike, joined at their ends only, it is made: y and z are theirs in turn."""
        return 1

    @property
    def strand(self) -> System:
        """The equations that all strands have in common: a system with y and z of one of them.

        Solvers and learning use its equations along the rod, and nothing of its ends. It is given the whole
        control.
        """
        return self

    # the equations

    def constitutive(self, s, t, y, y_t, control):  # type: ignore[no-untyped-def]
        """C (z, z), D (z, z) and f2 (z,) of C z + D z_t = f2, at arclength s (m) and time t (s)."""
        raise NotImplementedError(f"{type(self).__name__} gives neither `strains` nor `constitutive`")

    def balance(self, s, t, y, y_t, z, z_t, control):  # type: ignore[no-untyped-def]
        """A (y, y), B (y, y) and f1 (y,) of A y_s + B y_st = f1, at arclength s (m) and time t (s)."""
        raise NotImplementedError(f"{type(self).__name__} gives neither `rates` nor `balance`")

    def strains(
        self, s: Any, t: Any, y: Float[Any, " y"], control: Any, history: History
    ) -> Float[Any, " z"]:
        """z at one point, semi-discretised in time (paper eq. 4, second line)."""
        c0 = history.c0
        C, D, f2 = self.constitutive(s, t, y, c0 * y + history.y, control)
        return jnp.linalg.solve(C + c0 * D, f2 - D @ history.z)

    def left_of_law(
        self, s: Any, t: Any, y: Float[Any, " y"], z: Float[Any, " z"], control: Any, history: History
    ) -> Float[Any, " z"]:
        """What the law of the strains leaves at z, zero at `strains`: C z + D z_t - f2, or z less those.

        A system whose law is one of stresses, but not linear, states it here, and says so (`linear_law`).
        """
        c0 = history.c0
        if type(self).constitutive is System.constitutive:
            return z - self.strains(s, t, y, control, history)
        C, D, f2 = self.constitutive(s, t, y, c0 * y + history.y, control)
        return C @ z + D @ (c0 * z + history.z) - f2

    def rates(
        self, s: Any, t: Any, y: Float[Any, " y"], z: Float[Any, " z"], control: Any, history: History
    ) -> Float[Any, " y"]:
        """y_s at one point where the strains are z, semi-discretised in time (paper eq. 4, first line)."""
        c0 = history.c0
        A, B, f1 = self.balance(s, t, y, c0 * y + history.y, z, c0 * z + history.z, control)
        return jnp.linalg.solve(A + c0 * B, f1 - B @ history.y_s)

    def derivatives(
        self, s: Any, t: Any, y: Float[Any, " y"], control: Any, history: History
    ) -> tuple[Float[Any, " y"], Float[Any, " z"]]:
        """y_s and z at one point: what the solvers integrate."""
        z = self.strains(s, t, y, control, history)
        return self.rates(s, t, y, z, control, history), z

    def crossed(
        self, acting: Float[Any, " cuts"], t: Any, y: Float[Any, " y"], control: Any, history: History
    ) -> Float[Any, " y"]:
        """y on the far side of the cuts that act (ones; zeros elsewhere), from that on the near side."""
        raise NotImplementedError(f"{type(self).__name__} has `jumps`, but gives no `crossed`")

    # the two ends, and rest

    @abc.abstractmethod
    def rest(self, s: Any) -> tuple[Float[Any, " y"], Float[Any, " z"]]:
        """y and z at arclength s (m) of the unloaded robot at rest: where a simulation starts by default."""

    def base(self, t: Any, control: Any, unknowns: Float[Any, " k"], history: History) -> Float[Any, " y"]:
        """y at s = 0: the values at rest, with the unknowns in their places.

        `history` is that of the first node: a base that moves has its velocity from it.
        """
        fixed, _ = self.rest(jnp.zeros(()))
        return self.y_layout.replaced(jnp.asarray(fixed), self.base_unknowns, unknowns)

    def unknowns(self, y: Float[Any, " y"]) -> Float[Any, " k"]:
        """The unknowns in a given y at s = 0: the inverse of `base`."""
        return y[..., self.y_layout.indices(self.base_unknowns)]

    @abc.abstractmethod
    def tip(self, t: Any, control: Any, y: Float[Any, " y"], history: History) -> Float[Any, " k"]:
        """Residuals of the conditions at s = length: zero when they hold."""

    def end_poses(self, control: Any) -> tuple[Any, Any]:
        """Return the poses in which base and tip are held under a control; None for an end that is not."""
        return None, None

    @property
    def tip_layout(self) -> Layout:
        """What the tip's residuals are; one nameless field unless a system says more."""
        return Layout(("tip", self.unknown_count, "", "conditions at the tip"))

    def scales(self) -> Scales:
        """Natural sizes of y and of the tip's residuals; ones unless a system knows better."""
        return Scales(jnp.ones(self.y_layout.size), jnp.ones(self.unknown_count))

    def eased(self, part: float) -> Self:
        """The same system, with what is nearly a jump (friction, contact) spread over 1/part of its width.

        Solvers go by way of it where they find no other. By default nothing is, and it is the system itself.
        """
        return self

    # what learning looks at

    def actuation(self, control: Float[Any, " c"]) -> Float[Any, " a"]:
        """What of the control enters the equations; the control itself unless a system knows better."""
        return control

    def unstressed(self, s: Any, control: Any) -> Float[Any, " z"]:
        """z at s that the material has without stress, under this control; by default that of rest."""
        return self.rest(s)[1]

    def law_factors(self, s: Any, control: Any) -> tuple[Any, Any] | None:
        """By what C and D of the strains' law differ at s from elsewhere, by number of z; None: not."""
        return None

    @property
    def observable_layout(self) -> Layout:
        """What `observables` gives: by default y, its rate, the strains from rest, and their rate."""
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
        """What a load that the equations miss may depend on beside the control, as seen from the material."""
        bent = z - self.unstressed(s, control)
        return jnp.concatenate([self.turned(y, y), self.turned(y, y_t), bent, z_t])

    def turned(self, y: Float[Any, " y"], vectors: Float[Any, " y"]) -> Float[Any, " y"]:
        """Numbers laid out like y with those of the global frame turned into the material's."""
        parts = []
        for field in self.y_layout.fields:
            part = self.y_layout.get(vectors, field.name)
            if field.frame:
                part = dot(rotation_matrix(self.y_layout.get(y, field.frame)).T, part)
            parts.append(part)
        return jnp.concatenate(parts)

    # what every system can be asked

    @property
    def unknown_count(self) -> int:
        """How many numbers are unknown at the base."""
        return len(self.y_layout.indices(self.base_unknowns))

    @property
    def control_size(self) -> int:
        """How many numbers a control has."""
        return self.control_layout.size

    def positions(self, y: Any) -> Any:
        """Positions (…, 3) in metres of states y (…, y)."""
        return self._named(y, "p", "position")

    def curves(self, y: Any) -> list[Any]:
        """What is drawn of the states y (…, N, y) of one robot: lines (…, points, 3) in m."""
        return [np.asarray(self.positions(y))]

    def quaternions(self, y: Any) -> Any:
        """Orientations (…, 4), scalar first, of states y (…, y)."""
        return self._named(y, "h", "orientation")

    def _named(self, y: Any, name: str, meaning: str) -> Any:
        if name not in self.y_layout.names:
            raise AttributeError(
                f"{type(self).__name__} has no {meaning}: its y has no field {name!r} "
                f"(there are {', '.join(self.y_layout.names)})"
            )
        return self.y_layout.get(y, name)

    def replace(self, **changes: Any) -> Self:
        """A copy with other parameters, by name; what depends on them follows.

        Those of parts have names with dots, and numbers where there are several: `base_end.position`,
        `loads.0.mass`; they are given as `replace(**{"loads.0.mass": 0.1})`.

        Raises `ParameterError` for a name that does not exist or a value that is not allowed. Values may be
        JAX tracers, so that derivatives with respect to a parameter go through here.
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


def with_value(owner: Any, path: str, value: Any, name: str) -> Any:
    """A part, or a tuple of parts, with another value at a path such as `0.mass`."""
    first, _, rest = path.partition(".")
    several = isinstance(owner, tuple)
    stated = dataclasses.fields(owner) if dataclasses.is_dataclass(owner) else ()
    known = [str(k) for k in range(len(owner))] if several else [field.name for field in stated]
    if first not in known:
        raise ParameterError(
            f"there is no parameter {name!r}: no {first!r} among {', '.join(known) or 'nothing'}"
        )
    inner = owner[int(first)] if several else getattr(owner, first)
    changed = with_value(inner, rest, value, name) if rest else value
    if several:
        return tuple(changed if k == int(first) else each for k, each in enumerate(owner))
    return dataclasses.replace(owner, **{first: changed})


def is_traced(tree: Any) -> bool:
    """Whether any leaf is a JAX tracer: inside `jit`, `grad` or `vmap` values cannot be looked at."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(tree))
