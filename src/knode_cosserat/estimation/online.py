"""A robot's motion step by step with tangents of its uncertain directions, for observers and controllers.

The history of the next step is uncertain in few directions. Each is a tangent of the history, together with
coordinates of the adapted parameters. Together they are the columns of a square root of the covariance.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from knode_cosserat.engine.core import Core
from knode_cosserat.engine.equations import is_moving, with_moving
from knode_cosserat.engine.loops import at_all_stages, core_of, table_of, tangents_for
from knode_cosserat.engine.motions import Motions
from knode_cosserat.engine.pattern import Pattern
from knode_cosserat.engine.tangents import SolvedSteps, TangentCore
from knode_cosserat.estimation.outputs import Output
from knode_cosserat.estimation.parameters import ParametrisedRobot
from knode_cosserat.rods.system import System
from knode_cosserat.schemes.grid import grid_of
from knode_cosserat.schemes.history import EXTRAPOLATIONS, StateHistory, StepCoefficients, StepRows
from knode_cosserat.schemes.problem import no_history
from knode_cosserat.schemes.settings import Settings
from knode_cosserat.solvers.run import TimeIntegration

#: schemes of a simulated plant; nobody reads the errors of an observer's steps
STEPS = Settings(errors=False)
#: rows of any numbers by which the numbers are found on which an output depends
ROWS = 3
#: robots that are kept: that of the estimate, and earlier ones with which a rollback compares it
ROBOTS = 8


class Spread(NamedTuple):
    """Columns of a square root of the covariance of the history and of the adapted parameters."""

    records: Float[Any, "m 2 used x"]
    rate: Float[Any, "m used x"]
    parameters: Float[Any, "m n"]

    def wider(self, before: int, after: int) -> Spread:
        """Return these columns with columns of zeros before and after them."""
        sizes = len(self.records), before, after

        def filled(part: Any) -> np.ndarray:
            found = np.zeros((sum(sizes), *part.shape[1:]))
            found[before : before + len(part)] = part
            return found

        return Spread(*map(filled, self))

    def combined(self, matrix: Float[np.ndarray, "m k"]) -> Spread:
        """Return k columns, each a combination of these."""
        return Spread(*(np.tensordot(matrix.T, np.asarray(part), 1) for part in self))

    def along(self, coordinates: Float[np.ndarray, " m"]) -> tuple[Any, Any, Any]:
        """Return the change of records, rate and parameters at coordinates of the columns."""
        return tuple(np.tensordot(coordinates, np.asarray(part), 1) for part in self)  # type: ignore[return-value]


class Belief(NamedTuple):
    """Estimated state of a model: coordinates of its parameters, the solver's history, and their spread."""

    x: Float[Any, " n"]
    past: StateHistory
    spread: Spread

    def moved(
        self, coordinates: Float[np.ndarray, " m"], bounds: Float[np.ndarray, "2 n"], excitation: float = 1.0
    ) -> Belief:
        """Return the state moved along the columns of its spread, with parameters within bounds (2, n).

        Parameters move by the part `excitation` only.
        """
        records, rate, d_x = self.spread.along(coordinates)
        used = records.shape[1]
        all_records, all_rates = np.array(self.past.records), np.array(self.past.rate)
        all_records[:, :used] += records
        all_rates[:used] += rate
        x = np.clip(np.asarray(self.x) + excitation * d_x, *bounds)
        return Belief(x, self.past._replace(records=all_records, rate=all_rates), self.spread)


class Structure(NamedTuple):
    """Structure of a system without its numbers: a constant of compiled programs."""

    tree: Any
    shapes: tuple[tuple[int, ...], ...]

    @classmethod
    def of(cls, system: System) -> Structure:
        """Return the structure of a system."""
        leaves, tree = jax.tree.flatten(system)
        return cls(tree, tuple(np.shape(leaf) for leaf in leaves))

    def split(self, numbers: Float[Any, "... p"]) -> list[Any]:
        """Return the leaves of a system from all their numbers."""
        ends = np.cumsum([int(np.prod(shape)) for shape in self.shapes])
        return [
            numbers[..., end - int(np.prod(shape)) : end].reshape((*numbers.shape[:-1], *shape))
            for end, shape in zip(ends, self.shapes, strict=True)
        ]

    def system(self, numbers: Float[Any, " p"]) -> System:
        """Return the system with these numbers."""
        system: System = jax.tree.unflatten(self.tree, self.split(numbers))
        return system


