"""Residual of an identified robot: smooth functions of the controls, and terms of the rod's law and load.

    control    u' = u + f(u), the tensions or motions that act, by all controls together; or f(u), what each
               tendon needs more in length, where reels take tendons in
    bending    curvature more than by the nominal law, of the first to the fourth degree in the moment
    levers     curvature more, in proportion to each tendon's tension
    tightened  curvature more, in proportion to each tendon's tension times the moment
    damping    Kelvin-Voigt damping of bending; not negative
    load       force per length in the global frame

f is a sum of Gaussian functions about centres among the training controls. It falls to zero far from them,
where the model is the identified robot again. The rest is by place: hat functions over equal parts of the
rod. With κ the nominal bending stiffness, σ = s/L, and ê the rod's own part of the bending moment over κ/L,

    u L = (nominal law) + ∂W*/∂ê (ê, σ)

W* is a complementary energy, a polynomial in ê. In the first degree it is another curvature at rest, in the
second another stiffness, in the third a stiffness that differs between the two directions, and in the fourth
one that changes with the load. It is evaluated at the moment, so that no further equation has to be solved.
Under constant controls the residual of a rod without tendons supplies no energy; with tendons their part of
the moment is that on the unbent rod.
"""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple, Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.learning.residual import Residual
from knode_cosserat.rods.aspects import Observed
from knode_cosserat.rods.law import InternalState, StressedLaw
from knode_cosserat.rods.system import Discontinuities, System
from knode_cosserat.rods.wrapped import Wrapped, nominal_model
from knode_cosserat.rotation import dot

#: hat functions along the rod
PLACES = 4
#: Gaussian functions of the controls, at most; a combination of them with less than this part of the largest
#: variance is left out
CENTRES, LEAST_SHARE = 24, 1e-4
#: widths of the Gaussian functions, in standard deviations of the controls
REACHES = (3.0, 6.0)
#: change of the controls, or of tendons' lengths, by learned numbers of one, in their standard deviations
SHARE = 0.15
#: bending and forces per length by learned numbers of one, in 1/L and κ/L³
BENT, FORCE = 0.1, 0.3
#: damping ratio of the first mode by learned numbers of one
RATIO = 0.05
#: parts of the control, with the widths in `REACHES`, and of bending, by their degree
CONTROL = ("near", "wide")
BENDING = ("first", "second", "third", "fourth")


class Smooth(eqx.Module):
    """Smooth function of the controls: Gaussian functions that were made independent (Nyström)."""

    fixed: ClassVar[tuple[str, ...]] = ("centres", "mix", "unit", "size")

    weights: Float[Any, "functions outputs"]
    centres: Float[Any, "m c"]
    #: from the Gaussian functions to the functions
    mix: Float[Any, "m functions"]
    #: width of the Gaussian functions along each control
    unit: Float[Any, " c"]
    #: of each output, by weights of one
    size: Float[Any, " outputs"]

    def __call__(self, control: Float[Any, " c"]) -> Float[Any, " outputs"]:
        """Return the function's value."""
        away = (self.centres - control) / self.unit
        functions = jnp.exp(-0.5 * jnp.sum(away * away, axis=1)) @ self.mix
        return self.size * (functions @ self.weights)


