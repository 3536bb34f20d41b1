"""Quadratic programs of controllers, solved by DAQP (Arnström, Bemporad & Axehill 2022)."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

#: DAQP's code of solved problems
SOLVED = 1
#: time limit of a program (s)
TIME_LIMIT = 4e-3
#: weight of the unknowns beside violations of soft rows; both are in units of the unknowns
SMALL = 1e-6
#: part of the largest violation by which soft rows yield more than they must, so that rounding errors of the
#: first program cannot make the second one infeasible
MORE = 1e-4


class QuadraticProgram(NamedTuple):
    """Minimise ½ xᵀH x + gᵀx for low ≤ x ≤ high and below ≤ A x ≤ above; the last `soft` rows of A yield."""

    H: Float[np.ndarray, "n n"]
    g: Float[np.ndarray, " n"]
    low: Float[np.ndarray, " n"]
    high: Float[np.ndarray, " n"]
    A: Float[np.ndarray, "m n"]
    below: Float[np.ndarray, " m"]
    above: Float[np.ndarray, " m"]
    soft: int = 0

    def with_soft_rows(self, A: Any, below: Any, above: Any) -> QuadraticProgram:
        """Return the program with soft rows (k, n) after its own."""
        rows = zip((self.A, self.below, self.above), (A, below, above), strict=True)
        A, below, above = map(np.concatenate, rows)
        return self._replace(A=A, below=below, above=above, soft=len(A) - len(self.A))


def require_daqp() -> None:
    """Raise `ImportError` in one line if DAQP is not installed."""
    try:
        import daqp  # noqa: F401
    except ImportError:
        raise ImportError("DAQP is not installed: pip install 'knode-cosserat[control]'") from None


def solve(problem: QuadraticProgram) -> Float[np.ndarray, " n"] | None:
    """Return the solution (n,): hard limits first, then soft rows, then the cost; None without a solution.

    If not all rows can hold, a first program finds the least sum of squared violations that the hard limits
    allow. A second one minimises the cost with as much violation, and no more. No weight has to be chosen
    between violation and cost, and neither program is badly scaled. (DAQP's own soft constraints need such a
    weight; with a badly conditioned cost, squared violations were up to 6 times the least ones.)
    """
    x = _solve_hard(problem)
    if x is not None or not problem.soft:
        return x
    least = _solve_hard(_least_violation(problem))
    if least is None:
        return None
    least = least[: len(problem.g)]
    low, high = soft_violations(problem, least)
    more = MORE * max(low.max(), high.max())
    below, above = problem.below.copy(), problem.above.copy()
    below[-problem.soft :] -= low + more
    above[-problem.soft :] += high + more
    x = _solve_hard(problem._replace(below=below, above=above))
    return least if x is None else x


def _solve_hard(problem: QuadraticProgram) -> Float[np.ndarray, " n"] | None:
    """Return the solution with all rows hard; None if it is infeasible or took longer than the limit."""
    import daqp

    upper = np.concatenate([problem.high, problem.above])
    lower = np.concatenate([problem.low, problem.below])
    # H is positive definite only to rounding if some directions hardly matter
    H, A = np.ascontiguousarray(problem.H), np.ascontiguousarray(problem.A)
    x, _, flag, _ = daqp.solve(H, problem.g, A, upper, lower, time_limit=TIME_LIMIT)
    x = np.asarray(x)
    return x if flag == SOLVED and np.all(np.isfinite(x)) else None


def soft_violations(problem: QuadraticProgram, x: Float[np.ndarray, " n"]) -> tuple[Any, Any]:
    """Return the distance of each soft row below its lower and above its upper end, at least 0."""
    soft = slice(len(problem.A) - problem.soft, None)
    value = problem.A[soft] @ x
    return np.maximum(0.0, problem.below[soft] - value), np.maximum(0.0, value - problem.above[soft])


def _least_violation(problem: QuadraticProgram) -> QuadraticProgram:
    """Return the program of x and the violations of all soft rows, which minimises the violations."""
    p, n = problem, len(problem.g)
    hard = len(p.A) - p.soft
    # violations in units of the unknowns
    unit = max(float(np.max(np.linalg.norm(p.A[hard:], axis=1))), np.finfo(float).tiny)
    A = np.block([[p.A[:hard], np.zeros((hard, p.soft))], [p.A[hard:] / unit, np.eye(p.soft)]])
    scale = np.concatenate([np.ones(hard), np.full(p.soft, 1.0 / unit)])
    free = np.full(p.soft, np.inf)
    return QuadraticProgram(
        np.diag(np.concatenate([np.full(n, SMALL), np.ones(p.soft)])),
        np.zeros(n + p.soft),
        np.concatenate([p.low, -free]),
        np.concatenate([p.high, free]),
        A,
        p.below * scale,
        p.above * scale,
    )
