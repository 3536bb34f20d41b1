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

from knode_cosserat.estimation.adapted import AdaptedParameters
from knode_cosserat.estimation.outputs import Output
from knode_cosserat.rods.system import System
from knode_cosserat.solvers.history import StateHistory
from knode_cosserat.solvers.sensitivity import TangentState, tangent_time_loop
from knode_cosserat.solvers.settings import Settings
from knode_cosserat.solvers.tangent import SystemMoves
from knode_cosserat.solvers.time_loop import StepCoefficients, time_loop


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

    robot: System
    parameters: AdaptedParameters
    coefficients: StepCoefficients
    settings: Settings = eqx.field(static=True)

    def __init__(self, robot: System, parameters: AdaptedParameters, dt: float):
        """Set the default schemes: a plant holds its controls, as these do."""
        self.robot, self.parameters = robot, parameters
        self.settings = Settings()
        self.coefficients = StepCoefficients.of(self.settings, dt, "regular")

    def at(self, x: Any) -> System:
        """Return the robot at coordinates of its parameters."""
        return self.parameters.of(self.robot, x)

    def directions(self, x: Any) -> Any:
        """Return the robot's tangents by each parameter, stacked; None if there are none."""
        if not self.parameters.size:
            return None
        by_x = jax.vmap(lambda d: jax.jvp(self.at, (x,), (d,))[1])
        return by_x(jnp.eye(self.parameters.size))

    def rollout(
        self, belief: Belief, controls: Float[Any, "T c"], d_controls: Float[Any, "k T c"]
    ) -> tuple[System, Rollout]:
        """Return the robot, and its motion with the tangents of all rows along columns.

        A column is a direction of the belief's spread, with the tangents of the controls beside it.
        """
        system, directions = self.at(belief.x), self.directions(belief.x)
        settings, steps, past, spread = self.settings, len(controls), belief.past, belief.spread
        done, after, rows = time_loop(system, settings, self.coefficients, controls, past, (0, steps))
        state = TangentState.of(system, settings.space, past, *map(_last, (spread.records, spread.rate)))
        changes = SystemMoves(directions, _last(spread.parameters)), _last(d_controls)
        last, (d_solves, _) = tangent_time_loop(
            settings, self.coefficients, rows.every_stage, (system, controls), changes, state
        )
        d_rows = d_solves[settings.stages - 1 :: settings.stages]
        d_records, d_rate = (jnp.moveaxis(part, -1, 0) for part in (last.d_records, last.d_rate))
        moved = Spread(d_records, d_rate, spread.parameters)
        after = after._replace(t0=past.t0 + steps * self.coefficients.dt)
        return system, Rollout(after, rows.records, d_rows, moved, done == steps)


def _last(columns: Float[Any, "k ..."]) -> Float[Any, "... k"]:
    """Return an array with its columns in the last axis."""
    return jnp.moveaxis(jnp.asarray(columns), 0, -1)


class Rollout(NamedTuple):
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


def errors_along(
    system: System, output: Output, records: Float[Any, "T N x"], d_records: Float[Any, "T N x k"],
    references: Float[Any, "T p"],
) -> tuple[Float[Any, "T e"], Float[Any, "k T e"]]:  # fmt: skip
    """Return the errors of an output in every row, and their tangents."""

    def error(record: Any, reference: Any) -> Any:
        return output.error(system, *split_record(system, record), reference)

    def one(record: Any, reference: Any, d_record: Any) -> Any:
        value, moved = jax.linearize(lambda record: error(record, reference), record)
        return value, jax.vmap(moved, in_axes=-1)(d_record)

    return jax.vmap(one, out_axes=(0, 1))(records, references, d_records)


def errors_of(
    system: System, output: Output, records: Float[Any, "T N x"], measured: Float[Any, "T p"]
) -> Float[Any, "T e"]:
    """Return the errors of an output in every row."""

    def error(record: Any, measured: Any) -> Any:
        return output.error(system, *split_record(system, record), measured)

    return jax.vmap(error)(records, measured)


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
def predicted_motion(
    model: OnlineModel, belief: Belief, controls: Any, measured: Any, deviations: tuple[Any, Any],
    output: Output,
) -> Predicted:  # fmt: skip
    """Return a motion under controls (T, c), with new columns for their uncertainty and parameters' drift.

    The new columns are T c for the controls, step by step, and n for the parameters. `measured` (T, p) are
    the measurements after each control; NaN: none. `deviations` are those of each control (c,), independent
    in each step, and of the drift of each parameter (n,).
    """
    of_control, of_drift = deviations
    spread = belief.spread
    (steps, c), m, n = controls.shape, len(spread.records), len(of_drift)
    count = steps * c

    def more(part: Any) -> Any:
        return jnp.concatenate([part, jnp.zeros((count + n, *part.shape[1:]))])

    drifts = jnp.concatenate([spread.parameters, jnp.zeros((count, n)), jnp.diag(of_drift)])
    wide = Spread(more(spread.records), more(spread.rate), drifts)
    noise = jnp.diag(jnp.tile(of_control, steps)).reshape(count, steps, c)
    d_controls = jnp.concatenate([jnp.zeros((m, steps, c)), noise, jnp.zeros((n, steps, c))])
    system, found = model.rollout(belief._replace(spread=wide), controls, d_controls)
    values = jax.vmap(lambda record: output.value(system, *split_record(system, record)))(found.records)
    errors = errors_of(system, output, found.records, measured)
    # where nothing was measured the derivatives are those at the prediction
    known = jnp.where(jnp.isnan(measured), values, measured)
    _, slopes = errors_along(system, output, found.records, found.d_records, known)
    return Predicted(found.past, found.records[-1], found.spread, values, errors, slopes, found.solved)


@functools.partial(jax.jit, static_argnames="output")
def motion_errors(
    model: OnlineModel, x: Float[Any, " n"], past: StateHistory, controls: Any, measured: Any, output: Output
) -> Float[Any, "T e"]:
    """Return the errors of the motion with these parameters; infinite after a failure."""
    system, steps = model.at(x), len(controls)
    done, _, rows = time_loop(system, model.settings, model.coefficients, controls, past, (0, steps))
    errors = errors_of(system, output, rows.records, measured)
    return jnp.where((jnp.arange(steps) < done)[:, None], errors, jnp.inf)


@functools.partial(jax.jit, static_argnames="output")
def measured_error(model: OnlineModel, x: Any, record: Any, measured: Any, output: Output) -> Any:
    """Return the error of a state's output from a measurement."""
    system = model.at(x)
    return output.error(system, *split_record(system, record), measured)
