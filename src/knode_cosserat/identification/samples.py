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
#: deviations are at most multiplied by this
MOST_INFLATED = 30.0


def sampled(
    search: ParameterSearch,
    at: tuple[np.ndarray, Sequence[str]],
    posterior: Posterior,
    held_out: Sequence[Float[np.ndarray, "rows e"]],
    trained: Any,
) -> Ensemble | None:
    """Return samples of the robots that agree with the data, and can follow their controls; None if none can.

    Their spread is, in root mean square, at least that of the differences of held-out recordings, or of all
    recordings if none was held out.
    """
    model, (x, names), samples = search.misfit.model, at, posterior.samples()
    rollouts = search.solved(x)
    assert rollouts is not None
    search.misfit.differentiated(rollouts)
    covariance, expected, seen = np.atleast_2d(np.cov(samples, rowvar=False)), 0.0, 0.0
    for rollout, off in zip(rollouts, held_out or [it.values for it in rollouts], strict=True):
        slopes = rollout.derivatives
        spread = np.einsum("nre,nm,mre->re", slopes, covariance, slopes, optimize=True)
        known = np.isfinite(off) if off.size else np.zeros_like(spread, dtype=bool)
        expected, seen = expected + np.sum(spread[known]), seen + np.sum(off[known] ** 2)
    ratio = np.clip(np.sqrt(seen / max(expected, np.finfo(float).tiny)), 1.0, MOST_INFLATED)
    members = []
    for sample in samples[np.random.default_rng(0).choice(len(samples), MEMBERS, replace=False)]:
        wide = np.clip(x + ratio * (sample - samples.mean(axis=0)), *model.bounds)
        wide = np.where(model.mask(names), wide, 0.0)
        if all(search.misfit.differences(wide)):
            robot = model.reduced(wide, names)
            robot = robot if trained is None else robot.replace(trained=trained)
            members.append(KNODE(robot, Nothing(), About({"identified": True})))
    return Ensemble(members) if members else None