def smooth(
    controls: Float[np.ndarray, "rows c"], reach: float, size: Float[np.ndarray, " outputs"]
) -> Smooth:
    """Return a function of controls, zero, with centres spread over those that occurred.

    Args:
        controls: the controls of training, not all constant.
        reach: width of the Gaussian functions in standard deviations, for up to three controls; for more it
            grows with the usual distance between two controls.
        size: of each output.
    """
    spread = np.std(controls, axis=0)
    moves = spread > 1e-9 * np.max(spread)
    rows = controls[:, moves] / spread[moves]
    reach *= max(1.0, np.sqrt(rows.shape[1] / 3.0))
    # the one in the middle, then the farthest from those before, one by one
    chosen = [int(np.argmin(np.sum((rows - rows.mean(axis=0)) ** 2, axis=1)))]
    apart = np.sum((rows - rows[chosen[0]]) ** 2, axis=1)
    while len(chosen) < min(CENTRES, len(rows)) and np.max(apart) > 1e-6:
        chosen.append(int(np.argmax(apart)))
        apart = np.minimum(apart, np.sum((rows - rows[chosen[-1]]) ** 2, axis=1))
    away = rows[chosen][:, None] - rows[chosen]
    sizes, vectors = np.linalg.eigh(np.exp(-0.5 * np.sum(away**2, axis=-1) / reach**2))
    used = sizes > LEAST_SHARE * sizes[-1]
    # the width along a control that never moved has no limit
    unit = np.where(moves, reach * spread, 1e9 * np.maximum(1.0, np.max(np.abs(controls))))
    weights = np.zeros((int(used.sum()), len(size)))
    return Smooth(weights, controls[chosen], vectors[:, used] / np.sqrt(sizes[used]), unit, size)


class Recontrolled(Wrapped):
    """A system under changed controls."""

    knowledge: System
    changes: tuple[Smooth, ...]

    def __init__(self, knowledge: System, changes: tuple[Smooth, ...]):
        self.knowledge = knowledge
        self.changes = changes
        self.nodes = knowledge.nodes

    def around(self, knowledge: System) -> Self:
        """Return another system under the same change of its controls."""
        return type(self)(knowledge, self.changes)

    def acting(self, control: Any) -> Any:
        """Return the control that acts."""
        return control + sum(change(control) for change in self.changes)

    def constitutive(self, s: Any, t: Any, y: Any, y_t: Any, control: Any) -> Any:
        """Return the law under the control that acts."""
        return self.knowledge.constitutive(s, t, y, y_t, self.acting(control))

    def balance(self, s: Any, t: Any, y: Any, y_t: Any, z: Any, z_t: Any, control: Any) -> Any:
        """Return the balance under the control that acts."""
        return self.knowledge.balance(s, t, y, y_t, z, z_t, self.acting(control))

    def base(self, t: Any, control: Any, unknowns: Any) -> Any:
        """Return y at the base under the control that acts."""
        return self.knowledge.base(t, self.acting(control), unknowns)

    def tip(self, t: Any, control: Any, y: Any, y_t: Any) -> Any:
        """Return the conditions at the tip under the control that acts."""
        return self.knowledge.tip(t, self.acting(control), y, y_t)

    @property
    def discontinuities(self) -> Discontinuities:  # type: ignore[override]
        """Places of the system, and its jump under the control that acts."""
        places, jump = self.knowledge.discontinuities
        if jump is None:
            return Discontinuities(places)
        return Discontinuities(places, lambda *terms: jump(*terms[:-1], self.acting(terms[-1])))


class Units(NamedTuple):
    """κ (N m²), the time of damping (s), and a usual tension (N)."""

    stiffness: Any
    time: Any
    tension: Any = 1.0


