"""A robot with tendons routed through holes in its ribs, with friction. Symbols as in `elastic_rod`.

n and m include rod and tendons, so the balance equations contain no tendon forces. n and m do not jump where
a tendon is anchored. The tendons' part is in the material's law (Till 2019, after Rucker & Webster 2011;
`tendon_law`), with tendon i at rᵢ(s) and ṗᵢ = v + u × rᵢ + rᵢ′:

    Rᵀn = Kse (v - v*) + Bse v_t + Σ τᵢ ṗᵢ/|ṗᵢ|        Rᵀm = Kbt (u - u*) + Bbt u_t + Σ τᵢ rᵢ × ṗᵢ/|ṗᵢ|

Drive. Tendons are pulled with a tension, or by a reel. A reel that has taken in dᵢ leaves a tendon the
length ℓᵢ* - dᵢ + C Tᵢ, with its length ℓᵢ* in the unloaded robot and the compliance C. The path length
through the robot is ℓᵢ = ∫|ṗᵢ| ds. Either the tendon is taut and they are equal, or it is slack and Tᵢ = 0:

    0 ≤ Tᵢ  ⊥  ℓᵢ* - dᵢ + C Tᵢ - ℓᵢ ≥ 0

Parts. Friction and vibration (`tendon_friction`) are internal variables: a tendon loses tension along its
path, τᵢ = Tᵢ exp(-λᵢ). λ is a part of y. The mobilised part f of the friction and the part x that vibration
removes are parts of z, and so is the dashpot's curvature where the material has a `relaxation`. `rib_spacing`
softens the rod, `anchors` end tendons early, `load_cells` correct measured tensions.
"""

from __future__ import annotations

import dataclasses
from typing import Any, Self

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.anchors import EarlyAnchors
from knode_cosserat.rods.law import Evolution, Fields, InternalState, MaterialLaw
from knode_cosserat.rods.layout import Layout
from knode_cosserat.rods.load_cells import LoadCells
from knode_cosserat.rods.parameters import ParameterError, choice, parameter, part
from knode_cosserat.rods.reels import Reels
from knode_cosserat.rods.relaxation import Relaxation
from knode_cosserat.rods.rib_spacing import RibSpacing
from knode_cosserat.rods.rod import Rod
from knode_cosserat.rods.routing import Helical, Routing, Straight, ends, path_lengths, routes
from knode_cosserat.rods.tendon_friction import TendonFriction, Vibration
from knode_cosserat.rods.tendon_law import Tendons, stretches
from knode_cosserat.rods.tendon_rod import TendonRod
from knode_cosserat.rods.trained_range import TrainedRange
from knode_cosserat.rotation import dot

#: fraction of the rod's length over which slack and taut are blended, so that Newton's method has a slope
BLEND = 1e-7


