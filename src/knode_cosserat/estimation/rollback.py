"""Rollback of adapted parameters: earlier ones come back where they predict the last second better."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
from jaxtyping import Float

from knode_cosserat.estimation.online import OnlineModel, motion_errors
from knode_cosserat.estimation.outputs import Output

#: seconds between comparisons, and number of earlier parameters that are kept
WINDOW, KEPT = 1.0, 4
#: earlier parameters come back if the mean square of their errors is less than this part of the present one
BETTER = 0.5
#: largest error that counts, in units of the noise: one wrong measurement decides nothing
LARGEST = 30.0


class Rollback:
    """Compares the present parameters with earlier ones, by simulations of the last second.

    Without it, parameters that were adapted to wrong measurements have to be learned anew afterwards.
    """

    def __init__(self, model: OnlineModel, output: Output, x: Float[np.ndarray, " n"], dt: float):
        """Keep the first parameters; compile the comparison."""
        self._model, self._output = model, output
        self._steps = max(2, round(WINDOW / dt))
        self._kept = deque([np.array(x)] * KEPT, maxlen=KEPT)
        self._past: Any = None
        self._controls: list[Any] = []
        self._measured: list[Any] = []

    def copied(self) -> Rollback:
        """Return a copy that moves independently."""
        found = Rollback.__new__(Rollback)
        found.__dict__.update(self.__dict__)
        found._kept = deque(self._kept, maxlen=KEPT)
        found._controls, found._measured = list(self._controls), list(self._measured)
        return found

    def compile(self, past: Any, controls: int) -> None:
        """Compile the comparison for a history and a number of controls."""
        shape = (self._steps, controls), (self._steps, self._output.size)
        self._errors(past, np.zeros(shape[0]), np.zeros(shape[1]), np.array([*self._kept, self._kept[0]]))

    def predicted(self, control: Float[np.ndarray, " c"], past: Any) -> None:
        """Note a control, and the history before it."""
        if self._past is None:
            self._past = past
        self._controls.append(np.asarray(control))

    def measured(
        self, measured: Float[np.ndarray, " p"], x: Float[np.ndarray, " n"]
    ) -> Float[np.ndarray, " n"] | None:
        """Note a measurement; return earlier parameters if those were better, once in each window."""
        if len(self._measured) == len(self._controls):
            return None
        unseen = len(self._controls) - 1 - len(self._measured)
        self._measured += [np.full(len(measured), np.nan)] * unseen + [np.asarray(measured, dtype=float)]
        if len(self._controls) < self._steps:
            return None
        candidates = np.array([*self._kept, x])
        controls, rows = np.array(self._controls[-self._steps :]), np.array(self._measured[-self._steps :])
        errors = self._errors(self._past, controls, rows, candidates)
        self.forget()
        best = int(np.argmin(errors[:-1]))
        if errors[best] < BETTER * errors[-1]:
            self._kept.append(candidates[best])
            return candidates[best]
        self._kept.append(np.array(x))
        return None

    def forget(self) -> None:
        """Begin a new window."""
        self._past, self._controls, self._measured = None, [], []

    def _errors(self, past: Any, controls: Any, measured: Any, candidates: Any) -> Float[np.ndarray, " k"]:
        """Return the mean squared error of each candidate, in units of the noise and at least 1."""
        found = motion_errors(self._model, candidates, past, controls, measured, self._output)
        square = np.minimum((np.asarray(found) / self._output.noise) ** 2, LARGEST**2)
        known = np.isfinite(square)
        return 1.0 + np.sum(np.where(known, square, 0.0), axis=(1, 2)) / np.maximum(known.sum(axis=(1, 2)), 1)
