"""The linear equations of a Newton correction against a dense solve, whatever grows along the rod."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from knode_cosserat.solvers.linear import (
    Linearisation,
    factored,
    filled_up,
    inverted,
    matrix_products,
    quotient,
    solved_correction,
)

STATES, UNKNOWNS = 6, 3
PIVOTS = np.arange(UNKNOWNS)
SCALES = {"ones": np.ones(STATES), "natural": np.array([1e-3, 1.0, 1e3, 10.0, 1e-2, 1e2])}


class Equations:
    """Random equations: half of the states grow by this factor along each piece, half decay by it.

    The states have sizes as `scale` says, and so in these units everything is of the order of one.
    """

    def __init__(self, pieces, growth, seed, *, scale=SCALES["ones"], implicit=True, strands=1):
        rng = np.random.default_rng(seed)
        rates = np.array([growth] * UNKNOWNS + [1 / growth] * (STATES - UNKNOWNS))
        shape = (strands, pieces)
        bases = np.linalg.qr(rng.normal(size=(strands, pieces + 1, STATES, STATES)))[0]
        F = bases[:, 1:] @ np.diag(rates) @ np.swapaxes(bases[:, :-1], -1, -2)
        G = np.eye(STATES) + 0.3 * rng.normal(size=(*shape, STATES, STATES)) if implicit else None
        size, unknowns = strands * STATES, strands * UNKNOWNS
        scales = np.tile(scale, strands)
        self.scale, self.strands = scales, strands
        #: (strands, pieces, b, b)
        self.F = F * scale[:, None] / scale
        self.G = None if G is None else G * scale[:, None] / scale
        self.S = rng.normal(size=(size, unknowns)) * scales[:, None]
        self.M = rng.normal(size=(unknowns, size)) / scales
        self.defects = rng.normal(size=(pieces, size)) * scales
        self.tip, self.base = rng.normal(size=unknowns), rng.normal(size=size) * scales
        self.pivots = np.concatenate([k * STATES + PIVOTS for k in range(strands)])

    @property
    def linearisation(self):
        def by_piece(blocks):
            return jnp.asarray(blocks[0] if self.strands == 1 else np.swapaxes(blocks, 0, 1))

        G = None if self.G is None else by_piece(self.G)
        S, M = jnp.asarray(self.S), jnp.asarray(self.M)
        return Linearisation(by_piece(self.F), G, S, M)

    def joined(self, blocks):
        """One matrix for all strands, (pieces, y, y)."""
        size = self.strands * STATES
        found = np.zeros((blocks.shape[1], size, size))
        for k, own in enumerate(blocks):
            of = slice(k * STATES, (k + 1) * STATES)
            found[:, of, of] = own
        return found

    @property
    def right(self):
        """G r of every piece."""
        if self.G is None:
            return self.defects
        return np.einsum("jab,jb->ja", self.joined(self.G), self.defects)

    def dense(self, base=0.0):
        """δy_0 = S δξ + base, δy_{j+1} = F_j δy_j + G_j r_j, M δy_N = -tip as one matrix; δy and δξ."""
        F, (unknowns, n) = self.joined(self.F), self.M.shape
        size = (len(F) + 1) * n
        matrix, right = np.eye(size + unknowns), np.zeros(size + unknowns)
        matrix[:n, size:] = -self.S
        right[:n] = base
        right[n:size] = self.right.ravel()
        for j, own in enumerate(F):
            matrix[(j + 1) * n : (j + 2) * n, j * n : (j + 1) * n] = -own
        matrix[size:, size:] = 0.0
        matrix[size:, size - n : size] = self.M
        right[size:] = -self.tip
        # in natural units
        units = np.concatenate([np.tile(self.scale, len(F) + 1), np.ones(unknowns)])
        solution = units * np.linalg.solve(matrix * units / units[:, None], right / units)
        return solution[:size].reshape(-1, n), solution[size:]

    def residual(self, dy, dxi):
        """Largest residual of an equation, relative to the size of its terms."""
        F, S, M = self.joined(self.F), self.S, self.M
        onward = np.einsum("jab,jb->ja", F, dy[:-1])
        sizes = np.abs(dy[1:]) + np.einsum("jab,jb->ja", np.abs(F), np.abs(dy[:-1])) + np.abs(self.right)
        return max(
            np.max(np.abs(dy[0] - S @ dxi)) / np.max(np.abs(S) @ np.abs(dxi)),
            np.max(np.abs(dy[1:] - onward - self.right) / sizes),
            np.max(np.abs(M @ dy[-1] + self.tip) / (np.abs(M) @ np.abs(dy[-1]) + np.abs(self.tip))),
        )


@jax.jit
def solution_of(linearisation, pivots, defects, tip, base):
    return solved_correction(factored(linearisation, pivots), pivots, defects, tip, base)


def correction(equations, base=None):
    found = solution_of(equations.linearisation, equations.pivots, equations.defects, equations.tip, base)
    return tuple(map(np.asarray, found))


def assert_solves(found, equations, tolerance=1e-10, base=0.0):
    (dy, dxi), (expected_dy, expected_dxi) = found, equations.dense(base)
    expected = expected_dy / equations.scale
    atol = tolerance * np.abs(expected).max()
    np.testing.assert_allclose(dy / equations.scale, expected, rtol=0, atol=atol)
    np.testing.assert_allclose(dxi, expected_dxi, rtol=0, atol=tolerance * np.abs(expected_dxi).max())


@pytest.mark.parametrize("implicit", [True, False], ids=["implicit", "explicit"])
@pytest.mark.parametrize("scale", SCALES.values(), ids=SCALES)
def test_same_as_a_dense_solve(scale, implicit):
    for seed in range(5):
        equations = Equations(10, 1.3, seed, scale=scale, implicit=implicit)
        assert_solves(correction(equations), equations)


@pytest.mark.parametrize("pieces", [1, 2, 3, 7, 11])
def test_groups_that_are_filled_up_change_nothing(pieces):
    equations = Equations(pieces, 1.3, pieces)
    assert_solves(correction(equations), equations)


def test_strands_meet_at_the_ends_only():
    for seed in range(3):
        equations = Equations(10, 1.5, seed, strands=3)
        assert_solves(correction(equations), equations)


def test_a_base_that_moves_by_itself():
    """As in the estimate of the discretisation error, and in derivatives."""
    equations = Equations(10, 1.3, 4, scale=SCALES["natural"])
    assert_solves(correction(equations, equations.base), equations, base=equations.base)


def test_factors_serve_for_other_residuals():
    scale = SCALES["natural"]
    equations, other = (Equations(10, 1.3, seed, scale=scale) for seed in (7, 8))
    factors = jax.jit(factored)(equations.linearisation, PIVOTS)
    found = jax.jit(solved_correction)(factors, PIVOTS, other.defects, other.tip)
    # the product with G is of the first ones
    equations.defects, equations.tip = other.defects, other.tip
    assert_solves(tuple(map(np.asarray, found)), equations)


@pytest.mark.parametrize(("implicit", "strands"), [(True, 1), (False, 1), (True, 3)])
def test_many_corrections_at_once_are_each_by_itself(implicit, strands):
    several = [Equations(10, 1.3, seed, implicit=implicit, strands=strands) for seed in range(4)]
    first = several[0]
    factors = jax.jit(factored)(first.linearisation, first.pivots)

    def solved(which):
        data = (
            np.stack([getattr(each, name) for each in which], axis=-1) for name in ("defects", "tip", "base")
        )
        return jax.jit(solved_correction)(factors, first.pivots, *data)

    together, alone = (
        solved(several),
        [
            jax.jit(solved_correction)(factors, first.pivots, each.defects, each.tip, each.base)
            for each in several
        ],
    )
    for k, own in enumerate(alone):
        for found, expected in zip(together, own, strict=True):
            np.testing.assert_allclose(found[..., k], expected, rtol=0, atol=1e-12 * np.abs(expected).max())


def condensed(equations):
    """δy_j = X_j δξ + w_j from base to tip, δξ by the tip's conditions: what the Riccati form replaces."""
    X, w, each = equations.S, np.zeros(len(equations.S)), []
    for F, r in zip(equations.joined(equations.F), equations.right, strict=True):
        each.append((X, w))
        X, w = F @ X, F @ w + r
    dxi = np.linalg.solve(equations.M @ X, -equations.tip - equations.M @ w)
    return np.stack([X @ dxi + w for X, w in [*each, (X, w)]]), dxi


