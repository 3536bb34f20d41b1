"""Warnings about simulations without damping, and about time steps that do not resolve a motion."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import numpy as np

from knode_cosserat.rods.kept import kept
from knode_cosserat.rods.strands import strand_of
from knode_cosserat.rods.system import System, is_traced
from knode_cosserat.solvers.recovery import natural_time

#: period of a clamped rod's first vibration, 2π/3.516, in units of its natural time
SLOWEST = 1.79
#: loss factor of the suggested damping, typical of plastics
LOSS_FACTOR = 0.05


class UndampedWarning(UserWarning):
    """A robot without damping is simulated: its vibrations do not decay."""


class LongStepWarning(UserWarning):
    """Time steps are longer than a robot's slowest vibration: they do not show its motion."""


def _robots_of_users(robot: Any) -> Iterator[System]:
    """Yield the robots of a call that was not made by this package itself; its command line is a user."""
    caller = sys._getframe(3).f_globals.get("__name__", "")
    if caller.startswith("knode_cosserat.") and not caller.startswith("knode_cosserat.cli."):
        return
    for system in robot if isinstance(robot, Sequence) else [robot]:
        if isinstance(system, System) and not is_traced(system):
            yield system


def warn_of_long_steps(robot: Any, dt: float) -> None:
    """Warn if time steps are longer than a robot's slowest vibration. To be called by `simulate` itself."""
    for system in _robots_of_users(robot):
        with jax.core.eval_context():
            natural = natural_time(system)
        if natural is None or dt <= SLOWEST * natural:
            continue
        period = SLOWEST * natural
        warnings.warn(
            f"dt is {dt:g} s, longer than this robot's slowest vibration, of some {period:.2g} s: "
            f"rows are nearly equilibria and do not show how it moves. Use dt = {period / 20:.1g} s "
            "or less (is dt in seconds?), or `equilibria` if the motion does not matter.",
            LongStepWarning,
            stacklevel=3,
        )
        return


def warn_if_undamped(robot: Any, dt: float) -> None:
    """Warn if a robot, or one of a batch, is simulated without damping. To be called by `simulate` itself.

    Functions of this package that try parameters, such as an identification, call `simulate` without the
    warning; the command line calls it with the warning.
    """
    for system in _robots_of_users(robot):
        # the numbers of this robot are known, also inside a `jit` of the caller
        with jax.core.eval_context():
            vibration = _undamped_vibration(system)
        if vibration is None:
            continue
        frequency, stiffness = vibration
        damping = LOSS_FACTOR * stiffness / (2.0 * np.pi * frequency)
        warnings.warn(
            "bending_damping is 0 and nothing else damps the motion: vibrations do not decay, and "
            f"dt = {dt:g} s does not resolve the fast ones, so that the result depends on dt. "
            f"Set bending_damping, such as {damping:.1g} N m2 s "
            f"(a loss factor of {LOSS_FACTOR:g} at {frequency:.2g} Hz).",
            UndampedWarning,
            stacklevel=3,
        )
        return


@kept
def _undamped_vibration(system: System) -> tuple[float, float] | None:
    """Return frequency (Hz) and bending stiffness (N m²) of a robot without damping; None for any other."""
    strand = strand_of(system)
    if not getattr(strand, "is_undamped", False):
        return None
    bending = np.asarray(strand.Kbt)[..., :2, :2]
    stiffness = float(np.max(np.linalg.eigvalsh(bending)[..., 0]))
    return float(np.min(strand.bending_frequency)), stiffness
