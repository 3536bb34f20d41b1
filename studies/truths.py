"""Robots with physics beyond the nominal robot: the true robots of the study of imperfections.

Each is the paper's robot (`TendonRobot`) with one additional effect. A residual on a `TendonRobot` has to
learn this effect from trajectories alone.
"""

from __future__ import annotations

import abc
from typing import Any, Literal, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.aspects import Observed
from knode_cosserat.rods.law import MaterialLaw
from knode_cosserat.rods.loads import square_law_drag
from knode_cosserat.rods.parameters import parameter
from knode_cosserat.rods.tendon_robots import TendonRobot
from knode_cosserat.rotation import cross, dot, rotation_matrix

Robot = TypeVar("Robot", bound=TendonRobot)


def derived_robot(kind: type[Robot], robot: TendonRobot, **more: Any) -> Robot:
    """Return a robot of the given class with another robot's parameters and the class's own ones."""
    own = {name: getattr(robot, name) for name in robot.parameters() if name in kind.parameters()}
    return kind(**{**own, "nodes": robot.nodes, **more})


# materials


class CurvedMaterial(TendonRobot):
    """A material with a moment beside the linear law: Kbt u + Bbt u_t + μ(u, u_t) = Rᵀm."""

    @abc.abstractmethod
    def extra_moment(self, u: Float[Any, "3"], u_t: Float[Any, "3"]) -> Float[Any, "3"]:
        """μ (N·m), material frame."""

    def constitutive(self, s, t, y, y_t, control):  # type: ignore[no-untyped-def]
        """Return the linear law of v, and the law of u with this moment."""
        strains = self.linear_law(s, y, control).strains
        moment = jax.tree_util.Partial(_moment, self)
        return MaterialLaw({**strains, "u": strains["u"]._replace(moment=moment)})


def _moment(robot: CurvedMaterial, u: Any, u_t: Any) -> Float[Any, "3"]:
    return robot.extra_moment(u, u_t)


Stiffness = Literal["linear", "square", "exponential", "levelling", "each axis", "one way", "softening"]


class Stiffening(CurvedMaterial):
    """A bending stiffness that depends on the curvature.

    With x = u/u₀, the stiffness Kbt is multiplied by

        linear      1 + |x|            exponential  exp |x|²              each axis  1 + xᵢ²
        square      1 + |x|²           levelling    1 + xᵢ²/(1 + xᵢ²)     softening  1/(1 + |x|)
        one way     1.3 about an axis that bends in the positive sense, 1 in the other
    """

    curvature: Any = parameter("1/m", "u₀, curvature at which the law bends", low=1e-6, high=1e6, default=5.0)
    law: Stiffness = eqx.field(static=True, default="square")

    def extra_moment(self, u: Float[Any, "3"], u_t: Float[Any, "3"]) -> Float[Any, "3"]:
        """Return the moment in excess of Kbt u (N·m)."""
        x = u / self.curvature
        square = jnp.sum(x * x)
        # the square root of zero has no derivative
        norm = jnp.sqrt(square + 1e-30)
        factor = {
            "linear": norm,
            "square": square,
            "exponential": jnp.expm1(square),
            "levelling": x * x / (1.0 + x * x),
            "each axis": x * x,
            "one way": 0.3 * (u > 0.0),
            "softening": -norm / (1.0 + norm),
        }[self.law]
        return dot(self.Kbt, factor * u)


class Precurved(CurvedMaterial):
    """Rod with an intrinsic curvature but a straight initial state: a constant moment in the material."""

    rest_curvature: Any = parameter(
        "1/m", "curvature of the unloaded rod", shape="vector", low=-1e3, high=1e3, default=(0.2, -0.1, 0.0)
    )

    def extra_moment(self, u: Float[Any, "3"], u_t: Float[Any, "3"]) -> Float[Any, "3"]:
        """-Kbt u*."""
        return -dot(self.Kbt, jnp.asarray(self.rest_curvature))


