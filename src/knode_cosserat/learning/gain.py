"""Gain of a fitted model: the error of its simulation beside that of the nominal model."""

from __future__ import annotations

import warnings
from typing import NamedTuple

import numpy as np

from knode_cosserat.rods.system import System
from knode_cosserat.solvers.settings import Settings
from knode_cosserat.solvers.simulate import simulate
from knode_cosserat.trajectory import Trajectory

#: gain below which a fit is reported as of little use
LITTLE = 0.2
#: errors below this are those of the solver
SOLVED = 1e-8


class RolloutErrors(NamedTuple):
    """Root mean square of y's errors in natural units, of simulations from a trajectory's first rows.

    Infinite if a step of the simulation is not solved.
    """

    nominal: float
    model: float

    @property
    def gain(self) -> float:
        """Part of the nominal model's error that the model removes; negative if its error is larger."""
        if np.isinf(self.model):
            return -np.inf
        return 1.0 if np.isinf(self.nominal) else 1.0 - self.model / max(self.nominal, SOLVED)


def rollout_errors(nominal: System, model: System, trajectory: Trajectory) -> RolloutErrors:
    """Return the errors of both simulations of a trajectory; warn of failures and of a small gain."""
    first = 1 if trajectory.time[0] == 0.0 else min(3, len(trajectory.time) - 1)
    settings = trajectory.settings or Settings()
    scale, errors = np.asarray(nominal.scales().y), []
    for system in (nominal, model):
        with warnings.catch_warnings():
            # the grid is that of the training data
            warnings.simplefilter("ignore")
            found = simulate(
                system, np.asarray(trajectory.control)[first:], trajectory.dt, time=settings.time or "bdf2",
                space=settings.space, start=settings.start, initial=trajectory[:first], on_failure="return",
            )  # fmt: skip
        apart = (np.asarray(found.y)[1:] - np.asarray(trajectory.y)[first:]) / scale
        errors.append(float(np.sqrt(np.mean(apart**2))) if found.all_valid else float("inf"))
    made = RolloutErrors(*errors)
    if np.isinf(made.model):
        warnings.warn(
            "the fitted model cannot be simulated over its first training trajectory: a step has no "
            "solution. Use another residual, more trajectories, or less noise",
            stacklevel=3,
        )
    elif made.gain < LITTLE:
        warnings.warn(
            "the fit gained little: over its first training trajectory the model's error is "
            f"{100.0 * (1.0 - made.gain):.3g} % of the nominal model's. Its residual may not have "
            "the missing effect, or the error is in the length, the base or the tip, which it leaves alone",
            stacklevel=3,
        )
    return made
