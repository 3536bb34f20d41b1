"""Robots with tendons: of the paper, routed, and virtual. Symbols as in `rod`, equations in `tendons`."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar, Self

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.ends import Moving
from knode_cosserat.rods.law import MaterialLaw, Viscoelastic
from knode_cosserat.rods.loads import transverse_force
from knode_cosserat.rods.parameters import ParameterError, choice, parameter, slot
from knode_cosserat.rods.parts import Contribution, RodPoint, Wrench
from knode_cosserat.rods.relaxation import Relaxation
from knode_cosserat.rods.rod import SlenderRod
from knode_cosserat.rods.routing import OffsetPaths, RoutedPaths, Routing
from knode_cosserat.rods.tendons import (
    EarlyAnchors,
    LoadCells,
    PulledTendons,
    ReeledTendons,
    Reels,
    RibSpacing,
    RoutedTendons,
    TendonFriction,
    Vibration,
    tension,
)
from knode_cosserat.rotation import cross, dot

#: angles of the paper's four tendons about the rod, π/4 + iπ/2
FOUR_TENDONS = tuple(np.pi / 4 + i * np.pi / 2 for i in range(4))


class TendonRod(SlenderRod):
    """A rod with tendons around it. A subclass defines the part `tendons`, their action on the rod."""

    tendon_offset: Any = parameter(
        "m",
        "distance of the tendons from the rod's axis; the paper's tendon-robot ignores it",
        low=0.0,
        high=1.0,
        default=0.0,
    )
    tendon_angles: Any = parameter(
        "rad", "angles of the tendons about the rod", shape="list", low=-10.0, high=10.0, default=FOUR_TENDONS
    )

    @property
    def tendons(self) -> PulledTendons:
        """Tendons, with their controls and their action on the rod."""
        return PulledTendons(self.tendon_count)

    def list_parts(self) -> dict[str, Contribution]:
        """Return the tendons, and the parts of the rod."""
        return {"tendons": self.tendons} | super().list_parts()

    @property
    def paths(self) -> OffsetPaths | RoutedPaths:
        """Paths of the tendons; straight by default."""
        return OffsetPaths(self.tendon_offset, self.tendon_angles, None, self.length)

    @property
    def winding(self) -> float:
        """Largest angle (rad) through which a tendon or another part turns along the rod."""
        return max(self.paths.winding, super().winding)

    @property
    def tendon_count(self) -> int:
        """Number of tendons."""
        return len(self.paths.ends)

    @property
    def tendon_ends(self) -> tuple[float, ...]:
        """Places where the tendons end, as fractions of the length."""
        return self.paths.ends

    @property
    def moment_arm(self) -> float | None:
        """Largest distance (m) of a tendon from the axis at the base; None if that does not bend the rod."""
        return None

    def routes_at(self, s: Any) -> tuple[Float[Any, "c 3"], Float[Any, "c 3"]]:
        """Return the tendons' places r (m) in the cross-section at s (m), and r′."""
        return self.paths.routes(s)


@dataclasses.dataclass(frozen=True)
class _TransverseTendons(PulledTendons):
    """Tendons that push the rod sideways."""

    angles: Float[Any, " c"]

    def load(self, point: RodPoint) -> Wrench:
        """Return the resultant of the tendons' forces per length."""
        return Wrench(transverse_force(point.input, self.angles), np.zeros(3))

    def actuation(self, rod: Any, control: Any) -> Float[Any, "3"]:
        """Return the resultant of the tendons' forces per length (N/m), global frame: the paper's τ·φ."""
        return transverse_force(control, self.angles)


class TendonRobot(TendonRod):
    """A round rod with tendons, gravity, drag and material damping, as in the paper.

    The tendons load the rod as in the paper (`transverse_force`): a force across it, no moment, so that
    `tendon_offset` does not matter. See `RoutedTendonRobot` for tendons that run beside the rod.
    """

    kind: ClassVar[str] = "tendon-robot"

    def __check_init__(self) -> None:
        if isinstance(self.base_end, Moving):
            raise ParameterError(
                "base_end moves, and the tendons of a tendon-robot push along fixed global axes; allowed is "
                "RoutedTendonRobot.like(robot)"
            )

    @property
    def tendons(self) -> _TransverseTendons:
        """Tendons that push the rod sideways."""
        return _TransverseTendons(self.tendon_count, self.tendon_angles)


