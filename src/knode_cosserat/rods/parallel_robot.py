"""A parallel continuum robot: elastic legs from linear actuators to one rigid platform.

With six legs in pairs the layout is that of Stewart and Gough (Black, Till & Rucker 2018; Till, Aloi & Rucker
2019). Symbols as in `rod`, for each leg.
"""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.aspects import Drawing, Ends, Observed
from knode_cosserat.rods.camera import Camera
from knode_cosserat.rods.layout import Layout
from knode_cosserat.rods.parameters import Doubt, ParameterError, parameter, slot, stated_of
from knode_cosserat.rods.parts import RodPoint
from knode_cosserat.rods.rod import Y_LAYOUT, Z_LAYOUT, SlenderRod
from knode_cosserat.rods.section import CrossSection
from knode_cosserat.rods.shapes import Shape, ball
from knode_cosserat.rods.strands import Bundle, in_strands
from knode_cosserat.rods.system import Discontinuities, Scales, System, array_module
from knode_cosserat.rotation import cross, dot, rotation_matrix

#: indices in a leg's y at which the fields after p begin
FIELDS = np.cumsum([field.size for field in Y_LAYOUT.fields])[:-1]


class _Leg(SlenderRod):
    """The rod between base and platform. Its control is the control of the whole robot."""

    y_layout: ClassVar[Layout] = Y_LAYOUT
    z_layout: ClassVar[Layout] = Z_LAYOUT
    base_unknowns: ClassVar[tuple[str, ...]] = ("n", "m")

    legs: int = eqx.field(static=True, default=6)

    @property
    def control_layout(self) -> Layout:  # type: ignore[override]
        """One displacement per leg."""
        return Layout(("displacement", self.legs, "m", "displacement of each leg's base along z"))


def _of_rod(name: str) -> Any:
    """Return a field that states a parameter as `_Leg` does."""
    stated = _Leg.__dataclass_fields__[name]
    default = {} if stated.default is dataclasses.MISSING else {"default": stated.default}
    return dataclasses.field(metadata=stated.metadata, kw_only=True, **default)


