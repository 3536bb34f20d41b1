"""What is to be run, where it begins, and what came of it: the nouns of `run`."""

from __future__ import annotations

import dataclasses
from typing import Any, Literal, NamedTuple

import numpy as np

from knode_cosserat.solvers.past import Past, coefficient_table
from knode_cosserat.solvers.settings import Settings

FirstStep = Literal["start", "regular", "consistent", "still"]


class Steps(NamedTuple):
    """The steps of one robot (or, with a batch axis in front, of several), and what came of each."""

    records: Any
    unknowns: Any
    error: Any
    corrections: Any
    size: Any
    result: Any


class Start(NamedTuple):
    """Where a run begins: the past, and the control before the first step."""

    past: Past
    control: Any
    #: whether it was found as an equilibrium, be it on a finer grid than its nodes
    equilibrium: bool = False


@dataclasses.dataclass(frozen=True)
class Task:
    """What is the same for every robot of a run."""

    settings: Settings
    dt: float
    steps: int
    #: the first step: as the settings say, like any other (the past holds real states), or by BDF1; or every
    #: step without rates, an equilibrium (by the program of a simulation with these settings)
    first: FirstStep = "start"

    @property
    def table(self) -> np.ndarray:
        """Coefficients of the first step and of every other."""
        if self.first == "still":
            return np.zeros((2, 4))
        if self.first == "consistent":
            return coefficient_table(dataclasses.replace(self.settings, start="consistent"), self.dt)
        table = coefficient_table(self.settings, self.dt)
        return table[[1, 1]] if self.first == "regular" else table
