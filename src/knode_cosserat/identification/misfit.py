"""Differences between simulated and measured rows of experiments, and their derivatives.

Every solved step is differentiated by the implicit function theorem (`solvers.sensitivity`), and outputs as
in the online observers (`estimation.online.errors_along`), also by parameters such as places of bodies.
"""

from __future__ import annotations

import concurrent.futures
import copy
import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from knode_cosserat.engine.equations import with_moving
from knode_cosserat.estimation.online import errors_along, errors_of, sensitive
from knode_cosserat.estimation.outputs import Output
from knode_cosserat.estimation.parameters import Model, ParametrisedRobot
from knode_cosserat.identification.experiments import Experiment
from knode_cosserat.identification.steps import stepped
from knode_cosserat.rods.aspects import Ends
from knode_cosserat.rods.tendons import LoadCells
from knode_cosserat.rods.wrapped import nominal_model
from knode_cosserat.schemes.history import StateHistory, at_stages
from knode_cosserat.schemes.settings import Settings
from knode_cosserat.solvers.initial import continued_state, initial_state
from knode_cosserat.solvers.replay import at_one_state
from knode_cosserat.solvers.rest import constant_history, rest_record, resting_history
from knode_cosserat.solvers.run import TimeIntegration, run_one, usable_cores
from knode_cosserat.solvers.sensitivity import Changes, TangentState, static_tangents, tangent_time_loop
from knode_cosserat.solvers.static_run import static_run
from knode_cosserat.trajectory import Trajectory

#: number of points whose accurate differences are kept, and of those whose derivatives are
KEPT, DIFFERENTIATED = 8, 2
#: seconds that recovery of one simulation may take
RECOVERY = 0.5


class Rollout:
    """A simulated experiment: differences from its data in units of the noise; NaN where there are none.

    `offset` is what finer time steps add to the differences; it is part of the values. The `key` is that of a
    `Misfit`.
    """

    key: Any = None

    def __init__(
        self, values: Float[np.ndarray, "rows e"], tangents: Callable[[Any], np.ndarray], offset: Any = 0.0
    ):
        self.plain, self.values, self.offset, self._tangents = values, values + offset, offset, tangents
        #: derivatives by some coordinates (a mask, or a slice of all), shared by copies
        self._known: list[Any] = []

    def moved(self, offset: Any) -> Rollout:
        """Return it with another offset."""
        copied = copy.copy(self)
        copied.values, copied.offset = self.plain + offset, offset
        return copied

    def only(self, used: Bool[np.ndarray, "rows e"]) -> Rollout:
        """Return it with some of its differences."""
        copied = copy.copy(self)
        copied.values = np.where(used, self.values, np.nan)
        return copied

    @property
    def derivatives(self) -> Float[np.ndarray, "n rows e"]:
        """Derivatives of the differences by all coordinates."""
        return self.derivatives_by(slice(None))

    def derivatives_by(self, which: Any) -> Float[np.ndarray, "m rows e"]:
        """Return the derivatives by some coordinates, which take less time than all; the last are kept."""
        if self._known and isinstance(self._known[0], slice):
            return self._known[1][which]
        if not self._known or isinstance(which, slice) or np.any(which & ~self._known[0]):
            self._known[:] = which, self._tangents(which)
            return self._known[1]
        return self._known[1][which[self._known[0]]]


class _Start(NamedTuple):
    """Start of a simulation: record and history, and the tangents of both by the coordinates."""

    #: y and z at the nodes
    record: Float[Any, "N x"]
    #: history, or y at all points before a list of equilibria
    state: Any
    before: Any
    #: earlier states that the first step may use, as in `TimeIntegration`
    known: int
    sudden: bool
    #: of tangent systems and the weights of each in each tangent
    tangents: Callable[[Any, np.ndarray], tuple[Any, StateHistory, Any]]


