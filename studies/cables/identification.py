"""Parameters of a cable from rollouts of a few motions: short pieces first, whole motions in the end.

Long rollouts of a cable that is far from the real one drift out of phase, and least squares then prefers too
much damping. Pieces of 0.4 s keep the phase. Each stage begins with the numbers of the one before; the best
stage on motions that were not used is kept.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from studies.cables.model import CableParameters
from studies.cables.rollouts import NAMES, UNKNOWNS, Rollouts, cable_coordinates, cable_parameters, in_threads

_LOG = logging.getLogger(__name__)
#: differences from which on they count by their size instead of their square (m)
SCALE = 0.02
#: Levenberg-Marquardt: damping at the start, and corrections that are tried
DAMPING, TRIES = 1e-2, 4
#: twists (rad) that the first stage begins with
TWISTS = (0.0, 2.0, -2.0)
#: part of the pieces that has to be simulated
SIMULATED = 2 / 3
#: relative gain at which a stage ends
ENOUGH = 5e-3


class SearchStage(NamedTuple):
    """Pieces of motions (frames, number), unknowns, corrections at most; one in `every` frames counts."""

    frames: int
    pieces: int
    names: tuple[str, ...]
    corrections: int
    every: int = 3


FIRST = (
    "bending",
    "torsion",
    "curvature0",
    "curvature1",
    "twist",
    "base_tangent0",
    "base_tangent1",
    "tip_tangent0",
    "tip_tangent1",
    "drag",
)
MORE = (
    *FIRST,
    "damping_time",
    "offset0",
    "offset1",
    "curvature_change0",
    "curvature_change1",
    "stretch",
)
#: all but the place of the mass
MOST = tuple(name for name in NAMES if name != "eccentric")
#: chosen on DLO1 and DLO2
STAGES = (
    SearchStage(40, 12, FIRST, 6),
    SearchStage(40, 18, MORE, 8),
    SearchStage(120, 12, MOST, 5, 4),
    SearchStage(480, 6, MOST, 6, 6),
    SearchStage(480, 6, NAMES, 4, 6),
)


class IdentifiedCable(NamedTuple):
    """Best parameters, and the error of each stage on held-out motions (m)."""

    parameters: CableParameters
    errors: tuple[float, ...]
    notes: tuple[str, ...]


def identify_cable(
    rollouts: Rollouts,
    start: CableParameters,
    motions: Sequence[Float[np.ndarray, "T N 3"]],
    validate: Callable[[CableParameters], float],
    stages: Sequence[SearchStage] = STAGES,
    seconds: float = np.inf,
) -> IdentifiedCable:
    """Return the parameters that predict motions best, by `validate` (m, lower is better).

    A stage that fails, or is worse, leaves the best parameters as they are. No stage begins after `seconds`.
    """
    began = time.process_time()
    best, errors, notes = start, [validate(start)], []
    latest = start
    for number, stage in enumerate(stages):
        if time.process_time() - began > seconds:
            notes.append(f"stage {number + 1} was left out for time")
            break
        tried = []
        for begin in (latest,) if number or "twist" not in stage.names else _twisted(start):
            try:
                found = _searched(rollouts, begin, motions, stage, number, began + seconds)
                tried.append((validate(found), found))
            except (ValueError, RuntimeError, ArithmeticError) as error:
                notes.append(f"stage {number + 1} failed: {' '.join(str(error).split())}")
        if not tried:
            latest = best
            continue
        error_now, latest = min(tried, key=lambda each: each[0])
        errors.append(error_now)
        if errors[-1] < min(errors[:-1]):
            best = latest
        _LOG.info("stage %d: %.2f mm on motions not used; %s", number + 1, 1e3 * errors[-1], latest)
    return IdentifiedCable(best, tuple(errors), tuple(notes))


def _twisted(start: CableParameters) -> list[CableParameters]:
    """Return the start with several twists between the grips: the twist is not measured."""
    return [start.replace(twist=start.twist + twist) for twist in TWISTS]


def _searched(
    rollouts: Rollouts, start: CableParameters, motions: Any, stage: SearchStage, seed: int, until: float
) -> CableParameters:
    """Least squares by Levenberg-Marquardt with a robust loss.

    A piece that cannot be simulated is left out, and losses are compared on the others.
    """
    rollouts.forget()
    pieces = _pieces(motions, stage, seed)
    least = SIMULATED * len(pieces)
    x, damping = cable_coordinates(start), DAMPING
    chosen = np.array([NAMES.index(name) for name in stage.names])
    prior, moves = (
        np.array([getattr(UNKNOWNS[name], part) for name in stage.names]) for part in ("width", "move")
    )
    middle = x[chosen]

    def simulated(x: Any) -> list[Any]:
        return in_threads(lambda one: rollouts.columns(x, one[1], one[0]), pieces)

    def point(both: list[Any], x: Any) -> _Point:
        return _Point.of(both, chosen, stage.every, _weight(prior), x[chosen] - middle)

    here = simulated(x)
    pieces, here = _kept(_finite(here), pieces, here)
    if not pieces:
        raise ValueError("no piece of a motion can be simulated")
    for _ in range(stage.corrections):
        now = point(here, x)
        for _ in range(TRIES):
            matrix = now.square + damping * np.diag(np.diag(now.square))
            moved = x.copy()
            moved[chosen] += np.clip(-np.linalg.solve(matrix, now.gradient), -moves, moves)
            there = simulated(moved)
            solved = _finite(there)
            before, after = (point(_kept(solved, each)[0], at) for each, at in ((here, x), (there, moved)))
            if sum(solved) >= least and after.loss < before.loss:
                break
            damping *= 6.0
            if time.process_time() > until:
                return cable_parameters(x)
        else:
            break
        gain, x, damping = before.loss - after.loss, moved, max(damping / 5.0, 1e-4)
        pieces, here = _kept(solved, pieces, there)
        _LOG.info("%d frames: loss %.4f to %.4f", stage.frames, before.loss, after.loss)
        if gain < ENOUGH * before.loss or time.process_time() > until:
            break
    return cable_parameters(x)


def _finite(both: Sequence[Any]) -> list[bool]:
    """True for each piece that was simulated."""
    return [all(np.isfinite(part).all() for part in each) for each in both]


def _kept(which: Sequence[bool], *lists: Sequence[Any]) -> list[list[Any]]:
    """Return the items of lists for which `which` is true."""
    return [[each for each, keep in zip(items, which, strict=True) if keep] for items in lists]


class _Point(NamedTuple):
    """Robust loss, its gradient, and the Gauss-Newton matrix."""

    loss: float
    gradient: Float[np.ndarray, " n"]
    square: Float[np.ndarray, "n n"]

    @classmethod
    def of(cls, both: Any, chosen: Any, every: int, weight: Any, off: Any) -> _Point:
        """Return these from differences and derivatives of pieces, with a prior about the start."""
        if not both:
            return cls(np.inf, np.zeros(len(chosen)), np.zeros((len(chosen), len(chosen))))
        values = np.concatenate([each[0][::every].ravel() for each in both])
        slopes = np.concatenate([each[1][chosen, ::every].reshape(len(chosen), -1) for each in both], axis=1)
        roots = np.sqrt(1.0 + (values / SCALE) ** 2)
        loss = 2.0 * SCALE**2 * np.sum(roots - 1.0) + 0.5 * weight @ off**2
        # the loss is twice that of least squares over 2, and so is its gradient
        gradient = 2.0 * slopes @ (values / roots) + weight * off
        return cls(float(loss), gradient, 2.0 * (slopes / roots) @ slopes.T + np.diag(weight))


def _weight(width: Any) -> Any:
    """Weights of the prior: its width counts as ten differences of 1 cm."""
    return 10.0 * 0.01**2 / np.asarray(width) ** 2


def _pieces(motions: Any, stage: SearchStage, seed: int) -> list[tuple[Any, Any]]:
    """Pieces at random places of all motions in turn, with a key each."""
    rng = np.random.default_rng(seed)
    found = []
    for k in range(stage.pieces):
        markers = motions[k % len(motions)]
        frames = min(stage.frames + 2, len(markers))
        begin = int(rng.integers(0, len(markers) - frames + 1))
        found.append(((k % len(motions), begin, frames), markers[begin : begin + frames]))
    return found
