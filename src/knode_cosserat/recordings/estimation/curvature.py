"""Maximum a posteriori curvature of a rod, over arclength and time, from motion capture.

The curvature's coefficients are curves in time, c(t) = Σ_l B_l(t) c_l with B-splines B_l and K numbers in
each c_l. The bodies' poses follow from them (`kinematics`), and Gauss-Newton's method finds the curves. Frame
i contributes ½ aᵀ H_i a - g_iᵀ a with the curve's value a = c(t_i). The prior is, with ''' the third
derivative,

    ½ Σ_k τ_k ∫ (c_k''')² + Ω⁶ c_k² dt.

Above the frequency Ω it is the prior of a motion with white-noise jerk of the intensity 1/τ_k. Below Ω the
spectrum is flat, so that slow motion stays near zero. Data and prior form a banded system. The smoothness and
the noise level maximise the evidence of the poses by MacKay's fixed point. The prior determines modes that
are poorly observed.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import scipy.sparse
from jaxtyping import Bool, Float
from scipy.interpolate import BSpline
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.ndimage import gaussian_filter1d

from knode_cosserat.recordings.estimation import kinematics
from knode_cosserat.recordings.estimation.kinematics import MODES, RodGeometry

#: degree of the splines: the rate of the accelerations is smooth
DEGREE = 5
#: derivative penalised by the prior, and frequency below which the value itself is penalised (Hz)
ORDER, CORNER = 3, 0.6
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
class CapturedPoses:
    """Poses of all bodies at F times (s), quaternions scalar first; unseen values are arbitrary but finite.

    `placed` and `turned` are True where a position or an orientation was seen.
    """

    time: Float[np.ndarray, " F"]
    position: Float[np.ndarray, "F M 3"]
    quaternion: Float[np.ndarray, "F M 4"]
    placed: Bool[np.ndarray, "F M"]
    turned: Bool[np.ndarray, "F M"]


@dataclasses.dataclass(frozen=True, eq=False)
class _CurvatureFit:
    """Fitted curvature: splines in time and their coefficients.

    `stretch` is the ratio of the rod's length to its model's; `noise` are standard deviations of a coordinate
    (m) and of an angle (rad).
    """

    splines: _Splines
    curves: Float[np.ndarray, "n K"]
    stretch: float
    noise: tuple[float, float]

    def at(self, time: Float[np.ndarray, " T"]) -> Float[np.ndarray, "3 T K"]:
        """Return the curvature's coefficients and their first two rates at given times (s)."""
        return np.stack([np.asarray(self.splines.design(time, order) @ self.curves) for order in range(3)])


def fitted(
    rod: RodGeometry, poses: CapturedPoses, stretch: float, noise: tuple[float, float]
) -> _CurvatureFit:
    """Return the most likely curvature over time; `noise` and `stretch` are initial values."""
    usual = float(np.median(np.diff(poses.time)))
    splines = _Splines.of(poses.time[0], poses.time[-1], max(SPACING, usual))
    design = splines.design(poses.time)
    groups = kinematics.mode_groups()
    ridge = np.full(rod.modes, 1.0 / LARGEST**2)
    curves = np.zeros((splines.count, rod.modes))
    precision: np.ndarray | None = None
    profile = np.ones(splines.points)
    frames, size = len(poses.time), 3 * len(rod.bodies)
    # rotations (rad) of all bodies, then shifts (m); zero where nothing was seen
    seen = np.repeat(np.concatenate([poses.turned, poses.placed], axis=1), 3, axis=1)
    for correction in range(CORRECTIONS + CHOICES):
        a = np.asarray(design @ curves)
        shape = kinematics.rod_shape(rod, a, stretch)
        turns = kinematics.turn_between(poses.quaternion, shape.h[:, rod.bodies])
        shifts = poses.position - shape.p[:, rod.bodies]
        residual = seen * np.concatenate([turns.reshape(frames, -1), shifts.reshape(frames, -1)], axis=1)
        moves = [part.reshape(frames, size, -1) for part in kinematics.sensitivity(rod, shape)]
        J = seen[..., None] * np.concatenate(moves, axis=1)
        sigma = np.repeat(noise[::-1], size)
        rows = J / sigma[:, None]
        wanted = residual / sigma + (rows @ a[..., None])[..., 0]
        back = np.swapaxes(rows, 1, 2)
        H, g = back @ rows, (back @ wanted[..., None])[..., 0]
        system = _Banded(splines, design, H, g, splines.roots_of(profile))
        if precision is None:
            share = np.einsum("fkk->k", H) / len(H) / usual
            shared = _shared(share / (2 * np.pi * BEGIN) ** (2 * ORDER), groups)
            precision = _decaying(shared, BEGIN_DECAY)[groups]
        system.factorise(precision, ridge)
        new = system.curve()
        if correction >= 2:
            # after the first iterations the residual is noise
            precision, effective = _likelier(system, new, precision, groups)
            # a lower precision over time where the jerk is large, as after a step
            jerk = splines.roots[: splines.points] @ new
            strength = gaussian_filter1d(np.sum(jerk**2 * precision, axis=1), WIDTH)
            profile = (1.0 + QUIET) / (strength / strength.mean() + QUIET)
            rest = residual - (J @ (np.asarray(design @ new) - a)[..., None])[..., 0]
            turns, shifts = rest[:, :size], rest[:, size:]
            kept = max(0.2, 1.0 - effective / seen.sum())
            counts = np.array([seen[:, size:].sum(), seen[:, :size].sum()])
            squares = np.array([np.sum(shifts**2), np.sum(turns**2)])
            level = np.maximum(np.sqrt(squares / np.maximum(counts * kept, 1.0)), LEAST_NOISE)
            noise = tuple(np.where(counts > 0, level, noise).tolist())
            # least-squares correction of the stretch from the shifts along the position
            along = (shape.p[:, rod.bodies] - rod.origin).reshape(frames, -1)
            stretch += float(np.sum(along * shifts) / np.sum(along**2))
        change = np.max(np.abs(np.asarray(design @ new) - a))
        curves = new
        if correction >= CORRECTIONS and change < CLOSE:
            break
    return _CurvatureFit(splines, curves, stretch, noise)


