"""What noise in measured states does to parameters that were found from one-segment predictions.

A state is in a segment's start, in what it is compared with, and, multiplied by 1/dt, in the history of the
rows after it. So the differences of neighbouring segments and rows are correlated, and noise moves the
estimates on average, not only by chance. Both follow from how large the noise is in each field of y and z,
which the differences tell: white noise is assumed, independent from node to node and from row to row.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

from knode_cosserat.learning.misfit import Differences, SegmentMisfit, by_group
from knode_cosserat.learning.samples import _histories, _settings, _slopes
from knode_cosserat.solvers.space import middles
from knode_cosserat.trajectory import Trajectory

#: pairs of draws, with opposite signs, from which the shift of the estimates is taken
PAIRS = 16
#: draws from which it is taken how large differences become by noise in each field
PROBES = 3


class MeasurementNoise:
    """White noise in y and z, as large as the differences at an estimate say.

    `sizes` are standard deviations, by number of y and z.
    """

    def __init__(self, misfit: SegmentMisfit, coordinates: np.ndarray, sizes: Float[np.ndarray, " G"]):
        """`sizes`: root mean squares of the differences, by field."""
        # imported here: it takes a third of a second
        from scipy.optimize import nnls

        self.misfit, self.coordinates = misfit, coordinates
        rng = np.random.default_rng(0)
        self._draws = [misfit.unit_noise(rng) for _ in range(PAIRS)]
        gains = self._gains()
        seen = sizes > 0.0
        weight = 1.0 / np.square(sizes[seen])
        squares, _ = nnls(gains[seen] * weight[:, None], np.square(sizes[seen]) * weight)
        self.sizes = np.sqrt(squares)[misfit.state_groups]

    def _gains(self) -> Float[np.ndarray, "G F"]:
        """Mean squares of the differences in each field (G) per variance of each field of y and z (F)."""
        misfit, groups = self.misfit, self.misfit.state_groups
        segments = misfit.data.segments
        typical = np.sqrt(by_group(np.mean(np.square(np.hstack([segments.y, segments.z])), axis=0), groups))
        # small enough for the differences to be linear in it
        small = 1e-6 * np.maximum(typical, 1e-6 * typical.max())
        still = misfit(self.coordinates).values
        gains = np.zeros((len(misfit.fields), len(small)))
        for draw in self._draws[:PROBES]:
            for field, size in enumerate(small):
                moved = misfit.moved(draw, np.where(groups == field, size, 0.0))
                change = (misfit(self.coordinates, moved).values - still) / size
                gains[:, field] += by_group(np.square(change), misfit.groups) / PROBES
        return gains

    def covariance(self, sensitivity: Float[np.ndarray, "n M"]) -> Float[np.ndarray, "n n"]:
        """Covariance of estimates that move by `sensitivity` times the change of the differences."""
        pulled = self.misfit.pulled_back(self.coordinates, sensitivity)
        total = np.zeros((len(sensitivity), len(sensitivity)))
        for k, trajectory in enumerate(self.misfit.trajectories):
            by_state = self.sizes * _by_states(self.misfit, pulled, k, trajectory)
            each = by_state.reshape(len(sensitivity), -1)
            total += each @ each.T
        return total

    def shift(self, weights: Float[np.ndarray, " M"], free: np.ndarray) -> Float[np.ndarray, " n"]:
        """By how much noise of these sizes moves the estimates on average, to leading order.

        Noise is added once more, with both signs, and each time one step of the search is made. This is
        linear in the variance, so what a second helping adds on average the first has added too
        (simulation-extrapolation: Cook & Stefanski, J. Am. Stat. Assoc. 89, 1994).
        """
        total = np.zeros(np.count_nonzero(free))
        for draw in self._draws:
            for sign in (1.0, -1.0):
                values, slopes = self.misfit(self.coordinates, self.misfit.moved(draw, sign * self.sizes))
                total += step(Differences(values, slopes[:, free]), weights)
        still = self.misfit(self.coordinates)
        return total / (2 * len(self._draws)) - step(
            Differences(still.values, still.slopes[:, free]), weights
        )


def step(differences: Differences, weights: Float[np.ndarray, " M"]) -> Float[np.ndarray, " n"]:
    """One step of Gauss and Newton towards the least weighted squares."""
    weighted = differences.slopes * weights[:, None]
    lengths = np.linalg.norm(weighted, axis=0)
    scaled, *_ = np.linalg.lstsq(weighted / lengths, -differences.values * weights)
    return scaled / lengths


def _by_states(
    misfit: SegmentMisfit, pulled: Any, k: int, trajectory: Trajectory
) -> Float[np.ndarray, "n T N x"]:
    """Derivatives by y and z of trajectory k, from those by what its samples hold.

    The way of `samples.samples` backwards: it is linear in the states.
    """
    segments, (tip_y, tip_history) = pulled
    data, settings, robot = misfit.data, _settings(trajectory), misfit.robot
    mine, tips = data.segments.origin[:, 0] == k, data.tips.origin[:, 0] == k
    rows = data.tips.origin[tips, 1]
    (count, nodes), (n, ny) = np.shape(trajectory.y)[:2], (len(tip_y), robot.y_layout.size)

    def per_row(values: Any) -> Any:
        return values[:, mine].reshape(n, len(rows), nodes - 1, -1)

    y, z, y_next, (start, middle, end) = segments
    total = np.zeros((n, count, nodes, ny + robot.z_layout.size))
    total[:, rows, :-1, :ny] += per_row(y)
    total[:, rows, :-1, ny:] += per_row(z)
    total[:, rows, 1:, :ny] += per_row(y_next)
    total[:, rows, -1, :ny] += tip_y[:, tips]

    history = np.einsum("sj,nrsx->nrjx", middles(np.eye(nodes)), per_row(middle))
    history[:, :, :-1] += per_row(start)
    history[:, :, 1:] += per_row(end)
    history[:, :, -1] += tip_history[:, tips]
    _, in_time = _histories(settings, trajectory.dt, np.eye(count))
    records = np.einsum("rt,nrjx->ntjx", in_time[rows], history)
    if robot.mixed:
        along = _slopes(settings, np.eye(nodes)[None])[0][0] / misfit.length
        records[..., :ny] += np.einsum("jk,ntjx->ntkx", along, records[..., -ny:])
        records = records[..., :-ny]
    return total + records