class MovedRobot(NamedTuple):
    """Numbers of a robot at coordinates of its adapted parameters, and the machine code of its steps."""

    structure: Structure
    numbers: Float[np.ndarray, " p"]
    #: derivatives of the numbers that move, by each coordinate
    directions: Float[np.ndarray, "n moving"]
    core: Core
    tangents: TangentCore

    @property
    def system(self) -> System:
        """The robot."""
        return self.structure.system(self.numbers)


class OnlineModel:
    """A robot with adapted parameters, and its steps with tangents; what several calls need is kept."""

    def __init__(self, parameters: ParametrisedRobot, dt: float, settings: Settings = STEPS):
        """Set the time step (s); by default the schemes are those of a simulated plant."""
        self.parameters, self.dt, self.settings = parameters, dt, settings
        self._structure = Structure.of(parameters.robot)
        self._coefficients: dict[int, StepCoefficients] = {}
        #: robots by their coordinates, the newest last, and machine code by the masks of numbers
        self._robots: dict[bytes, MovedRobot] = {}
        self._codes: dict[tuple[bytes, bytes], tuple[Core, TangentCore]] = {}
        self._columns: dict[Output, np.ndarray] = {}

    @property
    def robot(self) -> System:
        """The robot with its first parameters."""
        return self.parameters.robot

    def task(self, steps: int) -> TimeIntegration:
        """Return so many steps from a state with a history."""
        return TimeIntegration(self.settings, self.dt, steps, self.settings.memory)

    def coefficients(self, stride: int) -> StepCoefficients:
        """Return the coefficients of steps of `stride` dt; longer ones start from the newest state."""
        if stride not in self._coefficients:
            known = self.settings.memory if stride == 1 else 1
            self._coefficients[stride] = StepCoefficients.of(self.settings, stride * self.dt, known)
        return self._coefficients[stride]

    def moved(self, x: Float[np.ndarray, " n"]) -> MovedRobot:
        """Return the robot at coordinates.

        Zeros that are adapted are no constants of the machine code, which would be compiled again, in the
        loop, as soon as they move.
        """
        key = np.asarray(x, dtype=float).tobytes()
        if key not in self._robots:
            numbers, directions = map(np.asarray, _numbers(self.parameters, x))
            moving = np.any(directions != 0.0, axis=0)
            numbers = with_moving(numbers, moving)
            core, tangents = self._code(numbers, moving)
            if len(self._robots) == ROBOTS:
                del self._robots[next(iter(self._robots))]
            self._robots[key] = MovedRobot(self._structure, numbers, directions[:, moving], core, tangents)
        return self._robots[key]

    def _code(self, numbers: np.ndarray, moving: np.ndarray) -> tuple[Core, TangentCore]:
        """Return the machine code for the zeros among these numbers, and for those that move."""
        key = is_moving(numbers).tobytes(), moving.tobytes()
        if key not in self._codes:
            pattern = Pattern.of(self._structure.system(numbers))
            masks = self._structure.split(moving)
            self._codes[key] = (
                core_of(pattern, self.settings, robots=False),
                tangents_for(TangentCore, pattern, self.settings, masks),
            )
        return self._codes[key]

    def columns(self, *outputs: Output) -> tuple[int, ...]:
        """Return the numbers (among N * x) of a record on which outputs depend."""
        for output in {*outputs} - {*self._columns}:
            shape = len(grid_of(self.robot).nodes), no_history(self.robot, self.settings.space).shape[-1]
            # no derivative is zero by chance
            records = np.random.default_rng(0).normal(size=(ROWS, *shape))
            depends = sensitive(self.robot, output, records, np.ones((ROWS, output.size)))
            self._columns[output] = np.flatnonzero(depends)
        return tuple(sorted({int(k) for output in outputs for k in self._columns[output]}))

    def simulated(
        self,
        x: Float[np.ndarray, " n"],
        past: StateHistory,
        controls: Float[np.ndarray, "T c"],
        stride: int = 1,
    ) -> tuple[StateHistory, StepRows] | None:
        """Return the last history and the rows of a motion in steps of `stride` dt; None if not solved."""
        moved, steps = self.moved(x), len(controls)
        if stride > 1:  # the states before the newest one are not at the distance of a step
            past = past._replace(weights=EXTRAPOLATIONS[0])
        states = StateHistory(*(np.asarray(leaf)[None] for leaf in past))
        motions = Motions(moved.core, moved.numbers, states, self.coefficients(stride))
        done, rows = motions.solve(controls[None], (0, steps))
        if done[0] < steps:
            return None
        after = StateHistory(*(leaf[0] for leaf in motions.states))
        after = after._replace(t0=past.t0 + steps * stride * self.dt)
        return after, StepRows(*(leaf[0] for leaf in rows))

    def rollout(
        self,
        belief: Belief,
        controls: Float[np.ndarray, "T c"],
        d_controls: Float[np.ndarray, "k T c"],
        columns: tuple[int, ...],
        stride: int = 1,
    ) -> tuple[MovedRobot, TangentMotion | None]:
        """Return the robot, and its motion with tangents of all rows; None if it was not solved.

        A tangent is that along a direction of the belief's spread, with the tangents of the controls beside
        it. Those of rows are returned for the numbers `columns` (among N * x) of each record. Steps take
        `stride` dt.
        """
        past, spread, settings, steps = belief.past, belief.spread, self.settings, len(controls)
        moved, solved = self.moved(belief.x), self.simulated(belief.x, past, controls, stride)
        if solved is None:
            return moved, None
        (after, rows), used = solved, spread.rate.shape[1]
        own, d_own = (
            at_all_stages(self.robot, settings, each) for each in (controls, np.moveaxis(d_controls, 0, -1))
        )
        data = SolvedSteps(
            moved.numbers,
            table_of(self.coefficients(stride), steps, float(past.t0)),
            own,
            *rows.every_stage,
            np.asarray(past.records)[:, :used],
            np.asarray(past.rate)[:used],
        )
        d_records, d_rate = (np.moveaxis(part, 0, -1) for part in (spread.records, spread.rate))
        last, (d_rows, _) = moved.tangents.solve(
            data, (moved.directions, spread.parameters.T), d_own, (d_records, d_rate)
        )
        d_rows = d_rows[settings.stages - 1 :: settings.stages]
        d_rows = d_rows[:, *np.divmod(columns, rows.records.shape[-1])]
        records, rate = (np.moveaxis(part, -1, 0) for part in last[2:])
        spread = Spread(records, rate, spread.parameters)
        return moved, TangentMotion(after, rows.records, d_rows, spread)

    def predicted(
        self, belief: Belief, controls: Any, measured: Any, deviations: tuple[Any, Any], output: Output
    ) -> Predicted | None:
        """Return a motion under controls, with uncertain controls and drift; None if it was not solved.

        The new columns are T c for the controls (T, c), step by step, and n for the parameters. `measured`
        (T, p) are the measurements after each control; NaN: none. `deviations` are those of each control
        (c,), independent in each step, and of the drift of each parameter (n,).
        """
        of_control, of_drift = deviations
        spread = belief.spread
        (steps, c), m, n = controls.shape, len(spread.records), len(of_drift)
        count = steps * c
        wide = spread.wider(0, count + n)
        wide.parameters[m + count :] = np.diag(of_drift)
        d_controls = np.zeros((m + count + n, steps, c))
        d_controls[m : m + count].reshape(count, count)[...] = np.diag(np.tile(of_control, steps))
        columns = self.columns(output)
        moved, motion = self.rollout(belief._replace(spread=wide), controls, d_controls, columns)
        if motion is None:
            return None
        seen = _output_rows(
            moved.structure, output, columns, moved.numbers, motion.records, motion.d_records, measured
        )
        return Predicted(motion.past, motion.records[-1], motion.spread, *map(np.asarray, seen))

    def errors(self, x: Float[np.ndarray, " n"], records: Any, measured: Any, output: Output) -> np.ndarray:
        """Return the errors (T, e) of an output in rows of a motion with these parameters."""
        return np.asarray(errors_of(self.moved(x).system, output, records, measured))


