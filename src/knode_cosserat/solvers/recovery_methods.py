"""Recovery of a time step and of an equilibrium: their guesses, and their last methods."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from knode_cosserat.rods.system import System
from knode_cosserat.solvers.evaluation import still_state
from knode_cosserat.solvers.guess import curve_guesses
from knode_cosserat.solvers.history import EXTRAPOLATIONS, repeated_record_history
from knode_cosserat.solvers.recovery import Budget, Recovery, SolvedStep, natural_time
from knode_cosserat.solvers.result import Result
from knode_cosserat.solvers.settings import Settings
from knode_cosserat.solvers.steps import TimeStep
from knode_cosserat.solvers.time import BDF1, BDF2, padded

#: smallest substep as a part of a time step, and largest number of substeps tried
LEAST_SUBSTEP, MOST_SUBSTEPS = 2.0**-14, 400
#: friction and contact are eased only in substeps below this part of a step: smaller substeps mostly suffice
EASE_BELOW = 1.0 / 16.0
#: part of the distance that a tip is moved in one step of relaxation
DRAWN = 0.05


class StepRecovery(Recovery):
    """Recovery of a time step. Its last method divides the step into substeps."""

    step: TimeStep

    def __init__(self, system: System, settings: Settings, step: TimeStep, dt: float, budget: Budget):
        super().__init__(system, settings, budget)
        self.step = jax.tree.map(lambda leaf: np.asarray(leaf, dtype=float), step)
        self.dt = dt

    @property
    def state(self) -> Any:
        """History before the step."""
        return self.step.past

    def guesses(self) -> list[Any]:
        """Return the last state, and its linear extrapolation."""
        return [np.einsum("p,pny->ny", w, self.step.past.y) for w in EXTRAPOLATIONS[:2]]

    def last_method(self, controls: tuple[Any, Any]) -> tuple[Result, SolvedStep] | None:
        """Divide the step into substeps: with a constant control first, then with a ramp."""
        for before in (controls[1], controls[0]):
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
        reached, part, memory = 0.0, 0.5, settings.memory
        #: lengths of earlier steps, the last one first
        previous = [dt] * (memory - 1)
        assert settings.time is not None
        regular = settings.time if settings.stages == 1 else BDF2()
        scheme = settings.time if settings.start == "paper" and settings.stages == 1 else BDF1()
        for _ in range(MOST_SUBSTEPS):
            until = min(1.0, reached + part)
            coefficients = padded(scheme.coefficients((until - reached) * dt, *previous), memory)
            step = TimeStep(past, coefficients, float(self.step.t) - (1.0 - until) * dt)
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
            reached, part = until, 2.0 * (until - reached)
        return None

    def direct(self, control: Any, ease: bool) -> SolvedStep | None:
        """Return a solution from the guesses, or by easing."""
        for guess in self.guesses():
            found = self.solve(control, guess)
            if self.solved(found):
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


class _Substeps(StepRecovery):
    """Recovery of a step of several stages by substeps of one stage, its last method."""

    def first_guesses(self, control: Any) -> list[Any]:
        """Return none: a whole step of one stage would be another scheme's."""
        return []

    def continue_load(self, before: Any, now: Any) -> None:
        """Return None, as for `first_guesses`."""

    def ease(self, control: Any) -> None:
        """Return None, as for `first_guesses`."""


def recovered_stages(
    system: System, settings: Settings, step: TimeStep, dt: float, budget: Budget, controls: tuple[Any, Any]
) -> SolvedStep:
    """Recover a step of several stages: each stage, or all of them by substeps of a multistep scheme."""
    shape = settings.stages, system.control_layout.size
    before, now = (np.broadcast_to(np.reshape(each, (-1, shape[1])), shape) for each in controls)
    last, past, found = before[-1], step.past, []
    for coefficients, t, own in zip(step.coefficients, step.t, now, strict=True):
        stage = _Stage(system, settings, TimeStep(past, coefficients, t), dt, budget)
        solved = stage.recover((last, own))
        if solved.row.result < 0:
            break
        found.append(solved.row)
        past, last = solved.state, own
    else:
        row = found[-1]._replace(
            error=max(each.error for each in found), corrections=sum(each.corrections for each in found),
            result=max(int(each.result) for each in found),
            stages=np.stack([each.records for each in found[:-1]]),
            stage_unknowns=np.stack([each.unknowns for each in found[:-1]]),
        )  # fmt: skip
        past = past._replace(time_error=np.full_like(past.time_error, np.nan))
        return SolvedStep(past, row)
    whole = TimeStep(step.past, BDF1().coefficients(dt), step.t[-1])
    solved = _Substeps(system, settings, whole, dt, budget).recover((before[-1], now[-1]))
    lost = solved.state._replace(time_error=np.full_like(solved.state.time_error, np.nan))
    row, count = solved.row, settings.stages - 1
    # between the ends of such a step no stages are known
    stages, unknowns = (np.repeat(each[None], count, axis=0) for each in (row.records, row.unknowns))
    return solved._replace(state=lost, row=row._replace(stages=stages, stage_unknowns=unknowns))


class _Stage(StepRecovery):
    """Recovery of one stage, which cannot be divided."""

    def last_method(self, controls: tuple[Any, Any]) -> None:
        """Return None: the whole step is divided instead."""


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
        past = repeated_record_history(system, settings, still.records, self._y, 0.0)
        natural = natural_time(system) or 0.1
        dt, longest = 0.1 * natural, 1e5 * natural
        for _ in range(80):
            step = TimeStep(past, BDF1().coefficients(dt), 0.0)
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
