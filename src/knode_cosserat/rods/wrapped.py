"""Base of systems that wrap another one, such as a nominal model with a learned residual."""

from __future__ import annotations

import abc
from typing import TYPE_CHECKING, Any, Self

import jax
import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.layout import Layout
from knode_cosserat.rods.system import Correction, Scales, System


class Wrapped(System):
    """System that delegates its whole interface to another system; a subclass overrides what it changes.

    A subclass has the wrapped system as its field `knowledge`, and defines `around`. Layouts, boundary
    unknowns and other static members are those of `knowledge`. Equations are those of `adapted`, which is
    `knowledge` unless the subclass changes its parameters. `adapted` does not exist for a batch.
    """

    if TYPE_CHECKING:  # a field of every subclass
        knowledge: System

    @abc.abstractmethod
    def around(self, knowledge: System) -> Self:
        """Return a copy of this system around another wrapped system."""

    @property
    def adapted(self) -> System:
        """Wrapped system with the parameters of the equations."""
        return self.knowledge

    @property
    def nominal(self) -> System:
        """Robot inside all wrapped systems; `replace` changes its parameters."""
        return self.knowledge.nominal

    # static members

    @property
    def y_layout(self) -> Layout:  # type: ignore[override]
        """Layout of y, from the wrapped system."""
        return self.knowledge.y_layout

    @property
    def z_layout(self) -> Layout:  # type: ignore[override]
        """Layout of z, from the wrapped system."""
        return self.knowledge.z_layout

    @property
    def control_layout(self) -> Layout:  # type: ignore[override]
        """Layout of the control, from the wrapped system."""
        return self.knowledge.control_layout

    @property
    def base_unknowns(self) -> tuple[str, ...]:  # type: ignore[override]
        """Fields of y that are unknown at the base, from the wrapped system."""
        return self.knowledge.base_unknowns

    @property
    def mixed(self) -> bool:  # type: ignore[override]
        """True if the wrapped system has terms in y_st."""
        return self.knowledge.mixed

    @property
    def cuts(self) -> tuple[float, ...]:  # type: ignore[override]
        """Discontinuities of the wrapped system (parts of the length)."""
        return self.knowledge.cuts

    @property
    def jumps(self) -> bool:  # type: ignore[override]
        """True if y jumps at discontinuities of the wrapped system."""
        return self.knowledge.jumps

    @property
    def rest_is_guess(self) -> bool:  # type: ignore[override]
        """True if the wrapped system's state at rest is only a guess."""
        return self.knowledge.rest_is_guess

    @property
    def held(self) -> bool:  # type: ignore[override]
        """True if the wrapped system is held in place."""
        return self.knowledge.held

    @property
    def has_actuation(self) -> bool:
        """True if the actuation of the wrapped system differs from its control."""
        return self.knowledge.has_actuation

    @property
    def velocities(self) -> tuple[str, ...]:  # type: ignore[override]
        """Names of the observables that are velocities, from the wrapped system."""
        return self.knowledge.velocities

    @property
    def strands(self) -> int:
        """Number of strands of the wrapped system."""
        return self.knowledge.strands

    @property
    def strand(self) -> System:
        """Strand of the wrapped system, wrapped too."""
        return self if self.strands == 1 else self.around(self.knowledge.strand)

    @property
    def tip_layout(self) -> Layout:
        """Layout of the tip's boundary conditions, from the wrapped system."""
        return self.knowledge.tip_layout

    @property
    def observable_layout(self) -> Layout:
        """Layout of the observables, from the wrapped system."""
        return self.knowledge.observable_layout

    @property  # type: ignore[misc]
    def length(self) -> Any:
        """Length of the rod (m); one value each in a batch."""
        if np.ndim(self.knowledge.length):
            return jax.vmap(lambda system: system.adapted.length)(self)
        return self.adapted.length

    # equations

    def constitutive(self, s, t, y, y_t, control):  # type: ignore[no-untyped-def]
        """Return C, D and f2 of the wrapped system."""
        return self.adapted.constitutive(s, t, y, y_t, control)

    def balance(self, s, t, y, y_t, z, z_t, control):  # type: ignore[no-untyped-def]
        """Return A, B and f1 of the wrapped system."""
        return self.adapted.balance(s, t, y, y_t, z, z_t, control)

    @property
    def correction(self) -> Correction | None:
        """Learned correction of the wrapped system."""
        return self.adapted.correction

    def jump(
        self, acting: Float[Any, " cuts"], t: Any, y: Float[Any, " y"], y_t: Float[Any, " y"], control: Any
    ) -> Float[Any, " y"]:
        """Return y on the far side of the active discontinuities, from the wrapped system."""
        return self.adapted.jump(acting, t, y, y_t, control)

    def rest(self, s: Any) -> tuple[Float[Any, " y"], Float[Any, " z"]]:
        """Return the state at rest of the wrapped system."""
        return self.adapted.rest(s)

    def base(self, t: Any, control: Any, unknowns: Float[Any, " k"]) -> Float[Any, " y"]:
        """Return y at the base, from the wrapped system."""
        return self.adapted.base(t, control, unknowns)

    def moving_base(self, y: Float[Any, " y"], y_t: Float[Any, " y"]) -> Float[Any, " y"]:
        """Return y at the base with its velocities, from the wrapped system."""
        return self.adapted.moving_base(y, y_t)

    def unknowns(self, y: Float[Any, " y"]) -> Float[Any, " k"]:
        """Return the unknowns in y at the base, from the wrapped system."""
        return self.adapted.unknowns(y)

    def tip(self, t: Any, control: Any, y: Float[Any, " y"], y_t: Float[Any, " y"]) -> Float[Any, " k"]:
        """Return the residual of the tip's boundary conditions, from the wrapped system."""
        return self.adapted.tip(t, control, y, y_t)

    def end_poses(self, control: Any) -> tuple[Any, Any]:
        """Return the poses of the held ends, from the wrapped system."""
        return self.knowledge.end_poses(control)

    def scales(self) -> Scales:
        """Return the natural units of y and of the tip's residual, from the wrapped system."""
        return self.adapted.scales()

    # observables

    def actuation(self, control: Float[Any, " c"]) -> Float[Any, " a"]:
        """Return the actuation of a control, from the wrapped system."""
        return self.knowledge.actuation(control)

    def unstressed(self, s: Any, control: Any) -> Float[Any, " z"]:
        """Return the strains without stress, from the wrapped system."""
        return self.adapted.unstressed(s, control)

    def law_factors(self, s: Any, control: Any) -> tuple[Any, Any] | None:
        """Return the factors of strain and rate in the law, from the wrapped system."""
        return self.adapted.law_factors(s, control)

    def observables(self, s: Any, y: Any, y_t: Any, z: Any, z_t: Any, control: Any) -> Float[Any, " o"]:
        """Return the observables, from the wrapped system."""
        return self.adapted.observables(s, y, y_t, z, z_t, control)

    def turned(self, y: Float[Any, " y"], vectors: Float[Any, " y"]) -> Float[Any, " y"]:
        """Return numbers with the layout of y in the material frame, from the wrapped system."""
        return self.knowledge.turned(y, vectors)

    def positions(self, y: Any) -> Any:
        """Return the positions in y, from the wrapped system."""
        return self.knowledge.positions(y)

    def curves(self, y: Any) -> list[Any]:
        """Return the centrelines in y, from the wrapped system."""
        return self.knowledge.curves(y)

    def quaternions(self, y: Any) -> Any:
        """Return the quaternions in y, from the wrapped system."""
        return self.knowledge.quaternions(y)

    def undelayed(
        self, measured: Float[np.ndarray, "T c"], dt: float, before: Float[np.ndarray, " c"] | None = None
    ) -> Float[np.ndarray, "T c"]:
        """Return the controls that act, without sensor delay, from the wrapped system."""
        return self.knowledge.undelayed(measured, dt, before)

    def trained_range(self) -> Any:
        """Return the training range of the wrapped system; None if it has none."""
        return self.knowledge.trained_range()

    # other parameters

    def eased(self, part: float) -> Self:
        """Return the system with eased friction and contact of the wrapped system."""
        easier = self.knowledge.eased(part)
        return self if easier is self.knowledge else self.around(easier)

    def scaled(self, factor: Any) -> Self:
        """Return the system with its length multiplied by a factor."""
        return self.around(self.knowledge.scaled(factor))

    def replace(self, **changes: Any) -> Self:
        """Return a copy in which the wrapped system has other parameters (or nodes), by name."""
        return self.around(self.knowledge.replace(**changes))
