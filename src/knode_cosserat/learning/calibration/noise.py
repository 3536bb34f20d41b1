"""Effect of data noise on calibrated parameters: covariance and bias.

In rollouts noise is only in the targets. In one-segment predictions, a state is the start of one segment, the
target of another and, multiplied by 1/dt, part of the history of later rows. The differences of neighbouring
segments and rows are therefore correlated, and noise also causes a bias. Both follow from the size of the
noise in each field of y and z, which is estimated from the differences. White noise is assumed, independent
between nodes and rows.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from knode_cosserat.learning.calibration.misfit import LinearisedMisfit, SegmentMisfit, by_group
from knode_cosserat.learning.calibration.search import Misfit, SearchResult
from knode_cosserat.solvers.replay import replayed_settings
from knode_cosserat.solvers.segments import histories, segment_history
from knode_cosserat.solvers.slopes import slopes_of
from knode_cosserat.trajectory import Trajectory

#: relative accuracy of the numbers of states
ROUNDING = 1e-14
#: number of draws for the effect of noise in each field on the differences
PROBES = 3


class CoordinateErrors(NamedTuple):
    """Errors of the searched coordinates: covariance and bias."""

    covariance: Float[np.ndarray, "n n"]
    shift: Float[np.ndarray, " n"]

    @property
    def standard(self) -> Float[np.ndarray, " n"]:
        """Standard deviations."""
        return np.sqrt(np.diag(self.covariance))


def errors_of(misfit: Misfit, ended: SearchResult) -> CoordinateErrors:
    """Return the errors of a search's result, from noise of the size of the differences."""
    weights = ended.weights(misfit)
    slopes = misfit(ended.coordinates).slopes[:, ended.free] * weights[:, None]
    lengths = np.linalg.norm(slopes, axis=0)
    inverse = np.linalg.inv((slopes / lengths).T @ (slopes / lengths)) / np.outer(lengths, lengths)
    if not isinstance(misfit, SegmentMisfit):
        freedom = len(slopes) - len(inverse)
        return CoordinateErrors(inverse * len(slopes) / freedom, np.zeros(len(inverse)))
    sizes = noise_sizes(misfit, ended)
    covariance = np.zeros_like(inverse)
    # includes zeros for left-out coordinates, so that one compiled program serves all cases
    moves = np.zeros((len(ended.free), len(weights)))
    moves[ended.free] = inverse @ slopes.T * weights
    for effects in by_states(misfit, ended.coordinates, moves):
        each = (sizes * effects[ended.free]).reshape(len(inverse), -1)
        covariance += each @ each.T
    return CoordinateErrors(covariance, _shift(misfit, ended, sizes))


def hidden_by_rounding(misfit: Misfit, ended: SearchResult) -> np.ndarray:
    """Return true for coordinates (n,) whose effect on the data is at the level of rounding errors.

    Noise of the size of rounding errors then changes their derivatives noticeably. An example is a
    coefficient of a rate in a robot at rest, where the rate is zero.
    """
    hidden = np.zeros(len(ended.free), dtype=bool)
    if not isinstance(misfit, SegmentMisfit):
        return hidden
    slopes = misfit(ended.coordinates).slopes
    rounded = misfit.moved(misfit.draws[0], ROUNDING * typical_sizes(misfit)[misfit.state_groups])
    changed = np.linalg.norm(misfit(ended.coordinates, rounded).slopes - slopes, axis=0)
    return changed > 0.1 * np.linalg.norm(slopes, axis=0)


def typical_sizes(misfit: SegmentMisfit) -> Float[np.ndarray, " fields"]:
    """Return the rms size of each field of y and z."""
    segments = misfit.data.segments
    squares = np.mean(np.square(np.hstack([segments.y, segments.z])), axis=0)
    return np.sqrt(by_group(squares, misfit.state_groups))


def noise_sizes(misfit: SegmentMisfit, ended: SearchResult) -> Float[np.ndarray, " x"]:
    """Return standard deviations of white noise in y and z that explain the differences."""
    # imported here: it takes a third of a second
    from scipy.optimize import nnls

    groups, typical = misfit.state_groups, typical_sizes(misfit)
    # small enough for the differences to be linear in it
    small = 1e-6 * np.maximum(typical, 1e-6 * typical.max())
    still = misfit(ended.coordinates).values
    gains = np.zeros((len(misfit.fields), len(small)))
    for draw in misfit.draws[:PROBES]:
        for field, size in enumerate(small):
            moved = misfit.moved(draw, np.where(groups == field, size, 0.0))
            change = (misfit(ended.coordinates, moved).values - still) / size
            gains[:, field] += by_group(np.square(change), misfit.groups) / PROBES
    seen = ended.sizes > 0.0
    weights = 1.0 / np.square(ended.sizes[seen])
    squares, _ = nnls(gains[seen] * weights[:, None], np.ones(len(weights)))
    return np.sqrt(squares)[groups]


