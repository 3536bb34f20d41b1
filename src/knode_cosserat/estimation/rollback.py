"""Rollback of adapted parameters: earlier ones come back where they predict the last second better."""

from __future__ import annotations

import copy
from collections import deque
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from knode_cosserat.estimation.online import OnlineModel
from knode_cosserat.estimation.outputs import Output

#: seconds between comparisons, and number of earlier parameters that are kept
WINDOW, KEPT = 1.0, 4
#: earlier parameters come back if the mean square of their errors is less than this part of the present one
BETTER = 0.5
#: largest error that counts, in units of the noise: one wrong measurement decides nothing
LARGEST = 30.0


class _Comparison(NamedTuple):
    """Comparison of parameters by a past second: candidates (k, n), the newest last, and errors so far."""

    past: Any
    controls: Float[np.ndarray, "T c"]
    measured: Float[np.ndarray, "T p"]
    candidates: Float[np.ndarray, "k n"]
    errors: tuple[float, ...] = ()


class Rollback:
    """Compares the present parameters with earlier ones, by simulations of a past second.

    Without it, parameters that were adapted to wrong measurements have to be learned anew afterwards. The
    simulations of a comparison are spread over the periods that follow, so that none takes much longer.
    """

    _past: Any
    _controls: list[Any]
    _measured: list[Any]

    def __init__(self, model: OnlineModel, output: Output, x: Float[np.ndarray, " n"], dt: float):
        """Keep the first parameters."""
        self._model, self._output = model, output
        self._steps = max(2, round(WINDOW / dt))
        #: simulations in one period
        self._quota = -(-(KEPT + 1) // self._steps)
        self._kept = deque([np.array(x)] * KEPT, maxlen=KEPT)
        self._comparison: _Comparison | None = None
        self.forget()

    def copied(self) -> Rollback:
        """Return a copy that moves independently."""
        twin = copy.copy(self)
        twin._kept = self._kept.copy()
        twin._controls, twin._measured = list(self._controls), list(self._measured)
        return twin

    def compile(self, past: Any, controls: int) -> None:
        """Compile the comparison for a history and a number of controls."""
        shape = (self._steps, controls), (self._steps, self._output.size)
        self._error(_Comparison(past, np.zeros(shape[0]), np.zeros(shape[1]), np.array(self._kept)), 0)

    def predicted(self, control: Float[np.ndarray, " c"], past: Any) -> None:
        """Note a control, and the history before it."""
        if self._past is None:
            self._past = past
        self._controls.append(np.asarray(control))

    def measured(
        self, measured: Float[np.ndarray, " p"], x: Float[np.ndarray, " n"]
    ) -> Float[np.ndarray, " n"] | None:
        """Note a measurement; return earlier parameters once a comparison has shown that they were better."""
        if len(self._measured) < len(self._controls):
            unseen = len(self._controls) - 1 - len(self._measured)
            self._measured += [np.full(len(measured), np.nan)] * unseen
            self._measured.append(np.asarray(measured, dtype=float))
        earlier = self._compared()
        if len(self._controls) >= self._steps and len(self._measured) == len(self._controls):
            controls, rows = (np.array(it[: self._steps]) for it in (self._controls, self._measured))
            self._comparison = _Comparison(self._past, controls, rows, np.array([*self._kept, x]))
            self.forget()
        return earlier

    def forget(self) -> None:
        """Begin a new window."""
        self._past, self._controls, self._measured = None, [], []

    def _compared(self) -> Float[np.ndarray, " n"] | None:
        """Simulate some candidates of the comparison; return the best earlier one after the last of them."""
        comparison = self._comparison
        if comparison is None:
            return None
        first, candidates = len(comparison.errors), comparison.candidates
        last = min(first + self._quota, len(candidates))
        errors = (*comparison.errors, *(self._error(comparison, k) for k in range(first, last)))
        self._comparison = comparison._replace(errors=errors)
        if last < len(candidates):
            return None
        self._comparison = None
        best = int(np.argmin(errors[:-1]))
        better = errors[best] < BETTER * errors[-1]
        self._kept.append(candidates[best if better else -1])
        return candidates[best] if better else None

    def _error(self, comparison: _Comparison, k: int) -> float:
        """Return the mean squared error of a candidate, in units of the noise and at least 1."""
        past, controls, measured, candidates, _ = comparison
        errors = self._model.errors(candidates[k], past, controls, measured, self._output)
        square = np.minimum((errors / self._output.noise) ** 2, LARGEST**2)
        known = np.isfinite(square)
        return 1.0 + float(np.sum(square[known])) / max(int(known.sum()), 1)
