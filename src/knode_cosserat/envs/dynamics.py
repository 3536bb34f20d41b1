"""Pure functions of an environment: reset, and steps of many episodes at once.

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

from knode_cosserat.engine.pattern import Pattern
from knode_cosserat.envs.tasks import Survey, Task, Tip
from knode_cosserat.estimation.online import split_record
from knode_cosserat.estimation.outputs import BodyPositions
from knode_cosserat.rods.aspects import Drawing
from knode_cosserat.rods.system import System, is_traced
from knode_cosserat.rods.wrapped import nominal_model
from knode_cosserat.rotation import dot, rotation_matrix
from knode_cosserat.schemes.history import StateHistory
from knode_cosserat.schemes.result import Result
from knode_cosserat.schemes.settings import Settings
from knode_cosserat.solvers.rollout import rollout
from knode_cosserat.solvers.run import TimeIntegration

Actions = Literal["control", "increment"]

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
        return (
            "running",
            "the task ended",
            "time limit",
            "the step was not solved; the state is the one before it",
            "the grid is too coarse for this shape; use more nodes",
            "the action is not finite; the control was held",
        )[self]


@dataclasses.dataclass(frozen=True)
class Spec:
    """Settings that a compiled program depends on.

    Attributes:
        task: the task.
        dt: period (s).
        steps: periods of an episode.
        actions: "control": an action of -1 to 1 is a control within its limits; "increment": it is a change
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
    #: the nominal robot's equilibrium, in which episodes start
    history: StateHistory
    record: Any


def scale_controls(arrays: Arrays, control: Float[Any, "... c"]) -> Float[Any, "... c"]:
    """Return controls as numbers from -1 to 1 within their limits."""
    return 2.0 * (control - arrays.low) / (arrays.high - arrays.low) - 1.0