def _shift(
    misfit: SegmentMisfit, ended: SearchResult, sizes: Float[np.ndarray, " x"]
) -> Float[np.ndarray, " n"]:
    """Return the bias of the estimates by noise of these sizes, to leading order.

    Noise is added once more, with both signs, and each time one step of the search is made. It is linear
    in the variance, so the additional noise adds the same bias as the original noise
    (simulation-extrapolation: Cook & Stefanski, J. Am. Stat. Assoc. 89, 1994).
    """
    weights, free = ended.weights(misfit), ended.free
    moved = [misfit.moved(draw, sign * sizes) for draw in misfit.draws for sign in (1.0, -1.0)]
    steps = [_step(misfit(ended.coordinates, each), weights, free) for each in moved]
    return np.mean(steps, axis=0) - _step(misfit(ended.coordinates), weights, free)


def _step(
    there: LinearisedMisfit, weights: Float[np.ndarray, " M"], free: np.ndarray
) -> Float[np.ndarray, " n"]:
    """Return one Gauss-Newton step of the weighted least squares."""
    weighted = there.slopes[:, free] * weights[:, None]
    lengths = np.linalg.norm(weighted, axis=0)
    scaled, *_ = np.linalg.lstsq(weighted / lengths, -there.values * weights)
    return scaled / lengths


def by_states(
    misfit: SegmentMisfit, coordinates: np.ndarray, factors: Float[np.ndarray, "n M"]
) -> list[Float[np.ndarray, "n T N x"]]:
    """Return derivatives of factors times differences by y and z of each trajectory, at all nodes."""
    pulled = misfit.pulled_back(coordinates, factors)
    return [_by_states(misfit, pulled, k, each) for k, each in enumerate(misfit.trajectories)]


def _by_states(
    misfit: SegmentMisfit, pulled: Any, k: int, trajectory: Trajectory
) -> Float[np.ndarray, "n T N x"]:
    """Return derivatives by y and z of trajectory k, from derivatives by its samples.

    This is the transpose of `samples.samples`, which is linear in the states.
    """
    segments, (tip_y, tip_history) = pulled
    data, settings, robot = misfit.data, replayed_settings(trajectory), misfit.robot
    mine, tips = data.segments.origin[:, 0] == k, data.tips.origin[:, 0] == k
    rows = data.tips.origin[tips, 1]
    (count, nodes), (n, ny) = np.shape(trajectory.y)[:2], (len(tip_y), robot.y_layout.size)

    def per_row(values: Any) -> Any:
        return values[:, mine].reshape(n, len(rows), nodes - 1, *values.shape[2:])

    y, z, y_next, *past = segments
    total = np.zeros((n, count, nodes, ny + robot.z_layout.size))
    total[:, rows, :-1, :ny] += per_row(y)
    total[:, rows, :-1, ny:] += per_row(z)
    total[:, rows, 1:, :ny] += per_row(y_next)
    total[:, rows, -1, :ny] += tip_y[:, tips]

    still = np.zeros((nodes, tip_history.shape[-1]))
    _, back = jax.vjp(lambda records: segment_history(robot, settings.space, records), still)
    own = jax.tree.map(per_row, tuple(past))
    history = np.array(jax.vmap(jax.vmap(lambda *each: back(each)[0]))(*own))
    history[:, :, -1] += tip_history[:, tips]
    # states at stages were never measured: they have no noise
    no_stages = np.zeros((count, settings.stages - 1, count))
    _, in_time = histories(settings, trajectory.dt, np.eye(count), no_stages)
    records = np.einsum("rt,nrjx->ntjx", in_time[rows], history)
    if robot.mixed:
        along = slopes_of(settings, np.eye(nodes)[None])[0][0] / misfit.length
        records[..., :ny] += np.einsum("jk,ntjx->ntkx", along, records[..., -ny:])
        records = records[..., :-ny]
    return total + records