@jax.jit
def _numbers(robot: ParametrisedRobot, x: Any) -> tuple[Any, Any]:
    """Return all numbers of a robot at coordinates, and their derivatives by each coordinate."""

    def numbers(x: Any) -> Any:
        return jnp.concatenate([jnp.ravel(jnp.asarray(leaf, float)) for leaf in jax.tree.leaves(robot(x))])

    return numbers(x), jax.vmap(lambda d: jax.jvp(numbers, (x,), (d,))[1])(jnp.eye(robot.size))


class TangentMotion(NamedTuple):
    """A simulated motion, and the tangents of its rows."""

    past: StateHistory
    records: Float[Any, "T N x"]
    d_records: Float[Any, "T q k"]
    #: history after the last step, along the columns
    spread: Spread


def split_record(system: System, record: Any) -> tuple[Any, Any]:
    """Return y and z (…) of records (…, x)."""
    ny, nz = system.y_layout.size, system.z_layout.size
    return record[..., :ny], record[..., ny : ny + nz]


@functools.partial(jax.jit, static_argnames=("output", "columns"))
def errors_along(
    system: System,
    output: Output,
    records: Float[Any, "T N x"],
    d_records: Float[Any, "T ... k"],
    references: Float[Any, "T p"],
    directions: Any = None,
    columns: tuple[int, ...] | None = None,
) -> tuple[Float[Any, "T e"], Float[Any, "k T e"]]:
    """Return the errors of an output in every row, and their tangents; `directions` are k of the system.

    The tangents of records are those of all numbers (T, N, x, k), or of the `columns` (T, columns, k) among
    the N * x numbers of a record, while the others do not move.
    """
    leaves, tree = jax.tree.flatten(system)
    moves = jax.tree.leaves(directions)

    def errors(records: Any, *moving: Any) -> Any:
        robot = jax.tree.unflatten(tree, moving or leaves)
        return output.errors(robot, *split_record(system, records), references)

    value, moved = jax.linearize(errors, records, *leaves[: len(moves)])
    if columns is None:
        return value, jax.vmap(moved, in_axes=(-1, *(0 for _ in moves)))(d_records, *moves)
    # a column of zeros is read in place of all other numbers: no array of all is written
    place = np.full(records[0].size, len(columns))
    place[list(columns)] = np.arange(len(columns))

    def along(tangent: Any, *direction: Any) -> Any:
        wider = jnp.concatenate([tangent, jnp.zeros((len(tangent), 1))], axis=1)
        return moved(wider[:, place].reshape(records.shape), *direction)

    return value, jax.vmap(along, in_axes=(-1, *(0 for _ in moves)))(d_records, *moves)


