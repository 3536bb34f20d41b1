"""The two eliminations against a dense solve, and where one of them must give up."""

import jax
import numpy as np
import pytest

from knode_cosserat.solvers.linear import Condensed, Decoupled, Linearisation

STATES, UNKNOWNS = 6, 3
SOLVERS = {"condensed": Condensed(), "decoupled": Decoupled(), "in groups": Decoupled(every=4)}


SCALES = {"ones": np.ones(STATES), "natural": np.array([1e-3, 1.0, 1e3, 10.0, 1e-2, 1e2])}


def problem(segments, growth, seed, scale=SCALES["ones"]):
    """Random equations: half of the states grow by this factor along each segment, half decay by it.

    The states have sizes as `scale` says, and so in these units everything is of the order of one.
    """
    rng = np.random.default_rng(seed)
    rates = np.array([growth] * UNKNOWNS + [1 / growth] * (STATES - UNKNOWNS))
    bases = [np.linalg.qr(rng.normal(size=(STATES, STATES)))[0] for _ in range(segments + 1)]
    F = np.stack([bases[j + 1] @ np.diag(rates) @ bases[j].T for j in range(segments)])
    return Linearisation(
        F=F * scale[:, None] / scale,
        base=rng.normal(size=(STATES, UNKNOWNS)) * scale[:, None],
        tip=rng.normal(size=(UNKNOWNS, STATES)) / scale,
        defects=rng.normal(size=(segments, STATES)) * scale,
        tip_residual=rng.normal(size=UNKNOWNS),
    )


def dense(equations):
    """δy_0 = S δξ, δy_{j+1} = F_j δy_j + r_j, M δy_N = -tip as one matrix; δy and δξ."""
    F, S, M, defects, tip = equations
    segments = len(F)
    size = (segments + 1) * STATES
    matrix, right = np.zeros((size + UNKNOWNS, size + UNKNOWNS)), np.zeros(size + UNKNOWNS)
    matrix[:size, :size] = np.eye(size)
    matrix[:STATES, size:] = -S
    for j in range(segments):
        here, following = slice(j * STATES, (j + 1) * STATES), slice((j + 1) * STATES, (j + 2) * STATES)
        matrix[following, here] = -F[j]
        right[following] = defects[j]
    matrix[size:, size - STATES : size] = M
    right[size:] = -tip
    solution = np.linalg.solve(matrix, right)
    return solution[:size].reshape(-1, STATES), solution[size:]


def residual(equations, dy, dxi):
    """The largest error of an equation, relative to the size of its terms."""
    F, S, M, defects, tip = equations
    onward = np.einsum("jab,jb->ja", F, dy[:-1])
    terms = np.abs(dy[1:]) + np.einsum("jab,jb->ja", np.abs(F), np.abs(dy[:-1])) + np.abs(defects)
    return max(
        np.max(np.abs(dy[0] - S @ dxi)) / np.max(np.abs(S) @ np.abs(dxi)),
        np.max(np.abs(dy[1:] - onward - defects) / terms),
        np.max(np.abs(M @ dy[-1] + tip) / (np.abs(M) @ np.abs(dy[-1]) + np.abs(tip))),
    )


def solved(solver, equations, scale):
    factors, dy, dxi = jax.jit(solver.start)(equations, scale)
    return factors, np.asarray(dy), np.asarray(dxi)


def assert_solves(found, equations, scale, tolerance=1e-10):
    (dy, dxi), (expected_dy, expected_dxi) = found, dense(equations)
    expected = expected_dy / scale
    np.testing.assert_allclose(dy / scale, expected, rtol=0, atol=tolerance * np.abs(expected).max())
    np.testing.assert_allclose(dxi, expected_dxi, rtol=0, atol=tolerance * np.abs(expected_dxi).max())


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("scale", SCALES.values(), ids=SCALES)
@pytest.mark.parametrize("solver", SOLVERS.values(), ids=SOLVERS)
def test_same_as_a_dense_solve(solver, scale, seed):
    equations = problem(10, 1.3, seed, scale)
    _, *found = solved(solver, equations, scale)
    assert_solves(found, equations, scale)


@pytest.mark.parametrize("solver", SOLVERS.values(), ids=SOLVERS)
def test_factors_serve_for_other_residuals(solver):
    scale = SCALES["natural"]
    equations, other = problem(10, 1.3, 7, scale), problem(10, 1.3, 8, scale)
    factors, *_ = solved(solver, equations, scale)
    found = jax.jit(solver.solve)(factors, other.defects, other.tip_residual)
    assert_solves(found, equations._replace(defects=other.defects, tip_residual=other.tip_residual), scale)


@pytest.mark.parametrize("seed", range(5))
def test_growth_along_the_rod_harms_only_the_condensed(seed):
    # growth makes 1e120 times as much of a rounding error at the base; the problem is as well posed as ever
    equations = problem(60, 1e2, seed)
    _, *condensed = solved(SOLVERS["condensed"], equations, SCALES["ones"])
    _, *decoupled = solved(SOLVERS["decoupled"], equations, SCALES["ones"])
    assert residual(equations, *decoupled) < 1e-12
    assert_solves(decoupled, equations, SCALES["ones"])
    # written so that NaN passes too
    assert not residual(equations, *condensed) < 1e-2
