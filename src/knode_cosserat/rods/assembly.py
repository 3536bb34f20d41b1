"""Assemblies: rods of any kind that rigid bodies join, in a tree or with closed loops.

All rods run side by side over one grid of s/length. A body has an unknown pose (p, h), and its fields of y
are constant along the grid. Both ends of a rod therefore meet the body at the tip, where the conditions are.
With the wrench n, m of each rod on the body (at its base; at its tip it is -n, -m), and r from the body's
centre of mass to the joint, in the global frame,

    M p_tt = M g + f + Σ n,      d(R J ω)/dt = l + Σ (m + r × n).

Neighbours in contact push each other with the law of `surroundings`, where s/length is equal.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, ClassVar, Self

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat._files.yaml_text import did_you_mean
from knode_cosserat.rods.aspects import Drawing, Ends, Observed
from knode_cosserat.rods.camera import Camera
from knode_cosserat.rods.ends import AT_ORIGIN, Pose, velocities
from knode_cosserat.rods.law import JointLaw
from knode_cosserat.rods.layout import Layout
from knode_cosserat.rods.loads import BodyInertia, Motion
from knode_cosserat.rods.parameters import Doubt, ParameterError, parameter, slot, text
from knode_cosserat.rods.parts import Part, RodPoint, Wrench
from knode_cosserat.rods.rod import Y_LAYOUT, SlenderRod
from knode_cosserat.rods.shapes import Shape
from knode_cosserat.rods.surroundings import ContactLaw, velocity_at
from knode_cosserat.rods.system import Discontinuities, Scales, System, is_traced
from knode_cosserat.rotation import cross, quaternion_of, quaternion_product


def _copy(part: Any, **fields: Any) -> Any:
    """Return a copy with other fields, unchecked: where code is made, parameters are any numbers or none."""
    copy = object.__new__(type(part))
    for field in dataclasses.fields(part):
        object.__setattr__(copy, field.name, fields.get(field.name, getattr(part, field.name)))
    return copy


#: gravity of rods that state none
GRAVITY: Any = SlenderRod.__dataclass_fields__["gravity"].default


class RigidBody(Part):
    """A rigid body that holds ends of rods. The origin of its frame is its centre of mass."""

    kind: ClassVar[str] = "body"

    name: str = text("name, by which ends refer to it")
    mass: Any = parameter("kg", "mass", low=0.0, high=1e4, default=0.0, doubt=Doubt(0.1))
    inertia: Any = parameter(
        "kg m2",
        "inertia about its centre of mass, in its frame",
        shape="matrix",
        low=0.0,
        high=1e6,
        default=0.0,
    )
    force: Any = parameter(
        "N",
        "load on its centre of mass, global frame",
        shape="vector",
        low=-1e6,
        high=1e6,
        default=(0.0, 0.0, 0.0),
    )
    moment: Any = parameter(
        "N m", "moment on it, global frame", shape="vector", low=-1e6, high=1e6, default=(0.0, 0.0, 0.0)
    )


class NeighbourContact(ContactLaw):
    """Contact of two rods side by side: at equal places of the grid, with equal and opposite forces.

    The normal is across the mean of their axes, along which they may slide by much less than their length.
    """

    kind: ClassVar[str] = "neighbours"

    first: str = text("name of a rod")
    second: str = text("name of the other rod")

    @property
    def names(self) -> tuple[str, str]:
        """Names of both rods."""
        return self.first, self.second

    def wrenches(self, motions: list[Motion], radii: list[Any]) -> list[Wrench]:
        """Return the loads on the rods, per length of the first (N/m, N), global frame."""
        axis = motions[0].R[:, 2] + motions[1].R[:, 2]
        away = motions[0].p - motions[1].p
        away = away - axis * (jnp.sum(away * axis) / jnp.sum(axis * axis))
        distance = jnp.sqrt(jnp.sum(away * away) + 1e-24)
        normal = away / distance
        arms = [-radii[0] * normal, radii[1] * normal]
        one, other = (velocity_at(motion, arm) for motion, arm in zip(motions, arms, strict=True))
        force = self.force(distance - radii[0] - radii[1], normal, one - other)
        return [Wrench(each, cross(arm, each)) for arm, each in zip(arms, (force, -force), strict=True)]


class Assembly(System):
    """Rods that are joined by rigid bodies.

    The ends of each rod are on the ground or, where they name a body, on that body, in whose frame their pose
    is then stated. Fields of y and z, controls and conditions have the name of their rod or body in front.
    Rods have the gravity of the assembly.
    """

    kind: ClassVar[str] = "assembly"
    mixed: ClassVar[bool] = False

    rods: tuple[SlenderRod, ...] = slot("rods, each with its name", SlenderRod, many=True, default=())
    bodies: tuple[RigidBody, ...] = slot("bodies that join the rods", RigidBody, many=True, default=())
    contacts: tuple[NeighbourContact, ...] = slot(
        "contacts of neighbouring rods", NeighbourContact, many=True, default=()
    )
    gravity: Any = parameter(
        "m/s2",
        "gravitational acceleration, global frame",
        shape="vector",
        low=-100.0,
        high=100.0,
        default=(0.0, 0.0, -9.81),
        doubt=Doubt(absolute=0.3),
    )
    camera: Camera | None = slot("frame and tip marker of measured positions", Camera, default=None)

    @functools.cached_property
    def members(self) -> tuple[SlenderRod, ...]:
        """Rods with the grid and the gravity of the assembly."""
        return tuple(_copy(rod, nodes=self.nodes, gravity=self.gravity) for rod in self.rods)

    @property  # type: ignore[misc]
    def length(self) -> Any:
        """Length of the first rod (m), in which s is stated."""
        return self.rods[0].length

    def replace(self, **changes: Any) -> Self:
        """Return a copy with other parameters, by name; another `length` changes all rods in proportion."""
        if "length" in changes:
            factor = changes.pop("length") / self.length
            changes = {f"rods.{rod.name}.length": rod.length * factor for rod in self.rods} | changes
        return super().replace(**changes)

    def __check_init__(self) -> None:
        rods, bodies = [rod.name for rod in self.rods], [body.name for body in self.bodies]
        names = rods + bodies
        if not self.rods:
            raise ParameterError("rods is []; allowed is one or more")
        for name in names:
            if not name:
                raise ParameterError(
                    "a rod or a body has no name; allowed is one for each, such as name: arm"
                )
            if names.count(name) > 1:
                raise ParameterError(
                    f"{names.count(name)} of the rods and bodies have the name {name!r}; "
                    "allowed is another name for each"
                )
        for rod in self.rods:
            for end, where in (rod.base_end, f"{rod.name}.base_end"), (rod.tip_end, f"{rod.name}.tip_end"):
                if end.body and end.body not in bodies:
                    raise ParameterError(
                        f"{where}.body is {end.body!r}; allowed is {', '.join(bodies) or 'none'}"
                        f"{did_you_mean(end.body, bodies)}"
                    )
                if not end.held and (end.body or end is rod.base_end):
                    raise ParameterError(f"{where} is free; allowed is an end that is held, or a free tip")
            if any(part.gyroscopic for part in rod.parts.values()):
                raise ParameterError(
                    f"{rod.name} has a spinning frame; allowed are rods seen from the ground"
                )
            known = GRAVITY, self.gravity
            if not is_traced((rod, self.gravity)) and not any(np.array_equal(rod.gravity, g) for g in known):
                raise ParameterError(f"{rod.name} has a gravity of its own; allowed is that of the assembly")
        for contact in self.contacts:
            if not {*contact.names} <= {*rods} or contact.first == contact.second:
                raise ParameterError(
                    f"a contact is of {contact.first!r} and {contact.second!r}; "
                    f"allowed is two of {', '.join(rods)}"
                )
        for name in bodies:
            if not any(name in (rod.base_end.body, rod.tip_end.body) for rod in self.rods):
                raise ParameterError(f"the body {name!r} holds no rod; allowed is a body that joins rods")
        if left := [rod.name for rod in self.rods if rod.name not in self.reached]:
            raise ParameterError(
                f"no rod joins {', '.join(left)} to the ground; allowed is an assembly on the ground"
            )

    @property
    def winding(self) -> float:
        """Largest angle (rad) through which a part of a rod turns along it."""
        return max(rod.winding for rod in self.rods)

    @property
    def reached(self) -> dict[str, str]:
        """Rods that lead from the ground, in order, each with the body that it places, if any."""
        order: dict[str, str] = {}
        known, count = {""}, -1
        while len(order) > count:
            count = len(order)
            for rod in self.rods:
                ends = [end.body for end in (rod.base_end, rod.tip_end) if end.held]
                if rod.name not in order and known & {*ends}:
                    order[rod.name] = next((body for body in ends if body not in known), "")
                    known |= {*ends}
        return order

    # layouts

    def joined(self, layouts: Any, bodies: Layout | None = None) -> Layout:
        """Return the layouts of all rods, and that of every body, with the names in front."""
        every: list[Any] = list(zip(self.rods, layouts, strict=True))
        every += [(body, bodies) for body in self.bodies if bodies]
        return Layout(
            *(
                field._replace(
                    name=f"{part.name}_{field.name}",
                    meaning=f"{field.meaning}, {part.name}",
                    frame=field.frame and f"{part.name}_{field.frame}",
                )
                for part, layout in every
                for field in layout.fields
            )
        )

    @functools.cached_property
    def y_layout(self) -> Layout:  # type: ignore[override]
        """Layout of y: that of each rod, then of each body, whose n and m are the wrench of bases on it."""
        return self.joined((rod.y_layout for rod in self.members), Y_LAYOUT)

    @functools.cached_property
    def z_layout(self) -> Layout:  # type: ignore[override]
        """Layout of z: that of each rod."""
        return self.joined(rod.z_layout for rod in self.members)

    @functools.cached_property
    def control_layout(self) -> Layout:  # type: ignore[override]
        """Layout of the controls of all rods."""
        return self.joined(rod.control_layout for rod in self.members)

    @functools.cached_property
    def base_unknowns(self) -> tuple[str, ...]:  # type: ignore[override]
        """Unknown fields at the bases of the rods, and the poses of the bodies."""
        rods = (f"{rod.name}_{name}" for rod in self.members for name in rod.base_unknowns)
        return (*rods, *(f"{body.name}_{name}" for body in self.bodies for name in ("p", "h")))

    def split(self, packed: Any, sizes: Any) -> list[Any]:
        """Return a packed vector split by these sizes."""
        return jnp.split(jnp.asarray(packed), np.cumsum(sizes)[:-1], axis=-1)

    def states(self, y: Any) -> tuple[list[Any], list[Any]]:
        """Return y of each rod, and of each body."""
        sizes = [rod.y_layout.size for rod in self.members] + [Y_LAYOUT.size] * len(self.bodies)
        parts = self.split(y, sizes)
        return parts[: len(self.rods)], parts[len(self.rods) :]

    def controls(self, control: Any) -> list[Any]:
        """Return the control of each rod."""
        return self.split(control, [rod.control_layout.size for rod in self.members])

    def points(self, point: RodPoint) -> list[RodPoint]:
        """Return a place of the grid as a point of each rod, at its part of the rod's length."""
        sizes, none = [rod.z_layout.size for rod in self.members], [None] * len(self.rods)
        y, y_t = (none if part is None else self.states(part)[0] for part in (point.y, point.y_t))
        z, z_t = (none if part is None else self.split(part, sizes) for part in (point.z, point.z_t))
        terms = zip(self.members, y, y_t, self.controls(point.control), z, z_t, strict=True)
        return [
            RodPoint(rod, point.s * (rod.length / self.length), point.t, y, y_t, control, z=z, z_t=z_t)
            for rod, y, y_t, control, z, z_t in terms
        ]

    def placed(self, poses: Any) -> list[SlenderRod]:
        """Return the rods whose ends know the poses of their bodies, by name."""
        return [
            _copy(
                rod,
                **{
                    name: _copy(end, frame=poses[end.body])
                    for name in ("base_end", "tip_end")
                    if (end := getattr(rod, name)).body in poses
                },
            )
            for rod in self.members
        ]

    def poses(self, bodies: list[Any]) -> dict[str, Pose]:
        """Return the poses of the bodies by name."""
        return {body.name: Pose(y[:3], y[3:7]) for body, y in zip(self.bodies, bodies, strict=True)}

    # equations along the rods

    def constitutive(self, s, t, y, y_t, control):  # type: ignore[no-untyped-def]
        """Return the laws of the rods."""
        return JointLaw(
            tuple(
                (at.rod.constitutive(at.s, t, at.y, at.y_t, at.control), at.rod.z_layout, at.rod.length)
                for at in self.points(RodPoint(self, s, t, y, y_t, control))
            )
        )

    def balance(self, s, t, y, y_t, z, z_t, control):  # type: ignore[no-untyped-def]
        """Return y_s of the rods, each at its part of its length; the fields of bodies are constant."""
        points = self.points(RodPoint(self, s, t, y, y_t, control, z=z, z_t=z_t))
        rates = {
            at.rod.name: (at.rod.length / self.length)
            * at.rod.balance(at.s, t, at.y, at.y_t, at.z, at.z_t, at.control)
            for at in points
        }
        for contact in self.contacts:
            pair = [next(at for at in points if at.rod.name == name) for name in contact.names]
            loads = contact.wrenches(
                [Motion.of(at.rod.y_layout, at.y, at.y_t) for at in pair],
                [at.rod.material(at.s, at.control).radius for at in pair],
            )
            for at, load in zip(pair, loads, strict=True):
                change = pair[0].rod.length / self.length * jnp.concatenate([np.zeros(7), *load])
                rates[at.rod.name] -= jnp.concatenate([change, np.zeros(at.rod.y_layout.size - 13)])
        return jnp.concatenate([*rates.values(), np.zeros(Y_LAYOUT.size * len(self.bodies))])

    @property
    def discontinuities(self) -> Discontinuities:  # type: ignore[override]
        """Places of all rods, with the jumps of each."""
        own = [rod.discontinuities for rod in self.members]
        places = tuple(sorted({place for each in own for place in each.places}))

        def jump(acting: Any, t: Any, y: Any, y_t: Any, control: Any) -> Any:
            states, bodies = self.states(y)
            rates, _ = self.states(y_t)
            far = [
                each.jump(acting[np.array([places.index(place) for place in each.places])], t, *rest)
                if each.jump
                else rest[0]
                for each, *rest in zip(own, states, rates, self.controls(control), strict=True)
            ]
            return jnp.concatenate([*far, *bodies])

        return Discontinuities(places, jump if any(each.jump for each in own) else None)

    # the two ends, and rest

    def base(self, t: Any, control: Any, unknowns: Float[Any, " k"]) -> Float[Any, " y"]:
        """Return y at s = 0: of the rods at their supports, and of the bodies with the bases' wrench."""
        sizes = [len(rod.y_layout.indices(rod.base_unknowns)) for rod in self.members]
        *own, poses = self.split(unknowns, [*sizes, 7 * len(self.bodies)])
        frames = self.poses(self.split(poses, [7] * len(self.bodies)) if self.bodies else [])
        rods = self.placed(frames)
        states = [rod.base(t, c, u) for rod, c, u in zip(rods, self.controls(control), own, strict=True)]
        wrenches = dict.fromkeys(frames, Wrench(jnp.zeros(3), jnp.zeros(3)))
        for rod, y in zip(rods, states, strict=True):
            if body := rod.base_end.body:
                p, _, n, m, *_ = rod.y_layout.split(y)
                wrenches[body] += Wrench(n, m + cross(p - frames[body].p, n))
        bodies = [jnp.concatenate([*frames[name], *wrenches[name], np.zeros(6)]) for name in frames]
        return jnp.concatenate([*states, *bodies])

    def tip(self, t: Any, control: Any, y: Float[Any, " y"], y_t: Float[Any, " y"]) -> Float[Any, " k"]:
        """Return the residuals of the conditions at the rods' tips, and of the motion of each body."""
        (states, bodies), (rates, body_rates) = self.states(y), self.states(y_t)
        frames = self.poses(bodies)
        rows, tips = [], {name: Wrench(jnp.zeros(3), jnp.zeros(3)) for name in frames}
        for rod, u, *both in zip(self.placed(frames), self.controls(control), states, rates, strict=True):
            rows.append(rod.tip(t, u, *both))
            if name := rod.tip_end.body:
                n, m = rod.tip_wrench(t, u, *both)
                tips[name] += Wrench(-n, -m - cross(rod.pose(both[0]).p - frames[name].p, n))
        for body, own, own_t in zip(self.bodies, bodies, body_rates, strict=True):
            _, h, n, m, *_ = Y_LAYOUT.split(own)
            moving = BodyInertia(body.mass, None, body.inertia).wrench(
                Motion.of(Y_LAYOUT, own, own_t), self.gravity
            )
            total = (
                moving + tips[body.name] + Wrench(n, m) + Wrench(*map(jnp.asarray, (body.force, body.moment)))
            )
            rows += [*total, jnp.sum(h * h)[None] - 1.0]
        return jnp.concatenate(rows)

    def scales(self) -> Scales:
        """Return the scales of the rods; a body has those of the first rod on it."""
        own = [rod.scales() for rod in self.members]
        y, tip = [each.y for each in own], [each.tip for each in own]
        for body in self.bodies:
            first = next(
                k for k, rod in enumerate(self.rods) if body.name in (rod.base_end.body, rod.tip_end.body)
            )
            scale = own[first].y[: Y_LAYOUT.size]
            y.append(scale)
            tip.append(jnp.append(scale[7:13], 1.0))
        return Scales(jnp.concatenate(y), jnp.concatenate(tip))

    def rest(self, s: Any) -> tuple[Float[Any, " y"], Float[Any, " z"]]:
        """Return the unloaded rods; rods that close a loop are bent to meet their tips' supports."""
        rods, frames = self._at_rest
        states, strains = [], []
        for rod in rods:
            y, z = rod.rest(s * (rod.length / self.length))
            end = rod.pose(rod.rest(rod.length)[0])
            if rod.tip_end.held:
                still = rod.end_controls(np.zeros(rod.control_layout.size))[1]
                held, part = rod.tip_end.pose(end, still), s / self.length
                blend = part * part * (3.0 - 2.0 * part)
                y = y.at[:3].add(blend * (held.p - end.p))
                turn = end._replace(p=np.zeros(3)).inverse().then(held).h
                turn = turn * jnp.where(turn[0] < 0.0, -1.0, 1.0)
                y = y.at[3:7].set(quaternion_product(y[3:7], quaternion_of(2.0 * blend * turn[1:])))
            states.append(y)
            strains.append(z)
        bodies = [jnp.concatenate([*frames[body.name], np.zeros(12)]) for body in self.bodies]
        return jnp.concatenate([*states, *bodies]), jnp.concatenate(strains)

    @property
    def _at_rest(self) -> tuple[list[SlenderRod], dict[str, Pose]]:
        """Rods, and bodies as the first rod places each that leads to it from the ground."""
        frames: dict[str, Pose] = {}
        for name, body in self.reached.items():
            if not body:
                continue
            rod = next(rod for rod in self.placed(frames | {body: AT_ORIGIN}) if rod.name == name)
            tip = rod.pose(rod.rest(rod.length)[0])
            held = rod.tip_end.pose(tip, rod.end_controls(np.zeros(rod.control_layout.size))[1])
            frames[body] = (tip if rod.tip_end.body == body else held).then(
                (held if rod.tip_end.body == body else tip).inverse()
            )
        return self.placed(frames), frames