class Misfit:
    """Differences of simulations from data, by the coordinates of a model."""

    def __init__(self, model: Model, data: Sequence[Experiment]):
        self.model, self.data = model, tuple(data)
        self._first = True
        self._known_columns: dict[Output, tuple[int, ...]] = {}
        #: accurate differences of the last points, by coordinates and number of the experiment
        self._accurate: dict[tuple[bytes, int], np.ndarray] = {}
        #: the last rollouts with derivatives, by coordinates, number of the experiment and rows
        self._differentiated: dict[tuple[bytes, int, int | None], Rollout] = {}
        # no value of a number, such as an effect that a robot lacks, needs machine code of its own
        directions, _ = _directions(model.robot, np.where(model.begin == 0.0, 0.1, model.begin))
        self._moving = jax.tree.map(lambda leaf: np.any(np.asarray(leaf) != 0.0, axis=0), directions)

    def system(self, x: Float[np.ndarray, " n"]) -> Any:
        """Return the robot at a point, with all effects: one machine code serves all points."""
        return jax.tree.map(with_moving, _system(self.model.robot, np.asarray(x, dtype=float)), self._moving)

    def differences(
        self, x: Float[np.ndarray, " n"], rows: int | None = None, which: Sequence[int] | None = None,
        offsets: Sequence[Any] | None = None,
    ) -> list[Rollout | None]:  # fmt: skip
        """Return the rollouts of all experiments, or of those with the given numbers; None if one failed.

        Args:
            x: coordinates.
            rows: rows after the first in motion that are simulated; None: all.
            which: numbers of experiments.
            offsets: of the differences of each rollout; None: zero.
        """
        at, chosen = np.asarray(x, dtype=float), range(len(self.data)) if which is None else which
        keys = [(at.tobytes(), k, rows) for k in chosen]
        found = self._parallel(
            lambda key: self._differentiated.get(key) or self._of_one(at, self.data[key[1]], rows), keys
        )
        for key, rollout in zip(keys, found, strict=True):
            if rollout is not None:
                rollout.key = key
        pairs = zip(found, offsets or [0.0] * len(found), strict=True)
        return [None if each is None else each.moved(offset) for each, offset in pairs]

    def whole(self, x: Float[np.ndarray, " n"], which: Sequence[int] | None = None) -> list[Rollout | None]:
        """Return the refined rollouts of whole experiments at a point; None if one failed."""
        return self.refined(self.differences(x, which=which), x, which)

    def refined(
        self, rollouts: Sequence[Rollout | None], x: Float[np.ndarray, " n"],
        which: Sequence[int] | None = None,
    ) -> list[Any]:  # fmt: skip
        """Return whole rollouts at a point with the differences of the accurate experiments, as an offset.

        Between continuous controls these are extrapolated from half the steps (Richardson), for schemes of
        order two. Derivatives are not refined. Held controls belong to the steps of their scheme.
        """
        at, chosen = np.asarray(x, dtype=float), range(len(self.data)) if which is None else which
        targets = {
            k: self.data[k].accurate or self.data[k]
            for k, rollout in zip(chosen, rollouts, strict=True)
            if rollout is not None and (at.tobytes(), k) not in self._accurate
        }
        resolved = [k for k, target in targets.items() if target.is_resolved]
        # the longest ones first
        wanted = [(k, 2) for k in resolved]
        wanted += [(k, 1) for k, target in targets.items() if target is not self.data[k]]

        def solved(part: tuple[int, int]) -> np.ndarray | None:
            target = targets[part[0]]
            rollout = self._of_one(at, target.replace(steps=part[1] * target.steps), None)
            return None if rollout is None else rollout.values

        found = dict(zip(wanted, self._parallel(solved, wanted), strict=True))
        refined = list[Any]()
        for k, rollout in zip(chosen, rollouts, strict=True):
            if rollout is not None and k in targets:
                values, finer = found.get((k, 1), rollout.plain), found.get((k, 2))
                if values is not None and finer is not None:
                    values = (4.0 * finer - values) / 3.0
                if values is not None and (finer is not None or k not in resolved):
                    self._accurate[at.tobytes(), k] = values
            values = self._accurate.get((at.tobytes(), k))
            if rollout is not None and values is not None:
                rollout = rollout.moved(values - rollout.plain)
            refined.append(rollout)
        self._accurate = dict([*self._accurate.items()][-KEPT * len(self.data) :])
        return refined

    def differentiated(
        self, rollouts: Sequence[Rollout], which: Bool[np.ndarray, " n"] | None = None
    ) -> None:
        """Compute the derivatives of all rollouts, by some coordinates or by all."""
        self._parallel(lambda it: it.derivatives_by(slice(None) if which is None else which), rollouts)
        self._first = False
        new = {it.key: it.moved(0.0) for it in rollouts}
        kept = {key: it for key, it in self._differentiated.items() if key not in new} | new
        self._differentiated = dict([*kept.items()][-DIFFERENTIATED * len(self.data) :])

    def _parallel(self, work: Any, items: Sequence[Any]) -> list[Any]:
        if self._first:  # programs are compiled one by one
            return [work(item) for item in items]
        with concurrent.futures.ThreadPoolExecutor(usable_cores()) as pool:
            return list(pool.map(work, items))

    def _of_one(self, x: np.ndarray, data: Experiment, rows: int | None) -> Rollout | None:
        seen = len(data.control) if rows is None else min(len(data.control), data.moves + rows)
        steps = seen * data.steps
        system = self.system(x)
        start = self._start(system, x, data)
        if start is None:
            return None
        acting, slope = _acting(system, data)
        # a search does not read the errors of its motions
        settings = dataclasses.replace(data.settings, errors=False)
        task: Any = TimeIntegration(settings, data.dt / data.steps, max(steps, 1), start.known, RECOVERY)
        if data.static:
            task = dataclasses.replace(task, settings=dataclasses.replace(settings, time=None), dt=0.0)
        else:
            acting = at_stages(system, data.settings, acting, start.before[None], start.sudden)
        solved_rows, _, cause = run_one(task, system, acting, (start.state, start.before), watch=None)
        if cause:
            return None
        size = system.y_layout.size + system.z_layout.size
        compared = slice(data.steps - 1, steps, data.steps)
        records = np.concatenate([start.record[None], solved_rows.records[compared, :, :size]])

        # outputs of all rows, a quarter, or a sixteenth: few compiled programs serve all horizons
        sizes = (-(-len(data.data) // part) for part in (1, 4, 16))
        count = min(size for size in sizes if size >= len(records))
        seen_data = data.data[:count]

        def filled(rows: np.ndarray) -> np.ndarray:
            return np.concatenate([rows, np.repeat(rows[-1:], count - len(rows), axis=0)])

        noise, stages = data.noise, 1 if data.static else data.settings.stages

        def tangents(which: Any) -> np.ndarray:
            directions, by_latency = _directions(self.model.robot, x)
            directions = jax.tree.map(with_moving, directions, self._moving)
            weights = np.eye(len(x))[:, which]
            d_first, past, d_past = start.tangents(directions, weights)
            controls = acting[:steps]
            d_controls = np.zeros((*controls.shape, weights.shape[1]))
            if slope is not None:
                d_controls = slope[:steps, :, None] * np.asarray(by_latency)[which]
            at, columns = (system, controls), self._columns(system, data.output, filled(records), seen_data)
            used = np.isin(np.arange(records[0].size), columns).reshape(records[0].shape)
            changes = Changes(d_controls, directions, weights, kept=used)
            solved = tuple(part[: steps * stages] for part in solved_rows.every_stage)
            if data.static:
                d_rows = static_tangents(task.settings, solved, at, changes)[0]
            else:
                state = TangentState.of(system, data.settings.space, past, *d_past)
                d_rows = tangent_time_loop(task.coefficients, solved, at, changes, state)[1][0]
            # zeros in all other columns: one compiled program serves any coordinates
            whole = np.zeros((len(records), len(columns), len(x)))
            whole[:1, :, which] = d_first[None, :, :size][:, used]
            whole[1:, :, which] = d_rows[stages - 1 :: stages][compared]
            _, slopes = errors_along(
                system, data.output, filled(records), filled(whole), seen_data, directions, columns
            )
            return np.asarray(slopes)[which, : len(records)] / noise

        errors = np.asarray(errors_of(system, data.output, filled(records), seen_data))
        return Rollout(errors[: len(records)] / noise, tangents)

    def _columns(
        self, system: Any, output: Output, records: np.ndarray, measured: np.ndarray
    ) -> tuple[int, ...]:
        """Return the numbers of a record (N * x) on which an output depends, now or before."""
        known = self._known_columns.get(output, ())
        found = np.flatnonzero(sensitive(system, output, records, measured))
        # another thread may replace what is kept
        columns = tuple(np.union1d(found, known).astype(int).tolist())
        self._known_columns[output] = columns
        return columns

    def _start(self, system: Any, x: np.ndarray, data: Experiment) -> _Start | None:
        """Return the start of an experiment; None if there is no equilibrium."""
        settings, size = data.settings, system.y_layout.size + system.z_layout.size
        named = not isinstance(data.initial, Trajectory)
        if data.held is None and not (named and Ends.of(system).rest_is_guess):
            return self._moving_start(system, x, data)
        control = (
            np.zeros(system.control_layout.size) if data.held is None else np.asarray(data.held, dtype=float)
        )
        still = dataclasses.replace(settings, time=None)
        rest, y, cause = static_run(TimeIntegration(still, recovery_budget=RECOVERY), system, control[None])
        if cause:
            return None
        record = np.asarray(rest.records[0][:, :size])
        past = None if data.static else at_one_state(system, settings, record, control)

        def tangents(directions: Any, weights: np.ndarray) -> Any:
            held, solved = control[None], (rest.records, rest.unknowns)
            changes = Changes(np.zeros((*held.shape, weights.shape[1])), directions, weights)
            d_rows, _, d_records = static_tangents(still, solved, (system, held), changes)
            return d_rows[0], past, (np.stack([d_records] * data.settings.memory), np.zeros_like(d_records))

        return _Start(record, y if data.static else past, control, 1, True, tangents)

    def _moving_start(self, system: Any, x: np.ndarray, data: Experiment) -> _Start:
        """Return the start in the unstressed state, or from given rows."""
        settings = data.settings
        if not isinstance(data.initial, Trajectory):
            at_start, rows = initial_state(system, settings), None
        else:
            at_start = continued_state(system, data.initial, settings, data.dt)
            # a control acts on the history only where that is one state
            one_state = at_start.state.known(settings) == 1
            rows = (at_start.record, at_start.control) if one_state else (at_start.record,)
        known, past = at_start.state.known(settings), at_start.state.history
        record = np.asarray(at_start.record)[:, : system.y_layout.size + system.z_layout.size]

        def tangents(directions: Any, weights: np.ndarray) -> Any:
            begun, d_record, d_past = _begun(self.model.robot, x, rows, past, settings)
            return np.asarray(d_record) @ weights, begun, tuple(np.asarray(part) @ weights for part in d_past)

        return _Start(record, past, np.asarray(at_start.control), known, at_start.state.dt is None, tangents)


def _cells(system: Any) -> LoadCells | None:
    """Return the load cells of a robot, also of one with a residual."""
    return getattr(nominal_model(system), "load_cells", None)


def _acting(system: Any, data: Experiment) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the controls of all steps by the load cells' latency, and their derivative by it (N/s).

    The derivative is a central difference over one step, because it jumps between steps.
    """
    cells, dt = _cells(system), data.dt / data.steps
    before = data.control[0] if data.held is None else data.held
    control = stepped(data.control, before, data.steps, data.continuous)
    if cells is None or not data.readings:
        return control, None
    late, early, acting = (
        dataclasses.replace(cells, latency=np.asarray(cells.latency) + shift).undelayed(
            control, dt, data.held
        )
        for shift in (0.5 * dt, -0.5 * dt, 0.0)
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


@functools.partial(jax.jit, static_argnames="settings")
def _begun(robot: ParametrisedRobot, x: Any, rows: Any, past: Any, settings: Settings) -> Any:
    """Return the history of an unstressed robot or of rows, and tangents of record and history.

    `rows` are the record of the last row and, if it is the whole history, its control; None: unstressed.
    """

    def begun(x: Any) -> Any:
        system = robot(x)
        if rows is None:
            return rest_record(system), resting_history(system, settings)
        if system.mixed and len(rows) == 2:
            return rows[0], constant_history(system, settings, *rows, past.t0)
        return rows[0], past

    def along(direction: Any) -> Any:
        (_, start), (d_record, d_past) = jax.jvp(begun, (x,), (direction,))
        return start, d_record, (d_past.records, d_past.rate)

    return jax.vmap(along, out_axes=(None, -1, -1))(jnp.eye(x.shape[0]))
