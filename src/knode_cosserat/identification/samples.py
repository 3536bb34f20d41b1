"""Random samples of the robots that agree with recordings, whose spread is the band of a prediction."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

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
    trained: Any,
) -> Ensemble | None:
    """Return samples of the robots that agree with the data, and can follow their controls; None if none can.

    They state the noise at each body: by how much the differences of held-out recordings, or of all if none
    was held out, are more than the spread of the samples (root mean squares).
    """
    model, (x, names), samples = search.misfit.model, at, posterior.samples()
    rollouts = search.solved(x)
    assert rollouts is not None
    search.misfit.differentiated(rollouts)
    covariance = np.atleast_2d(np.cov(samples, rowvar=False))
    more: dict[float, list[np.ndarray]] = {}
    for rollout, off in zip(rollouts, held_out or [it.values for it in rollouts], strict=True):
        slopes = rollout.derivatives
        spread = np.einsum("nre,nm,mre->re", slopes, covariance, slopes, optimize=True)
        squares = rollout.data.positions((off**2 - spread) * rollout.data.noise**2) if off.size else None
        for k, place in enumerate(() if squares is None else rollout.data.places):
            more.setdefault(place, []).append(squares[1:, k].ravel())
    noise = [
        (place, float(np.sqrt(max(np.nanmean(np.concatenate(parts)), 0.0))))
        for place, parts in sorted(more.items())
        if np.isfinite(np.concatenate(parts)).any()
    ]
    about, members = About({"identified": True, "noise": noise}), []
    for sample in samples[np.random.default_rng(0).choice(len(samples), MEMBERS, replace=False)]:
        moved = np.clip(x + sample - samples.mean(axis=0), *model.bounds)
        moved = np.where(model.mask(names), moved, 0.0)
        if all(search.misfit.differences(moved)):
            robot = model.reduced(moved, names)
            robot = robot if trained is None else robot.replace(trained=trained)
            members.append(KNODE(robot, Nothing(), about))
    return Ensemble(members) if members else None
