"""A system made of a system and a residual: solvers cannot tell the difference."""

from __future__ import annotations

from typing import Any, Self

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from knode_cosserat.learning.residual import Residual
from knode_cosserat.rods.layout import Layout
from knode_cosserat.rods.system import History, Scales, System, of_strands


class About:
    """What is known of a model beside its numbers: how it was fitted, on which data.

    It rides along with a model and is equal to any other, so that models of one structure share compiled
    programs and can be stacked.
    """

    def __init__(self, facts: dict[str, Any] | None = None):
        self.facts = dict(facts or {})

    def __eq__(self, other: object) -> bool:
        return isinstance(other, About)

    def __hash__(self) -> int:
        return hash(About)


class KNODE(System):
    """Knowledge and residual together (paper eq. 9), with the layouts and conditions of the knowledge."""

    knowledge: System
    residual: Residual
    about: About = eqx.field(static=True)

    def __init__(self, knowledge: System, residual: Residual, about: About | None = None):
        self.knowledge = knowledge
        self.residual = residual
        self.about = about or About()
        self.nodes = knowledge.nodes

    @property
    def adapted(self) -> System:
        """The knowledge as the residual changes it."""
        return self.residual.adapted(self.knowledge)

    @property
    def y_layout(self) -> Layout:  # type: ignore[override]
        """The knowledge's."""
        return self.knowledge.y_layout

    @property
    def z_layout(self) -> Layout:  # type: ignore[override]
        """The knowledge's."""
        return self.knowledge.z_layout

    @property
    def control_layout(self) -> Layout:  # type: ignore[override]
        """The knowledge's."""
        return self.knowledge.control_layout

    @property
    def base_unknowns(self) -> tuple[str, ...]:  # type: ignore[override]
        """The knowledge's."""
        return self.knowledge.base_unknowns

    @property
    def mixed(self) -> bool:  # type: ignore[override]
        """The knowledge's."""
        return self.knowledge.mixed

    @property
    def cuts(self) -> tuple[float, ...]:  # type: ignore[override]
        """The knowledge's."""
        return self.knowledge.cuts

    @property
    def jumps(self) -> bool:  # type: ignore[override]
        """The knowledge's."""
        return self.knowledge.jumps

    @property
    def rest_is_guess(self) -> bool:  # type: ignore[override]
        """The knowledge's."""
        return self.knowledge.rest_is_guess

    @property
    def held(self) -> bool:  # type: ignore[override]
        """The knowledge's."""
        return self.knowledge.held

    @property
    def strands(self) -> int:
        """The knowledge's."""
        return self.knowledge.strands

    @property
    def strand(self) -> System:
        """The knowledge's strand with the residual: what is learned along the rod holds for every strand."""
        return self if self.strands == 1 else type(self)(self.knowledge.strand, self.residual, self.about)

    @property
    def velocities(self) -> tuple[str, ...]:  # type: ignore[override]
        """The knowledge's."""
        return self.knowledge.velocities

    @property  # type: ignore[misc]
    def length(self) -> Any:
        """Length of the rod (m), as the residual corrects it; one each of a batch."""
        if np.ndim(self.knowledge.length):
            return jax.vmap(lambda model: model.adapted.length)(self)
        return self.adapted.length

    def derivatives(
        self, s: Any, t: Any, y: Float[Any, " y"], control: Any, history: History
    ) -> tuple[Float[Any, " y"], Float[Any, " z"]]:
        """y_s and z of knowledge and residual together."""
        if self.strands > 1:
            return of_strands(self, s, t, y, control, history)
        return self.residual.derivatives(self.adapted, s, t, y, control, history)

    def crossed(
        self, acting: Float[Any, " cuts"], t: Any, y: Float[Any, " y"], control: Any, history: History
    ) -> Float[Any, " y"]:
        """The knowledge's."""
        return self.adapted.crossed(acting, t, y, control, history)

    def rest(self, s: Any) -> tuple[Float[Any, " y"], Float[Any, " z"]]:
        """The knowledge's, at its corrected length."""
        return self.adapted.rest(s)

    def base(self, t: Any, control: Any, unknowns: Float[Any, " k"], history: History) -> Float[Any, " y"]:
        """The knowledge's."""
        return self.adapted.base(t, control, unknowns, history)

    def unknowns(self, y: Float[Any, " y"]) -> Float[Any, " k"]:
        """The knowledge's."""
        return self.adapted.unknowns(y)

    def tip(self, t: Any, control: Any, y: Float[Any, " y"], history: History) -> Float[Any, " k"]:
        """The tip's conditions of knowledge and residual together."""
        return self.residual.tip(self.adapted, t, control, y, history)

    @property
    def tip_layout(self) -> Layout:
        """The knowledge's."""
        return self.knowledge.tip_layout

    def scales(self) -> Scales:
        """The knowledge's."""
        return self.adapted.scales()

    def actuation(self, control: Float[Any, " c"]) -> Float[Any, " a"]:
        """The knowledge's."""
        return self.knowledge.actuation(control)

    @property
    def observable_layout(self) -> Layout:
        """The knowledge's."""
        return self.knowledge.observable_layout

    def observables(self, s: Any, y: Any, y_t: Any, z: Any, z_t: Any, control: Any) -> Float[Any, " o"]:
        """The knowledge's."""
        return self.adapted.observables(s, y, y_t, z, z_t, control)

    def end_poses(self, control: Any) -> tuple[Any, Any]:
        """The knowledge's."""
        return self.knowledge.end_poses(control)

    def positions(self, y: Any) -> Any:
        """The knowledge's."""
        return self.knowledge.positions(y)

    def unstressed(self, s: Any, control: Any) -> Float[Any, " z"]:
        """The knowledge's."""
        return self.adapted.unstressed(s, control)

    def law_factors(self, s: Any, control: Any) -> tuple[Any, Any] | None:
        """The knowledge's."""
        return self.adapted.law_factors(s, control)

    def curves(self, y: Any) -> list[Any]:
        """The knowledge's."""
        return self.knowledge.curves(y)

    def quaternions(self, y: Any) -> Any:
        """The knowledge's."""
        return self.knowledge.quaternions(y)

    def eased(self, part: float) -> Self:
        """With the knowledge's."""
        easier = self.knowledge.eased(part)
        return self if easier is self.knowledge else type(self)(easier, self.residual, self.about)

    def replace(self, **changes: Any) -> Self:
        """A copy whose knowledge has other parameters (or nodes), by name."""
        return type(self)(self.knowledge.replace(**changes), self.residual, self.about)

    def save(self, path: Any) -> None:
        """Write a model's file (see `model_file.save`)."""
        from knode_cosserat.learning.files import model_file

        model_file.save(self, path)
