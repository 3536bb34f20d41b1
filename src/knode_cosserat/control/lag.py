"""Lag of motors: its identification, and the controls that act under a plan of commands."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

#: longest time constant that is looked for (s)
LONGEST = 2.0


def remaining_part(lag: float, dt: float) -> float:
    """Return the part of the distance from a command that is left after a time `dt` (s)."""
    return float(np.exp(-dt / lag)) if lag > 0.0 else 0.0


def mean_part(lag: float, dt: float) -> float:
    """Return the part of the distance from a command that is left on average over a time `dt` (s).

    A step of a motion holds its controls: those of motors that lag count by their mean.
    """
    return lag / dt * (1.0 - remaining_part(lag, dt)) if lag > 0.0 else 0.0


def lagged(
    commanded: Float[np.ndarray, "T c"], dt: float, lag: float, initial: Float[np.ndarray, " c"]
) -> Float[np.ndarray, "T c"]:
    """Return the controls at the end of each row of commands, after a first-order lag.

    Args:
        commanded: held from row to row.
        dt: time from row to row (s).
        lag: time constant (s); 0: none.
        initial: controls before the first row.
    """
    found, acting, remaining = [], np.asarray(initial, dtype=float), remaining_part(lag, dt)
    for command in commanded:
        acting = command + (acting - command) * remaining
        found.append(acting)
    return np.array(found)


def lag_weights(basis: Float[np.ndarray, "T knots"], lag: float, dt: float) -> Float[np.ndarray, "T more"]:
    """Return the weights of a plan's knots, and of the controls before it, in the mean controls of periods.

    Args:
        basis: weights of the knots in the commands of the horizon.
        lag: time constant (s).
        dt: period (s).
    """
    before = np.zeros(basis.shape[1] + 1)
    before[-1] = 1.0
    commands = np.concatenate([basis, np.zeros((len(basis), 1))], axis=1)
    starts = np.concatenate([before[None], lagged(commands, dt, lag, before)[:-1]])
    return commands + (starts - commands) * mean_part(lag, dt)


def identified_lag(
    commanded: Float[np.ndarray, "T c"], measured: Float[np.ndarray, "T c"], dt: float,
    initial: Float[np.ndarray, " c"],
) -> float:  # fmt: skip
    """Return the time constant (s) of the motors, by least squares of the measured tensions.

    Args:
        commanded: tensions, held from row to row.
        measured: tensions at the end of each row; NaN: not measured.
        dt: time from row to row (s).
        initial: tensions before the first row.
    """
    from scipy.optimize import minimize_scalar

    def cost(lag: float) -> float:
        return float(np.nansum((lagged(commanded, dt, lag, initial) - measured) ** 2))

    return float(minimize_scalar(cost, bounds=(0.0, LONGEST), method="bounded", options={"xatol": 1e-5}).x)
