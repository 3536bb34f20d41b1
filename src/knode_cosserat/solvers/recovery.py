"""Recovery of a failed step: other guesses, load continuation, easing, then a method of the kind of problem.

It runs outside the compiled loop, step by step in plain Python, by the machine code of the run.
"""

from __future__ import annotations

import abc
import dataclasses
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from knode_cosserat.engine import loops as engine
from knode_cosserat.engine.pattern import values_along
from knode_cosserat.rods.aspects import Ends
from knode_cosserat.rods.kept import kept
from knode_cosserat.rods.parts import ease
from knode_cosserat.rods.strands import strand_of
from knode_cosserat.rods.system import System, unknown_count
from knode_cosserat.schemes import history
from knode_cosserat.schemes.grid import grid_of
from knode_cosserat.schemes.result import Result
from knode_cosserat.schemes.settings import Settings
from knode_cosserat.schemes.time import BDF1, BDF2, pad_coefficients
from knode_cosserat.solvers.guess import (
    LARGEST_JUMP,
    LARGEST_TURN,
    curve_guesses,
    largest_turns,
    turns_between,
)
from knode_cosserat.solvers.replay import still_state

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


#: smallest substep as a part of a time step, and largest number of substeps tried
LEAST_SUBSTEP, MOST_SUBSTEPS = 2.0**-14, 400
#: friction and contact are eased only in substeps below this part of a step: smaller substeps mostly suffice
EASE_BELOW = 1.0 / 16.0
#: part of the distance that a tip is moved in one step of relaxation
DRAWN = 0.05


#: likely cause of a failure where an end turns too far in one step
FAR_TURN = (
    "Likely cause: the control turns an end too far in one step, and turns would be lost; turn it over more "
    "rows, or use a smaller time step."
)


class Budget:
    """The time (s) that recovery may take in one run; none from when `stop` returns True."""

    def __init__(self, seconds: float | None, stop: Callable[[], bool] | None = None):
        """Set a fixed budget in seconds; None: in proportion to the run's own time."""
        self._fixed, self._stop, self._own, self._used = seconds, stop, 0.0, 0.0

    @property
    def seconds(self) -> float:
        """Total time (s) that recovery may take."""
        if self._stop is not None and self._stop():
            return 0.0
        return max(BUDGET_LEAST, BUDGET_SHARE * self._own) if self._fixed is None else self._fixed

    def ran(self, seconds: float) -> None:
        """Count time of the run itself."""
        self._own += seconds

    def spend(self, seconds: float) -> None:
        """Count time of recovery. Raises `TimeoutError` if the budget is used up."""
        self._used += seconds
        if self._used > self.seconds:
            raise TimeoutError


class SolvedStep(NamedTuple):
    """A solved step, or the best attempt (`row.result` < 0)."""

    #: start of the next step: a `StateHistory`, or y at all points of an equilibrium
    state: Any
    row: history.StepRows
    #: likely cause of a failure
    cause: str = ""