class Tapered(TendonRobot):
    """A rod whose modulus falls linearly towards the tip."""

    tip_softening: Any = parameter(
        "", "part of the modulus that the tip lacks", low=0.0, high=0.9, default=0.2
    )

    def _there(self, s: Any) -> TendonRobot:
        part = 1.0 - self.tip_softening * s / self.length
        return derived_robot(TendonRobot, self, youngs_modulus=self.youngs_modulus * part)

    def constitutive(self, s, t, y, y_t, control):  # type: ignore[no-untyped-def]
        """Return the constitutive law of a rod with the modulus at s."""
        return self._there(s).linear_law(s, y, control)


# friction

Rubbing = Literal["each axis", "isotropic", "stribeck"]


def rubbing(law: Rubbing, rate: Float[Any, "3"], least: Any) -> Float[Any, "3"]:
    """Return the normalised friction against a rate.

    "each axis" is tanh of every component over `least`. "isotropic" points along the rate and saturates
    beyond `least`. "stribeck" is "isotropic", increased by half at slow rates.
    """
    if law == "each axis":
        return jnp.tanh(rate / least)
    square = jnp.sum(rate * rate) / least**2
    along = rate / (least * jnp.sqrt(1.0 + square))
    return along if law == "isotropic" else along * (1.0 + 0.5 * jnp.exp(-square / 9.0))


class InternalFriction(CurvedMaterial):
    """Fibres that rub against each other as the rod bends."""

    friction: Any = parameter("N m", "moment of the friction", low=0.0, high=1e3, default=0.02)
    least: Any = parameter(
        "1/(m s)", "rate of curvature from which it is full", low=1e-9, high=1e6, default=1.0
    )
    law: Rubbing = eqx.field(static=True, default="each axis")

    def extra_moment(self, u: Float[Any, "3"], u_t: Float[Any, "3"]) -> Float[Any, "3"]:
        """Return the friction's moment, which opposes the rate of the curvature (N·m)."""
        return self.friction * rubbing(self.law, u_t, self.least)


class ExternalFriction(TendonRobot):
    """A moment per length, as from a sleeve, against the rod's turning."""

    friction: Any = parameter("N", "moment of the friction per length", low=0.0, high=1e3, default=0.05)
    least: Any = parameter("rad/s", "angular velocity from which it is full", low=1e-9, high=1e6, default=0.5)
    law: Rubbing = eqx.field(static=True, default="each axis")

    def balance(self, s, t, y, y_t, z, z_t, control):  # type: ignore[no-untyped-def]
        """Return the rates with this robot's additional effect."""
        y_s = super().balance(s, t, y, y_t, z, z_t, control)
        R = rotation_matrix(self.y_layout.get(y, "h"))
        moment = self.friction * rubbing(self.law, self.y_layout.get(y, "w"), self.least)
        return y_s.at[self.y_layout.slice("m")].add(dot(R, moment))


# the air and the tendons


class Wind(TendonRobot):
    """Drag in moving air: it depends on the velocity relative to the wind."""

    wind: Any = parameter(
        "m/s",
        "velocity of the air, global frame",
        shape="vector",
        low=-100.0,
        high=100.0,
        default=(3.0, 0.0, 0.0),
    )

    def balance(self, s, t, y, y_t, z, z_t, control):  # type: ignore[no-untyped-def]
        """Return the rates with this robot's additional effect."""
        y_s = super().balance(s, t, y, y_t, z, z_t, control)
        R, q = rotation_matrix(self.y_layout.get(y, "h")), self.y_layout.get(y, "q")
        relative = q - dot(R.T, jnp.asarray(self.wind))
        more = square_law_drag(self.drag, relative) - square_law_drag(self.drag, q)
        return y_s.at[self.y_layout.slice("n")].add(dot(R, more))


class TurningTendons(TendonRobot):
    """Tendons whose forces turn with the rod, fully (1), not at all (0, as in the paper) or in part."""

    turning: Any = parameter("", "part of the tendons' force that turns", low=0.0, high=1.0, default=1.0)

    def balance(self, s, t, y, y_t, z, z_t, control):  # type: ignore[no-untyped-def]
        """Return the rates with this robot's additional effect."""
        y_s = super().balance(s, t, y, y_t, z, z_t, control)
        f = Observed.of(self).actuation(control)
        turned = dot(rotation_matrix(self.y_layout.get(y, "h")), f)
        return y_s.at[self.y_layout.slice("n")].add(self.turning * (f - turned))


