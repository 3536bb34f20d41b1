"""Recovery of a failed step: other guesses, load continuation, easing, then a method of the kind of problem.

It runs outside the compiled loop, step by step in plain Python, by the machine code of the run.
`recovery_methods` has the methods of time steps and of equilibria.
"""

from __future__ import annotations

import abc
import dataclasses
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from knode_cosserat.engine import loops as engine
from knode_cosserat.engine.places import values_along
from knode_cosserat.errors import KnodeCosseratError
from knode_cosserat.rods.aspects import Ends
from knode_cosserat.rods.parts import eased
from knode_cosserat.rods.strands import strand_of
from knode_cosserat.rods.system import System, unknown_count
from knode_cosserat.solvers.history import EXTRAPOLATIONS
from knode_cosserat.solvers.result import Result
from knode_cosserat.solvers.settings import Settings
from knode_cosserat.solvers.steps import StepCoefficients, StepRows, TimeStep

#: smallest load step of continuation, as a part of the change of control
LEAST_PART = 1.0 / 512.0
#: largest number of linearisations of an attempt
MOST_LINEARISATIONS = 40
#: initial factor by which continuation eases friction and contact
EASIEST = 1e-3
#: forces in the control above this multiple of EI/L² suggest a wrong unit
ABSURD = 1e4
#: default recovery budget: this multiple of the run's own time, or this many seconds, whichever is more
BUDGET_SHARE, BUDGET_LEAST = 20.0, 5.0


class BudgetError(KnodeCosseratError):
    """The time for recovery is used up."""

    code = "recovery-budget"


class Budget:
    """The time (s) that recovery may take in one run."""

    def __init__(self, seconds: float | None):
        """Set a fixed budget in seconds; None: in proportion to the run's own time."""
        self._fixed, self._own, self._used = seconds, 0.0, 0.0

    @property
    def seconds(self) -> float:
        """Total time (s) that recovery may take."""
        return max(BUDGET_LEAST, BUDGET_SHARE * self._own) if self._fixed is None else self._fixed

    def ran(self, seconds: float) -> None:
        """Count time of the run itself."""
        self._own += seconds

    def spend(self, seconds: float) -> None:
        """Count time of recovery. Raises `BudgetError` if the budget is used up."""
        self._used += seconds
        if self._used > self.seconds:
            raise BudgetError


class SolvedStep(NamedTuple):
    """A solved step, or the best attempt (`row.result` < 0)."""

    #: start of the next step: a `StateHistory`, or y at all points of an equilibrium
    state: Any
    row: StepRows
    #: likely cause of a failure
    cause: str = ""


def attempt(
    system: System, settings: Settings, step: TimeStep | None, control: Any, y: Any, tip_offset: Any
) -> SolvedStep:
    """Solve one boundary-value problem, of a time step or of an equilibrium (None), from y at all points.

    The search is long. The offset (k,) is subtracted from the residual of the tip's boundary conditions.
    """
    patient = dataclasses.replace(
        settings, newton=dataclasses.replace(settings.newton, max_linearisations=MOST_LINEARISATIONS)
    )
    controls = np.asarray(control)[None]
    if step is None:
        _, state, rows = engine.static_one(system, patient, controls, y, (0, 1), tip_offset)
    else:
        past, weights = step.past, EXTRAPOLATIONS[0]
        # the first guess is the newest of the earlier states
        guess = past._replace(y=np.stack([y, *past.y[:-1]]), weights=weights, t0=0.0)
        one = StepCoefficients(np.asarray(step.coefficients)[None], step.t)
        _, after, rows = engine.loop_one(system, patient, one, controls, guess, (0, 1), tip_offset)
        state = after._replace(y=np.stack([after.y[0], *past.y[:-1]]), weights=weights, t0=past.t0)
    return SolvedStep(state, StepRows(*(leaf[0] for leaf in rows)))


