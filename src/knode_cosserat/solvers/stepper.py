"""Step-by-step simulation of one robot, for controllers that choose each control from the previous state."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import numpy as np

from knode_cosserat._reprs import robot_text
from knode_cosserat.rods.system import System
from knode_cosserat.solvers.boundary import NewtonOptions
from knode_cosserat.solvers.history import InitialHistory
from knode_cosserat.solvers.initial import SimulationRun, initial_state
from knode_cosserat.solvers.recovery import Budget
from knode_cosserat.solvers.result import Result, SimulationError
from knode_cosserat.solvers.run import LEAST_CAPACITY, is_coarse, rescue
from knode_cosserat.solvers.run_types import RunSettings
from knode_cosserat.solvers.settings import Settings
from knode_cosserat.solvers.simulate import check_initial, checked_dt, marked
from knode_cosserat.solvers.space import SpaceScheme
from knode_cosserat.solvers.time import Static, TimeScheme
from knode_cosserat.solvers.time_loop import loop_one
from knode_cosserat.trajectory import Trajectory


class _Solved(NamedTuple):
    """A solved step: the history of the next step, and the data of its row."""

    past: Any
    record: np.ndarray
    result: int
    residual: float
    corrections: int
    position_error: float


class _StoppableBudget(Budget):
    """Time for recovery that is zero from when `stop` returns True."""

    def __init__(self, seconds: float | None, stop: Callable[[], bool] | None):
        super().__init__(seconds)
        self._stop = stop

    @property
    def seconds(self) -> float:
        return 0.0 if self._stop is not None and self._stop() else super().seconds


class Stepper:
    """A robot that moves one step at a time, by the program of `simulate` and with its recovery.

    Calls of `step` return the rows of one `simulate`, to the tolerance of Newton's method. A call takes the
    time of the step and a fraction of a millisecond in addition. Programs are shared with `simulate`.

        stepper = kc.solvers.Stepper(robot, dt=0.05)
        while True:
            row = stepper.step(tensions())
            row.tip_position[0], row.time[0]
    """

    def __init__(
        self,
        robot: System,
        dt: float,
        *,
        time: str | TimeScheme = "bdf2",
        space: str | SpaceScheme = "lobatto2",
        start: Literal["paper", "consistent"] = "paper",
        initial: Trajectory | None = None,
        newton: NewtonOptions = NewtonOptions(),
        recovery_budget: float | None = None,
    ):
        """Start at rest, or at the last row of `initial`. The arguments are the same as in `simulate`.

        Raises:
            SimulationError: the initial equilibrium was not found.
            ValueError: arguments of a wrong shape or name.
        """
        given: Any = robot
        if not isinstance(given, System) or np.ndim(given.length):
            raise ValueError(f"robot is {type(robot).__name__}; a stepper is of one robot, not of a batch")
        settings = Settings.of(time, space, start, newton)
        if isinstance(settings.time, Static):
            raise ValueError("time is Static; a stepper moves: see `equilibrium` for shapes at rest")
        self.robot, self.dt = robot, checked_dt(dt)
        if initial is not None:
            check_initial(robot, initial, None)
        count = robot.control_size
        begins = initial_state(
            SimulationRun(robot, np.zeros((1, count)), initial, settings, self.dt, None, False)
        )
        begun, t0 = begins.start, begins.t0
        self._task = RunSettings(settings, self.dt, 1, begins.first, recovery_budget)
        self._settings = settings
        self._past, self._t0, self._index, self._steps = begun.past, float(t0), 0, 0
        self._coarse = bool(begun.coarse)
        self._control = np.asarray(begun.control, dtype=float)
        # same capacity as in a run of up to 128 steps, so that they share a program
        self._controls = np.zeros((LEAST_CAPACITY, count))
        first = _Solved(begun.past, np.asarray(begins.record), 0, 0.0, 0, 0.0)
        self._state = self._row(first, self._control, self.time, begins.begun)

    def __repr__(self) -> str:
        return f"Stepper of a {robot_text(self.robot)}: t = {self.time:g} s, dt = {self.dt:g} s"

    @property
    def time(self) -> float:
        """Time of the current state (s)."""
        return self._t0 + self._steps * self.dt

    @property
    def state(self) -> Trajectory:
        """Current state, a trajectory of one row."""
        return self._state

    def step(self, control: Any, stop: Callable[[], bool] | None = None) -> Trajectory:
        """Advance by one time step under a control (c,) and return the new state, a trajectory of one row.

        Args:
            control: the control (c,) during the step.
            stop: called between the attempts of a recovery; if it returns True, the recovery ends and the
                step counts as not solved.

        Raises:
            SimulationError: the step was not solved. The state is then unchanged, and another control may be
                tried.
            ValueError: a control of a wrong shape, or one that is not finite.
        """
        control = self._checked(control)
        solved = self._solve(control, stop)
        self._past, self._control = solved.past, control
        self._coarse = solved.result == Result.COARSE
        self._steps, self._index = self._steps + 1, self._index + 1
        if self._index == LEAST_CAPACITY:
            # restart the count at row 1, not at row 0, because the coefficients of row 0 may differ
            self._index = 1
            self._past = self._past._replace(t0=np.asarray(self.time - self.dt))
        self._state = self._row(solved, control, self.time, self._begun_after(solved))
        return self._state

    def preview(self, control: Any, stop: Callable[[], bool] | None = None) -> Trajectory:
        """Return the row that `step` would return, without changing the state. Raises the same errors."""
        control = self._checked(control)
        solved = self._solve(control, stop)
        return self._row(solved, control, self.time + self.dt, self._begun_after(solved))

    def _checked(self, control: Any) -> np.ndarray:
        fields = self.robot.control_layout.fields
        names = ", ".join(f"{field.name} ({field.size}, {field.unit})" for field in fields)
        try:
            control = np.array(control, dtype=float)
        except (TypeError, ValueError) as error:
            raise ValueError(f"the control is not numbers ({error}); there are {names}") from None
        if control.shape != (self.robot.control_size,):
            raise ValueError(
                f"the control has shape {control.shape}; allowed is ({self.robot.control_size},): {names}"
            )
        if not np.all(np.isfinite(control)):
            raise ValueError(f"the control is {control.tolist()}; it must be finite")
        beyond = self.robot.control_layout.beyond(control)
        if beyond:
            raise ValueError(f"the control: {beyond}")
        return control

    def _solve(self, control: np.ndarray, stop: Callable[[], bool] | None) -> _Solved:
        i = self._index
        controls = self._controls.copy()  # the compiled loop may still read the previous array
        controls[i] = control
        done, past, rows = loop_one(
            self.robot, self._settings, self._task.table, controls, self.dt, self._past, i, i + 1
        )
        cause = ""
        if int(done) > i:
            record, error = np.asarray(rows.records)[i], float(rows.error[i])
            found = _Solved(past, record, 0, error, int(rows.corrections[i]), float(rows.position_error[i]))
        else:
            budget = _StoppableBudget(self._task.recovery_budget, stop)
            outcome = rescue(self._task, self.robot, self._past, (self._control, control), i, budget)
            found = _Solved(
                outcome.past, outcome.record, int(outcome.result), outcome.error, outcome.corrections,
                outcome.position_error,
            )  # fmt: skip
            cause = outcome.cause
        result = Result(found.result)
        if not result.solved:
            number = self._steps + 1
            raise SimulationError(number, self.time + self.dt, found.residual, result, cause)
        # same rule as `mark_coarse`
        coarse = self._coarse or is_coarse(np.asarray(found.position_error), self.robot)
        return found._replace(result=int(Result.COARSE)) if coarse else found

    def _begun_after(self, solved: _Solved) -> InitialHistory:
        """Return the initial history of a motion that continues from a step."""
        past = solved.past
        return InitialHistory(*map(np.asarray, (past.records, past.rate, self._task.table[1], self.dt)))

    def _row(
        self, solved: _Solved, control: np.ndarray, time: float, begun: InitialHistory | None
    ) -> Trajectory:
        ny, nz = self.robot.y_layout.size, self.robot.z_layout.size
        record = solved.record[None, :, : ny + nz]
        row = Trajectory(
            system=self.robot,
            settings=self._settings,
            time=np.array([time]),
            y=record[..., :ny],
            z=record[..., ny:],
            control=control[None],
            result=np.array([solved.result]),
            residual=np.array([solved.residual]),
            iterations=np.array([solved.corrections]),
            position_error=np.array([solved.position_error]),
            begun=begun,
        )
        return marked(row, None)
