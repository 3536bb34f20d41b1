"""Pure functions of an environment: settings, reset, and steps of many episodes at once.

The motion is that of `simulate`. All but the solution of the steps is computed for all robots together.
"""

from __future__ import annotations

import dataclasses
import enum
import functools
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from knode_cosserat.control import ControlLimits
from knode_cosserat.engine.pattern import Pattern
from knode_cosserat.envs.tasks import Randomisation, Survey, Task, TaskError, Tip
from knode_cosserat.estimation.outputs import BodyPositions
from knode_cosserat.rods.aspects import Drawing, Ends
from knode_cosserat.rods.system import System, is_traced
from knode_cosserat.rods.wrapped import nominal_model
from knode_cosserat.rotation import dot, rotation_matrix
from knode_cosserat.solvers.history import StateHistory, StepRows, rest_record, resting_history
from knode_cosserat.solvers.initial import initial_state
from knode_cosserat.solvers.result import Result
from knode_cosserat.solvers.rollout import rollout
from knode_cosserat.solvers.run import TimeIntegration
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
    if limits is None:
        if set(robot.control_layout.names) != {"tension"}:
            names = ", ".join(f"{field.name} ({field.unit})" for field in robot.control_layout.fields)
            raise TaskError(f"limits are needed for the controls {names}: give kc.control.ControlLimits")
        limits = TENSIONS
    try:
        within = limits.of(robot)
    except ValueError as error:
        raise TaskError(f"limits: {error}") from None
    if actions == "increment" and not np.all(np.isfinite(within.rate)):
        raise TaskError("increments need a finite rate of the limits")
    equipped = task.equipped(robot)
    if set(equipped.control_layout.names) != set(robot.control_layout.names):
        raise TaskError(f"the task {task.name} adds controls to the robot; that is not allowed")
    least, greatest = randomisation.ends(equipped)
    settings = Settings()
    models = tuple(task.equipped(model) for model in randomisation.models)
    for model in models:
        if model.control_layout.size != equipped.control_layout.size:
            raise TaskError(
                f"a model has {model.control_layout.size} controls, the robot "
                f"{equipped.control_layout.size}; allowed are models of this robot"
            )
    if len({jax.tree.structure(model) for model in models}) > 1:
        raise TaskError("the models must be of one class, with the same nodes and options")
    stacked = (
        jax.tree.map(lambda *leaves: jnp.stack([jnp.asarray(leaf) for leaf in leaves]), *models)
        if models
        else None
    )
    spec = Spec(
        task, dt, steps, actions, settings, BodyPositions(bodies), tuple(randomisation.parameters),
        float(randomisation.change), (randomisation.delay[0], randomisation.delay[1]), len(models),
    )  # fmt: skip
    rest = None
    if Ends.of(equipped).rest_is_guess:
        at_start = initial_state(equipped, settings)
        rest = (at_start.state.history, at_start.record)
    arrays = Arrays(
        equipped, stacked, least, greatest, within.low, within.high, within.rate,
        within.safe, float(randomisation.noise), task.survey(robot, within, seed), rest,
    )  # fmt: skip
    return spec, arrays


# episodes


class EpisodeState(NamedTuple):
    """State of an episode."""

    history: StateHistory
    goal: Any
    #: places of the parameters in their ranges, 0 to 1, before and after the change; the period of the change
    drawn: Float[Any, "2 k"]
    changes_at: Int[Any, ""]
    model: Int[Any, ""]
    #: commands, the newest first
    commands: Float[Any, "d c"]
    delay: Int[Any, ""]
    #: measured positions (m), the newest first
    measured: Float[Any, "m p"]
    #: periods since the start
    count: Int[Any, ""]
    key: Any


class Transition(NamedTuple):
    """Result of a step."""

    observation: Float[Any, " o"]
    reward: Float[Any, ""]
    terminated: Bool[Any, ""]
    truncated: Bool[Any, ""]
    #: an `Ending`
    ending: Int[Any, ""]
    #: error of the task (m), and true position of the tip (m)
    error: Float[Any, ""]
    tip: Float[Any, "3"]
    #: least distance from obstacles (m); infinite without obstacles
    clearance: Float[Any, ""]
    #: control of this period
    control: Float[Any, " c"]


def observation_size(spec: Spec, arrays: Arrays) -> int:
    """Return the number of numbers in an observation."""
    per_target = len(PREVIEW) * spec.task.target_size
    return MEASURED * spec.output.size + len(arrays.low) + per_target + 3 + spec.task.observed


# an episode's robot


def system_of(spec: Spec, arrays: Arrays, state: EpisodeState) -> System:
    """Return the robot of an episode, at its present time."""
    drawn = jnp.where(state.count >= state.changes_at, state.drawn[1], state.drawn[0])
    return _assembled(spec, arrays, drawn, state.model, state.goal)


