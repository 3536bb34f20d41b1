"""Pure functions of an environment: reset, and steps of many episodes at once.

The motion is that of `simulate`. All but the solution of the steps is computed for all robots together.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from knode_cosserat.engine.pattern import Pattern
from knode_cosserat.envs.spec import MEASURED, PREVIEW, Arrays, Ending, Spec, commanded, scaled
from knode_cosserat.envs.tasks.base import Tip
from knode_cosserat.rods.system import System
from knode_cosserat.rotation import dot, rotation_matrix
from knode_cosserat.solvers.history import StateHistory, rest_record, resting_history
from knode_cosserat.solvers.result import Result
from knode_cosserat.solvers.rollout import rollout
from knode_cosserat.solvers.run import TimeIntegration
from knode_cosserat.solvers.steps import StepRows


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
    position = system.drawing.positions(y[-1])
    if "h" not in system.y_layout.names:
        return Tip(position, jnp.array([0.0, 0.0, 1.0]))
    tangent = dot(rotation_matrix(system.drawing.quaternions(y[-1])), jnp.array([0.0, 0.0, 1.0]))
    return Tip(position, tangent)


def clearance_of(system: System, y: Float[Any, "N y"]) -> Float[Any, ""]:
    """Return the least distance (m) of the nodes' surface from obstacles; infinite without obstacles."""
    obstacles = getattr(system.nominal, "surroundings", ())
    radius = getattr(system.nominal, "radius", 0.0)
    p = system.drawing.positions(y)
    every = [jax.vmap(lambda p, each=each: each.distance(p)[0])(p) for each in obstacles]
    return jnp.min(jnp.stack(every)) - radius if every else jnp.array(jnp.inf)


def _measured(spec: Spec, arrays: Arrays, key: Any, system: System, y: Any, z: Any) -> Any:
    value = spec.output.value(system, y, z)
    return value + arrays.noise * jax.random.normal(key, value.shape)


def observed(spec: Spec, arrays: Arrays, state: Any) -> Float[Any, " o"]:
    """Return the observation: measured positions, the last command, the target now and later, the task's.

    Lengths are in lengths of the nominal robot from its tip at rest, and controls from -1 to 1.
    """
    length, origin = arrays.robot.nominal.length, arrays.survey.origin
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


def _moved_by(spec: Spec, arrays: Arrays, state: EpisodeState, action: Any) -> Move:
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


def _arrived(
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
    t, length = count * spec.dt, arrays.robot.nominal.length
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


def step_many(
    spec: Spec, arrays: Arrays, states: EpisodeState, actions: Float[Any, "B c"]
) -> tuple[EpisodeState, Transition]:
    """Return the states after one period of many episodes, and their transitions, all with a leading axis."""
    moves = moved(spec, arrays, states, actions)
    systems = arrays.robot if spec.is_shared else moves.system
    acting, pasts = moves.acting[:, None], moves.state.history
    solve = rollout(task_of(spec), Pattern.of(systems))
    axes = None if spec.is_shared else 0, 0, 0
    rows, histories = jax.vmap(solve, in_axes=axes)(systems, acting, pasts)
    return arrived(spec, arrays, moves, histories, rows)


def task_of(spec: Spec) -> TimeIntegration:
    """Return the time integration of a period."""
    return TimeIntegration(spec.settings, spec.dt, 1, spec.settings.memory)


def moved(spec: Spec, arrays: Arrays, states: EpisodeState, actions: Float[Any, "B c"]) -> Move:
    """Return the commands of many episodes."""
    return jax.vmap(lambda state, action: _moved_by(spec, arrays, state, action))(states, actions)


def arrived(
    spec: Spec, arrays: Arrays, moves: Move, histories: StateHistory, rows: StepRows
) -> tuple[EpisodeState, Transition]:
    """Return the states after a solved step of many episodes, with rows (B, 1, ...), and the transitions."""
    rows = jax.tree.map(lambda leaf: leaf[:, 0], rows)
    return jax.vmap(lambda *each: _arrived(spec, arrays, *each))(moves, histories, rows)
