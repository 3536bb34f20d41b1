"""An identified robot with a residual, as a function of the coordinates of both."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from knode_cosserat.identification.model import Model
from knode_cosserat.learning.knode import KNODE
from knode_cosserat.learning.passive import POSITIVE, Passive
from knode_cosserat.rods.system import System

#: standard deviation of a number's prior, by the part of the residual
WIDTHS = {"stiffness": 0.2, "levers": 0.3, "energy": 0.2, "damping": 1.0, "dissipation": 1.0}


class FixedModel:
    """A robot of which nothing is identified, as `Model` has one."""

    size = 0
    bounds = np.zeros(0), np.zeros(0)

    def __init__(self, nominal: System):
        self.nominal = nominal

    def mask(self, names: Iterable[str]) -> Bool[np.ndarray, " 0"]:
        """Return which coordinates belong to these effects: there are none."""
        return np.zeros(0, dtype=bool)

    def reduced(self, x: Any, names: Sequence[str]) -> Any:
        """Return the robot."""
        return self.nominal


class _WithResidual(eqx.Module):
    """The robot with its residual as a function of coordinates; one program for each `ResidualModel`."""

    model: ResidualModel = eqx.field(static=True)

    def __call__(self, x: Any) -> KNODE:
        model = self.model
        robot = model.model.reduced(jnp.asarray(model.identified(x)), model.names)
        return KNODE(robot, model.residual.with_numbers(model.widths * x[model.known :]))


class ResidualModel:
    """Coordinates of the identified parameters, as in `Model`, followed by those of the residual.

    It has the members of `Model` that a search uses.

    Attributes:
        nominal: the robot that defines length and controls.
        residual: the residual with all learned parameters zero.
        robot: the robot with its residual, a function of coordinates.
        widths: standard deviations of the priors of the residual's numbers.
    """

    def __init__(
        self,
        model: Model | FixedModel,
        names: Sequence[str],
        residual: Passive,
        widths: Mapping[str, float] = WIDTHS,
    ):
        self.model, self.names, self.residual = model, tuple(names), residual
        self.nominal = model.nominal
        self.robot = _WithResidual(self)
        self._own = np.flatnonzero(model.mask(names))
        self.widths = np.concatenate(
            [np.full(count, widths[part]) for part, count in residual.counts.items()]
        )

    def __hash__(self) -> int:
        return id(self)

    @property
    def known(self) -> int:
        """Number of the identified numbers' coordinates."""
        return len(self._own)

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return self.known + self.residual.size

    def slice(self, part: str) -> slice:
        """Return the coordinates of a part of the residual."""
        found = self.residual.slices[part]
        return slice(self.known + found.start, self.known + found.stop)

    def mask(self, parts: Iterable[str]) -> Bool[np.ndarray, " n"]:
        """Return which coordinates are the identified numbers' or belong to these parts."""
        found = np.arange(self.size) < self.known
        for part in parts:
            found[self.slice(part)] = True
        return found

    @property
    def bounds(self) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Lowest and highest coordinates."""
        low, high = np.full(self.size, -np.inf), np.full(self.size, np.inf)
        low[: self.known], high[: self.known] = (each[self._own] for each in self.model.bounds)
        for part in POSITIVE:
            low[self.slice(part)] = 0.0
        return low, high

    @property
    def prior(self) -> Float[np.ndarray, " n"]:
        """Precision of each coordinate's prior."""
        return np.ones(self.size)

    @property
    def begin(self) -> Float[np.ndarray, " n"]:
        """Coordinates where a search from far begins: of the nominal robot without a residual."""
        return self.begun(np.zeros(self.model.size))

    def begun(self, x: Float[np.ndarray, " m"]) -> Float[np.ndarray, " n"]:
        """Return the coordinates of an identified robot without a residual, from those of all effects."""
        return np.concatenate([np.asarray(x)[self._own], np.zeros(self.residual.size)])

    def identified(self, x: Any) -> Any:
        """Return the coordinates of all effects."""
        return jnp.zeros(self.model.size).at[self._own].set(x[: self.known])
