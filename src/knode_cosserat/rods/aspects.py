"""Aspects of a system that most systems need not state: its ends, its drawing, its observables.

`Ends.of(system)` returns the ends of a system, and so for each aspect. A system that differs from the
defaults has a subclass, which names the system's class: `class MyEnds(Ends, of=MySystem)`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar, Self

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.layout import Layout
from knode_cosserat.rods.parts import RodPoint
from knode_cosserat.rods.shapes import Shape
from knode_cosserat.rotation import dot, rotation_matrix


class _Aspect:
    """Aspect of a system."""

    #: makers of the aspect by the class of the systems
    _makers: ClassVar[dict[type, Callable[[Any], Any]]]

    def __init__(self, system: Any):
        self.system = system

    def __init_subclass__(cls, of: type | None = None):
        if _Aspect in cls.__bases__:
            cls._makers = {}
        elif of is not None:
            cls.register(of, cls)

    @classmethod
    def register(cls, owner: type, maker: Callable[[Any], Any]) -> None:
        """Let a function make this aspect of all systems of a class."""
        cls._makers[owner] = maker

    @classmethod
    def of(cls, system: Any) -> Self:
        """Return this aspect of a system."""
        makers = (cls._makers.get(owner) for owner in type(system).__mro__)
        return next(filter(None, makers), cls)(system)


class Ends(_Aspect):
    """Facts of a system's two ends, beside their conditions (`System.base`, `System.tip`)."""

    @property
    def held(self) -> bool:
        """True if the system is constrained; without constraints an equilibrium needs loads that cancel."""
        return True

    @property
    def rest_is_guess(self) -> bool:
        """True if the state at rest is a guess: a simulation starts at the equilibrium without control."""
        return False

    @property
    def layout(self) -> Layout:
        """Layout of the tip's residuals; one generic field by default."""
        count = len(self.system.y_layout.indices(self.system.base_unknowns))
        return Layout(("tip", count, "", "conditions at the tip"))

    def unloaded(self, y: Any, along: Any, controls: Any) -> Any:
        """Return guesses of y (T, points, y): the unloaded system as each control (T, c) turns it.

        By default they are y (points, y), the unloaded shape, `placed` by each. The points are at fractions
        `along` the grid.
        """
        if type(self).placed is Ends.placed:
            return np.broadcast_to(y, (len(controls), *np.shape(y)))
        return np.stack([self.placed(y, control) for control in controls])

    def placed(self, y: Any, control: Any) -> Any:
        """Return the unloaded shape y (points, y) where a control (c,) places the base; by default y."""
        return y

    def branches(self, y: Any, along: Any, controls: Any) -> tuple[Any, Any]:
        """Return guesses (K, points, y) by which several equilibria are found, and the control's row of each.

        Arguments as in `unloaded`. By default there are none.
        """
        return np.zeros(0, dtype=int), np.zeros((0, *np.shape(y)))

    def poses(self, control: Any) -> tuple[Any, Any]:
        """Return the constrained poses of base and tip under a control; None for a free end."""
        return None, None

    def moving_base(self, y: Float[Any, " y"], y_t: Float[Any, " y"]) -> Float[Any, " y"]:
        """Return y at s = 0 with the velocities of a base whose pose has the rate in `y_t`."""
        return y


class Drawing(_Aspect):
    """Positions, orientations and lines of a system's states."""

    #: number of the last curves that are outlines of bodies, not rods
    outlines: int = 0

    def positions(self, y: Any) -> Any:
        """Return positions (…, 3) in metres of states y (…, y)."""
        return self._named(y, "p", "position")

    def quaternions(self, y: Any) -> Any:
        """Return orientations (…, 4), scalar first, of states y (…, y)."""
        return self._named(y, "h", "orientation")

    def attached(self, y: Any) -> Any:
        """Return the orientations (…, 4) of what is attached to the tip, of states y there."""
        return self.quaternions(y)

    def curves(self, y: Any) -> list[Any]:
        """Return lines (…, points, 3) in m for drawing the states y (…, N, y) of one robot."""
        return [np.asarray(self.positions(y))]

    def parts(self, at: Any, control: Any) -> list[Shape]:
        """Return the shapes beside one rod with nodes at fractions (N,), for controls (T, c); here none."""
        return []

    def shapes(self, y: Any, control: Any) -> list[Shape]:
        """Return the shapes of rods and parts, with positions (T, n, 3), for states (T, N, y)."""
        y = np.asarray(y, dtype=float)
        shapes = self.parts(np.linspace(0.0, 1.0, y.shape[1]), control)
        if not shapes:
            return []
        rotation = jax.vmap(jax.vmap(rotation_matrix))(jnp.asarray(self.quaternions(y)))
        place = (np.asarray(self.positions(y)), np.asarray(rotation))
        return [shape.placed(*place) for shape in shapes]

    def _named(self, y: Any, name: str, meaning: str) -> Any:
        layout = self.system.y_layout
        if name not in layout.names:
            raise AttributeError(
                f"{type(self.system).__name__} has no {meaning}: its y has no field {name!r} "
                f"(there are {', '.join(layout.names)})"
            )
        return layout.get(y, name)


