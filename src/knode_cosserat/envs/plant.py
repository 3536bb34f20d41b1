"""An episode as the plant of a closed loop."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from knode_cosserat.control import Plant
from knode_cosserat.envs.dynamics import EpisodeState
from knode_cosserat.envs.environment import Environment
from knode_cosserat.envs.errors import TaskError
from knode_cosserat.envs.spec import Ending, scaled


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
        action = scaled(self.environment.arrays, np.asarray(control))
        self.state, found = self.environment.step(self.state, np.clip(action, -1.0, 1.0))
        self.rewards.append(float(found.reward))
        self.ending, self._tip = Ending(int(found.ending)), np.asarray(found.tip)

    def tip(self) -> Float[np.ndarray, "3"]:
        """Return the true position of the tip (m)."""
        return self._tip
