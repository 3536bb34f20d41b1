"""Recovery of a failed step: other guesses, load continuation, easing, shorter steps, in this order.

It runs outside the compiled loop, step by step in plain Python. It is rare, and its program is compiled only
when it is first needed.
"""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from knode_cosserat.errors import KnodeCosseratError
from knode_cosserat.rods.system import System, unknown_count, unknowns_of
from knode_cosserat.solvers.boundary import Solution, newton
from knode_cosserat.solvers.grid import grid_of
from knode_cosserat.solvers.guess import hanging_curve, natural_reach, state_from_positions
from knode_cosserat.solvers.history import EXTRAPOLATIONS, StateHistory, history_of
from knode_cosserat.solvers.problem import StepProblem
from knode_cosserat.solvers.result import Result
from knode_cosserat.solvers.settings import Settings
from knode_cosserat.solvers.time import BDF1, Static
from knode_cosserat.solvers.time_loop import StepRows, recorded_step

#: smallest substep as a part of a time step, and largest number of substeps tried
LEAST_SUBSTEP, MOST_SUBSTEPS = 2.0**-14, 400
#: friction and contact are eased only in substeps below this part of a step: smaller substeps mostly suffice
EASE_BELOW = 1.0 / 16.0
#: smallest load step of continuation, as a part of the change of control
LEAST_PART = 1.0 / 512.0
#: initial factor by which continuation eases friction and contact
EASIEST = 1e-3
#: forces in the control above this multiple of EI/L² suggest a wrong unit
ABSURD = 1e4
#: part of the distance that a tip is moved in one step of relaxation
DRAWN = 0.05
#: reaches of the initial curves between held ends, as multiples of the natural reach
REACHES = (1.0, 0.3, 3.0)
#: default recovery budget: this multiple of the run's own time, or this many seconds, whichever is more
BUDGET_SHARE, BUDGET_LEAST = 20.0, 5.0


class BudgetError(KnodeCosseratError):
    """The time for recovery is used up."""

    code = "recovery-budget"


class Budget:
    """The time (s) that recovery may take in one run; compiling its program does not count."""

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


class Outcome(NamedTuple):
    """A recovered step, or the best attempt (`result` < 0)."""

    result: Result
    past: StateHistory
    record: np.ndarray
    unknowns: np.ndarray
    error: float
    corrections: int
    position_error: float
    cause: str


class Attempt(NamedTuple):
    """Result of one boundary-value problem."""

    solution: Solution
    after: StateHistory
    row: StepRows


@functools.partial(jax.jit, static_argnames="settings")
def attempt(
    system: System, settings: Settings, past: StateHistory, coefficients: Any, control: Any, t: Any, y: Any,
    unknowns: Any,
    part: Any, from_y: Any,
) -> Attempt:  # fmt: skip
    """Solve one boundary-value problem with a long search.

    The tip's boundary conditions are enforced in `part`: the rest of their residual at `from_y` remains.
    """
    history = history_of(past.records, past.rate, coefficients, settings)
    problem = StepProblem(system, t, control, coefficients[0], history, settings.space).ready()
    problem = dataclasses.replace(problem, tip_offset=(1.0 - part) * problem.tip_residual(from_y[-1]))
    patient = dataclasses.replace(settings.newton, max_linearisations=40)
    solution, kept = newton(problem, y, unknowns, patient)
    after, row = recorded_step(problem, settings, past, coefficients, solution, kept.factors)
    return Attempt(solution, after._replace(weights=jnp.asarray(EXTRAPOLATIONS[0])), row)


#: compiled programs of `attempt`: the first call of each compiles and does not count
_COMPILED: set[Any] = set()


class _Step:
    """One time step as boundary-value problems, for one history and one set of coefficients."""

    def __init__(
        self,
        system: System,
        settings: Settings,
        past: StateHistory,
        coefficients: Any,
        t: float,
        budget: Budget,
    ):
        self.system, self.settings, self.past, self.t = system, settings, past, t
        self.coefficients, self.budget = np.asarray(coefficients, dtype=float), budget
        self.corrections = 0

    def solve(
        self, control: Any, y: Any, unknowns: Any, part: float = 1.0, from_y: Any = None,
        system: System | None = None,
    ) -> Attempt:  # fmt: skip
        began, own = time.perf_counter(), system or self.system
        found = attempt(
            own, self.settings, self.past, self.coefficients, control, self.t, y, unknowns, part,
            y if from_y is None else from_y,
        )  # fmt: skip
        self.corrections += int(found.solution.corrections)
        program = jax.tree.structure(own), self.settings, np.shape(y)
        if program in _COMPILED:
            self.budget.spend(time.perf_counter() - began)
        _COMPILED.add(program)
        return found

    def hanging(self, control: Any) -> list[tuple[Any, Any]]:
        """Return initial guesses of an equilibrium between held ends: curves of the rod's length."""
        found: list[tuple[Any, Any]] = []
        if not isinstance(self.settings.time, Static):
            return found
        for reach in dict.fromkeys(min(1.0, part * natural_reach(self.system)) for part in REACHES):
            points = hanging_curve(self.system, control, reach)
            if points is not None:
                record = state_from_positions(self.system, points, control)
                y = grid_of(self.system).spread(jnp.asarray(record[:, : self.system.y_layout.size]))
                found.append((y, unknowns_of(self.system, y[0])))
        return found

    def guesses(self) -> list[tuple[Any, Any]]:
        guesses = [jnp.einsum("p,pny->ny", w, self.past.y) for w in EXTRAPOLATIONS[:2]]
        return [(y, unknowns_of(self.system, y[0])) for y in guesses]

    def solved(self, found: Attempt) -> bool:
        return bool(found.row.error <= self.settings.newton.acceptable)


