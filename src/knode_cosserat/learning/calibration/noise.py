"""What noise in the data does to parameters that were found from them.

In rollouts noise is only in what they are compared with. In one-segment predictions, a state is in a
segment's start, in what another's end is compared with and, multiplied by 1/dt, in the history of the rows
after it. So the differences of neighbouring segments and rows are correlated, and noise moves the estimates
on average, not only by chance. Both follow from how large the noise is in each field of y and z, which the
differences tell: white noise is assumed, independent from node to node and from row to row.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from knode_cosserat.learning.calibration.misfit import Differences, SegmentMisfit, by_group
from knode_cosserat.learning.calibration.search import Fit, Misfit
from knode_cosserat.learning.samples import histories, past_of_segments, settings_of
from knode_cosserat.learning.sides import slopes_of
from knode_cosserat.trajectory import Trajectory

#: numbers of states are not known better than to this part
ROUNDING = 1e-14
#: draws from which it is taken how large differences become by noise in each field
PROBES = 3


class Errors(NamedTuple):
    """Errors of the coordinates that were searched: their covariance, and what they are on average."""

    covariance: Float[np.ndarray, "n n"]
    shift: Float[np.ndarray, " n"]

    @property
    def standard(self) -> Float[np.ndarray, " n"]:
        """Standard deviations."""
        return np.sqrt(np.diag(self.covariance))


def errors_of(misfit: Misfit, ended: Fit) -> Errors:
    """Errors where a search ended, as noise of the size of the differences makes them."""
    weights = ended.weights(misfit)
    slopes = misfit(ended.coordinates).slopes[:, ended.free] * weights[:, None]
    lengths = np.linalg.norm(slopes, axis=0)
    inverse = np.linalg.inv((slopes / lengths).T @ (slopes / lengths)) / np.outer(lengths, lengths)
    if not isinstance(misfit, SegmentMisfit):
        freedom = len(slopes) - len(inverse)
        return Errors(inverse * len(slopes) / freedom, np.zeros(len(inverse)))
    sizes = noise_sizes(misfit, ended)
    covariance = np.zeros_like(inverse)
    # of what was left out too, which is zero: one compiled program whatever is left out
    moves = np.zeros((len(ended.free), len(weights)))
    moves[ended.free] = inverse @ slopes.T * weights
    for effects in by_states(misfit, ended.coordinates, moves):
        each = (sizes * effects[ended.free]).reshape(len(inverse), -1)
        covariance += each @ each.T
    return Errors(covariance, _shift(misfit, ended, sizes))


def hidden_by_rounding(misfit: Misfit, ended: Fit) -> np.ndarray:
    """Which coordinates the data tell of by their last digits only: (n,), true or false.

    Noise as small as rounding then changes their slopes by more than a little: what multiplies a rate that is
    zero, say, in a robot that is at rest.
    """
    hidden = np.zeros(len(ended.free), dtype=bool)
    if not isinstance(misfit, SegmentMisfit):
        return hidden
    slopes = misfit(ended.coordinates).slopes
    rounded = misfit.moved(misfit.draws[0], ROUNDING * typical_sizes(misfit)[misfit.state_groups])
    changed = np.linalg.norm(misfit(ended.coordinates, rounded).slopes - slopes, axis=0)
    return changed > 0.1 * np.linalg.norm(slopes, axis=0)


def typical_sizes(misfit: SegmentMisfit) -> Float[np.ndarray, " fields"]:
    """How large the numbers of each field of y and z are (rms)."""
    segments = misfit.data.segments
    squares = np.mean(np.square(np.hstack([segments.y, segments.z])), axis=0)
    return np.sqrt(by_group(squares, misfit.state_groups))


def noise_sizes(misfit: SegmentMisfit, ended: Fit) -> Float[np.ndarray, " x"]:
    """Standard deviations of white noise in y and z that explain how large the differences are."""
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


def _shift(misfit: SegmentMisfit, ended: Fit, sizes: Float[np.ndarray, " x"]) -> Float[np.ndarray, " n"]:
    """By how much noise of these sizes moves the estimates on average, to leading order.

    Noise is added once more, with both signs, and each time one step of the search is made. This is linear in
    the variance, so what a second helping adds on average the first has added too (simulation-extrapolation:
    Cook & Stefanski, J. Am. Stat. Assoc. 89, 1994).
    """
    weights, free = ended.weights(misfit), ended.free
    moved = [misfit.moved(draw, sign * sizes) for draw in misfit.draws for sign in (1.0, -1.0)]
    steps = [_step(misfit(ended.coordinates, each), weights, free) for each in moved]
    return np.mean(steps, axis=0) - _step(misfit(ended.coordinates), weights, free)


def _step(there: Differences, weights: Float[np.ndarray, " M"], free: np.ndarray) -> Float[np.ndarray, " n"]:
    """One step of Gauss and Newton towards the least weighted squares."""
    weighted = there.slopes[:, free] * weights[:, None]
    lengths = np.linalg.norm(weighted, axis=0)
    scaled, *_ = np.linalg.lstsq(weighted / lengths, -there.values * weights)
    return scaled / lengths


def by_states(
    misfit: SegmentMisfit, coordinates: np.ndarray, factors: Float[np.ndarray, "n M"]
) -> list[Float[np.ndarray, "n T N x"]]:
    """Derivatives of factors times differences by y and z of each trajectory, all rows and nodes."""
    pulled = misfit.pulled_back(coordinates, factors)
    return [_by_states(misfit, pulled, k, each) for k, each in enumerate(misfit.trajectories)]


def _by_states(
    misfit: SegmentMisfit, pulled: Any, k: int, trajectory: Trajectory
) -> Float[np.ndarray, "n T N x"]:
    """Derivatives by y and z of trajectory k, from those by what its samples hold.

    The way of `samples.samples` backwards: it is linear in the states.
    """
    segments, (tip_y, tip_history) = pulled
    data, settings, robot = misfit.data, settings_of(trajectory), misfit.robot
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
    _, back = jax.vjp(lambda records: past_of_segments(robot, settings.space, records), still)
    own = jax.tree.map(per_row, tuple(past))
    history = np.array(jax.vmap(jax.vmap(lambda *each: back(each)[0]))(*own))
    history[:, :, -1] += tip_history[:, tips]
    _, in_time = histories(settings, trajectory.dt, np.eye(count))
    records = np.einsum("rt,nrjx->ntjx", in_time[rows], history)
    if robot.mixed:
        along = slopes_of(settings, np.eye(nodes)[None])[0][0] / misfit.length
        records[..., :ny] += np.einsum("jk,ntjx->ntkx", along, records[..., -ny:])
        records = records[..., :-ny]
    return total + records
