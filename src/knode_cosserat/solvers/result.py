"""What came of each step, and the error that a failed one raises."""

from __future__ import annotations

import enum


class Result(enum.IntEnum):
    """How a step ended. Zero and above: solved to tolerance. Below zero: not solved, the state is invalid."""

    CONVERGED = 0
    RECOVERED_STABLE_ELIMINATION = 1
    RECOVERED_LOAD_CONTINUATION = 2
    RECOVERED_STEP_HALVING = 3
    RECOVERED_RELAXATION = 4
    RECOVERED_FINER_SEGMENTS = 5
    RECOVERED_EASING = 6
    NO_CONVERGENCE = -1
    NOT_FINITE = -2
    NOT_REACHED = -3
    UNSTABLE = -4

    @property
    def solved(self) -> bool:
        """Whether the state is a solution."""
        return self >= 0

    @property
    def message(self) -> str:
        """The result in words."""
        return _MESSAGES[self]


_MESSAGES = {
    Result.CONVERGED: "converged",
    Result.RECOVERED_STABLE_ELIMINATION: "converged with the stable elimination and a longer search",
    Result.RECOVERED_LOAD_CONTINUATION: "converged by applying the change of control in smaller parts",
    Result.RECOVERED_STEP_HALVING: "converged by several smaller time steps",
    Result.RECOVERED_RELAXATION: "converged after a damped motion towards rest: it may have snapped",
    Result.RECOVERED_FINER_SEGMENTS: "converged with every segment divided: they were too long",
    Result.RECOVERED_EASING: "converged by way of friction or contact that set in more gently",
    Result.NO_CONVERGENCE: "no solution found",
    Result.NOT_FINITE: "the equations overflow or are undefined there",
    Result.UNSTABLE: "the equations are solved, but their segments are too long for them to be the rod's",
    Result.NOT_REACHED: "not simulated: an earlier step failed",
}


class SimulationError(RuntimeError):
    """A step could not be solved.

    `step`, `time` (s), `residual` (natural units), `result`, `cause` and `robot` (of a batch) say more.
    """

    def __init__(
        self, step: int, time: float, residual: float, result: Result, cause: str, robot: int | None = None
    ):
        self.step, self.time, self.residual, self.result = step, time, residual, result
        self.cause, self.robot = cause, robot
        who = "" if robot is None else f" of robot {robot}"
        where = "equilibrium" if step == 0 else f"step {step} (t = {time:g} s)"
        super().__init__(
            f"{where}{who}: {result.message}; residual {residual:.2g} of its natural scale. {cause}"
        )
