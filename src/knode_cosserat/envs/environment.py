"""Environments: a robot, a task and a randomisation, as pure functions; and many episodes on all cores."""

from __future__ import annotations

import concurrent.futures
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat._files.yaml_text import did_you_mean
from knode_cosserat._reprs import robot_text
from knode_cosserat.control import ControlLimits, Reference
from knode_cosserat.controls import ControlsError, completed_limits
from knode_cosserat.engine.loops import motions_of
from knode_cosserat.engine.motions import Motions
from knode_cosserat.engine.pattern import Pattern, packed
from knode_cosserat.envs import dynamics
from knode_cosserat.envs.dynamics import Actions, Arrays, EpisodeState, Spec, Transition
from knode_cosserat.envs.tasks import TASKS, Randomisation, Task, TaskError
from knode_cosserat.estimation.outputs import BodyPositions
from knode_cosserat.rods.robot_file import load_robot
from knode_cosserat.rods.system import System
from knode_cosserat.schemes.settings import Settings
from knode_cosserat.solvers.guess import LARGEST_JUMP, largest_turns
from knode_cosserat.solvers.initial import start_of
from knode_cosserat.solvers.run import usable_cores
from knode_cosserat.solvers.simulate import checked_dt

#: robot of an environment by default
ROBOT = "delrin-tendon-robot"