class Observed(_Aspect):
    """Possible arguments of a learned law or load of a system, beside its control."""

    #: velocities among the observables, on which drag and friction depend; empty: not specified
    velocities: ClassVar[tuple[str, ...]] = ()
    #: fields of y at the base that follow from its unknowns by a law, and the arguments of that law
    base_law: ClassVar[tuple[str, ...]] = ()
    base_layout: ClassVar[Layout] = Layout()

    @property
    def layout(self) -> Layout:
        """Layout of `observables`: by default y, its rate, the strains relative to rest, and their rate."""
        state, strain = self.system.y_layout.fields, self.system.z_layout.fields
        return Layout(
            *state,
            *((f"{name}_t", size, f"{unit}/s", f"rate of {name}") for name, size, unit, *_ in state),
            *strain,
            *((f"{name}_t", size, f"{unit}/s", f"rate of {name}") for name, size, unit, *_ in strain),
        )

    def observables(self, point: RodPoint) -> Float[Any, " o"]:
        """Return the possible arguments of an unmodelled load, beside the control, in the material frame."""
        _, s, _, y, y_t, control, *_ = point
        bent = point.z - self.unstressed(s, control)
        state = [self._in_material_frame(y, vectors) for vectors in (y, y_t)]
        return jnp.concatenate([*state, bent, point.z_t])

    def actuation(self, control: Float[Any, " c"]) -> Float[Any, " a"]:
        """Return the part of the control that enters the equations; the whole control by default."""
        return control

    @property
    def has_actuation(self) -> bool:
        """True if the actuation differs from the control."""
        return type(self).actuation is not Observed.actuation

    @property
    def ambient_layout(self) -> Layout:
        """Layout of `ambient`: the control, and its actuation if that differs."""
        controls = self.system.control_layout
        if not self.has_actuation:
            return controls
        size = jax.eval_shape(self.actuation, np.zeros(controls.size)).shape[0]
        return controls + Layout(("actuation", size, "", "part of the control that enters the equations"))

    def ambient(self, s: Any, control: Float[Any, " c"]) -> Float[Any, " a"]:
        """Return the possible arguments of a load in the global frame at s."""
        return jnp.concatenate([control, self.actuation(control)]) if self.has_actuation else control

    @property
    def law_layout(self) -> Layout:
        """Layout of `law_inputs`: the strains relative to those without stress, and their rates."""
        strain = self.system.z_layout
        return strain + Layout(
            *((f"{name}_t", size, f"{unit}/s", meaning) for name, size, unit, meaning, *_ in strain.fields)
        )

    def law_inputs(self, s: Any, y: Float[Any, " y"], control: Any) -> Callable[[Any, Any], Any]:
        """Return a function of z and z_t: the possible arguments of a stress, scaled by `law_factors`."""
        rest, factors = self.unstressed(s, control), self.law_factors(s, control)
        strain, rate = (1.0, 1.0) if factors is None else factors
        return lambda z, z_t: jnp.concatenate([(z - rest) * strain, z_t * rate])

    def load_factor(self, s: Any, control: Any) -> Any:
        """Return the rate of arclength along the grid, by which a load per length acts on y_s."""
        return 1.0

    def base_inputs(self, y: Float[Any, " y"], control: Any) -> Float[Any, " b"]:
        """Return the arguments of the law at the base."""
        return jnp.zeros(0)

    def unstressed(self, s: Any, control: Any) -> Float[Any, " z"]:
        """Return z at s of the unstressed material under this control; by default z at rest."""
        return self.system.rest(s)[1]

    def law_factors(self, s: Any, control: Any) -> tuple[Any, Any] | None:
        """Return factors on C and D of the strains' law at s, for each number of z; None if uniform."""
        return None

    def _in_material_frame(self, y: Float[Any, " y"], vectors: Float[Any, " y"]) -> Float[Any, " y"]:
        """Return numbers with the layout of y, with vectors of the global frame in the material frame."""
        layout, parts = self.system.y_layout, []
        for field in layout.fields:
            part = layout.get(vectors, field.name)
            if field.frame:
                part = dot(rotation_matrix(layout.get(y, field.frame)).T, part)
            parts.append(part)
        return jnp.concatenate(parts)
