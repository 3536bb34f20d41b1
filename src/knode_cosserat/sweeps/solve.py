"""Solution of the cases of a shard, in chunks of which only the stored quantities are kept.

Results do not depend on the number of threads or processes: chunks have a fixed size. Recovery has no limit
of time, for the same reason.
"""

from __future__ import annotations

import concurrent.futures
import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from knode_cosserat.rods.system import System
from knode_cosserat.rods.trained_range import without_range
from knode_cosserat.solvers.history import SolverState, rest_record
from knode_cosserat.solvers.initial import initial_state
from knode_cosserat.solvers.recovery import likely_cause
from knode_cosserat.solvers.replay import at_one_state, history_settings
from knode_cosserat.solvers.result import Result, SimulationError
from knode_cosserat.solvers.run import (
    InitialState,
    TimeIntegration,
    carried_results,
    run_one,
    usable_cores,
)
from knode_cosserat.solvers.settings import Settings
from knode_cosserat.sweeps.plan import Cases, Plan

#: robots that one call solves
CHUNK = 16
#: quantities that are functions of y
_OF_Y = ("tip_position", "tip_quaternion", "position")


class Start(NamedTuple):
    """Initial states of a chunk: y and z at the nodes, and the histories of the first step."""

    record: Any
    history: Any


class Settled(NamedTuple):
    """Initial states of a chunk that had to be solved for; see `_settled`."""

    start: Start | None
    #: COARSE where the grid was, otherwise CONVERGED
    result: Any
    #: by case, the reasons of equilibria that were not found
    reasons: dict[int, str]


@functools.partial(jax.jit, static_argnames=("settings", "size"))
def _started(robot, values, start, settings, size):  # type: ignore[no-untyped-def]
    """Return the systems of a chunk, or one for all, and their initial states; None: at rest."""
    systems = jax.vmap(lambda own: robot.replace(**own))(values) if values else robot
    if start is None:
        at = initial_state(systems, settings, size)
        start = Start(at.record, at.state.history)
    return systems, start


@functools.partial(jax.jit, static_argnames="store")
def _stored(systems, record, rows, store):  # type: ignore[no-untyped-def]
    """Return results, position errors and stored quantities of the rows of a chunk."""
    size = systems.y_layout.size + systems.z_layout.size
    records = jnp.concatenate([record[:, None, :, :size], rows.records[..., :size]], axis=1)
    none = jnp.zeros((len(record), 1))
    solved = jnp.concatenate([none.astype(int), rows.result], axis=1)
    errors = jnp.concatenate([none, rows.position_error], axis=1)
    records = jnp.where((solved < 0)[..., None, None], jnp.nan, records)
    return solved, jnp.where(solved < 0, jnp.nan, errors), stored_of(systems, records, store)


def stored_of(systems: System, records: Any, store: tuple[str, ...]) -> dict[str, Any]:
    """Return stored quantities of records (cases, rows, nodes, y and z) of one system or of as many."""
    ny = systems.y_layout.size
    y, z = records[..., :ny], records[..., ny:]
    known = {
        "tip_position": lambda one, y: one.drawing.positions(y[:, -1]),
        "tip_quaternion": lambda one, y: one.drawing.quaternions(y[:, -1]),
        "position": lambda one, y: one.drawing.positions(y),
    }
    axes = (0 if jnp.ndim(systems.length) else None, 0)
    found = {name: jax.vmap(known[name], in_axes=axes)(systems, y) for name in store if name in known}
    return found | {name: each for name, each in (("y", y), ("z", z)) if name in store}


