"""Many episodes at once: Gymnasium's `VectorEnv`, on all cores."""

from __future__ import annotations

import concurrent.futures
from typing import Any

import gymnasium
import jax
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from knode_cosserat.envs import dynamics, programs
from knode_cosserat.envs.environment import Environment, checked_action
from knode_cosserat.envs.errors import TaskError
from knode_cosserat.envs.single import spaces
from knode_cosserat.envs.spec import Ending
from knode_cosserat.solvers.run import usable_cores

#: number of episodes that one call resets: one program for any number
RESET_AT_ONCE = 8


class Episodes:
    """States of many episodes, in one part for each core."""

    def __init__(self, environment: Environment, count: int):
        given: Any = count
        if not isinstance(given, int) or isinstance(given, bool) or count < 1:
            raise TaskError(f"count is {count!r}; allowed is a whole number from 1")
        self.environment, self.count = environment, count
        lockstep = jax.default_backend() != "cpu"
        parts = 1 if lockstep else min(usable_cores(), count)
        # equal parts, the last one filled up: one shape, one program
        self._size = -(-count // parts)
        self._parts: list[Any] = [None] * -(-count // self._size)
        self._pool = concurrent.futures.ThreadPoolExecutor(len(self._parts))

    def close(self) -> None:
        """End the threads."""
        self._pool.shutdown()

    def start(self, keys: np.ndarray) -> np.ndarray:
        """Start all episodes by keys (B, 2), and return their observations (B, o)."""
        filled = self._filled(keys)
        found = [self.environment.reset_many(part) for part in filled]
        self._parts = [states for states, _ in found]
        return self._joined([np.asarray(observations) for _, observations in found])

    def restart(self, where: np.ndarray, keys: np.ndarray) -> np.ndarray:
        """Start new episodes at places (n,) by keys (n, 2), and return their observations (n, o)."""
        every = np.zeros((len(where), self.environment.observation_size), dtype=np.float32)
        for part in range(len(self._parts)):
            own = np.flatnonzero(where // self._size == part)
            for first in range(0, len(own), RESET_AT_ONCE):
                some = own[first : first + RESET_AT_ONCE]
                places = np.full(RESET_AT_ONCE, self._size)
                places[: len(some)] = where[some] - part * self._size
                used = np.zeros((RESET_AT_ONCE, 2), dtype=np.uint32)
                used[: len(some)] = keys[some]
                self._parts[part], seen = programs.restart(
                    self.environment.spec, self.environment.arrays, self._parts[part], places, used
                )
                every[some] = np.asarray(seen)[: len(some)]
        return every

    def step(self, actions: np.ndarray) -> dynamics.Transition:
        """Move all episodes on by one period under actions (B, c); return arrays with a leading axis."""
        filled = self._filled(actions)
        spec, arrays = self.environment.spec, self.environment.arrays

        def work(part: int) -> Any:
            self._parts[part], found = programs.step(spec, arrays, self._parts[part], filled[part])
            return jax.tree.map(np.asarray, found)

        found = list(self._pool.map(work, range(len(self._parts))))
        return jax.tree.map(lambda *parts: self._joined(parts), *found)

    def warm_up(self) -> None:
        """Compile the programs of steps and restarts, so that none is compiled later."""
        environment = self.environment
        states, _ = environment.reset_many(np.zeros((self._size, 2), dtype=np.uint32))
        actions = np.zeros((self._size, environment.action_size))
        states, _ = programs.step(environment.spec, environment.arrays, states, actions)
        places = np.full(RESET_AT_ONCE, self._size)
        keys = np.zeros((RESET_AT_ONCE, 2), dtype=np.uint32)
        jax.block_until_ready(programs.restart(environment.spec, environment.arrays, states, places, keys))

    def goals(self) -> Any:
        """Return the goals of all episodes, with a leading axis."""
        return jax.tree.map(lambda *parts: self._joined(parts), *(part.goal for part in self._parts))

    def _filled(self, rows: np.ndarray) -> np.ndarray:
        missing = len(self._parts) * self._size - self.count
        rows = np.concatenate([rows, np.repeat(rows[-1:], missing, axis=0)]) if missing else rows
        return rows.reshape(len(self._parts), self._size, *rows.shape[1:])

    def _joined(self, parts: Any) -> np.ndarray:
        return np.concatenate(parts)[: self.count]


class VectorEnv(gymnasium.vector.VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """Many episodes of an environment as Gymnasium's `VectorEnv`.

    The information of a step has arrays of all episodes: the task's `error` (m), the `tip` (m), the `control`
    and the `ending` (an `Ending`).
    """

    def __init__(self, environment: Environment, count: int, autoreset: str = "next-step"):
        """Set up `count` episodes, and compile everything; `autoreset` as in `AutoresetMode`.

        Raises:
            TaskError: a number or a mode that is not allowed.
        """
        modes = {mode.name.lower().replace("_", "-"): mode for mode in AutoresetMode}
        if autoreset not in modes:
            raise TaskError(f"autoreset is {autoreset!r}; allowed is {', '.join(modes)}")
        self.environment, self.num_envs = environment, count
        self.autoreset_mode = modes[autoreset]
        self.metadata = {"autoreset_mode": self.autoreset_mode, "render_fps": round(1.0 / environment.dt)}
        self._episodes = Episodes(environment, count)
        self.single_observation_space, self.single_action_space = spaces(environment)
        self.observation_space = batch_space(self.single_observation_space, count)
        self.action_space = batch_space(self.single_action_space, count)
        self._ended = np.zeros(count, dtype=bool)
        self._started = False
        self._seen = np.zeros((count, environment.observation_size), dtype=np.float32)
        self._episodes.warm_up()

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start all episodes, or those of `options["reset_mask"]` (B,).

        One seed determines all of them, and all following ones.
        """
        if isinstance(seed, list):
            raise TaskError("seed is a list; allowed is one whole number for all episodes")
        super().reset(seed=seed)
        mask = None if options is None else options.get("reset_mask")
        if mask is None or not self._started:
            self._seen = self._episodes.start(self._keys(self.num_envs))
            self._ended[:], self._started = False, True
            return self._seen.copy(), {}
        mask = np.asarray(mask)
        if mask.shape != (self.num_envs,) or mask.dtype != bool:
            raise TaskError(f"reset_mask has shape {mask.shape}; allowed are {self.num_envs} booleans")
        self._restart(np.flatnonzero(mask))
        return self._seen.copy(), {}

    def step(self, actions: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Move all episodes on by one period under actions (B, c).

        Raises:
            TaskError: actions of a wrong shape or not finite, or a step of an episode that has ended.
        """
        if not self._started:
            raise gymnasium.error.ResetNeeded("call reset before step")
        actions = checked_action(actions, self.environment.action_size)
        if actions.shape != (self.num_envs, self.environment.action_size):
            raise TaskError(
                f"actions have shape {actions.shape}; allowed is "
                f"({self.num_envs}, {self.environment.action_size})"
            )
        if self.autoreset_mode is AutoresetMode.DISABLED and np.any(self._ended):
            raise TaskError(
                f"episode {int(np.argmax(self._ended))} has ended; call reset with a reset_mask first"
            )
        found = self._episodes.step(actions)
        terminated, truncated = np.array(found.terminated), np.array(found.truncated)
        reward = np.array(found.reward, dtype=np.float64)
        info: dict[str, Any] = {
            "error": found.error, "tip": found.tip, "control": found.control,
            "ending": np.array(found.ending),
        }  # fmt: skip
        restarted = np.flatnonzero(self._ended)
        self._seen = np.array(found.observation)
        if self.autoreset_mode is AutoresetMode.NEXT_STEP and len(restarted):
            self._restart(restarted)
            reward[restarted], terminated[restarted], truncated[restarted] = 0.0, False, False
            info["ending"][restarted] = Ending.RUNNING
        self._ended = terminated | truncated
        if self.autoreset_mode is AutoresetMode.SAME_STEP and np.any(self._ended):
            info = self._final(info)
            self._restart(np.flatnonzero(self._ended))
        return self._seen.copy(), reward, terminated, truncated, info

    def _final(self, info: dict[str, Any]) -> dict[str, Any]:
        """Return the information of a step with that of the episodes which ended in it."""
        ended = self._ended.copy()
        last = np.full(self.num_envs, None, dtype=object)
        for k in np.flatnonzero(ended):
            last[k] = self._seen[k].copy()
        names = {name: value for name, value in info.items() if not name.startswith("_")}
        return {**info, "final_obs": last, "_final_obs": ended, "final_info": names, "_final_info": ended}

    def _restart(self, where: np.ndarray) -> None:
        if len(where):
            self._seen[where] = self._episodes.restart(where, self._keys(len(where)))
            self._ended[where] = False

    def _keys(self, count: int) -> np.ndarray:
        return self.np_random.integers(2**32, size=(count, 2), dtype=np.uint32)

    def close_extras(self, **kwargs: Any) -> None:
        """End the threads."""
        self._episodes.close()
