"""Rollback of adapted parameters: earlier ones come back where they predict the last second better."""

from __future__ import annotations

import copy
from collections import deque
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from knode_cosserat.estimation.online import OnlineModel
from knode_cosserat.estimation.outputs import Output

#: seconds between comparisons, and number of earlier parameters that are kept
WINDOW, KEPT = 1.0, 4
#: most steps that are simulated in one period; each period adds one for each of the kept parameters
BUDGET = 10
#: earlier parameters come back if the mean square of their errors is less than this part of the present one
BETTER = 0.5
#: largest error that counts, in units of the noise: one wrong measurement decides nothing
LARGEST = 30.0


class _Candidate(NamedTuple):
    """Parameters, and their motion so far: rows and the last history."""

    x: Float[np.ndarray, " n"]
    state: Any
    rows: tuple[np.ndarray, ...] = ()
    failed: bool = False

    @property
    def steps(self) -> float:
        """Number of simulated steps; a motion that failed has no more."""
        return np.inf if self.failed else sum(map(len, self.rows))


class _Window(NamedTuple):
    """Controls and measurements of a second, the history before it, and the parameters that are compared."""

    past: Any = None
    controls: tuple[np.ndarray, ...] = ()
    measured: tuple[np.ndarray, ...] = ()
    candidates: tuple[_Candidate, ...] = ()

    def begun(self, kept: Iterable[np.ndarray]) -> _Window:
        """Return the window with candidates, of kept parameters if it has none."""
        made = self.candidates or tuple(_Candidate(x, self.past) for x in kept)
        return self._replace(candidates=made)

    def continued(self, model: OnlineModel) -> _Window:
        """Return the window after some more steps of the candidate that is furthest behind."""
        k = int(np.argmin([it.steps for it in self.candidates]))
        old = self.candidates[k]
        if old.steps >= len(self.controls):
            return self
        part = np.array(self.controls[int(old.steps) :][:BUDGET])
        solved = model.simulated(old.x, old.state, part)
        new = old._replace(failed=True)
        if solved is not None:
            new = old._replace(state=solved[0], rows=(*old.rows, solved[1].records))
        return self._replace(candidates=(*self.candidates[:k], new, *self.candidates[k + 1 :]))


class Rollback:
    """Compares the present parameters with earlier ones, by simulations of a past second.

    Without it, parameters that were adapted to wrong measurements have to be learned anew afterwards. The
    simulations of a comparison are spread over the periods, so that none takes much longer.
    """

    def __init__(self, model: OnlineModel, output: Output, x: Float[np.ndarray, " n"], dt: float):
        """Keep the first parameters."""
        self._model, self._output = model, output
        self._steps = max(2, round(WINDOW / dt))
        self._kept = deque([np.array(x)] * KEPT, maxlen=KEPT)
        #: a complete window whose comparison is not complete, and the window of the present time
        self._compared: _Window | None = None
        self._window = _Window()

    def copied(self) -> Rollback:
        """Return a copy that moves independently."""
        twin = copy.copy(self)
        twin._kept = self._kept.copy()
        return twin

    def compile(self, record: Float[np.ndarray, "N x"]) -> None:
        """Compile the comparison by rows of any record."""
        rows, unseen = [record] * self._steps, np.full((self._steps, self._output.size), np.nan)
        self._error(_Candidate(self._kept[0], None, (np.array(rows),)), unseen)

    def predicted(self, control: Float[np.ndarray, " c"], past: Any) -> None:
        """Note a control, and the history before it."""
        window = self._window
        past = window.past if window.controls else past
        self._window = window._replace(past=past, controls=(*window.controls, np.asarray(control)))

    def measured(
        self, measured: Float[np.ndarray, " p"], x: Float[np.ndarray, " n"]
    ) -> Float[np.ndarray, " n"] | None:
        """Note a measurement; return earlier parameters once a comparison has shown that they were better."""
        window = self._window
        if len(window.measured) < len(window.controls):
            unseen = [np.full(len(measured), np.nan)] * (len(window.controls) - 1 - len(window.measured))
            window = window._replace(measured=(*window.measured, *unseen, np.asarray(measured, dtype=float)))
        earlier = None
        if self._compared is not None:
            self._compared = self._compared.continued(self._model)
            if min(it.steps for it in self._compared.candidates) >= len(self._compared.controls):
                earlier, self._compared = self._better(self._compared), None
        elif window.controls:
            window = window.begun(self._kept).continued(self._model)
        if len(window.measured) == len(window.controls) >= self._steps:
            window = window.begun(self._kept)
            self._compared = window._replace(candidates=(*window.candidates, _Candidate(x, window.past)))
            window = _Window()
        self._window = window
        return earlier

    def forget(self) -> None:
        """Begin a new window."""
        self._window = _Window()

    def _better(self, window: _Window) -> Float[np.ndarray, " n"] | None:
        """Return the best earlier parameters if the last candidate's motion is much worse, and keep them."""
        errors = [self._error(it, np.array(window.measured)) for it in window.candidates]
        best = int(np.argmin(errors[:-1]))
        better = errors[best] < BETTER * errors[-1]
        x = window.candidates[best if better else -1].x
        self._kept.append(x)
        return x if better else None

    def _error(self, candidate: _Candidate, measured: Float[np.ndarray, "T p"]) -> float:
        """Return the mean squared error of a candidate, in units of the noise and at least 1."""
        if candidate.failed:
            return np.inf
        rows = np.concatenate(candidate.rows)[: self._steps]
        errors = self._model.errors(candidate.x, rows, measured[: self._steps], self._output)
        square = np.minimum((errors / self._output.noise) ** 2, LARGEST**2)
        known = np.isfinite(square)
        return 1.0 + float(np.sum(square[known])) / max(int(known.sum()), 1)
