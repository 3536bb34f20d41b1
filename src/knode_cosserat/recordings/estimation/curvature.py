"""Maximum a posteriori curvature of a rod, over arclength and time, from motion capture.

The curvature's coefficients are curves in time (`smoothing`), the bodies' poses follow from them
(`kinematics`), and Gauss-Newton's method finds the curves. The smoothness and the noise level maximise the
evidence of the poses by MacKay's fixed point. The prior determines modes that are poorly observed.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Bool, Float

from knode_cosserat.recordings.estimation import kinematics
from knode_cosserat.recordings.estimation.kinematics import MODES, RodGeometry, RodShape, Sensitivity
from knode_cosserat.recordings.estimation.smoothing import ORDER, Banded, Splines

#: largest spacing of knots (s); the frame period if that is longer
SPACING = 0.04
#: minimum number of Gauss-Newton iterations, and further iterations at most
CORRECTIONS, CHOICES = 5, 3
#: tolerance on the change of the curvature's coefficients (1/m)
CLOSE = 1e-6
#: lower bounds of the noise (m, rad)
LEAST_NOISE = (1e-6, 1e-5)
#: standard deviation of a weak prior on the curvature's coefficients (1/m)
LARGEST = 30.0
#: initial bandwidth of the motion in the search for the smoothness (Hz)
BEGIN = 6.0
#: smallest exponent of the growth of the prior's precision with the cosines' order; its initial value
DECAY, BEGIN_DECAY = 2.0, 4.0
#: regularisation of the precision's profile: at zero jerk the precision is (1 + 1/QUIET) times as large
QUIET = 0.05
#: width of the jerk's Gaussian average, in points of the prior: 3 points per knot interval
WIDTH = 2.0
_PROBES = 4


@dataclasses.dataclass(frozen=True, eq=False)
class BodyPoses:
    """Poses of all bodies at F times; masked values are arbitrary but finite.

    Attributes:
        time: times (s), increasing.
        position: positions (m).
        quaternion: orientations, scalar first.
        placed: True where a position was seen.
        turned: True where an orientation was seen.
    """

    time: Float[np.ndarray, " F"]
    position: Float[np.ndarray, "F M 3"]
    quaternion: Float[np.ndarray, "F M 4"]
    placed: Bool[np.ndarray, "F M"]
    turned: Bool[np.ndarray, "F M"]


@dataclasses.dataclass(frozen=True, eq=False)
class CurvatureFit:
    """Fitted curvature.

    Attributes:
        splines: splines in time.
        curves: coefficients of the splines.
        stretch: ratio of the rod's length to its model's length.
        noise: standard deviations of a coordinate (m) and of an angle (rad).
    """

    splines: Splines
    curves: Float[np.ndarray, "n K"]
    stretch: float
    noise: tuple[float, float]

    def at(self, time: Float[np.ndarray, " T"]) -> Float[np.ndarray, "3 T K"]:
        """Return the curvature's coefficients and their first two rates at given times (s)."""
        return np.stack([np.asarray(self.splines.design(time, order) @ self.curves) for order in range(3)])


def fitted(rod: RodGeometry, poses: BodyPoses, stretch: float, noise: tuple[float, float]) -> CurvatureFit:
    """Return the most likely curvature over time; `noise` and `stretch` are initial values."""
    usual = float(np.median(np.diff(poses.time)))
    splines = Splines.of(poses.time[0], poses.time[-1], max(SPACING, usual))
    design = splines.design(poses.time)
    groups = kinematics.mode_groups()
    ridge = np.full(rod.modes, 1.0 / LARGEST**2)
    curves = np.zeros((splines.count, rod.modes))
    precision: np.ndarray | None = None
    profile = np.ones(splines.points)
    for correction in range(CORRECTIONS + CHOICES):
        a = np.asarray(design @ curves)
        it = kinematics.rod_shape(rod, a, stretch)
        left = _left(rod, it, poses)
        moves = kinematics.sensitivity(rod, it)
        H, g = _normal(moves, left, poses, noise, a)
        system = Banded(splines, design, H, g, splines.roots_of(profile))
        if precision is None:
            share = np.einsum("fkk->k", H) / len(H) / usual
            precision = share / (2 * np.pi * BEGIN) ** (2 * ORDER)
            precision = _decaying(_shared(precision, groups), BEGIN_DECAY)[groups]
        system.factorise(precision, ridge)
        new = system.curve()
        if correction >= 2:
            # after the first iterations the residual is noise
            precision, effective = _likelier(system, new, precision, groups)
            profile = _profile(splines, new, precision)
            after = _after(moves, left, poses, np.asarray(design @ new) - a)
            noise = _noise(after, poses, effective, noise)
            stretch += _stretching(rod, it, after[1])
        change = np.max(np.abs(np.asarray(design @ new) - a))
        curves = new
        if correction >= CORRECTIONS and change < CLOSE:
            break
    return CurvatureFit(splines, curves, stretch, noise)


def _left(rod: RodGeometry, it: RodShape, poses: BodyPoses) -> tuple[np.ndarray, np.ndarray]:
    """Return the residuals of poses: rotations (rad) and shifts (m), zero where nothing was seen."""
    turns = kinematics.turn_between(poses.quaternion, it.h[:, rod.bodies])
    shifts = poses.position - it.p[:, rod.bodies]
    return turns * poses.turned[..., None], shifts * poses.placed[..., None]


