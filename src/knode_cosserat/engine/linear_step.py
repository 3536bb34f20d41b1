"""A linearised time step from an equilibrium, by the machine code that solved the equilibrium."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

from knode_cosserat.engine.core import Core


class LinearStep:
    """The step y_t = c0 (y - y_before) from an equilibrium: changes of its record by those of the one before.

    Attributes:
        still: the equilibrium at all places.
        scale_y: natural units of y at the base.
        scale_tip: natural units of the tip's conditions.
    """

    def __init__(self, core: Core, parameters: np.ndarray, control: Any, y: Any):
        """Take the core of a robot's equilibria, and an equilibrium y at all points, or at the nodes."""
        self._core, self._control = core, np.array(control, dtype=float)
        self._memory, width = core._empty_memory(), core._width(core.move)
        self._evaluate = core.evaluator(parameters, self._memory)
        counts = core.counts
        self._none = np.zeros((counts.grid.count, width))
        self.still = self._evaluate(0.0, 0.0, control, self._none, y)
        inverse, tip = (
            core._numbers(self._memory[None], each)[0, 0] for each in (core.scale_y, core.scale_tip)
        )
        bases = [counts[f"base {q}"] for q in range(core.strands)]
        self.scale_y, self.scale_tip = 1.0 / core.equations.join(inverse[bases]), 1.0 / tip[0]
        #: where the numbers of a record are in the memory of a change
        [packed] = core._pack([core.move])
        self._size = core._size_of(packed)
        places = np.arange(self._size).reshape(packed.size, packed.component).T
        used = counts.grid.ends + len(core.space.formula.stages) * counts.grid.tip
        self._at = core._join(core.move, places, used).reshape(-1)

    @property
    def unit(self) -> Float[np.ndarray, " n"]:
        """Unit of each number of a change: those of y are natural."""
        width = self._none.shape[1]
        one = np.concatenate([self.scale_y, np.ones(width - len(self.scale_y))])
        return np.tile(one, len(self._at) // width)

    def error_at(self, t: float) -> float:
        """Return the largest residual of the equilibrium at another time (s), in natural units."""
        later = self._evaluate(0.0, t, self._control, self._none, self.still.y)
        return float(np.max(np.abs(later.tip) / self.scale_tip, initial=float(later.error)))

    def linearise(self, c0: float) -> None:
        """Linearise the step at a coefficient c0 (1/s)."""
        self._c0 = c0
        self._evaluate(c0, 0.0, self._control, -c0 * self.still.records, self.still.y)
        table = np.zeros(self._core.settings.memory + 3)
        table[0] = c0
        self._core._functions.run("linearise_step", self._memory, table, self._control)

    def __call__(self, changes: Float[np.ndarray, "n m"]) -> Float[np.ndarray, "n m"]:
        """Return the changes of the record (used x, m) by those of the record before, side by side."""
        columns = np.zeros((changes.shape[1], self._size))
        columns[:, self._at] = -self._c0 * changes.T
        self._core._functions.run("map_changes", self._memory, columns, len(columns), self._size)
        return columns[:, self._at].T
