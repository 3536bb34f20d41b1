"""Time loops of the engine: the same arguments and results as the compiled loops of `solvers.time_loop`."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterable
from typing import Any, TypeVar

import jax
import numpy as np

from knode_cosserat.engine.core import Constants, Core, Shape, States, coefficients_of
from knode_cosserat.engine.equations import constant_zeros
from knode_cosserat.engine.program import EngineError
from knode_cosserat.engine.tangents import TangentCore
from knode_cosserat.rods.system import System
from knode_cosserat.solvers.problem import Evaluated
from knode_cosserat.solvers.settings import Settings
from knode_cosserat.solvers.space import LOBATTO2
from knode_cosserat.solvers.time_loop import StepCoefficients, StepRows

log = logging.getLogger(__name__)

#: compiled cores, or the reason why there is none, by what their code depends on; the last used come last
_CORES: dict[Any, Core | TangentCore | EngineError] = {}
#: number of cores that a process keeps: a core takes some MB
MOST_CORES = 100
_COMPILING = threading.Lock()

CoreOrTangents = TypeVar("CoreOrTangents", Core, TangentCore)


def core_of(system: System, settings: Settings, robots: bool) -> Core:
    """Return the core of a system or, with robots in lanes, of a batch of systems or one for all.

    Parameters that are zero, in all systems of a batch, are constants of the code. Newton's options are not.

    Raises:
        EngineError: the engine does not cover the system or the settings.
    """
    leaves, structure = jax.tree.flatten(system)
    leaves = [np.asarray(leaf, dtype=float) for leaf in leaves]
    if np.ndim(system.length):
        leaves = [np.max(np.abs(leaf), axis=0) for leaf in leaves]
    schemes = Settings(settings.time, settings.space)
    key = structure, _masks(map(constant_zeros, leaves)), schemes, robots
    return _compiled(key, lambda: Core(jax.tree.unflatten(structure, leaves), schemes, robots))


def _masks(masks: Iterable[np.ndarray]) -> Any:
    return tuple((mask.shape, np.packbits(mask).tobytes()) for mask in masks)


def _compiled(key: Any, build: Callable[[], CoreOrTangents]) -> CoreOrTangents:
    """Return compiled code that is kept by a key."""
    with _COMPILING:
        core: Any = _CORES.pop(key, None)
        if core is None:
            try:
                core = build()
            except EngineError as error:
                log.info("%s; JAX runs it", error)
                # without the frames that a traceback keeps alive
                core = error.with_traceback(None)
        _CORES[key] = core
        if len(_CORES) > MOST_CORES:
            del _CORES[next(iter(_CORES))]
    if isinstance(core, EngineError):
        raise core.with_traceback(None)
    return core


def parameters_of(system: System) -> np.ndarray:
    """Return all numeric parameters of a system in one vector."""
    return np.concatenate([np.asarray(leaf, float).reshape(-1) for leaf in jax.tree.leaves(system)])


def loop_one(
    system: System, settings: Settings, steps: StepCoefficients, controls: Any, past: States,
    span: tuple[int, int], tip_offset: Any = 0.0,
) -> tuple[int, States, StepRows]:  # fmt: skip
    """Solve a span of steps until one fails: the number of steps done, the state after them, and rows.

    The offset (k,) is subtracted from the residual of the tip's conditions.
    """
    core = core_of(system, settings, robots=False)
    batch = jax.tree.map(lambda leaf: np.asarray(leaf)[None], past)
    constants = Constants(parameters_of(system), settings.newton, tip_offset)
    found = core.integrate(constants, np.asarray(controls)[None], steps, batch, span)
    done, last, rows = jax.tree.map(lambda leaf: leaf[0], found)
    return int(done), last, rows


def loop_many(
    system: System, settings: Settings, steps: StepCoefficients, controls: Any, pasts: States, stop: int
) -> tuple[np.ndarray, States, StepRows]:
    """Solve all steps of a batch: controls (B, T, c), states (B, ...), and one system or a batch of them.

    Robots are solved side by side in the lanes of vectors; see `Core.integrate`.
    """
    core = core_of(system, settings, robots=len(controls) > 1)
    parameters = parameters_of(system)
    if np.ndim(system.length):
        leaves = [np.asarray(leaf, float) for leaf in jax.tree.leaves(system)]
        parameters = np.concatenate([leaf.reshape(len(leaf), -1) for leaf in leaves], axis=1)
    pasts = jax.tree.map(np.asarray, pasts)
    constants = Constants(parameters, settings.newton)
    return core.integrate(constants, np.asarray(controls), steps, pasts, (0, stop))


#: the coefficients of equilibria
STILL = StepCoefficients(np.zeros((2, 4)), 0.0)


def evaluator(system: System, settings: Settings) -> Callable[..., Evaluated]:
    """Return a function that evaluates states of a system (see `Core.evaluator`)."""
    return core_of(system, settings, robots=False).evaluator(parameters_of(system))


def static_one(
    system: System, settings: Settings, controls: Any, y: Any, span: tuple[int, int], tip_offset: Any = 0.0
) -> Any:
    """Solve a span of equilibria in turn until one fails: the number done, y at all points, and rows."""
    done, last, rows = loop_one(system, settings, STILL, controls, Shape(y), span, tip_offset)
    return done, last.y, rows


def static_many(system: System, settings: Settings, controls: Any, y: Any, stop: int) -> Any:
    """Solve the equilibria of a batch: controls (B, T, c), y (B, points, y), and one system or a batch."""
    done, last, rows = loop_many(system, settings, STILL, controls, Shape(y), stop)
    return done, last.y, rows


def tangent_loop(
    settings: Settings, steps: StepCoefficients, solved: tuple[Any, Any], at: tuple[System, Any],
    changes: tuple[tuple[Any, Any], Any], states: tuple[Any, Any, Any, Any], t0: float,
) -> tuple[Any, Any]:  # fmt: skip
    """Return the tangents of solved steps: see `solvers.sensitivity.tangent_time_loop`, and its states."""
    (system, controls), ((directions, weights), d_controls) = at, changes
    if system.strands > 1 or system.mixed or settings.space != LOBATTO2:
        raise EngineError("engine: tangents only of one rod by lobatto2, with a balance in which B is zero")
    leaves, structure = jax.tree.flatten(system)
    leaves = [np.asarray(leaf, float) for leaf in leaves]
    count, stages, m = len(controls), settings.stages, d_controls.shape[-1]
    if directions is None:
        stacked, weights = [np.zeros((0, *leaf.shape)) for leaf in leaves], np.zeros((0, m))
    else:
        stacked = [np.asarray(leaf, float) for leaf in jax.tree.leaves(directions)]
    moving = [np.any(leaf != 0.0, axis=0) for leaf in stacked]
    masks = _masks(map(constant_zeros, leaves)), _masks(moving)
    key = structure, *masks, settings.space, settings.uses_rate, "tangents"
    core = _compiled(key, lambda: TangentCore(jax.tree.unflatten(structure, leaves), settings, moving))
    moved = np.concatenate(
        [
            leaf[:, mask].reshape(len(leaf), int(mask.sum()))
            for leaf, mask in zip(stacked, moving, strict=True)
        ],
        axis=1,
    )
    table = coefficients_of(steps, stages, (0, count))
    table[..., 4] += t0

    def all_stages(values: Any) -> np.ndarray:
        """Return controls, or their tangents, of all stages of all steps."""
        values, size = np.asarray(values, float), system.control_size
        if values.shape[1] > size:
            return values.reshape(count * stages, size, *values.shape[2:])
        return np.repeat(values, stages, axis=0)

    return core.solve(
        parameters_of(system), table.reshape(-1, 5), solved, all_stages(controls), (moved, weights),
        all_stages(d_controls), states,
    )  # fmt: skip
