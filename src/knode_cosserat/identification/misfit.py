"""Differences between simulated and measured rows of experiments, and their derivatives.

Motions and their derivatives come from `solvers.tangent_motion`; outputs are differentiated as in the online
observers (`estimation.online.errors_along`), also by parameters such as places of bodies.
"""

from __future__ import annotations

import concurrent.futures
import copy
import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from knode_cosserat.engine.equations import with_moving
from knode_cosserat.estimation.online import errors_along, errors_of, sensitive
from knode_cosserat.estimation.outputs import Output
from knode_cosserat.estimation.parameters import ParameterModel, ParametrisedRobot
from knode_cosserat.identification.effects import clock_of
from knode_cosserat.identification.experiments import Experiment
from knode_cosserat.identification.steps import stepped
from knode_cosserat.rods.tendons import LoadCells, rows_later
from knode_cosserat.rods.wrapped import nominal_model
from knode_cosserat.solvers.run import TimeIntegration, usable_cores
from knode_cosserat.solvers.tangent_motion import start_at, tangent_motion

#: number of points whose accurate differences are kept, and of those whose derivatives are
KEPT, DIFFERENTIATED = 8, 2
#: seconds that recovery of one simulation may take
RECOVERY = 0.5
#: an equilibrium that is not found counts as a difference of this part of the length
LOST = 0.2


class Rollout:
    """A simulated experiment: differences from its data in units of the noise; NaN where there are none.

    `offset` is what finer time steps add to the differences; it is part of the values. The `key` is that of a
    `Misfit`: coordinates, number of the experiment, and rows.
    """

    key: Any = None

    def __init__(
        self,
        data: Experiment,
        values: Float[np.ndarray, "rows e"],
        tangents: Callable[[Any], np.ndarray],
    ):
        self.data, self.plain, self.values, self._tangents = data, values, values, tangents
        self.offset: Any = 0.0
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


