"""Step-by-step simulation of one robot, for controllers that choose each control from the previous state."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import jax
import numpy as np

from knode_cosserat._numbers import real_array
from knode_cosserat._reprs import robot_text
from knode_cosserat.rods.system import System
from knode_cosserat.solvers.history import SolverState, StateHistory, StepRows, at_stages
from knode_cosserat.solvers.initial import continued_state, initial_state
from knode_cosserat.solvers.recovery import Budget
from knode_cosserat.solvers.result import Result, SimulationError
from knode_cosserat.solvers.run import TimeIntegration, carried_results, rows_of
from knode_cosserat.solvers.settings import NewtonOptions, Settings
from knode_cosserat.solvers.simulate import check_initial, checked_dt, marked, split_initial
from knode_cosserat.solvers.space import SpaceScheme
from knode_cosserat.solvers.time import TimeScheme
from knode_cosserat.trajectory import Trajectory


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
        time: str | TimeScheme = "sdirk2",
        space: str | SpaceScheme = "lobatto2",
        start: Literal["paper", "consistent"] = "consistent",
        initial: Trajectory | Literal["equilibrium"] | None = None,
        newton: NewtonOptions = NewtonOptions(),
        recovery_budget: float | None = None,
    ):
        """Start unstressed, in equilibrium, or at the last row of `initial`: arguments as in `simulate`.

        Raises:
            SimulationError: the initial equilibrium was not found.
            ValueError: arguments of a wrong shape or name.
        """
        given: Any = robot
        if not isinstance(given, System) or np.ndim(given.length):
            raise ValueError(f"robot is {type(robot).__name__}; a stepper is of one robot, not of a batch")
        if time in (None, "static"):
            raise ValueError(f"time is {time!r}; a stepper moves: see `equilibrium` for shapes at rest")
        settings = Settings.of(time, space, start, newton)
        self.robot, self.dt = robot, checked_dt(dt)
        # layouts are put together anew in each call
        self._layout, self._control_shape = robot.control_layout, (robot.control_layout.size,)
        initial, settled = split_initial(initial)
        if initial is None:
            held = np.zeros(robot.control_layout.size) if settled else None
            at_start = initial_state(robot, settings, recovery_budget=recovery_budget, held=held)
        else:
            check_initial(robot, initial, None)
            at_start = continued_state(robot, initial, settings, self.dt)
        known = at_start.state.known(settings)
        self._task = TimeIntegration(settings, self.dt, 1, known, recovery_budget)
        self._past, self._t0 = at_start.state.history, float(at_start.state.history.t0)
        self._steps, self._result = 0, int(at_start.result)
        self._control = np.asarray(at_start.control, dtype=float)
        self._begun, self._first_state = at_start.state.dt is not None, at_start.state
        stages = np.full((settings.stages - 1, *np.shape(at_start.record)), np.nan)
        row = StepRows(np.asarray(at_start.record), np.zeros(0), 0.0, 0, 0.0, 0, 0.0, stages, np.zeros(0))
        self._state = self._row(row, self._control, self.time, at_start.state)

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
        row, after = self._solve(control, stop)
        self._past, self._control, self._begun = after, control, True
        self._result = int(row.result)
        self._steps += 1
        self._state = self._row(row, control, self.time, self._state_after(after, self._steps))
        return self._state

    def preview(self, control: Any, stop: Callable[[], bool] | None = None) -> Trajectory:
        """Return the row that `step` would return, without changing the state. Raises the same errors."""
        control = self._checked(control)
        row, after = self._solve(control, stop)
        return self._row(row, control, self.time + self.dt, self._state_after(after, self._steps + 1))

    def _checked(self, control: Any) -> np.ndarray:
        try:
            control = np.array(real_array(control))
        except (TypeError, ValueError) as error:
            raise ValueError(f"the control is not numbers ({error}); there are {self._names}") from None
        if control.shape != self._control_shape:
            raise ValueError(
                f"the control has shape {control.shape}; allowed is {self._control_shape}: {self._names}"
            )
        if not np.all(np.isfinite(control)):
            raise ValueError(f"the control is {control.tolist()}; it must be finite")
        beyond = self._layout.beyond(control)
        if beyond:
            raise ValueError(f"the control: {beyond}")
        return control

    @property
    def _names(self) -> str:
        return ", ".join(f"{field.name} ({field.size}, {field.unit})" for field in self._layout.fields)

    def _solve(self, control: np.ndarray, stop: Callable[[], bool] | None) -> tuple[StepRows, StateHistory]:
        i, settings = self._steps, self._task.settings
        control = at_stages(self.robot, settings, control[None], self._control[None], not self._begun)[0]
        controls = np.broadcast_to(control, (i + 1, len(control)))
        done, after, rows = self._task.solve(self.robot, controls, self._past, (i, i + 1))
        row, cause = StepRows(*(leaf[0] for leaf in rows)), ""
        if int(done) == i:
            budget = Budget(self._task.recovery_budget, stop)
            pair = self._control, control
            after, row, cause = self._task.recover(self.robot, self._past, pair, i, budget)
        result = Result(int(row.result))
        if not result.solved:
            raise SimulationError(self._steps + 1, self.time + self.dt, float(row.error), result, cause)
        return row._replace(result=int(carried_results(np.array([result]), self._result)[0])), after

    def _state_after(self, past: StateHistory, steps: int) -> SolverState:
        """Return the solver's state after so many steps."""
        past = past._replace(t0=np.asarray(self._t0 + steps * self.dt))
        return self._first_state.after(past, self.dt, steps, self._task.settings)

    def _row(self, row: StepRows, control: np.ndarray, time: float, state: SolverState) -> Trajectory:
        single = StepRows(*(np.asarray(leaf)[None] for leaf in row))
        state = jax.tree.map(np.asarray, state)
        found = Trajectory(
            self.robot, self._task.settings, np.array([time]), control=control[None],
            **rows_of(self.robot, single), initial_state=state, final_state=state,
        )  # fmt: skip
        return marked(found, None)
