"""Differences between simulated and measured poses of whole recordings, and their derivatives."""

from __future__ import annotations

import concurrent.futures
import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.identification.model import Model, ParametrisedRobot
from knode_cosserat.identification.steps import stepped, steps_per_row, time_scheme
from knode_cosserat.recordings.measurements import Measurements
from knode_cosserat.rods.load_cells import LoadCells
from knode_cosserat.rotation import conjugate, quaternion_product, since_first
from knode_cosserat.solvers.boundary import NewtonOptions
from knode_cosserat.solvers.evaluation import unloaded_shape
from knode_cosserat.solvers.places import Places, places_at, positions_at, quaternions_at
from knode_cosserat.solvers.replay import at_one_state
from knode_cosserat.solvers.run import Equilibria, TimeIntegration, run_one, usable_cores
from knode_cosserat.solvers.segments import DataError
from knode_cosserat.solvers.sensitivity import (
    SystemMoves,
    TangentState,
    static_tangents,
    tangent_time_loop,
)
from knode_cosserat.solvers.settings import Settings
from knode_cosserat.solvers.space import SpaceScheme
from knode_cosserat.solvers.steps import StepCoefficients

#: seconds that recovery of one simulation may take
RECOVERY = 0.5
#: a rotation counts as the displacement at this part of the length
ARM = 0.2


class RecordingData(NamedTuple):
    """One recording, ready to be compared with."""

    name: str
    dt: float
    #: tension before row 0 (c,), and held from each row to the next (T, c), in N
    initial_tension: Float[np.ndarray, " c"]
    tension: Float[np.ndarray, "T c"]
    places: Places
    #: positions (T + 1, M, 3) in m, and rotations since row 0 (T + 1, M, 4); NaN where nothing was seen
    position: Float[np.ndarray, "rows M 3"]
    rotation: Float[np.ndarray, "rows M 4"]
    #: the first row in motion
    moves: int
    #: true if each row is a separate equilibrium
    static: bool = False
    #: true if the tensions are continuous; time steps from row to row
    continuous: bool = False
    steps: int = 1


def data_of(given: Measurements, model: Model, name: str) -> RecordingData:
    """Return a recording's data.

    Raises:
        DataError: too short, unknown tensions, or another number of tendons than the robot has.
    """
    if len(given.time) < 3:
        raise DataError(f"{name}: {len(given.time)} rows; at least 3 are needed")
    if given.tension.shape[1] != model.nominal.control_size:
        raise DataError(
            f"{name}: {given.tension.shape[1]} tensions in a row; the robot has {model.nominal.control_size}"
        )
    if given.static:
        given = _as_steps(given)
    if not np.all(np.isfinite(given.tension[:-1])):
        row = int(np.flatnonzero(~np.isfinite(given.tension).all(axis=1))[0])
        raise DataError(
            f"{name}: no tension is known at {given.time[row]:g} s; use the part before (`parts`)"
        )
    if not np.any(np.isfinite(given.position[1:])):
        raise DataError(f"{name}: no position was seen after the first row")
    tension = given.tension[:-1]
    initial = tension[0] if given.initial_tension is None else given.initial_tension
    swing = np.max(np.abs(tension - initial), axis=1)
    moving = np.flatnonzero(swing > 0.05 * max(np.max(swing), 1e-12))
    return RecordingData(
        name, given.dt, np.asarray(initial), tension, places_at(given.fractions, model.nominal.nodes),
        given.position, np.asarray(since_first(given.quaternion)),
        int(moving[0]) if len(moving) and not given.static else 0, given.static, given.continuous,
        steps_per_row(given.dt, given.continuous),
    )  # fmt: skip


def _as_steps(given: Measurements) -> Measurements:
    """Return equilibria as rows of a motion: each row's own tension leads to it, the first one not seen."""

    def late(rows: np.ndarray) -> np.ndarray:
        return np.concatenate([np.full_like(rows[:1], np.nan), rows])

    return dataclasses.replace(
        given,
        tension=np.concatenate([given.tension, given.tension[-1:]]),
        position=late(given.position),
        quaternion=late(given.quaternion),
        initial_tension=given.tension[0],
    )