def _stretching(rod: RodGeometry, it: RodShape, shifts: Float[np.ndarray, "F M 3"]) -> float:
    """Return the least-squares correction of the stretch from the residual shifts along the position."""
    along = it.p[:, rod.bodies] - rod.origin
    return float(np.sum(along * shifts) / np.sum(along**2))


def _normal(
    moves: Sensitivity,
    left: tuple[np.ndarray, np.ndarray],
    poses: BodyPoses,
    noise: tuple[float, float],
    a: Float[np.ndarray, "F K"],
) -> tuple[np.ndarray, np.ndarray]:
    """Return H and g of every frame, as defined in `smoothing`."""
    F, _, _, K = moves.turn.shape
    rows = np.concatenate(
        [
            (moves.turn * poses.turned[..., None, None] / noise[1]).reshape(F, -1, K),
            (moves.shift * poses.placed[..., None, None] / noise[0]).reshape(F, -1, K),
        ],
        axis=1,
    )
    wanted = np.concatenate([left[0].reshape(F, -1) / noise[1], left[1].reshape(F, -1) / noise[0]], axis=1)
    wanted = wanted + (rows @ a[..., None])[..., 0]
    back = np.swapaxes(rows, 1, 2)
    return back @ rows, (back @ wanted[..., None])[..., 0]


def _shared(values: Float[np.ndarray, " K"], groups: np.ndarray) -> Float[np.ndarray, " groups"]:
    return np.bincount(groups, values) / np.bincount(groups)


def _likelier(
    system: Banded, curves: Float[np.ndarray, "n K"], precision: Float[np.ndarray, " K"], groups: np.ndarray
) -> tuple[Float[np.ndarray, " K"], float]:
    """Return an updated τ for every mode, and the effective number of parameters.

    MacKay's fixed point: τ = γ / ∫ (c''')² dt, where γ is the number of parameters of the jerk that are
    determined by the poses rather than by the prior. Its trace is estimated by random probes with a fixed
    seed.
    """
    roots = system.roots
    n, K = curves.shape
    rows = roots.shape[0]
    random = np.random.default_rng(0)
    count = int(groups.max()) + 1
    probes = np.zeros((n, K, count * _PROBES))
    for group in range(count):
        for axis in np.flatnonzero(groups == group):
            signs = random.choice([-1.0, 1.0], (rows, _PROBES))
            probes[:, axis, group * _PROBES : (group + 1) * _PROBES] = roots.T @ signs
    flat = probes.reshape(n * K, -1)
    traces = np.einsum("xp,xp->p", flat, system.solve(flat)).reshape(count, _PROBES).mean(axis=1)
    dimensions = n * np.bincount(groups)
    tau = np.array([precision[groups == group][0] for group in range(count)])
    determined = np.clip(dimensions - tau * traces, 1e-3 * dimensions, dimensions)
    jerk = np.bincount(groups, np.sum(np.square(roots @ curves), axis=0))
    new = determined / np.maximum(jerk, 1e-300)
    # limit the change of one update
    new = np.clip(new, tau / 1e3, tau * 1e3)
    return _decaying(new, DECAY)[groups], float(determined.sum())


def _decaying(precision: Float[np.ndarray, " groups"], power: float) -> Float[np.ndarray, " groups"]:
    """Return precisions that grow with the order: the evidence hardly determines poorly observed modes."""
    first = 0
    for size in (max(MODES[:2]), MODES[2]):
        for k in range(1, size):
            least = precision[first + k - 1] * ((k + 1) / k) ** power
            precision[first + k] = max(precision[first + k], least)
        first += size
    return precision


def _profile(
    splines: Splines, curves: Float[np.ndarray, "n K"], precision: Float[np.ndarray, " K"]
) -> Float[np.ndarray, " points"]:
    """Return the prior's relative precision over time: lower where the jerk is large, as after a step."""
    from scipy.ndimage import gaussian_filter1d

    jerk = splines.roots[: splines.points] @ curves
    size = np.sum(jerk**2 * precision, axis=1)
    size = gaussian_filter1d(size, WIDTH)
    return (1.0 + QUIET) / (size / size.mean() + QUIET)


def _after(
    moves: Sensitivity,
    left: tuple[np.ndarray, np.ndarray],
    poses: BodyPoses,
    change: Float[np.ndarray, "F K"],
) -> tuple[np.ndarray, np.ndarray]:
    """Return the residual rotations (rad) and shifts (m) after a change of the coefficients."""
    by = change[:, None, :, None]
    turns = left[0] - (moves.turn @ by)[..., 0] * poses.turned[..., None]
    return turns, left[1] - (moves.shift @ by)[..., 0] * poses.placed[..., None]


def _noise(
    after: tuple[np.ndarray, np.ndarray], poses: BodyPoses, effective: float, noise: tuple[float, float]
) -> tuple[float, float]:
    """Return the standard deviations of a coordinate and of an angle, from the residuals."""
    counts = 3.0 * np.array([poses.placed.sum(), poses.turned.sum()])
    kept = max(0.2, 1.0 - effective / counts.sum())
    sums = np.array([np.sum(after[1] ** 2), np.sum(after[0] ** 2)])
    found = np.sqrt(sums / np.maximum(counts * kept, 1.0))
    found = np.where(counts > 0, np.maximum(found, LEAST_NOISE), noise)
    return float(found[0]), float(found[1])
