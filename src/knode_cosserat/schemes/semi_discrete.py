"""Equations of a system in a time scheme: functions of y and the history of earlier states.

A system states its equations with y_t, z_t and y_st (`rods.system`). An implicit scheme, y_t = c0 y + ʰy,
turns them into an ordinary differential equation along the rod:

    z   = (C + c0 D)⁻¹ (f2 - D ʰz)
    y_s = (A + c0 B)⁻¹ (f1 - B ʰy_s)

`discrete_law` has the constitutive laws. The `corrections` of a system add to y_s and z.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.aspects import Ends
from knode_cosserat.rods.law import InternalState, JointLaw, MaterialLaw, StressedLaw
from knode_cosserat.rods.strands import in_strands, strand_count, strand_of
from knode_cosserat.rods.system import System
from knode_cosserat.rods.wrapped import corrections_of, nominal_model
from knode_cosserat.schemes.discrete_law import DiscreteLaw, discrete_law


class History(NamedTuple):
    """History terms of an implicit time scheme at one point of the rod.

    The scheme is y_t = c0 y + ʰy, z_t = c0 z + ʰz, y_st = c0 y_s + ʰy_s. At rest c0 and all three are zero.
    """

    c0: Float[Any, ""]
    y: Float[Any, " y"]
    z: Float[Any, " z"]
    y_s: Float[Any, " y"]

    def y_t(self, y: Float[Any, " y"]) -> Float[Any, " y"]:
        """Return the rate of y (paper eq. 11, rates in time of the rod)."""
        return self.c0 * y + self.y

    def z_t(self, z: Float[Any, " z"]) -> Float[Any, " z"]:
        """Return the rate of z."""
        return self.c0 * z + self.z


class Point(NamedTuple):
    """A point of the rod in a time step: arclength (m), time (s), y, the control and the history."""

    s: Any
    t: Any
    y: Float[Any, " y"]
    control: Any
    history: History

    @property
    def y_t(self) -> Float[Any, " y"]:
        """Rate of y in time."""
        return self.history.y_t(self.y)

    def z_t(self, z: Float[Any, " z"]) -> Float[Any, " z"]:
        """Return the rate of z in time."""
        return self.history.z_t(z)


def unpacked_history(system: System, c0: Any, record: Float[Any, " x"]) -> History:
    """Return the history at one point from its packed record: y, z and, if B is not zero, y_s."""
    ny, nz = system.y_layout.size, system.z_layout.size
    y_s = record[ny + nz :] if system.mixed else jnp.zeros(ny)
    return History(c0, record[:ny], record[ny : ny + nz], y_s)


def records_in_strands(system: System, records: Any) -> Any:
    """Return packed records of history (…, x) split by strand: (…, strands, x of one)."""
    if strand_count(system) == 1:
        return in_strands(system, records)
    ny, nz = system.y_layout.size, system.z_layout.size
    parts = jnp.split(records, [ny, ny + nz], axis=-1)
    return jnp.concatenate([in_strands(system, part) for part in parts], axis=-1)


# along the rod


def derivatives(system: System, point: Point) -> tuple[Float[Any, " y"], Float[Any, " z"]]:
    """Return y_s and z at one point (paper eq. 4, semi-discretised general class)."""
    if strand_count(system) > 1:
        return _of_strands(system, point)
    z = law(system, point).strains()
    added, corrected = _add_corrections(system, point, z)
    return _solve_balance(system, point, z) + added, corrected


def _of_strands(system: System, point: Point) -> tuple[Float[Any, " y"], Float[Any, " z"]]:
    strand, (s, t, y, control, history) = strand_of(system), point
    parts = [in_strands(system, part) for part in (y, history.y, history.z, history.y_s)]

    def of_strand(y: Any, *terms: Any) -> Any:
        return derivatives(strand, Point(s, t, y, control, History(history.c0, *terms)))

    y_s, z = jax.vmap(of_strand)(*parts)
    return y_s.reshape(-1), z.reshape(-1)


def _add_corrections(system: System, point: Point, z: Float[Any, " z"]) -> tuple[Any, Float[Any, " z"]]:
    """Return the corrections of y_s, and z with its corrections, from z of the law."""
    added: Any = 0.0
    for correction in corrections_of(system):
        both = correction(point.s, point.t, point.y, point.y_t, z, point.z_t(z), point.control)
        size = point.y.shape[0]
        added, z = added + both[:size], z + both[size:]
    return added, z


def law(system: System, point: Point) -> DiscreteLaw:
    """Return the law of z at one point of a strand, before corrections of z."""
    s, t, y, control, history = point
    stated = system.constitutive(s, t, y, point.y_t, control)
    return discrete_law(stated, system.z_layout, history.c0, history.z, system.length)


def has_friction(system: System) -> bool:
    """True if internal variables of the law have bounds, such as friction: no linearisation at rest."""
    found, size = list[bool](), system.y_layout.size // strand_count(system)

    def is_bounded(law: Any) -> bool:
        if isinstance(law, StressedLaw):
            return is_bounded(law.law)
        if isinstance(law, JointLaw):
            return any(is_bounded(own) for own, *_ in law.laws)
        return isinstance(law, InternalState) or (isinstance(law, MaterialLaw) and law.internal is not None)

    def look(system: System, s: Any, y: Any, control: Any) -> None:
        strand = strand_of(nominal_model(system))
        found.append(is_bounded(strand.constitutive(s, s, y, jnp.zeros_like(y), control)))

    # traced only: the kind of law does not depend on numbers
    jax.eval_shape(look, system, np.zeros(()), np.ones(size), np.zeros(system.control_layout.size))
    return found[0]


def strains(system: System, point: Point) -> Float[Any, " z"]:
    """Return z at one point."""
    if strand_count(system) > 1:
        return _of_strands(system, point)[1]
    return _add_corrections(system, point, law(system, point).strains())[1]


def law_residual(system: System, point: Point, z: Float[Any, " z"]) -> Float[Any, " z"]:
    """Return the residual of the law of z, at any z less the corrections of the law's z."""
    _, z = _subtract_corrections(system, point, z)
    return law(system, point).residual(z)


