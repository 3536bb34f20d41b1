"""Warning about simulations without damping."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from knode_cosserat.rods.system import System, is_traced

#: loss factor of the suggested damping, typical of plastics
LOSS_FACTOR = 0.05


class UndampedWarning(UserWarning):
    """A robot without damping is simulated: its vibrations do not decay."""


def warn_if_undamped(robot: Any, dt: float) -> None:
    """Warn if a robot, or one of a batch, is simulated without damping. To be called by `simulate` itself.

    Functions of this package that try parameters, such as an identification, call `simulate` without the
    warning; the command line calls it with the warning.
    """
    caller = sys._getframe(2).f_globals.get("__name__", "")
    if caller.startswith("knode_cosserat.") and not caller.startswith("knode_cosserat.cli."):
        return
    for system in robot if isinstance(robot, Sequence) else [robot]:
        if not isinstance(system, System) or is_traced(system):
            continue
        # the numbers of this robot are known, also inside a `jit` of the caller
        with jax.ensure_compile_time_eval():
            strand = system.strand
            if not getattr(strand, "is_undamped", False):
                continue
            frequency = float(np.min(strand.bending_frequency))  # type: ignore[attr-defined]
            stiffness = float(np.max(np.asarray(strand.Kbt)[..., 0, 0]))  # type: ignore[attr-defined]
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
