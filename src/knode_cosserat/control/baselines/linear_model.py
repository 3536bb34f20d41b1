"""Linear model of a robot about an equilibrium, from impulse responses of its linearised equations.

The eigensystem realization algorithm (Juang & Pappa 1985) finds a state of low order. The impulse responses
are exact derivatives of a simulation.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from knode_cosserat.estimation.observer import KalmanObserver
from knode_cosserat.estimation.online import Belief, OnlineModel, Spread, errors_along
from knode_cosserat.estimation.outputs import Output
from knode_cosserat.rods.system import System
from knode_cosserat.solvers.equilibrium import equilibrium

#: steps of the impulse responses
STEPS = 80
#: singular values below this part of the largest one are left out, and the largest order
LEAST, ORDER = 1e-3, 16


class LinearModel(NamedTuple):
    """x⁺ = A x + B (u - u₀), y = y₀ + C x⁺: the output one period after a control."""

    A: Float[np.ndarray, "x x"]
    B: Float[np.ndarray, "x c"]
    C: Float[np.ndarray, "p x"]
    control: Float[np.ndarray, " c"]
    output: Float[np.ndarray, " p"]


def _impulses(model: OnlineModel, belief: Belief, control: Any, output: Output, steps: int) -> Any:
    """Return the output at rest (p,), and its responses (c, steps, p) to each control's first period."""
    count = len(control)
    pulses = np.zeros((count, steps, count))
    pulses[:, 0] = np.eye(count)
    system, found = model.rollout(belief, np.tile(control, (steps, 1)), pulses)
    zero = np.zeros((steps, output.size))
    values, slopes = errors_along(system, output, found.records, found.d_records, zero)
    return values[-1], slopes, found.solved


def linear_model(
    robot: System, dt: float, control: Float[np.ndarray, " c"], output: Output
) -> LinearModel:  # fmt: skip
    """Return the linear model of a robot about the equilibrium under a control.

    Raises:
        SimulationError: there is no such equilibrium.
    """
    count = len(control)
    own = KalmanObserver(robot, dt, output, initial=equilibrium(robot, control))
    past = own.belief.past
    used, size = own.belief.spread.rate.shape[1:]
    rows = np.zeros((count, 2, used, size))
    belief = Belief(np.zeros(0), past, Spread(rows, rows[:, 0], np.zeros((count, 0))))
    at_rest, responses, solved = _impulses(own.model, belief, np.asarray(control), output, STEPS)
    if not bool(solved):
        raise RuntimeError("the motion about the equilibrium was not solved")
    A, B, C = realized(np.moveaxis(np.asarray(responses), 0, -1))
    return LinearModel(A, B, C, np.asarray(control), np.asarray(at_rest))


def realized(
    responses: Float[np.ndarray, "T p c"], least: float = LEAST, most: int = ORDER
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return A, B, C with C Aᵏ B equal to the responses k = 0, 1, … as well as a state of low order can."""
    count, p, c = responses.shape
    half = range(count // 2)
    first, later = (np.block([[responses[i + j + shift] for j in half] for i in half]) for shift in (0, 1))
    U, s, Vt = np.linalg.svd(first, full_matrices=False)
    order = min(most, int(np.sum(s > least * s[0])))
    root = np.sqrt(s[:order])
    U, Vt = U[:, :order], Vt[:order]
    A = (U.T @ later @ Vt.T) / root[:, None] / root[None, :]
    return A, root[:, None] * Vt[:, :c], U[:p] * root