class ParallelRobot(Bundle):
    """Legs clamped in actuators that move along z, and clamped again in a rigid platform.

    The base of leg i is at the angle base_angles[i] on the base's circle, at the height of control i. Its end
    is at platform_angles[i] on the platform, with the platform's orientation. Unbent legs are straight along
    z, with the platform at height `length` and not rotated. The platform is a rigid body whose centre of mass
    is the centre of its circle of joints.

    `positions` and `quaternions` describe one line, the robot's axis, which ends in the platform's centre. At
    every node it is the mean of the platform poses that the legs imply. `leg_positions` has the legs.

    If the angles or radii of base and platform differ, the legs are bent at rest, and `rest` is a guess from
    the theory of slender beams. A simulation therefore starts at the equilibrium under zero control.
    """

    kind: ClassVar[str] = "parallel-robot"
    strand_class: ClassVar[type[System]] = _Leg
    alternatives: ClassVar[tuple[tuple[str, ...], ...]] = _Leg.alternatives
    length: Any = _of_rod("length")
    radius: Any = _of_rod("radius")
    density: Any = _of_rod("density")
    youngs_modulus: Any = _of_rod("youngs_modulus")
    tip_radius: Any = _of_rod("tip_radius")
    cross_section: CrossSection | None = _of_rod("cross_section")
    base_radius: Any = parameter(
        "m", "radius of the circle on which the legs begin", low=0.0, high=20.0, doubt=Doubt(0.02)
    )
    platform_radius: Any = parameter(
        "m", "radius of the platform's circle of joints", low=0.0, high=20.0, doubt=Doubt(0.02)
    )
    base_angles: Any = parameter(
        "rad",
        "angles of the legs on the base, one a leg",
        shape="list",
        low=-10.0,
        high=10.0,
        doubt=Doubt(absolute=0.02),
    )
    platform_angles: Any = parameter(
        "rad",
        "angles of the legs on the platform, one a leg",
        shape="list",
        low=-10.0,
        high=10.0,
        doubt=Doubt(absolute=0.02),
    )
    platform_mass: Any = parameter("kg", "mass of the platform", low=0.0, high=1e4, doubt=Doubt(0.1))
    platform_inertia: Any = parameter(
        "kg m2",
        "inertia of the platform about its centre; by default of a disc as wide as its joints",
        shape="matrix",
        low=0.0,
        high=1e6,
        default=None,
    )
    platform_force: Any = parameter(
        "N",
        "load on the platform's centre, global frame",
        shape="vector",
        low=-1e6,
        high=1e6,
        default=(0.0, 0.0, 0.0),
    )
    platform_moment: Any = parameter(
        "N m",
        "moment on the platform, global frame",
        shape="vector",
        low=-1e6,
        high=1e6,
        default=(0.0, 0.0, 0.0),
    )
    shear_modulus: Any = _of_rod("shear_modulus")
    shear_damping: Any = _of_rod("shear_damping")
    bending_damping: Any = _of_rod("bending_damping")
    drag: Any = _of_rod("drag")
    linear_drag: Any = _of_rod("linear_drag")
    gravity: Any = _of_rod("gravity")
    shear_stiffness: Any = _of_rod("shear_stiffness")
    bending_stiffness: Any = _of_rod("bending_stiffness")
    camera: Camera | None = slot("frame and tip marker of measured positions", Camera, default=None)

    def __check_init__(self) -> None:
        base, platform = np.shape(self.base_angles), np.shape(self.platform_angles)
        if base != platform:
            raise ParameterError(
                f"there are {base[-1]} base_angles and {platform[-1]} platform_angles; "
                "allowed is one of each for every leg"
            )

    # derived quantities

    @property
    def strands(self) -> int:
        """Number of legs."""
        return np.shape(self.base_angles)[-1]

    @property
    def strand(self) -> _Leg:
        """Equations along a leg; the legs share them."""
        return _Leg(**{name: getattr(self, name) for name in LEG}, legs=self.strands, nodes=self.nodes)

    @property
    def usual_shear_modulus(self) -> Any:
        """Shear modulus (Pa) of the legs without the parameter (`SlenderRod.usual_shear_modulus`)."""
        return self.strand.usual_shear_modulus

    @property
    def usual_shear_stiffness(self) -> Any:
        """Stiffness (N) of the legs without the parameter (`SlenderRod.usual_shear_stiffness`)."""
        return self.strand.usual_shear_stiffness

    @property
    def control_layout(self) -> Layout:  # type: ignore[override]
        """Layout of the legs' control."""
        return Layout(("displacement", self.strands, "m", "displacement of each leg's base along z"))

    @property
    def discontinuities(self) -> Discontinuities:  # type: ignore[override]
        """Kinks of tabulated legs."""
        return Discontinuities(() if self.cross_section is None else self.cross_section.cuts)

    @property
    def inertia(self) -> Float[Any, "3 3"]:
        """The platform's inertia about its centre, in its frame (kg m²)."""
        if self.platform_inertia is not None:
            return self.platform_inertia
        return self.platform_mass * self.platform_radius**2 / 4.0 * np.diag([1.0, 1.0, 2.0])

    @property
    def joints(self) -> Float[Any, "legs 3"]:
        """Positions of the legs' ends relative to the platform's centre, in its frame (m)."""
        return _on_circle(self.platform_radius, self.platform_angles)

    # the state of each leg

    def legs(self, y: Float[Any, "*n y"]) -> list[Any]:
        """Return p, h, n, m, q and w (…, legs, size) of states y."""
        numeric = array_module(y)
        return numeric.split(in_strands(self, y), FIELDS, axis=-1)

    def leg_positions(self, y: Any) -> Any:
        """Return the positions (…, legs, 3) in m of the legs' points, from states y (…, y)."""
        return self.legs(y)[0]

    def platform_position(self, y: Any) -> Any:
        """Return the platform's centre (…, 3) in m, from the robot's states y (…, nodes, y)."""
        return Drawing.of(self).positions(y[..., -1, :])

    def platform_orientation(self, y: Any) -> Any:
        """Return the platform's orientation (…, 4), scalar first, from the robot's states y (…, nodes, y)."""
        return Drawing.of(self).quaternions(y[..., -1, :])

    # the two ends, and rest

    def rest(self, s: Any) -> tuple[Float[Any, " y"], Float[Any, " z"]]:
        """Return straight unloaded legs if the joints face each other, else an estimate by slender beams."""
        L, EI, count = self.length, jnp.asarray(self.strand.Kbt)[:2, :2], self.strands
        begin, end = _on_circle(self.base_radius, self.base_angles), self.joints
        facing, off = jnp.sum(begin * end), jnp.sum(begin[:, 1] * end[:, 0] - begin[:, 0] * end[:, 1])
        # rotation of the platform that brings its joints nearest to the base's, if it is defined
        known = facing**2 + off**2 > 0.0
        turn = jnp.where(known, jnp.arctan2(off, jnp.where(known, facing, 1.0)), 0.0)
        x, y = end[:, 0], end[:, 1]
        c, d = jnp.cos(turn), jnp.sin(turn)
        away = jnp.stack([c * x - d * y, d * x + c * y], axis=1) - begin[:, :2]
        part = jnp.asarray(s / L, dtype=float)
        moved, slope = part * part * (3.0 - 2.0 * part), 6.0 * part * (1.0 - part) / L
        bent, sheared = (6.0 - 12.0 * part) / L**2, 12.0 / L**3
        zero, one = jnp.zeros(count), jnp.ones(count)
        twist = 0.5 * turn * part
        p = jnp.concatenate([begin[:, :2] + moved * away, (s * one)[:, None]], axis=1)
        across = jnp.stack([-away[:, 1], away[:, 0]], axis=1)
        h = jnp.concatenate(
            [(jnp.cos(twist) * one)[:, None], 0.5 * slope * across, (jnp.sin(twist) * one)[:, None]], axis=1
        )
        stiff = across @ EI
        n = jnp.concatenate([sheared * stiff[:, 1:], -sheared * stiff[:, :1], zero[:, None]], axis=1)
        m, u = (jnp.concatenate([bent * each, zero[:, None]], axis=1) for each in (stiff, across))
        v = jnp.tile(self.strand.v_star, (count, 1))
        state = jnp.concatenate([p, h, n, m, jnp.zeros((count, 6))], axis=1)
        return state.reshape(-1), jnp.concatenate([v, u], axis=1).reshape(-1)

    def base(self, t: Any, control: Any, unknowns: Float[Any, " k"]) -> Float[Any, " y"]:
        """Return y at the base: the actuators' positions along z."""
        count = self.strands
        height = jnp.asarray(control)
        p = _on_circle(self.base_radius, self.base_angles) + height[:, None] * np.array([0.0, 0.0, 1.0])
        h = jnp.tile(np.array([1.0, 0.0, 0.0, 0.0]), (count, 1))
        loads = in_strands(self, unknowns)
        return jnp.concatenate([p, h, loads, jnp.zeros((count, 6))], axis=1).reshape(-1)

    def tip(self, t: Any, control: Any, y: Float[Any, " y"], y_t: Float[Any, " y"]) -> Float[Any, " k"]:
        """Return the residuals of the platform's motion and of the joints with the legs' tips."""
        p, h, n, m, _, _ = self.legs(y)
        R, M = rotation_matrix(h[0]), self.platform_mass
        arms = jax.vmap(lambda joint: dot(R, joint))(self.joints)
        # in its frame, from the mean of the legs' velocities, which differ a little on a coarse grid
        q, w = self.platform_velocity(y)
        q_t, w_t = self.platform_velocity(y_t)
        acceleration = q_t + cross(w, q)
        momentum_rate = dot(self.inertia, w_t) + cross(w, dot(self.inertia, w))
        force = M * (self.gravity - dot(R, acceleration)) + self.platform_force - jnp.sum(n, axis=0)
        twisting = jnp.sum(m + jax.vmap(cross)(arms, n), axis=0)
        moment = self.platform_moment - dot(R, momentum_rate) - twisting
        centres = p - arms
        gaps = centres[1:] - centres[0]
        turns = jax.vmap(lambda other: _turn(h[0], other))(h[1:])
        return jnp.concatenate([force, moment, jnp.concatenate([gaps, turns], axis=1).reshape(-1)])

    def platform_velocity(self, y: Any) -> tuple[Any, Any]:
        """Return velocity and angular velocity of the platform's centre, in its frame; or their rates."""
        *_, q, w = self.legs(y)
        w = jnp.mean(w, axis=0)
        return jnp.mean(q, axis=0) - cross(w, jnp.mean(jnp.asarray(self.joints), axis=0)), w

    def scales(self) -> Scales:
        """Return a leg's scales for every leg; a gap's scale is the leg's length, a turn's one radian."""
        leg = self.strand.scales()
        gaps = jnp.concatenate([jnp.full(3, self.length), jnp.ones(3)])
        rest = jnp.tile(gaps, self.strands - 1)
        return Scales(jnp.tile(leg.y, self.strands), jnp.concatenate([leg.tip, rest]))