def _shared(values: Float[np.ndarray, " K"], groups: np.ndarray) -> Float[np.ndarray, " groups"]:
    return np.bincount(groups, values) / np.bincount(groups)


def _likelier(
    system: _Banded, curves: Float[np.ndarray, "n K"], precision: Float[np.ndarray, " K"], groups: np.ndarray
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


# curves in time


@dataclasses.dataclass(frozen=True, eq=False)
class _Splines:
    """B-splines on evenly spaced knots.

    Attributes:
        knots: times of the knots (s).
        count: number of splines.
        roots: factor of the prior's matrix at τ = 1, which is `rootsᵀ roots`: first the rows of the jerk,
            then those of the value, each in order of time.
    """

    knots: Float[np.ndarray, " n"]
    count: int
    roots: Any

    @classmethod
    def of(cls, start: float, end: float, spacing: float) -> _Splines:
        """Return splines from `start` to `end` with a spacing of knots up to `spacing` (s)."""
        pieces = max(1, int(np.ceil((end - start) / spacing - 1e-9)))
        step = (end - start) / pieces
        knots = start + step * np.arange(-DEGREE, pieces + DEGREE + 1)
        splines = cls(knots, pieces + DEGREE, None)
        nodes, weights = np.polynomial.legendre.leggauss(DEGREE - ORDER + 1)
        at = (start + step * (np.arange(pieces)[:, None] + (nodes + 1) / 2)).ravel()
        scale = np.sqrt(np.tile(weights * step / 2, pieces))[:, None]
        corner = (2 * np.pi * CORNER) ** ORDER
        parts = [splines.design(at, ORDER).multiply(scale), splines.design(at).multiply(corner * scale)]
        return dataclasses.replace(splines, roots=scipy.sparse.vstack(parts).tocsr())

    def roots_of(self, profile: Float[np.ndarray, " points"]) -> Any:
        """Return the prior's roots with the jerk's precision scaled by a profile (1 on average)."""
        scale = np.concatenate([np.sqrt(profile), np.ones(len(profile))])
        return self.roots.multiply(scale[:, None]).tocsr()

    @property
    def points(self) -> int:
        """Number of points in time at which the prior evaluates the jerk."""
        return self.roots.shape[0] // 2

    def design(self, time: Float[np.ndarray, " F"], derivative: int = 0) -> Any:
        """Return the sparse values (F, count) of a derivative of the splines at given times (s)."""
        knots, degree = self.knots, DEGREE - derivative
        inside = np.clip(time, knots[DEGREE], np.nextafter(knots[-DEGREE - 1], -np.inf))
        values: Any = BSpline.design_matrix(inside, knots[derivative : len(knots) - derivative], degree)
        step = knots[1] - knots[0]
        for order in range(derivative, 0, -1):
            # a derivative is a difference of coefficients
            rows = self.count - order
            difference = scipy.sparse.eye_array(rows, rows + 1, k=1) - scipy.sparse.eye_array(rows, rows + 1)
            values = values @ (difference / step)
        return values.tocsr()


class _Banded:
    """Banded linear system of a curve: data of the frames plus the prior."""

    def __init__(
        self,
        splines: _Splines,
        design: Any,
        H: Float[np.ndarray, "F K K"],
        g: Float[np.ndarray, "F K"],
        roots: Any,
    ) -> None:
        self.splines, self.modes, self.roots = splines, g.shape[1], roots
        n, K = splines.count, self.modes
        self.right = np.asarray(design.T @ g).ravel()
        self.data = np.zeros(((DEGREE + 1) * K, n * K))
        columns = design.tocsc()
        flat = H.reshape(len(H), K * K)
        for lag in range(DEGREE + 1):
            both = columns[:, lag:].multiply(columns[:, : n - lag]) if lag else columns.multiply(columns)
            blocks = np.asarray(both.T.tocsr() @ flat).reshape(n - lag, K, K)
            # row of the later spline, column of the earlier one
            band = self.data.reshape(len(self.data), -1, K)
            for j in range(K):
                for i in range(j if lag == 0 else 0, K):
                    band[lag * K + i - j, : n - lag, j] += blocks[:, i, j]
        gram = (roots.T @ roots).tocsc()
        self.gram = [gram.diagonal(-lag) for lag in range(DEGREE + 1)]
        self.factor: np.ndarray | None = None

    def factorise(self, precision: Float[np.ndarray, " K"], ridge: Float[np.ndarray, " K"]) -> None:
        """Factorise with the precisions τ of the prior and a ridge on every coefficient."""
        K, n = self.modes, self.splines.count
        band = self.data.copy()
        for lag, diagonal in enumerate(self.gram):
            row = band[lag * K].reshape(n, K)
            row[: n - lag] += diagonal[:, None] * precision
        band[0] += np.tile(ridge, n)
        self.factor = cholesky_banded(band, lower=True, overwrite_ab=True, check_finite=False)

    def solve(self, right: Float[np.ndarray, "nK ..."]) -> Float[np.ndarray, "nK ..."]:
        """Return the solution for one right-hand side or several."""
        assert self.factor is not None
        return np.asarray(cho_solve_banded((self.factor, True), right, check_finite=False))

    def curve(self) -> Float[np.ndarray, "n K"]:
        """Return the most likely coefficients."""
        return self.solve(self.right).reshape(self.splines.count, self.modes)
