"""Settings and arrays of an environment: hashable settings for compilation, and arrays that may change."""

from __future__ import annotations

import dataclasses
import enum
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.control import ControlLimits
from knode_cosserat.envs.errors import TaskError
from knode_cosserat.envs.randomisation import Randomisation
from knode_cosserat.envs.tasks.base import Task
from knode_cosserat.envs.tasks.survey import Survey
from knode_cosserat.estimation.outputs import BodyPositions
from knode_cosserat.rods.system import System
from knode_cosserat.solvers.history import StateHistory
from knode_cosserat.solvers.initial import initial_state
from knode_cosserat.solvers.settings import Settings
from knode_cosserat.solvers.simulate import checked_dt

Actions = Literal["tension", "increment"]

#: limits of tensions (N) and their rate (N/s) by default
TENSIONS = ControlLimits(0.0, 10.0, 40.0)
#: number of measurements in an observation, the newest first: their differences are velocities
MEASURED = 3
#: periods ahead at which an observation has the target
PREVIEW = (1, 3, 6)


class Ending(enum.IntEnum):
    """Reason why an episode ended; RUNNING if it did not."""

    RUNNING = 0
    TERMINATED = 1
    TIME_LIMIT = 2
    UNSOLVED = 3
    COARSE = 4
    INVALID_ACTION = 5

    @property
    def message(self) -> str:
        """The reason in words."""
        return {
            Ending.RUNNING: "running",
            Ending.TERMINATED: "the task ended",
            Ending.TIME_LIMIT: "time limit",
            Ending.UNSOLVED: "the step was not solved; the state is the one before it",
            Ending.COARSE: "the grid is too coarse for this shape; use more nodes",
            Ending.INVALID_ACTION: "the action is not finite; the control was held",
        }[self]


@dataclasses.dataclass(frozen=True)
class Spec:
    """Settings that a compiled program depends on.

    Attributes:
        task: the task.
        dt: period (s).
        steps: periods of an episode.
        actions: "tension": an action of -1 to 1 is a control within its limits; "increment": it is a change
            of control within its greatest rate.
        settings: of the solver.
        output: measured positions.
        names: randomised parameters.
        change: probability of a change of parameters within an episode.
        delay: least and greatest delay of commands (periods).
        models: number of models to choose from; 0: the robot only.
    """

    task: Task
    dt: float
    steps: int
    actions: Actions
    settings: Settings
    output: BodyPositions
    names: tuple[str, ...]
    change: float
    delay: tuple[int, int]
    models: int

    @property
    def is_shared(self) -> bool:
        """True if all episodes have the same robot."""
        return not (self.names or self.models or self.task.moves_parts)


class Arrays(NamedTuple):
    """Robot, ranges and limits of an environment."""

    robot: System
    #: models, stacked; None without
    models: Any
    #: ends of the randomised parameters, by name
    least: dict[str, Any]
    greatest: dict[str, Any]
    low: Float[Any, " c"]
    high: Float[Any, " c"]
    rate: Float[Any, " c"]
    start: Float[Any, " c"]
    #: standard deviation of measured positions (m)
    noise: Any
    survey: Survey
    #: history and record at the start; None: the robot's state at rest
    rest: tuple[StateHistory, Any] | None


def scaled(arrays: Arrays, control: Float[Any, "... c"]) -> Float[Any, "... c"]:
    """Return controls as numbers from -1 to 1 within their limits."""
    return 2.0 * (control - arrays.low) / (arrays.high - arrays.low) - 1.0


def commanded(
    spec: Spec, arrays: Arrays, before: Float[Any, " c"], action: Float[Any, " c"]
) -> Float[Any, " c"]:
    """Return the command of an action after another command, within limits and rate."""
    most, part = arrays.rate * spec.dt, jnp.clip(action, -1.0, 1.0)
    if spec.actions == "increment":
        wanted = before + part * most
    else:
        wanted = arrays.low + 0.5 * (part + 1.0) * (arrays.high - arrays.low)
        wanted = jnp.clip(wanted, before - most, before + most)
    return jnp.clip(wanted, arrays.low, arrays.high)


def checked_limits(robot: System, limits: ControlLimits | None) -> ControlLimits:
    """Return limits as arrays; those of tensions by default.

    Raises:
        TaskError: a robot without tensions needs limits.
    """
    if limits is None:
        if set(robot.control_layout.names) != {"tension"}:
            names = ", ".join(f"{field.name} ({field.unit})" for field in robot.control_layout.fields)
            raise TaskError(f"limits are needed for the controls {names}: give kc.control.ControlLimits")
        limits = TENSIONS
    try:
        return limits.of(robot)
    except ValueError as error:
        raise TaskError(f"limits: {error}") from None


def specified(
    robot: System, task: Task, randomisation: Randomisation, limits: ControlLimits | None, *, dt: float,
    duration: float, actions: Actions, bodies: tuple[float, ...], seed: int,
) -> tuple[Spec, Arrays]:  # fmt: skip
    """Return settings and arrays of an environment.

    Raises:
        TaskError: settings that are not allowed, or a task that this robot cannot do.
        ParameterError: a parameter that does not exist.
    """
    if np.ndim(robot.length):
        raise TaskError(
            "an environment has one robot, not a batch; use Randomisation(models=...) for several"
        )
    if actions not in ("tension", "increment"):
        raise TaskError(f'actions is {actions!r}; allowed is "tension" or "increment"')
    dt = checked_dt(dt)
    steps = round(duration / dt) if np.isfinite(duration) else 0
    if steps < 1:
        raise TaskError(f"duration is {duration!r} s; allowed is at least one period, {dt:g} s")
    within = checked_limits(robot, limits)
    if actions == "increment" and not np.all(np.isfinite(within.rate)):
        raise TaskError("increments need a finite rate of the limits")
    equipped = task.equipped(robot)
    if set(equipped.control_layout.names) != set(robot.control_layout.names):
        raise TaskError(f"the task {task.name} adds controls to the robot; that is not allowed")
    least, greatest = randomisation.ends(equipped)
    settings = Settings()
    models = tuple(task.equipped(model) for model in randomisation.models)
    spec = Spec(
        task, dt, steps, actions, settings, BodyPositions(bodies), tuple(randomisation.parameters),
        float(randomisation.change), (randomisation.delay[0], randomisation.delay[1]), len(models),
    )  # fmt: skip
    rest = None
    if equipped.rest_is_guess:
        at_start = initial_state(equipped, settings)
        rest = (at_start.state.history, at_start.record)
    arrays = Arrays(
        equipped, stacked_models(equipped, models), least, greatest, within.low, within.high, within.rate,
        within.safe, float(randomisation.noise), task.survey(robot, within, seed), rest,
    )  # fmt: skip
    return spec, arrays


def stacked_models(robot: System, models: tuple[System, ...]) -> Any:
    """Return the models as one pytree with a leading axis; None without models.

    Raises:
        TaskError: models of different structure, or other controls than the robot's.
    """
    if not models:
        return None
    for model in models:
        if model.control_size != robot.control_size:
            raise TaskError(
                f"a model has {model.control_size} controls, the robot {robot.control_size}; "
                "allowed are models of this robot"
            )
    if len({jax.tree.structure(model) for model in models}) > 1:
        raise TaskError("the models must be of one class, with the same nodes and options")
    return jax.tree.map(lambda *leaves: jnp.stack([jnp.asarray(leaf) for leaf in leaves]), *models)