class Environment:
    """A task for a robot, as pure functions on JAX.

        environment = kc.envs.make("follow")
        state, observation = environment.reset(jax.random.PRNGKey(0))
        state, transition = environment.step(state, action)

    `SingleEnv`, `VectorEnv` and `StableBaselinesEnv` wrap it for Gymnasium and Stable-Baselines3.
    """

    def __init__(
        self,
        task: Task,
        robot: System,
        randomisation: Randomisation | None = None,
        limits: ControlLimits | None = None,
        *,
        dt: float = 0.05,
        duration: float = 10.0,
        actions: Actions = "control",
        bodies: tuple[float, ...] = (0.5, 1.0),
        seed: int = 0,
    ):
        """Set up the environment; equilibria of the robot are computed for a survey of its reach.

        Args:
            task: the task.
            robot: the nominal robot, or a learned model of it.
            randomisation: of the episodes; None: the task's own.
            limits: of the controls; None: tensions of 0 to 10 N, or those of the robot's file, 40 N/s.
            dt: period (s).
            duration: time limit of an episode (s).
            actions: "control": actions of -1 to 1 are controls within their limits; "increment": changes of
                the control within its rate.
            bodies: places whose positions are observed, as fractions of the length; the last one is the tip.
            seed: of the survey.

        Raises:
            TaskError: settings that are not allowed, or a task that this robot cannot do.
            ParameterError: a randomised parameter that does not exist.
        """
        randomisation = task.randomisation() if randomisation is None else randomisation
        if not isinstance(randomisation, Randomisation):
            kind = type(randomisation).__name__
            raise TaskError(f"randomisation is {kind}; allowed is a Randomisation, or None")
        if not bodies or bodies[-1] != 1.0:
            raise TaskError(f"bodies is {bodies!r}; the last one must be 1.0, the tip")
        if np.ndim(robot.length):
            raise TaskError(
                "an environment has one robot, not a batch; use Randomisation(models=...) for several"
            )
        if actions not in ("control", "increment"):
            raise TaskError(f'actions is {actions!r}; allowed is "control" or "increment"')
        dt = checked_dt(dt)
        steps = round(duration / dt) if np.isfinite(duration) else 0
        if steps < 1:
            raise TaskError(f"duration is {duration!r} s; allowed is at least one period, {dt:g} s")
        controls = robot.control_layout
        if limits is None:
            try:
                limits = ControlLimits(**completed_limits(controls, dict.fromkeys(("low", "high", "rate"))))
            except ControlsError as error:
                raise TaskError(str(error)) from None
        try:
            within = limits.of(robot)
        except ValueError as error:
            raise TaskError(f"limits: {error}") from None
        turn = float(largest_turns(robot, np.minimum(within.rate * dt, within.high - within.low)))
        if turn > LARGEST_JUMP:
            raise TaskError(
                f"limits let a control turn an end by {turn:.3g} rad in one period of {dt:g} s; allowed is "
                f"up to {LARGEST_JUMP:.3g} rad. Give a lower rate, or a smaller dt"
            )
        if actions == "increment" and not np.all(np.isfinite(within.rate)):
            raise TaskError("increments need a finite rate of the limits")
        equipped = task.equipped(robot)
        if set(equipped.control_layout.names) != set(controls.names):
            raise TaskError(f"the task {task.name} adds controls to the robot; that is not allowed")
        models = [task.equipped(model) for model in randomisation.models]
        for model in models:
            if model.control_layout.size != equipped.control_layout.size:
                raise TaskError(
                    f"a model has {model.control_layout.size} controls, the robot "
                    f"{equipped.control_layout.size}; allowed are models of this robot"
                )
        if len({jax.tree.structure(model) for model in models}) > 1:
            raise TaskError("the models must be of one class, with the same nodes and options")
        stacked = None
        if models:
            stacked = jax.tree.map(lambda *leaves: jnp.stack(list(map(jnp.asarray, leaves))), *models)
        # the errors by the time scheme are not read
        settings = Settings(errors="grid")
        at_start = start_of(equipped, "equilibrium", settings, dt)
        self.task, self.robot, self.randomisation = task, robot, randomisation
        self.spec = Spec(
            task,
            dt,
            steps,
            actions,
            settings,
            BodyPositions(bodies),
            tuple(randomisation.parameters),
            float(randomisation.change),
            (randomisation.delay[0], randomisation.delay[1]),
            len(models),
        )
        self.arrays = Arrays(
            equipped,
            stacked,
            *randomisation.ends(equipped),
            within.low,
            within.high,
            within.rate,
            within.safe,
            float(randomisation.noise),
            task.survey(robot, within, seed),
            at_start.state.history,
            at_start.record,
        )

    @property
    def dt(self) -> float:
        """Period (s)."""
        return self.spec.dt

    @property
    def steps(self) -> int:
        """Periods of an episode."""
        return self.spec.steps

    @property
    def action_size(self) -> int:
        """Number of numbers in an action, each -1 to 1."""
        return len(self.arrays.low)

    @property
    def observation_size(self) -> int:
        """Number of numbers in an observation."""
        task, measured = self.task, dynamics.MEASURED * self.spec.output.size
        targets = len(dynamics.PREVIEW) * task.target_size
        return measured + self.action_size + targets + 3 + task.observed

    @property
    def limits(self) -> ControlLimits:
        """Limits of the controls."""
        arrays = self.arrays
        return ControlLimits(arrays.low, arrays.high, arrays.rate, arrays.start)

    # pure functions

    def reset(self, key: Any) -> tuple[EpisodeState, Float[Any, " o"]]:
        """Return the state and the observation at the start of an episode that a JAX key determines."""
        states, observations = self.reset_many(jnp.asarray(key)[None])
        return jax.tree.map(lambda leaf: leaf[0], states), observations[0]

    def reset_many(self, keys: Any) -> tuple[EpisodeState, Float[Any, "B o"]]:
        """Return the states and observations (B, o) at the starts of episodes, for keys (B, 2)."""
        start: tuple[EpisodeState, Any] = dynamics.reset_many(self.spec, self.arrays, keys)
        return start

    def step(self, state: EpisodeState, action: Float[Any, " c"]) -> tuple[EpisodeState, Transition]:
        """Return the state after one period under an action (c,), and the transition.

        An unsolved step truncates the episode with its reason in `ending`; the state is then the one before.
        """
        many = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], (state, action))
        after: tuple[EpisodeState, Transition] = jax.tree.map(lambda leaf: leaf[0], self.step_many(*many))
        return after

    def step_many(self, states: EpisodeState, actions: Float[Any, "B c"]) -> tuple[EpisodeState, Transition]:
        """Return the states of many episodes after one period under actions (B, c), and the transitions."""
        return dynamics.step_many(self.spec, self.arrays, states, actions)

    def system(self, state: EpisodeState) -> System:
        """Return the robot of an episode, with its drawn parameters and parts."""
        return dynamics.system_of(self.spec, self.arrays, state)

    def reference(self, state: EpisodeState) -> Reference:
        """Return the target of an episode as a reference of a controller."""
        return self.task.reference(state.goal, self.arrays.survey)

    def __repr__(self) -> str:
        controls = ", ".join(f"{field.name} [{field.unit}]" for field in self.robot.control_layout.fields)
        changes = "changes of " if self.spec.actions == "increment" else ""
        return (
            f"Environment {self.task.name!r} of a {robot_text(self.robot)}: {self.steps} periods of "
            f"{self.dt:g} s, actions ({self.action_size},) are {changes}{controls}, observations "
            f"({self.observation_size},)"
        )


def make(task: str | Task, robot: str | System = ROBOT, **settings: Any) -> Environment:
    """Return an environment.

    Args:
        task: "follow", "reach", "pillar", "gate", "payload", "adaptation", or a task object.
        robot: a robot or model, or the name or file of a robot.
        settings: arguments of `Environment`: randomisation, limits, dt, duration, actions, bodies, seed.

    Raises:
        TaskError: a task that does not exist, or settings that are not allowed.
    """
    if isinstance(task, str):
        if task not in TASKS:
            names = ", ".join(TASKS)
            raise TaskError(f"there is no task {task!r}; there are {names}{did_you_mean(task, TASKS)}")
        task = TASKS[task]()
    if not isinstance(task, Task):
        raise TaskError(f"task is {type(task).__name__}; allowed is a name ({', '.join(TASKS)}) or a Task")
    system = load_robot(robot) if isinstance(robot, str) else robot
    if not isinstance(system, System):
        raise TaskError(f"robot is {type(robot).__name__}; allowed is a robot, a model, a name or a file")
    return Environment(task, system, **settings)


