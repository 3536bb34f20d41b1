"""One episode at a time: Gymnasium's `Env`."""

from __future__ import annotations

from typing import Any

try:
    import gymnasium
except ModuleNotFoundError as missing:
    raise ModuleNotFoundError(
        "this needs gymnasium: pip install 'knode-cosserat[rl]'", name=missing.name
    ) from None
import jax
import numpy as np

from knode_cosserat.envs.environment import Environment, checked_action, make
from knode_cosserat.envs.spec import Ending


def spaces(environment: Environment) -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Box]:
    """Return the spaces of observations and actions."""
    seen, moved = environment.observation_size, environment.action_size
    return (
        gymnasium.spaces.Box(-np.inf, np.inf, (seen,), np.float32),
        gymnasium.spaces.Box(-1.0, 1.0, (moved,), np.float32),
    )


class SingleEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """An environment as `gymnasium.Env`.

    The information of a step has the task's `error` (m), the `tip` (m), the `control`, and the `ending` in
    words once the episode has ended.
    """

    def __init__(self, environment: Environment, render_mode: str | None = None):
        """Take over an environment; `render_mode` is None or "rgb_array"."""
        self.environment = environment
        self.observation_space, self.action_space = spaces(environment)
        self.metadata = {"render_modes": ["rgb_array"], "render_fps": round(1.0 / environment.dt)}
        self.render_mode = render_mode
        self._state: Any = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode; a seed determines it and all following ones."""
        super().reset(seed=seed)
        key = jax.random.PRNGKey(int(self.np_random.integers(2**31)))
        self._state, observation = self.environment.reset(key)
        return np.asarray(observation), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Move on by one period under an action (c,).

        Raises:
            TaskError: an action of a wrong shape, or one that is not finite.
        """
        if self._state is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        action = checked_action(action, self.environment.action_size)
        self._state, found = self.environment.step(self._state, action)
        ending = Ending(int(found.ending))
        info = {
            "error": float(found.error),
            "tip": np.asarray(found.tip),
            "control": np.asarray(found.control),
        }
        if ending is not Ending.RUNNING:
            info["ending"] = ending.message
        return (
            np.asarray(found.observation), float(found.reward), bool(found.terminated),
            bool(found.truncated), info,
        )  # fmt: skip

    def render(self) -> Any:
        """Return a picture (H, W, 3) of the robot and its target; None without a render mode."""
        if self.render_mode is None or self._state is None:
            return None
        from knode_cosserat.envs.pictures import picture

        return picture(self.environment, self._state)


def made(task: str, render_mode: str | None = None, **settings: Any) -> SingleEnv:
    """Return the environment of a task, for `gymnasium.make("knode_cosserat/Follow-v0")`."""
    return SingleEnv(make(task, **settings), render_mode)
