"""KNODE: a nominal model with a learned residual, which is itself a system."""

from __future__ import annotations

from typing import Any, Self

import equinox as eqx
import jax
from jaxtyping import Float

from knode_cosserat._registry import provided
from knode_cosserat._reprs import count_of, quantity, robot_text, wrapped
from knode_cosserat.learning.residual import Residual
from knode_cosserat.rods.system import History, System, of_strands
from knode_cosserat.rods.trained_range import TrainedRange
from knode_cosserat.rods.wrapped import Wrapped


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


class KNODE(Wrapped):
    """Nominal model with a residual; layouts and base conditions are the nominal model's.

    The nominal model may itself be a KNODE.
    """

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

    def around(self, knowledge: System) -> Self:
        """Return a model with the same residual and another nominal model."""
        return type(self)(knowledge, self.residual, self.about, self.trained)

    def __repr__(self) -> str:
        facts = self.about.facts
        parts = [f"KNODE of a {robot_text(self.knowledge)}", f"residual {self.residual!r}"]
        if "trajectories" in facts:
            parts.append(f"fitted to {count_of(len(facts['trajectories']), 'trajectory', 'trajectories')}")
        if isinstance(facts.get("held_out_error"), float):
            parts.append(f"held-out tip error {quantity(1e3 * facts['held_out_error'], 'mm')}")
        return wrapped("; ".join(parts))

    @property
    def adapted(self) -> System:
        """Nominal model with the residual's parameter changes."""
        return self.residual.adapted(self.knowledge)

    # the equations with the residual; it is the same for all strands

    def derivatives(
        self, s: Any, t: Any, y: Float[Any, " y"], control: Any, history: History
    ) -> tuple[Float[Any, " y"], Float[Any, " z"]]:
        """Return y_s and z of the nominal model with the residual (paper eq. 7, KNODE model)."""
        if self.strands > 1:
            return of_strands(self, s, t, y, control, history)
        return self.residual.derivatives(self.adapted, s, t, y, control, history)

    def strains(
        self, s: Any, t: Any, y: Float[Any, " y"], control: Any, history: History
    ) -> Float[Any, " z"]:
        """Return z of the nominal model with the residual."""
        if self.strands > 1:
            return self.derivatives(s, t, y, control, history)[1]
        return self.residual.strains(self.adapted, s, t, y, control, history)

    def rates(
        self, s: Any, t: Any, y: Float[Any, " y"], z: Float[Any, " z"], control: Any, history: History
    ) -> Float[Any, " y"]:
        """Return y_s at strains z; with several strands, at the strains of their law."""
        if self.strands > 1:
            return self.derivatives(s, t, y, control, history)[0]
        return self.residual.rates(self.adapted, s, t, y, z, control, history)

    def left_of_law(
        self, s: Any, t: Any, y: Float[Any, " y"], z: Float[Any, " z"], control: Any, history: History
    ) -> Float[Any, " z"]:
        """Return the residual of the law of the strains at z, with the learned one."""
        if self.strands > 1:
            return z - self.strains(s, t, y, control, history)
        return self.residual.left_of_law(self.adapted, s, t, y, z, control, history)

    @property
    def linear_law(self) -> bool:  # type: ignore[override]
        """True if the law is linear in the strains, with the residual."""
        return self.knowledge.linear_law and self.residual.linear

    def law_matrix(
        self, s: Any, t: Any, y: Float[Any, " y"], z: Float[Any, " z"], control: Any, history: History
    ) -> Float[Any, "z z"]:
        """Return the derivative of `left_of_law` by z."""
        return jax.jacfwd(lambda z: self.left_of_law(s, t, y, z, control, history))(z)

    # a residual is not of the general form
    constitutive = System.constitutive
    balance = System.balance

    def tip(self, t: Any, control: Any, y: Float[Any, " y"], history: History) -> Float[Any, " k"]:
        """Return the residual of the tip's boundary conditions, with the learned residual."""
        return self.residual.tip(self.adapted, t, control, y, history)

    def trained_range(self) -> TrainedRange | None:
        """Return the model's own training range, else the nominal model's."""
        return self.trained if self.trained is not None else self.knowledge.trained_range()

    def save(self, path: Any) -> None:
        """Write the model to a file (see `model_file.save`)."""
        provided(type(self), "save")(self, path)