def recover(
    system: System,
    settings: Settings,
    past: StateHistory,
    coefficients: Any,
    controls: tuple[Any, Any],
    t: float,
    dt: float,
    budget: Budget,
) -> Outcome:
    """Solve the step that ends at t. `controls` are the previous step's and this one's."""
    step = _Step(system, settings, past, coefficients, t, budget)
    if budget.seconds <= 0.0:
        return _given_up(step, controls[1])
    best: list[Attempt] = []
    cause = ""
    try:
        found = _recovered(step, controls, dt, best)
        if found is not None:
            return _outcome(*found)
    except BudgetError:
        cause = f"Recovery was stopped after {budget.seconds:.3g} s (recovery_budget)."
        step.budget = Budget(np.inf)
    least = min(best, key=lambda each: float(each.solution.error)) if best else None
    if least is None:
        least = step.solve(controls[1], *step.guesses()[0])
    result = Result.NO_CONVERGENCE if np.isfinite(least.solution.error) else Result.NOT_FINITE
    outcome = _outcome(result, step, least, controls[1])._replace(past=past)
    return outcome._replace(cause=f"{outcome.cause} {cause}".strip())


def _given_up(step: _Step, control: Any) -> Outcome:
    """Return the outcome of a failed step without recovery; nothing is compiled."""
    past, system = step.past, step.system
    record = np.full((system.nodes, past.records.shape[-1]), np.nan)
    cause = likely_cause(Result.NO_CONVERGENCE, step, control)
    unknowns = np.full(unknown_count(system), np.nan)
    return Outcome(Result.NO_CONVERGENCE, past, record, unknowns, np.inf, 0, np.nan, cause)


def _recovered(
    step: _Step, controls: tuple[Any, Any], dt: float, best: list[Attempt]
) -> tuple[Result, _Step, Attempt] | None:
    """Try all methods in order; attempts from direct guesses are added to `best`."""
    for guess in (*step.hanging(controls[1]), *step.guesses()):
        found = step.solve(controls[1], *guess)
        best.append(found)
        if step.solved(found):
            return Result.CONVERGED, step, found
    continued = _continue_load(step, *controls)
    if continued is not None:
        return Result.RECOVERED_LOAD_CONTINUATION, step, continued
    eased = _ease(step, controls[1])
    if eased is not None:
        return Result.RECOVERED_EASING, step, eased
    if isinstance(step.settings.time, Static):
        relaxed = _relax(step, controls[1])
        return None if relaxed is None else (Result.RECOVERED_RELAXATION, step, relaxed)
    divided = _substeps(step, controls, dt)
    return None if divided is None else (Result.RECOVERED_STEP_HALVING, *divided)


def _outcome(result: Result, step: _Step, found: Attempt, control: Any = None) -> Outcome:
    row = found.row
    return Outcome(
        result, found.after, np.asarray(row.records), np.asarray(row.unknowns), float(row.error),
        step.corrections, float(row.position_error), likely_cause(result, step, control),
    )  # fmt: skip


def _continue_load(step: _Step, before: Any, now: Any) -> Attempt | None:
    """Continue from the previous control to this one in load steps, each from the last solution."""
    before, now = np.asarray(before, dtype=float), np.asarray(now, dtype=float)
    if np.array_equal(before, now):
        return None
    for guess in step.guesses():
        found = step.solve(before, *guess)
        if not step.solved(found):
            continue
        whole = _in_parts(
            step, found, lambda part, at: step.solve(before + part * (now - before), at.y, at.unknowns)
        )
        if whole is not None:
            return whole
    return None


def _ease(step: _Step, control: Any) -> Attempt | None:
    """Continue from eased friction and contact to the system's own."""
    system = step.system
    if system.eased(EASIEST) is system:
        return None
    for guess in step.guesses():
        found = step.solve(control, *guess, system=system.eased(EASIEST))
        if not step.solved(found):
            continue

        def at_part(part: float, at: Solution) -> Attempt:
            easier = system.eased(EASIEST ** (1.0 - part)) if part < 1.0 else system
            return step.solve(control, at.y, at.unknowns, system=easier)

        whole = _in_parts(step, found, at_part)
        if whole is not None:
            return whole
    return None


def _in_parts(step: _Step, found: Attempt, solve: Callable[[float, Solution], Attempt]) -> Attempt | None:
    """Continue from a solution at part 0 to part 1, with adaptive steps, each from the last solution."""
    reached, part = 0.0, 0.25
    while reached < 1.0 and part >= LEAST_PART:
        target = min(1.0, reached + part)
        following = solve(target, found.solution)
        if step.solved(following):
            found, reached, part = following, target, 2.0 * part
        else:
            part /= 4.0
    return found if reached == 1.0 else None


