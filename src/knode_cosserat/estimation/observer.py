"""Observers: the state of a moving robot from incomplete measurements, with its covariance."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, Self

import numpy as np
from jaxtyping import Float

from knode_cosserat.errors import KnodeCosseratError
from knode_cosserat.estimation import online
from knode_cosserat.estimation.outputs import Output
from knode_cosserat.estimation.parameters import Adapted, adapted_model
from knode_cosserat.estimation.rollback import Rollback
from knode_cosserat.rods.aspects import Drawing
from knode_cosserat.rods.system import System
from knode_cosserat.schemes.grid import grid_of
from knode_cosserat.schemes.history import used_places
from knode_cosserat.solvers.initial import start_of
from knode_cosserat.solvers.simulate import check_initial, checked_dt
from knode_cosserat.trajectory import Trajectory

#: a measurement farther from its prediction than this quantile of its distribution is weighted less
GATE = 0.9999
#: movement of the output that counts as such, in units of the noise
MOVING = 30.0
#: time over which movements and errors are judged (s), and an average that is not zero (standard deviations)
BIASED, SIGNIFICANT = 1.0, 4.0
#: periods of uncertain controls before the start
STARTING = 10
#: error of a position that linearised equations do not describe (m): along the rod a tip moves by a second-
#: order part of its deviation across it
NUMERICAL = 5e-6
#: standard deviations of tensions (N), and of other controls (in their units), unless given
TENSION_DEVIATION, OTHER_DEVIATION = 0.05, 0.01


class ObserverError(KnodeCosseratError, RuntimeError):
    """An observer cannot go on; one line says why."""

    code = "observer"


class StateEstimate(NamedTuple):
    """State of a robot at one time, by an observer.

    `y` (N, y) and `z` (N, z) are at the nodes; `innovation` is the last measurement's error from its
    prediction, and `surprise` its square in standard deviations, divided by its number of numbers.
    """

    time: float
    y: Float[np.ndarray, "N y"]
    z: Float[np.ndarray, "N z"]
    parameters: dict[str, float]
    deviations: dict[str, float]
    innovation: Float[np.ndarray, " e"]
    surprise: float


class KalmanObserver:
    """Extended Kalman filter of a rod, with a covariance of low rank (Verlaan & Heemink 1997).

    The covariance's square root has few columns: tangents of the solver's history, and coordinates of the
    adapted parameters. They move with the linearised equations of each step, and new ones enter by uncertain
    controls and by the drift of parameters. The most important ones are kept.

        observer = kc.estimation.KalmanObserver(robot, 0.05, TipPosition(), adapt=["youngs_modulus"])
        observer.predict(tensions)
        observer.update(measured)
        observer.estimate
    """

    def __init__(
        self,
        robot: System,
        dt: float,
        output: Output,
        *,
        adapt: Sequence[Adapted | str] = (),
        initial: Trajectory | Literal["equilibrium", "unstressed"] = "equilibrium",
        columns: int = 14,
        control_deviation: float | Sequence[float] | None = None,
        start_deviation: float = 0.0,
    ):
        """Start at rest under zero control, or at the last row of a trajectory.

        Args:
            robot: the model.
            dt: time step of measurements and controls (s).
            output: the measured output, with its noise.
            adapt: parameters that are estimated with the state.
            initial: where it starts, as in `simulate`.
            columns: rank of the covariance.
            control_deviation: standard deviation of each control; by default 0.05 N for tensions, and 0.01 in
                its own unit for any other control.
            start_deviation: standard deviation of the controls that acted before the start, in their unit: a
                wrong initial state is then corrected quickly.

        Raises:
            ParameterError: a parameter that cannot be adapted.
            ValueError: arguments of a wrong shape or size.
        """
        if columns < 1:
            raise ValueError(f"columns is {columns}; allowed is at least 1")
        self.dt, self.output = checked_dt(dt), output
        self.parameters, self._drift = adapted_model(robot, adapt)
        self.model = online.OnlineModel(self.parameters.robot, self.dt)
        self.columns = columns + self.parameters.size
        self._control_deviation = _deviations(robot, control_deviation)
        self._start_deviation = float(start_deviation)
        self._scale = np.asarray(robot.scales().y)
        self.restart(initial)

    @property
    def robot(self) -> System:
        """The model, with the parameters that it had at first."""
        return self.model.robot

    def restart(self, initial: Trajectory | Literal["equilibrium", "unstressed"] = "equilibrium") -> None:
        """Start again at rest, or at the last row of a trajectory, with the initial uncertainty."""
        #: number of times that earlier parameters came back
        self.rollbacks = 0
        robot, settings = self.robot, self.model.settings
        check_initial(robot, initial, None)
        at_start = start_of(robot, initial, settings, self.dt)
        past = at_start.state.history
        self.control = np.asarray(at_start.control, dtype=float)
        self.record = np.asarray(at_start.record)
        self._rollback: Rollback | None = None
        #: the last measurement, until `predict` has compared parameters by it
        self._last: np.ndarray | None = None
        used, n = used_places(robot, settings.space), self.parameters.size
        rows = np.zeros((self.columns, 2, used, past.records.shape[-1]))
        coordinates = np.eye(self.columns, n)
        self.belief = online.Belief(np.zeros(n), past, online.Spread(rows, rows[:, 0], coordinates))
        self._slopes = np.zeros((self.columns, len(self.output.noise)))
        self._innovation, self._surprise = np.full(len(self.output.noise), np.nan), 0.0
        #: the output that was predicted for this time; NaN at the start
        self.expected = np.full(self.output.size, np.nan)
        # the predicted outputs of the last second, in units of the noise
        self._values = np.zeros((0, len(self.output.noise)))
        # running mean of the measurement's errors, in standard deviations of their predictions
        self._bias = np.zeros(len(self.output.noise))
        if self._start_deviation:
            self._spread_start()
        if n:
            self._rollback = Rollback(self.model, self.output, self.belief.x, self.dt)
            self._rollback.compile(self.record)

    def _spread_start(self) -> None:
        """Set the columns to those of a robot at rest under controls that varied before the start."""
        past, record, control = self.belief.past, self.record, self._control_deviation
        self._control_deviation = np.full(len(control), self._start_deviation / np.sqrt(STARTING))
        for _ in range(STARTING):
            self.predict(self.control)
        self.record, self._control_deviation = record, control
        self.belief = self.belief._replace(past=past)

    @property
    def time(self) -> float:
        """Time of the state (s)."""
        return float(self.belief.past.t0)

    @property
    def system(self) -> System:
        """Robot with the adapted parameters."""
        return self.parameters.robot(self.belief.x) if self.parameters.size else self.robot

    @property
    def estimate(self) -> StateEstimate:
        """Current state, and the parameters with their standard deviations."""
        y, z = online.split_record(self.robot, self.record)
        numbers, labels = self.parameters.numbers, self.parameters.labels
        spread = np.sqrt(np.sum(np.asarray(self.belief.spread.parameters) ** 2, axis=0))
        values = [number.value(x) for number, x in zip(numbers, self.belief.x, strict=True)]
        deviations = [
            abs(number.slope(value)) * float(deviation)
            for number, value, deviation in zip(numbers, values, spread, strict=True)
        ]
        return StateEstimate(
            self.time,
            y,
            z,
            dict(zip(labels, values, strict=True)),
            dict(zip(labels, deviations, strict=True)),
            self._innovation,
            self._surprise,
        )

    def predict(self, control: Float[np.ndarray, " c"]) -> None:
        """Advance the estimate by one time step under a control.

        Raises:
            ObserverError: the model's equations were not solved; the state is unchanged.
        """
        control = np.asarray(control, dtype=float)
        if control.shape != (self.robot.control_layout.size,) or not np.all(np.isfinite(control)):
            raise ValueError(
                f"the control is {control.tolist()}; allowed are {self.robot.control_layout.size} finite "
                "numbers"
            )
        self._roll_back()
        nothing = np.full((1, self.output.size), np.nan)
        motion = self.model.predicted(self.belief, control[None], nothing, self._deviations(), self.output)
        if motion is None:
            raise ObserverError(f"the model's step at t = {self.time + self.dt:g} s was not solved")
        if self._rollback is not None:
            self._rollback.predicted(control, self.belief.past)
        self.control = control
        self._accept(motion, self.belief.x, np.eye(motion.by_column.shape[0]))

    def _deviations(self) -> tuple[Float[np.ndarray, " c"], Float[np.ndarray, " n"]]:
        """Return the standard deviations of controls, and of the parameters' drift in one step."""
        return self._control_deviation, self.excitation * self._drift * np.sqrt(self.dt)

    @property
    def excitation(self) -> float:
        """Part (0 to 1) by which parameters are adapted: none at rest, for a robot at rest says nothing new.

        All if the output moves by `MOVING` in a second, or if its errors are not zero on average; none if it
        moves by less than half of that.
        """
        ranges = np.ptp(self._values, axis=0) if len(self._values) else np.zeros(1)
        moved = np.clip(2.0 * np.max(ranges) / MOVING - 1.0, 0.0, 1.0)
        count = 2.0 * BIASED / self.dt
        return 1.0 if np.max(np.abs(self._bias)) * np.sqrt(count) > SIGNIFICANT else float(moved)

    def _accept(self, motion: online.Predicted, x: Float[np.ndarray, " n"], remaining: Any) -> None:
        """Set the state to the end of a motion; `remaining` (m, k) combines its columns to new ones."""
        spread = motion.spread.combined(remaining)
        # the combinations of columns that keep the most of the covariance
        records = np.asarray(spread.records)[..., : len(self._scale)] / self._scale
        flat = np.concatenate([records.reshape(len(records), -1), np.asarray(spread.parameters)], axis=1)
        matrix = np.linalg.eigh(flat @ flat.T)[1][:, ::-1][:, : self.columns]
        self.expected = np.asarray(motion.values[-1])
        value = self.expected[: len(self.output.noise)] / self.output.noise
        self._values = np.concatenate([self._values, value[None]])[-max(2, round(BIASED / self.dt)) :]
        self.record = np.asarray(motion.record)
        self.belief = online.Belief(x, motion.past, spread.combined(matrix))
        self._slopes = matrix.T @ (remaining.T @ np.asarray(motion.by_column)[:, -1])

    def covers(self, truth: Trajectory, level: float = 0.95) -> bool:
        """Return True if the true position of the tip lies in the estimate's confidence region.

        Args:
            truth: the true state, a trajectory of one row.
            level: probability of the region.
        """
        from scipy.stats import chi2

        nodes = grid_of(self.robot).nodes
        ny = len(self._scale)
        # the tip's position is linear in y
        positions = Drawing.of(self.robot).positions
        tips = np.array([positions(c[0][nodes[-1:], :ny])[0] for c in np.asarray(self.belief.spread.records)])
        apart = np.asarray(truth.tip_position[-1]) - np.asarray(positions(self.record[-1:, :ny]))[0]
        estimated = tips.T @ tips
        covariance = estimated + NUMERICAL**2 * np.eye(3)
        # the tip of an inextensible rod moves on a surface: only its uncertain directions count
        uncertain = np.trace(np.linalg.solve(covariance, estimated))
        return bool(apart @ np.linalg.solve(covariance, apart) <= chi2.ppf(level, uncertain))

    def wait(self) -> None:
        """Let a period pass without a prediction: the state is held."""
        if self._rollback is not None:
            self._rollback.forget()
        past = self.belief.past._replace(t0=np.asarray(self.time + self.dt))
        self.belief = self.belief._replace(past=past)

    def _correction(self, measured: Float[np.ndarray, " p"]) -> tuple[Any, Any]:
        """Return the correction's coordinates in the columns, and the remaining covariance's square root."""
        measured = np.asarray(measured, dtype=float)
        if measured.shape != (self.output.size,):
            raise ValueError(
                f"a measurement has shape {measured.shape}; allowed is ({self.output.size},): "
                f"{', '.join(self.output.labels)}"
            )
        moved = self.model.moved(self.belief.x)
        error = np.asarray(
            online.measured_error(moved.structure, self.output, moved.numbers, self.record, measured)
        )
        known = np.isfinite(error)
        self._innovation, count = -error, int(known.sum())
        self._surprise = 0.0
        if not count:
            return np.zeros(self.columns), np.eye(self.columns)
        H = self._slopes[:, known].T / self.output.noise[known, None]
        e = error[known] / self.output.noise[known]
        self._surprise, weight = surprise(H, e)
        expected = e / np.sqrt(1.0 + np.sum(H * H, axis=1))
        self._bias[known] += min(1.0, self.dt / BIASED) * (np.clip(expected, -3.0, 3.0) - self._bias[known])
        return correction(np.sqrt(weight) * H, np.sqrt(weight) * e)

    def update(self, measured: Float[np.ndarray, " p"]) -> Float[np.ndarray, " m"]:
        """Correct the estimate by a measurement; return the coordinates of the correction in the columns.

        NaN are numbers that were not measured.
        """
        coordinates, remaining = self._correction(measured)
        records = self.belief.spread.along(coordinates)[0]
        moved = self.belief.moved(coordinates, self.parameters.bounds, self.excitation)
        self.belief = moved._replace(spread=moved.spread.combined(remaining))
        self.record = self.record + records[0][grid_of(self.robot).nodes]
        self._slopes = remaining.T @ self._slopes
        self._last = np.asarray(measured, dtype=float)
        return coordinates

    def _roll_back(self) -> None:
        """Return to earlier parameters where those predict the last second better.

        It belongs to `predict`, because it takes longer than a controller may wait for a correction.
        """
        earlier, measured, self._last = None, self._last, None
        if self._rollback is not None and measured is not None:
            earlier = self._rollback.measured(measured, np.asarray(self.belief.x))
        if earlier is not None:
            self.belief = self.belief._replace(x=earlier)
            self.rollbacks += 1

    def __copy__(self) -> Self:
        twin = type(self).__new__(type(self))
        twin.__dict__.update(self.__dict__)
        twin._bias = self._bias.copy()
        if self._rollback is not None:
            twin._rollback = self._rollback.copied()
        return twin


