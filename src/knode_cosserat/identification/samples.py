"""Random samples of the robots that agree with recordings, whose spread is the band of a prediction."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from knode_cosserat.identification.experiments import Experiment
from knode_cosserat.identification.posterior import Posterior
from knode_cosserat.identification.search import ParameterSearch
from knode_cosserat.learning.ensemble import Ensemble
from knode_cosserat.learning.knode import KNODE, About
from knode_cosserat.learning.residual import Nothing

#: number of samples
MEMBERS = 10


def sampled(
    search: ParameterSearch,
    at: tuple[np.ndarray, Sequence[str]],
    posterior: Posterior,
    held_out: Sequence[Float[np.ndarray, "rows e"]],
) -> Ensemble | None:
    """Return samples of the robots that agree with the data, and can follow their controls; None if none can.

    They state the noise at each body: by how much the differences of held-out recordings, or of all if none
    was held out, are more than the spread of the samples (root mean squares).
    """
    model, (x, names), samples = search.misfit.model, at, posterior.samples()
    robots, motions = list[Any](), list[list[np.ndarray]]()
    for sample in samples[np.random.default_rng(0).choice(len(samples), MEMBERS, replace=False)]:
        moved = np.clip(x + sample - samples.mean(axis=0), *model.bounds)
        moved = np.where(model.mask(names), moved, 0.0)
        rollouts = search.misfit.differences(moved)
        if all(rollouts):
            robots.append(model.reduced(moved, names))
            motions.append([it.values for it in rollouts if it is not None])
    if not robots:
        return None
    if not held_out:
        held_out = [it.values for it in search.solved(x) or ()]
    spread = [np.var(it, axis=0, ddof=min(1, len(it) - 1)) for it in zip(*motions, strict=True)]
    noise = _noise(search.misfit.data, held_out, spread)
    return Ensemble(KNODE(it, Nothing(), About({"identified": True, "noise": noise})) for it in robots)


def _noise(
    data: Sequence[Experiment],
    differences: Sequence[Float[np.ndarray, "rows e"]],
    spread: Sequence[Float[np.ndarray, "rows e"]],
) -> list[tuple[float, float]]:
    """Return places of bodies, and the root mean square (m) by which differences are more than a variance."""
    more: dict[float, list[np.ndarray]] = {}
    for it, off, variance in zip(data, differences, spread, strict=False):
        squares = it.positions((off**2 - variance) * it.noise**2) if off.size else None
        if squares is not None:
            for k, place in enumerate(it.places):
                more.setdefault(place, []).append(squares[1:, k].ravel())
    known = {place: np.concatenate(parts) for place, parts in sorted(more.items())}
    means = {place: np.nanmean(it) for place, it in known.items() if np.isfinite(it).any()}
    return [(place, float(np.sqrt(max(mean, 0.0)))) for place, mean in means.items()]
