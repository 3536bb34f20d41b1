"""Policies of environments: their use as controllers, the comparison with controllers, and scores.

A policy is a function from observations (..., o) to actions (..., c), of any library.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat._arguments import check_arguments
from knode_cosserat.control import Command, Controller, Plant, Reference, controller_named, run_loop
from knode_cosserat.control.commands import CONTROLLERS
from knode_cosserat.control.planning import PlanController
from knode_cosserat.envs.dynamics import (
    MEASURED,
    Ending,
    EpisodeState,
    next_command,
    observation,
    scale_controls,
)
from knode_cosserat.envs.environment import Environment
from knode_cosserat.envs.tasks import TaskError
from knode_cosserat.estimation.outputs import TipPosition

Policy = Callable[[Any], Any]

#: standard deviation (m) of measured positions that a reference controller assumes, at least
LEAST_NOISE = 2e-4


class PolicyController(Controller):
    """A policy as a controller of a plant that measures the bodies which the environment observes."""

    def __init__(self, environment: Environment, policy: Policy, state: EpisodeState):
        """Take over a policy of an environment; `state` is the start of an episode, whose goal it pursues."""
        self.environment, self.policy, self.dt = environment, policy, environment.dt
        spec, arrays = environment.spec, environment.arrays
        self._observed = jax.jit(
            lambda measured, control, count: observation(
                spec, arrays, state._replace(measured=measured, commands=control[None], count=count)
            )
        )
        self._commanded = jax.jit(lambda control, action: next_command(spec, arrays, control, action))
        self.reset(np.asarray(arrays.start))

    def reset(self, control: Float[np.ndarray, " c"]) -> None:
        """Start from a control that acts now."""
        self._control = np.array(control, dtype=float)
        self._measured: Any = None

    def command(self, time: float, measured: Float[np.ndarray, " p"], reference: Reference) -> Command:
        """Return the control of the policy; `reference` is not used, the goal is the one of the start.

        A lost measurement (NaN) is replaced by the last one.
        """
        output = self.environment.spec.output
        if np.shape(measured) != (output.size,):
            raise TaskError(
                f"the plant measures {np.shape(measured)[0]} numbers; the policy needs {output.size}, the "
                f"positions at {output.fractions} of the length"
            )
        if self._measured is None:
            self._measured = np.tile(np.nan_to_num(measured), (MEASURED, 1))
        newest = np.where(np.isfinite(measured), measured, self._measured[0])
        self._measured = np.concatenate([newest[None], self._measured[:-1]])
        observation = self._observed(self._measured, self._control, round(time / self.dt))
        action = np.asarray(self.policy(np.asarray(observation)), dtype=float)
        self._control = np.asarray(self._commanded(self._control, action))
        return Command(self._control)


class _EpisodePlant(Plant):
    """An episode of an environment, moved by a controller; it measures the tip."""

    def __init__(self, environment: Environment, state: EpisodeState):
        """Take over the start of an episode.

        Raises:
            TaskError: an environment with increments as actions.
        """
        if environment.spec.actions != "control":
            raise TaskError('a controller commands no increments; use an environment with actions="control"')
        self.environment, self.dt, self._first = environment, environment.dt, state
        self.start()

    def start(self) -> Float[np.ndarray, " c"]:
        """Go to the start, and return the control that acts there."""
        self.state, self.ending = self._first, Ending.RUNNING
        self.rewards: list[float] = []
        self._tip = self.measure()
        return np.asarray(self.state.commands[0])

    def measure(self) -> Float[np.ndarray, "3"]:
        """Return the measured position of the tip (m)."""
        return np.asarray(self.state.measured[0, -3:])

    def apply(self, control: Float[np.ndarray, " c"]) -> None:
        """Move on by one period under a control; after the end of the episode nothing moves."""
        if self.ending is not Ending.RUNNING:
            return
        action = scale_controls(self.environment.arrays, np.asarray(control))
        self.state, after = self.environment.step(self.state, np.clip(action, -1.0, 1.0))
        self.rewards.append(float(after.reward))
        self.ending, self._tip = Ending(int(after.ending)), np.asarray(after.tip)

    def tip(self) -> Float[np.ndarray, "3"]:
        """Return the true position of the tip (m)."""
        return self._tip


def controller_scores(
    environment: Environment, keys: jax.Array | np.ndarray, name: str = "predictive"
) -> Float[np.ndarray, " n"]:
    """Return the mean reward of a controller in the episode of each key (n, 2).

    Its model has the middle of the randomised parameters and the obstacles; it knows the target, measures the
    tip, and adapts the parameters that the task names. An episode that ends early counts zero for the rest of
    its time.
    """
    check_arguments(controller_scores, locals())
    arrays, spec = environment.arrays, environment.spec
    middle = {key: 0.5 * (arrays.least[key] + arrays.greatest[key]) for key in spec.names}
    adapt = [key for key in spec.task.adapted if CONTROLLERS[name].has_observer and key in spec.names]
    measured = TipPosition(sigma=max(float(arrays.noise), LEAST_NOISE))
    scores = []
    for key in np.asarray(keys):
        state, _ = environment.reset(jnp.asarray(key))
        robot = spec.task.placed(arrays.robot.replace(**middle), state.goal)
        controller = controller_named(name, robot, spec.dt, environment.limits, adapt, measured)
        if isinstance(controller, PlanController):
            controller.observer.restart()
        plant = _EpisodePlant(environment, state)
        run_loop(controller, plant, environment.reference(state), environment.steps * environment.dt)
        scores.append(sum(plant.rewards) / environment.steps)
    return np.array(scores)


def policy_scores(
    environment: Environment, policy: Policy, keys: jax.Array | np.ndarray
) -> Float[np.ndarray, " n"]:
    """Return the mean reward of a policy in the episode of each key (n, 2), as in `controller_scores`."""
    check_arguments(policy_scores, locals())
    states, observations = environment.reset_many(jnp.asarray(keys))
    running, total = np.ones(len(keys), dtype=bool), np.zeros(len(keys))
    for _ in range(environment.steps):
        states, after = environment.step_many(states, policy(np.asarray(observations)))
        total += np.where(running, np.asarray(after.reward), 0.0)
        running &= ~np.asarray(after.terminated | after.truncated)
        observations = after.observation
    return total / environment.steps