def _assembled(spec: Spec, arrays: Arrays, drawn: Any, model: Any, goal: Any) -> System:
    system: System = arrays.robot
    if spec.models:
        system = jax.tree.map(lambda leaf: leaf[model], arrays.models)
    if spec.names:
        system = system.replace(
            **{
                name: arrays.least[name] + drawn[k] * (arrays.greatest[name] - arrays.least[name])
                for k, name in enumerate(spec.names)
            }
        )
    return spec.task.placed(system, goal)


# measurements


def tip_of(system: System, y: Float[Any, "N y"]) -> Tip:
    """Return the pose of the tip; along z for a robot without orientations."""
    position = Drawing.of(system).positions(y[-1])
    if "h" not in system.y_layout.names:
        return Tip(position, jnp.array([0.0, 0.0, 1.0]))
    tangent = dot(rotation_matrix(Drawing.of(system).quaternions(y[-1])), jnp.array([0.0, 0.0, 1.0]))
    return Tip(position, tangent)


def clearance_of(system: System, y: Float[Any, "N y"]) -> Float[Any, ""]:
    """Return the least distance (m) of the nodes' surface from obstacles; infinite without obstacles."""
    obstacles = getattr(nominal_model(system), "surroundings", ())
    radius = getattr(nominal_model(system), "radius", 0.0)
    if not obstacles:
        return jnp.array(jnp.inf)
    points = Drawing.of(system).positions(y)
    distances = [jax.vmap(lambda p, wall=wall: wall.distance(p)[0])(points) for wall in obstacles]
    return jnp.min(jnp.stack(distances)) - radius


def _measured(spec: Spec, arrays: Arrays, key: Any, system: System, y: Any, z: Any) -> Any:
    value = spec.output.value(system, y, z)
    return value + arrays.noise * jax.random.normal(key, value.shape)


def observed(spec: Spec, arrays: Arrays, state: Any) -> Float[Any, " o"]:
    """Return the observation: measured positions, the last command, the target now and later, the task's.

    Lengths are in lengths of the nominal robot from its tip at rest, and controls from -1 to 1.
    """
    length, origin = nominal_model(arrays.robot).length, arrays.survey.origin
    bodies = state.measured.reshape(MEASURED, -1, 3)
    measured = (bodies - origin) / length
    control = scaled(arrays, state.commands[0])
    times = (state.count + np.asarray(PREVIEW)) * spec.dt
    targets = jax.vmap(lambda t: spec.task.target(state.goal, t))(times)
    places = (targets[:, :3] - origin) / length
    apart = places[0] - measured[0, -1]
    extra = spec.task.observation(state.goal, arrays.survey, length)
    parts = [measured.ravel(), control, places.ravel(), targets[:, 3:].ravel(), apart, extra]
    return jnp.concatenate(parts).astype(jnp.float32)


# reset


def reset(spec: Spec, arrays: Arrays, key: Any) -> tuple[EpisodeState, Float[Any, " o"]]:
    """Return the state and the observation at the start of an episode; the robot is at rest."""
    goal_key, drawn_key, change_key, other, noise_key, key = jax.random.split(key, 6)
    goal = spec.task.draw(goal_key, arrays.survey)
    drawn = jax.random.uniform(drawn_key, (2, len(spec.names)))
    when = jax.random.uniform(change_key, (2,))
    changes_at = jnp.where(when[0] < spec.change, 1 + (when[1] * spec.steps).astype(int), spec.steps + 1)
    one, two = jax.random.split(other)
    model = jax.random.randint(one, (), 0, max(spec.models, 1))
    delay = jax.random.randint(two, (), spec.delay[0], spec.delay[1] + 1)
    system = _assembled(spec, arrays, drawn[0], model, goal)
    if arrays.rest is None:
        history, record = resting_history(system, spec.settings), rest_record(system)
    else:
        history, record = arrays.rest
    ny = system.y_layout.size
    y, z = record[:, :ny], record[:, ny : ny + system.z_layout.size]
    measured = _measured(spec, arrays, noise_key, system, y, z)
    state = EpisodeState(
        history, goal, drawn, changes_at, model, jnp.tile(arrays.start, (spec.delay[1] + 1, 1)), delay,
        jnp.tile(measured, (MEASURED, 1)), jnp.array(0), key,
    )  # fmt: skip
    return state, observed(spec, arrays, state)


# steps


class Move(NamedTuple):
    """Command of a step, before it is solved."""

    system: Any
    state: EpisodeState
    acting: Float[Any, " c"]
    valid: Any


def _moved_one(spec: Spec, arrays: Arrays, state: EpisodeState, action: Any) -> Move:
    """Return the command of an action, and the acting control after its delay."""
    before, action = state.commands[0], jnp.asarray(action, dtype=float)
    valid = jnp.all(jnp.isfinite(action))
    command = commanded(spec, arrays, before, jnp.where(valid, action, 0.0))
    command = jnp.where(valid, command, before)
    commands = jnp.concatenate([command[None], state.commands[:-1]])
    history = state.history._replace(t0=jnp.asarray(state.count * spec.dt, dtype=float))
    state = state._replace(commands=commands, history=history)
    system = None if spec.is_shared else system_of(spec, arrays, state)
    return Move(system, state, commands[state.delay], valid)


