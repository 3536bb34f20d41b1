"""Moving-horizon estimation: the last measurements together, by Gauss-Newton steps (Rao & Rawlings 2003)."""

from __future__ import annotations

import copy
from collections import deque
from typing import Any, Literal, Self

import numpy as np
from jaxtyping import Float

from knode_cosserat.estimation.observer import KalmanObserver, ObserverError, correction, surprise
from knode_cosserat.estimation.online import Belief, Predicted
from knode_cosserat.estimation.outputs import Output
from knode_cosserat.rods.system import System
from knode_cosserat.trajectory import Trajectory


class MovingHorizonObserver(KalmanObserver):
    """Estimates the state from all measurements of a window, whose beginning is estimated by a Kalman filter.

    In each period the motion of the window is simulated and linearised again, so that a wrong start or
    wrong parameters are corrected as the nonlinear equations require. The prior of its first state is that
    of the filter there (the arrival cost). Until the window is full, it is a `KalmanObserver`.
    """

    def __init__(
        self,
        robot: System,
        dt: float,
        output: Output,
        *,
        window: int = 5,
        corrections: int = 1,
        **options: Any,
    ):
        """Start at rest, or at the last row of a trajectory.

        Args:
            robot: the model.
            dt: time step of measurements and controls (s).
            output: the measured output, with its noise.
            window: number of periods.
            corrections: nonlinear Gauss-Newton steps in each period; one more is made in the linearised
                equations of the last of them.
            options: those of `KalmanObserver`.

        Raises:
            ParameterError: a parameter that cannot be adapted.
            ValueError: arguments of a wrong shape or size.
        """
        if window < 2 or corrections < 1:
            raise ValueError(
                f"window is {window} and corrections {corrections}; allowed are at least 2 and 1"
            )
        self.window, self.corrections = window, corrections
        super().__init__(robot, dt, output, **options)
        # compile before the loop
        controls = np.tile(self.control, (window, 1))
        nothing = np.full((window, output.size), np.nan)
        self.model.predicted(self.belief, controls, nothing, self._deviations(), output)

    def restart(self, initial: Trajectory | Literal["equilibrium", "unstressed"] = "equilibrium") -> None:
        """Start again at rest, or at the last row of a trajectory, with the initial uncertainty."""
        self._controls: deque[Any] = deque()
        self._measured: deque[Any] = deque()
        self._arrival: KalmanObserver | None = None
        super().restart(initial)

    def __copy__(self) -> Self:
        twin = super().__copy__()
        twin._controls, twin._measured = deque(self._controls), deque(self._measured)
        twin._arrival = copy.copy(self._arrival)
        return twin

    def update(self, measured: Float[np.ndarray, " p"]) -> Float[np.ndarray, " m"]:
        """Correct the estimate by a measurement; return the coordinates of the correction in the columns."""
        coordinates = super().update(measured)
        if self._arrival is None:
            self._arrival = self._filter()
        elif len(self._measured) < len(self._controls):
            self._measured.append(np.asarray(measured, dtype=float))
        return coordinates

    def _filter(self) -> KalmanObserver:
        """Return a Kalman filter in the state of this observer; the filter has the rollback from then on."""
        arrival = KalmanObserver.__new__(KalmanObserver)
        arrival.__dict__.update(self.__dict__)
        arrival._bias = self._bias.copy()
        self._rollback = None
        return arrival

    def wait(self) -> None:
        """Let a period pass without a prediction: the state is held, and a new window begins."""
        super().wait()
        self._forget()

    def _forget(self) -> None:
        """Begin a new window."""
        if self._arrival is not None:
            self._rollback, self._arrival = self._arrival._rollback, None
        if self._rollback is not None:
            self._rollback.forget()
        self._controls.clear()
        self._measured.clear()

    def predict(self, control: Float[np.ndarray, " c"]) -> None:
        """Advance the estimate by one time step under a control, from the beginning of the window.

        Raises:
            ObserverError: the model's equations were not solved; the state is unchanged.
        """
        arrival = self._arrival
        if arrival is None:
            super().predict(control)
            return
        self._controls.append(np.asarray(control, dtype=float))
        nothing = np.full(self.output.size, np.nan)
        while len(self._measured) < len(self._controls) - 1:  # periods without a call of update
            self._measured.append(nothing)
        if len(self._controls) <= self.window:
            super().predict(control)
            return
        try:
            arrival.predict(self._controls.popleft())
            arrival.update(self._measured.popleft())
            self.rollbacks = arrival.rollbacks
            self._solve(arrival, np.array([*self._measured, nothing]))
        except ObserverError:
            self._forget()
            super().predict(control)
            return
        self.control = self._controls[-1]

    def _solve(self, arrival: KalmanObserver, measured: Float[np.ndarray, "T p"]) -> None:
        """Set the estimate to the end of the window's most likely motion."""
        controls, deviations = np.array(self._controls), self._deviations()
        bounds, size, end = self.parameters.bounds, self.columns, self.columns + controls.size
        total = np.zeros(end + len(deviations[1]))
        for last in [*[False] * self.corrections, True]:
            belief = arrival.belief.moved(total[:size], bounds, self.excitation)
            of_controls = total[size:end].reshape(controls.shape)
            belief = belief._replace(x=np.clip(belief.x + deviations[1] * total[end:], *bounds))
            motion = self.model.predicted(
                belief, controls + of_controls * deviations[0], measured, deviations, self.output
            )
            if motion is None:
                raise ObserverError(f"the motion until t = {self.time + self.dt:g} s was not solved")
            H, e = self._rows(motion)
            # the prior belongs to the whole way from the arrival
            step, remaining = correction(H, e - H @ total)
            move, total = step - total, step
            if last:
                after = Belief(belief.x, motion.past, motion.spread).moved(move, bounds, self.excitation)
                self._accept(motion._replace(past=after.past), after.x, remaining)

    def _rows(self, motion: Predicted) -> tuple[np.ndarray, np.ndarray]:
        """Return derivatives and errors of all measurements, divided by their noise and weighted."""
        by_column, noise = np.asarray(motion.by_column), self.output.noise
        rows, values = [np.zeros((0, len(by_column)))], [np.zeros(0)]
        for k, error in enumerate(np.asarray(motion.errors)):
            known = np.isfinite(error)
            if known.any():
                H, e = by_column[:, k, known].T / noise[known, None], error[known] / noise[known]
                weight = np.sqrt(surprise(H, e)[1])
                rows.append(weight * H)
                values.append(weight * e)
        return np.concatenate(rows), np.concatenate(values)