@functools.partial(jax.jit, static_argnames="output")
def errors_of(
    system: System, output: Output, records: Float[Any, "T N x"], measured: Float[Any, "T p"]
) -> Float[Any, "T e"]:
    """Return the errors of an output in every row."""
    return output.errors(system, *split_record(system, records), measured)


class Predicted(NamedTuple):
    """Motion of an observer's model over some steps, and the errors of the output with their columns."""

    past: StateHistory
    record: Float[Any, "N x"]
    spread: Spread
    #: values of the output, their errors (NaN where nothing was measured), and tangents by every column
    values: Float[Any, "T p"]
    errors: Float[Any, "T e"]
    by_column: Float[Any, "m T e"]


@functools.partial(jax.jit, static_argnames=("structure", "output", "columns"))
def _output_rows(
    structure: Structure,
    output: Output,
    columns: tuple[int, ...],
    numbers: Any,
    records: Any,
    d_records: Any,
    measured: Any,
) -> Any:
    """Return values of the output in every row, their errors, and the errors' tangents."""
    system = structure.system(numbers)
    values = jax.vmap(lambda record: output.value(system, *split_record(system, record)))(records)
    errors = errors_of(system, output, records, measured)
    # where nothing was measured the derivatives are those at the prediction
    known = jnp.where(jnp.isnan(measured), values, measured)
    return values, errors, errors_along(system, output, records, d_records, known, columns=columns)[1]


@functools.partial(jax.jit, static_argnames=("structure", "output"))
def measured_error(structure: Structure, output: Output, numbers: Any, record: Any, measured: Any) -> Any:
    """Return the error of a state's output from a measurement."""
    system = structure.system(numbers)
    return output.error(system, *split_record(system, record), measured)


@functools.partial(jax.jit, static_argnames="output")
def sensitive(
    system: System, output: Output, records: Float[Any, "T N x"], measured: Float[Any, "T p"]
) -> Bool[Any, " numbers"]:
    """Return true for the numbers of a record (N * x) on which the errors depend in any row."""
    errors, pull = jax.vjp(lambda rows: errors_of(system, output, rows, measured), records)
    # numbers without a pattern do not cancel
    weights = jnp.sin(1.0 + jnp.arange(errors.size) ** 1.5).reshape(errors.shape)
    return jnp.any(pull(weights)[0] != 0.0, axis=0).ravel()