class _AssemblyEnds(Ends, of=Assembly):
    """Ends of all rods, and the motion of the bodies."""

    system: Assembly

    @property
    def rest_is_guess(self) -> bool:
        """True if there is a closed loop, which the unloaded rods need not close."""
        return sum(rod.tip_end.held for rod in self.system.rods) > len(self.system.bodies)

    @property
    def layout(self) -> Layout:
        """Conditions at the rods' tips, and the balance of each body."""
        balance = Layout(
            ("force", 3, "N", "force on the body, global frame", "h", "N"),
            ("moment", 3, "N m", "moment on the body, global frame", "h", "N m"),
            ("norm", 1, "1", "square of the length of the quaternion, less one"),
        )
        return self.system.joined((Ends.of(rod).layout for rod in self.system.members), balance)

    def moving_base(self, y: Float[Any, " y"], y_t: Float[Any, " y"]) -> Float[Any, " y"]:
        """Return y at s = 0 with the velocities of bases and bodies."""
        (states, bodies), (rates, body_rates) = self.system.states(y), self.system.states(y_t)
        moving = [
            Ends.of(rod).moving_base(*both)
            for rod, *both in zip(self.system.members, states, rates, strict=True)
        ]
        for own, own_t in zip(bodies, body_rates, strict=True):
            q, w = velocities(Pose(own[:3], own[3:7]), Pose(own_t[:3], own_t[3:7]))
            moving.append(jnp.concatenate([own[:13], q, w]))
        return jnp.concatenate(moving)


