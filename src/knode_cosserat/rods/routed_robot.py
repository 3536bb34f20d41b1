"""A robot whose tendons run through holes in its ribs: they bend it, and rub. Symbols as in `elastic_rod`.

n and m carry rod and tendons together, so that their balance has no tendon in it, and where a tendon is
anchored nothing of theirs jumps. What the tendons take of them stands in the material's law (Till 2019,
after Rucker & Webster 2011; `tendon_law`), with tendon i at rᵢ(s) and ṗᵢ = v + u × rᵢ + rᵢ′:

    Rᵀn = Kse (v - v*) + Bse v_t + Σ τᵢ ṗᵢ/|ṗᵢ|        Rᵀm = Kbt (u - u*) + Bbt u_t + Σ τᵢ rᵢ × ṗᵢ/|ṗᵢ|

Drive. Tendons are pulled with a tension, or by a reel. A reel that has taken in dᵢ leaves a tendon the
length ℓᵢ* - dᵢ + C Tᵢ, with its length ℓᵢ* in the robot unloaded and the compliance C; the way through the
robot is ℓᵢ = ∫|ṗᵢ| ds. Either the tendon is taut and they are equal, or it is slack and Tᵢ = 0:

    0 ≤ Tᵢ  ⊥  ℓᵢ* - dᵢ + C Tᵢ - ℓᵢ ≥ 0

Friction and vibration are memories (`tendon_friction` has them): a tendon loses tension on its way, τᵢ =
Tᵢ exp(-λᵢ). λ is a part of y; how much of the friction holds, f, and how much is shaken loose, x, of z.
"""

from __future__ import annotations

import dataclasses
from typing import Any, Self

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.layout import Layout
from knode_cosserat.rods.parameters import ParameterError, choice, parameter, part
from knode_cosserat.rods.rod import Rod
from knode_cosserat.rods.routing import Routing, Straight, ends, routes
from knode_cosserat.rods.section import Material
from knode_cosserat.rods.system import History, System
from knode_cosserat.rods.tendon_friction import held, loss_rates, shaking
from knode_cosserat.rods.tendon_law import stretches, tendon_balance, tendon_strains, unbent_flexibility
from knode_cosserat.rods.tendon_rod import TendonRod
from knode_cosserat.rotation import dot

#: of the rod's length: how far slack and taut are blended, so that Newton's method has a slope between them
BLEND = 1e-7
#: points of Gauss's rule for the length of a tendon in the unloaded robot
GAUSS = 24


