"""A Cosserat rod with loads, boundary conditions and contact: the base of all single-rod robots.

`elastic_rod` has the material and the symbols. `slender_rod` is a rod without actuators. `tendon_robot` and
`routed_robot` add tendons.
"""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple, Self

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.elastic_rod import ElasticRod
from knode_cosserat.rods.ends import Clamped, End, Free, Pose, velocities
from knode_cosserat.rods.layout import Layout
from knode_cosserat.rods.loads import (
    Load,
    Motion,
    PointLoad,
    SpreadLoad,
    Wrench,
    point_wrench,
    square_law_drag,
)
from knode_cosserat.rods.parameters import ParameterError, parameter, part
from knode_cosserat.rods.parts import prefixed_fields, shares
from knode_cosserat.rods.section import INWARD, shape_at_rest
from knode_cosserat.rods.surroundings import Obstacle
from knode_cosserat.rods.system import Scales
from knode_cosserat.rotation import cross, dot, quaternion_rate, rotation_matrix

#: first root of cos(x) cosh(x) = -1, the frequency equation of a cantilever
FIRST_ROOT = 1.875104068711961
#: drag × length over mass per length, below which drag is weak: the damping ratio at an amplitude of a
#: tenth of the length is then below 0.2 %
WEAK_DRAG = 0.05
#: default pose of the base
AT_ORIGIN = Pose(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))


class PartControls(NamedTuple):
    """Controls of a rod's parts; sections and loads in their order."""

    base: Any
    tip: Any
    sections: list[Any]
    loads: list[Any]