class _AssemblyDrawing(Drawing, of=Assembly):
    """The first rod, and lines of all rods and bodies."""

    system: Assembly

    @property
    def outlines(self) -> int:  # type: ignore[override]
        """Number of bodies."""
        return len(self.system.bodies)

    def positions(self, y: Any) -> Any:
        """Return the positions (…, 3) in m of the first rod."""
        return y[..., :3]

    def quaternions(self, y: Any) -> Any:
        """Return the orientations (…, 4) of the first rod."""
        return y[..., 3:7]

    def curves(self, y: Any) -> list[Any]:
        """Return every rod's curve, and a star from the centre of each body to the ends on it."""
        y, layout, curves = np.asarray(y), self.system.y_layout, []
        places = {rod.name: layout.get(y, f"{rod.name}_p") for rod in self.system.rods}
        for body in self.system.bodies:
            centre = layout.get(y, f"{body.name}_p")[..., 0, :]
            star = [centre]
            for rod in self.system.rods:
                for node, end in ((0, rod.base_end), (-1, rod.tip_end)):
                    if end.body == body.name:
                        star += [places[rod.name][..., node, :], centre]
            curves.append(np.stack(star, axis=-2))
        return [*places.values(), *curves]

    def shapes(self, y: Any, control: Any) -> list[Shape]:
        """Return the shapes of all rods."""
        states, controls = self.system.states(np.asarray(y))[0], self.system.controls(control)
        return [
            shape._replace(name=f"{own.name} {shape.name}")
            for own, rod, *row in zip(self.system.rods, self.system.members, states, controls, strict=True)
            for shape in Drawing.of(rod).shapes(*row)
        ]