# many episodes

#: number of episodes that one call resets: one program for any number
RESET_AT_ONCE = 8


class Episodes:
    """States of many episodes, in one part for each core."""

    def __init__(self, environment: Environment, count: int):
        if type(count) is not int or count < 1:
            raise TaskError(f"count is {count!r}; allowed is a whole number from 1")
        self.environment, self.count = environment, count
        parts = min(usable_cores(), count)
        # equal parts, the last one filled up: one shape, one program
        self._size = -(-count // parts)
        self._parts: list[Any] = [None] * -(-count // self._size)
        #: motions of each part, with the pattern of its robots
        self._motions: list[Any] = []
        self._pool = concurrent.futures.ThreadPoolExecutor(len(self._parts))

    def close(self) -> None:
        """End the threads."""
        self._pool.shutdown()

    def start(self, keys: np.ndarray) -> np.ndarray:
        """Start all episodes by keys (B, 2), and return their observations (B, o)."""
        started = [self.environment.reset_many(part) for part in self._filled(keys)]
        self._parts = [states._replace(history=None) for states, _ in started]
        self._motions = [self._motion(states.history) for states, _ in started]
        return self._joined([np.asarray(observations) for _, observations in started])

    def _motion(self, history: Any, systems: Any = None) -> tuple[Pattern, Motions]:
        """Return the motions of a part, and the pattern of its robots."""
        systems = self.environment.arrays.robot if systems is None else systems
        steps = dynamics.period(self.environment.spec).coefficients
        return Pattern.of(systems), motions_of(systems, steps, jax.tree.map(np.asarray, history))

    def restart(self, where: np.ndarray, keys: np.ndarray) -> np.ndarray:
        """Start new episodes at places (n,) by keys (n, 2), and return their observations (n, o)."""
        environment = self.environment
        observations = np.zeros((len(where), environment.observation_size), dtype=np.float32)
        for part in range(len(self._parts)):
            rows = np.flatnonzero(where // self._size == part)
            for first in range(0, len(rows), RESET_AT_ONCE):
                some = rows[first : first + RESET_AT_ONCE]
                places, padded = _pad_restarts(where[some] - part * self._size, keys[some], self._size)
                self._parts[part], seen, histories = dynamics.restart(
                    environment.spec, environment.arrays, self._parts[part], places, padded
                )
                observations[some] = np.asarray(seen)[: len(some)]
                self._motions[part][1].put(histories, places[: len(some)])
        return observations

    def step(self, actions: np.ndarray) -> dynamics.Transition:
        """Move all episodes on by one period under actions (B, c); return arrays with a leading axis."""
        filled = self._filled(actions)
        transitions = list(self._pool.map(lambda part: self._step(part, filled[part]), range(len(filled))))
        return jax.tree.map(lambda *parts: self._joined(parts), *transitions)

    def _step(self, part: int, actions: np.ndarray) -> Any:
        """Move the episodes of a part on; their histories stay in the engine's memory."""
        spec, arrays, before = self.environment.spec, self.environment.arrays, self._parts[part]
        systems, states, acting, valid = dynamics.apply_actions(spec, arrays, before, actions)
        pattern, motions = self._motions[part]
        if not spec.is_shared:
            if Pattern.of(systems) != pattern:
                self._motions[part] = _, motions = self._motion(motions.states, systems)
            motions.set_parameters(packed(systems))
        motions.set_times(np.asarray(before.count) * spec.dt)
        _, rows = motions.solve(np.asarray(acting), (0, 1))
        solution = rows.records[:, 0], rows.result[:, 0], valid
        self._parts[part], transitions = dynamics.finish_step(spec, arrays, systems, states, solution)
        return jax.tree.map(np.asarray, transitions)

    def warm_up(self) -> None:
        """Compile the programs of steps and restarts, so that none is compiled later."""
        self.start(np.zeros((self.count, 2), dtype=np.uint32))
        self.step(np.zeros((self.count, self.environment.action_size)))
        self.restart(np.zeros(1, dtype=int), np.zeros((1, 2), dtype=np.uint32))

    def _filled(self, rows: np.ndarray) -> np.ndarray:
        missing = len(self._parts) * self._size - self.count
        rows = np.concatenate([rows, np.repeat(rows[-1:], missing, axis=0)]) if missing else rows
        return rows.reshape(len(self._parts), self._size, *rows.shape[1:])

    def _joined(self, parts: Any) -> np.ndarray:
        return np.concatenate(parts)[: self.count]


def _pad_restarts(places: np.ndarray, keys: np.ndarray, beyond: int) -> tuple[np.ndarray, np.ndarray]:
    """Return places (n,) and keys (n, 2) of restarts, filled up with places beyond the end."""
    all_places = np.full(RESET_AT_ONCE, beyond)
    all_keys = np.zeros((RESET_AT_ONCE, 2), dtype=np.uint32)
    all_places[: len(places)], all_keys[: len(keys)] = places, keys
    return all_places, all_keys