class Recovery(abc.ABC):
    """Recovery of one step, as a series of boundary-value problems."""

    #: the time step; None for an equilibrium
    step: TimeStep | None = None

    def __init__(self, system: System, settings: Settings, budget: Budget):
        self.system, self.settings, self.budget = system, settings, budget
        self.corrections = 0

    @property
    @abc.abstractmethod
    def state(self) -> Any:
        """State before the step, as in `SolvedStep`."""

    @abc.abstractmethod
    def guesses(self) -> list[Any]:
        """Return initial guesses, y at all points, from the state before the step."""

    def first_guesses(self, control: Any) -> list[Any]:
        """Return the guesses of the first attempts."""
        return self.guesses()

    @abc.abstractmethod
    def last_method(self, controls: tuple[Any, Any]) -> tuple[Result, SolvedStep] | None:
        """Return the result of the last method, which may change the problem on the way."""

    def solve(
        self, control: Any, guess: Any, tip_offset: Any = 0.0, system: System | None = None
    ) -> SolvedStep:
        """Solve the step under a control; arguments as in `attempt`."""
        began, own = time.perf_counter(), system or self.system
        found = attempt(own, self.settings, self.step, control, guess, tip_offset)
        self.corrections += int(found.row.corrections)
        self.budget.spend(time.perf_counter() - began)
        return found

    def solved(self, found: SolvedStep) -> bool:
        """Return True if the attempt is a solution."""
        return bool(found.row.error <= self.settings.newton.acceptable)

    def recover(self, controls: tuple[Any, Any]) -> SolvedStep:
        """Solve the step by all methods in order. `controls` are the previous step's and this one's."""
        if self.budget.seconds <= 0.0:
            return self._given_up(controls[1])
        best: list[SolvedStep] = []
        cause = ""
        try:
            found = self._by_all_methods(controls, best)
            if found is not None:
                return self._outcome(*found)
        except BudgetError:
            cause = f"Recovery was stopped after {self.budget.seconds:.3g} s (recovery_budget)."
        # an attempt that is only reported
        self.budget = Budget(np.inf)
        least = min(best, key=lambda each: float(each.row.error)) if best else None
        if least is None:
            least = self.solve(controls[1], self.guesses()[0])
        result = Result.NO_CONVERGENCE if np.isfinite(least.row.error) else Result.NOT_FINITE
        cause = f"{likely_cause(result, self.system, self.settings, controls[1])} {cause}".strip()
        return self._outcome(result, least)._replace(state=self.state, cause=cause)

    def _given_up(self, control: Any) -> SolvedStep:
        """Return the outcome of a failed step without recovery; nothing is compiled."""
        system, result = self.system, Result.NO_CONVERGENCE
        width = system.y_layout.size * (2 if system.mixed else 1) + system.z_layout.size
        record, unknowns = np.full((system.nodes, width), np.nan), np.full(unknown_count(system), np.nan)
        stages = (np.zeros((0, *np.shape(each))) for each in (record, unknowns))
        row = StepRows(record, unknowns, np.inf, 0, np.nan, int(result), np.nan, *stages)
        return SolvedStep(self.state, row, likely_cause(result, system, self.settings, control))

    def _outcome(self, result: Result, found: SolvedStep) -> SolvedStep:
        row = found.row
        if result.solved and row.result == Result.COARSE:
            result = Result.COARSE
        return SolvedStep(found.state, row._replace(corrections=self.corrections, result=int(result)))

    def _by_all_methods(
        self, controls: tuple[Any, Any], best: list[SolvedStep]
    ) -> tuple[Result, SolvedStep] | None:
        """Try all methods in order; attempts from direct guesses are added to `best`."""
        for guess in self.first_guesses(controls[1]):
            found = self.solve(controls[1], guess)
            best.append(found)
            if self.solved(found):
                return Result.CONVERGED, found
        continued = self.continue_load(*controls)
        if continued is not None:
            return Result.RECOVERED_LOAD_CONTINUATION, continued
        eased = self.ease(controls[1])
        if eased is not None:
            return Result.RECOVERED_EASING, eased
        return self.last_method(controls)

    def continue_load(self, before: Any, now: Any) -> SolvedStep | None:
        """Continue from the previous control to this one in load steps, each from the last solution."""
        before, now = np.asarray(before, dtype=float), np.asarray(now, dtype=float)
        if np.array_equal(before, now):
            return None

        def at_part(part: float, y: Any) -> SolvedStep:
            return self.solve(before + part * (now - before), y)

        return self._in_parts(lambda guess: self.solve(before, guess), at_part)

    def ease(self, control: Any) -> SolvedStep | None:
        """Continue from eased friction and contact to the system's own."""
        system = self.system
        easiest = eased(system, EASIEST)
        if easiest is system:
            return None

        def at_part(part: float, y: Any) -> SolvedStep:
            easier = eased(system, EASIEST ** (1.0 - part)) if part < 1.0 else system
            return self.solve(control, y, system=easier)

        return self._in_parts(lambda guess: self.solve(control, guess, system=easiest), at_part)

    def _in_parts(
        self, first: Callable[[Any], SolvedStep], solve: Callable[[float, Any], SolvedStep]
    ) -> SolvedStep | None:
        """Continue from a solution at part 0 to part 1, with adaptive steps, each from the last solution."""
        for guess in self.guesses():
            found = first(guess)
            reached, part = 0.0, 0.25 if self.solved(found) else 0.0
            while reached < 1.0 and part >= LEAST_PART:
                target = min(1.0, reached + part)
                y = found.state if self.step is None else found.state.y[0]
                following = solve(target, y)
                if self.solved(following):
                    found, reached, part = following, target, 2.0 * part
                else:
                    part /= 4.0
            if reached == 1.0:
                return found
        return None