class Recovery(abc.ABC):
    """Recovery of one step, as a series of boundary-value problems."""

    #: the time step; None for an equilibrium
    step: history.TimeStep | None = None

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

    def largest_part(self, controls: tuple[Any, Any]) -> float:
        """Return the largest part of a change of control in which turns of the ends are kept."""
        return 1.0

    def solve(
        self, control: Any, guess: Any, tip_offset: Any = 0.0, system: System | None = None
    ) -> SolvedStep:
        """Solve the step under a control, from y at all points, with a long search.

        The offset (k,) is subtracted from the residual of the tip's boundary conditions.
        """
        began, newton = time.perf_counter(), self.settings.newton
        newton = dataclasses.replace(newton, max_linearisations=MOST_LINEARISATIONS)
        patient = dataclasses.replace(self.settings, newton=newton)
        start, weights, step = guess, history.EXTRAPOLATIONS[0], self.step
        if step is None:
            steps = history.StepCoefficients.of(patient)
        else:
            steps = history.StepCoefficients(patient, np.asarray(step.coefficients)[None], step.t)
            # the first guess is the newest of the earlier states
            start = step.past._replace(y=np.stack([guess, *step.past.y[:-1]]), weights=weights, t0=0.0)
        _, state, rows = engine.solve_steps(
            system or self.system,
            steps._replace(tip_offset=tip_offset),
            np.asarray(control)[None],
            start,
            (0, 1),
        )
        if step is not None:
            y = np.stack([state.y[0], *step.past.y[:-1]])
            state = state._replace(y=y, weights=weights, t0=step.past.t0)
        found = SolvedStep(state, history.StepRows(*(leaf[0] for leaf in rows)))
        self.corrections += int(found.row.corrections)
        self.budget.spend(time.perf_counter() - began)
        return found

    def solved(self, found: SolvedStep) -> bool:
        """Return True if the attempt is a solution."""
        return bool(found.row.error <= self.settings.newton.acceptable)

    def recover(
        self, controls: tuple[Any, Any], has_direct: bool = True, has_last: bool = True
    ) -> SolvedStep:
        """Solve the step by all methods in order. `controls` are the previous step's and this one's.

        The direct methods solve the step itself, the last one may change the problem on the way.
        """
        if self.budget.seconds <= 0.0:
            return self._given_up(controls[1])
        best: list[SolvedStep] = []
        cause = ""
        try:
            found = self._directly(controls, best) if has_direct else None
            if found is None and has_last:
                found = self.last_method(controls)
            if found is not None:
                return self._outcome(*found)
        except TimeoutError:
            cause = f"Recovery was stopped after {self.budget.seconds:.3g} s (recovery_budget)."
        # an attempt that is only reported
        self.budget = Budget(np.inf)
        least = min(best, key=lambda each: float(each.row.error)) if best else None
        if least is None:
            least = self.solve(controls[1], self.guesses()[0])
        result = Result.NO_CONVERGENCE if np.isfinite(least.row.error) else Result.NOT_FINITE
        likely = likely_cause(result, self.system, self.settings, controls[1])
        cause = f"{likely if self.largest_part(controls) == 1.0 else FAR_TURN} {cause}".strip()
        return self._outcome(result, least)._replace(state=self.state, cause=cause)

    def _given_up(self, control: Any) -> SolvedStep:
        """Return the outcome of a failed step without recovery; nothing is compiled."""
        system, result = self.system, Result.NO_CONVERGENCE
        width = system.y_layout.size * (2 if system.mixed else 1) + system.z_layout.size
        record, unknowns = np.full((system.nodes, width), np.nan), np.full(unknown_count(system), np.nan)
        stages = (np.zeros((0, *np.shape(each))) for each in (record, unknowns))
        row = history.StepRows(record, unknowns, np.inf, 0, np.nan, int(result), np.nan, *stages)
        return SolvedStep(self.state, row, likely_cause(result, system, self.settings, control))

    def _outcome(self, result: Result, found: SolvedStep) -> SolvedStep:
        row = found.row
        if result.solved and row.result == Result.COARSE:
            result = Result.COARSE
        return SolvedStep(found.state, row._replace(corrections=self.corrections, result=int(result)))

    def _directly(
        self, controls: tuple[Any, Any], best: list[SolvedStep]
    ) -> tuple[Result, SolvedStep] | None:
        """Try guesses, load continuation and easing; attempts from guesses are added to `best`."""
        at_once = self.largest_part(controls) == 1.0
        for guess in self.first_guesses(controls[1]) if at_once else ():
            found = self.solve(controls[1], guess)
            best.append(found)
            if self.solved(found) and self.keeps_turns(found):
                return Result.CONVERGED, found
        continued = self.continue_load(*controls)
        if continued is not None:
            return Result.RECOVERED_LOAD_CONTINUATION, continued
        eased = self.ease(controls[1]) if at_once else None
        return None if eased is None else (Result.RECOVERED_EASING, eased)

    def continue_load(self, before: Any, now: Any) -> SolvedStep | None:
        """Continue from the previous control to this one in load steps, each from the last solution."""
        before, now = np.asarray(before, dtype=float), np.asarray(now, dtype=float)
        if np.array_equal(before, now):
            return None

        def at_part(part: float, y: Any) -> SolvedStep:
            return self.solve(before + part * (now - before), y)

        return self._in_parts(
            lambda guess: self.solve(before, guess), at_part, self.largest_part((before, now))
        )

    def ease(self, control: Any) -> SolvedStep | None:
        """Continue from eased friction and contact to the system's own."""
        system = self.system
        easiest = ease(system, EASIEST)
        if easiest is system:
            return None

        def at_part(part: float, y: Any) -> SolvedStep:
            easier = ease(system, EASIEST ** (1.0 - part)) if part < 1.0 else system
            return self.solve(control, y, system=easier)

        return self._in_parts(lambda guess: self.solve(control, guess, system=easiest), at_part)

    def _in_parts(
        self, first: Callable[[Any], SolvedStep], solve: Callable[[float, Any], SolvedStep], most: float = 1.0
    ) -> SolvedStep | None:
        """Continue from a solution at part 0 to part 1, with adaptive steps, each from the last solution.

        A step is at most the part `most`, and keeps the turns between the ends.
        """
        for guess in self.guesses():
            found = first(guess)
            fits = self.solved(found) and self.keeps_turns(found)
            reached, part = 0.0, min(0.25, most) if fits else 0.0
            while reached < 1.0 and part >= LEAST_PART:
                target = min(1.0, reached + part)
                y = found.state if self.step is None else found.state.y[0]
                following = solve(target, y)
                if self.solved(following) and self.keeps_turns(following, found.row.records):
                    found, reached, part = following, target, min(2.0 * part, most)
                else:
                    part /= 4.0
            if reached == 1.0:
                return found
        return None

    def keeps_turns(self, found: SolvedStep, before: Any = None) -> bool:
        """True if a solution has the turns of the records before, by default of the state before the step.

        The ends must have turned by less than half a turn.
        """
        return before is None or not turns_between(self.system, before, found.row.records)


