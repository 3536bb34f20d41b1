"""Simulations and equilibria inside JAX's transformations: primitives that run in the engine.

Three primitives solve all steps, and map tangents of their data to those of their results, and cotangents
back. They run in the engine, by callbacks with NumPy only.

Arrays of a primitive have robots as first axis, and tangents columns as second axis. One system for all
robots has one entry there. A batch of tangents of the same robots is more columns.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from knode_cosserat.engine.loops import at_all_stages, core_of, table_of, tangents_for
from knode_cosserat.engine.motions import Motions, StaticState
from knode_cosserat.engine.pattern import Pattern
from knode_cosserat.engine.program import EngineError
from knode_cosserat.engine.tangents import CotangentCore, SolvedSteps, TangentCore
from knode_cosserat.rods.system import System
from knode_cosserat.schemes.history import StateHistory, StepRows, no_rows, used_places
from knode_cosserat.schemes.problem import no_history
from knode_cosserat.solvers.run import TimeIntegration

Arrays = Sequence[Any]


@dataclasses.dataclass(frozen=True)
class Solves:
    """All that the code of a primitive depends on, but for the shapes of its arrays."""

    task: TimeIntegration
    pattern: Pattern
    #: true for leaves of the system that have tangents
    moving: tuple[bool, ...] = ()

    @property
    def leaves(self) -> int:
        """Number of arrays of a system."""
        return len(self.pattern.zeros)

    def moved(self, leaves: Arrays) -> list[Any]:
        """Return the leaves that have tangents."""
        return [leaf for leaf, moves in zip(leaves, self.moving, strict=True) if moves]


def _primitive(
    name: str, shapes: Callable[..., Any], core: Callable[..., Any], run: Callable[..., Any]
) -> Primitive:
    """Return a primitive with results of some shapes.

    `core` compiles code for the operands, before the program runs; `run` evaluates results by it.
    """
    primitive = Primitive(name)
    primitive.multiple_results = True

    @functools.lru_cache(maxsize=64)
    def compiled(spec: Solves) -> Callable[..., Any]:
        return jax.jit(functools.partial(primitive.bind, spec=spec))

    @primitive.def_impl
    def evaluate(*operands: Any, spec: Solves) -> Any:
        return compiled(spec)(*operands)

    @primitive.def_abstract_eval
    def abstract(*operands: Any, spec: Solves) -> Any:
        return [jax.core.ShapedArray(each.shape, each.dtype) for each in shapes(spec, *operands)]

    def lower(ctx: Any, *operands: Any, spec: Solves) -> Any:
        code = core(spec, *ctx.avals_in)

        def call(*arrays: np.ndarray) -> tuple[np.ndarray, ...]:
            results = run(code, spec, *arrays)
            return tuple(
                np.asarray(each, aval.dtype) for each, aval in zip(results, ctx.avals_out, strict=True)
            )

        results, _, _ = mlir.emit_python_callback(
            ctx, call, None, list(operands), ctx.avals_in, ctx.avals_out, has_side_effect=False
        )
        return results

    mlir.register_lowering(primitive, lower)
    return primitive


def _batch_first(x: Any, axis: Any, size: int) -> Any:
    """Return an array with its batch as first axis, which it may not have."""
    if axis is None:
        return jnp.broadcast_to(x, (size, *np.shape(x)))
    return jnp.moveaxis(x, axis, 0)


def _join(x: Any, robots: int) -> Any:
    """Return an array (batch, robots or 1, ...) with one axis for both."""
    size = x.shape[0]
    return jnp.broadcast_to(x, (size, robots, *x.shape[2:])).reshape(size * robots, *x.shape[2:])


def _divide(x: Any, robots: int) -> Any:
    """Return an array with its first axis divided into a batch and robots."""
    return x.reshape(x.shape[0] // robots, robots, *x.shape[1:])


def _as_robots(spec: Solves, operands: Arrays, axes: Arrays, robots: int) -> list[Any]:
    """Return operands of a batch of robots; a system that is one for all remains one."""
    size = next(np.shape(x)[axis] for x, axis in zip(operands, axes, strict=True) if axis is not None)
    shared = all(
        axis is None and x.shape[0] == 1 for x, axis in zip(operands, axes[: spec.leaves], strict=False)
    )
    return [
        x if shared and k < spec.leaves else _join(_batch_first(x, axis, size), robots)
        for k, (x, axis) in enumerate(zip(operands, axes, strict=True))
    ]


# solved steps


def _solved_shapes(spec: Solves, *operands: Any) -> list[Any]:
    controls, states = operands[spec.leaves], operands[spec.leaves + 1 :]
    system, shape = spec.pattern.system, controls.shape[:2]
    rows = jax.eval_shape(lambda: no_rows(system, shape, spec.task.settings.stages))
    return [jax.ShapeDtypeStruct(shape[:1], int), *states, *rows]


def _core_of_solves(spec: Solves, *operands: Any) -> Any:
    return core_of(spec.pattern, spec.task.settings, robots=operands[spec.leaves].shape[0] > 1)


def _solve(core: Any, spec: Solves, *arrays: np.ndarray) -> list[Any]:
    leaves, controls = arrays[: spec.leaves], arrays[spec.leaves]
    task, parameters = spec.task, np.concatenate([leaf.reshape(len(leaf), -1) for leaf in leaves], axis=1)
    states: Any = (StateHistory if task.settings.time else StaticState)(*arrays[spec.leaves + 1 :])
    motions = Motions(core, parameters, states, task.coefficients)
    done, rows = motions.solve(controls, (0, task.steps))
    return [done, *motions.states, *rows]


solve_p = _primitive("solve", _solved_shapes, _core_of_solves, _solve)


def _batched_solve(operands: Arrays, axes: Arrays, *, spec: Solves) -> Any:
    robots = _robots(operands[spec.leaves], axes[spec.leaves])
    found = solve_p.bind(*_as_robots(spec, operands, axes, robots), spec=spec)
    return [_divide(x, robots) for x in found], [0] * len(found)


def _robots(x: Any, axis: Any) -> int:
    """Return the number of robots of an operand that may have a batch axis, too."""
    return np.shape(x)[0 if axis is None else int(axis == 0)]


batching.primitive_batchers[solve_p] = _batched_solve


# tangents and cotangents: linear in their last operands. Those before are the leaves of the system, controls,
# records, rate and time before the first step, and solved rows and unknowns


def _residuals(spec: Solves) -> int:
    return spec.leaves + 6


def _sides(spec: Solves, operands: Arrays) -> tuple[list[Any], list[Any]]:
    """Return, of the operands, the data and the results that have tangents."""
    *leaves, controls, records, rate, _, rows, unknowns = operands[: _residuals(spec)]
    return [*spec.moved(leaves), controls, records, rate], [rows, unknowns, records, rate]


def _linear_shapes(side: int, spec: Solves, *operands: Any) -> list[Any]:
    robots, columns = operands[-1].shape[:2]
    return [
        jax.ShapeDtypeStruct((robots, columns, *each.shape[1:]), each.dtype)
        for each in _sides(spec, operands)[side]
    ]


def _core_of_linear(kind: Any, spec: Solves, *operands: Any) -> Any:
    masks = [np.full(shape, moves) for (shape, _), moves in zip(spec.pattern.zeros, spec.moving, strict=True)]
    return tangents_for(kind, spec.pattern, spec.task.settings, masks)


def _each_robot(function: Callable[..., Any], spec: Solves, arrays: Arrays) -> list[np.ndarray]:
    """Return results of a function of each robot's solved steps and tangents.

    Tangents and results have columns as the last axis in the function, and as the first one here.
    """
    task, n, system = spec.task, _residuals(spec), spec.pattern.system
    found = []
    for k in range(len(arrays[-1])):
        own = [each[min(k, len(each) - 1)] for each in arrays]
        *leaves, controls, records, rate, t0, rows, unknowns = own[:n]
        parameters = np.concatenate([leaf.reshape(-1) for leaf in leaves])
        table = table_of(task.coefficients, task.steps, float(t0))
        at = at_all_stages(system, task.settings, controls)
        columns = [np.moveaxis(each, 0, -1) for each in own[n:]]
        results = function(SolvedSteps(parameters, table, at, rows, unknowns, records, rate), columns)
        found.append([np.moveaxis(each, -1, 0) for each in results])
    return [np.stack(each) for each in zip(*found, strict=True)]


def _push(core: TangentCore, spec: Solves, *arrays: np.ndarray) -> list[np.ndarray]:
    system, settings = spec.pattern.system, spec.task.settings

    def push(solved: SolvedSteps, columns: Any) -> tuple[Any, ...]:
        *leaves, d_controls, d_records, d_rate = columns
        m = d_rate.shape[-1]
        moved = [leaf.reshape(-1, m).T for leaf in leaves]
        directions = np.concatenate(moved, axis=1) if moved else np.zeros((0, 0))
        moves = directions, np.eye(len(directions), m)
        d_own = at_all_stages(system, settings, d_controls)
        after, found = core.solve(solved, moves, d_own, (d_records, d_rate))
        return *found, *after[2:]

    return _each_robot(push, spec, arrays)


def _pull(core: CotangentCore, spec: Solves, *arrays: np.ndarray) -> list[np.ndarray]:
    shapes = spec.moved([shape for shape, _ in spec.pattern.zeros])
    ends, steps = np.cumsum([int(np.prod(shape)) for shape in shapes])[:-1], spec.task.steps
    held = arrays[spec.leaves].shape[2] == spec.pattern.system.control_layout.size

    def pull(solved: SolvedSteps, cotangents: Any) -> tuple[Any, ...]:
        moved, controls, *states = core.solve(solved, cotangents)
        leaves = np.split(moved, ends) if shapes else []
        leaves = [leaf.reshape(*shape, moved.shape[-1]) for leaf, shape in zip(leaves, shapes, strict=True)]
        controls = controls.reshape(steps, spec.task.settings.stages, -1, controls.shape[-1])
        controls = controls.sum(axis=1) if held else controls.reshape(steps, -1, controls.shape[-1])
        return *leaves, controls, *states

    return _each_robot(pull, spec, arrays)


DATA, RESULTS = 0, 1
push_p = _primitive(
    "push",
    functools.partial(_linear_shapes, RESULTS),
    functools.partial(_core_of_linear, TangentCore),
    _push,
)
pull_p = _primitive(
    "pull",
    functools.partial(_linear_shapes, DATA),
    functools.partial(_core_of_linear, CotangentCore),
    _pull,
)


def _batched_linear(primitive: Primitive, operands: Arrays, axes: Arrays, *, spec: Solves) -> Any:
    n, robots = _residuals(spec), _robots(operands[-1], axes[-1])
    if all(axis is None for axis in axes[:n]):
        size = next(np.shape(x)[axis] for x, axis in zip(operands, axes, strict=True) if axis is not None)
        columns = []
        for x, axis in zip(operands[n:], axes[n:], strict=True):
            own = jnp.moveaxis(_batch_first(x, axis, size), 0, 1)
            columns.append(own.reshape(robots, size * own.shape[2], *own.shape[3:]))
        found = primitive.bind(*operands[:n], *columns, spec=spec)
        return [x.reshape(robots, size, x.shape[1] // size, *x.shape[2:]) for x in found], [1] * len(found)
    found = primitive.bind(*_as_robots(spec, operands, axes, robots), spec=spec)
    return [_divide(x, robots) for x in found], [0] * len(found)


def _tangents_of_linear(primitive: Primitive, primals: Arrays, tangents: Arrays, *, spec: Solves) -> Any:
    n, found = _residuals(spec), primitive.bind(*primals, spec=spec)
    if not all(isinstance(tangent, ad.Zero) for tangent in tangents[:n]):
        raise EngineError(
            "a simulation has first derivatives only; take differences of them (one call of `jax.grad` each)"
        )
    moved = [ad.instantiate_zeros(each) for each in tangents[n:]]
    return found, primitive.bind(*primals[:n], *moved, spec=spec)


def _transpose(other: Primitive, cotangents: Arrays, *operands: Any, spec: Solves) -> list[Any]:
    n = _residuals(spec)
    given = [ad.instantiate_zeros(each) for each in cotangents]
    return [None] * n + list(other.bind(*operands[:n], *given, spec=spec))


for _one, _other in ((push_p, pull_p), (pull_p, push_p)):
    batching.primitive_batchers[_one] = functools.partial(_batched_linear, _one)
    ad.primitive_jvps[_one] = functools.partial(_tangents_of_linear, _one)
    ad.primitive_transposes[_one] = functools.partial(_transpose, _other)


# differentiable functions


@functools.lru_cache(maxsize=64)
def rollout(
    task: TimeIntegration, pattern: Pattern
) -> Callable[[System, Any, StateHistory], tuple[StepRows, StateHistory]]:
    """Return a differentiable function from (system, controls (T, c), past) to all rows and the last history.

    Cached between calls: JAX recognises functions that it has already traced by identity.
    """

    @jax.custom_jvp
    def run(system: System, controls: Any, past: StateHistory) -> tuple[StepRows, StateHistory]:
        done, found, rows = _solve_primitive(Solves(task, pattern), system, controls, past)
        last = StateHistory(*found)._replace(t0=past.t0 + task.steps * task.dt)
        return rows, jax.tree.map(lambda x: jnp.where(done < task.steps, jnp.nan, x), last)

    def tangent(primals: Any, tangents: Any) -> Any:
        rows, last = run(*primals)
        d_past = jax.tree.map(_instantiate, tangents[2], is_leaf=_is_zero)
        used = used_places(primals[0], task.settings.space)
        past = primals[2]
        states = past.records[:, :used], past.rate[:used], past.t0
        d_states = d_past.records[:, :used], d_past.rate[:used]
        d_rows, d_records, d_rate = _push_tangents(
            Solves(task, pattern), primals, tangents, rows, (states, d_states)
        )
        # first guesses, error estimates and the extra stages of these count as constants
        d_last = jax.tree.map(jnp.zeros_like, last)
        d_last = d_last._replace(
            records=d_last.records.at[:, :used].set(d_records),
            rate=d_last.rate.at[:used].set(d_rate),
            t0=d_past.t0,
        )
        return (rows, last), (d_rows, d_last)

    run.defjvp(tangent, symbolic_zeros=True)
    return run


@functools.lru_cache(maxsize=64)
def static_rollout(task: TimeIntegration, pattern: Pattern) -> Callable[[System, Any, Any], StepRows]:
    """Return a differentiable function from (system, controls (T, c), y at all points) to all rows."""

    @jax.custom_jvp
    def run(system: System, controls: Any, y: Any) -> StepRows:
        return _solve_primitive(Solves(task, pattern), system, controls, StaticState(y))[2]

    def tangent(primals: Any, tangents: Any) -> Any:
        rows, system = run(*primals), primals[0]
        none = no_history(system, task.settings.space)[: used_places(system, task.settings.space)]
        still = jnp.stack([none] * task.settings.memory), none
        states = (*still, jnp.zeros(())), still
        return rows, _push_tangents(Solves(task, pattern), primals, tangents, rows, states)[0]

    run.defjvp(tangent, symbolic_zeros=True)
    return run


def _solve_primitive(
    spec: Solves, system: System, controls: Any, states: Any
) -> tuple[Any, list[Any], StepRows]:
    """Return the number of steps done, the last state, and rows: NaN where unsolved."""
    operands = [*jax.tree.leaves(system), controls, *states]
    done, *found = (each[0] for each in solve_p.bind(*map(_one_robot, operands), spec=spec))
    rows = StepRows(*found[len(states) :])
    unsolved = rows.result < 0
    rows = rows._replace(
        records=jnp.where(unsolved[:, None, None], jnp.nan, rows.records),
        unknowns=jnp.where(unsolved[:, None], jnp.nan, rows.unknowns),
        error=jnp.where(unsolved, jnp.inf, rows.error),
    )
    return done, found[: len(states)], rows


def _push_tangents(
    spec: Solves, primals: Any, tangents: Any, rows: StepRows, states: tuple[Any, Any]
) -> tuple[StepRows, Any, Any]:
    """Return the tangents of rows, and of the records and the rate after the last step.

    `states` are records, rate and time before the first step, and the tangents of records and rate.
    """
    (system, controls, *_), task, (before, d_before) = primals, spec.task, states
    d_leaves = jax.tree.leaves(tangents[0], is_leaf=_is_zero)
    moving = tuple(not _is_zero(leaf) for leaf in d_leaves)
    spec = dataclasses.replace(spec, moving=moving)
    residuals = *jax.tree.leaves(system), controls, *before, *rows.every_stage
    moved = *spec.moved(d_leaves), _instantiate(tangents[1]), *d_before
    operands = [*map(_one_robot, residuals), *(_one_robot(_one_robot(each)) for each in moved)]
    d_records, d_unknowns, *after = (each[0, 0] for each in push_p.bind(*operands, spec=spec))
    d_records, d_unknowns = (
        each.reshape(task.steps, task.settings.stages, *each.shape[1:]) for each in (d_records, d_unknowns)
    )
    whole, zero = np.zeros(rows.result.shape, dtype=jax.dtypes.float0), jnp.zeros_like(rows.error)
    last, stages = (d_records[:, -1], d_unknowns[:, -1]), (d_records[:, :-1], d_unknowns[:, :-1])
    return StepRows(*last, zero, whole, zero, whole, zero, *stages), *after


def _one_robot(x: Any) -> Any:
    return jnp.asarray(x, float)[None]


def _is_zero(tangent: Any) -> bool:
    return isinstance(tangent, SymbolicZero)


def _instantiate(tangent: Any) -> Any:
    """Return a tangent as an array."""
    if not _is_zero(tangent):
        return tangent
    numeric: Any = np if tangent.dtype == jax.dtypes.float0 else jnp
    return numeric.zeros(tangent.shape, tangent.dtype)
