"""KNODE: a nominal model with a learned residual, which is itself a system."""

from __future__ import annotations

from typing import Any, Self

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from knode_cosserat._registry import provided
from knode_cosserat.learning.residual import Residual
from knode_cosserat.rods.layout import Layout
from knode_cosserat.rods.system import History, Scales, System, of_strands
from knode_cosserat.rods.trained_range import TrainedRange


class About:
    """Metadata of a model: settings and data of its fit.

    All instances compare equal, so that models of one structure share compiled programs and can be stacked.
    """

    def __init__(self, facts: dict[str, Any] | None = None):
        self.facts = dict(facts or {})

    def __eq__(self, other: object) -> bool:
        return isinstance(other, About)

    def __hash__(self) -> int:
        return hash(About)


class KNODE(System):
    """Nominal model with a residual (paper eq. 9); layouts and base conditions are the nominal model's."""

    knowledge: System
    residual: Residual
    about: About = eqx.field(static=True)
    #: range of the training trajectories; None if unknown
    trained: TrainedRange | None = None

    def __init__(
        self, knowledge: System, residual: Residual, about: About | None = None,
        trained: TrainedRange | None = None,
    ):  # fmt: skip
        self.knowledge = knowledge
        self.residual = residual
        self.about = about or About()
        self.trained = trained
        self.nodes = knowledge.nodes

    @property
    def adapted(self) -> System:
        """Nominal model with the residual's parameter changes."""
        return self.residual.adapted(self.knowledge)

    @property
    def y_layout(self) -> Layout:  # type: ignore[override]
        """Layout of y, from the nominal model."""
        return self.knowledge.y_layout

    @property
    def z_layout(self) -> Layout:  # type: ignore[override]
        """Layout of z, from the nominal model."""
        return self.knowledge.z_layout

    @property
    def control_layout(self) -> Layout:  # type: ignore[override]
        """Layout of the control, from the nominal model."""
        return self.knowledge.control_layout

    @property
    def base_unknowns(self) -> tuple[str, ...]:  # type: ignore[override]
        """Fields of y that are unknown at the base, from the nominal model."""
        return self.knowledge.base_unknowns

    @property
    def mixed(self) -> bool:  # type: ignore[override]
        """True if the nominal model has terms in y_st."""
        return self.knowledge.mixed

    @property
    def cuts(self) -> tuple[float, ...]:  # type: ignore[override]
        """Discontinuities of the nominal model (parts of the length)."""
        return self.knowledge.cuts

    @property
    def jumps(self) -> bool:  # type: ignore[override]
        """True if y jumps at discontinuities of the nominal model."""
        return self.knowledge.jumps

    @property
    def rest_is_guess(self) -> bool:  # type: ignore[override]
        """True if the nominal model's state at rest is only a guess."""
        return self.knowledge.rest_is_guess

    @property
    def held(self) -> bool:  # type: ignore[override]
        """True if the nominal model is held in place."""
        return self.knowledge.held

    @property
    def strands(self) -> int:
        """Number of strands of the nominal model."""
        return self.knowledge.strands

    @property
    def strand(self) -> System:
        """Strand of the nominal model with the residual; all strands share one residual."""
        if self.strands == 1:
            return self
        return type(self)(self.knowledge.strand, self.residual, self.about, self.trained)

    @property
    def velocities(self) -> tuple[str, ...]:  # type: ignore[override]
        """Names of the observables that are velocities, from the nominal model."""
        return self.knowledge.velocities

    @property  # type: ignore[misc]
    def length(self) -> Any:
        """Length of the rod (m), corrected by the residual; one value each in a batch."""
        if np.ndim(self.knowledge.length):
            return jax.vmap(lambda model: model.adapted.length)(self)
        return self.adapted.length

    def derivatives(
        self, s: Any, t: Any, y: Float[Any, " y"], control: Any, history: History
    ) -> tuple[Float[Any, " y"], Float[Any, " z"]]:
        """Return y_s and z of the nominal model with the residual."""
        if self.strands > 1:
            return of_strands(self, s, t, y, control, history)
        return self.residual.derivatives(self.adapted, s, t, y, control, history)

    def crossed(
        self, acting: Float[Any, " cuts"], t: Any, y: Float[Any, " y"], control: Any, history: History
    ) -> Float[Any, " y"]:
        """Return y on the far side of the active discontinuities, from the nominal model."""
        return self.adapted.crossed(acting, t, y, control, history)

    def rest(self, s: Any) -> tuple[Float[Any, " y"], Float[Any, " z"]]:
        """Return the state at rest of the nominal model, at its corrected length."""
        return self.adapted.rest(s)

    def base(self, t: Any, control: Any, unknowns: Float[Any, " k"], history: History) -> Float[Any, " y"]:
        """Return y at the base, from the nominal model."""
        return self.adapted.base(t, control, unknowns, history)

    def unknowns(self, y: Float[Any, " y"]) -> Float[Any, " k"]:
        """Return the unknowns in y at the base, from the nominal model."""
        return self.adapted.unknowns(y)

    def tip(self, t: Any, control: Any, y: Float[Any, " y"], history: History) -> Float[Any, " k"]:
        """Return the residual of the tip's boundary conditions, with the learned residual."""
        return self.residual.tip(self.adapted, t, control, y, history)

    @property
    def tip_layout(self) -> Layout:
        """Layout of the tip's boundary conditions, from the nominal model."""
        return self.knowledge.tip_layout

    def scales(self) -> Scales:
        """Return the natural units of y and of the tip's residual, from the nominal model."""
        return self.adapted.scales()

    def actuation(self, control: Float[Any, " c"]) -> Float[Any, " a"]:
        """Return the actuation of a control, from the nominal model."""
        return self.knowledge.actuation(control)

    @property
    def observable_layout(self) -> Layout:
        """Layout of the observables, from the nominal model."""
        return self.knowledge.observable_layout

    def observables(self, s: Any, y: Any, y_t: Any, z: Any, z_t: Any, control: Any) -> Float[Any, " o"]:
        """Return the observables, from the nominal model."""
        return self.adapted.observables(s, y, y_t, z, z_t, control)

    def end_poses(self, control: Any) -> tuple[Any, Any]:
        """Return the poses of the held ends, from the nominal model."""
        return self.knowledge.end_poses(control)

    def positions(self, y: Any) -> Any:
        """Return the positions in y, from the nominal model."""
        return self.knowledge.positions(y)

    def unstressed(self, s: Any, control: Any) -> Float[Any, " z"]:
        """Return the strains without stress, from the nominal model."""
        return self.adapted.unstressed(s, control)

    def law_factors(self, s: Any, control: Any) -> tuple[Any, Any] | None:
        """Return the factors of strain and rate in the law, from the nominal model."""
        return self.adapted.law_factors(s, control)

    def curves(self, y: Any) -> list[Any]:
        """Return the centrelines in y, from the nominal model."""
        return self.knowledge.curves(y)

    def quaternions(self, y: Any) -> Any:
        """Return the quaternions in y, from the nominal model."""
        return self.knowledge.quaternions(y)

    def eased(self, part: float) -> Self:
        """Return the model with eased friction and contact of the nominal model."""
        easier = self.knowledge.eased(part)
        if easier is self.knowledge:
            return self
        return type(self)(easier, self.residual, self.about, self.trained)

    def replace(self, **changes: Any) -> Self:
        """Return a copy in which the nominal model has other parameters (or nodes), by name."""
        return type(self)(self.knowledge.replace(**changes), self.residual, self.about, self.trained)

    def undelayed(
        self, measured: Float[np.ndarray, "T c"], dt: float, before: Float[np.ndarray, " c"] | None = None
    ) -> Float[np.ndarray, "T c"]:
        """Return the controls that act, without sensor delay, from the nominal model."""
        return self.knowledge.undelayed(measured, dt, before)

    def trained_range(self) -> TrainedRange | None:
        """Return the model's own training range, else the nominal model's."""
        return self.trained if self.trained is not None else self.knowledge.trained_range()

    def save(self, path: Any) -> None:
        """Write the model to a file (see `model_file.save`)."""
        provided(type(self), "save")(self, path)
