"""States of many episodes, moved on all cores."""

from __future__ import annotations

import concurrent.futures
from typing import Any

import jax
import numpy as np

from knode_cosserat.envs import dynamics, programs
from knode_cosserat.envs.environment import Environment
from knode_cosserat.envs.errors import TaskError
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
        parts = min(usable_cores(), count)
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