class RoutedTendonRobot(TendonRod):
    """A round rod with tendons that run beside it, anywhere, and bend it, with friction where they run.

    Without friction and vibration (the defaults) it has no memory beyond that of its damping. The heads of
    this module and of `tendon_friction` have the equations. Tendons are at `tendon_offset` and
    `tendon_angles`, or where `routing` has them.
    """

    routing: tuple[Routing, ...] | None = part(
        "where the tendons run; by default straight, at their offset and angles", Routing, many=True,
        default=None,
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
    sleeve_stiffening: Any = parameter(
        "", "how much stiffer against bending the rod is at its base, as a part", low=0.0, high=1e4,
        default=None,
    )  # fmt: skip
    sleeve_length: Any = parameter(
        "m", "where that ends: exp(-(s / length)^4) of it are left at s", low=1e-4, high=20.0, default=0.05
    )
    friction_wobble: Any = parameter(
        "1/m", "k, friction of the tendons by the way they run", low=0.0, high=100.0, default=None
    )
    friction_curvature: Any = parameter(
        "1/rad", "μ, friction of the tendons by the angle they turn", low=0.0, high=10.0, default=None
    )
    friction_reach: Any = parameter(
        "1/m", "κ₀, change of curvature that builds friction up", low=1e-4, high=100.0, default=0.1
    )
    vibration_tension: Any = parameter(
        "N", "T_v, tension of all tendons together above which vibration grows", low=0.0, high=1e6,
        default=1e6,
    )  # fmt: skip
    vibration_rate: Any = parameter(
        "1/(N s)", "k_v, how fast it grows; none at 0", low=0.0, high=1e3, default=None
    )
    vibration_softening: Any = parameter(
        "m2", "c, loss of bending stiffness by vibration, by tension", low=0.0, high=1.0, default=0.0
    )

    def __check_init__(self) -> None:
        if isinstance(self.routing, tuple) and not self.routing:
            raise ParameterError("routing is []; allowed is one or more, one for each tendon")

    @classmethod
    def like(cls, robot: TendonRod, **changes: Any) -> Self:
        """A robot with the rod of another, and with tendons at the same places.

        Raises:
            ParameterError: a change that is not allowed.
        """
        if not isinstance(robot, TendonRod):
            raise ParameterError(f"robot is a {type(robot).__name__}; allowed is a tendon-driven robot")
        same = {field.name: getattr(robot, field.name) for field in dataclasses.fields(TendonRod)}
        return cls(**same).replace(**changes)

    def eased(self, part: float) -> Self:
        """With friction that builds up over a longer reach."""
        found = super().eased(part)
        if not self.rubs:
            return found
        return found.replace(friction_reach=np.minimum(self.friction_reach / part, 100.0))

    # what its tendons have: which states there are

    @property
    def rubs(self) -> bool:
        """Whether there is friction, or could be: a coefficient of it is given."""
        return self.friction_wobble is not None or self.friction_curvature is not None

    @property
    def vibrates(self) -> bool:
        """Whether vibration is a state: its rate is given."""
        return self.vibration_rate is not None

    @property
    def routings(self) -> tuple[Routing, ...]:
        """Where the tendons run."""
        if self.routing is not None:
            return self.routing
        angles = jnp.asarray(self.tendon_angles)
        x, y = self.tendon_offset * jnp.cos(angles), self.tendon_offset * jnp.sin(angles)
        return tuple(Straight(x[k], y[k]) for k in range(angles.shape[0]))

    @property
    def tendon_count(self) -> int:
        """How many tendons there are."""
        return len(self.routing) if self.routing is not None else int(np.shape(self.tendon_angles)[-1])

    @property
    def actuator_layout(self) -> Layout:
        """One tension per tendon, or what its reel has taken in."""
        if self.drive == "reel":
            return Layout(("reel", self.tendon_count, "m", "length of tendon that the reel has taken in"))
        return Layout(("tension", self.tendon_count, "N", "tendon tension"))

    @property
    def y_layout(self) -> Layout:  # type: ignore[override]
        """The rod's, the loss of tension by friction, and of reels the tension and the tendons' ways."""
        count, more = self.tendon_count, []
        if self.rubs:
            more.append(("loss", count, "1", "logarithm of tension lost by friction"))
        if self.drive == "reel":
            more.append(("tension", count, "N", "tendon tension at the base"))
            more.append(("path", count, "m", "way of the tendons through the robot"))
        return Rod.y_layout + Layout(*more)

    @property
    def z_layout(self) -> Layout:  # type: ignore[override]
        """Strains, friction of each tendon, and vibration."""
        more = []
        if self.rubs:
            more.append(
                ("f", self.tendon_count, "1", "part of the friction that holds a tendon, and which way")
            )
        if self.vibrates:
            more.append(("x", 1, "1", "part of the friction that vibration has taken away"))
        return Rod.z_layout + Layout(*more)

    @property
    def base_unknowns(self) -> tuple[str, ...]:  # type: ignore[override]
        """Those of the rod, and the tension that comes of a reel's position."""
        return (*self.base_end.unknowns, "tension") if self.drive == "reel" else self.base_end.unknowns

    @property
    def cuts(self) -> tuple[float, ...]:  # type: ignore[override]
        """Those of the rod, and where tendons are anchored."""
        return tuple(sorted({*super().cuts, *(end for end in self._ends if end < 1.0)}))

    @property
    def _ends(self) -> tuple[float, ...]:
        return (1.0,) if self.routing is None else tuple(float(end) for end in ends(self.routing))

    # what the tendons do

    def base_tension(self, y: Float[Any, " y"], control: Float[Any, " c"]) -> Float[Any, " c"]:
        """T (N) at the base."""
        return self.y_layout.get(y, "tension") if self.drive == "reel" else control[: self.tendon_count]

    def tension_at(self, s: Any, y: Float[Any, " y"], control: Float[Any, " c"]) -> Float[Any, " c"]:
        """τ (N) at s: less by friction, and none of a tendon that has ended."""
        T = self.base_tension(y, control)
        if self.rubs:
            T = T * jnp.exp(-self.y_layout.get(y, "loss"))
        return self._where_it_runs(s, T)

    def _where_it_runs(self, s: Any, values: Float[Any, " c"]) -> Float[Any, " c"]:
        """Values of the tendons, and zero for those that have ended before s."""
        if min(self._ends) >= 1.0:
            return values
        return jnp.where(s < np.array(self._ends) * self.length, values, 0.0)

    def routes_at(self, s: Any) -> tuple[Float[Any, "c 3"], Float[Any, "c 3"]]:
        """r and r′ of the tendons at s."""
        if self.routing is not None:
            return routes(self.routing, s / self.length, self.length)
        angles = jnp.asarray(self.tendon_angles)
        around = jnp.stack([jnp.cos(angles), jnp.sin(angles), jnp.zeros_like(angles)], axis=-1)
        return self.tendon_offset * around, np.zeros(around.shape)

    def bending_directions(self, s: Any) -> Float[Any, "c 3"]:
        """eᵢ: the direction of u in which each tendon bends the rod at s, material frame."""
        if self.routing is None:
            angles = jnp.asarray(self.tendon_angles)
            return jnp.stack([-jnp.sin(angles), jnp.cos(angles), jnp.zeros_like(angles)], axis=-1)
        r, _ = self.routes_at(s)
        across = jnp.stack([-r[:, 1], r[:, 0], jnp.zeros_like(r[:, 0])], axis=-1)
        return across / jnp.sqrt(jnp.sum(across * across, axis=1, keepdims=True) + 1e-24)

    def actuation(self, control: Float[Any, " c"]) -> Float[Any, " a"]:
        """Σ Tᵢ d₃ × rᵢ of straight tendons (N·m), material frame; of all others the control."""
        if self.routing is not None or self.drive == "reel" or self.control_size > self.tendon_count:
            return control
        return self.tendon_offset * dot(self.bending_directions(0.0).T, control)

    def material(self, s: Any, control: Any) -> Material:
        """The rod's, stiffer against bending within the sleeve."""
        found = super().material(s, control)
        if self.sleeve_stiffening is None:
            return found
        return found._replace(Kbt=found.Kbt * self._sleeve(s))

    def _sleeve(self, s: Any) -> Any:
        return 1.0 + self.sleeve_stiffening * jnp.exp(-((s / self.sleeve_length) ** 4))

    def law_factors(self, s: Any, control: Any) -> tuple[Any, Any] | None:
        """Those of the rod's sections, and the sleeve's on its stiffness."""
        found = super().law_factors(s, control)
        if found is None and self.sleeve_stiffening is None:
            return None
        stiffness, damping = (jnp.ones(6), jnp.ones(6)) if found is None else found
        if self.sleeve_stiffening is not None:
            stiffness = stiffness * jnp.concatenate([jnp.ones(3), jnp.full(3, self._sleeve(s))])
        others = jnp.ones(self.z_layout.size - 6)
        return jnp.concatenate([stiffness, others]), jnp.concatenate([damping, others])

    def rest(self, s: Any) -> tuple[Float[Any, " y"], Float[Any, " z"]]:
        """That of the rod; no tension, and no friction."""
        y, z = super().rest(s)
        if self.drive == "reel":
            y = y.at[self.y_layout.slice("path")].set(self._ways(s))
        return y, jnp.concatenate([z, np.zeros(self.z_layout.size - 6)])

    def _ways(self, s: Any) -> Float[Any, " c"]:
        """Lengths of the tendons through the unloaded robot from the base to s, by Gauss's rule."""
        nodes, weights = np.polynomial.legendre.leggauss(GAUSS)
        ways = []
        for k, routing in enumerate(self.routings):
            last = jnp.minimum(s, routing.end * self.length)
            at = 0.5 * (nodes + 1.0) * jnp.asarray(last)[..., None]

            def stretched(place: Any, k: int = k) -> Any:
                r, r_s = routes((self.routings[k],), place / self.length, self.length)
                u = self.material(place, np.zeros(self.control_size)).u_star
                return stretches(jnp.asarray(self.v_star), jnp.asarray(u), jnp.asarray(r), jnp.asarray(r_s))[
                    0
                ]

            ways.append(0.5 * last * jnp.sum(weights * jax.vmap(stretched)(at)))
        return jnp.stack(ways)

    # the equations

    # not of the form C z + D z_t = f2
    constitutive = System.constitutive

    def strains(
        self, s: Any, t: Any, y: Float[Any, " y"], control: Any, history: History
    ) -> Float[Any, " z"]:
        """v and u by the material's law, f and x by their own."""
        given, more = self._law_at(s, y, control, history)
        v, u = tendon_strains(*given, flexibility=self._unbent_flexibility(s, y, control, history.c0))
        if self.rubs:
            more.insert(0, self._friction(s, history.c0 * u + self.z_layout.get(history.z, "u"), history))
        return jnp.concatenate([v, u, *more])

    linear_law = False

    def left_of_law(self, s, t, y, z, control, history):  # type: ignore[no-untyped-def]
        """Rod and tendons together less n and m; of friction and vibration, what they differ by."""
        given, more = self._law_at(s, y, control, history)
        v, u = self.z_layout.get(z, "v"), self.z_layout.get(z, "u")
        if self.rubs:
            more.insert(0, self._friction(s, history.c0 * u + self.z_layout.get(history.z, "u"), history))
        left = tendon_balance(v, u, *given)
        return jnp.concatenate([left, z[6:] - jnp.concatenate(more)]) if more else left

    def _law_at(self, s: Any, y: Any, control: Any, history: History) -> tuple[tuple[Any, ...], list[Any]]:
        """K_v, K_u, a, b, r, r′ and T of the law (see `tendon_law`), and x if there is vibration."""
        c0, material = history.c0, self.material(s, control)
        n, m = self.stresses(y)
        hv, hu = self.z_layout.get(history.z, "v"), self.z_layout.get(history.z, "u")
        Kse, Bse, Kbt, Bbt = material[:4]
        more = []
        if self.vibrates:
            x = self._vibration(y, control, history)
            more.append(x)
            total = jnp.sum(self.base_tension(y, control))
            Kbt = Kbt - self.vibration_softening * x[0] * total * np.diag([1.0, 1.0, 0.0])
        a = n + dot(Kse, self.v_star) - dot(Bse, hv)
        b = m - dot(Bbt, hu) if not self.sections else m + dot(Kbt, material.u_star) - dot(Bbt, hu)
        tension = self.tension_at(s, y, control)
        return (Kse + c0 * Bse, Kbt + c0 * Bbt, a, b, *self.routes_at(s), tension), more

    def _unbent_flexibility(self, s: Any, y: Any, control: Any, c0: Any) -> Float[Any, "6 6"]:
        """What the law is solved by: of what is known before y, where tensions are given."""
        Kse, Bse, Kbt, Bbt = self.material(s, control)[:4]
        tension = self._where_it_runs(s, self.base_tension(y, control))
        return unbent_flexibility(Kse + c0 * Bse, Kbt + c0 * Bbt, *self.routes_at(s), tension)

    def _vibration(self, y: Any, control: Any, history: History) -> Float[Any, " 1"]:
        total = jnp.sum(self.base_tension(y, control))
        growth = self.vibration_rate * (total - self.vibration_tension)
        return shaking(growth, self.z_layout.get(history.z, "x"), history.c0)

    def _friction(self, s: Any, u_t: Float[Any, "3"], history: History) -> Float[Any, " c"]:
        bending = dot(self.bending_directions(s), u_t) / self.friction_reach
        return held(bending, self.z_layout.get(history.z, "f"), history.c0)

    def spatial_rates(self, s, y, y_t, z, z_t, control):  # type: ignore[no-untyped-def]
        """Those of the rod, of the tension, and of the tendons' way."""
        rates = [super().spatial_rates(s, y, y_t, z, z_t, control)]
        v, u = self.z_layout.get(z, "v"), self.z_layout.get(z, "u")
        if self.rubs:
            f = self.z_layout.get(z, "f")
            if self.vibrates:
                f = f * (1.0 - self.z_layout.get(z, "x"))
            rates.append(loss_rates(u, f, self.friction_wobble, self.friction_curvature))
        if self.drive == "reel":
            way = stretches(v, u, *map(jnp.asarray, self.routes_at(s)))
            rates += [jnp.zeros(self.tendon_count), self._where_it_runs(s, way)]
        return jnp.concatenate(rates)

    def tip(self, t: Any, control: Any, y: Float[Any, " y"], history: History) -> Float[Any, " k"]:
        """That of the rod; of reels, that tension or slack is zero (Fischer & Burmeister, blended)."""
        left = super().tip(t, control, y, history)
        if self.drive != "reel":
            return left
        T, way = self.y_layout.get(y, "tension"), self.y_layout.get(y, "path")
        given = self._ways(self.length) - control[: self.tendon_count] + self.tendon_compliance * T
        slack, pulled = given - way, self._give * T
        blend = BLEND * self.length
        return jnp.concatenate([left, slack + pulled - jnp.sqrt(slack**2 + pulled**2 + 2.0 * blend**2)])

    @property
    def _give(self) -> Any:
        """Metres per newton by which tension and slack are compared: the tendon's own, and the rod's."""
        return self.tendon_compliance + 1e-3 * self.length**3 / self.Kbt[0, 0]

    @property
    def tip_layout(self) -> Layout:
        """That of the rod, and of reels."""
        if self.drive != "reel":
            return super().tip_layout
        return super().tip_layout + Layout(("slack", self.tendon_count, "m", "slack or tension"))

    def scale_of(self, name: str, sizes: dict[str, Any]) -> Any:
        """Tension of a rod's own force, ways of its length."""
        more = {"loss": 1.0, "tension": sizes["n"], "path": sizes["p"], "slack": sizes["p"]}
        return more[name] if name in more else super().scale_of(name, sizes)
