"""KNODE: a nominal model with a learned residual, which is itself a system."""

from __future__ import annotations

import functools
from typing import Any, Self

import equinox as eqx
from jaxtyping import Float

from knode_cosserat._registry import provided
from knode_cosserat._reprs import count_of, quantity, robot_text, wrapped
from knode_cosserat.learning.residual import Residual
from knode_cosserat.rods.system import System
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

    def constitutive(self, s: Any, t: Any, y: Float[Any, " y"], y_t: Any, control: Any) -> Any:
        """Return the nominal model's law of z with the residual's terms."""
        return self.residual.constitutive(self.adapted, s, t, y, y_t, control)

    def balance(self, s: Any, t: Any, y: Float[Any, " y"], y_t: Any, z: Any, z_t: Any, control: Any) -> Any:
        """Return the nominal model's balance along the rod with the residual's loads."""
        return self.residual.balance(self.adapted, s, t, y, y_t, z, z_t, control)

    def tip(self, t: Any, control: Any, y: Float[Any, " y"], y_t: Float[Any, " y"]) -> Float[Any, " k"]:
        """Return the residual of the tip's boundary conditions, with the learned residual."""
        return self.residual.tip(self.adapted, t, control, y, y_t)

    @property
    def corrections(self) -> tuple[Any, ...]:
        """Corrections of [y_s; z]: the nominal model's, then the residual's (paper eq. 7, KNODE model)."""
        knowledge, correction = self.adapted, self.residual.correction
        own = () if correction is None else (functools.partial(correction, knowledge),)
        return (*knowledge.corrections, *own)

    def trained_range(self) -> TrainedRange | None:
        """Return the model's own training range, else the nominal model's."""
        return self.trained if self.trained is not None else self.knowledge.trained_range()

    def coefficients(self) -> dict[str, Any]:
        """Return the numbers in which the residual is linear; `replace` knows them as "residual.NAME"."""
        return self.residual.coefficients()

    def replace(self, **changes: Any) -> Self:
        """Return a copy with other parameters of the nominal model, or other coefficients of the residual.

        The latter are named as in `coefficients`, such as `residual.damping`.

        Raises:
            ParameterError: a name that does not exist, a value that is not allowed.
        """
        own = {name: changes.pop(name) for name in list(changes) if name.startswith("residual.")}
        found = super().replace(**changes) if changes else self
        if not own:
            return found
        numbers = {name.removeprefix("residual."): value for name, value in own.items()}
        return type(self)(found.knowledge, self.residual.with_coefficients(numbers), self.about, self.trained)

    def save(self, path: Any) -> None:
        """Write the model to a file (see `model_file.save`)."""
        provided(type(self), "save")(self, path)