class Terms(Residual):
    """Residual of an identified robot (see the module). Parts that are None cost nothing."""

    fixed: ClassVar[tuple[str, ...]] = ("units",)
    linear_in: ClassVar[tuple[str, ...]] = (
        *(f"{name}.weights" for name in CONTROL),
        *BENDING,
        "levers",
        "tightened",
        "damping",
        "load",
    )

    units: Units
    #: functions of the controls, of two widths
    near: Smooth | None = None
    wide: Smooth | None = None
    #: coefficients of W* of the degrees one to four, in the order of `_powers`
    first: Float[Any, "places 2"] | None = None
    second: Float[Any, "places 3"] | None = None
    third: Float[Any, "places 4"] | None = None
    fourth: Float[Any, "places 5"] | None = None
    #: curvature in proportion to the tension of each tendon
    levers: Float[Any, "places 2 tendons"] | None = None
    #: curvature in proportion to the products of both components of the moment with all tensions
    tightened: Float[Any, "places 2 products"] | None = None
    damping: Float[Any, " places"] | None = None
    load: Float[Any, "places 3"] | None = None

    @property
    def changes(self) -> tuple[Smooth, ...]:
        """Functions of the controls."""
        return tuple(change for name in CONTROL if (change := getattr(self, name)) is not None)

    def adapted(self, knowledge: System) -> System:
        """Return the nominal model under the controls that act."""
        if not self.changes or _wound(knowledge):
            return knowledge
        return Recontrolled(knowledge, self.changes)

    def constitutive(self, knowledge: System, s: Any, t: Any, y: Any, y_t: Any, control: Any) -> Any:
        """Return the nominal law with the learned curvature and damping."""
        law = knowledge.constitutive(s, t, y, y_t, control)
        energy = [(degree, value) for degree, name in enumerate(BENDING, 1)
                  if (value := getattr(self, name)) is not None]  # fmt: skip
        if not energy and self.levers is None and self.tightened is None and self.damping is None:
            return law
        L, (kappa, time, tension) = knowledge.length, self.units
        rest = Observed.of(knowledge).unstressed(s, control)
        unbent = {name: knowledge.z_layout.get(rest, name) for name in "vu"}

        def changed(law: Any) -> Any:
            if isinstance(law, StressedLaw):
                return law._replace(law=changed(law.law))
            if isinstance(law, InternalState):
                return InternalState(law.evolutions, lambda internal: changed(law.law(internal)))
            u, more = law.strains["u"], jnp.zeros(2)
            if energy or self.tightened is not None:
                # the rod's own part of the moment
                moment = u.stress - dot(u.stiffness, unbent["u"])
                if law.coupling is not None:
                    moment = moment - law.coupling.stresses(unbent)["u"]
                bent = L / kappa * moment[:2]
                more = sum((_bending(degree, hats(s / L, value), bent) for degree, value in energy), more)
            if self.levers is not None or self.tightened is not None:
                pulled = _tensions(knowledge, y, control) / tension
            if self.levers is not None:
                more = more + BENT * dot(hats(s / L, self.levers), pulled)
            if self.tightened is not None:
                products = (bent[:, None] * pulled).reshape(-1)
                more = more + BENT * dot(hats(s / L, self.tightened), products)
            u = u._replace(stress=u.stress + dot(u.stiffness, jnp.append(more, 0.0)) / L)
            if self.damping is not None:
                damping = kappa * time * _not_negative(hats(s / L, self.damping))
                u = u._replace(damping=u.damping + damping * np.diag([1.0, 1.0, 0.0]))
            return law.with_strain("u", u)

        return changed(law)

    def balance(
        self, knowledge: System, s: Any, t: Any, y: Any, y_t: Any, z: Any, z_t: Any, control: Any
    ) -> Any:
        """Return the nominal balance with the learned load."""
        balance = knowledge.balance(s, t, y, y_t, z, z_t, control)
        lengths = self.changes if _wound(knowledge) else ()
        if self.load is None and not lengths:
            return balance
        L, layout, more = knowledge.length, knowledge.y_layout, jnp.zeros(y.shape[0])
        factor = Observed.of(knowledge).load_factor(s, control)
        if self.load is not None:
            force = FORCE * self.units.stiffness / L**3 * hats(s / L, self.load)
            more = more.at[layout.slice("n")].set(-force)
        if lengths:
            # what a tendon needs more, spread over the rod
            more = more.at[layout.slice("path")].set(sum(change(control) for change in lengths) / L)
        more = more * factor
        if not isinstance(balance, tuple):
            return balance + more
        A, B, f1 = balance
        return A, B, f1 + more

    def clamped(self) -> Self:
        """Return the residual with damping that is not negative."""
        if self.damping is None:
            return self
        return eqx.tree_at(lambda it: it.damping, self, replace_fn=_not_negative)

    def pruned(self) -> Self:
        """Return a copy without parts that are zero."""
        used = self.coefficients()
        empty = [path.partition(".")[0] for path, value in used.items() if not np.any(np.asarray(value))]
        if not empty:
            return self
        return eqx.tree_at(lambda it: [getattr(it, name) for name in empty], self, [None] * len(empty))


