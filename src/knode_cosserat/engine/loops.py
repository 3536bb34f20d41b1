"""Runs of the engine: of one robot or of a batch, over time steps or equilibria."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import jax
import numpy as np

from knode_cosserat.engine.core import Constants, Core, Shape, States, coefficients_of
from knode_cosserat.engine.pattern import Pattern, compiled, masks_of, parameters_of
from knode_cosserat.engine.tangents import CotangentCore, TangentCore
from knode_cosserat.rods.system import System
from knode_cosserat.solvers.problem import Evaluated
from knode_cosserat.solvers.settings import Settings
from knode_cosserat.solvers.steps import StepCoefficients, StepRows

AnyTangents = TypeVar("AnyTangents", TangentCore, CotangentCore)


def core_of(pattern: Pattern, settings: Settings, robots: bool) -> Core:
    """Return the core of a pattern, of one robot or with robots in lanes.

    Newton's options are not part of the code.

    Raises:
        EngineError: the engine does not cover the system or the settings.
    """
    schemes = Settings(settings.time, settings.space)
    return compiled((pattern, schemes, robots), lambda: Core(pattern.system, schemes, robots))


def tangents_for(
    kind: type[AnyTangents], pattern: Pattern, settings: Settings, moving: Sequence[np.ndarray]
) -> AnyTangents:
    """Return the core of tangents or cotangents of a pattern, with masks of `moving` parameters."""
    key = pattern, masks_of(moving), settings.space, settings.memory, settings.uses_rate, kind
    return compiled(key, lambda: kind(pattern.system, settings, moving))


def loop_one(
    system: System, settings: Settings, steps: StepCoefficients, controls: Any, past: States,
    span: tuple[int, int], tip_offset: Any = 0.0,
) -> tuple[int, States, StepRows]:  # fmt: skip
    """Solve a span of steps until one fails: the number of steps done, the state after them, and rows.

    The offset (k,) is subtracted from the residual of the tip's conditions.
    """
    core = core_of(Pattern.of(system), settings, robots=False)
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
    core = core_of(Pattern.of(system), settings, robots=len(controls) > 1)
    parameters = parameters_of(system)
    if np.ndim(system.length):
        leaves = [np.asarray(leaf, float) for leaf in jax.tree.leaves(system)]
        parameters = np.concatenate([leaf.reshape(len(leaf), -1) for leaf in leaves], axis=1)
    pasts = jax.tree.map(np.asarray, pasts)
    constants = Constants(parameters, settings.newton)
    return core.integrate(constants, np.asarray(controls), steps, pasts, (0, stop))


#: the coefficients of equilibria
STILL = StepCoefficients(np.zeros((1, 4)), 0.0)


def evaluator(system: System, settings: Settings) -> Callable[..., Evaluated]:
    """Return a function that evaluates states of a system (see `Core.evaluator`)."""
    return core_of(Pattern.of(system), settings, robots=False).evaluator(parameters_of(system))


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


def table_of(settings: Settings, steps: StepCoefficients, count: int, t0: float) -> np.ndarray:
    """Return the coefficients and the time (s) of all stages of the first steps (solves, memory + 3)."""
    table = coefficients_of(steps, settings.stages, (0, count))
    table[..., -1] += t0
    return table.reshape(-1, table.shape[-1])


def at_all_stages(system: System, settings: Settings, values: Any) -> np.ndarray:
    """Return controls (solves, c, ...) of all stages from (T, c, ...) or (T, stages * c, ...)."""
    values, size = np.asarray(values, float), system.control_layout.size
    if values.shape[1] > size:
        return values.reshape(-1, size, *values.shape[2:])
    return np.repeat(values, settings.stages, axis=0)
