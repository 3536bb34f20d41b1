"""A policy as a controller of a plant, such as a stand-in for a real robot."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from knode_cosserat.control import Command, Controller, Reference, Status
from knode_cosserat.envs import dynamics
from knode_cosserat.envs.environment import Environment
from knode_cosserat.envs.errors import TaskError
from knode_cosserat.envs.policy import Policy
from knode_cosserat.envs.spec import MEASURED, commanded


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

        @jax.jit
        def following(arrays: Any, state: _Seen) -> Any:
            action = policy.action(dynamics.observed(environment.spec, arrays, state))
            return commanded(environment.spec, arrays, state.commands[0], action.astype(float))

        self._next = following
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
        self._control = np.asarray(self._next(self.environment.arrays, state))
        return Command(self._control, Status.OPTIMAL)

    def fallback(self, reason: str) -> Command:
        """Return the last control again."""
        return Command(self._control, Status.HELD, reason)
