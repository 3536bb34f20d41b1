"""Derivatives of a simulation, by the implicit function theorem in each step.

A solved step satisfies G(y, ξ; history, control, parameters) = 0. Its tangent therefore solves the linear
equations of Newton's method, with the tangents of history, control and parameters on the right-hand side.
The iteration is not differentiated, and reverse mode is the transpose of the same recursion. Both run in the
engine (`engine.tangents`).
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple, Self

import jax
import numpy as np
from jaxtyping import Bool, Float

from knode_cosserat.engine.equations import is_moving
from knode_cosserat.engine.loops import at_all_stages, table_of, tangents_for
from knode_cosserat.engine.pattern import Pattern, packed
from knode_cosserat.engine.tangents import SolvedSteps, TangentCore
from knode_cosserat.rods.system import System
from knode_cosserat.schemes.history import StateHistory, StepCoefficients, used_places
from knode_cosserat.schemes.problem import no_history
from knode_cosserat.schemes.settings import Settings
from knode_cosserat.schemes.space import SpaceScheme

#: most numbers of tangents that are kept at once if few are needed: as many as a cache holds
PART = 500_000


class Changes(NamedTuple):
    """Tangents of controls, of the system, and of the residual of the tip's conditions.

    The equations are differentiated once for each direction with a weight, whatever the number of tangents.
    """

    controls: Float[Any, "T c m"]
    #: tangent systems, stacked; None: the system does not change
    directions: Any = None
    #: weight of each direction in each tangent
    weights: Float[Any, "directions m"] | None = None
    #: added to the residual of the tip's conditions
    tip: Any = 0.0
    #: numbers of a row whose tangents are returned (N, x); None: all
    kept: Bool[np.ndarray, "N x"] | None = None


class TangentState(NamedTuple):
    """History before a step at the places of the scheme, and its tangents: the carry of the tangent loop."""

    records: Float[Any, "memory used x"]
    rate: Float[Any, "used x"]
    d_records: Float[Any, "memory used x ..."]
    d_rate: Float[Any, "used x ..."]
    #: time of row 0 (s)
    t0: Any

    @classmethod
    def of(cls, system: System, space: SpaceScheme, past: StateHistory, d_records: Any, d_rate: Any) -> Self:
        """Return the state before the first step, from a history and its tangents at all places.

        Many tangents are columns: one more axis, the last.
        """
        used = used_places(system, space)
        records, d_records = (part[:, :used] for part in (past.records, d_records))
        return cls(records, past.rate[:used], d_records, d_rate[:used], past.t0)


def tangent_time_loop(
    steps: StepCoefficients,
    solved: tuple[Any, Any],
    at: tuple[System, Any],
    changes: Changes,
    state: TangentState,
) -> tuple[TangentState, tuple[Any, Any]]:
    """Return the state after the last of some solved rows, and the tangents of all rows and unknowns.

    They are linear in `changes` and in the tangents of `state`. `solved` are all rows and unknowns, and
    with several stages those of every stage, like the result; `at` are system and controls. Tangents are
    columns: weights, controls, state and results have one more axis, the last. Tangents of rows are those of
    all numbers, (solves, N, x, m), or of the `kept` ones, (solves, q, m).
    """
    (system, controls), settings, (d_controls, _, _, d_tip, kept) = at, steps.settings, changes
    pattern = Pattern.of(system)
    moving, moved, weights = _moves(pattern, changes)
    core = tangents_for(TangentCore, pattern, settings, moving)
    own, d_own = (at_all_stages(system, settings, each) for each in (controls, d_controls))
    table = table_of(steps, len(controls), float(state.t0))
    parameters, found = packed(system), list[tuple[np.ndarray, np.ndarray]]()
    part = max(len(own) if kept is None else PART // (kept.size * weights.shape[1]), 1)
    for first in range(0, max(len(own), 1), part):
        on = slice(first, first + part)
        data = (each[on] for each in (table, own, *solved))
        known = SolvedSteps._make((parameters, *data, state.records, state.rate))
        d_states = state.d_records, state.d_rate
        after, (d_rows, d_unknowns) = core.solve(known, (moved, weights), d_own[on], d_states, d_tip)
        state = TangentState._make((*after, state.t0))
        found.append((d_rows if kept is None else d_rows[:, :, : kept.shape[1]][:, kept], d_unknowns))
    if len(found) == 1:
        return state, found[0]
    d_rows, d_unknowns = (np.concatenate(each) for each in zip(*found, strict=True))
    return state, (d_rows, d_unknowns)


def _moves(pattern: Pattern, changes: Changes) -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
    """Return masks of the parameters that move, the directions in which they do, and weights of these."""
    if changes.directions is None:
        masks = [np.zeros(shape, bool) for shape, _ in pattern.zeros]
        return masks, np.zeros((0, 0)), np.zeros((0, changes.controls.shape[-1]))
    leaves, weights = map(np.asarray, jax.tree.leaves(changes.directions)), np.asarray(changes.weights)
    stacked = [leaf.astype(float) for leaf in leaves]
    masks = [np.any(is_moving(leaf), axis=0) for leaf in stacked]
    moved = [
        leaf[:, mask].reshape(len(leaf), int(mask.sum())) for leaf, mask in zip(stacked, masks, strict=True)
    ]
    # directions of no tangent need no derivatives of the equations
    needed = np.any(weights != 0.0, axis=1)
    return masks, np.concatenate(moved, axis=1)[needed], weights[needed]


def static_tangents(
    settings: Settings, solved: tuple[Any, Any], at: tuple[System, Any], changes: Changes
) -> tuple[Any, Any, Any]:
    """Return the tangents of rows and unknowns of solved equilibria, and of the records of the last.

    Arguments as in `tangent_time_loop`. Records are those at the places of the scheme.
    """
    system = at[0]
    none = no_history(system, settings.space)[: used_places(system, settings.space)]
    d_none = np.zeros((*none.shape, changes.controls.shape[-1]))
    still = dataclasses.replace(settings, time=None)
    before, d_before = (np.stack([each] * still.memory) for each in (none, d_none))
    state = TangentState(before, none, d_before, d_none, 0.0)
    after, found = tangent_time_loop(StepCoefficients.of(still), solved, at, changes, state)
    return *found, after.d_records[0]