class _AssemblyObserved(Observed, of=Assembly):
    """Observables of all rods."""

    system: Assembly

    @property
    def _rods(self) -> list[Any]:
        return [Observed.of(rod) for rod in self.system.members]

    def _points(self, point: RodPoint) -> Any:
        return zip(self._rods, self.system.points(point), strict=True)

    @property
    def velocities(self) -> tuple[str, ...]:  # type: ignore[override]
        """Velocities of all rods."""
        rods = zip(self.system.rods, self._rods, strict=True)
        return tuple(f"{rod.name}_{name}" for rod, own in rods for name in own.velocities)

    @property
    def layout(self) -> Layout:
        """Layout of `observables`."""
        return self.system.joined(own.layout for own in self._rods)

    def observables(self, point: RodPoint) -> Float[Any, " o"]:
        """Return the observables of all rods."""
        return jnp.concatenate([rod.observables(at) for rod, at in self._points(point)])

    def actuation(self, control: Float[Any, " c"]) -> Float[Any, " a"]:
        """Return the actuation of all rods."""
        parts = zip(self._rods, self.system.controls(control), strict=True)
        return jnp.concatenate([own.actuation(part) for own, part in parts])

    @property
    def has_actuation(self) -> bool:
        """True if a rod has another form of its control."""
        return any(own.has_actuation for own in self._rods)

    def unstressed(self, s: Any, control: Any) -> Float[Any, " z"]:
        """Return z of the unstressed rods."""
        points = self._points(RodPoint(self.system, s, None, None, None, control))
        return jnp.concatenate([rod.unstressed(at.s, at.control) for rod, at in points])

    def law_factors(self, s: Any, control: Any) -> tuple[Any, Any] | None:
        """Return the factors of all rods; None if all are uniform."""
        if all(rod.is_uniform for rod in self.system.members):
            return None
        factors = [
            rod.law_factors(at.s, at.control) or (np.ones(at.rod.z_layout.size),) * 2
            for rod, at in self._points(RodPoint(self.system, s, None, None, None, control))
        ]
        return tuple(jnp.concatenate(each) for each in zip(*factors, strict=True))  # type: ignore[return-value]
