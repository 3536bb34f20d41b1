"""Structured residual from trajectories, solved in closed form, in a few rounds.

Trajectories hold the nodes only. A scheme with stages between nodes also needs the history there. It is
interpolated at first. If the trajectories were simulated, it is then evaluated by the fitted model.
"""

from __future__ import annotations

from collections.abc import Sequence

from knode_cosserat.learning.config import StructuredOptions
from knode_cosserat.learning.knode import KNODE
from knode_cosserat.learning.samples import rows_are_states, samples, strand_samples
from knode_cosserat.learning.structured.regression import solve_residuals
from knode_cosserat.learning.structured.residual import Structured
from knode_cosserat.rods.system import System
from knode_cosserat.trajectory import Trajectory

#: number of repeated solves: each reduces the error to a hundredth
ROUNDS = 2


def residuals_of(
    knowledge: System, trajectories: Sequence[Trajectory], options: StructuredOptions, seeds: Sequence[int]
) -> list[Structured]:
    """Return the structured residuals that explain the trajectories, one for each seed.

    Raises:
        DataError: a trajectory does not fit the knowledge or the others, is too short or not finite.
    """
    found = solve_residuals(
        knowledge, strand_samples(knowledge, samples(knowledge, trajectories)), options, seeds
    )
    if rows_are_states(knowledge, trajectories):
        return found
    for _ in range(ROUNDS):
        found = [
            _again(knowledge, trajectories, options, seed, residual)
            for seed, residual in zip(seeds, found, strict=True)
        ]
    return found


def _again(
    knowledge: System,
    trajectories: Sequence[Trajectory],
    options: StructuredOptions,
    seed: int,
    before: Structured,
) -> Structured:
    data = samples(knowledge, trajectories, model=KNODE(knowledge, before))
    return solve_residuals(knowledge, strand_samples(knowledge, data), options, (seed,))[0]
