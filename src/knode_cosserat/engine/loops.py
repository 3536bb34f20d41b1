"""Time loops of the engine: the same arguments and results as the compiled loops of `solvers.time_loop`."""

from __future__ import annotations

import functools
import threading
from typing import Any

import jax
import numpy as np

from knode_cosserat.engine.core import Core
from knode_cosserat.engine.program import EngineError
from knode_cosserat.rods.system import System
from knode_cosserat.solvers.history import StateHistory
from knode_cosserat.solvers.settings import Settings
from knode_cosserat.solvers.time_loop import StepCoefficients, StepRows

#: compiled cores, or the reason why there is none, by what their code depends on
_CORES: dict[Any, Core | EngineError] = {}
_COMPILING = threading.Lock()


def core_of(system: System, settings: Settings, robots: bool) -> Core:
    """Return the core of a system or, with robots in lanes, of a batch of systems or one for all.

    Parameters that are zero, in all systems of a batch, are constants of the code.

    Raises:
        EngineError: the engine does not cover the system or the settings.
    """
    leaves, structure = jax.tree.flatten(system)
    leaves = [np.asarray(leaf, dtype=float) for leaf in leaves]
    if np.ndim(system.length):
        leaves = [np.max(np.abs(leaf), axis=0) for leaf in leaves]
    zeros = tuple((leaf.shape, np.packbits(leaf == 0.0).tobytes()) for leaf in leaves)
    key = structure, zeros, settings, robots
    with _COMPILING:
        if key not in _CORES:
            try:
                _CORES[key] = Core(jax.tree.unflatten(structure, leaves), settings, robots)
            except EngineError as error:
                _CORES[key] = error
    core = _CORES[key]
    if isinstance(core, EngineError):
        raise core
    return core


def parameters_of(system: System) -> np.ndarray:
    """Return all numeric parameters of a system in one vector."""
    return np.concatenate([np.asarray(leaf, float).reshape(-1) for leaf in jax.tree.leaves(system)])


def loop_one(
    system: System, settings: Settings, steps: StepCoefficients, controls: Any, past: StateHistory,
    span: tuple[int, int],
) -> tuple[int, StateHistory, StepRows]:  # fmt: skip
    """Solve a span of steps until one fails: the number of steps done, the state after them, and rows."""
    core = core_of(system, settings, robots=False)
    one = functools.partial(jax.tree.map, lambda leaf: np.asarray(leaf)[None])
    done, states, rows = core.integrate(
        parameters_of(system), np.asarray(controls)[None], steps, one(past), span
    )
    return int(done[0]), *jax.tree.map(lambda leaf: leaf[0], (states, rows))


def loop_many(
    system: System, settings: Settings, steps: StepCoefficients, controls: Any, pasts: StateHistory, stop: int
) -> tuple[np.ndarray, StateHistory, StepRows]:
    """Solve all steps of a batch: controls (B, T, c), states (B, ...), and one system or a batch of them.

    Robots are solved side by side in the lanes of vectors; see `Core.integrate`.
    """
    core = core_of(system, settings, robots=len(controls) > 1)
    parameters = parameters_of(system)
    if np.ndim(system.length):
        leaves = [np.asarray(leaf, float) for leaf in jax.tree.leaves(system)]
        parameters = np.concatenate([leaf.reshape(len(leaf), -1) for leaf in leaves], axis=1)
    pasts = jax.tree.map(np.asarray, pasts)
    return core.integrate(parameters, np.asarray(controls), steps, pasts, (0, stop))
