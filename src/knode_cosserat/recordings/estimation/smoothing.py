"""Curves in time: splines of several coefficients, fitted to frames.

A curve is c(t) = Σ_l B_l(t) c_l with B-splines B_l and K numbers in each c_l. Frame i contributes
½ aᵀ H_i a - g_iᵀ a with the curve's value a = c(t_i). The prior is, with ''' the third derivative,

    ½ Σ_k τ_k ∫ (c_k''')² + Ω⁶ c_k² dt.

Above the frequency Ω it is the prior of a motion with white-noise jerk of the intensity 1/τ_k. Below Ω the
spectrum is flat, so that slow motion stays near zero. Data and prior form a banded system.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Float

#: degree of the splines: the rate of the accelerations is smooth
DEGREE = 5
#: derivative penalised by the prior, and frequency below which the value itself is penalised (Hz)
ORDER, CORNER = 3, 0.6


@dataclasses.dataclass(frozen=True, eq=False)
class Splines:
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
    def of(cls, start: float, end: float, spacing: float) -> Splines:
        """Return splines from `start` to `end` with a spacing of knots up to `spacing` (s)."""
        import scipy.sparse

        pieces = max(1, int(np.ceil((end - start) / spacing - 1e-9)))
        step = (end - start) / pieces
        knots = start + step * np.arange(-DEGREE, pieces + DEGREE + 1)
        made = cls(knots, pieces + DEGREE, None)
        nodes, weights = np.polynomial.legendre.leggauss(DEGREE - ORDER + 1)
        at = (start + step * (np.arange(pieces)[:, None] + (nodes + 1) / 2)).ravel()
        scale = np.sqrt(np.tile(weights * step / 2, pieces))[:, None]
        corner = (2 * np.pi * CORNER) ** ORDER
        parts = [made.design(at, ORDER).multiply(scale), made.design(at).multiply(corner * scale)]
        return dataclasses.replace(made, roots=scipy.sparse.vstack(parts).tocsr())

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
        import scipy.sparse
        from scipy.interpolate import BSpline

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


class Banded:
    """Banded linear system of a curve: data of the frames plus the prior."""

    def __init__(
        self,
        splines: Splines,
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
        for ahead in range(DEGREE + 1):
            both = (
                columns[:, ahead:].multiply(columns[:, : n - ahead]) if ahead else columns.multiply(columns)
            )
            blocks = np.asarray(both.T.tocsr() @ flat).reshape(n - ahead, K, K)
            _put(self.data, blocks, ahead, K)
        gram = (roots.T @ roots).tocsc()
        self.gram = [gram.diagonal(-ahead) for ahead in range(DEGREE + 1)]
        self.factor: np.ndarray | None = None

    def factorise(self, precision: Float[np.ndarray, " K"], ridge: Float[np.ndarray, " K"]) -> None:
        """Factorise with the precisions τ of the prior and a ridge on every coefficient."""
        from scipy.linalg import cholesky_banded

        K, n = self.modes, self.splines.count
        band = self.data.copy()
        for ahead, diagonal in enumerate(self.gram):
            row = band[ahead * K].reshape(n, K)
            row[: n - ahead] += diagonal[:, None] * precision
        band[0] += np.tile(ridge, n)
        self.factor = cholesky_banded(band, lower=True, overwrite_ab=True, check_finite=False)

    def solve(self, right: Float[np.ndarray, "nK ..."]) -> Float[np.ndarray, "nK ..."]:
        """Return the solution for one right-hand side or several."""
        from scipy.linalg import cho_solve_banded

        assert self.factor is not None
        return np.asarray(cho_solve_banded((self.factor, True), right, check_finite=False))

    def curve(self) -> Float[np.ndarray, "n K"]:
        """Return the most likely coefficients."""
        return self.solve(self.right).reshape(self.splines.count, self.modes)


def _put(band: np.ndarray, blocks: Float[np.ndarray, "n K K"], ahead: int, K: int) -> None:
    """Write blocks (row of the later spline, column of the earlier one) into a lower band."""
    columns = band.reshape(band.shape[0], -1, K)
    for j in range(K):
        for i in range(j if ahead == 0 else 0, K):
            columns[ahead * K + i - j, : len(blocks), j] += blocks[:, i, j]
