"""Quadratic programs of controllers, by interchangeable solvers."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import numpy as np
from jaxtyping import Float

from knode_cosserat.errors import KnodeCosseratError

#: DAQP's code of solved problems
SOLVED = 1
#: weight of the unknowns beside violations of soft rows; both are in units of the unknowns
SMALL = 1e-6
#: part of the largest violation by which soft rows yield more than they must, so that rounding errors of the
#: first program cannot make the second one infeasible
MORE = 1e-4


class QPError(KnodeCosseratError, ValueError):
    """A quadratic program cannot be set up; one line says why."""

    code = "qp"


class QuadraticProgram(NamedTuple):
    """Minimise ½ xᵀH x + gᵀx for low ≤ x ≤ high and below ≤ A x ≤ above; the last `soft` rows of A yield.

    A solver ignores `soft`; `solved_program` does not.
    """

    H: Float[np.ndarray, "n n"]
    g: Float[np.ndarray, " n"]
    low: Float[np.ndarray, " n"]
    high: Float[np.ndarray, " n"]
    A: Float[np.ndarray, "m n"]
    below: Float[np.ndarray, " m"]
    above: Float[np.ndarray, " m"]
    soft: int = 0


class QPSolution(NamedTuple):
    """Solution of a quadratic program; not `solved` if it is infeasible or took too long."""

    x: Float[np.ndarray, " n"]
    solved: bool


class QPSolver(Protocol):
    """Solver of dense quadratic programs of some dozen variables."""

    def solve(self, problem: QuadraticProgram) -> QPSolution:
        """Return the solution; never raise for an infeasible problem."""
        ...


class DAQP:
    """Dual active-set solver (Arnström, Bemporad & Axehill 2022): 0.05 ms for 32 variables."""

    def __init__(self, time_limit: float = 4e-3):
        """Load the library; a problem that takes longer than `time_limit` (s) counts as not solved.

        Raises:
            QPError: the library is not installed.
        """
        try:
            import daqp
        except ImportError:
            raise QPError("DAQP is not installed: pip install 'knode-cosserat[control]'") from None
        self._solve, self._limit = daqp.solve, time_limit

    def solve(self, problem: QuadraticProgram) -> QPSolution:
        """Return the solution; never raise for an infeasible problem."""
        p = problem
        upper, lower = np.concatenate([p.high, p.above]), np.concatenate([p.low, p.below])
        # H is positive definite only to rounding if some directions hardly matter
        H, A = np.ascontiguousarray(p.H), np.ascontiguousarray(p.A)
        x, _, flag, _ = self._solve(H, p.g, A, upper, lower, time_limit=self._limit)
        return QPSolution(np.asarray(x), flag == SOLVED and bool(np.all(np.isfinite(x))))


def solved_program(solver: QPSolver, problem: QuadraticProgram) -> QPSolution:
    """Return the solution of a program with soft rows: hard limits first, then soft rows, then the cost.

    If not all rows can hold, a first program finds the least sum of squared violations that the hard limits
    allow. A second one minimises the cost with as much violation, and no more. No weight has to be chosen
    between violation and cost, and neither program is badly scaled.
    """
    found = solver.solve(problem)
    if found.solved or not problem.soft:
        return found
    first = solver.solve(_least_violation(problem))
    n = len(problem.g)
    x = first.x[:n]
    if not first.solved:
        return QPSolution(x, False)
    low, high = soft_violations(problem, x)
    more = MORE * max(low.max(), high.max())
    below, above = problem.below.copy(), problem.above.copy()
    below[-problem.soft :] -= low + more
    above[-problem.soft :] += high + more
    second = solver.solve(problem._replace(below=below, above=above))
    return second if second.solved else QPSolution(x, True)


def soft_violations(problem: QuadraticProgram, x: Float[np.ndarray, " n"]) -> tuple[Any, Any]:
    """Return by how much each soft row is below its lower end and above its upper end, at least 0."""
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
        np.diag(np.concatenate([np.full(n, SMALL), np.ones(p.soft)])), np.zeros(n + p.soft),
        np.concatenate([p.low, -free]), np.concatenate([p.high, free]), A, p.below * scale, p.above * scale,
    )  # fmt: skip


def solver_named(name: Any) -> QPSolver:
    """Return a solver by its name, or the given solver."""
    if name == "daqp":
        return DAQP()
    if isinstance(name, str):
        raise QPError(f"there is no solver {name!r} of quadratic programs; there is 'daqp'")
    return name
