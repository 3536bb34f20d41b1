"""Runs of the engine: of one robot or of a batch, over time steps or equilibria."""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

import jax
import numpy as np

from knode_cosserat.engine.core import Core
from knode_cosserat.engine.counts import counts_of
from knode_cosserat.engine.linear_step import LinearStep
from knode_cosserat.engine.motions import Motions, StaticState, coefficients_of
from knode_cosserat.engine.pattern import Pattern, compiled, masks_of, packed
from knode_cosserat.engine.tangents import CotangentCore, TangentCore
from knode_cosserat.rods.system import System
from knode_cosserat.schemes.history import StepCoefficients, StepRows
from knode_cosserat.schemes.problem import Evaluated
from knode_cosserat.schemes.settings import Settings
from knode_cosserat.schemes.space import SpaceScheme

AnyTangents = TypeVar("AnyTangents", TangentCore, CotangentCore)
AnyCode = TypeVar("AnyCode", Core, TangentCore, CotangentCore)


def core_of(pattern: Pattern, settings: Settings, robots: bool) -> Core:
    """Return the core of a pattern, of one robot or with robots in lanes.

    The core of the default scheme in time solves equilibria, too. Newton's options are not part of the code.

    Raises:
        EngineError: the engine does not cover the system or the settings.
    """
    schemes = Settings(settings.time or Settings.time, settings.space)
    build = functools.partial(Core, pattern.in_room.system, schemes, robots)
    core = compiled((pattern.in_room, schemes, robots), Core, build, _given(schemes))
    return _on_grid(core, pattern)


def _given(settings: Settings) -> dict[str, Any]:
    """Return the attributes of a core that are no data of its own."""
    return {"settings": settings, "space": settings.space, "on_grids": {}}


def _on_grid(core: AnyCode, pattern: Pattern) -> AnyCode:
    """Return code with the counts of a grid; one object for each, which keeps what follows from it."""
    counts, grids = counts_of(pattern.system, core.space), core.on_grids
    if counts not in grids:
        found = grids[counts] = copy.copy(core)
        # no cycle: machine code is freed with the last code that has it
        found.counts, found.on_grids = counts, {}
    return grids[counts]


def tangents_for(
    kind: type[AnyTangents], pattern: Pattern, settings: Settings, moving: Sequence[np.ndarray]
) -> AnyTangents:
    """Return the core of tangents or cotangents of a pattern, with masks of `moving` parameters."""
    key = pattern.in_room, masks_of(moving), settings.space, settings.memory, settings.uses_rate, kind
    build = functools.partial(kind, pattern.in_room.system, settings, moving)
    return _on_grid(compiled(key, kind, build, _given(settings)), pattern)


def solve_steps(
    system: System,
    steps: StepCoefficients,
    controls: Any,
    states: Any,
    span: tuple[int, int],
    rows: StepRows | None = None,
) -> tuple[Any, Any, Any]:
    """Solve a span of steps until one fails: the number of steps done, the state after them, and rows.

    The state is a `StateHistory`; of equilibria, solved in turn, it is y at all points. Controls are (T, c).
    A batch has controls (B, T, c), as many states, and one system or as many: its robots are solved side by
    side in the lanes of vectors, each until a step fails (see `Motions.solve`); its rows may be given.
    """
    alone, is_static = np.ndim(controls) == 2, steps.settings.time is None
    states = StaticState(states) if is_static else states
    controls, states = jax.tree.map(lambda leaf: np.asarray(leaf)[None if alone else ...], (controls, states))
    motions = motions_of(system, steps, states)
    rows = rows if rows is None or not alone else StepRows(*(leaf[None] for leaf in rows))
    done, rows = motions.solve(controls, span, rows)
    last = motions.states
    found = done, last.y if is_static else last, rows
    return jax.tree.map(lambda leaf: leaf[0], found) if alone else found


def motions_of(system: System, steps: StepCoefficients, states: Any) -> Motions:
    """Return motions from states (robots, ...), of one system or of as many."""
    core = core_of(Pattern.of(system), steps.settings, robots=len(states[0]) > 1)
    return Motions(core, packed(system), states, steps)


def evaluators(system: System, settings: Settings) -> Iterator[Callable[..., Evaluated]]:
    """Yield a function that evaluates states, for each robot of a batch or for one (see `Core.evaluator`)."""
    core = core_of(Pattern.of(system), settings, robots=False)
    memory = core._empty_memory()
    for parameters in np.atleast_2d(packed(system)):
        yield core.evaluator(parameters, memory)


def evaluator(system: System, settings: Settings) -> Callable[..., Evaluated]:
    """Return a function that evaluates states of a system (see `Core.evaluator`)."""
    return next(evaluators(system, settings))


def linear_step(system: System, space: SpaceScheme, control: Any, y: Any) -> LinearStep:
    """Return the linearised step of a system from an equilibrium y at all points, or at the nodes."""
    return LinearStep(_still_core(system, space), packed(system), control, y)


def has_friction(system: System, space: SpaceScheme) -> bool:
    """True if the law has friction (`semi_discrete.has_friction`), as the code of equilibria knows."""
    return _still_core(system, space).has_friction


def _still_core(system: System, space: SpaceScheme) -> Core:
    return core_of(Pattern.of(system), Settings(None, space), robots=False)


def table_of(steps: StepCoefficients, count: int, t0: float) -> np.ndarray:
    """Return the coefficients and the time (s) of all stages of the first steps (solves, memory + 3)."""
    table = coefficients_of(steps, (0, count))
    table[..., -1] += t0
    return table.reshape(-1, table.shape[-1])


def at_all_stages(system: System, settings: Settings, values: Any) -> np.ndarray:
    """Return controls (solves, c, ...) of all stages from (T, c, ...) or (T, stages * c, ...)."""
    values, size = np.asarray(values, float), system.control_layout.size
    if values.shape[1] > size:
        return values.reshape(-1, size, *values.shape[2:])
    return np.repeat(values, settings.stages, axis=0)