@pytest.mark.parametrize(("growth", "first"), [(10.0, 1e-7), (1e2, 1e-4), (3e2, 1e-1)])
def test_growth_along_the_rod_does_no_harm(growth, first):
    """Rounding errors at the base grow by up to 1e74 to the tip; the problem is as well posed as ever.

    Within a group of pieces α is not changed, so that the first correction is inexact by what grows there.
    The next corrections by the same factors, as Newton's method makes them, leave rounding errors only.
    """
    for seed in range(5):
        equations = Equations(30, growth, seed)
        factors = jax.jit(factored)(equations.linearisation, PIVOTS)
        expected = equations.dense()[0]
        dy, dxi = np.zeros_like(expected), np.zeros(UNKNOWNS)
        for k in range(4):
            F, G = equations.joined(equations.F), equations.joined(equations.G)
            # G⁻¹ of what is missing at the ends of pieces
            missing = np.einsum("jab,jb->ja", F, dy[:-1]) - dy[1:] + equations.right
            left = np.linalg.solve(G, missing[..., None])[..., 0]
            change = jax.jit(solved_correction)(factors, PIVOTS, left, equations.M @ dy[-1] + equations.tip)
            dy, dxi = dy + change[0], dxi + change[1]
            if k == 0:
                np.testing.assert_allclose(dy, expected, rtol=0, atol=first * np.abs(expected).max())
        assert equations.residual(dy, dxi) < 1e-11
        np.testing.assert_allclose(dy, expected, rtol=0, atol=1e-9 * np.abs(expected).max())
        # written so that NaN passes too
        assert not equations.residual(*condensed(equations)) < 1e-2