class Misfit:
    """Differences of simulations from data, by the coordinates of a model."""

    def __init__(self, model: ParameterModel, data: Sequence[Experiment]):
        self.model, self.data = model, tuple(data)
        #: coordinate of the clocks of each recording where they are in doubt, by its name
        self._clocks = {
            it.name: model.slice(clock_of(it.name)).start
            for it in self.data
            if clock_of(it.name) in model.names
        }
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
        self,
        x: Float[np.ndarray, " n"],
        rows: int | None = None,
        which: Sequence[int] | None = None,
        offsets: Sequence[Any] | None = None,
    ) -> list[Rollout | None]:
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
        return self.refined(self.differences(x, which=which), x)

    def refined(self, rollouts: Sequence[Rollout | None], x: Float[np.ndarray, " n"]) -> list[Any]:
        """Return whole rollouts at a point with the differences of the accurate experiments, as an offset.

        Between continuous controls these are extrapolated from half the steps (Richardson), for schemes of
        order two. Derivatives are not refined. Held controls belong to the steps of their scheme.
        """
        at = np.asarray(x, dtype=float)
        new = {it.key[:2]: it.data for it in rollouts if it and it.key[:2] not in self._accurate}
        targets = {key: data.accurate or data for key, data in new.items()}
        # the longest ones first
        wanted = [(key, 2) for key, target in targets.items() if target.is_resolved]
        wanted += [(key, 1) for key, target in targets.items() if target is not new[key]]

        def solved(part: tuple[Any, int]) -> np.ndarray | None:
            target = targets[part[0]]
            rollout = self._of_one(at, target.replace(steps=part[1] * target.steps), None)
            return None if rollout is None else rollout.values

        found = dict(zip(wanted, self._parallel(solved, wanted), strict=True))
        refined = list[Any]()
        for rollout in rollouts:
            if rollout is None:
                refined.append(None)
                continue
            key = rollout.key[:2]
            if key in targets:
                values, finer = found.get((key, 1), rollout.plain), found.get((key, 2))
                if values is not None and finer is not None:
                    values = (4.0 * finer - values) / 3.0
                if values is not None and (finer is not None or not targets[key].is_resolved):
                    self._accurate[key] = values
            values = self._accurate.get(key)
            refined.append(rollout if values is None else rollout.moved(values - rollout.plain))
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

    def errors(
        self,
        x: Float[np.ndarray, " n"],
        which: Sequence[int] | None = None,
        after: int | None = None,
    ) -> list[float | None]:
        """Return the root mean square error of the last body's position (m), by experiment.

        Where no positions were measured it is that of all differences; None: there is no motion. It is that
        of the rows `after` so many in motion, or of all.
        """
        errors: list[float | None] = []
        for rollout in self.whole(x, which):
            if rollout is None:
                errors.append(None)
                continue
            places = rollout.data.positions(rollout.values * rollout.data.noise)
            squares = rollout.values**2 if places is None else np.sum(places[:, -1] ** 2, axis=-1)
            squares = squares[0 if after is None else rollout.data.moves + after + 1 :]
            errors.append(float(np.sqrt(np.nanmean(squares))) if np.isfinite(squares).any() else None)
        return errors

    def tip_errors(self, x: Float[np.ndarray, " n"]) -> dict[str, float | None]:
        """Return the error of each experiment by its name; None where no positions were measured."""
        pairs = zip(self.data, self.errors(x), strict=True)
        return {it.name: None if it.positions(it.data) is None else error for it, error in pairs}

    def _parallel(self, work: Any, items: Sequence[Any]) -> list[Any]:
        if self._first:  # programs are compiled one by one
            return [work(item) for item in items]
        with concurrent.futures.ThreadPoolExecutor(usable_cores()) as pool:
            return list(pool.map(work, items))

    def _of_one(self, x: np.ndarray, data: Experiment, rows: int | None) -> Rollout | None:
        seen = len(data.control) if rows is None else min(len(data.control), data.moves + rows)
        system, robot = self.system(x), self.model.robot
        settings = dataclasses.replace(data.settings, time=None) if data.static else data.settings
        # equilibria are sought in batches only: a search does not depend on the machine's speed
        task = TimeIntegration(
            settings,
            0.0 if data.static else data.dt / data.steps,
            recovery_budget=0.0 if data.static else RECOVERY,
        )
        start = start_at(robot, x, system, task, data.held, data.initial)
        if start is None:
            return None
        late, clock = None, self._clocks.get(data.name)
        if clock is not None:
            late = self.model.numbers[clock].value(x[clock])
        acting, slope = _acting(system, data, late)
        motion = tangent_motion(task, system, start, acting, seen * data.steps)
        if motion is None:
            return None
        # outputs of all rows, a quarter, or a sixteenth: few compiled programs serve all horizons
        records = motion.records[:: data.steps]
        sizes = (-(-len(data.data) // part) for part in (1, 4, 16))
        count = min(size for size in sizes if size >= len(records))
        seen_data, noise = data.data[:count], data.noise

        def filled(rows: np.ndarray) -> np.ndarray:
            return np.concatenate([rows, np.repeat(rows[-1:], count - len(rows), axis=0)])

        def tangents(which: Any) -> np.ndarray:
            directions, by_latency = _directions(robot, x)
            directions = jax.tree.map(with_moving, directions, self._moving)
            weights = np.eye(len(x))[:, which]
            d_controls = np.zeros((*motion.controls.shape, weights.shape[1]))
            if slope is not None:
                by_late = np.array(by_latency)
                if clock is not None:
                    by_late[clock] = self.model.numbers[clock].width
                d_controls = slope[: len(d_controls), :, None] * by_late[which]
            columns = self._columns(system, data.output, filled(records), seen_data)
            kept = np.isin(np.arange(records[0].size), columns).reshape(records[0].shape)
            # zeros in all other columns: one compiled program serves any coordinates
            d_records = np.zeros((len(records), len(columns), len(x)))
            d_records[:, :, which] = motion.tangents(directions, weights, d_controls, kept)[:: data.steps]
            _, slopes = errors_along(
                system, data.output, filled(records), filled(d_records), seen_data, directions, columns
            )
            slopes = np.array(slopes[:, : len(records)])[which] / noise
            slopes[:, lost] = 0.0
            return slopes

        lost = np.zeros(len(records), bool) if motion.missing is None else motion.missing
        errors = np.array(errors_of(system, data.output, filled(records), seen_data))[: len(records)] / noise
        off = LOST * float(np.asarray(self.model.nominal.length))
        errors[lost] = np.where(np.isfinite(errors[lost]), off, np.nan)
        return Rollout(data, errors, tangents)

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


def _cells(system: Any) -> LoadCells | None:
    """Return the load cells of a robot, also of one with a residual."""
    return getattr(nominal_model(system), "load_cells", None)


def _acting(system: Any, data: Experiment, late: float | None) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the controls of all steps by a recording's latency, and their derivative by it (N/s).

    It is that of the load cells, and of the files' clocks if they are in doubt. The derivative is a central
    difference over one step, because it jumps between steps.
    """
    cells, dt = _cells(system), data.dt / data.steps
    before = data.control[0] if data.held is None else data.held
    control = stepped(data.control, before, data.steps, data.continuous)
    if not data.readings or (cells is None and late is None):
        return control, None
    latency = (late or 0.0) + (0.0 if cells is None else float(np.asarray(cells.latency)))
    after, earlier, acting = (
        rows_later(control, latency + shift, dt, data.held) for shift in (0.5 * dt, -0.5 * dt, 0.0)
    )
    return acting, (after - earlier) / dt


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