class StepRecovery(Recovery):
    """Recovery of a time step. Its last method divides the step into substeps."""

    step: history.TimeStep

    def __init__(self, system: System, settings: Settings, step: history.TimeStep, dt: float, budget: Budget):
        super().__init__(system, settings, budget)
        self.step = jax.tree.map(lambda leaf: np.asarray(leaf, dtype=float), step)
        self.dt = dt

    @property
    def state(self) -> Any:
        """History before the step."""
        return self.step.past

    def largest_part(self, controls: tuple[Any, Any]) -> float:
        """Return 1 for all but far turns of an end."""
        angle = float(largest_turns(self.system, np.subtract(controls[1], controls[0])))
        return LARGEST_TURN / angle if angle > LARGEST_JUMP else 1.0

    def keeps_turns(self, found: SolvedStep, before: Any = None) -> bool:
        """True if a solution has the turns of the records before."""
        before = self.step.past.y[0][grid_of(self.system).nodes] if before is None else before
        return super().keeps_turns(found, before)

    def guesses(self) -> list[Any]:
        """Return the last state, and its linear extrapolation."""
        return [np.einsum("p,pny->ny", w, self.step.past.y) for w in history.EXTRAPOLATIONS[:2]]

    def last_method(self, controls: tuple[Any, Any]) -> tuple[Result, SolvedStep] | None:
        """Divide the step into substeps: with a constant control first, then with a ramp."""
        ramp_only = self.largest_part(controls) < 1.0
        for before in controls[:1] if ramp_only else controls[::-1]:
            found = self._in_substeps(before, controls[1])
            if found is not None:
                return Result.RECOVERED_STEP_HALVING, found
        return None

    def _in_substeps(self, before: Any, now: Any) -> SolvedStep | None:
        """Solve the step by adaptive substeps, with coefficients for unequal time steps.

        The substeps of a scheme of several stages are those of BDF2.
        """
        settings, past, dt = self.settings, self.step.past, self.dt
        before, now = np.asarray(before, dtype=float), np.asarray(now, dtype=float)
        most, memory = self.largest_part((before, now)), settings.memory
        reached, part = 0.0, min(0.5, most)
        #: lengths of earlier steps, the last one first
        previous = [dt] * (memory - 1)
        assert settings.time is not None
        regular = settings.time if settings.stages == 1 else BDF2()
        scheme = settings.time if settings.start == "paper" and settings.stages == 1 else BDF1()
        for _ in range(MOST_SUBSTEPS):
            until = min(1.0, reached + part)
            coefficients = pad_coefficients(scheme.coefficients((until - reached) * dt, *previous), memory)
            step = history.TimeStep(past, coefficients, float(self.step.t) - (1.0 - until) * dt)
            substep = StepRecovery(self.system, settings, step, dt, self.budget)
            found = substep.direct(before + until * (now - before), ease=part < EASE_BELOW)
            if found is None:
                part /= 4.0
                if part < LEAST_SUBSTEP:
                    return None
                continue
            self.corrections = substep.corrections
            if until == 1.0:
                return found._replace(state=self._whole(found.state))
            past, scheme = found.state, regular
            previous = [(until - reached) * dt, *previous[:-1]]
            reached, part = until, min(2.0 * (until - reached), most)
        return None

    def direct(self, control: Any, ease: bool) -> SolvedStep | None:
        """Return a solution from the guesses, or by easing."""
        for guess in self.guesses():
            found = self.solve(control, guess)
            if self.solved(found) and self.keeps_turns(found):
                return found
        return self.ease(control) if ease else None

    def _whole(self, after: Any) -> Any:
        """Return the history of the next step, which holds whole steps, not substeps."""
        before = self.step.past
        return after._replace(
            records=np.stack([after.records[0], *before.records[:-1]]),
            y=np.stack([after.y[0], *before.y[:-1]]),
            error=np.stack([after.error[0], *before.error[:-2], after.error[-1]]),
        )


