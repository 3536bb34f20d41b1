"""What is tried when a step does not converge: a stable elimination, continuation, shorter steps, in order.

This runs outside the compiled loop, step by step in plain Python: it is rare, and its program is compiled
only when it is first needed.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from knode_cosserat.rods.system import System
from knode_cosserat.solvers.boundary import Solution, newton
from knode_cosserat.solvers.linear import Decoupled
from knode_cosserat.solvers.past import EXTRAPOLATIONS, Past, advanced, history_of, problem_of
from knode_cosserat.solvers.problem import row_of
from knode_cosserat.solvers.result import Result
from knode_cosserat.solvers.settings import Settings
from knode_cosserat.solvers.stability import natural_time
from knode_cosserat.solvers.time import BDF1, Static

#: the smallest part of a time step that it is divided into, and how many parts are tried
LEAST_SUBSTEP, MOST_SUBSTEPS = 2.0**-14, 400
#: friction and contact are eased only in parts of a step below this: smaller parts alone mostly do
EASE_BELOW = 1.0 / 16.0
#: the smallest part of a change of control that continuation goes down to
LEAST_PART = 1.0 / 512.0
#: how much gentler friction and contact are, where continuation in them begins
EASIEST = 1e-3
#: forces in the control so many times EI/L² are taken for a wrong unit
ABSURD = 1e4
#: what part of the way a tip is brought in one step while a robot comes to rest
DRAWN = 0.05


class Outcome(NamedTuple):
    """A recovered step, or the best that was reached (`result` < 0)."""

    result: Result
    past: Past
    record: np.ndarray
    unknowns: np.ndarray
    error: float
    corrections: int
    size: float
    cause: str


@functools.partial(jax.jit, static_argnames="settings")
def attempt(
    system: System, settings: Settings, c0: Any, history: Any, control: Any, t: Any, y: Any, unknowns: Any,
    part: Any, from_y: Any,
) -> tuple[Solution, Any]:  # fmt: skip
    """One boundary-value problem with the stable elimination and a long search.

    The tip's conditions hold in `part`: of what they leave at `from_y` the rest is still left.
    """
    problem = problem_of(system, settings, t, control, c0, history).ready()
    problem = dataclasses.replace(problem, tip_offset=(1.0 - part) * problem.tip_residual(from_y[-1]))
    patient = dataclasses.replace(settings.newton, max_linearisations=40)
    solution = newton(problem, y, unknowns, Decoupled(), patient)
    return solution, problem.records(solution.y)


class _Step:
    """One time step as boundary-value problems, for one past and one set of coefficients."""

    def __init__(self, system: System, settings: Settings, past: Past, coefficients: Any, t: float):
        self.system, self.settings, self.past, self.t = system, settings, past, t
        self.coefficients = np.asarray(coefficients, dtype=float)
        self.history = history_of(past, self.coefficients, settings)
        self.corrections = 0

    def solve(
        self, control: Any, y: Any, unknowns: Any, part: float = 1.0, from_y: Any = None,
        system: System | None = None,
    ) -> tuple[Solution, Any]:  # fmt: skip
        solution, records = attempt(
            system or self.system, self.settings, self.coefficients[0], self.history, control, self.t, y,
            unknowns, part, y if from_y is None else from_y,
        )  # fmt: skip
        self.corrections += int(solution.corrections)
        return solution, records

    def guesses(self) -> list[tuple[Any, Any]]:
        guesses = [jnp.einsum("p,pny->ny", w, self.past.y) for w in EXTRAPOLATIONS[:2]]
        return [(y, self.system.unknowns(y[0])) for y in guesses]

    def solved(self, solution: Solution) -> bool:
        return bool(solution.error <= self.settings.newton.acceptable)

    def after(self, solution: Solution, records: Any) -> Past:
        rate = self.coefficients[0] * records + self.history
        return advanced(self.past, records, rate, solution.y, jnp.asarray(EXTRAPOLATIONS[0]))


def recover(
    system: System,
    settings: Settings,
    past: Past,
    coefficients: Any,
    controls: tuple[Any, Any],
    t: float,
    dt: float,
) -> Outcome:
    """Solve the step that ends at t. `controls` are the previous step's and this one's."""
    step = _Step(system, settings, past, coefficients, t)
    best: tuple[Solution, Any] | None = None
    for guess in step.guesses():
        found = step.solve(controls[1], *guess)
        if step.solved(found[0]):
            return _outcome(Result.RECOVERED_STABLE_ELIMINATION, step, found)
        if best is None or found[0].error < best[0].error:
            best = found
    continued = _continue_load(step, *controls)
    if continued is not None:
        return _outcome(Result.RECOVERED_LOAD_CONTINUATION, step, continued)
    eased = _ease(step, controls[1])
    if eased is not None:
        return _outcome(Result.RECOVERED_EASING, step, eased)
    if isinstance(settings.time, Static):
        relaxed = _relax(step, controls[1])
        if relaxed is not None:
            return _outcome(Result.RECOVERED_RELAXATION, step, relaxed)
    else:
        divided = _substeps(step, controls, dt)
        if divided is not None:
            return _outcome(Result.RECOVERED_STEP_HALVING, *divided)
    assert best is not None
    result = Result.NO_CONVERGENCE if np.isfinite(best[0].error) else Result.NOT_FINITE
    return _outcome(result, step, best, controls[1])._replace(past=past)


def _outcome(result: Result, step: _Step, found: tuple[Solution, Any], control: Any = None) -> Outcome:
    solution, records = found
    return Outcome(
        result,
        step.after(solution, records),
        np.asarray(row_of(step.system, solution.y, records)),
        np.asarray(solution.unknowns),
        float(solution.error),
        step.corrections,
        float(np.max(np.abs(solution.y) / np.asarray(step.system.scales().y))),
        likely_cause(result, step, control),
    )


def _continue_load(step: _Step, before: Any, now: Any) -> tuple[Solution, Any] | None:
    """From the previous control to this one in parts, each from the solution of the last."""
    before, now = np.asarray(before, dtype=float), np.asarray(now, dtype=float)
    if np.array_equal(before, now):
        return None
    for guess in step.guesses():
        found = step.solve(before, *guess)
        if not step.solved(found[0]):
            continue
        whole = _in_parts(
            step, found, lambda part, at: step.solve(before + part * (now - before), at.y, at.unknowns)
        )
        if whole is not None:
            return whole
    return None


def _ease(step: _Step, control: Any) -> tuple[Solution, Any] | None:
    """From friction and contact that set in gently to those that the system has."""
    system = step.system
    if system.eased(EASIEST) is system:
        return None
    for guess in step.guesses():
        found = step.solve(control, *guess, system=system.eased(EASIEST))
        if not step.solved(found[0]):
            continue

        def at_part(part: float, at: Solution) -> tuple[Solution, Any]:
            easier = system.eased(EASIEST ** (1.0 - part)) if part < 1.0 else system
            return step.solve(control, at.y, at.unknowns, system=easier)

        whole = _in_parts(step, found, at_part)
        if whole is not None:
            return whole
    return None


def _in_parts(
    step: _Step, found: tuple[Solution, Any], solve: Callable[[float, Solution], tuple[Solution, Any]]
) -> tuple[Solution, Any] | None:
    """From a solution at part 0 to that at 1, each from the last, in steps as long as go well."""
    reached, part = 0.0, 0.25
    while reached < 1.0 and part >= LEAST_PART:
        target = min(1.0, reached + part)
        following = solve(target, found[0])
        if step.solved(following[0]):
            found, reached, part = following, target, 2.0 * part
        else:
            part /= 4.0
    return found if reached == 1.0 else None


def _substeps(
    whole: _Step, controls: tuple[Any, Any], dt: float
) -> tuple[_Step, tuple[Solution, Any]] | None:
    """The step in parts: the control as it is held throughout, or brought there bit by bit."""
    for before in (controls[1], controls[0]):
        found = _in_substeps(whole, before, controls[1], dt)
        if found is not None:
            return found
    return None


def _in_substeps(whole: _Step, before: Any, now: Any, dt: float) -> tuple[_Step, tuple[Solution, Any]] | None:
    """The step in time steps as long as go well, with coefficients for unequal ones."""
    settings, past = whole.settings, whole.past
    before, now = np.asarray(before, dtype=float), np.asarray(now, dtype=float)
    reached, part, previous = 0.0, 0.5, 1.0
    scheme = settings.time if settings.start == "paper" else BDF1()
    for _ in range(MOST_SUBSTEPS):
        until = min(1.0, reached + part)
        coefficients = scheme.coefficients((until - reached) * dt, previous * dt)
        step = _Step(whole.system, settings, past, coefficients, whole.t - (1.0 - until) * dt)
        found = _one_substep(step, before + until * (now - before), ease=part < EASE_BELOW)
        if found is None:
            part /= 4.0
            if part < LEAST_SUBSTEP:
                return None
            continue
        if until == 1.0:
            # the next whole step looks back on whole steps, not on the parts
            step.past = whole.past
            return step, found
        past, previous, scheme = step.after(*found), until - reached, settings.time
        reached, part = until, 2.0 * previous
    return None


def _one_substep(step: _Step, control: Any, ease: bool) -> tuple[Solution, Any] | None:
    for guess in step.guesses():
        found = step.solve(control, *guess)
        if step.solved(found[0]):
            return found
    return _ease(step, control) if ease else None


def _relax(step: _Step, control: Any) -> tuple[Solution, Any] | None:
    """Implicit Euler with ever longer time steps, then the static solve: comes to rest in a stable shape.

    A tip that is held elsewhere than where it is, or loaded, is brought there in the first steps.
    """
    now, part = step.past, 0.0
    natural = natural_time(step.system) or 0.1
    dt, longest = 0.1 * natural, 1e5 * natural
    at_first = step.guesses()[0][0]
    for _ in range(80):
        moving = _Step(step.system, step.settings, now, BDF1().coefficients(dt, dt), 0.0)
        target = min(1.0, part + DRAWN)
        found = moving.solve(control, *moving.guesses()[0], target, at_first)
        if not moving.solved(found[0]):
            dt /= 4.0
            continue
        # short steps until the tip is where it belongs
        now, dt = moving.after(*found), 2.0 * dt if part == 1.0 else dt
        part = target
        if dt > longest:
            break
    y = now.y[0]
    found = step.solve(control, y, step.system.unknowns(y[0]))
    return found if step.solved(found[0]) else None


def likely_cause(result: Result, step: _Step, control: Any) -> str:
    """A hint at what to change, from what can be seen."""
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
    """Of a force in the control that is absurdly large: that it may be meant in another unit."""
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
