"""Step-by-step simulation of one robot, for controllers that choose each control from the previous state."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import jax
import numpy as np

from knode_cosserat._arguments import check_arguments
from knode_cosserat._reprs import robot_text
from knode_cosserat.rods.passport import without_passport
from knode_cosserat.rods.system import System
from knode_cosserat.schemes.history import SolverState, StateHistory, StepRows, at_stages
from knode_cosserat.schemes.result import Result, SimulationError
from knode_cosserat.schemes.settings import Errors, NewtonOptions, Settings
from knode_cosserat.schemes.space import SpaceScheme
from knode_cosserat.schemes.time import TimeScheme
from knode_cosserat.solvers.guess import LARGEST_JUMP, LARGEST_TURN, turns_between, turns_within
from knode_cosserat.solvers.initial import start_of
from knode_cosserat.solvers.recovery import Budget
from knode_cosserat.solvers.run import TimeIntegration, carried_results, rows_of
from knode_cosserat.solvers.simulate import check_initial, checked_dt, mark_extrapolated
from knode_cosserat.trajectory import Trajectory

#: function that returns a solved step's row and the state of the solver after it
Solved = Callable[[], tuple[StepRows, SolverState]]


class Stepper:
    """A robot that moves one step at a time, by the program of `simulate` and with its recovery.

    Calls of `step` return the rows of one `simulate`, to the tolerance of Newton's method. A call takes the
    time of the step and some 20 µs; its row takes more when it is first used. Programs are those of
    `simulate`.

        stepper = kc.solvers.Stepper(robot, dt=0.05)
        while True:
            row = stepper.step(tensions())
            row.tip_position[0], row.time[0]
    """

    _engines: list[Any]
    #: the engine's numbers of the present state; None in a copy and of another robot, until it moves
    _motion: np.ndarray | None

    def __init__(
        self,
        robot: System,
        dt: float,
        *,
        time: str | TimeScheme = "sdirk2",
        space: str | SpaceScheme = "lobatto2",
        start: Literal["paper", "consistent"] = "consistent",
        initial: Trajectory | Literal["equilibrium", "unstressed"] = "equilibrium",
        newton: NewtonOptions = NewtonOptions(),
        errors: Errors = True,
        recovery_budget: float | None = None,
    ):
        """Start in equilibrium, unstressed, or at the last row of `initial`: arguments as in `simulate`.

        Raises:
            SimulationError: the initial equilibrium was not found.
            ValueError: arguments of a wrong shape or name.
        """
        check_arguments(Stepper.__init__, locals())
        if np.ndim(robot.length):
            raise ValueError("robot is a batch; a stepper is of one robot")
        if time in (None, "static"):
            raise ValueError(f"time is {time!r}; a stepper moves: see `equilibrium` for shapes at rest")
        settings = Settings.of(time, space, start, newton, errors=errors)
        self.robot, self.dt = robot, checked_dt(dt)
        # layouts are put together anew in each call
        self._layout, self._control_shape = robot.control_layout, (robot.control_layout.size,)
        self._linear, self._counts = bool(self._layout.moving.any()), False
        # an infinite number is beyond them, and NaN too
        most = np.finfo(float).max
        self._limits = [
            (max(field.low, -most), min(field.high, most))
            for field in self._layout.fields
            for _ in range(field.size)
        ]
        check_initial(robot, initial, None)
        at_start = start_of(robot, initial, settings, self.dt, recovery_budget=recovery_budget)
        known = at_start.state.known(settings)
        self._task = TimeIntegration(settings, self.dt, 1, known, recovery_budget)
        self._t0, self._steps, self._result = float(at_start.state.history.t0), 0, int(at_start.result)
        self._control = np.asarray(at_start.control, dtype=float)
        self._begun, self._first_state = at_start.state.dt is not None, at_start.state
        # memories of the engine that no call uses, and the present state as an array of theirs
        engine = self._task.motions(self._bare, at_start.state.history)
        self._engines = [engine]
        self._motion = engine.motions
        at_rest = jax.tree.map(np.asarray, at_start.state)
        stages = np.full((settings.stages - 1, *np.shape(at_start.record)), np.nan)
        row = StepRows(np.asarray(at_start.record), np.zeros(0), 0.0, 0, 0.0, 0, 0.0, stages, np.zeros(0))
        self._state = self._row(lambda: (row, at_rest), self._control, self.time)

    def __repr__(self) -> str:
        return f"Stepper of a {robot_text(self.robot)}: t = {self.time:g} s, dt = {self.dt:g} s"

    @property
    def robot(self) -> System:
        """The robot; another one of the same layouts takes over its state."""
        return self._robot

    @robot.setter
    def robot(self, robot: System) -> None:
        self._robot, self._bare = robot, without_passport(robot)
        # memories and machine code were those of the robot before; no state until it moves, as in a copy
        self._engines, self._motion = [], None

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
        self._result, self._motion, solved = self._solve(control, stop)
        self._control, self._begun = control, True
        self._steps += 1
        self._state = self._row(solved, control, self.time)
        return self._state

    def preview(self, control: Any, stop: Callable[[], bool] | None = None) -> Trajectory:
        """Return the row that `step` would return, without changing the state. Raises the same errors."""
        control = self._checked(control)
        return self._row(self._solve(control, stop)[2], control, self.time + self.dt)

    def _checked(self, control: Any) -> np.ndarray:
        try:
            control = np.array(self._layout.numbers_of(control))
        except (TypeError, ValueError) as error:
            raise ValueError(f"the control is not numbers ({error}); there are {self._names}") from None
        if control.shape != self._control_shape:
            raise ValueError(
                f"the control has shape {control.shape}; allowed is {self._control_shape}: {self._names}"
            )
        if all(
            low <= number <= high for number, (low, high) in zip(control.tolist(), self._limits, strict=True)
        ):
            return control
        if not np.all(np.isfinite(control)):
            raise ValueError(f"the control is {control.tolist()}; it must be finite")
        raise ValueError(f"the control: {self._layout.beyond(control)}")

    @property
    def _names(self) -> str:
        return ", ".join(f"{field.name} ({field.size}, {field.unit})" for field in self._layout.fields)

    def __getstate__(self) -> dict[str, Any]:
        # the engine's memory is of this object alone; the state of the solver is also in the row
        return self.__dict__ | {"_engines": [], "_motion": None}

    @property
    def _history(self) -> StateHistory:
        """History of the present state."""
        assert self._state.final_state is not None
        return self._state.final_state.history._replace(t0=np.asarray(self._t0))

    def _solve(self, control: np.ndarray, stop: Callable[[], bool] | None) -> tuple[int, np.ndarray, Solved]:
        """Return the result of the next step, the engine's array of the state after it, and its row."""
        i, settings, acting = self._steps, self._task.settings, control
        if self._linear:
            acting = at_stages(self.robot, settings, control[None], self._control[None], not self._begun)[0]
        try:
            engine = self._engines.pop()
        except IndexError:  # another thread has it, or this is a copy
            engine = self._task.motions(self._bare, self._history)
        before = engine.motions if self._motion is None else self._motion
        angle = turns_within(self.robot, control[None], self._control)[0] if self._linear else 0.0
        numbers = None
        if angle <= LARGEST_JUMP:
            motion, numbers, result = engine.step(before, i, acting)
        # from the first large turn on, turns are counted
        self._counts = self._counts or angle > LARGEST_TURN
        if self._counts and numbers is not None:
            y = (self._state.y[-1], engine.row_of(numbers).records)
            numbers = None if turns_between(self.robot, *y) else numbers
        if numbers is None:
            budget, pair = Budget(self._task.recovery_budget, stop), (self._control, acting)
            after, row, cause = self._task.recover(self._bare, self._history, pair, i, budget)
            result = int(row.result)
            if result < 0:
                self._engines.append(engine)
                raise SimulationError(i + 1, self.time + self.dt, float(row.error), Result(result), cause)
            engine = self._task.motions(self._bare, after)
            motion = engine.motions
        if result or self._result:
            result = int(carried_results(np.array([result]), self._result)[0])
        t = np.asarray(self._t0 + (i + 1) * self.dt)
        self._engines.append(engine)

        def solved() -> tuple[StepRows, SolverState]:
            found = row if numbers is None else engine.row_of(numbers)
            past = engine.state_of(motion)._replace(t0=t)
            return found._replace(result=result), self._first_state.after(past, self.dt, i + 1, settings)

        return result, motion, solved

    def _row(self, solved: Solved, control: np.ndarray, time: float) -> Trajectory:
        """Return a solved row as a trajectory, put together when it is first used."""
        robot = self.robot  # which another one may have replaced by then

        def fields() -> dict[str, Any]:
            row, state = solved()
            row = StepRows(*(np.asarray(leaf)[None] for leaf in row))
            found = Trajectory(
                robot,
                self._task.settings,
                np.array([time]),
                control=control[None],
                **rows_of(robot, row),
                initial_state=state,
                final_state=state,
            )
            return vars(mark_extrapolated(found, None))

        return Trajectory.deferred(fields)
