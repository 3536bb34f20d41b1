"""Result codes of steps, and the error that a failed step raises."""

from __future__ import annotations

import enum
from typing import Any, ClassVar

import numpy as np

from knode_cosserat.errors import KnodeCosseratError


class Code(enum.IntEnum):
    """Integer code that prints its name."""

    def __str__(self) -> str:
        return self.name

    def __format__(self, spec: str) -> str:
        return int.__format__(self, spec) if spec else self.name


class Result(Code):
    """Outcome of a step. Zero and above: solved to tolerance. Below zero: not solved, the state is invalid.

    COARSE is also solved, but its estimated discretisation error is more than 2 % of the length or 0.1 rad,
    or there is no estimate. In a motion, all rows after a COARSE or recovered one have its result. UNSTABLE
    is an equilibrium that a small disturbance destroys. OTHER_TURNS has another winding than the control's.
    """

    CONVERGED = 0
    COARSE = 1
    RECOVERED_LOAD_CONTINUATION = 2
    RECOVERED_STEP_HALVING = 3
    RECOVERED_RELAXATION = 4
    RECOVERED_EASING = 6
    UNSTABLE = 7
    OTHER_TURNS = 8
    NO_CONVERGENCE = -1
    NOT_FINITE = -2
    NOT_REACHED = -3

    @property
    def solved(self) -> bool:
        """True if the state is a solution of the equations on its grid."""
        return self >= 0

    @property
    def message(self) -> str:
        """The result in words."""
        return _MESSAGES[self]


_MESSAGES = {
    Result.CONVERGED: "converged",
    Result.COARSE: "equations solved, but the grid is too coarse: use more nodes, or position_tolerance",
    Result.RECOVERED_LOAD_CONTINUATION: "converged by applying the change of control in smaller parts",
    Result.RECOVERED_STEP_HALVING: "converged by several smaller time steps",
    Result.RECOVERED_RELAXATION: "converged after a damped motion towards rest: it may have snapped",
    Result.RECOVERED_EASING: "converged by continuation from smoother friction or contact",
    Result.UNSTABLE: "in equilibrium, but unstable: a small disturbance moves the robot away from this shape",
    Result.OTHER_TURNS: "in equilibrium, but with another number of turns than the control asks for",
    Result.NO_CONVERGENCE: "no solution found",
    Result.NOT_FINITE: "the equations overflow or are undefined there",
    Result.NOT_REACHED: "not simulated: an earlier step failed",
}


class Verdict(Code):
    """Stability of an equilibrium under small disturbances. Below zero: not tested, with the reason."""

    STABLE = 0
    UNSTABLE = 1
    FLUTTER = 2
    UNTESTED_MANY = -1
    UNTESTED_FRICTION = -2
    UNTESTED_GRID = -3
    UNTESTED_SIZE = -4
    UNTESTED_SYSTEM = -5
    UNTESTED_TURNING = -6
    UNTESTED_TRACED = -7
    UNTESTED_UNSOLVED = -8
    UNTESTED_UNASKED = -9

    @property
    def message(self) -> str:
        """The verdict in words."""
        return f"stability not tested: {self.reason}" if self < 0 else self.reason

    @property
    def reason(self) -> str:
        """The reason why it was not tested, or the verdict."""
        return _VERDICTS[self]


_VERDICTS = {
    Verdict.STABLE: "stable",
    Verdict.UNSTABLE: "UNSTABLE: a small disturbance moves the robot away from this shape",
    Verdict.FLUTTER: "UNSTABLE by flutter: a small disturbance grows to oscillations about this shape",
    Verdict.UNTESTED_MANY: "one of several equilibria; kc.statics.stability(equilibria, row) tests one",
    Verdict.UNTESTED_FRICTION: "friction has no linearisation at rest",
    Verdict.UNTESTED_GRID: "the grid is too coarse to decide; use more nodes",
    Verdict.UNTESTED_SIZE: "the robot has too many states; kc.statics.stability may test it",
    Verdict.UNTESTED_SYSTEM: "the system has no positions p and velocities q",
    Verdict.UNTESTED_TURNING: "loads turn in the robot's frame, so that it does not stay in equilibrium",
    Verdict.UNTESTED_TRACED: "it was solved inside JAX's transformations",
    Verdict.UNTESTED_UNSOLVED: "no equilibrium was found",
    Verdict.UNTESTED_UNASKED: "with_stability is False",
}


class Codes(np.ndarray):
    """Array of integer codes that prints their names; an element is a member of `members`."""

    members: ClassVar[type[Code]]

    @classmethod
    def of(cls, values: Any) -> Any:
        """Return an array of integers as codes; anything else, such as a traced array, as it is."""
        known = isinstance(values, np.ndarray) and values.dtype.kind == "i"
        return values.view(cls) if known else values

    def __array_wrap__(self, array: Any, context: Any = None, return_scalar: bool = False) -> Any:
        # the result of arithmetic or of a comparison is not a code
        return array[()] if return_scalar else np.asarray(array)

    def __getitem__(self, key: Any) -> Any:
        found = super().__getitem__(key)
        return found if isinstance(found, np.ndarray) else self._named(found)

    def _named(self, code: Any) -> Any:
        return {int(each): each for each in self.members}.get(int(code), code)

    def __str__(self) -> str:
        return np.array2string(np.asarray(self), formatter={"int": lambda code: str(self._named(code))})

    def __repr__(self) -> str:
        return str(self)


class ResultCodes(Codes):
    """Array of `Result` codes."""

    members = Result


class VerdictCodes(Codes):
    """Array of `Verdict` codes."""

    members = Verdict


class SimulationError(KnodeCosseratError, RuntimeError):
    """A step could not be solved.

    Attributes: `step`, `time` (s), `residual` (natural units), `result`, `cause` and `robot` (of a batch).
    """

    code = "simulation"

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