@pytest.mark.parametrize("size", [1, 6, 19])
def test_inverses_are_those_of_numpy(size):
    rng = np.random.default_rng(size)
    # I - h J, with rows and columns of very different units
    units = 10.0 ** rng.uniform(-3, 3, size)
    matrices = np.eye(size) - 0.3 * rng.normal(size=(12, size, size)) / np.sqrt(size)
    matrices = matrices * units[:, None] / units
    found = np.moveaxis(jax.jit(inverted)(jnp.asarray(np.moveaxis(matrices, 0, -1))), -1, 0)
    natural = found * units / units[:, None]
    expected = np.linalg.inv(matrices * units / units[:, None])
    np.testing.assert_allclose(natural, expected, rtol=0, atol=1e-11 * np.abs(expected).max())


def test_products_of_matrices_that_are_last():
    A, B = np.random.default_rng(0).normal(size=(2, 4, 4, 7))
    np.testing.assert_allclose(
        matrix_products(jnp.asarray(A), jnp.asarray(B)), np.einsum("abn,bcn->acn", A, B), atol=1e-13
    )


@pytest.mark.parametrize("used", [np.arange(19), np.arange(3, 19), np.array([0, 1, 5, 6, 11, 18])])
def test_columns_of_the_identity_need_no_elimination(used):
    rng = np.random.default_rng(2)
    A, B = (np.tile(np.eye(19), (7, 1, 1)) for _ in range(2))
    for each in (A, B):
        each[:, :, used] += 0.1 * rng.normal(size=(7, 19, len(used)))
    columns = (jnp.asarray(np.moveaxis(each, 0, -1)[:, used]) for each in (A, B))
    found = (np.moveaxis(filled_up(each, used), -1, 0) for each in quotient(*columns, used))
    for got, wanted in zip(found, (np.linalg.solve(B, A), np.linalg.inv(B)), strict=True):
        np.testing.assert_allclose(got, wanted, atol=1e-12)