def turned_from(
    first: Float[np.ndarray, "M 4"], rotation: Float[np.ndarray, "T M 4"]
) -> Float[np.ndarray, "T M 4"]:
    """Return orientations from those in the first row, and rotations since then."""
    begun = jnp.broadcast_to(jnp.asarray(first), rotation.shape)
    return np.asarray(jax.vmap(jax.vmap(quaternion_product))(jnp.asarray(rotation), begun))


class Rollout(NamedTuple):
    """A simulated recording: differences of positions and rotations (rows, M, 6) in m, or none if it failed.

    NaN where nothing was measured. `derivatives` are by the coordinates (n, rows, M, 6).
    """

    values: Float[np.ndarray, "rows M 6"]
    derivatives: Float[np.ndarray, "n rows M 6"] | None


class Misfit:
    """Differences of simulations from recordings, by the coordinates of a model."""

    def __init__(self, model: Model, data: Sequence[RecordingData], space: str | SpaceScheme):
        self.model, self.data = model, tuple(data)
        #: settings of equilibria; those of a motion have the time scheme of its recording
        self.settings = Settings.of(None, space, "paper", NewtonOptions())
        self._first = True

    def differences(
        self, x: Float[np.ndarray, " n"], rows: int | None = None, which: Sequence[int] | None = None,
        derivatives: bool = True,
    ) -> list[Rollout | None]:  # fmt: skip
        """Return the rollouts of all recordings, or of those with the given numbers; None if one failed.

        Args:
            x: coordinates.
            rows: rows after the first in motion that are simulated; None: all.
            which: numbers of recordings.
            derivatives: compute them too.
        """
        chosen = [self.data[k] for k in (range(len(self.data)) if which is None else which)]

        def work(data: RecordingData) -> Rollout | None:
            return self._of_one(x, data, rows, derivatives)

        if self._first:  # programs are compiled one by one
            self._first = False
            return [work(data) for data in chosen]
        with concurrent.futures.ThreadPoolExecutor(usable_cores()) as pool:
            return list(pool.map(work, chosen))

    def _of_one(self, x: Any, data: RecordingData, rows: int | None, derivatives: bool) -> Rollout | None:
        x = np.asarray(x, dtype=float)
        seen = len(data.tension) if rows is None else min(len(data.tension), data.moves + rows)
        steps = seen * data.steps
        system = _system(self.model.robot, x)
        settings = dataclasses.replace(self.settings, time=time_scheme(data.dt, data.continuous))
        acting, slope = _acting(system, data)
        still = Equilibria(self.settings, 1, RECOVERY)
        held = data.initial_tension[None]
        first = run_one(still, system, held, unloaded_shape(system, settings.space), held[0])
        if first.cause:
            return None
        ny, count = system.y_layout.size, max(steps, 1)
        task: TimeIntegration | Equilibria = TimeIntegration(
            settings, data.dt / data.steps, count, recovery_budget=RECOVERY
        )
        if data.static:
            task, state = dataclasses.replace(still, steps=count), first.state
        else:
            record = first.rows.records[0][:, : ny + system.z_layout.size]
            state = at_one_state(system, settings, record, data.initial_tension)
        found, _, cause = run_one(task, system, acting, state, data.initial_tension)
        if cause:
            return None
        compared = slice(data.steps - 1, steps, data.steps)
        y = np.concatenate([first.rows.records[:1, :, :ny], found.records[compared, :, :ny]])
        if not derivatives:
            return Rollout(np.asarray(_compared(system, y, *self._target(data, seen))), None)
        directions, by_latency = _directions(self.model.robot, x)
        moves, none = SystemMoves(directions, np.eye(len(x))), np.zeros((*held.shape, len(x)))
        solved = first.rows.records, first.rows.unknowns
        d_first, _, d_records = static_tangents(self.settings, solved, (system, held), (moves, none))
        acting, changes = acting[:steps], (moves, slope[:steps, :, None] * np.asarray(by_latency))
        solved = tuple(each[: steps * settings.stages] for each in found.every_stage)
        if not steps:
            d_rows = d_first[:0]
        elif data.static:
            d_rows, _, _ = static_tangents(self.settings, solved, (system, acting), changes)
        else:
            both = np.stack([d_records] * 2)
            begun = TangentState.of(system, settings.space, state, both, np.zeros_like(both[0]))
            coefficients = StepCoefficients.of(settings, data.dt / data.steps)
            _, (d_solves, _) = tangent_time_loop(
                settings, coefficients, solved, (system, acting), changes, begun
            )
            d_rows = d_solves[settings.stages - 1 :: settings.stages][compared]
        d_y = np.concatenate([d_first, d_rows])[:, :, :ny]
        values, slopes = _with_slopes(system, y, d_y, *self._target(data, seen))
        return Rollout(np.asarray(values), np.asarray(slopes))

    def _target(self, data: RecordingData, steps: int) -> tuple[Any, ...]:
        return data.places, data.position[: steps + 1], data.rotation[: steps + 1]


