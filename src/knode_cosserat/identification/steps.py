"""Time steps of simulations that are compared with recordings.

The parameters of a robot are those of its equations only if the error of the time scheme is small. Between
rows 12.5 ms apart, BDF2 changes the phase and the damping of a vibration of 5 Hz by more than any sensor's
noise. Where the tensions are samples of a continuous signal, simulations therefore take steps of 6.25 ms at
most, under tensions that are interpolated linearly, and by a scheme with little numerical damping. Rows with
held tensions, such as those of a simulated trajectory, are simulated from row to row like that trajectory.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.system import System
from knode_cosserat.rods.tendons import remove_delay
from knode_cosserat.schemes.space import SpaceScheme
from knode_cosserat.schemes.time import BDF2, LIGHTLY_DAMPED, TWO_STAGES, TimeScheme
from knode_cosserat.solvers.refinement import fix_grid
from knode_cosserat.solvers.simulate import simulate
from knode_cosserat.trajectory import Trajectory

#: longest time step between rows with continuous tensions (s), and most steps from row to row
LONGEST, MOST = 0.00625, 16


def is_resolved(dt: float, continuous: bool) -> bool:
    """Return True if rows `dt` (s) apart are close enough to follow vibrations between them.

    Rows farther apart, more than 0.1 s, are for slow or strongly damped robots. They are simulated from row
    to row by BDF2, which damps the vibrations that such rows cannot show.
    """
    return continuous and dt <= MOST * LONGEST * (1.0 + 1e-6)


def time_scheme(dt: float, continuous: bool) -> TimeScheme:
    """Return the time scheme for rows `dt` (s) apart with continuous or held tensions."""
    if not continuous:
        return TWO_STAGES
    return LIGHTLY_DAMPED if is_resolved(dt, continuous) else BDF2()


def steps_per_row(dt: float, continuous: bool) -> int:
    """Return the number of time steps from row to row."""
    return max(1, math.ceil(dt / LONGEST - 1e-6)) if is_resolved(dt, continuous) else 1


def stepped(
    tension: Float[np.ndarray, "T c"], initial: Float[np.ndarray, " c"], count: int, continuous: bool
) -> Float[np.ndarray, "steps c"]:
    """Return the tension at the end of every step, from those of the rows.

    Args:
        tension: held from each row to the next, or, if continuous, at the next row.
        initial: before the first row.
        count: steps from row to row.
        continuous: interpolate between rows.
    """
    if count == 1 or not continuous:
        return np.repeat(tension, count, axis=0)
    before = np.concatenate([np.asarray(initial)[None], tension[:-1]])
    parts = (np.arange(count) + 1.0) / count
    steps = before[:, None] + parts[:, None] * (tension - before)[:, None]
    return np.asarray(steps.reshape(-1, tension.shape[1]))


def simulated_rows(
    robot: System,
    tension: Float[np.ndarray, "T c"],
    dt: float,
    start: Trajectory | str | None,
    initial: Float[np.ndarray, " c"] | None,
    continuous: bool,
    space: str | SpaceScheme,
    recovery: float | None,
) -> Trajectory:
    """Return a motion in rows under the tensions (or motor angles) of a recording.

    Args:
        robot: any robot or model.
        tension: from each row to the next.
        dt: time from row to row (s).
        start: equilibrium from which it moves, or "unstressed"; None: that under zero control.
        initial: tension before the first row; None: the first tension.
        continuous: tensions vary continuously; `Measurements.continuous`.
        space: the scheme along the rod.
        recovery: seconds that recovery from failed steps may take; None: the usual budget.

    Raises:
        SimulationError: a step was not solved.
    """
    count = steps_per_row(dt, continuous)
    tension = stepped(tension, tension[0] if initial is None else initial, count, continuous)
    acting = remove_delay(robot, tension, dt / count, initial)
    motion = simulate(
        fix_grid(robot),
        acting,
        dt / count,
        time=time_scheme(dt, continuous),
        start="paper",
        space=space,
        initial="equilibrium" if start is None else start,  # type: ignore[arg-type]
        recovery_budget=recovery,
    )
    return motion[::count] if count > 1 else motion
