"""Solution of the cases of a shard, in chunks of which only the stored quantities are kept.

Results do not depend on the number of threads or processes: chunks have a fixed size. Recovery has no limit
of time, for the same reason.
"""

from __future__ import annotations

import concurrent.futures
import dataclasses
import functools
import threading
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from knode_cosserat.rods.aspects import Drawing, Ends
from knode_cosserat.rods.parameters import parameter_at
from knode_cosserat.rods.passport import without_passport
from knode_cosserat.rods.system import System
from knode_cosserat.rods.wrapped import nominal_model
from knode_cosserat.schemes.history import SolverState
from knode_cosserat.schemes.result import Result, SimulationError
from knode_cosserat.solvers.initial import initial_state, start_of
from knode_cosserat.solvers.recovery import likely_cause
from knode_cosserat.solvers.replay import at_one_state, history_settings
from knode_cosserat.solvers.rest import rest_record
from knode_cosserat.solvers.run import (
    InitialState,
    TimeIntegration,
    carried_results,
    refuse_far_turns,
    run_one,
    usable_cores,
)
from knode_cosserat.sweeps._plan import Cases, Plan

#: robots that one call solves
CHUNK = 16

#: JAX may crash if one thread stores a program on disk while another compiles it
_COMPILING = threading.Lock()


@functools.partial(jax.jit, static_argnames=("settings", "size"))
def _started(robot, values, start, settings, size):  # type: ignore[no-untyped-def]
    """Return the systems of a chunk, or one for all, with initial records and histories; None: at rest."""
    systems = jax.vmap(lambda changes: robot.replace(**changes))(values) if values else robot
    if start is None:
        at = initial_state(systems, settings, size)
        start = at.record, at.state.history
    return systems, *start


@functools.partial(jax.jit, static_argnames="store")
def _stored(systems, record, rows, store):  # type: ignore[no-untyped-def]
    """Return results, position errors and stored quantities of all rows of a chunk."""
    ny = systems.y_layout.size
    size = ny + systems.z_layout.size
    records = jnp.concatenate([record[:, None, :, :size], rows.records[..., :size]], axis=1)
    zero = jnp.zeros((len(record), 1))
    solved = jnp.concatenate([zero.astype(int), rows.result], axis=1)
    errors = jnp.concatenate([zero, rows.position_error], axis=1)
    records = jnp.where((solved < 0)[..., None, None], jnp.nan, records)
    y = records[..., :ny]
    functions = {
        "tip_position": lambda system, y: Drawing.of(system).positions(y[:, -1]),
        "tip_quaternion": lambda system, y: Drawing.of(system).quaternions(y[:, -1]),
        "position": lambda system, y: Drawing.of(system).positions(y),
        "y": lambda _, y: y,
    }
    axes = (0 if jnp.ndim(systems.length) else None, 0)
    stored = {
        name: jax.vmap(functions[name], in_axes=axes)(systems, y) for name in store if name in functions
    }
    stored |= {"z": records[..., ny:]} if "z" in store else {}
    return {"result": solved, "position_error": jnp.where(solved < 0, jnp.nan, errors)} | stored


def solve_shard(plan: Plan, number: int, threads: int | None = None) -> dict[str, Any]:
    """Return the columns of a shard, by name; by default with one thread for each usable core."""
    robot, cases = plan.span(number)[0], plan.cases(number)
    size, threads = len(cases.case), threads or usable_cores()
    with _COMPILING:
        parts = [_chunk(plan, robot, cases, 0)]
    firsts = range(CHUNK, size, CHUNK)
    with concurrent.futures.ThreadPoolExecutor(threads) as pool:
        chunks = map if threads == 1 else pool.map
        parts += chunks(lambda first: _chunk(plan, robot, cases, first), firsts)
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    if "controls" in plan.sweep.store:
        columns["controls"] = cases.controls
    for name in plan.sweep.store:
        kind = np.float32 if plan.sweep.precision == "single" else np.float64
        columns[name] = columns[name].astype(kind, copy=False)
    return {
        "case": cases.case,
        "robot": np.full(size, robot, dtype=np.int32),
        "word": cases.word.astype(np.int32),
        "seed": cases.seed,
        **cases.values,
        **columns,
    }