class Rod(ElasticRod):
    """A round rod with gravity, drag, loads, ends and surroundings.

    A subclass defines its actuators by its own `constitutive` law, or by their load on the rod,
    `actuator_force`.
    """

    mixed: ClassVar[bool] = False
    velocities: ClassVar[tuple[str, ...]] = ("q", "w", "u_t")

    drag: Any = parameter("kg/m2", "C, square-law drag", shape="matrix", low=0.0, high=1e3, default=0.0)
    linear_drag: Any = parameter(
        "kg/(m s)", "drag in proportion to velocity", shape="matrix", low=0.0, high=1e4, default=None
    )
    gravity: Any = parameter(
        "m/s2",
        "gravitational acceleration, global frame",
        shape="vector",
        low=-100.0,
        high=100.0,
        default=(0.0, 0.0, -9.81),
    )
    loads: tuple[Load, ...] = part("what loads it beside gravity and drag", Load, many=True, default=())
    surroundings: tuple[Obstacle, ...] = part("what it may touch", Obstacle, many=True, default=())
    base_end: End = part("what holds it at s = 0", End, default=Clamped())
    tip_end: End = part("what holds it at s = length", End, default=Free())

    def __check_init__(self) -> None:
        if not self.base_end.anywhere:
            raise ParameterError(f"base_end is {self.base_end.kind}; that is allowed as tip_end only")

    # derived quantities

    @property
    def base_unknowns(self) -> tuple[str, ...]:  # type: ignore[override]
        """Unknown fields of y at the base."""
        return self.base_end.unknowns

    @property
    def actuator_layout(self) -> Layout:
        """Layout of the actuators' controls; empty by default."""
        return Layout()

    @property
    def control_layout(self) -> Layout:  # type: ignore[override]
        """Layout of the actuators' controls, then the controls of ends, sections and loads."""
        driven = [
            field for prefix, each in self._driven for field in prefixed_fields(each.control_fields, prefix)
        ]
        return Layout(*self.actuator_layout.fields, *driven)

    @property
    def _driven(self) -> list[tuple[str, Any]]:
        """Parts that may have controls, each with the prefix of its controls' names."""
        ends = [("base", self.base_end), ("tip", self.tip_end)]
        sections = [(f"section{k}", each) for k, each in enumerate(self.sections)]
        return [*ends, *sections, *((f"load{k}", each) for k, each in enumerate(self.loads))]

    def _controls(self, control: Any) -> PartControls:
        """Return the control of each part."""
        spots = shares(tuple(each for _, each in self._driven), self.actuator_layout.size)
        base, tip, *others = (control[spot] for spot in spots)
        return PartControls(base, tip, others[: len(self.sections)], others[len(self.sections) :])

    def section_controls(self, control: Any) -> list[Any]:
        """Return the control of each section."""
        return self._controls(control).sections

    @property
    def rest_is_guess(self) -> bool:  # type: ignore[override]
        """True if the tip is constrained: the unloaded rod need not meet that constraint."""
        return self.tip_end.held

    @property
    def held(self) -> bool:  # type: ignore[override]
        """True if an end is constrained, or there is an obstacle on which the rod may lie."""
        return self.base_end.held or self.tip_end.held or bool(self.surroundings)

    @property
    def is_undamped(self) -> bool:
        """True if no parameter, part or internal variable damps a motion; weak drag does not count."""
        values = (self.bending_damping, self.shear_damping, self.linear_drag)
        internal = not set(self.z_layout.names) <= {"v", "u"}  # friction, relaxation
        if (
            internal
            or self.surroundings
            or any(value is not None and np.any(np.asarray(value)) for value in values)
        ):
            return False
        drag = np.max(np.asarray(self.drag)) * np.max(self.length)
        return bool(drag < WEAK_DRAG * np.min(self.mass_per_length))

    @property
    def bending_frequency(self) -> Any:
        """First bending frequency (Hz) of the bare rod, clamped at the base, by beam theory."""
        EI, mass = np.asarray(self.Kbt)[..., 0, 0], self.mass_per_length * self.length
        return FIRST_ROOT**2 / (2 * np.pi) * np.sqrt(EI / (mass * self.length**3))

    def eased(self, part: float) -> Self:
        """Return the rod with smoothed contact and friction on its obstacles."""
        if not self.surroundings:
            return self
        return self.replace(surroundings=tuple(each.eased(part) for each in self.surroundings))

    # observables for learning

    @property
    def observable_layout(self) -> Layout:
        """Motion and bending, in the material frame."""
        return Layout(
            ("acceleration", 3, "m/s2", "acceleration of the centreline"),
            ("spin", 3, "1/s2", "rate of the angular momentum over ρI"),
            ("q", 3, "m/s", "velocity"),
            ("w", 3, "rad/s", "angular velocity"),
            ("u", 3, "1/m", "curvature"),
            ("u_t", 3, "1/(m s)", "rate of the curvature"),
        )

    def observables(self, s: Any, y: Any, y_t: Any, z: Any, z_t: Any, control: Any) -> Float[Any, " o"]:
        """Return acceleration, spin, q, w, curvature and its rate; see `observable_layout`."""
        q, w = self.y_layout.get(y, "q"), self.y_layout.get(y, "w")
        q_t, w_t = self.y_layout.get(y_t, "q"), self.y_layout.get(y_t, "w")
        u, u_t = self.z_layout.get(z, "u"), self.z_layout.get(z_t, "u")
        J = np.diag([1.0, 1.0, 2.0])
        acceleration, spin = cross(w, q) + q_t, cross(w, dot(J, w)) + dot(J, w_t)
        bent = u - self.material(s, control).u_star
        return jnp.concatenate([acceleration, spin, q, w, bent, u_t])

    # the paper's equations

    def actuator_force(self, control: Float[Any, " c"]) -> Float[Any, "3"] | None:
        """Return the actuators' load per length (N/m), global frame; None by default."""
        return None

    def balance(self, s, t, y, y_t, z, z_t, control):  # type: ignore[no-untyped-def]
        """Return y_s (paper eq. 10, spatial derivatives of the rod)."""
        h, n = self.y_layout.get(y, "h"), self.y_layout.get(y, "n")
        motion = Motion.of(self.y_layout, y, y_t)
        _, R, q, w, q_t, w_t = motion
        v, u = self.z_layout.get(z, "v"), self.z_layout.get(z, "u")
        v_t, u_t = self.z_layout.get(z_t, "v"), self.z_layout.get(z_t, "u")
        *_, rhoA, rhoJ, radius = self.material(s, control)
        dragged = square_law_drag(self.drag, q)
        if self.linear_drag is not None:
            dragged = dragged + dot(self.linear_drag, q)

        p_s = dot(R, v)
        h_s = quaternion_rate(h, u)
        n_s = dot(R, rhoA * (cross(w, q) + q_t) + dragged) - rhoA * self.gravity
        m_s = dot(R, cross(w, dot(rhoJ, w)) + dot(rhoJ, w_t)) - cross(p_s, n)
        q_s = v_t - cross(u, q) + cross(w, v)
        w_s = u_t - cross(u, w)
        pushed = self.actuator_force(control)
        if pushed is not None:
            n_s = n_s - pushed
        for load in self._distributed(s, motion, radius, control):
            n_s, m_s = n_s - load.force, m_s - load.moment
        return jnp.concatenate([p_s, h_s, n_s, m_s, q_s, w_s])

    def _distributed(self, s: Any, motion: Motion, radius: Any, control: Any) -> list[Wrench]:
        """Return the wrenches of loads and surroundings, per length."""
        found = [obstacle.wrench(motion, radius) for obstacle in self.surroundings]
        for load, own in zip(self.loads, self._controls(control).loads, strict=True):
            if not isinstance(load, SpreadLoad):
                continue
            wrench = load.wrench(motion, own)
            if (load.begin, load.end) != (0.0, 1.0):
                acts = (s >= load.begin * self.length) & (s <= load.end * self.length)
                wrench = Wrench(*(jnp.where(acts, each, 0.0) for each in wrench))
            found.append(wrench)
        return found

    # discontinuities: places where something begins, ends or pulls

    @property
    def cuts(self) -> tuple[float, ...]:  # type: ignore[override]
        """Places where loads and sections begin or end, and where point loads act."""
        stretches: list[Any] = [
            *self.sections,
            *(load for load in self.loads if isinstance(load, SpreadLoad)),
        ]
        found = {end for each in stretches for end in (each.begin, each.end)}
        found -= {0.0}
        found |= {load.at for load in self.loads if isinstance(load, PointLoad)}
        return tuple(sorted(cut for cut in found if cut < 1.0))

    @property
    def jumps(self) -> bool:  # type: ignore[override]
        """True if a point load acts before the tip."""
        return any(isinstance(load, PointLoad) and load.at < 1.0 for load in self.loads)

    def jump(
        self, acting: Float[Any, " cuts"], t: Any, y: Float[Any, " y"], y_t: Float[Any, " y"], control: Any
    ) -> Float[Any, " y"]:
        """Return y on the far side of the acting cuts: n and m less the point loads there."""
        places = {cut: k for k, cut in enumerate(self.cuts)}
        weights = {k: acting[places[load.at]] for k, load in self._points() if load.at in places}
        wrench = self._point_wrench(weights, y, y_t, control)
        change = jnp.concatenate([np.zeros(7), wrench.force, wrench.moment])
        return y - jnp.concatenate([change, np.zeros(self.y_layout.size - 13)])

    def _points(self) -> list[tuple[int, PointLoad]]:
        return [(k, load) for k, load in enumerate(self.loads) if isinstance(load, PointLoad)]

    def _point_wrench(self, weights: Any, y: Any, y_t: Any, control: Any) -> Wrench:
        """Return the sum of the point loads, each times its weight."""
        controls = self._controls(control).loads
        motion = Motion.of(self.y_layout, y, y_t)
        acting = [(self.loads[k], weight, controls[k]) for k, weight in weights.items()]
        return point_wrench(acting, motion, self.gravity)

    # the two ends, and rest

    def rest(self, s: Any) -> tuple[Float[Any, " y"], Float[Any, " z"]]:
        """Return y and z of the unloaded rod at rest: straight, or with the sections' curvature."""
        s = jnp.asarray(s, dtype=float)
        p, h, u = self._rest_shape(self.base_end.pose(AT_ORIGIN, self._no_control(0)), s)
        y = jnp.concatenate([p, h, np.zeros(self.y_layout.size - 7)])
        return y, jnp.concatenate([self.v_star, u])

    def _no_control(self, k: int) -> np.ndarray:
        """Return the zero control of the k-th driven part."""
        return np.zeros(sum(field.size for field in self._driven[k][1].control_fields))

    def _rest_shape(self, base: Pose, s: Any) -> tuple[Any, Any, Any]:
        if not self.sections:
            along = dot(rotation_matrix(base.h), jnp.stack([jnp.zeros(()), jnp.zeros(()), s]))
            return base.p + along, base.h, np.zeros(3)
        still = np.zeros(self.control_layout.size)

        def curvature(at: Any) -> Any:
            return self.material(at, still).u_star

        ends = {place for each in self.sections for place in (each.begin, each.end)}
        edges = np.array(sorted({0.0, *ends, 1.0}))
        # z at a node is the far-side value, and where two sections meet both curvatures act; the margin is
        # less than the distance that moves places away from that side
        margin = 0.2 * INWARD * self.length / (self.nodes - 1)
        beyond = jnp.minimum(s + margin, self.length - margin)
        return *shape_at_rest(base.p, base.h, s, curvature, self.length, edges), curvature(beyond)

    def base(self, t: Any, control: Any, unknowns: Float[Any, " k"]) -> Float[Any, " y"]:
        """Return y at s = 0: the pose of the base's end, with the unknowns."""
        held = self.base_end.pose(AT_ORIGIN, self._controls(control).base)
        y = jnp.concatenate([held.p, held.h, np.zeros(self.y_layout.size - 7)])
        return self.y_layout.replaced(y, self.base_unknowns, unknowns)

    def moving_base(self, y: Float[Any, " y"], y_t: Float[Any, " y"]) -> Float[Any, " y"]:
        """Return y at s = 0 with the velocities of the base's pose; a clamped base does not move."""
        if type(self.base_end) is Clamped:
            return y
        q, w = velocities(self._pose(y), self._pose(y_t))
        return jnp.concatenate([y[:13], q, w, y[19:]])

    def end_poses(self, control: Any) -> tuple[Pose | None, Pose | None]:
        """Return the clamped poses of the two ends under a control; None for an end that is not clamped."""
        controls, rest = self._controls(control), self._pose(self.rest(self.length)[0])
        ends = (self.base_end, AT_ORIGIN, controls.base), (self.tip_end, rest, controls.tip)
        base, tip = (end.pose(at, own) if isinstance(end, Clamped) else None for end, at, own in ends)
        return base, tip

    def _pose(self, y: Any) -> Pose:
        return Pose(self.y_layout.get(y, "p"), self.y_layout.get(y, "h"))

    def tip(self, t: Any, control: Any, y: Float[Any, " y"], y_t: Float[Any, " y"]) -> Float[Any, " k"]:
        """Return the residual of the tip's conditions with the loads there, and of the quaternion's norm."""
        n, m = self.y_layout.get(y, "n"), self.y_layout.get(y, "m")
        at_tip = {k: 1.0 for k, load in self._points() if load.at == 1.0}
        if at_tip:
            loaded = self._point_wrench(at_tip, y, y_t, control)
            n, m = n - loaded.force, m - loaded.moment
        if type(self.tip_end) is Free:
            left = jnp.concatenate([-n, -m])
        else:
            rest = self._pose(self.rest(self.length)[0])
            held = self.tip_end.pose(rest, self._controls(control).tip)
            left = self.tip_end.left(held, self._pose(y), n, m)
        if "h" not in self.base_unknowns:
            return left
        h = self.y_layout.get(y, "h")
        return jnp.concatenate([left, jnp.sum(h * h)[None] - 1.0])

    @property
    def tip_layout(self) -> Layout:
        """Layout of the tip's conditions: force and moment, or the constrained pose."""
        fields = self.tip_end.conditions
        if "h" in self.base_unknowns:
            fields = (*fields, ("norm", 1, "1", "square of the length of the quaternion, less one"))
        return Layout(*fields)

    def scales(self) -> Scales:
        """Return the scales of a beam: length L, force EI/L², moment EI/L, time L² √(ρA/EI)."""
        L, EI = self.length, self.Kbt[0, 0]
        T = L * L * jnp.sqrt(self.mass_per_length / EI)
        sizes = {
            "p": L, "h": 1.0, "n": EI / (L * L), "m": EI / L, "q": L / T, "w": 1.0 / T,
            "turn": 1.0, "norm": 1.0,
        }  # fmt: skip

        def of(layout: Layout) -> Any:
            return jnp.concatenate([jnp.full(f.size, self.scale_of(f.name, sizes)) for f in layout.fields])

        return Scales(of(self.y_layout), of(self.tip_layout))

    def scale_of(self, name: str, sizes: dict[str, Any]) -> Any:
        """Return the natural size of a field of y or of the tip's conditions; `sizes` are those of a beam."""
        return sizes[name]
