"""Clocks of the files of a recording: offset and drift, found from the motion that controls cause.

Files are matched by a delay τ. Candidates come from the correlation of the speed of bodies with the rate of
controls. A static model decides between them: positions (as principal components) are linear in the controls
at the time less τ. Its τ contains the lag of the robot's motion. A dynamic model refines it, together with
the drift: accelerations are linear in positions, velocities and the controls at the time less τ. Standard
deviations are those of a jackknife over parts of the recording, with the scatter over the widths of the
filter that differentiates, and a tenth of the lag between the two models.

A robot that reels hold follows its controls: the static model then says more than the dynamic one, whose
positions already tell the controls, and which says as much for delays before and after the true one. The
static model refines such a delay, with a doubt about the lag that remains in it.

The latency of the robot itself cannot be told from an offset of clocks: dead time between a measured control
and the motion is in the offset. The effect `latency` of `identify` takes what is left.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.ndimage
import scipy.signal
from jaxtyping import Bool, Float

from knode_cosserat.recordings.findings import RecordingError

#: width of the filter that differentiates (s), and its multiples whose scatter counts as doubt
WIDTH, WIDTHS = 0.02, (1.0, 1.5, 2.25)
#: finest and coarsest grid (s), and most rows of a grid
FINEST, COARSEST, MOST_ROWS = 0.005, 0.1, 30_000
#: smallest overlap of two files: a part of the shorter one, and seconds
OVERLAP, SHORTEST = 0.4, 2.0
#: distance of delays that are tried (s)
GRID = 0.02
#: number of delays over the whole range, beside candidates
OTHERS = 101
#: number of candidates, and the distance within which they are one (s)
CANDIDATES, APART = 8, 0.3
#: duration in which residuals are one independent number (s)
CORRELATED = 0.2
#: differences of log likelihoods, twice: from no relation at all, from another candidate, and of two
#: standard deviations
RELATED, DECIDED, TWO_SIGMA = 25.0, 10.0, 4.0
#: principal components of positions, and the smallest part of the largest one
COMPONENTS, SMALLEST = 4, 1e-3
#: doubt about the lag between the two models, as a part of it
LAGGING = 0.1
#: doubt about the lag of a robot that follows its controls (s)
FOLLOWING = 0.03
#: largest drift of a clock (1)
LARGEST_DRIFT = 1e-3
#: parts of the jackknife
PARTS = 10


class Signal(NamedTuple):
    """Numbers of a file that move together: increasing times (s), and values; `held` until the next one."""

    time: Float[np.ndarray, " n"]
    values: Float[np.ndarray, "n c"]
    held: bool = False


class Match(NamedTuple):
    """Clock of a second file against a first one.

    Attributes:
        offset: seconds that are added to the second file's times at `at`.
        drift: by how much the second clock is faster than the first (1).
        at: time on the second clock at which the offset holds (s).
        offset_error: standard deviation of the offset (s).
        drift_error: standard deviation of the drift (1).
    """

    offset: float
    drift: float
    at: float
    offset_error: float
    drift_error: float


def match_clocks(first: Signal, second: Signal, *, is_reversed: bool = False) -> Match:
    """Return the clock of a second signal against that of a first one.

    Args:
        first: controls, whose change moves the second signal; or poses of bodies on the same robot.
        second: positions of bodies.
        is_reversed: True to return the clock of the first signal against that of the second.

    Raises:
        RecordingError: the signals have no relation, or several offsets explain it; a phrase.
    """
    dt = float(np.clip(np.median(np.diff(second.time)), FINEST, COARSEST))
    dt = max(dt, (second.time[-1] - second.time[0]) / MOST_ROWS)
    motion = _Motion.of(second, dt)
    widths = max(WIDTH, 1.5 * dt) * np.array(WIDTHS)
    delay, doubt, follows = _best_delay(first, motion, widths[1])
    (tau, drift), errors = _over_widths(first, motion, widths, delay, follows, has_drift=True)
    # a drift that is not known from zero, or not that of a clock, would only add its error
    if abs(drift) < 3.0 * errors[1] or abs(drift) > LARGEST_DRIFT:
        (tau, drift), (errors[0], _) = _over_widths(first, motion, widths, delay, follows, has_drift=False)
    errors[0] = math.hypot(errors[0], doubt)
    if abs(tau - delay) > 3.0 * GRID + 3.0 * errors[0]:
        raise RecordingError("the motion follows no linear model that tells")
    middle = motion.middle
    # time of the first clock = time of the second - tau - drift (time - middle)
    if is_reversed:
        return Match(tau, -drift, middle - tau, float(errors[0]), float(errors[1]))
    return Match(-tau, drift, middle, float(errors[0]), float(errors[1]))


class _Motion(NamedTuple):
    """Positions on an even grid, as principal components, and a mask of the rows that were seen."""

    time: Float[np.ndarray, " T"]
    values: Float[np.ndarray, "T k"]
    seen: Bool[np.ndarray, " T"]

    @classmethod
    def of(cls, signal: Signal, dt: float) -> _Motion:
        time = np.arange(signal.time[0], signal.time[-1] + 1e-9, dt)
        values = np.stack([np.interp(time, signal.time, column) for column in signal.values.T], axis=1)
        values = values - values.mean(axis=0)
        scale, rotation = np.linalg.svd(values, full_matrices=False)[1:]
        if not scale[0] > 0.0:
            raise RecordingError("nothing moves in one of the files")
        kept = min(COMPONENTS, int(np.sum(scale > SMALLEST * scale[0])))
        values = values @ rotation[:kept].T * (math.sqrt(len(time)) / scale[0])
        return cls(
            time, values, _near(time, signal.time, 3.0 * max(dt, float(np.median(np.diff(signal.time)))))
        )

    @property
    def dt(self) -> float:
        return float(self.time[1] - self.time[0])

    @property
    def middle(self) -> float:
        return float(self.time[0] + self.time[-1]) / 2.0

    def filtered(self, width: float, order: int) -> Float[np.ndarray, "T k"]:
        """Return smoothed derivatives."""
        return _filtered(self.values, width / self.dt, order) / self.dt**order


def _filtered(values: np.ndarray, width: float, order: int) -> np.ndarray:
    return np.asarray(scipy.ndimage.gaussian_filter1d(values, width, axis=0, order=order, mode="nearest"))


def _near(at: np.ndarray, time: np.ndarray, longest: float) -> Bool[np.ndarray, " T"]:
    """Return a mask of times that are inside a signal and not in a gap of it."""
    after = np.clip(np.searchsorted(time, at), 1, len(time) - 1)
    inside = (at >= time[0] - 1e-9) & (at <= time[-1] + 1e-9)
    return np.asarray(inside & (time[after] - time[after - 1] <= longest))


def _values_at(signal: Signal, at: np.ndarray) -> tuple[np.ndarray, Bool[np.ndarray, " T"]]:
    """Return a signal's values at other times, scaled to a deviation of one, and a mask of known ones."""
    deviation = signal.values.std(axis=0)
    moved = deviation > 1e-6 * max(deviation.max(), 1e-300)
    scaled = (signal.values[:, moved] - signal.values[:, moved].mean(axis=0)) / deviation[moved]
    usual = float(np.median(np.diff(signal.time)))
    if signal.held:
        known = (at >= signal.time[0] - 1e-9) & (at <= signal.time[-1] + usual)
        return scaled[np.maximum(np.searchsorted(signal.time, at + 1e-9, side="right") - 1, 0)], known
    values = np.stack([np.interp(at, signal.time, column) for column in scaled.T], axis=1)
    return values, _near(at, signal.time, max(5.0 * usual, 0.2))


