"""An episode as the plant of a closed loop, and scores of controllers and policies."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.control.commands import Command, Controller, Status
from knode_cosserat.control.loop import run_loop
from knode_cosserat.control.named import WITH_OBSERVER, controller_named
from knode_cosserat.control.planning import PlanController
from knode_cosserat.control.plants import Plant
from knode_cosserat.control.references import Reference
from knode_cosserat.envs import dynamics
from knode_cosserat.envs.dynamics import EpisodeState
from knode_cosserat.envs.environment import Environment
from knode_cosserat.envs.errors import TaskError
from knode_cosserat.envs.policy import Policy
from knode_cosserat.envs.spec import MEASURED, Ending
from knode_cosserat.estimation.outputs import TipPosition
from knode_cosserat.rods.system import System

#: standard deviation (m) of measured positions that a reference controller assumes, at least
LEAST_NOISE = 2e-4


class EpisodePlant(Plant):
    """An episode of an environment, moved by a controller; it measures the tip."""

    def __init__(self, environment: Environment, state: EpisodeState):
        """Take over the start of an episode.

        Raises:
            TaskError: an environment with increments as actions.
        """
        if environment.spec.actions != "tension":
            raise TaskError('a controller commands tensions; use an environment with actions="tension"')
        self.environment, self.dt, self._first = environment, environment.dt, state
        self.start()

    def start(self) -> Float[np.ndarray, " c"]:
        """Go to the start, and return the control that acts there."""
        self.state, self.ending = self._first, Ending.RUNNING
        self.rewards: list[float] = []
        self._tip = np.asarray(self.state.measured[0, -3:])
        return np.asarray(self.state.commands[0])

    def measure(self) -> Float[np.ndarray, "3"]:
        """Return the measured position of the tip (m)."""
        return np.asarray(self.state.measured[0, -3:])

    def apply(self, control: Float[np.ndarray, " c"]) -> None:
        """Move on by one period under a control; after the end of the episode nothing moves."""
        if self.ending is not Ending.RUNNING:
            return
        arrays = self.environment.arrays
        action = 2.0 * (np.asarray(control) - arrays.low) / (arrays.high - arrays.low) - 1.0
        self.state, found = self.environment.step(self.state, np.clip(action, -1.0, 1.0))
        self.rewards.append(float(found.reward))
        self.ending, self._tip = Ending(int(found.ending)), np.asarray(found.tip)

    def tip(self) -> Float[np.ndarray, "3"]:
        """Return the true position of the tip (m)."""
        return self._tip


def reference_controller(
    environment: Environment, state: EpisodeState, name: str = "predictive"
) -> Controller:
    """Return a controller whose model has the middle of all parameters, and the obstacles of an episode."""
    arrays, spec = environment.arrays, environment.spec
    middle = {name: 0.5 * (arrays.least[name] + arrays.greatest[name]) for name in spec.names}
    robot: System = spec.task.placed(arrays.robot.replace(**middle), state.goal)
    noise = max(float(arrays.noise), LEAST_NOISE)
    adapt = [each for each in spec.task.adapted if name in WITH_OBSERVER and each in spec.names]
    return controller_named(name, robot, spec.dt, environment.limits, adapt, TipPosition(sigma=noise))


def controller_scores(
    environment: Environment, keys: Any, name: str = "predictive"
) -> Float[np.ndarray, " n"]:
    """Return the mean reward of a controller in the episode of each key (n, 2).

    It knows the middle of the parameters and the target, and measures the tip. It adapts the parameters that
    the task names. An episode that ends early counts zero for the rest of its time.
    """
    scores = []
    for key in np.asarray(keys):
        state, _ = environment.reset(jnp.asarray(key))
        controller = reference_controller(environment, state, name)
        if isinstance(controller, PlanController):
            controller.observer.restart()
        plant = EpisodePlant(environment, state)
        run_loop(controller, plant, environment.reference(state), environment.steps * environment.dt)
        scores.append(sum(plant.rewards) / environment.steps)
    return np.array(scores)


def policy_scores(environment: Environment, policy: Policy, keys: Any) -> Float[np.ndarray, " n"]:
    """Return the mean reward of a policy in the episode of each key (n, 2), as in `controller_scores`."""
    states, observations = environment.reset_many(jnp.asarray(keys))
    act = jax.jit(lambda observation: policy.action(observation))
    running, total = np.ones(len(keys), dtype=bool), np.zeros(len(keys))
    for _ in range(environment.steps):
        states, found = environment.step_many(states, act(observations))
        total += np.where(running, np.asarray(found.reward), 0.0)
        running &= ~np.asarray(found.terminated | found.truncated)
        observations = found.observation
    return total / environment.steps


class _Seen(NamedTuple):
    """Part of an episode's state that an observation depends on."""

    measured: Any
    commands: Any
    count: Any
    goal: Any


class PolicyController(Controller):
    """A policy as a controller of a plant that measures the bodies which the environment observes."""

    def __init__(self, environment: Environment, policy: Policy, goal: Any):
        """Take over a policy of an environment, and the goal that it is to reach or follow."""
        self.environment, self.policy, self.dt = environment, policy, environment.dt
        self._goal = goal
        self._act = jax.jit(lambda observation: policy.action(observation))
        self._observe = jax.jit(lambda arrays, state: dynamics.observed(environment.spec, arrays, state))
        self.reset(np.asarray(environment.arrays.start))

    def reset(self, control: Float[np.ndarray, " c"]) -> None:
        """Start from a control that acts now."""
        self._control = np.array(control, dtype=float)
        self._measured: Any = None

    def command(self, time: float, measured: Float[np.ndarray, " p"], reference: Reference) -> Command:
        """Return the control of the policy; `reference` is not used, the goal is the one of the start.

        A lost measurement (NaN) is replaced by the last one.
        """
        wanted = self.environment.spec.output.size
        if np.shape(measured) != (wanted,):
            raise TaskError(
                f"the plant measures {np.shape(measured)[0]} numbers; the policy needs {wanted}, the "
                f"positions at {self.environment.spec.output.fractions} of the length"
            )
        if self._measured is None:
            self._measured = np.tile(np.nan_to_num(measured), (MEASURED, 1))
        newest = np.where(np.isfinite(measured), measured, self._measured[0])
        self._measured = np.concatenate([newest[None], self._measured[:-1]])
        state = _Seen(self._measured, self._control[None], round(time / self.dt), self._goal)
        action = np.asarray(self._act(self._observe(self.environment.arrays, state)), dtype=float)
        return Command(self._within(action), Status.OPTIMAL)

    def _within(self, action: Float[np.ndarray, " c"]) -> Float[np.ndarray, " c"]:
        limits = self.environment.limits
        if self.environment.spec.actions == "increment":
            wanted = self._control + action * np.asarray(limits.rate) * self.dt
        else:
            wanted = limits.low + 0.5 * (action + 1.0) * (np.asarray(limits.high) - limits.low)
        self._control = limits.applied(wanted, self._control, self.dt)
        return self._control

    def fallback(self, reason: str) -> Command:
        """Return the last control again."""
        return Command(self._control, Status.HELD, reason)
