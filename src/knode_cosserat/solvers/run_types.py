"""Types of a run: the task, its initial history, and its steps."""

from __future__ import annotations

import dataclasses
from typing import Any, Literal, NamedTuple

import numpy as np

from knode_cosserat.solvers.history import StateHistory, coefficient_table
from knode_cosserat.solvers.settings import Settings
from knode_cosserat.solvers.time import Static

FirstStep = Literal["start", "regular", "consistent", "still"]


class StepResults(NamedTuple):
    """The steps of one robot (or, with a batch axis in front, of several), with their result codes."""

    records: Any
    unknowns: Any
    error: Any
    corrections: Any
    position_error: Any
    result: Any


class InitialCondition(NamedTuple):
    """Initial history of a run, and the control before the first step."""

    past: StateHistory
    control: Any
    #: true if the grid was too coarse for the state before the first step
    coarse: Any = False


@dataclasses.dataclass(frozen=True)
class RunSettings:
    """Settings and sizes shared by every robot of a run."""

    settings: Settings
    dt: float
    steps: int
    #: kind of the first step: "start" by the settings, "regular" like any other (the history holds real
    #: states), "consistent" by BDF1; "still": every step is an equilibrium, with the same compiled program
    first: FirstStep = "start"
    #: seconds that recovery may take; None: 20 times the run's own time or 5 s, whichever is more
    recovery_budget: float | None = None

    @property
    def still(self) -> bool:
        """True if every step is an independent equilibrium."""
        return self.first == "still" or isinstance(self.settings.time, Static)

    @property
    def table(self) -> np.ndarray:
        """Coefficients (2, 4) of the first step and of all later steps."""
        if self.first == "still":
            return np.zeros((2, 4))
        if self.first == "consistent":
            return coefficient_table(dataclasses.replace(self.settings, start="consistent"), self.dt)
        table = coefficient_table(self.settings, self.dt)
        return table[[1, 1]] if self.first == "regular" else table