# candidates


def _best_delay(first: Signal, motion: _Motion, width: float) -> tuple[float, float, bool]:
    """Return the delay (s) that explains the motion best, its doubt (s), and if the static model says more.

    Raises:
        RecordingError: no delay explains the motion, or several do.
    """
    if min(np.ptp(first.time), np.ptp(motion.time)) < SHORTEST:
        raise RecordingError(f"less than {SHORTEST:g} s are there in one of the files")
    wanted = max(SHORTEST, OVERLAP * min(np.ptp(first.time), np.ptp(motion.time)))
    near = np.arange(-15, 16) * GRID
    candidates = np.add.outer(_correlated(first, motion, wanted), near).ravel()
    # others tell if a delay is better than any
    least, most = motion.time[0] - first.time[-1] + wanted, motion.time[-1] - first.time[0] - wanted
    others = np.linspace(least, most, OTHERS)
    grid = np.unique(np.round(np.concatenate([candidates, others]) / GRID).astype(int)) * GRID
    rows = [motion.filtered(width, order) for order in (0, 1, 2)]
    scores = np.array([_likelihoods(first, motion, rows, width, delay, wanted) for delay in grid])
    if not len(grid) or scores[:, 0].max() < RELATED:
        raise RecordingError("controls and motion have no relation that tells")
    static, dynamic, count = scores.T
    both = static + dynamic
    best = int(np.argmax(both))
    # a longer overlap is no better reason: the shorter one of two counts
    mean = np.where(count > 0.0, both, 0.0) / np.maximum(count, 1.0)
    better = (mean[best] - mean) * np.minimum(count, count[best])
    alike = (np.abs(grid - grid[best]) > APART) & (count > 0.0) & (better < DECIDED)
    if alike.any():
        apart = np.min(np.abs(grid - grid[best])[alike])
        raise RecordingError(f"offsets that differ by {apart:.2f} s explain the motion as well as each other")
    # the dynamic model knows the delay without the lag, unless the robot follows its controls
    around = (grid >= grid[best] - APART) & (grid <= grid[best] + 0.5 * APART)
    every = dynamic
    static, dynamic = (np.where(around, each, -math.inf) for each in (static, dynamic))
    # a lag is not negative: a dynamic model that says as much beyond the static one's delay does not know it
    late = grid - grid[int(np.argmax(static))]
    beyond = every[(late > 0.0) & (late <= APART)].max(initial=-math.inf)
    follows = bool(static.max() > dynamic.max() and dynamic.max() - beyond < DECIDED)
    says = static if follows else dynamic
    at = int(np.argmax(says))
    likely = grid[says > says[at] - TWO_SIGMA]
    doubt = 0.25 * float(np.ptp(likely)) if len(likely) > 2 else 0.0
    lagging = FOLLOWING if follows else LAGGING * float(grid[int(np.argmax(static))] - grid[at])
    return float(grid[at]), math.hypot(doubt, lagging), follows


