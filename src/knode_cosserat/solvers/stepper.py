"""One robot, step by step: for what decides on each control only when it has seen the step before."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import numpy as np

from knode_cosserat.rods.system import System
from knode_cosserat.solvers.begin import Run, beginning
from knode_cosserat.solvers.boundary import NewtonOptions
from knode_cosserat.solvers.linear import LinearSolver
from knode_cosserat.solvers.march import march_one
from knode_cosserat.solvers.past import Begun, newest_row
from knode_cosserat.solvers.result import Result, SimulationError
from knode_cosserat.solvers.run import (
    ENOUGH_RESCUES,
    LEAST_CAPACITY,
    rescue,
    with_stable_elimination,
)
from knode_cosserat.solvers.simulate import check_initial, checked_dt, settings_of
from knode_cosserat.solvers.space import SpaceScheme
from knode_cosserat.solvers.stability import SAFE_DECAY, decay_per_segment
from knode_cosserat.solvers.task import Task
from knode_cosserat.solvers.time import Static, TimeScheme
from knode_cosserat.solvers.trust import trusted_size
from knode_cosserat.trajectory import Trajectory


class _Solved(NamedTuple):
    """A step that was solved: the past of the next one, and what its row is made of."""

    past: Any
    record: np.ndarray
    result: int
    residual: float
    corrections: int


class Stepper:
    """A robot that moves one step at a time, by the program of `simulate` and with its recovery.

    As many calls of `step` give, bit for bit, the rows that one `simulate` gives. A call costs the step
    itself and a fraction of a millisecond beside it; what `simulate` has compiled is not compiled again.

        stepper = kc.Stepper(robot, dt=0.05)
        while True:
            row = stepper.step(tensions())
            row.tip_position[0], row.time[0]

    There is one difference: where a motion grows as only an instability in space does, `simulate` begins
    anew with divided segments. What has been handed out cannot be taken back, so that here this is an error.
    """

    def __init__(
        self,
        robot: System,
        dt: float,
        *,
        time: str | TimeScheme = "bdf2",
        space: str | SpaceScheme = "euler",
        start: Literal["paper", "consistent"] = "paper",
        initial: Trajectory | None = None,
        newton: NewtonOptions = NewtonOptions(),
        elimination: str | LinearSolver | None = None,
    ):
        """Begin at rest, or where `initial` ends. The arguments are those of `simulate`.

        Raises:
            SimulationError: where rest is an equilibrium to be found, there is none.
            ValueError: arguments of a wrong shape or name.
        """
        given: Any = robot
        if not isinstance(given, System) or np.ndim(given.length):
            raise ValueError(f"robot is {type(robot).__name__}; a stepper is of one robot, not of a batch")
        settings = settings_of(time, space, start, newton, elimination, initial)
        if isinstance(settings.time, Static):
            raise ValueError("time is Static; a stepper moves: see `equilibrium` for shapes at rest")
        if settings.newton.across_steps:
            raise ValueError("newton has across_steps; a stepper keeps nothing of one step's equations")
        self.robot, self.dt = robot, checked_dt(dt)
        if initial is not None:
            check_initial(robot, initial, None)
        count = robot.control_size
        begins = beginning(Run(robot, np.zeros((1, count)), initial, settings, self.dt, None, False))
        begun, t0 = begins.start, begins.t0
        self._task = Task(settings, self.dt, 1, begins.first)
        self._settings = settings
        self._past, self._t0, self._index, self._steps = begun.past, float(t0), 0, 0
        self._control = np.asarray(begun.control, dtype=float)
        self._begun, self._trusted = begun, trusted_size(robot, begun)
        self._decay: float | None = None
        self._rescues = 0
        # as many as in a run of up to 128 steps, so that they share a program
        self._controls = np.zeros((LEAST_CAPACITY, count))
        first = _Solved(begun.past, np.asarray(begins.record), 0, 0.0, 0)
        self._state = self._row(first, self._control, self.time, begins.begun)

    @property
    def time(self) -> float:
        """Time of the state that has been reached (s)."""
        return self._t0 + self._steps * self.dt

    @property
    def state(self) -> Trajectory:
        """The state that has been reached: a trajectory of one row."""
        return self._state

    def step(self, control: Any) -> Trajectory:
        """Go on by one time step under a control (c,): the new state, a trajectory of one row.

        Raises:
            SimulationError: the step has no solution, or none to be trusted. The robot then stays where it
                is, and may be stepped with another control.
            ValueError: a control of a wrong shape, or one that is not finite.
        """
        control = self._checked(control)
        solved = self._solve(control)
        self._past, self._control = solved.past, control
        self._steps, self._index = self._steps + 1, self._index + 1
        self._rescues += solved.result == Result.RECOVERED_STABLE_ELIMINATION
        if self._rescues >= ENOUGH_RESCUES:
            self._settings = with_stable_elimination(self._task.settings)
        if self._index == LEAST_CAPACITY:
            # the march counts from an earlier row on, but not from row 0, whose coefficients may differ
            self._index = 1
            self._past = self._past._replace(t0=np.asarray(self.time - self.dt))
        self._state = self._row(solved, control, self.time, self._begun_after(solved))
        return self._state

    def preview(self, control: Any) -> Trajectory:
        """What `step` would give, without going there. Raises what that would raise."""
        control = self._checked(control)
        solved = self._solve(control)
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

    def _solve(self, control: np.ndarray) -> _Solved:
        i = self._index
        controls = self._controls.copy()  # the compiled march may still read the last one
        controls[i] = control
        done, past, rows = march_one(
            self.robot, self._settings, self._task.table, controls, self.dt, self._past, i, i + 1
        )
        if int(done) > i:
            found = _Solved(
                past, np.asarray(rows.records)[i], 0, float(rows.error[i]), int(rows.corrections[i])
            )
            size, cause = float(rows.size[i]), ""
        else:
            outcome = rescue(self._task, self.robot, self._past, (self._control, control), i)
            found = _Solved(
                outcome.past, outcome.record, int(outcome.result), outcome.error, outcome.corrections
            )
            size, cause = outcome.size, outcome.cause
        self._require(found, control, size, cause)
        return found

    def _require(self, found: _Solved, control: np.ndarray, size: float, cause: str) -> None:
        """That the step is solved, and a solution to be trusted."""
        result = Result(found.result)
        if result.solved and not np.isfinite(found.record[-1, self.robot.y_layout.size :]).all():
            result, cause = Result.NOT_FINITE, "At the tip strains are undefined."
        if result.solved and size > self._trusted and self._may_be_unstable(control):
            result = Result.UNSTABLE
            cause = (
                "Give the robot more nodes, or use longer time steps; `simulate` divides segments by itself."
            )
        if not result.solved:
            number = self._steps + 1
            raise SimulationError(number, self.time + self.dt, found.residual, result, cause)

    def _may_be_unstable(self, control: np.ndarray) -> bool:
        """Whether its segments are long enough for that, as `simulate` judges it: by the first step."""
        if self._decay is None:
            record = newest_row(self.robot, self._begun.past)
            self._decay = decay_per_segment(
                self.robot, self._task.settings, self._task.table[1], record, control
            )
        return self._decay >= SAFE_DECAY / 4.0

    def _begun_after(self, solved: _Solved) -> Begun:
        """What a motion that goes on from a step looks back on."""
        past = solved.past
        return Begun(*map(np.asarray, (past.records, past.rate, self._task.table[1], self.dt)))

    def _row(self, solved: _Solved, control: np.ndarray, time: float, begun: Begun | None) -> Trajectory:
        ny, nz = self.robot.y_layout.size, self.robot.z_layout.size
        record = solved.record[None, :, : ny + nz]
        return Trajectory(
            system=self.robot,
            settings=self._settings,
            time=np.array([time]),
            y=record[..., :ny],
            z=record[..., ny:],
            control=control[None],
            result=np.array([solved.result]),
            residual=np.array([solved.residual]),
            iterations=np.array([solved.corrections]),
            begun=begun,
        )
