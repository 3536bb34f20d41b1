"""Time loops of the engine: the same arguments and results as the compiled loops of `solvers.time_loop`."""

from __future__ import annotations

import dataclasses
import logging
import threading
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Self, TypeVar

import jax
import numpy as np

from knode_cosserat.engine.core import Constants, Core, Shape, States, coefficients_of
from knode_cosserat.engine.equations import constant_zeros
from knode_cosserat.engine.program import EngineError
from knode_cosserat.engine.tangents import CotangentCore, TangentCode, TangentCore
from knode_cosserat.rods.system import System, is_traced
from knode_cosserat.solvers.problem import Evaluated
from knode_cosserat.solvers.settings import Settings
from knode_cosserat.solvers.time_loop import StepCoefficients, StepRows

log = logging.getLogger(__name__)

#: compiled cores, or the reason why there is none, by what their code depends on; the last used come last
_CORES: dict[Any, Core | TangentCode | EngineError] = {}
#: number of cores that a process keeps: a core takes some MB
MOST_CORES = 100
_COMPILING = threading.Lock()

AnyCore = TypeVar("AnyCore", Core, TangentCore, CotangentCore)
AnyTangents = TypeVar("AnyTangents", TangentCore, CotangentCore)


@dataclasses.dataclass(frozen=True)
class Pattern:
    """Structure of a system, and its parameters that are zero: constants of the code."""

    structure: Any
    #: shape of each leaf, and its zeros as bits
    zeros: tuple[tuple[tuple[int, ...], bytes], ...]

    @classmethod
    def of(cls, system: System) -> Self:
        """Return the pattern of a system; zeros of a batch are those of all, and no traced value is one."""
        leaves, structure = jax.tree.flatten(system)
        axis, zeros = np.ndim(system.length), []
        for leaf in leaves:
            known = np.ones(np.shape(leaf)) if is_traced(leaf) else np.asarray(leaf, float)
            zeros.append(constant_zeros(np.max(np.abs(known), axis=tuple(range(axis)))))
        return cls(structure, _masks(zeros))

    @property
    def system(self) -> System:
        """A system of this pattern, with ones for all other parameters."""
        leaves = []
        for shape, bits in self.zeros:
            size = int(np.prod(shape))
            mask = np.unpackbits(np.frombuffer(bits, np.uint8), count=size).reshape(shape)
            leaves.append(1.0 - mask)
        return jax.tree.unflatten(self.structure, leaves)


def core_of(system: System, settings: Settings, robots: bool) -> Core:
    """Return the core of a system or, with robots in lanes, of a batch of systems or one for all.

    Newton's options are not part of the code.

    Raises:
        EngineError: the engine does not cover the system or the settings.
    """
    return core_for(Pattern.of(system), settings, robots)


def core_for(pattern: Pattern, settings: Settings, robots: bool) -> Core:
    """Return the core of a pattern; see `core_of`."""
    schemes = Settings(settings.time, settings.space)
    return _compiled((pattern, schemes, robots), lambda: Core(pattern.system, schemes, robots))


def tangents_for(
    kind: type[AnyTangents], pattern: Pattern, settings: Settings, moving: Sequence[np.ndarray]
) -> AnyTangents:
    """Return the core of tangents or cotangents of a pattern, with masks of `moving` parameters."""
    key = pattern, _masks(moving), settings.space, settings.uses_rate, kind

    def build() -> AnyTangents:
        system = pattern.system
        if system.strands > 1:
            raise EngineError("engine: tangents only of one rod")
        return kind(system, settings, moving)

    return _compiled(key, build)


def _masks(masks: Iterable[np.ndarray]) -> Any:
    return tuple((mask.shape, np.packbits(mask).tobytes()) for mask in masks)


def _compiled(key: Any, build: Callable[[], AnyCore]) -> AnyCore:
    """Return compiled code that is kept by a key."""
    with _COMPILING:
        core: Any = _CORES.pop(key, None)
        if core is None:
            try:
                # also while JAX traces a caller: equations are traced by themselves
                with jax.ensure_compile_time_eval():
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
    leaves = [np.asarray(leaf, float) for leaf in jax.tree.leaves(system)]
    if directions is None:
        stacked = [np.zeros((0, *leaf.shape)) for leaf in leaves]
        weights = np.zeros((0, d_controls.shape[-1]))
    else:
        stacked = [np.asarray(leaf, float) for leaf in jax.tree.leaves(directions)]
    moving = [np.any(leaf != 0.0, axis=0) for leaf in stacked]
    core = tangents_for(TangentCore, Pattern.of(system), settings, moving)
    moved = np.concatenate(
        [
            leaf[:, mask].reshape(len(leaf), int(mask.sum()))
            for leaf, mask in zip(stacked, moving, strict=True)
        ],
        axis=1,
    )
    own, d_own = (at_all_stages(system, settings, each) for each in (controls, d_controls))
    table = table_of(settings, steps, len(controls), t0)
    return core.solve(parameters_of(system), table, solved, own, (moved, weights), d_own, states)


def table_of(settings: Settings, steps: StepCoefficients, count: int, t0: float) -> np.ndarray:
    """Return the coefficients and the time (s) of all stages of the first steps (solves, 5)."""
    table = coefficients_of(steps, settings.stages, (0, count)).reshape(-1, 5)
    table[:, 4] += t0
    return table


def at_all_stages(system: System, settings: Settings, values: Any) -> np.ndarray:
    """Return controls (solves, c, ...) of all stages from (T, c, ...) or (T, stages * c, ...)."""
    values, size = np.asarray(values, float), system.control_size
    if values.shape[1] > size:
        return values.reshape(-1, size, *values.shape[2:])
    return np.repeat(values, settings.stages, axis=0)