class RoutedTendonRobot(TendonRod):
    """A round rod with routed tendons beside it that bend it, with friction along them.

    Without friction and vibration (the defaults) damping is its only internal variable. Tendons are at
    `tendon_offset` and `tendon_angles`, or follow `routing`.
    """

    kind: ClassVar[str] = "routed-tendon-robot"

    routing: tuple[Routing, ...] | None = slot(
        "paths of the tendons; by default straight, at their offset and angles",
        Routing,
        many=True,
        default=None,
    )
    tendon_twist: Any = parameter(
        "rad",
        "angle by which the tendons turn about the rod from base to tip; by default they are straight",
        low=-10.0,
        high=10.0,
        default=None,
    )
    drive: str = choice(
        "control of the tendons: tension, or length that reels take in", ("tension", "reel"), "tension"
    )
    tendon_compliance: Any = parameter(
        "m/N", "C, compliance of a tendon that a reel drives", low=0.0, high=1.0, default=0.0
    )
    reels: Reels | None = slot(
        "motors of the reels; none: one length for each tendon",
        Reels,
        default=None,
    )
    friction: TendonFriction | None = slot(
        "friction of the tendons; none: they slide freely", TendonFriction, default=None
    )
    vibration: Vibration | None = slot(
        "loss of friction by vibration under high tensions; none: no vibration", Vibration, default=None
    )
    rib_spacing: RibSpacing | None = slot(
        "softening by tendons that are straight between ribs; none: tendons follow the rod",
        RibSpacing,
        default=None,
    )
    relaxation: Relaxation | None = slot(
        "relaxation of the material, a Maxwell branch; none: it does not creep", Relaxation, default=None
    )
    anchors: EarlyAnchors | None = slot(
        "anchors before the tip; none: at the tip, or at the end of `routing`",
        EarlyAnchors,
        default=None,
    )
    load_cells: LoadCells | None = slot(
        "correction of measured tensions; none: controls are tensions", LoadCells, default=None
    )

    def __check_init__(self) -> None:
        if isinstance(self.routing, tuple) and not self.routing:
            raise ParameterError("routing is []; allowed is one or more, one for each tendon")
        if self.reels is None:
            return
        if self.drive != "reel":
            raise ParameterError(f"reels are given, and drive is {self.drive}; allowed is reel")
        if self.reels.tendon_count != self.tendon_count:
            raise ParameterError(
                f"reels have {self.reels.tendon_count} tendons; the robot has {self.tendon_count}"
            )

    @classmethod
    def like(cls, robot: TendonRod, **changes: Any) -> Self:
        """Return a robot with the rod of another, and with tendons at the same places.

        Raises:
            ParameterError: a change that is not allowed.
        """
        if not isinstance(robot, TendonRod):
            raise ParameterError(f"robot is a {type(robot).__name__}; allowed is a tendon-driven robot")
        same = {field.name: getattr(robot, field.name) for field in dataclasses.fields(TendonRod)}
        return cls(**same).replace(**changes)

    # parts

    @property
    def tendons(self) -> RoutedTendons:
        """Tendons with their drive."""
        count, ends = self.tendon_count, self.tendon_ends
        if self.drive == "reel":
            return ReeledTendons(count, ends, None, self.tendon_compliance, self.reels)
        return RoutedTendons(count, ends, self.load_cells)

    def list_parts(self) -> dict[str, Contribution]:
        """Return the parts that are present, in order."""
        names = ("friction", "vibration", "rib_spacing", "relaxation", "anchors")
        present = {name: getattr(self, name) for name in names if getattr(self, name) is not None}
        return present | super().list_parts()

    @property
    def paths(self) -> OffsetPaths | RoutedPaths:
        """Paths of the tendons."""
        if self.routing is not None:
            return RoutedPaths(self.routing, self.length)
        return OffsetPaths(self.tendon_offset, self.tendon_angles, self.tendon_twist, self.length)

    # action of the tendons

    @property
    def routings(self) -> tuple[Routing, ...]:
        """Routings of the tendons."""
        return self.paths.routings

    @property
    def moment_arm(self) -> float:
        """Largest distance (m) of a tendon from the axis at the base."""
        return float(np.linalg.norm(np.asarray(self.routes_at(0.0)[0]), axis=-1).max())

    def bending_directions(self, s: Any) -> Float[Any, "c 3"]:
        """Return eᵢ: the direction of u in which each tendon bends the rod at s, material frame."""
        return self.paths.directions(s)

    def tension_at(self, s: Any, y: Float[Any, " y"], control: Float[Any, " c"]) -> Float[Any, " c"]:
        """Return τ (N) at s: reduced by friction, and zero beyond a tendon's end."""
        return tension(RodPoint(self, s, None, y, None, control))

    def taken_in(self, control: Float[Any, " c"]) -> Float[Any, " tendons"]:
        """Return dᵢ (m), the length of each tendon that the reels have taken in."""
        tendons: Any = self.parts["tendons"]
        return tendons.taken_in(control[: tendons.control_fields[0].size])