#: rod parameters that a leg takes from the robot
LEG = tuple(name for name in stated_of(ParallelRobot) if name in stated_of(_Leg))


class _PlatformEnds(Ends, of=ParallelRobot):
    """Actuators at the base, and the platform at the tip."""

    system: ParallelRobot
    rest_is_guess = True

    @property
    def layout(self) -> Layout:
        """Force and moment on the platform, and the other legs' tip errors relative to the first leg."""
        gaps = [
            field
            for k in range(2, self.system.strands + 1)
            for field in (
                (f"gap{k}", 3, "m", f"distance of leg {k}'s tip from its joint"),
                (f"turn{k}", 3, "rad", f"turn of leg {k}'s tip from the platform"),
            )
        ]
        return Layout(
            ("force", 3, "N", "force on the platform, global frame", "h1", "N"),
            ("moment", 3, "N m", "moment on the platform, global frame", "h1", "N m"),
            *gaps,
        )

    def moving_base(self, y: Float[Any, " y"], y_t: Float[Any, " y"]) -> Float[Any, " y"]:
        """Return y at the base with the actuators' velocities along z."""
        legs, speed = in_strands(self.system, y), self.system.legs(y_t)[0][:, 2:]
        q = jnp.concatenate([jnp.zeros((self.system.strands, 2)), speed], axis=1)
        return jnp.concatenate([legs[:, :13], q, legs[:, 16:]], axis=1).reshape(-1)