def _cells(system: Any) -> LoadCells | None:
    """Return the load cells of a robot, also of one with a residual."""
    return getattr(system.nominal, "load_cells", None)


def _acting(system: Any, data: RecordingData) -> tuple[np.ndarray, np.ndarray]:
    """Return the tensions of all steps by the load cells' latency, and their derivative by it (N/s).

    The derivative is over one step: between steps it jumps, and at no latency it is of both sides.
    """
    dt = data.dt / data.steps
    tension = stepped(data.tension, data.initial_tension, data.steps, data.continuous)
    cells, half = _cells(system), 0.5 * dt
    if cells is None:
        return tension, np.zeros_like(tension)
    late, early, acting = (
        dataclasses.replace(cells, latency=np.asarray(cells.latency) + shift).undelayed(
            tension, dt, data.initial_tension
        )
        for shift in (half, -half, 0.0)
    )
    return acting, (late - early) / dt


@jax.jit
def _system(robot: ParametrisedRobot, x: Any) -> Any:
    return robot(x)


@jax.jit
def _directions(robot: ParametrisedRobot, x: Any) -> tuple[Any, Any]:
    """Return a system's tangents by each coordinate, stacked, and those of the load cells' latency (n,)."""

    def along(direction: Any) -> Any:
        d_system = jax.jvp(robot, (x,), (direction,))[1]
        cells = _cells(d_system)
        return d_system, jnp.zeros(()) if cells is None else cells.latency

    return jax.vmap(along)(jnp.eye(len(x)))


@jax.jit
def _compared(system: Any, y: Any, places: Places, position: Any, rotation: Any) -> Any:
    """Differences of positions (m), and of rotations since row 0 times an arm (m)."""
    seen = positions_at(system, y, places) - position
    h = quaternions_at(system, y, places)
    product = jax.vmap(jax.vmap(quaternion_product))
    inverse = jax.vmap(jax.vmap(conjugate))
    since = product(h, inverse(jnp.broadcast_to(h[:1], h.shape)))
    left = product(since, inverse(jnp.where(jnp.isnan(rotation), 1.0, rotation)))
    left = left * jnp.where(left[..., :1] < 0.0, -1.0, 1.0)
    turned = jnp.where(jnp.isnan(rotation[..., :1]), jnp.nan, 2.0 * ARM * system.length * left[..., 1:])
    return jnp.concatenate([seen, turned], axis=-1)


@jax.jit
def _with_slopes(system: Any, y: Any, d_y: Any, places: Places, position: Any, rotation: Any) -> Any:
    def compared(y: Any) -> Any:
        return _compared(system, y, places, position, rotation)

    return compared(y), jax.vmap(lambda d: jax.jvp(compared, (y,), (d,))[1], in_axes=-1)(d_y)