def recovered_stages(whole: StepRecovery, controls: tuple[Any, Any]) -> SolvedStep:
    """Recover a step of several stages: each stage, or all of them by substeps of a multistep scheme."""
    system, settings, step, dt, budget = whole.system, whole.settings, whole.step, whole.dt, whole.budget
    shape = settings.stages, system.control_layout.size
    before, now = (np.broadcast_to(np.reshape(each, (-1, shape[1])), shape) for each in controls)
    last, past, found = before[-1], step.past, []
    for coefficients, t, own in zip(step.coefficients, step.t, now, strict=True):
        stage = StepRecovery(system, settings, history.TimeStep(past, coefficients, t), dt, budget)
        # the whole step is divided, not a stage
        solved = stage.recover((last, own), has_last=False)
        if solved.row.result < 0:
            break
        found.append(solved.row)
        past, last = solved.state, own
    else:
        row = found[-1]._replace(
            error=max(each.error for each in found),
            corrections=sum(each.corrections for each in found),
            result=max(int(each.result) for each in found),
            stages=np.stack([each.records for each in found[:-1]]),
            stage_unknowns=np.stack([each.unknowns for each in found[:-1]]),
        )
        past = past._replace(time_error=np.full_like(past.time_error, np.nan))
        return SolvedStep(past, row)
    one = history.TimeStep(step.past, pad_coefficients(BDF1().coefficients(dt), settings.memory), step.t[-1])
    # without direct methods: a whole step of one stage would be another scheme's
    divided = StepRecovery(system, settings, one, dt, budget)
    solved = divided.recover((before[-1], now[-1]), has_direct=False)
    lost = solved.state._replace(time_error=np.full_like(solved.state.time_error, np.nan))
    row, count = solved.row, settings.stages - 1
    # between the ends of such a step no stages are known
    stages, unknowns = (np.repeat(each[None], count, axis=0) for each in (row.records, row.unknowns))
    return solved._replace(state=lost, row=row._replace(stages=stages, stage_unknowns=unknowns))


class StaticRecovery(Recovery):
    """Recovery of an equilibrium. Its last method relaxes the robot in a damped motion."""

    def __init__(self, system: System, settings: Settings, y: Any, budget: Budget):
        super().__init__(system, settings, budget)
        self._y = np.asarray(y)

    @property
    def state(self) -> Any:
        """y at all points before the equilibrium."""
        return self._y

    def guesses(self) -> list[Any]:
        """Return the state before."""
        return [self._y]

    def first_guesses(self, control: Any) -> list[Any]:
        """Return curves of the rod's length between held ends, then the state before."""
        return [*curve_guesses(self.system, control), *self.guesses()]

    def last_method(self, controls: tuple[Any, Any]) -> tuple[Result, SolvedStep] | None:
        """Relax by implicit Euler with growing time steps, then solve the equilibrium; it is then stable.

        The tip's boundary conditions are applied gradually in the first steps.
        """
        system, part = self.system, 0.0
        settings = Settings(BDF1(), self.settings.space, newton=self.settings.newton)
        still = still_state(system, settings.space, controls[1], self._y)
        past = history.repeated_record_history(system, settings, still.records, self._y, 0.0)
        natural = natural_time(system) or 0.1
        dt, longest = 0.1 * natural, 1e5 * natural
        for _ in range(80):
            step = history.TimeStep(past, BDF1().coefficients(dt), 0.0)
            moving = StepRecovery(system, settings, step, dt, self.budget)
            target = min(1.0, part + DRAWN)
            found = moving.solve(controls[1], moving.guesses()[0], (1.0 - target) * still.tip)
            if not moving.solved(found):
                dt /= 4.0
                continue
            # short steps until the tip's boundary conditions hold
            past, dt = found.state, 2.0 * dt if part == 1.0 else dt
            part = target
            if dt > longest:
                break
        found = self.solve(controls[1], past.y[0])
        return (Result.RECOVERED_RELAXATION, found) if self.solved(found) else None


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
        step = "" if settings.time is None else ", or too long a time step"
        return (
            f"Likely cause: too few nodes for so soft or loaded a rod ({system.nodes}){step}"
            f"{_largest(system, np.asarray(control))}."
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


def _largest(system: System, control: np.ndarray) -> str:
    """Return the largest control in words, as another possible cause."""
    sizes = [
        (float(np.max(np.abs(system.control_layout.get(control, field.name)), initial=0.0)), field)
        for field in system.control_layout.fields
    ]
    size, field = max(sizes, key=lambda it: it[0], default=(0.0, None))
    return f", or too large a control ({field.name} is {size:.3g} {field.unit})" if field and size else ""


def _scales_of_y(system: System) -> Any:
    return values_along(_scales_at, system, [0.0])[0]


def _scales_at(system: System, s: Any, _: Any) -> Any:
    return system.scales().y


@kept
def natural_time(system: System) -> float | None:
    """Return the time (s) in which the system moves by its own length; None if its scales do not give it."""
    layout = strand_of(system).y_layout
    if "p" not in layout.names or "q" not in layout.names:
        return None
    scale = _scales_of_y(strand_of(system))
    return float(np.min(scale[..., layout.slice("p")] / scale[..., layout.slice("q")]))