def next_command(
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


# episodes


class EpisodeState(NamedTuple):
    """State of an episode."""

    #: None where the engine keeps it
    history: Any
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


# an episode's robot


def system_of(spec: Spec, arrays: Arrays, state: EpisodeState) -> System:
    """Return the robot of an episode, at its present time."""
    drawn = jnp.where(state.count >= state.changes_at, state.drawn[1], state.drawn[0])
    return _assemble(spec, arrays, drawn, state.model, state.goal)


def _assemble(spec: Spec, arrays: Arrays, drawn: Any, model: Any, goal: Any) -> System:
    system: System = arrays.robot
    if spec.models:
        system = jax.tree.map(lambda leaf: leaf[model], arrays.models)
    values = {
        name: arrays.least[name] + drawn[k] * (arrays.greatest[name] - arrays.least[name])
        for k, name in enumerate(spec.names)
    }
    return spec.task.placed(system.replace(**values) if values else system, goal)


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


def _noisy(arrays: Arrays, key: Any, positions: Float[Any, " p"]) -> Float[Any, " p"]:
    """Return measurements of positions (m)."""
    return positions + arrays.noise * jax.random.normal(key, positions.shape)


def observation(spec: Spec, arrays: Arrays, state: Any) -> Float[Any, " o"]:
    """Return the observation: measured positions, the last command, the target now and later, the task's.

    Lengths are in lengths of the nominal robot from its tip at rest, and controls from -1 to 1.
    """
    length, origin = nominal_model(arrays.robot).length, arrays.survey.origin
    measured = (state.measured.reshape(MEASURED, -1, 3) - origin) / length
    control = scale_controls(arrays, state.commands[0])
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
    system = _assemble(spec, arrays, drawn[0], model, goal)
    measured = _noisy(arrays, noise_key, spec.output.value(system, *split_record(system, arrays.record)))
    state = EpisodeState(
        arrays.history,
        goal,
        drawn,
        changes_at,
        model,
        jnp.tile(arrays.start, (spec.delay[1] + 1, 1)),
        delay,
        jnp.tile(measured, (MEASURED, 1)),
        jnp.array(0),
        key,
    )
    return state, observation(spec, arrays, state)


# steps


def step_many(
    spec: Spec, arrays: Arrays, states: EpisodeState, actions: Float[Any, "B c"]
) -> tuple[EpisodeState, Transition]:
    """Return the states after one period of many episodes under actions (B, c), and their transitions."""
    history, others = states.history._replace(t0=states.count * spec.dt), states._replace(history=None)
    systems, others, acting, valid = apply_actions(spec, arrays, others, actions)
    if is_traced((arrays, states, actions)):
        task, axes = period(spec), (None if spec.is_shared else 0, 0, 0)
        solve = rollout(task, Pattern.of(systems))
        rows, history = jax.vmap(solve, in_axes=axes)(systems, acting, history)
    else:
        _, history, rows = period(spec).solve(systems, np.asarray(acting), history)
    others, transitions = finish_step(
        spec, arrays, systems, others, (rows.records[:, 0], rows.result[:, 0], valid)
    )
    return others._replace(history=history), transitions


def period(spec: Spec) -> TimeIntegration:
    """Return the one step of a period."""
    return TimeIntegration(spec.settings, spec.dt, 1, spec.settings.memory)


@functools.partial(jax.jit, static_argnames="spec")
def apply_actions(spec: Spec, arrays: Arrays, states: EpisodeState, actions: Float[Any, "B c"]) -> Any:
    """Return systems, states with the commands of actions, acting controls (B, 1, c), and valid actions."""

    def move(state: EpisodeState, action: Any) -> Any:
        before, action = state.commands[0], jnp.asarray(action, dtype=float)
        valid = jnp.all(jnp.isfinite(action))
        command = next_command(spec, arrays, before, jnp.where(valid, action, 0.0))
        commands = jnp.concatenate([jnp.where(valid, command, before)[None], state.commands[:-1]])
        state = state._replace(commands=commands)
        system = None if spec.is_shared else system_of(spec, arrays, state)
        return system, state, commands[state.delay][None], valid

    systems, *rest = jax.vmap(move)(states, actions)
    return arrays.robot if spec.is_shared else systems, *rest


@functools.partial(jax.jit, static_argnames="spec")
def finish_step(spec: Spec, arrays: Arrays, systems: Any, states: EpisodeState, solution: Any) -> Any:
    """Return the states after a solved step, and the transitions; states have no history here.

    `solution` has records and results of the rows, and True for valid actions. Without a solution, the state
    is the one before.
    """

    def arrive(system: System, state: EpisodeState, record: Any, result: Any, valid: Any) -> Any:
        solved, coarse = result >= 0, result == int(Result.COARSE)
        y, z = split_record(system, jnp.where(solved, record, 0.0))
        key, noise_key = jax.random.split(state.key)
        positions = _noisy(arrays, noise_key, spec.output.value(system, y, z))
        measured = jnp.concatenate(
            [jnp.where(solved, positions, state.measured[0])[None], state.measured[:-1]]
        )
        count = state.count + 1
        state = state._replace(measured=measured, count=count, key=key)
        tip = tip_of(system, y)
        tip = Tip(jnp.where(solved, tip.position, measured[0, -3:]), tip.tangent)
        clearance = jnp.where(solved, clearance_of(system, y), jnp.inf)
        t, length = count * spec.dt, nominal_model(arrays.robot).length
        error = spec.task.error(state.goal, t, tip)
        reward = spec.task.reward(error, clearance, length)
        usable = solved & ~coarse & valid
        terminated = spec.task.is_over(state.goal, t, tip) & usable
        ending = jnp.select(
            [~valid, ~solved, coarse, terminated, count >= spec.steps],
            [Ending.INVALID_ACTION, Ending.UNSOLVED, Ending.COARSE, Ending.TERMINATED, Ending.TIME_LIMIT],
            Ending.RUNNING,
        )
        truncated = (ending != Ending.RUNNING) & ~terminated
        transition = Transition(
            observation(spec, arrays, state),
            jnp.where(usable, reward, 0.0).astype(jnp.float32),
            terminated,
            truncated,
            ending,
            error,
            tip.position,
            clearance,
            state.commands[0],
        )
        return state, transition

    axes = (None if spec.is_shared else 0, *[0] * 4)
    return jax.vmap(arrive, in_axes=axes)(systems, states, *solution)


@functools.partial(jax.jit, static_argnames="spec")
def reset_many(spec: Any, arrays: Any, keys: Any) -> Any:
    """Return states and observations at the starts of episodes, for keys (B, 2)."""
    return jax.vmap(lambda key: reset(spec, arrays, key))(keys)


@functools.partial(jax.jit, static_argnames="spec", donate_argnames="states")
def restart(spec: Any, arrays: Any, states: Any, places: Any, keys: Any) -> Any:
    """Return states with new episodes at some places, their observations and histories."""
    fresh, observations = jax.vmap(lambda key: reset(spec, arrays, key))(keys)
    histories, fresh = fresh.history, fresh._replace(history=None)
    # places beyond the end are not written: they only fill up the number
    states = jax.tree.map(lambda leaf, new: leaf.at[places].set(new, mode="drop"), states, fresh)
    return states, observations, histories