#: standard deviation of the distribution of a rib's mass along the rod (m)
RIB_WIDTH = 0.02
#: the nine ribs, as fractions of the length
RIBS = tuple((k + 1) / 9 for k in range(9))


class _VirtualTendons(PulledTendons):
    """Tendons of a test robot: their controls, and the masses of the ribs in which they run."""

    def load(self, point: RodPoint) -> Wrench:
        """Return weight less inertia of the ribs per length, each spread along the rod."""
        away = (point.material_place / point.rod.length - np.array(RIBS)) * point.rod.length / RIB_WIDTH
        # a Gaussian, with half of the last one beyond the tip
        lump = jnp.exp(-0.5 * away**2) / (RIB_WIDTH * np.sqrt(2.0 * np.pi))
        _, R, q, w, q_t, _ = point.motion
        mass = point.rod.rib_mass * jnp.sum(lump)
        return Wrench(-mass * (dot(R, cross(w, q) + q_t) - point.rod.gravity), jnp.zeros(3))

    def actuation(self, rod: Any, control: Float[Any, " c"]) -> Float[Any, "3"]:
        """Return the total tension, and its moment about the axis (N, N·m, N·m)."""
        angles = rod.tendon_angles
        moment = jnp.stack([jnp.sum(control * jnp.sin(angles)), -jnp.sum(control * jnp.cos(angles))])
        return jnp.concatenate([jnp.sum(control)[None], rod.tendon_offset * moment])


class VirtualRobot(TendonRod):
    """A rod with tendons in ribs: n and m include rod and tendons.

    With the tendons at r_i, and d₃ the third axis of the material frame,

        Rᵀn = Kse (v - v*) + Σ T_i d₃            Rᵀm = Kbt (u - u*) + Bbt u_t + Σ T_i r_i × d₃
        T_i(s) = τ_i (1 - μ s/L tanh(ρ_i/ρ₀)),    ρ_i = d₃ · (r_i × u_t)

    where ρ_i is the rate at which the tendon is pulled in per metre of rod. A tendon that is pulled in loses
    tension towards the tip, and a tendon that is let out gains tension. Near the base Kbt is multiplied. Ribs
    are masses, each distributed over a part of the length. The balance of n and m is that of a rod without
    tendons, because the tendons act within the section. At the tip, where they end, n and m are zero.
    """

    kind: ClassVar[str] = "virtual-robot"

    friction: Any = parameter(
        "", "μ, part of a tendon's tension lost to the tip", low=0.0, high=0.9, default=0.1
    )
    sliding: Any = parameter(
        "1/s", "ρ₀, rate of sliding per length from which friction is full", low=1e-6, high=10.0, default=0.02
    )
    sleeve_length: Any = parameter("m", "length of the sleeve at the base", low=0.0, high=1.0, default=0.08)
    sleeve_factor: Any = parameter("", "factor of Kbt by the sleeve", low=1.0, high=100.0, default=4.0)
    rib_mass: Any = parameter("kg", "mass of one of the nine ribs", low=0.0, high=1.0, default=0.0015)

    @property
    def tendons(self) -> _VirtualTendons:
        """Controls of the tendons."""
        return _VirtualTendons(self.tendon_count)

    def tendon_moment(self, s: Any, control: Any, u: Any, u_t: Float[Any, "3"]) -> Float[Any, "3"]:
        """Return Σ T_i r_i × d₃ (N·m) at s, material frame, at the rate of curvature u_t."""
        x, y = jnp.cos(self.tendon_angles), jnp.sin(self.tendon_angles)
        pulled_in = self.tendon_offset * (x * u_t[1] - y * u_t[0])
        loss = self.friction * s / self.length * jnp.tanh(pulled_in / self.sliding)
        T = control * (1.0 - loss)
        return self.tendon_offset * jnp.stack([jnp.sum(T * y), -jnp.sum(T * x), jnp.zeros(())])

    def constitutive(self, s, t, y, y_t, control):  # type: ignore[no-untyped-def]
        """Return the law of v and u with the tendons."""
        n, m = self.stresses(y)
        pulled = n - jnp.sum(jnp.asarray(control)) * np.array([0.0, 0.0, 1.0])
        moment = jax.tree_util.Partial(VirtualRobot.tendon_moment, self, s, jnp.asarray(control))
        material = self.material(s, control)
        inside = jnp.exp(-((s / self.sleeve_length) ** 2))
        Kbt = material.Kbt * (1.0 + (self.sleeve_factor - 1.0) * inside)
        bent = m if not self.sections else m + dot(Kbt, material.u_star)
        v = Viscoelastic(material.Kse, material.Bse, pulled + material.Kse @ material.v_star)
        return MaterialLaw({"v": v, "u": Viscoelastic(Kbt, material.Bbt, bent, moment=moment)})