def _arrived_one(
    spec: Spec, arrays: Arrays, move: Move, history: StateHistory, row: StepRows
) -> tuple[EpisodeState, Transition]:
    """Return the state after a solved step, and its outcome; without a solution the state before it."""
    state, system = move.state, arrays.robot if spec.is_shared else move.system
    solved, ny = row.result >= 0, system.y_layout.size
    coarse = row.result == int(Result.COARSE)
    record = jnp.where(solved, row.records, 0.0)
    y, z = record[:, :ny], record[:, ny : ny + system.z_layout.size]
    key, noise_key = jax.random.split(state.key)
    measured = jnp.where(solved, _measured(spec, arrays, noise_key, system, y, z), state.measured[0])
    count = state.count + 1
    state = state._replace(
        history=history, measured=jnp.concatenate([measured[None], state.measured[:-1]]), count=count,
        key=key,
    )  # fmt: skip
    tip = tip_of(system, y)
    tip = Tip(jnp.where(solved, tip.position, state.measured[0, -3:]), tip.tangent)
    clearance = jnp.where(solved, clearance_of(system, y), jnp.inf)
    t, length = count * spec.dt, nominal_model(arrays.robot).length
    reward, terminated, error = spec.task.outcome(state.goal, t, tip, clearance, length)
    usable = solved & ~coarse & move.valid
    terminated = terminated & usable
    ending = jnp.select(
        [~move.valid, ~solved, coarse, terminated, count >= spec.steps],
        [Ending.INVALID_ACTION, Ending.UNSOLVED, Ending.COARSE, Ending.TERMINATED, Ending.TIME_LIMIT],
        Ending.RUNNING,
    )
    truncated = (ending != Ending.RUNNING) & ~terminated
    transition = Transition(
        observed(spec, arrays, state), jnp.where(usable, reward, 0.0).astype(jnp.float32), terminated,
        truncated, ending, error, tip.position, clearance, state.commands[0],
    )  # fmt: skip
    return state, transition


# compiled programs of many episodes


@functools.partial(jax.jit, static_argnames="spec")
def reset_many(spec: Any, arrays: Any, keys: Any) -> Any:
    """Return states and observations at the starts of episodes, for keys (B, 2)."""
    return jax.vmap(lambda key: reset(spec, arrays, key))(keys)


def step_many(
    spec: Spec, arrays: Arrays, states: EpisodeState, actions: Float[Any, "B c"]
) -> tuple[EpisodeState, Transition]:
    """Return the states after one period of many episodes under actions (B, c), and their transitions."""
    traced = is_traced((arrays, states, actions))
    moves = (_moved if traced else _compiled_moved)(spec, arrays, states, actions)
    systems = arrays.robot if spec.is_shared else moves.system
    task, acting, histories = (
        TimeIntegration(spec.settings, spec.dt, 1, spec.settings.memory),
        moves.acting[:, None],
        moves.state.history,
    )
    if traced:
        solve = rollout(task, Pattern.of(systems))
        rows, histories = jax.vmap(solve, in_axes=(None if spec.is_shared else 0, 0, 0))(
            systems, acting, histories
        )
        return _arrived(spec, arrays, moves, histories, rows)
    _, histories, rows = task.solve(systems, np.asarray(acting), histories)
    arrived: tuple[EpisodeState, Transition] = _compiled_arrived(spec, arrays, moves, histories, rows)
    return arrived


def _moved(spec: Spec, arrays: Arrays, states: EpisodeState, actions: Float[Any, "B c"]) -> Move:
    """Return the commands of many episodes."""
    return jax.vmap(lambda state, action: _moved_one(spec, arrays, state, action))(states, actions)


def _arrived(
    spec: Spec, arrays: Arrays, moves: Move, histories: StateHistory, rows: StepRows
) -> tuple[EpisodeState, Transition]:
    """Return the states after a solved step of many episodes, with rows (B, 1, ...), and the transitions."""
    rows = jax.tree.map(lambda leaf: leaf[:, 0], rows)
    return jax.vmap(lambda *parts: _arrived_one(spec, arrays, *parts))(moves, histories, rows)


_compiled_moved = jax.jit(_moved, static_argnames="spec")
_compiled_arrived = jax.jit(_arrived, static_argnames="spec")


@functools.partial(jax.jit, static_argnames="spec", donate_argnames="states")
def restart(spec: Any, arrays: Any, states: Any, places: Any, keys: Any) -> Any:
    """Return states with new episodes at some places, and their observations."""
    fresh, observations = jax.vmap(lambda key: reset(spec, arrays, key))(keys)
    # places beyond the end are not written: they only fill up the number
    states = jax.tree.map(lambda leaf, new: leaf.at[places].set(new, mode="drop"), states, fresh)
    return states, observations
