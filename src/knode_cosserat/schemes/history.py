"""History of a motion: the earlier states that a time step needs.

An implicit scheme in time needs y, z and y_s of earlier steps at all places where a step evaluates the
equations (`grid.Grid`). The history stores them there. The rows of a trajectory hold the nodes only; its
`final_state` holds the history after the last row.
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int

from knode_cosserat.rods.system import System, array_module, unknown_count
from knode_cosserat.schemes.grid import grid_of
from knode_cosserat.schemes.problem import no_history
from knode_cosserat.schemes.result import Result
from knode_cosserat.schemes.settings import Settings
from knode_cosserat.schemes.space import LOBATTO2, SpaceScheme
from knode_cosserat.schemes.time import BDF1, pad_coefficients

#: number of earlier states in the first guess of a step, and the extrapolations in time (constant, linear,
#: quadratic) of which the guess is the weighted mean
GUESS_STATES = 3
EXTRAPOLATIONS = np.array([[1.0, 0.0, 0.0], [2.0, -1.0, 0.0], [3.0, -3.0, 1.0]])


class StateHistory(NamedTuple):
    """The states before a step, newest first."""

    records: Float[Any, "memory places x"]
    rate: Float[Any, "places x"]
    #: for the first guess
    y: Float[Any, "past points y"]
    #: weight of each state in the first guess
    weights: Float[Any, " past"]
    #: time of row 0 (s): step i ends at t0 + (i + 1) dt
    t0: Float[Any, ""]
    #: estimated discretisation errors of the records and of the rate, at the places of the scheme
    error: Float[Any, "memory_and_rate used x"]
    #: estimated errors of the records by the time scheme, at these places; NaN: lost
    time_error: Float[Any, "memory used x"]


#: of a field that is no leaf of a tree
CONSTANT = {"static": True}


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class SolverState:
    """State of the solver at a row of a motion, from which the motion continues."""

    history: StateHistory
    #: time step (s) between the states of the history; None if all its states are the same one
    dt: float | None = dataclasses.field(default=None, metadata=CONSTANT)
    #: True if the history's rate is that of its newest state
    rate_known: bool = dataclasses.field(default=True, metadata=CONSTANT)
    #: number of different states in the history, if not all are
    distinct: int | None = dataclasses.field(default=None, metadata=CONSTANT)

    def known(self, settings: Settings) -> int:
        """Return the number of states from which the next step can be made; 0 if it lacks a rate."""
        if settings.uses_rate and not self.rate_known:
            return 0
        return 1 if self.dt is None else self.distinct or settings.memory

    def after(self, history: StateHistory, dt: float, steps: int, settings: Settings) -> SolverState:
        """Return the state after so many steps (s)."""
        distinct = self.known(settings) + steps
        return SolverState(history, dt, settings.uses_rate, distinct if distinct < settings.memory else None)


def coefficient_table(settings: Settings, dt: float, known: int = 1) -> np.ndarray:
    """Return the coefficients (rows, memory + 2) of the first steps and of all later ones.

    They are zeros for statics. With several stages they are (rows, stages, memory + 2). `known` are the
    states before the first step; see `SolverState.known`.
    """
    if settings.time is None:
        return np.zeros((1, settings.memory + 2))
    if settings.stages > 1:
        return np.array([settings.time.stages(dt)])
    missing = range(max(known, 1), settings.memory) if settings.start == "consistent" else range(0)
    schemes = [settings.time.starter(count) for count in missing]
    if not known:
        schemes = [BDF1(), *schemes[1:]]
    steps = [dt] * (settings.memory - 1)
    rows = [scheme.coefficients(dt, *steps) for scheme in (*schemes, settings.time)]
    return np.array([pad_coefficients(row, settings.memory) for row in rows])


def at_stages(system: System, settings: Settings, controls: Any, before: Any, sudden: bool) -> Any:
    """Return controls (…, T, c) or, if some change within a step, (…, T, stages * c) at all its stages.

    `before` (…, 1, c) precedes the first one. Displacements and rotations cannot jump, and are linear from
    row to row; all others only if `settings.between` says so. In a motion from one state, the first value of
    these is held: it begins suddenly.
    """
    moved = system.control_layout.moving
    linear = moved | (settings.between == "linear")
    if settings.time is None or settings.stages == 1 or not linear.any():
        return controls
    numeric = array_module((controls, before))
    first = controls[..., :1, :]
    earlier = numeric.where(moved | (not sudden), before, first), controls[..., :-1, :]
    earlier = numeric.where(linear, numeric.concatenate(earlier, axis=-2), controls)
    parts = [earlier + end * (controls - earlier) for end in settings.time.ends]
    return numeric.concatenate(parts, axis=-1)


def history_of(states: Any, rate: Any, coefficients: Any, settings: Settings) -> Any:
    """Return ʰ of y, z and y_s (paper eq. 3, lumped history terms).

    ʰ = c1 (newest) + c2 (second newest) + … + d1 (newest rate)
    """
    _, *weights, d1 = coefficients
    history = sum(c * state for c, state in zip(weights, states, strict=True))
    return history + d1 * rate if settings.uses_rate else history


def advance_history(past: StateHistory, records: Any, rate: Any, y: Any, weights: Any) -> StateHistory:
    """Return the history of the next step."""
    numeric = array_module((past, records, rate, y))
    records, y = numeric.stack([records, *past.records[:-1]]), numeric.concatenate([y[None], past.y[:-1]])
    return past._replace(records=records, rate=rate, y=y, weights=weights)


def repeated_record_history(
    system: System,
    settings: Settings,
    records: Float[Any, "... places x"],
    y: Float[Any, "... points y"],
    t0: Any,
) -> StateHistory:
    """Return a history in which all earlier states equal one state, or of a batch of robots."""
    used, memory = used_places(system, settings.space), settings.memory
    numeric = array_module((records, y, t0))
    robots, size = records.shape[:-2], records.shape[-1]
    weights, t0 = numeric.asarray(EXTRAPOLATIONS[0]), numeric.asarray(t0, dtype=float)
    return StateHistory(
        numeric.stack([records] * memory, axis=-3),
        numeric.zeros_like(records),
        numeric.stack([y] * GUESS_STATES, axis=-3),
        numeric.broadcast_to(weights, (*robots, *weights.shape)),
        numeric.broadcast_to(t0, robots),
        numeric.zeros((*robots, memory + 1, used, size)),
        numeric.zeros((*robots, memory, used, size)),
    )


def used_places(system: System, space: SpaceScheme) -> int:
    """Return the number of places that the scheme itself uses, without the extra stages of its check."""
    grid = grid_of(system, space)
    return grid.ends + len(space.formula.stages) * grid.tip


# the steps of a run, and their results

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
        numeric = array_module(self)
        joined = [numeric.concatenate([stages, last[:, None]], axis=1) for stages, last in pairs]
        records, unknowns = (part.reshape(-1, *part.shape[2:]) for part in joined)
        return records, unknowns


class StepCoefficients(NamedTuple):
    """Coefficients of a run's first steps and of all later ones, and all else that its steps share.

    A scheme of several stages has coefficients (rows, stages, n) and as many ends, as parts of a step.
    """

    settings: Settings
    table: Float[Any, "rows n"]
    #: time step (s)
    dt: Any
    ends: Any = 1.0
    #: subtracted from the residual of the tip's conditions
    tip_offset: Any = 0.0

    @classmethod
    def of(cls, settings: Settings, dt: float = 0.0, known: int = 1) -> StepCoefficients:
        """Return the coefficients of a run with steps of dt (s); `known` as in `coefficient_table`."""
        ends = np.array(settings.time.ends) if settings.time and settings.stages > 1 else 1.0
        return cls(settings, coefficient_table(settings, dt, known), dt, ends)

    def at(self, t0: Any, i: Any) -> tuple[Any, Any]:
        """Return the coefficients of step i, and the times (s) at its end or at those of its stages."""
        numeric = array_module((self, i))
        row = numeric.minimum(i, len(self.table) - 1)
        return numeric.asarray(self.table)[row], t0 + (i + self.ends) * self.dt


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
        np.zeros((*shape, *row)),
        np.zeros((*shape, k)),
        np.zeros(shape),
        np.zeros(shape, dtype=int),
        np.zeros(shape),
        np.full(shape, int(Result.NOT_REACHED)),
        np.full(shape, np.nan),
        np.zeros((*shape, stages - 1, *row)),
        np.zeros((*shape, stages - 1, k)),
    )
