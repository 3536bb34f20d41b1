"""Quadratic programs of controllers, by interchangeable solvers."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import numpy as np
from jaxtyping import Float

from knode_cosserat.errors import KnodeCosseratError

#: DAQP's flag for a soft constraint, and its codes of solved problems
SOFT, SOLVED = 8, (1, 2)
#: weight of a soft constraint's violation: DAQP minimises ρ/2 times its square
SOFTNESS = 1e-6


class QPError(KnodeCosseratError, ValueError):
    """A quadratic program cannot be set up; one line says why."""

    code = "qp"


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
        n = len(p.g)
        sense = np.zeros(n + len(p.A), dtype=np.int32)
        sense[len(sense) - p.soft :] = SOFT
        upper, lower = np.concatenate([p.high, p.above]), np.concatenate([p.low, p.below])
        # H is positive definite only to rounding if some directions hardly matter
        H, A = np.ascontiguousarray(p.H), np.ascontiguousarray(p.A)
        x, _, flag, _ = self._solve(H, p.g, A, upper, lower, sense, time_limit=self._limit, rho_soft=SOFTNESS)
        return QPSolution(np.asarray(x), flag in SOLVED and bool(np.all(np.isfinite(x))))


def solver_named(name: Any) -> QPSolver:
    """Return a solver by its name, or the given solver."""
    if name == "daqp":
        return DAQP()
    if isinstance(name, str):
        raise QPError(f"there is no solver {name!r} of quadratic programs; there is 'daqp'")
    return name