def rates(system: System, point: Point, z: Float[Any, " z"]) -> Float[Any, " y"]:
    """Return y_s at one point, for any z; with several strands, for the z of their law."""
    if strand_count(system) > 1:
        return _of_strands(system, point)[0]
    added, z = _subtract_corrections(system, point, z)
    return _solve_balance(system, point, z) + added


def _subtract_corrections(system: System, point: Point, z: Float[Any, " z"]) -> tuple[Any, Float[Any, " z"]]:
    """Return the corrections of y_s at the law's z, and a given z less the corrections there."""
    if not corrections_of(system):
        return 0.0, z
    of_law = law(system, point).strains()
    added, corrected = _add_corrections(system, point, of_law)
    return added, z - (corrected - of_law)


def _solve_balance(system: System, point: Point, z: Float[Any, " z"]) -> Float[Any, " y"]:
    """Return y_s of the balance."""
    balance = _balance(system, point, z)
    if not isinstance(balance, tuple):
        return balance
    A, B, f1 = balance
    return jnp.linalg.solve(A + point.history.c0 * B, f1 - B @ point.history.y_s)


def load_matrix(system: System, point: Point, z: Float[Any, " z"]) -> Float[Any, "y y"]:
    """Return A + c0 B, whose inverse turns loads into rates."""
    balance = _balance(system, point, z)
    if not isinstance(balance, tuple):
        return jnp.eye(system.y_layout.size)
    A, B, _ = balance
    return A + point.history.c0 * B


def _balance(system: System, point: Point, z: Float[Any, " z"]) -> Any:
    s, t, y, control, _ = point
    return system.balance(s, t, y, point.y_t, z, point.z_t(z), control)


# the ends, and jumps


def base(
    system: System, t: Any, control: Any, unknowns: Float[Any, " k"], history: History
) -> Float[Any, " y"]:
    """Return y at the base; its velocities are those of a moving base."""
    y = system.base(t, control, unknowns)
    return Ends.of(system).moving_base(y, history.y_t(y))


def tip(system: System, t: Any, control: Any, y: Float[Any, " y"], history: History) -> Float[Any, " k"]:
    """Return the residuals of the boundary conditions at the tip."""
    return system.tip(t, control, y, history.y_t(y))


def jump(system: System, acting: Float[Any, " cuts"], point: Point) -> Float[Any, " y"]:
    """Return y on the far side of the acting cuts; their place is not used."""
    return system.discontinuities.jump(acting, point.t, point.y, point.y_t, point.control)
