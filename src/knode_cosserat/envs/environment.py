"""Environments: a robot, a task and a randomisation, as pure functions and as Gymnasium's classes."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat._files.yaml_text import did_you_mean
from knode_cosserat._reprs import robot_text
from knode_cosserat.control import ControlLimits, Reference
from knode_cosserat.envs import dynamics, programs
from knode_cosserat.envs.dynamics import EpisodeState, Transition
from knode_cosserat.envs.errors import TaskError
from knode_cosserat.envs.randomisation import Randomisation
from knode_cosserat.envs.spec import Actions, specified
from knode_cosserat.envs.tasks import TASKS
from knode_cosserat.envs.tasks.base import Task
from knode_cosserat.rods.robot_file import load_robot
from knode_cosserat.rods.system import System

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
        self, task: Task, robot: System, randomisation: Randomisation | None = None,
        limits: ControlLimits | None = None, *, dt: float = 0.05, duration: float = 10.0,
        actions: Actions = "tension", bodies: tuple[float, ...] = (0.5, 1.0), seed: int = 0,
    ):  # fmt: skip
        """Set up the environment; equilibria of the robot are computed for a survey of its reach.

        Args:
            task: the task.
            robot: the nominal robot, or a learned model of it.
            randomisation: of the episodes; None: the task's own.
            limits: of the controls; None: tensions of 0 to 10 N, 40 N/s.
            dt: period (s).
            duration: time limit of an episode (s).
            actions: "tension": actions of -1 to 1 are controls within their limits; "increment": changes of
                the control within its rate.
            bodies: places whose positions are observed, as fractions of the length; the last one is the tip.
            seed: of the survey.

        Raises:
            TaskError: settings that are not allowed, or a task that this robot cannot do.
            ParameterError: a randomised parameter that does not exist.
        """
        chosen = task.randomisation() if randomisation is None else randomisation
        if not isinstance(chosen, Randomisation):
            raise TaskError(f"randomisation is {type(chosen).__name__}; allowed is a Randomisation, or None")
        if not bodies or bodies[-1] != 1.0:
            raise TaskError(f"bodies is {bodies!r}; the last one must be 1.0, the tip")
        self.task, self.robot, self.randomisation = task, robot, chosen
        self.spec, self.arrays = specified(
            robot, task, chosen, limits, dt=dt, duration=duration, actions=actions, bodies=bodies, seed=seed
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
        return dynamics.observation_size(self.spec, self.arrays)

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
        found: tuple[EpisodeState, Any] = programs.reset(self.spec, self.arrays, keys)
        return found

    def step(self, state: EpisodeState, action: Float[Any, " c"]) -> tuple[EpisodeState, Transition]:
        """Return the state after one period under an action (c,), and the transition.

        An unsolved step truncates the episode with its reason in `ending`; the state is then the one before.
        """
        many = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], (state, action))
        found: tuple[EpisodeState, Transition] = jax.tree.map(lambda leaf: leaf[0], self.step_many(*many))
        return found

    def step_many(self, states: EpisodeState, actions: Float[Any, "B c"]) -> tuple[EpisodeState, Transition]:
        """Return the states of many episodes after one period under actions (B, c), and the transitions."""
        found: tuple[EpisodeState, Transition] = programs.step(self.spec, self.arrays, states, actions)
        return found

    def system(self, state: EpisodeState) -> System:
        """Return the robot of an episode, with its drawn parameters and parts."""
        return dynamics.system_of(self.spec, self.arrays, state)

    def reference(self, state: EpisodeState) -> Reference:
        """Return the target of an episode as a reference of a controller."""
        return self.task.reference(state.goal, self.arrays.survey)

    def __repr__(self) -> str:
        return (
            f"Environment {self.task.name!r} of a {robot_text(self.robot)}: {self.steps} periods of "
            f"{self.dt:g} s, actions ({self.action_size},) are {self.spec.actions}s, observations "
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
            raise TaskError(
                f"there is no task {task!r}; there are {', '.join(TASKS)}{did_you_mean(task, TASKS)}"
            )
        task = TASKS[task]()
    if not isinstance(task, Task):
        raise TaskError(f"task is {type(task).__name__}; allowed is a name ({', '.join(TASKS)}) or a Task")
    system = load_robot(robot) if isinstance(robot, str) else robot
    if not isinstance(system, System):
        raise TaskError(f"robot is {type(robot).__name__}; allowed is a robot, a model, a name or a file")
    return Environment(task, system, **settings)


def checked_action(action: Any, size: int) -> np.ndarray:
    """Return an action (c,) or (B, c) as numbers. Raises `TaskError` for a wrong shape or NaN."""
    try:
        found = np.asarray(action, dtype=float)
    except (TypeError, ValueError):
        raise TaskError(
            f"the action is {str(action)[:60]}; allowed are {size} numbers from -1 to 1"
        ) from None
    finite = bool(np.all(np.isfinite(found)))
    if found.shape[-1:] != (size,) or not finite:
        raise TaskError(
            f"the action has shape {found.shape}{'' if finite else ' and is not finite'}; allowed are {size} "
            "finite numbers from -1 to 1"
        )
    return found