def _chunk(plan: Plan, robot: int, cases: Cases, first: int) -> dict[str, Any]:
    """Return result, position error, reason and stored quantities of a chunk of cases."""
    system, settings, steps = _solved_system(plan, robot), plan.settings, plan.sweep.steps
    count = min(CHUNK, len(cases.case) - first)
    # the last chunk is filled with its last case: one shape, one program
    index = np.minimum(np.arange(first, first + CHUNK), len(cases.case) - 1)
    nominal = nominal_model(plan.systems[robot])
    values = {name: array[index] for name, array in cases.values.items() if parameter_at(nominal, name)}
    start, marks, reasons = _equilibria(plan, system, values)
    task = TimeIntegration(settings, plan.sweep.dt, steps)
    systems, record, history = _started(system, values, start, settings, CHUNK)
    _, _, rows = task.solve(systems, cases.controls[index], history)
    zero = np.zeros((CHUNK, system.control_layout.size))
    rows = rows._replace(result=refuse_far_turns(system, rows.result, cases.controls[index], zero))
    stored = _stored(systems, record, rows, plan.sweep.store)
    columns: dict[str, Any] = jax.tree.map(lambda leaf: np.array(leaf[:count]), stored)
    for k in range(count):
        if cause := cases.refused.get(first + k) or reasons.get(k):
            reasons[k] = cause
            for name, column in columns.items():
                column[k] = int(Result.NOT_REACHED) if name == "result" else np.nan
        elif np.any(columns["result"][k] < 0):
            case = system.replace(**{name: array[k] for name, array in values.items()}) if values else system
            rows_of_case = {name: column[k] for name, column in columns.items()}
            reasons[k] = _failed(plan, case, task, cases.controls[first + k], rows_of_case)
    result = columns["result"]
    carried = carried_results(result[:, 1:], marks[:count])
    columns["result"] = np.concatenate([result[:, :1], carried], axis=1).astype(np.int8)
    return columns | {"reason": np.array([reasons.get(k, "") for k in range(count)], dtype=object)}


@functools.lru_cache(maxsize=64)
def _solved_system(plan: Plan, robot: int) -> System:
    """Return a robot without the range of its training data, as the solvers' programs expect."""
    return without_passport(plan.systems[robot])


def _equilibria(plan: Plan, system: System, values: dict[str, Any]) -> tuple[Any, Any, dict[int, str]]:
    """Return records and histories at the start of a chunk, result codes, and by case reasons of failures.

    The unstressed state (None) is evaluated by the chunk's program.
    """
    if plan.sweep.initial == "unstressed" and not Ends.of(system).rest_is_guess:
        return None, np.full(CHUNK, int(Result.CONVERGED)), {}
    states: list[InitialState | None] = []
    reasons: dict[int, str] = {}
    for k in range(CHUNK if values else 1):
        case = system.replace(**{name: array[k] for name, array in values.items()}) if values else system
        try:
            budget = np.inf if plan.sweep.recovery else 0.0
            states.append(start_of(case, plan.sweep.initial, plan.settings, plan.sweep.dt, None, budget))
        except SimulationError as error:
            states.append(None)
            reasons[k] = str(error)
    solved = next((state for state in states if state is not None), None)
    if solved is None:
        # a failed case is marked as such: any state of the right shape serves
        record, zero = rest_record(system), np.zeros(system.control_layout.size)
        history = at_one_state(system, history_settings(plan.settings), record, zero)
        solved = InitialState(record, zero, SolverState(history), False)
    usable = [state or solved for state in states]
    if not values:
        usable, reasons = usable * CHUNK, dict.fromkeys(range(CHUNK), reasons[0]) if reasons else {}
    pairs = [(state.record, state.state.history) for state in usable]
    start = jax.tree.map(lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]), *pairs)
    return start, np.array([int(state.result) for state in usable]), reasons


def _failed(
    plan: Plan, system: System, task: TimeIntegration, controls: Any, stored: dict[str, np.ndarray]
) -> str:
    """Return the reason of a failed case, empty after recovery if that is wanted; write into its stored rows.

    Neither the recovery nor the pieces of the run depend on times.
    """
    cause = ""
    if plan.sweep.recovery:
        at = start_of(system, plan.sweep.initial, task.settings, task.dt, None, np.inf)
        task = dataclasses.replace(task, recovery_budget=np.inf)
        rows, _, cause = run_one(task, system, controls, (at.state.history, at.control), watch=None)
        record, rows = jax.tree.map(lambda leaf: np.asarray(leaf)[None], (at.record, rows))
        for name, column in _stored(system, record, rows, plan.sweep.store).items():
            stored[name][...] = np.asarray(column[0])
        if not cause:
            return ""
    step = int(np.argmax(stored["result"] < 0))
    code = Result(int(stored["result"][step]))
    cause = cause or likely_cause(code, system, plan.settings, controls[step - 1])
    return f"step {step} (t = {step * plan.sweep.dt:g} s): {code.message}. {cause}".strip()
