"""Scores of controllers and policies: their mean rewards in episodes."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.control import CONTROLLERS, Controller, controller_named, run_loop
from knode_cosserat.control.planning import PlanController
from knode_cosserat.envs.dynamics import EpisodeState
from knode_cosserat.envs.environment import Environment
from knode_cosserat.envs.plant import EpisodePlant
from knode_cosserat.envs.policy import Policy
from knode_cosserat.estimation.outputs import TipPosition
from knode_cosserat.rods.system import System

#: standard deviation (m) of measured positions that a reference controller assumes, at least
LEAST_NOISE = 2e-4


def reference_controller(
    environment: Environment, state: EpisodeState, name: str = "predictive"
) -> Controller:
    """Return a controller whose model has the middle of all parameters, and the obstacles of an episode."""
    arrays, spec = environment.arrays, environment.spec
    middle = {name: 0.5 * (arrays.least[name] + arrays.greatest[name]) for name in spec.names}
    robot: System = spec.task.placed(arrays.robot.replace(**middle), state.goal)
    noise = max(float(arrays.noise), LEAST_NOISE)
    has_observer = CONTROLLERS[name].cls.has_observer
    adapt = [key for key in spec.task.adapted if has_observer and key in spec.names]
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
