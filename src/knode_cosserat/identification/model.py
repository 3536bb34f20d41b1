"""A robot with unknown numbers, as a function of the coordinates of a search."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from knode_cosserat.identification.effects import Change, Effect, Number, Usual, effects_of
from knode_cosserat.rods.system import System
from knode_cosserat.rods.tendon_robots import RoutedTendonRobot, TendonRod

#: tendon offset of a robot that states none, over its radius
OFFSET = 5.0


class ParametrisedRobot(eqx.Module):
    """A robot with all effects as a function of coordinates: a pytree, so that programs serve any robot.

    Attributes:
        robot: the nominal robot with every part.
        nominal: nominal values (n,) of all numbers.
        width: widths (n,) of their priors.
        logarithmic: true for logarithmic numbers.
        changes: for each effect, its change of a robot, and the number of its parameters.
    """

    robot: System
    nominal: Float[Any, " n"]
    width: Float[Any, " n"]
    logarithmic: tuple[bool, ...] = eqx.field(static=True)
    changes: tuple[tuple[Change, int], ...] = eqx.field(static=True)

    def values(self, x: Float[Any, " n"]) -> Float[Any, " n"]:
        """Return the values of all numbers."""
        away, logarithmic = self.width * x, np.array(self.logarithmic, dtype=bool)
        factors = jnp.exp(jnp.where(logarithmic, away, 0.0))
        return self.nominal * factors + jnp.where(logarithmic, 0.0, away)

    def __call__(self, x: Float[Any, " n"]) -> Any:
        """Return the robot at coordinates."""
        values = self.values(x)
        robot, first = self.robot, 0
        for change, count in self.changes:
            robot = change(robot, [values[k] for k in range(first, first + count)])
            first += count
        return robot


class Model:
    """Unknown numbers of one robot, and the robot with them for any coordinates.

    Attributes:
        nominal: the robot without any change.
        effects: causes of the changes, in the order of the coordinates.
        numbers: their numbers.
        robot: the robot with all effects, a function of coordinates.
    """

    def __init__(self, nominal: System, effects: Iterable[Effect]):
        self.nominal, self.effects = nominal, tuple(effects)
        self.numbers: tuple[Number, ...] = tuple(it for effect in self.effects for it in effect.numbers)
        self.robot = ParametrisedRobot(
            self._with_parts(self.names),
            np.array([number.nominal for number in self.numbers]),
            np.array([number.width for number in self.numbers]),
            tuple(number.logarithmic for number in self.numbers),
            tuple((effect.apply, len(effect.numbers)) for effect in self.effects),
        )

    @classmethod
    def of_library(
        cls, nominal: TendonRod, tension: Float[np.ndarray, "T c"], bodies: Iterable[float] = (),
        more: Sequence[Effect] = (),
    ) -> Self:  # fmt: skip
        """Return the model with all library effects of a robot whose tendons run beside it.

        Args:
            nominal: the robot as its data sheet has it.
            tension: tensions in the recordings (N): widths of some priors depend on them.
            bodies: places of measured bodies, as parts of the length.
            more: further effects, such as plain parameters.
        """
        if not isinstance(nominal, RoutedTendonRobot):
            offset = float(nominal.tendon_offset) or OFFSET * float(nominal.radius)
            nominal = RoutedTendonRobot.like(nominal, tendon_offset=offset)
        usual = Usual(
            float(np.nanmean(tension)), float(np.nanmax(tension.sum(axis=1))),
            tuple(float(at) for at in bodies if at > 0.0),
        )  # fmt: skip
        return cls(nominal, [*effects_of(nominal, usual), *more])

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return len(self.numbers)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the effects."""
        return tuple(effect.name for effect in self.effects)

    @property
    def prior(self) -> Float[np.ndarray, " n"]:
        """Precision of each coordinate's prior: zero for a flat one."""
        return np.array([0.0 if number.flat else 1.0 for number in self.numbers])

    @property
    def begin(self) -> Float[np.ndarray, " n"]:
        """Coordinates where a search begins."""
        return np.array([number.begin for number in self.numbers])

    @property
    def bounds(self) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Lowest and highest coordinates."""
        both = np.array([number.bounds for number in self.numbers]).reshape(-1, 2)
        return both[:, 0], both[:, 1]

    def slice(self, name: str) -> slice:
        """Return the coordinates of an effect."""
        before = self.effects[: self.names.index(name)]
        first = sum(len(effect.numbers) for effect in before)
        return slice(first, first + len(self.effect(name).numbers))

    def effect(self, name: str) -> Effect:
        """Return the effect of that name."""
        return self.effects[self.names.index(name)]

    def mask(self, names: Iterable[str]) -> Bool[np.ndarray, " n"]:
        """Return which coordinates belong to these effects."""
        wanted = set(names)
        return np.array([it.name in wanted for it in self.effects for _ in it.numbers], dtype=bool)

    def values(self, x: Float[np.ndarray, " n"]) -> list[float]:
        """Return the numbers' values, within their bounds."""
        return [
            float(np.clip(number.value(np.asarray(at)), number.low, number.high))
            for number, at in zip(self.numbers, x, strict=True)
        ]

    def reduced(self, x: Any, names: Sequence[str]) -> Any:
        """Return the robot with the named effects only, and without the parts of all others.

        It moves as `robot` does with the other effects' coordinates at zero. Coordinates may be traced.
        """
        robot = self._with_parts(names)
        values = self.robot.values(x) if isinstance(x, jax.core.Tracer) else self.values(x)
        for effect in self.effects:
            if effect.name in names:
                robot = effect.apply(robot, list(values[self.slice(effect.name)]))
        return robot

    def _with_parts(self, names: Sequence[str]) -> Any:
        """Return the nominal robot with the parts that the named effects change; effects may share a part."""
        parts = [effect.part for effect in self.effects if effect.name in names and effect.part]
        robot: Any = self.nominal
        for part in dict.fromkeys(parts):
            robot = part(robot)
        return robot