class Solver:
    """Solver of a plan's shards."""

    def __init__(self, plan: Plan, threads: int | None = None):
        """Prepare a plan; by default with one thread for each core that this process may use."""
        self.plan = plan
        self.threads = threads or usable_cores()
        self._compiled: set[int] = set()

    def shard(self, number: int) -> dict[str, Any]:
        """Return the columns of a shard, by name."""
        plan = self.plan
        robot, _, _ = plan.span(number)
        cases = plan.cases(number)
        size = len(cases.case)
        firsts = range(0, size, CHUNK)

        def work(first: int) -> Any:
            return self._chunk(robot, cases, first)

        # JAX may crash if one thread stores a program on disk while another compiles it
        begun = [] if robot in self._compiled else [work(firsts[0])]
        self._compiled.add(robot)
        if self.threads == 1:
            parts = begun + [work(first) for first in firsts[len(begun) :]]
        else:
            with concurrent.futures.ThreadPoolExecutor(self.threads) as pool:
                parts = begun + list(pool.map(work, firsts[len(begun) :]))
        columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        if "controls" in plan.sweep.store:
            columns["controls"] = cases.controls
        single = plan.sweep.precision == "single"
        for name in plan.sweep.store:
            columns[name] = columns[name].astype(np.float32 if single else np.float64, copy=False)
        keys = {
            "case": cases.case,
            "robot": np.full(size, robot, dtype=np.int32),
            "word": cases.word.astype(np.int32),
            "seed": cases.seed,
        }
        return keys | cases.values | columns

    def _chunk(self, robot: int, cases: Cases, first: int) -> dict[str, Any]:
        """Return result, position error, reason and stored quantities of a chunk of cases."""
        plan, size = self.plan, len(cases.case)
        count = min(CHUNK, size - first)
        # the last chunk is filled with its last case: one shape, one program
        index = np.minimum(np.arange(first, first + CHUNK), size - 1)
        bare, settings, steps = _bare(plan, robot), plan.settings, plan.sweep.steps
        values = {name: each[index] for name, each in plan.robot_values(robot, cases.values).items()}
        settled = _settled(plan, robot, values, CHUNK)
        task = TimeIntegration(settings, plan.sweep.dt, steps)
        systems, start = _started(bare, values, settled.start, settings, CHUNK)
        done, _, rows = task.solve_many(systems, cases.controls[index], start.history)
        found = _stored(systems, start.record, rows, plan.sweep.store)
        result, error, stored = jax.tree.map(lambda leaf: np.array(leaf[:count]), found)
        columns = {"result": result, "position_error": error} | stored
        reasons = [""] * count
        for k in range(count):
            cause = cases.refused.get(first + k) or settled.reasons.get(k)
            if cause:
                _mark_unsolved(columns, k, 0)
                reasons[k] = cause
            elif done[k] < steps:
                own = {name: each[k] for name, each in values.items()}
                system = bare.replace(**own) if own else bare
                reasons[k] = self._failed(system, task, cases.controls[first + k], columns, k)
        result = columns["result"]
        marked = carried_results(result[:, 1:], settled.result[:count])
        columns["result"] = np.concatenate([result[:, :1], marked], axis=1).astype(np.int8)
        return columns | {"reason": np.array(reasons, dtype=object)}

    def _failed(
        self, system: System, task: TimeIntegration, controls: Any, columns: dict[str, Any], k: int
    ) -> str:
        """Return the reason of a failed case, after recovery if it is wanted; write its rows."""
        plan, result, cause = self.plan, columns["result"], ""
        if plan.sweep.recovery:
            cause = _recover(system, task, controls, plan.sweep.store, columns, k)
            if not cause:
                return ""
        step = int(np.argmax(result[k] < 0))
        code = Result(int(result[k, step]))
        cause = cause or likely_cause(code, system, plan.settings, controls[step - 1])
        return f"step {step} (t = {step * plan.sweep.dt:g} s): {code.message}. {cause}".strip()


@functools.lru_cache(maxsize=64)
def _bare(plan: Plan, robot: int) -> System:
    """Return a robot without the range of its training data, as the solvers' programs expect."""
    return without_range(plan.systems[robot])


def _mark_unsolved(columns: dict[str, Any], k: int, first: int) -> None:
    """Mark the rows of a case from one on as not solved."""
    for name, each in columns.items():
        if name == "result":
            each[k, first:] = int(Result.NOT_REACHED)
        elif name != "controls":
            each[k, first:] = np.nan


# initial states of robots whose rest is an equilibrium


def _settled(plan: Plan, robot: int, values: dict[str, Any], size: int) -> Settled:
    """Return the initial states of a chunk.

    A robot such as a platform on bent legs starts from its equilibrium under zero control. All others start
    from rest, which the chunk's program evaluates.
    """
    system, settings = _bare(plan, robot), plan.settings
    if not system.ends.rest_is_guess:
        return Settled(None, np.full(size, int(Result.CONVERGED)), {})
    found: list[InitialState | None] = []
    reasons: dict[int, str] = {}
    for k in range(size if values else 1):
        one = system.replace(**{name: each[k] for name, each in values.items()}) if values else system
        try:
            found.append(initial_state(one, settings, None, np.inf if plan.sweep.recovery else 0.0))
        except SimulationError as error:
            found.append(None)
            reasons[k] = str(error)
    # a failed case is marked as such: any state of the right shape serves
    good = next((each for each in found if each is not None), None) or _guessed(system, settings)
    every = [each or good for each in found]
    if not values:
        every, reasons = every * size, dict.fromkeys(range(size), reasons[0]) if reasons else {}
    pairs = [Start(each.record, each.state.history) for each in every]
    start = jax.tree.map(lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]), *pairs)
    result = np.array([int(each.result) for each in every])
    return Settled(start, result, reasons)


def _guessed(system: System, settings: Settings) -> InitialState:
    """Return the state at rest, though it is no equilibrium."""
    record, none = rest_record(system), np.zeros(system.control_size)
    history = at_one_state(system, history_settings(settings), record, none)
    return InitialState(record, none, SolverState(history), False)


# recovery


def _recover(
    system: System, task: TimeIntegration, controls: Any, store: tuple[str, ...], columns: dict[str, Any],
    k: int,
) -> str:  # fmt: skip
    """Solve a case by itself, with recovery of failed steps; write its rows and return the likely cause.

    Neither the recovery nor the pieces of the run depend on times.
    """
    task = dataclasses.replace(task, recovery_budget=np.inf)
    at = initial_state(system, task.settings, None, np.inf)
    rows, _, cause = run_one(task, system, controls, at.state.history, at.control, response=np.inf)
    size = system.y_layout.size + system.z_layout.size
    invalid = rows.result < 0
    records = np.concatenate([np.asarray(at.record)[None, :, :size], rows.records[..., :size]])
    records[1:][invalid] = np.nan
    columns["result"][k, 1:] = rows.result
    columns["position_error"][k, 1:] = np.where(invalid, np.nan, rows.position_error)
    for name, each in _stored_one(system, records, store).items():
        columns[name][k] = np.asarray(each)
    return cause


@functools.partial(jax.jit, static_argnames="store")
def _stored_one(system, records, store):  # type: ignore[no-untyped-def]
    return {name: each[0] for name, each in stored_of(system, records[None], store).items()}
