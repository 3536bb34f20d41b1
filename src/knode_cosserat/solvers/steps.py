"""Steps of a run: their coefficients, and rows of their results."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from knode_cosserat.rods.system import System, is_traced, unknown_count
from knode_cosserat.solvers.history import (
    EXTRAPOLATIONS,
    GUESS_STATES,
    StateHistory,
    coefficient_table,
)
from knode_cosserat.solvers.problem import no_history
from knode_cosserat.solvers.result import Result
from knode_cosserat.solvers.settings import Settings
from knode_cosserat.solvers.space import LOBATTO2

#: a row is COARSE if its position error is above this part of the length, or its orientation error above this
#: angle (rad), which is the position error relative to the radius of curvature of a coil
COARSE_SHARE, COARSE_ANGLE = 0.02, 0.1
#: tolerance of a step's error estimate relative to its change, and largest number of corrections
ESTIMATE_TOLERANCE, ESTIMATE_TURNS = 1e-2, 10
#: misfits below this are rounding errors (natural units)
ROUNDING = 1e-12


class StepRows(NamedTuple):
    """The steps' results, one row a step; with a batch, one axis more in front.

    A row is that of the step's last stage; `stages` and `stage_unknowns` are those of the stages before it.
    """

    records: Float[Any, "steps nodes x"]
    unknowns: Float[Any, "steps k"]
    #: largest residual, natural units
    error: Float[Any, " steps"]
    corrections: Int[Any, " steps"]
    #: estimated discretisation error of positions (m), the largest over the nodes; NaN: no estimate
    position_error: Float[Any, " steps"]
    #: result codes (`result.Result`)
    result: Int[Any, " steps"]
    #: estimated error of positions (m) by the time scheme, the largest over the nodes; NaN: no estimate
    time_error: Float[Any, " steps"]
    stages: Float[Any, "steps stages nodes x"]
    stage_unknowns: Float[Any, "steps stages k"]

    @property
    def every_stage(self) -> tuple[Float[Any, "solves nodes x"], Float[Any, "solves k"]]:
        """Records and unknowns of all stages of all steps in turn, those of the rows among them."""
        pairs = (self.stages, self.records), (self.stage_unknowns, self.unknowns)
        numeric: Any = jnp if is_traced(self) else np
        joined = [numeric.concatenate([stages, last[:, None]], axis=1) for stages, last in pairs]
        records, unknowns = (part.reshape(-1, *part.shape[2:]) for part in joined)
        return records, unknowns


class StepCoefficients(NamedTuple):
    """Coefficients of a run's first steps and of all later ones, its time step (s), and the ends of stages.

    A scheme of several stages has coefficients (rows, stages, n) and as many ends, as parts of a step.
    """

    table: Float[Any, "rows n"]
    dt: Any
    ends: Any = 1.0

    @classmethod
    def of(cls, settings: Settings, dt: float, known: int = 1) -> StepCoefficients:
        """Return the coefficients of a run with steps of dt (s); `known` as in `coefficient_table`."""
        ends = np.array(settings.time.ends) if settings.time and settings.stages > 1 else 1.0
        return cls(coefficient_table(settings, dt, known), dt, ends)

    def at(self, t0: Any, i: Any) -> tuple[Any, Any]:
        """Return the coefficients of step i, and the times (s) at its end or at those of its stages."""
        numeric: Any = jnp if is_traced((self, i)) else np
        return self.table[numeric.minimum(i, len(self.table) - 1)], t0 + (i + self.ends) * self.dt


class TimeStep(NamedTuple):
    """A time step, without its control: the history before it, its coefficients, and the time at its end.

    With several stages, coefficients (stages, 4) and times (stages,).
    """

    past: StateHistory
    coefficients: Float[Any, "4"]
    t: Any

    @classmethod
    def of(cls, steps: StepCoefficients, past: StateHistory, i: Any) -> TimeStep:
        """Return step i of a run."""
        return cls(past, *steps.at(past.t0, i))


def stage_extrapolations(settings: Settings) -> Float[np.ndarray, "stages past past"]:
    """Return for each stage the constant, linear and quadratic extrapolations from the last three states."""
    assert settings.time is not None
    ends = np.array(settings.time.ends)
    times = np.concatenate([ends - 2.0, ends - 1.0, ends])
    found = np.zeros((len(ends), *EXTRAPOLATIONS.shape))
    for k in range(len(ends)):
        now = 2 * len(ends) + k
        for order in range(GUESS_STATES):
            nodes = times[now - 1 - order : now][::-1] - times[now]
            found[k, order, : order + 1] = np.linalg.solve(
                np.vander(nodes, increasing=True).T, np.eye(order + 1)[0]
            )
    return found


def no_rows(system: System, shape: tuple[int, ...], stages: int = 1) -> StepRows:
    """Return rows of steps that were not reached, (steps,) or (robots, steps)."""
    row, k = (system.nodes, no_history(system, LOBATTO2).shape[-1]), unknown_count(system)
    return StepRows(
        np.zeros((*shape, *row)), np.zeros((*shape, k)), np.zeros(shape), np.zeros(shape, dtype=int),
        np.zeros(shape), np.full(shape, int(Result.NOT_REACHED)), np.full(shape, np.nan),
        np.zeros((*shape, stages - 1, *row)), np.zeros((*shape, stages - 1, k)),
    )  # fmt: skip