def likely_cause(result: Result, system: System, settings: Settings, control: Any) -> str:
    """Return a hint at the likely cause and the fix."""
    if result.solved:
        return ""
    unit = other_unit(system, np.asarray(control))
    if unit:
        return unit
    if not Ends.of(system).held and settings.time is None:
        return (
            "Likely cause: nothing holds the robot, which is at rest only where all loads on it cancel out; "
            "hold an end of it, or simulate its motion."
        )
    if result is Result.NOT_FINITE:
        return (
            f"Likely too few nodes for so soft or loaded a rod ({system.nodes}): use more, "
            "or a smaller time step."
        )
    return (
        "Likely cause: the control changes too much in one step, the rod buckles or snaps, "
        f"or it has too few nodes ({system.nodes})."
    )


def other_unit(system: System, control: np.ndarray) -> str:
    """Return a hint at another unit if a force in the control is absurdly large."""
    if "n" not in system.y_layout.names:
        return ""
    natural = float(_scales_of_y(system)[system.y_layout.slice("n")][0])
    for field in system.control_layout.fields:
        largest = float(np.max(np.abs(system.control_layout.get(control, field.name)), initial=0.0))
        if field.unit == "N" and largest > ABSURD * natural:
            return (
                f"Likely cause: {field.name} is {largest:.3g} N, {largest / natural:.2g} times what bends "
                "this robot by its own length; is it meant in another unit?"
            )
    return ""


def _scales_of_y(system: System) -> Any:
    return values_along(_scales_at, system, [0.0])[0]


def _scales_at(system: System, s: Any, _: Any) -> Any:
    return system.scales().y


def natural_time(system: System) -> float | None:
    """Return the time (s) in which the system moves by its own length; None if its scales do not give it."""
    layout = strand_of(system).y_layout
    if "p" not in layout.names or "q" not in layout.names:
        return None
    scale = _scales_of_y(strand_of(system))
    return float(np.min(scale[..., layout.slice("p")] / scale[..., layout.slice("q")]))