def _substeps(whole: _Step, controls: tuple[Any, Any], dt: float) -> tuple[_Step, Attempt] | None:
    """Divide the step into substeps: with a constant control first, then with a ramp."""
    for before in (controls[1], controls[0]):
        found = _in_substeps(whole, before, controls[1], dt)
        if found is not None:
            return found
    return None


def _in_substeps(whole: _Step, before: Any, now: Any, dt: float) -> tuple[_Step, Attempt] | None:
    """Solve the step by adaptive substeps, with coefficients for unequal time steps."""
    settings, past = whole.settings, whole.past
    before, now = np.asarray(before, dtype=float), np.asarray(now, dtype=float)
    reached, part, previous = 0.0, 0.5, 1.0
    scheme = settings.time if settings.start == "paper" else BDF1()
    for _ in range(MOST_SUBSTEPS):
        until = min(1.0, reached + part)
        coefficients = scheme.coefficients((until - reached) * dt, previous * dt)
        step = _Step(whole.system, settings, past, coefficients, whole.t - (1.0 - until) * dt, whole.budget)
        found = _one_substep(step, before + until * (now - before), ease=part < EASE_BELOW)
        if found is None:
            part /= 4.0
            if part < LEAST_SUBSTEP:
                return None
            continue
        if until == 1.0:
            # the history of the next step holds whole steps, not substeps
            before, after = whole.past, found.after
            past = after._replace(
                records=jnp.stack([after.records[0], before.records[0]]),
                y=jnp.concatenate([after.y[:1], before.y[:-1]]),
                error=jnp.stack([after.error[0], before.error[0], after.error[2]]),
            )
            return step, found._replace(after=past)
        past, previous, scheme = found.after, until - reached, settings.time
        reached, part = until, 2.0 * previous
    return None


def _one_substep(step: _Step, control: Any, ease: bool) -> Attempt | None:
    for guess in step.guesses():
        found = step.solve(control, *guess)
        if step.solved(found):
            return found
    return _ease(step, control) if ease else None


def _relax(step: _Step, control: Any) -> Attempt | None:
    """Relax by implicit Euler with growing time steps, then solve the static problem; ends in a stable shape.

    The tip's boundary conditions are applied gradually in the first steps.
    """
    now, part = step.past, 0.0
    natural = natural_time(step.system) or 0.1
    dt, longest = 0.1 * natural, 1e5 * natural
    at_first = step.guesses()[0][0]
    for _ in range(80):
        moving = _Step(step.system, step.settings, now, BDF1().coefficients(dt, dt), 0.0, step.budget)
        target = min(1.0, part + DRAWN)
        found = moving.solve(control, *moving.guesses()[0], target, at_first)
        if not moving.solved(found):
            dt /= 4.0
            continue
        # short steps until the tip's boundary conditions hold
        now, dt = found.after, 2.0 * dt if part == 1.0 else dt
        part = target
        if dt > longest:
            break
    y = now.y[0]
    found = step.solve(control, y, unknowns_of(step.system, y[0]))
    return found if step.solved(found) else None


def likely_cause(result: Result, step: _Step, control: Any) -> str:
    """Return a hint at the likely cause and the fix."""
    if result.solved:
        return ""
    unit = other_unit(step.system, np.asarray(control))
    if unit:
        return unit
    if not step.system.held and isinstance(step.settings.time, Static):
        return (
            "Likely cause: nothing holds the robot, which is at rest only where all loads on it cancel out; "
            "hold an end of it, or simulate its motion."
        )
    nodes = step.system.nodes
    if result is Result.NOT_FINITE:
        return (
            f"Likely too few nodes for so soft or loaded a rod ({nodes}): use more, or a smaller time step."
        )
    return (
        "Likely cause: the control changes too much in one step, the rod buckles or snaps, "
        f"or it has too few nodes ({nodes})."
    )


def other_unit(system: System, control: np.ndarray) -> str:
    """Return a hint at another unit if a force in the control is absurdly large."""
    if "n" not in system.y_layout.names:
        return ""
    natural = float(np.asarray(system.scales().y)[system.y_layout.slice("n")][0])
    for field in system.control_layout.fields:
        largest = float(np.max(np.abs(system.control_layout.get(control, field.name)), initial=0.0))
        if field.unit == "N" and largest > ABSURD * natural:
            return (
                f"Likely cause: {field.name} is {largest:.3g} N, {largest / natural:.2g} times what bends "
                "this robot by its own length; is it meant in another unit?"
            )
    return ""


def natural_time(system: System) -> float | None:
    """Return the time (s) in which the system moves by its own length; None if its scales do not give it."""
    layout = system.strand.y_layout
    if "p" not in layout.names or "q" not in layout.names:
        return None
    scale = np.asarray(system.strand.scales().y)
    return float(np.min(scale[..., layout.slice("p")] / scale[..., layout.slice("q")]))