class _PlatformDrawing(Drawing, of=ParallelRobot):
    """Axis of the robot, and lines of its legs and platform."""

    system: ParallelRobot
    outlines = 1

    def curves(self, y: Any) -> list[Any]:
        """Return every leg's curve, and the polygon of the platform's joints."""
        legs = np.moveaxis(np.asarray(self.system.leg_positions(y)), -2, 0)
        order = np.argsort(np.asarray(self.system.platform_angles) % (2.0 * np.pi))
        joints = np.moveaxis(legs[np.append(order, order[0]), ..., -1, :], 0, -2)
        return [*legs, joints]

    def shapes(self, y: Any, control: Any) -> list[Shape]:
        """Return the legs, the rods of their actuators, and the joints on the platform."""
        legs = np.moveaxis(np.asarray(self.system.leg_positions(y)), -2, 0)
        radius, length = float(self.system.strand.section.radius), float(self.system.length)
        ground = np.array([1.0, 1.0, 0.0])
        found = []
        for k, leg in enumerate(legs, 1):
            base, tip = leg[:, 0], leg[:, -1]
            found.append(Shape("rod", f"leg {k}", None, leg, radius))
            fixed = ground * base - np.array([0.0, 0.0, 0.15 * length])
            actuator = np.stack([fixed, base], axis=1)
            found.append(Shape("joint", f"actuator {k}", None, actuator, 1.8 * radius))
            joint = ball("joint", f"joint {k}", 1.0, 2.2 * radius, turns=False)
            found.append(joint._replace(at=None, offset=tip[:, None] + joint.offset))
        return found

    def positions(self, y: Any) -> Any:
        """Return the robot's axis (…, 3) in m, from states y (…, y); at the tip, the platform's centre."""
        numeric = array_module((self.system, y))
        p, h, *_ = self.system.legs(y)
        w, x = h[..., :1], h[..., 1:]
        joints = numeric.asarray(self.system.joints)
        # each robot of a batch has its own joints
        lead = joints.shape[:-2] + (1,) * (p.ndim - joints.ndim)
        joints = numeric.broadcast_to(joints.reshape(*lead, *joints.shape[-2:]), p.shape)
        across = numeric.cross(x, joints)
        k = 2.0 / numeric.sum(h * h, axis=-1, keepdims=True)
        arms = joints + k * (w * across + numeric.cross(x, across))
        return numeric.mean(p - arms, axis=-2)

    def quaternions(self, y: Any) -> Any:
        """Return the legs' mean orientations (…, 4), scalar first; at the tip, the platform's."""
        numeric = array_module((self.system, y))
        h = self.system.legs(y)[1]
        h = h / numeric.sqrt(numeric.sum(h * h, axis=-1, keepdims=True))
        same = numeric.sum(h * h[..., :1, :], axis=-1, keepdims=True) >= 0.0
        total = numeric.sum(numeric.where(same, h, -h), axis=-2)
        return total / numeric.sqrt(numeric.sum(total * total, axis=-1, keepdims=True))