def surprise(H: Float[np.ndarray, "e m"], error: Float[np.ndarray, " e"]) -> tuple[float, float]:
    """Return the mean squared error in standard deviations of its prediction, and its weight.

    Args:
        H: derivatives of the error by the columns; errors are divided by their noise.
        error: of a measurement. One that is too far away counts less.
    """
    count = len(error)
    size = float(error @ np.linalg.solve(np.eye(count) + H @ H.T, error)) / count
    return size, min(1.0, _largest_usual(count) / max(size, 1e-12))


def correction(H: Float[np.ndarray, "e m"], error: Float[np.ndarray, " e"]) -> tuple[Any, Any]:
    """Return the coordinates (m,) of least squares, and a square root (m, m) of the remaining covariance."""
    A = np.eye(H.shape[1]) + H.T @ H
    return -np.linalg.solve(A, H.T @ error), np.linalg.inv(np.linalg.cholesky(A)).T


@functools.lru_cache
def _largest_usual(count: int) -> float:
    """Return the `GATE` quantile of the mean square of so many standard normal numbers."""
    from scipy.stats import chi2

    return float(chi2.ppf(GATE, count) / count)


def _deviations(robot: System, stated: Any) -> Float[np.ndarray, " c"]:
    if stated is None:
        parts = [
            np.full(field.size, TENSION_DEVIATION if field.name == "tension" else OTHER_DEVIATION)
            for field in robot.control_layout.fields
        ]
        return np.concatenate(parts)
    deviations = np.broadcast_to(np.asarray(stated, dtype=float), (robot.control_layout.size,))
    if not np.all(deviations >= 0.0):
        raise ValueError(f"control_deviation is {stated}; allowed is zero or more for each control")
    return np.array(deviations)
