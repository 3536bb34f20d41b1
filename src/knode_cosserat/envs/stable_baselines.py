"""Many episodes at once: the `VecEnv` of Stable-Baselines3."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

try:
    from stable_baselines3.common.vec_env import VecEnv
except ModuleNotFoundError as missing:
    raise ModuleNotFoundError(
        "this needs stable_baselines3: pip install 'knode-cosserat[sb3]'", name=missing.name
    ) from None

from knode_cosserat.envs.dynamics import Ending
from knode_cosserat.envs.environment import Environment
from knode_cosserat.envs.gymnasium_envs import VectorEnv, spaces


class StableBaselinesEnv(VecEnv):  # type: ignore[misc,unused-ignore]
    """Many episodes of an environment as a `VecEnv`: an episode that ends is restarted in the same step."""

    def __init__(self, environment: Environment, count: int):
        """Set up `count` episodes, and compile everything."""
        self._vector = VectorEnv(environment, count, "same-step")
        self.environment = environment
        self._actions: Any = None
        self._next_seed: int | None = None
        self.render_mode = None
        observations, actions = spaces(environment)
        super().__init__(count, observations, actions)

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Set the seed that the next reset uses for all episodes."""
        self._next_seed = seed
        return [seed] * self.num_envs

    def reset(self) -> np.ndarray:
        """Start all episodes, and return their observations (B, o)."""
        observations, _ = self._vector.reset(seed=self._next_seed)
        self._next_seed = None
        return observations

    def step_async(self, actions: np.ndarray) -> None:
        """Take the actions (B, c) of the next `step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Move all episodes on by one period; return observations, rewards, ends and information."""
        seen, reward, terminated, truncated, info = self._vector.step(self._actions)
        ended = terminated | truncated
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for k in np.flatnonzero(ended):
            infos[k] = {
                "terminal_observation": info["final_obs"][k],
                "TimeLimit.truncated": bool(truncated[k]),
                "ending": Ending(int(info["ending"][k])).message,
            }
        return seen, reward.astype(np.float32), ended, infos

    def close(self) -> None:
        """End the threads."""
        self._vector.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute, once for each episode."""
        return [getattr(self, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of all episodes."""
        setattr(self, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        """Call a method of the environment, and return its result once for each episode."""
        result = getattr(self.environment, method_name)(*args, **kwargs)
        return [result] * len(list(self._get_indices(indices)))

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        """Return False for each episode: there are no wrappers."""
        return [False] * len(list(self._get_indices(indices)))