class RoutedTendonRobot(TendonRod):
    """A round rod with routed tendons beside it that bend it, with friction along them.

    Without friction and vibration (the defaults) damping is its only internal variable. The docstrings of
    this module, of `tendon_friction` and of `rib_spacing` have the equations. Tendons are at `tendon_offset`
    and `tendon_angles`, or follow `routing`.
    """

    routing: tuple[Routing, ...] | None = part(
        "where the tendons run; by default straight, at their offset and angles", Routing, many=True,
        default=None,
    )  # fmt: skip
    tendon_twist: Any = parameter(
        "rad", "angle by which the tendons turn about the rod from base to tip; by default they are straight",
        low=-10.0, high=10.0, default=None,
    )  # fmt: skip
    drive: str = choice(
        "what is given of the tendons: their tension, or what reels take in", ("tension", "reel"), "tension"
    )
    tendon_compliance: Any = parameter(
        "m/N",
        "C, how much a tendon gives by its tension, if a reel drives it",
        low=0.0,
        high=1.0,
        default=0.0,
    )
    reels: Reels | None = part(
        "motors whose angles, or lengths, are the controls of the reels; none: one length for each tendon",
        Reels, default=None,
    )  # fmt: skip
    friction: TendonFriction | None = part(
        "friction of the tendons; none: they slide freely", TendonFriction, default=None
    )
    vibration: Vibration | None = part(
        "loss of friction where high tensions make the robot shake; none: it does not",
        Vibration,
        default=None,
    )
    rib_spacing: RibSpacing | None = part(
        "softening by tendons that are straight between ribs; none: they are bent as the rod is", RibSpacing,
        default=None,
    )  # fmt: skip
    relaxation: Relaxation | None = part(
        "relaxation of the material, a Maxwell branch; none: it does not creep", Relaxation, default=None
    )
    anchors: EarlyAnchors | None = part(
        "where tendons are anchored before the tip; none: at the tip, or where `routing` ends", EarlyAnchors,
        default=None,
    )  # fmt: skip
    load_cells: LoadCells | None = part(
        "what measured tensions have to be corrected by; none: controls are tensions", LoadCells, default=None
    )

    trained: TrainedRange | None = part(
        "range of the recordings that it was identified from; outside it extrapolates", TrainedRange,
        default=None,
    )  # fmt: skip

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

    def eased(self, part: float) -> Self:
        """Return the robot with smoothed contact, and friction that builds up over more curvature."""
        found = super().eased(part)
        return found if self.friction is None else found.replace(friction=self.friction.eased(part))

    def undelayed(
        self, measured: Float[np.ndarray, "T c"], dt: float, before: Float[np.ndarray, " c"] | None = None
    ) -> Float[np.ndarray, "T c"]:
        """Return the acting tensions, from the load cells' readings."""
        cells = self.load_cells
        return measured if cells is None else cells.undelayed(measured, dt, before)

    def trained_range(self) -> TrainedRange | None:
        """Return the range of the recordings used to identify it; None if it has none."""
        return self.trained

    @property
    def routings(self) -> tuple[Routing, ...]:
        """Routings of the tendons."""
        if self.routing is not None:
            return self.routing
        angles = jnp.asarray(self.tendon_angles)
        if self.tendon_twist is not None:
            turns = self.tendon_twist / (2.0 * np.pi)
            return tuple(Helical(self.tendon_offset, angles[k], turns) for k in range(angles.shape[0]))
        x, y = self.tendon_offset * jnp.cos(angles), self.tendon_offset * jnp.sin(angles)
        return tuple(Straight(x[k], y[k]) for k in range(angles.shape[0]))

    @property
    def tendon_count(self) -> int:
        """Number of tendons."""
        return len(self.routing) if self.routing is not None else super().tendon_count

    @property
    def tendon_ends(self) -> tuple[float, ...]:
        """Places where the tendons end, as fractions of the length."""
        return tuple(ends(self.routings).tolist())

    @property
    def moment_arm(self) -> float:
        """Largest distance (m) of a tendon from the axis at the base."""
        return float(np.linalg.norm(np.asarray(self.routes_at(0.0)[0]), axis=-1).max())

    @property
    def actuator_layout(self) -> Layout:
        """Layout of the tendons' tensions, or of the lengths taken in by reels, or of the motors' angles."""
        if self.drive != "reel":
            return Layout(("tension", self.tendon_count, "N", "tendon tension"))
        count = self.tendon_count if self.reels is None else self.reels.motor_count(self.tendon_count)
        if self.reels is not None and self.reels.radius is not None:
            return Layout(("motor", count, "rad", "angle of the motor"))
        return Layout(("reel", count, "m", "length of tendon that the reel has taken in"))

    @property
    def y_layout(self) -> Layout:  # type: ignore[override]
        """Layout of y: the rod, the loss of tension by friction, and for reels tension and path length."""
        count, more = self.tendon_count, []
        if self.friction is not None:
            more.append(("loss", count, "1", "logarithm of tension lost by friction"))
        if self.drive == "reel":
            more.append(("tension", count, "N", "tendon tension at the base"))
            more.append(("path", count, "m", "way of the tendons through the robot"))
        return Rod.y_layout + Layout(*more)

    @property
    def z_layout(self) -> Layout:  # type: ignore[override]
        """Layout of z: strains, friction of each tendon, vibration, and relaxation."""
        more = []
        if self.friction is not None:
            more.append(
                ("f", self.tendon_count, "1", "part of the friction that holds a tendon, and which way")
            )
        if self.vibration is not None:
            more.append(("x", 1, "1", "part of the friction that vibration has taken away"))
        if self.relaxation is not None:
            more.append(("u_branch", 3, "1/m", "curvature of the dashpot of the Maxwell branch"))
        return Rod.z_layout + Layout(*more)

    @property
    def base_unknowns(self) -> tuple[str, ...]:  # type: ignore[override]
        """Unknown fields of y at the base: those of the rod, and with reels the tension."""
        return (*self.base_end.unknowns, "tension") if self.drive == "reel" else self.base_end.unknowns

    @property
    def cuts(self) -> tuple[float, ...]:  # type: ignore[override]
        """Places of discontinuity: those of the rod, the tendons' anchors, and ribs."""
        early = () if self.anchors is None else (self.anchors.at,)
        ribs = () if self.rib_spacing is None else self.rib_spacing.at or ()
        return tuple(sorted({*super().cuts, *(at for at in (*self._ends, *early, *ribs) if at < 1.0)}))

    @property
    def _ends(self) -> tuple[float, ...]:
        return (1.0,) if self.routing is None else tuple(float(end) for end in ends(self.routing))

    # action of the tendons

    def base_tension(self, y: Float[Any, " y"], control: Float[Any, " c"]) -> Float[Any, " c"]:
        """Return the tensions T (N) at the base."""
        return self.y_layout.get(y, "tension") if self.drive == "reel" else self._pulled(control)

    def taken_in(self, control: Float[Any, " c"]) -> Float[Any, " tendons"]:
        """Return dᵢ (m), the length of each tendon that the reels have taken in."""
        given = control[: self.actuator_layout.size]
        return given if self.reels is None else self.reels.lengths(given)

    @property
    def _compliance(self) -> Any:
        """C (m/N) of each tendon, including its spring."""
        springs = None if self.reels is None else self.reels.compliance
        return self.tendon_compliance if springs is None else self.tendon_compliance + jnp.asarray(springs)

    def _pulled(self, control: Float[Any, " c"]) -> Float[Any, " c"]:
        """Return the tensions (N) at the base: the control, corrected by load cells if there are any."""
        given = control[: self.tendon_count]
        return given if self.load_cells is None else self.load_cells.tension(given)

    def tension_at(self, s: Any, y: Float[Any, " y"], control: Float[Any, " c"]) -> Float[Any, " c"]:
        """Return τ (N) at s: reduced by friction, and zero beyond a tendon's end."""
        T = self.base_tension(y, control)
        if self.friction is not None:
            T = T * jnp.exp(-self.y_layout.get(y, "loss"))
        return self._where_it_runs(s, T)

    def _where_it_runs(self, s: Any, values: Float[Any, " c"]) -> Float[Any, " c"]:
        """Return the tendons' values, with zero for tendons that end before s."""
        if self.anchors is not None:
            values = values * jnp.where(s < self.anchors.at * self.length, 1.0, self.anchors.share)
        if min(self._ends) >= 1.0:
            return values
        return jnp.where(s < np.array(self._ends) * self.length, values, 0.0)

    def routes_at(self, s: Any) -> tuple[Float[Any, "c 3"], Float[Any, "c 3"]]:
        """Return r and r′ of the tendons at s."""
        if self.routing is not None:
            return routes(self.routing, s / self.length, self.length)
        if self.tendon_twist is None:
            return super().routes_at(s)
        angles = self._angles_at(s)
        r = self.tendon_offset * jnp.stack([jnp.cos(angles), jnp.sin(angles), jnp.zeros_like(angles)], -1)
        across = jnp.stack([-r[:, 1], r[:, 0], jnp.zeros_like(angles)], axis=-1)
        return r, self.tendon_twist / self.length * across

    def _angles_at(self, s: Any) -> Float[Any, " c"]:
        """Return the angles (rad) of the tendons about the rod at s."""
        angles = jnp.asarray(self.tendon_angles)
        return angles if self.tendon_twist is None else angles + self.tendon_twist * (s / self.length)

    def bending_directions(self, s: Any) -> Float[Any, "c 3"]:
        """Return eᵢ: the direction of u in which each tendon bends the rod at s, material frame."""
        if self.routing is None:
            angles = self._angles_at(s)
            return jnp.stack([-jnp.sin(angles), jnp.cos(angles), jnp.zeros_like(angles)], axis=-1)
        r, _ = self.routes_at(s)
        across = jnp.stack([-r[:, 1], r[:, 0], jnp.zeros_like(r[:, 0])], axis=-1)
        return across / jnp.sqrt(jnp.sum(across * across, axis=1, keepdims=True) + 1e-24)

    def actuation(self, control: Float[Any, " c"]) -> Float[Any, " a"]:
        """Return Σ Tᵢ d₃ × rᵢ of straight tendons (N·m), material frame; otherwise the control."""
        straight = self.routing is None and self.tendon_twist is None
        if not straight or self.drive == "reel" or self.control_size > self.tendon_count:
            return control
        return self.tendon_offset * dot(self.bending_directions(0.0).T, self._pulled(control))

    def law_factors(self, s: Any, control: Any) -> tuple[Any, Any] | None:
        """Return the sections' factors on stiffness and damping, with 1 for the other rows of the law."""
        found = super().law_factors(s, control)
        others = jnp.ones(self.z_layout.size - 6)
        return found and (jnp.concatenate([found[0], others]), jnp.concatenate([found[1], others]))

    def rest(self, s: Any) -> tuple[Float[Any, " y"], Float[Any, " z"]]:
        """Return the rod's state at rest, with zero tension and zero friction."""
        y, z = super().rest(s)
        if self.drive == "reel":
            y = y.at[self.y_layout.slice("path")].set(self._ways(s))
        return y, self._with_dashpot(jnp.concatenate([z, np.zeros(self.z_layout.size - 6)]))

    def unstressed(self, s: Any, control: Any) -> Float[Any, " z"]:
        """Return z of the unstressed rod at s, with a relaxed material."""
        return self._with_dashpot(super().unstressed(s, control))

    def _with_dashpot(self, z: Float[Any, " z"]) -> Float[Any, " z"]:
        """Return z with the dashpot's curvature equal to the rod's."""
        return z if self.relaxation is None else z.at[self.z_layout.slice("u_branch")].set(z[3:6])

    def _ways(self, s: Any) -> Float[Any, " c"]:
        """Return the tendons' lengths in the unloaded robot from the base to s."""
        none = np.zeros(self.control_size)
        return path_lengths(self.routings, s, self.length, lambda at: self.material(at, none).u_star)

    # the equations

    def constitutive(self, s, t, y, y_t, control):  # type: ignore[no-untyped-def]
        """Return the law of v and u with the tendons, and of the internal variables."""
        if self.vibration is None:
            return self._law(s, y, control)
        total = jnp.sum(self.base_tension(y, control))
        softening = self.vibration.softening * total * np.diag([1.0, 1.0, 0.0])

        def law(internal: Fields) -> MaterialLaw:
            return self._law(s, y, control, internal["x"][0] * softening)

        return InternalState({"x": self.vibration.evolution(total)}, law)

    def _law(self, s: Any, y: Any, control: Any, shaken: Any = None) -> MaterialLaw:
        """Return the law of v and u, for a loss of bending stiffness by vibration (None: no loss)."""
        law = self.linear_law(s, y, control)
        material, tension = self.material(s, control), self.tension_at(s, y, control)
        v, u = law.strains["v"], law.strains["u"]
        if shaken is not None:
            u = u._replace(softening=shaken, stress=u.stress - dot(shaken, material.u_star))
        if self.rib_spacing is not None:
            # tendons press on the bent rod, including its intrinsic curvature
            remaining = u.stiffness if shaken is None else u.stiffness - shaken
            lost = self.rib_spacing.lost(s / self.length, self.length, remaining, jnp.sum(tension))
            u = u._replace(softening=lost if shaken is None else shaken + lost)
        if self.relaxation is not None:
            u = u._replace(branch=self.relaxation.branch(material.Kbt))
        nominal = self._where_it_runs(s, self.base_tension(y, control))
        tendons = Tendons(*self.routes_at(s), tension, nominal)

        def evolutions(strains: Fields, rates: Fields) -> dict[str, Evolution]:
            directions, bent = self.bending_directions(s), strains["u"] - material.u_star
            return {"f": self.friction.evolution(directions, rates["u"], bent)}  # type: ignore[union-attr]

        return MaterialLaw({"v": v, "u": u}, tendons, None if self.friction is None else evolutions)

    def balance(self, s, t, y, y_t, z, z_t, control):  # type: ignore[no-untyped-def]
        """Return y_s of the rod, of the tension, and of the tendons' path lengths."""
        rates = [super().balance(s, t, y, y_t, z, z_t, control)]
        v, u = self.z_layout.get(z, "v"), self.z_layout.get(z, "u")
        if self.friction is not None:
            f = self.z_layout.get(z, "f")
            if self.vibration is not None:
                f = f * (1.0 - self.z_layout.get(z, "x"))
            rates.append(self.friction.loss_rates(u, f))
        if self.drive == "reel":
            way = stretches(v, u, *map(jnp.asarray, self.routes_at(s)))
            rates += [jnp.zeros(self.tendon_count), self._where_it_runs(s, way)]
        return jnp.concatenate(rates)

    def tip(self, t: Any, control: Any, y: Float[Any, " y"], y_t: Float[Any, " y"]) -> Float[Any, " k"]:
        """Return the rod's residual; for reels also that tension or slack is zero (Fischer-Burmeister)."""
        left = super().tip(t, control, y, y_t)
        if self.drive != "reel":
            return left
        T, way = self.y_layout.get(y, "tension"), self.y_layout.get(y, "path")
        given = self._ways(self.length) - self.taken_in(control) + self._compliance * T
        slack, pulled = given - way, self._give * T
        blend = BLEND * self.length
        return jnp.concatenate([left, slack + pulled - jnp.sqrt(slack**2 + pulled**2 + 2.0 * blend**2)])

    @property
    def _give(self) -> Any:
        """Scale (m/N) for comparing tension and slack: the tendon's compliance plus a part of the rod's."""
        return self._compliance + 1e-3 * self.length**3 / self.Kbt[0, 0]

    @property
    def tip_layout(self) -> Layout:
        """Layout of the tip's conditions: those of the rod, and of reels."""
        if self.drive != "reel":
            return super().tip_layout
        return super().tip_layout + Layout(("slack", self.tendon_count, "m", "slack or tension"))

    def scale_of(self, name: str, sizes: dict[str, Any]) -> Any:
        """Return the natural size of a field: a tension's is the rod's force, a path's its length."""
        more = {"loss": 1.0, "tension": sizes["n"], "path": sizes["p"], "slack": sizes["p"]}
        return more[name] if name in more else super().scale_of(name, sizes)