def terms(knowledge: System, controls: Float[np.ndarray, "rows c"], moving: bool = True) -> Terms:
    """Return a residual with all parts that fit a system, zero.

    Args:
        knowledge: the identified robot, or any system.
        controls: the controls of training.
        moving: false for equilibria, which know no damping.
    """
    parts: dict[str, Any] = {}
    robot, kappa, time, tension = nominal_model(knowledge), 1.0, 1.0, 1.0
    if np.any(np.ptp(controls, axis=0) > 0.0):
        acting = controls
        if _wound(knowledge):
            acting = np.stack([robot.parts["tendons"].taken_in(it) for it in controls])
        size = SHARE * np.std(acting, axis=0)
        parts |= {name: smooth(controls, reach, size) for name, reach in zip(CONTROL, REACHES, strict=True)}
    if (
        hasattr(robot, "Kbt")
        and {"u", "v"} <= {*knowledge.z_layout.names}
        and "n" in knowledge.y_layout.names
    ):
        kappa = float(np.min(np.linalg.eigvalsh(np.asarray(robot.Kbt)[:2, :2])))
        sizes = np.asarray(knowledge.scales().y)
        time = 2.0 * RATIO / 3.516 * float(knowledge.length) / sizes[knowledge.y_layout.slice("q")][0]
        parts |= {name: np.zeros((PLACES, degree + 1)) for degree, name in enumerate(BENDING, 1)}
        parts["load"] = np.zeros((PLACES, 3))
        if "tension" in (*knowledge.y_layout.names, *knowledge.control_layout.names):
            count = len(_tensions(knowledge, sizes, np.zeros(knowledge.control_layout.size)))
            parts |= {"levers": np.zeros((PLACES, 2, count)), "tightened": np.zeros((PLACES, 2, 2 * count))}
            # of tendons at a tenth of the length from the axis
            tension = 10.0 * kappa / float(knowledge.length) ** 2
        if moving:
            parts["damping"] = np.zeros(PLACES)
    return Terms(Units(kappa, time, tension), **parts)


def _wound(system: System) -> bool:
    """Return True if controls take in tendons, whose lengths then are unknowns."""
    return "path" in system.y_layout.names


def _tensions(system: System, y: Any, control: Any) -> Any:
    """Return the tendons' tensions (N)."""
    if _wound(system):
        return system.y_layout.get(y, "tension")
    return system.control_layout.get(control, "tension")


def hats(sigma: Any, values: Any) -> Any:
    """Return values between places that are equally spaced along the rod, at σ = s/L."""
    count = values.shape[0]
    near = jnp.maximum(1.0 - jnp.abs(sigma - np.linspace(0.0, 1.0, count)) * (count - 1), 0.0)
    return jnp.tensordot(near, values, 1)


def _bending(degree: int, weights: Any, bent: Float[Any, "2"]) -> Float[Any, "2"]:
    """Return ∂W*/∂ê for W* = Σ wₖ ê₁^(degree-k) ê₂^k / degree."""
    x, y = bent
    powers = [[jnp.ones(())], [jnp.ones(())]]
    for _ in range(degree):
        powers[0].append(powers[0][-1] * x)
        powers[1].append(powers[1][-1] * y)
    along_x = sum(weights[k] * (degree - k) * powers[0][degree - k - 1] * powers[1][k] for k in range(degree))
    along_y = sum(weights[k] * k * powers[0][degree - k] * powers[1][k - 1] for k in range(1, degree + 1))
    return BENT * jnp.stack([jnp.asarray(along_x), jnp.asarray(along_y)]) / degree


def _not_negative(values: Any) -> Any:
    """Return values with negative ones set to zero; the derivative at zero is one."""
    return jnp.where(values >= 0.0, values, 0.0)
