"""Gymnasium's classes: one episode at a time (`Env`), and many at once on all cores (`VectorEnv`)."""

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
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from knode_cosserat.envs.dynamics import Ending
from knode_cosserat.envs.environment import Environment, Episodes, make
from knode_cosserat.envs.tasks import TASKS, TaskError


def spaces(environment: Environment) -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Box]:
    """Return the spaces of observations and actions."""
    seen, moved = environment.observation_size, environment.action_size
    return (
        gymnasium.spaces.Box(-np.inf, np.inf, (seen,), np.float32),
        gymnasium.spaces.Box(-1.0, 1.0, (moved,), np.float32),
    )


def checked_action(action: Any, size: int) -> np.ndarray:
    """Return an action (c,) or (B, c) as numbers. Raises `TaskError` for a wrong shape or NaN."""
    try:
        numbers = np.asarray(action, dtype=float)
    except (TypeError, ValueError):
        text = str(action)[:60]
        raise TaskError(f"the action is {text}; allowed are {size} numbers from -1 to 1") from None
    is_finite = bool(np.all(np.isfinite(numbers)))
    if numbers.shape[-1:] != (size,) or not is_finite:
        problem = "" if is_finite else " and is not finite"
        raise TaskError(
            f"the action has shape {numbers.shape}{problem}; allowed are {size} finite numbers from -1 to 1"
        )
    return numbers


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
        self._state, after = self.environment.step(self._state, action)
        ending = Ending(int(after.ending))
        info: dict[str, Any] = {
            "error": float(after.error),
            "tip": np.asarray(after.tip),
            "control": np.asarray(after.control),
        }
        if ending is not Ending.RUNNING:
            info["ending"] = ending.message
        ends = bool(after.terminated), bool(after.truncated)
        return np.asarray(after.observation), float(after.reward), *ends, info

    def render(self) -> Any:
        """Return a picture (H, W, 3) of the robot and its target; None without a render mode."""
        if self.render_mode is None or self._state is None:
            return None
        from knode_cosserat.envs.pictures import picture

        return picture(self.environment, self._state)


def make_single(task: str, render_mode: str | None = None, **settings: Any) -> SingleEnv:
    """Return the environment of a task, for `gymnasium.make("knode_cosserat/Follow-v0")`."""
    return SingleEnv(make(task, **settings), render_mode)


def register() -> None:
    """Register an environment for each task in Gymnasium's registry; it needs the extra `rl`.

    An entry point of Gymnasium would do it at each `import gymnasium`, and import JAX with it.
    """
    for name in TASKS:
        gymnasium.register(
            id=f"knode_cosserat/{name.capitalize()}-v0",
            entry_point="knode_cosserat.envs.gymnasium_envs:make_single",
            kwargs={"task": name},
        )


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
        after = self._episodes.step(actions)
        terminated, truncated = np.array(after.terminated), np.array(after.truncated)
        reward = np.array(after.reward, dtype=np.float64)
        info: dict[str, Any] = {
            "error": after.error,
            "tip": after.tip,
            "control": after.control,
            "ending": np.array(after.ending),
        }
        restarted = np.flatnonzero(self._ended)
        self._seen = np.array(after.observation)
        if self.autoreset_mode is AutoresetMode.NEXT_STEP and len(restarted):
            self._restart(restarted)
            reward[restarted], terminated[restarted], truncated[restarted] = 0.0, False, False
            info["ending"][restarted] = Ending.RUNNING
        self._ended = terminated | truncated
        if self.autoreset_mode is AutoresetMode.SAME_STEP and np.any(self._ended):
            ended, last = self._ended.copy(), np.full(self.num_envs, None, dtype=object)
            for k in np.flatnonzero(ended):
                last[k] = self._seen[k].copy()
            info |= {"final_obs": last, "_final_obs": ended, "final_info": dict(info), "_final_info": ended}
            self._restart(np.flatnonzero(ended))
        return self._seen.copy(), reward, terminated, truncated, info

    def _restart(self, where: np.ndarray) -> None:
        if len(where):
            self._seen[where] = self._episodes.restart(where, self._keys(len(where)))
            self._ended[where] = False

    def _keys(self, count: int) -> np.ndarray:
        return self.np_random.integers(2**32, size=(count, 2), dtype=np.uint32)

    def close_extras(self, **kwargs: Any) -> None:
        """End the threads."""
        self._episodes.close()