def _correlated(first: Signal, motion: _Motion, wanted: float) -> list[float]:
    """Return the delays (s) of the largest correlations of the rates of change."""
    dt = motion.dt
    time = np.arange(first.time[0], first.time[-1] + 1e-9, dt)
    values, known = _values_at(first, time)
    smooth = max(0.06 / dt, 1.5)
    rates = []
    for numbers, mask in ((motion.values, motion.seen), (values, known)):
        rate = np.linalg.norm(_filtered(numbers, smooth, 1), axis=1)
        rate = np.sqrt(np.minimum(rate, np.quantile(rate[mask], 0.98) if mask.any() else 0.0))
        rates.append(np.where(mask, rate, 0.0))
    (a, b), (m, k) = rates, (motion.seen.astype(float), known.astype(float))

    def moved(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.asarray(scipy.signal.correlate(x, y, mode="full", method="fft"))

    count = np.maximum(moved(m, k), 1e-9)
    mean_a, mean_b = moved(a, k) / count, moved(m, b) / count
    spread = (moved(a * a, k) / count - mean_a**2) * (moved(m, b * b) / count - mean_b**2)
    correlation = (moved(a, b) / count - mean_a * mean_b) / np.sqrt(np.maximum(spread, 1e-12))
    correlation[count * dt < wanted] = -1.0
    peaks, _ = scipy.signal.find_peaks(correlation, distance=max(1, int(0.1 / dt)))
    best = sorted(peaks, key=lambda at: -correlation[at])[:CANDIDATES]
    shift = motion.time[0] - time[0]
    return [float((at - (len(time) - 1)) * dt + shift) for at in best if correlation[at] > 0.0]


def _likelihoods(
    first: Signal, motion: _Motion, rows: Sequence[np.ndarray], width: float, delay: float, wanted: float
) -> tuple[float, float, float]:
    """Return twice the log likelihood ratios of a delay, by the static and the dynamic model.

    The third number is the count of independent rows.
    """
    columns, known = _explaining(first, motion, width, delay, 0.0)
    if np.sum(known) * motion.dt < wanted:
        return -math.inf, -math.inf, 0.0
    independent = np.sum(known) * motion.dt / CORRELATED
    # smoothed rows are not needed more densely than they differ
    used = np.flatnonzero(known)[:: max(1, int(width / motion.dt))]
    position, velocity, acceleration = (each[used] for each in rows)
    constant, columns = np.ones((len(used), 1)), columns[used]
    power, least = (
        np.sum(_residual(position, _basis(own)) ** 2) for own in (constant, np.hstack([constant, columns]))
    )
    own = np.hstack([constant, position, velocity])
    before, after = (
        np.sum(_residual(acceleration, _basis(each)) ** 2, axis=0)
        for each in (own, np.hstack([own, columns]))
    )
    # the first components have most of the motion
    weights = np.sum(acceleration**2, axis=0)
    dynamic = weights @ np.log(np.maximum(before, 1e-300) / np.maximum(after, 1e-300)) / weights.sum()
    static = np.log(power / max(least, 1e-300))
    return float(independent * static), float(independent * dynamic), float(independent)


def _residual(values: np.ndarray, basis: np.ndarray) -> np.ndarray:
    return np.asarray(values - basis @ (basis.T @ values))


def _basis(columns: np.ndarray) -> np.ndarray:
    scale = np.linalg.norm(columns, axis=0)
    scaled = columns / np.where(scale > 0.0, scale, 1.0)
    # by the eigenvectors of the small matrix: many bases of few columns are needed
    s, v = np.linalg.eigh(scaled.T @ scaled)
    kept = s > 1e-10 * s[-1]
    return np.asarray(scaled @ (v[:, kept] / np.sqrt(s[kept])))


def _explaining(
    first: Signal, motion: _Motion, width: float, delay: float, drift: float, order: int = 0
) -> tuple[np.ndarray, Bool[np.ndarray, " T"]]:
    """Return smoothed values of the first signal at the delayed times, or derivatives, and known rows."""
    at = motion.time - delay - drift * (motion.time - motion.middle)
    values, known = _values_at(first, at)
    reach = 4.0 * width
    # rows whose filter reaches into a gap, or beyond an end, are not used
    size = 2 * math.ceil(reach / motion.dt) + 1
    known = known & motion.seen
    padded = np.pad(known, size // 2, constant_values=False)
    known = (
        scipy.ndimage.minimum_filter1d(padded.astype(np.uint8), size)[size // 2 : len(padded) - size // 2] > 0
    )
    return _filtered(values, width / motion.dt, order) / motion.dt**order, known


# refinement


def _over_widths(
    first: Signal, motion: _Motion, widths: np.ndarray, delay: float, follows: bool, *, has_drift: bool
) -> tuple[tuple[float, float], list[float]]:
    """Return delay (s) and drift, and their standard deviations, over the widths of the filter."""
    fits = [_refined(first, motion, width, delay, follows, has_drift) for width in widths]
    values, errors = (np.array([fit[k] for fit in fits]) for k in (0, 1))
    weights = 1.0 / np.maximum(errors[:, 0], 1e-9) ** 2
    weights /= weights.sum()
    tau, drift = weights @ values
    doubt = np.hypot(weights @ errors, np.sqrt(weights @ (values - [tau, drift]) ** 2))
    return (float(tau), float(drift)), doubt.tolist()


def _refined(
    first: Signal, motion: _Motion, width: float, delay: float, follows: bool, has_drift: bool
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return delay (s) and drift, and their standard deviations, by Gauss-Newton and a jackknife."""
    rows = [motion.filtered(width, order) for order in ((0,) if follows else (2, 1, 0))]
    own = np.concatenate([*rows[1:], np.ones((len(motion.time), 1))], axis=1)
    apart = motion.time - motion.middle
    drift = 0.0
    steps: list[np.ndarray] = []
    for _ in range(8):
        columns, known = _explaining(first, motion, width, delay, drift)
        rates, _ = _explaining(first, motion, width, delay, drift, order=1)
        every = np.hstack([own, columns])
        parts = np.array_split(np.flatnonzero(known), PARTS)
        whole = _step(rows[0], every, rates, apart if has_drift else None, np.flatnonzero(known))
        steps = [
            _step(
                rows[0],
                every,
                rates,
                apart if has_drift else None,
                np.concatenate([*parts[:k], *parts[k + 1 :]]),
            )
            for k in range(PARTS)
        ]
        change = float(np.clip(whole[0], -0.02, 0.02))
        delay, drift = delay + change, drift + float(whole[1])
        if abs(change) < 1e-5:
            break
    # estimates that leave a part out, about the whole one
    away = np.array(steps) - np.mean(steps, axis=0)
    errors = np.sqrt((PARTS - 1) / PARTS * np.sum(away**2, axis=0))
    return (delay, drift), (float(errors[0]), float(errors[1]))


def _step(
    y: np.ndarray, columns: np.ndarray, rates: np.ndarray, apart: np.ndarray | None, used: np.ndarray
) -> Float[np.ndarray, " 2"]:
    """Return the Gauss-Newton step of delay and drift; all other coefficients are eliminated.

    Without times `apart` from the middle the drift stays.
    """
    y, columns, rates = y[used], columns[used], rates[used]
    scale = np.linalg.norm(columns, axis=0)
    scaled = columns / np.where(scale > 0.0, scale, 1.0)
    coefficients = np.linalg.lstsq(scaled, y, rcond=1e-8)[0] / np.where(scale > 0.0, scale, 1.0)[:, None]
    # a larger delay takes earlier values
    slope = -rates @ coefficients[-rates.shape[1] :]
    q = _basis(columns)
    residual = _residual(y, q)
    size = np.sqrt(np.mean(residual**2, axis=0))
    of_drift = [] if apart is None else [slope * apart[used, None]]
    slopes = np.stack([slope, *of_drift], axis=-1)
    slopes = slopes - np.einsum("tq,qkp->tkp", q, np.einsum("tq,tkp->qkp", q, slopes))
    a = (slopes / size[:, None]).reshape(residual.size, -1)
    step = np.linalg.lstsq(a, (residual / size).ravel(), rcond=None)[0]
    return np.array([step[0], step[1] if len(step) > 1 else 0.0])