class FadingTendons(TendonRobot):
    """Tendons that lose tension along the rod, as by friction: e^(-loss s)."""

    loss: Any = parameter("1/m", "part of the tension lost per length", low=0.0, high=100.0, default=0.3)

    def balance(self, s, t, y, y_t, z, z_t, control):  # type: ignore[no-untyped-def]
        """Return y_s under the tension remaining at s."""
        return super().balance(s, t, y, y_t, z, z_t, jnp.asarray(control) * jnp.exp(-self.loss * s))


# the tip


class LoadedTip(TendonRobot):
    """A robot with a force and a moment at its tip."""

    @abc.abstractmethod
    def load_at_tip(self, R: Any, y: Float[Any, " y"], y_t: Float[Any, " y"]) -> tuple[Any, Any]:
        """Force (N) and moment (N·m) on the tip, in the global frame; R turns the material's into it."""

    def tip(self, t: Any, control: Any, y: Float[Any, " y"], y_t: Float[Any, " y"]) -> Float[Any, " k"]:
        """Return the boundary condition's residual: n and m at the tip equal the load."""
        R = rotation_matrix(self.y_layout.get(y, "h"))
        load = self.load_at_tip(R, y, y_t)
        return super().tip(t, control, y, y_t) + jnp.concatenate(load)


class TipMass(LoadedTip):
    """A body at the tip: n = M (g - a), and the moment of a body with a size or beside the axis."""

    tip_mass: Any = parameter("kg", "mass at the tip", low=0.0, high=100.0, default=0.01)
    tip_inertia: Any = parameter(
        "kg m2", "inertia about its centre", shape="matrix", low=0.0, high=100.0, default=0.0
    )
    tip_offset: Any = parameter(
        "m",
        "its centre as seen from the tip, material frame",
        shape="vector",
        low=-1.0,
        high=1.0,
        default=(0.0, 0.0, 0.0),
    )

    def load_at_tip(self, R: Any, y: Float[Any, " y"], y_t: Float[Any, " y"]) -> tuple[Any, Any]:
        """Return the body's weight minus its inertia force, and the moment about the tip."""
        part = self.y_layout.get
        q, w, q_t, w_t = part(y, "q"), part(y, "w"), part(y_t, "q"), part(y_t, "w")
        offset, J = jnp.asarray(self.tip_offset), jnp.asarray(self.tip_inertia)
        acceleration = q_t + cross(w, q) + cross(w_t, offset) + cross(w, cross(w, offset))
        force = self.tip_mass * (dot(R.T, jnp.asarray(self.gravity)) - acceleration)
        moment = cross(offset, force) - dot(J, w_t) - cross(w, dot(J, w))
        return dot(R, force), dot(R, moment)


class FollowerLoad(LoadedTip):
    """A force and a moment that turn with the tip, as of a jet or a stiff cable."""

    tip_force: Any = parameter(
        "N", "force, material frame", shape="vector", low=-1e3, high=1e3, default=(0.0, 0.0, -0.2)
    )
    tip_moment: Any = parameter(
        "N m", "moment, material frame", shape="vector", low=-1e3, high=1e3, default=(0.0, 0.0, 0.0)
    )

    def load_at_tip(self, R: Any, y: Float[Any, " y"], y_t: Float[Any, " y"]) -> tuple[Any, Any]:
        """Return force and moment, rotated to the global frame."""
        return dot(R, jnp.asarray(self.tip_force)), dot(R, jnp.asarray(self.tip_moment))


class TipFriction(LoadedTip):
    """Robot with a friction force against the tip's velocity."""

    tip_friction: Any = parameter("N", "force of the friction", low=0.0, high=1e3, default=0.05)
    least: Any = parameter("m/s", "velocity from which it is full", low=1e-9, high=1e6, default=0.1)
    law: Rubbing = eqx.field(static=True, default="each axis")

    def load_at_tip(self, R: Any, y: Float[Any, " y"], y_t: Float[Any, " y"]) -> tuple[Any, Any]:
        """Return the friction force and a zero moment."""
        force = -self.tip_friction * rubbing(self.law, self.y_layout.get(y, "q"), self.least)
        return dot(R, force), np.zeros(3)