class _PlatformObserved(Observed, of=ParallelRobot):
    """Motion of the platform, in its frame."""

    system: ParallelRobot
    velocities: ClassVar[tuple[str, ...]] = ("q", "w")

    @property
    def layout(self) -> Layout:
        """The platform's motion, in its frame; the legs' own observables belong to the strand."""
        return Layout(
            ("acceleration", 3, "m/s2", "acceleration of the platform"),
            ("spin", 3, "1/s2", "rate of the platform's angular velocity, as a rigid body's"),
            ("q", 3, "m/s", "velocity of the platform"),
            ("w", 3, "rad/s", "angular velocity of the platform"),
        )

    def observables(self, point: RodPoint) -> Float[Any, " o"]:
        """Return the platform's acceleration, spin, q and w; see `layout`."""
        q, w = self.system.platform_velocity(point.y)
        q_t, w_t = self.system.platform_velocity(point.y_t)
        return jnp.concatenate([q_t + cross(w, q), w_t, q, w])


def _on_circle(radius: Any, angles: Any) -> Float[Any, "legs 3"]:
    numeric = array_module((radius, angles))
    radius = numeric.asarray(radius)[..., None]
    x, y = radius * numeric.cos(angles), radius * numeric.sin(angles)
    return numeric.stack([x, y, numeric.zeros(numeric.shape(angles))], axis=-1)


def _turn(one: Float[Any, "4"], other: Float[Any, "4"]) -> Float[Any, "3"]:
    """Return twice the sine of half the angle between two orientations times its axis, in one's frame."""
    a, b = one[0], other[0]
    vector = a * other[1:] - b * one[1:] - cross(one[1:], other[1:])
    return 2.0 * vector / jnp.sqrt(jnp.sum(one * one) * jnp.sum(other * other))
