"""A robot's motion step by step with tangents of its uncertain directions, for observers and controllers.

The history of the next step is uncertain in few directions. Each is a tangent of the history, together with
coordinates of the adapted parameters. Together they are the columns of a square root of the covariance.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.engine.equations import with_moving
from knode_cosserat.estimation.outputs import Output
from knode_cosserat.estimation.parameters import ParametrisedRobot
from knode_cosserat.rods.system import System
from knode_cosserat.solvers.history import StateHistory
from knode_cosserat.solvers.run import TimeIntegration
from knode_cosserat.solvers.sensitivity import Changes, TangentState, tangent_time_loop
from knode_cosserat.solvers.settings import Settings


class Spread(NamedTuple):
    """Columns of a square root of the covariance of the history and of the adapted parameters."""

    records: Float[Any, "m 2 used x"]
    rate: Float[Any, "m used x"]
    parameters: Float[Any, "m n"]

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


class OnlineModel(eqx.Module):
    """A robot with adapted parameters, and the numerical settings of its steps."""

    parameters: ParametrisedRobot
    dt: float = eqx.field(static=True)
    #: the default schemes: a plant holds its controls, as these do
    settings: Settings = eqx.field(static=True, default=Settings())

    @property
    def robot(self) -> System:
        """The robot with its first parameters."""
        return self.parameters.robot

    def task(self, steps: int) -> TimeIntegration:
        """Return so many steps from a state with a history."""
        return TimeIntegration(self.settings, self.dt, steps, self.settings.memory)

    def moved(self, x: Any) -> tuple[System, Any]:
        """Return the robot, and its tangents by each parameter, stacked; None if there are none.

        Zeros that are adapted are no constants of the machine code, which would be compiled again, in the
        loop, as soon as they move.
        """
        if not self.parameters.size:
            return self.robot, None
        system, directions = jax.tree.map(np.asarray, _moved(self, x))
        return jax.tree.map(
            lambda leaf, moves: with_moving(leaf, np.any(moves != 0.0, axis=0)), system, directions
        ), directions

    def rollout(
        self, belief: Belief, controls: Float[Any, "T c"], d_controls: Float[Any, "k T c"]
    ) -> tuple[System, Motion]:
        """Return the robot, and its motion with the tangents of all rows along columns.

        A column is a direction of the belief's spread, with the tangents of the controls beside it.
        """
        system, directions = self.moved(belief.x)
        settings, steps, past, spread = self.settings, len(controls), belief.past, belief.spread
        task = self.task(steps)
        done, after, rows = task.solve(system, controls, past, (0, steps))
        columns = [np.moveaxis(np.asarray(part), 0, -1) for part in (*spread, d_controls)]
        last = TangentState.of(system, settings.space, past, *columns[:2])
        d_rows = np.zeros((*rows.records.shape, columns[0].shape[-1]))
        if done == steps:
            changes = Changes(columns[3], directions, columns[2])
            last, (d_solves, _) = tangent_time_loop(
                task.coefficients, rows.every_stage, (system, controls), changes, last
            )
            d_rows = d_solves[settings.stages - 1 :: settings.stages]
        d_records, d_rate = (np.moveaxis(part, -1, 0) for part in (last.d_records, last.d_rate))
        moved = Spread(d_records, d_rate, spread.parameters)
        after = after._replace(t0=past.t0 + steps * self.dt)
        return system, Motion(after, rows.records, d_rows, moved, bool(done == steps))

    def predicted(
        self, belief: Belief, controls: Any, measured: Any, deviations: tuple[Any, Any], output: Output
    ) -> Predicted:
        """Return a motion under controls, with new columns for their uncertainty and parameters' drift.

        The new columns are T c for the controls (T, c), step by step, and n for the parameters. `measured`
        (T, p) are the measurements after each control; NaN: none. `deviations` are those of each control
        (c,), independent in each step, and of the drift of each parameter (n,).
        """
        of_control, of_drift = deviations
        spread = belief.spread
        (steps, c), m, n = controls.shape, len(spread.records), len(of_drift)
        count = steps * c

        def more(part: Any) -> Any:
            return np.concatenate([part, np.zeros((count + n, *part.shape[1:]))])

        drifts = np.concatenate([spread.parameters, np.zeros((count, n)), np.diag(of_drift)])
        wide = Spread(more(spread.records), more(spread.rate), drifts)
        noise = np.diag(np.tile(of_control, steps)).reshape(count, steps, c)
        d_controls = np.concatenate([np.zeros((m, steps, c)), noise, np.zeros((n, steps, c))])
        system, motion = self.rollout(belief._replace(spread=wide), controls, d_controls)
        outputs = _measured(system, output, motion.records, motion.d_records, measured)
        values, errors, slopes = map(np.asarray, outputs)
        record = motion.records[-1]
        return Predicted(motion.past, record, motion.spread, values, errors, slopes, motion.solved)

    def errors(
        self, x: Float[Any, " n"], past: StateHistory, controls: Any, measured: Any, output: Output
    ) -> Float[Any, "T e"]:
        """Return the errors of the motion with these parameters; infinite after a failure."""
        system, steps = self.moved(x)[0], len(controls)
        done, _, rows = self.task(steps).solve(system, controls, past, (0, steps))
        errors = np.asarray(errors_of(system, output, rows.records, measured))
        return np.where((np.arange(steps) < done)[:, None], errors, np.inf)


@jax.jit
def _moved(model: OnlineModel, x: Any) -> tuple[System, Any]:
    robot = model.parameters
    return robot(x), jax.vmap(lambda d: jax.jvp(robot, (x,), (d,))[1])(jnp.eye(robot.size))


class Motion(NamedTuple):
    """A simulated motion, and the tangents of its rows."""

    past: StateHistory
    records: Float[Any, "T N x"]
    d_records: Float[Any, "T N x k"]
    #: history after the last step, along the columns
    spread: Spread
    solved: Any


def split_record(system: System, record: Any) -> tuple[Any, Any]:
    """Return y and z (…) of records (…, x)."""
    ny, nz = system.y_layout.size, system.z_layout.size
    return record[..., :ny], record[..., ny : ny + nz]


@functools.partial(jax.jit, static_argnames=("output", "columns"))
def errors_along(
    system: System, output: Output, records: Float[Any, "T N x"], d_records: Float[Any, "T ... k"],
    references: Float[Any, "T p"], directions: Any = None, columns: tuple[int, ...] | None = None,
) -> tuple[Float[Any, "T e"], Float[Any, "k T e"]]:  # fmt: skip
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
    solved: Any


@functools.partial(jax.jit, static_argnames="output")
def _measured(system: System, output: Output, records: Any, d_records: Any, measured: Any) -> Any:
    """Return values of the output in every row, their errors, and the errors' tangents."""
    values = jax.vmap(lambda record: output.value(system, *split_record(system, record)))(records)
    errors = errors_of(system, output, records, measured)
    # where nothing was measured the derivatives are those at the prediction
    known = jnp.where(jnp.isnan(measured), values, measured)
    return values, errors, errors_along(system, output, records, d_records, known)[1]


@functools.partial(jax.jit, static_argnames="output")
def measured_error(model: OnlineModel, x: Any, record: Any, measured: Any, output: Output) -> Any:
    """Return the error of a state's output from a measurement."""
    system = model.parameters(x)
    return output.error(system, *split_record(system, record), measured)
