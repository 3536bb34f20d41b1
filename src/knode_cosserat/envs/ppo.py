"""Proximal policy optimisation on JAX (Schulman et al. 2017, arXiv:1707.06347).

Episodes move on all cores while the networks wait; the networks are small, and learn between two rollouts.
"""

from __future__ import annotations

import dataclasses
import functools
import time as clock
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax  # type: ignore[import-untyped]
from jaxtyping import Float

from knode_cosserat.envs.environment import Environment
from knode_cosserat.envs.episodes import Episodes
from knode_cosserat.envs.errors import TaskError
from knode_cosserat.envs.policy import Layers, Policy, evaluated, network


@dataclasses.dataclass(frozen=True)
class PPOSettings:
    """Settings of the training.

    Attributes:
        episodes: episodes that move at once.
        rollout: periods between two updates.
        epochs: passes over a rollout in an update.
        batch: transitions in a step of the optimiser.
        rate: learning rate at the start; it falls to zero.
        discount: of later rewards, per period.
        trace: λ of the generalised advantage estimate.
        clip: largest change of a probability ratio that is rewarded.
        entropy: weight of the entropy of the actions.
        deviation: standard deviation of the actions at the start.
        hidden: widths of the hidden layers.
    """

    episodes: int = 128
    rollout: int = 32
    epochs: int = 6
    batch: int = 1024
    rate: float = 1e-3
    discount: float = 0.95
    trace: float = 0.95
    clip: float = 0.2
    entropy: float = 0.0
    deviation: float = 0.5
    hidden: tuple[int, ...] = (128, 128)

    def __post_init__(self) -> None:
        for name in ("episodes", "rollout", "epochs", "batch"):
            if getattr(self, name) < 1:
                raise TaskError(f"{name} is {getattr(self, name)!r}; allowed is a whole number from 1")
        if self.episodes * self.rollout < self.batch:
            raise TaskError(
                f"batch is {self.batch}; allowed is at most episodes × rollout, "
                f"{self.episodes * self.rollout}"
            )


class Progress(NamedTuple):
    """Progress of a training after an update."""

    #: periods of all episodes so far, and seconds since the start
    steps: int
    seconds: float
    #: mean reward of the last rollout, with exploration
    reward: float


class Weights(NamedTuple):
    """Optimised numbers: the networks, and the logarithm of the actions' deviation."""

    policy: Layers
    value: Layers
    log_deviation: Float[Any, " c"]


class _Batch(NamedTuple):
    """Transitions with normalised observations."""

    seen: Any
    action: Any
    log_probability: Any
    advantage: Any
    wanted: Any


class _Statistics:
    """Running mean and variance of the observations."""

    def __init__(self, size: int):
        self.count, self.mean, self.squares = 1e-4, np.zeros(size), np.zeros(size)

    def add(self, rows: np.ndarray) -> None:
        """Take rows (n, o) into account."""
        count, mean = len(rows), rows.mean(axis=0)
        apart, total = mean - self.mean, self.count + len(rows)
        self.squares += rows.var(axis=0) * count + apart**2 * self.count * count / total
        self.mean, self.count = self.mean + apart * count / total, total

    def policy(self, layers: Layers) -> Policy:
        """Return a policy with these statistics."""
        deviation = np.sqrt(self.squares / self.count + 1e-8)
        return Policy(layers, self.mean.astype(np.float32), deviation.astype(np.float32))


@jax.jit
def _acted(weights: Weights, policy: Policy, observation: Any, key: Any) -> Any:
    """Return normalised observations, actions, their log-probabilities, and values."""
    seen = policy.normalised(observation)
    mean, deviation = evaluated(weights.policy, seen), jnp.exp(weights.log_deviation)
    action = mean + deviation * jax.random.normal(key, mean.shape, dtype=jnp.float32)
    return seen, action, _log_probability(mean, weights.log_deviation, action), _value(weights, seen)


def _log_probability(mean: Any, log_deviation: Any, action: Any) -> Any:
    apart = (action - mean) / jnp.exp(log_deviation)
    return jnp.sum(-0.5 * apart**2 - log_deviation - 0.5 * np.log(2.0 * np.pi), axis=-1)


def _value(weights: Weights, seen: Any) -> Any:
    return evaluated(weights.value, seen)[..., 0]


@jax.jit
def _values(weights: Weights, policy: Policy, observation: Any) -> Any:
    return _value(weights, policy.normalised(observation))


def advantages(
    reward: Float[np.ndarray, "T B"], value: Float[np.ndarray, "T B"], following: Float[np.ndarray, "T B"],
    ended: np.ndarray, discount: float, trace: float,
) -> Float[np.ndarray, "T B"]:  # fmt: skip
    """Return generalised advantage estimates (Schulman et al. 2016, equation (16)).

    Args:
        reward: of each period.
        value: of the observations before each period.
        following: values after each period; those of the last observation where an episode was truncated,
            zero where it terminated.
        ended: (T, B) True where an episode ended with the period.
        discount: of later rewards.
        trace: λ.
    """
    found, later = np.zeros_like(reward), np.zeros(reward.shape[1])
    for t in range(len(reward) - 1, -1, -1):
        error = reward[t] + discount * following[t] - value[t]
        later = error + discount * trace * np.where(ended[t], 0.0, later)
        found[t] = later
    return found


def _loss(weights: Weights, batch: _Batch, clip: float, entropy: float) -> Any:
    mean = evaluated(weights.policy, batch.seen)
    ratio = jnp.exp(_log_probability(mean, weights.log_deviation, batch.action) - batch.log_probability)
    advantage = (batch.advantage - jnp.mean(batch.advantage)) / (jnp.std(batch.advantage) + 1e-8)
    bounded = jnp.clip(ratio, 1.0 - clip, 1.0 + clip)
    gain = jnp.mean(jnp.minimum(ratio * advantage, bounded * advantage))
    wrong = jnp.mean((_value(weights, batch.seen) - batch.wanted) ** 2)
    return -gain + 0.5 * wrong - entropy * jnp.sum(weights.log_deviation)


@functools.partial(jax.jit, static_argnames=("settings", "optimiser"))
def _updated(
    weights: Weights, state: Any, batch: _Batch, key: Any, settings: PPOSettings,
    optimiser: optax.GradientTransformation,
) -> Any:  # fmt: skip
    """Return the weights and the optimiser's state after all epochs over a rollout."""
    size = batch.advantage.shape[0]
    count = size // settings.batch

    def one(carry: Any, chosen: Any) -> Any:
        weights, state = carry
        some = jax.tree.map(lambda leaf: leaf[chosen], batch)
        slopes = jax.grad(_loss)(weights, some, settings.clip, settings.entropy)
        change, state = optimiser.update(slopes, state, weights)
        return (optax.apply_updates(weights, change), state), None

    keys = jax.random.split(key, settings.epochs)
    order = jax.vmap(lambda each: jax.random.permutation(each, size)[: count * settings.batch])(keys)
    rows = order.reshape(settings.epochs * count, settings.batch)
    (weights, state), _ = jax.lax.scan(one, (weights, state), rows)
    return weights, state


class Training:
    """Training of a policy by PPO; `policy` may be used at any time.

    training = kc.envs.Training(environment)
    training.run(seconds=600.0)
    training.policy.save("follow.npz")
    """

    def __init__(
        self, environment: Environment, settings: PPOSettings = PPOSettings(), *, steps: int = 3_000_000,
        seed: int = 0,
    ):  # fmt: skip
        """Set up the networks and the episodes; the same seed gives the same policy.

        Args:
            environment: the environment.
            settings: of the algorithm.
            steps: periods of all episodes together, after which the training is done.
            seed: of networks, episodes and actions.

        Raises:
            TaskError: fewer steps than one rollout.
        """
        per_update = settings.episodes * settings.rollout
        if steps < per_update:
            raise TaskError(f"steps is {steps}; allowed is at least one rollout, {per_update}")
        self.environment, self.settings = environment, settings
        self._updates = steps // per_update
        seen, moved = environment.observation_size, environment.action_size
        one, two, self._key = jax.random.split(jax.random.PRNGKey(seed), 3)
        sizes = (seen, *settings.hidden)
        self.weights = Weights(
            network(one, (*sizes, moved), 0.01), network(two, (*sizes, 1), 1.0),
            jnp.full(moved, np.log(settings.deviation), dtype=jnp.float32),
        )  # fmt: skip
        steps_of_optimiser = self._updates * settings.epochs * (per_update // settings.batch)
        self._optimiser = optax.chain(
            optax.clip_by_global_norm(0.5),
            optax.adam(optax.linear_schedule(settings.rate, 0.0, steps_of_optimiser)),
        )
        self._state = self._optimiser.init(self.weights)
        self._statistics = _Statistics(seen)
        self._random = np.random.default_rng(seed)
        self._episodes = Episodes(environment, settings.episodes)
        self._episodes.warm_up()
        self._observation = self._episodes.start(self._keys(settings.episodes))
        self._statistics.add(self._observation)
        #: progress after each update
        self.history: list[Progress] = []

    @property
    def policy(self) -> Policy:
        """The present policy, without exploration."""
        return self._statistics.policy(self.weights.policy)

    @property
    def is_done(self) -> bool:
        """True if all steps have been made."""
        return len(self.history) >= self._updates

    def run(
        self, seconds: float = np.inf, report: Callable[[Progress], None] | None = None
    ) -> list[Progress]:
        """Train until all steps are made, or for some seconds; return the progress after each update.

        Args:
            seconds: time after which no further update begins.
            report: called after each update.
        """
        began = clock.perf_counter() - (self.history[-1].seconds if self.history else 0.0)
        while not self.is_done and clock.perf_counter() - began < seconds:
            reward = self.update()
            steps = (len(self.history) + 1) * self.settings.episodes * self.settings.rollout
            self.history.append(Progress(steps, clock.perf_counter() - began, reward))
            if report is not None:
                report(self.history[-1])
        return self.history

    def update(self) -> float:
        """Make one rollout and learn from it; return its mean reward."""
        settings, policy = self.settings, self.policy
        rows = [self._period(policy) for _ in range(settings.rollout)]
        seen, action, log_probability, value, reward, following, ended, raw = (
            np.stack(each) for each in zip(*rows, strict=True)
        )
        advantage = advantages(reward, value, following, ended, settings.discount, settings.trace)

        def flat(array: np.ndarray) -> Any:
            return jnp.asarray(array.reshape(-1, *array.shape[2:]), dtype=jnp.float32)

        batch = _Batch(*map(flat, (seen, action, log_probability, advantage, advantage + value)))
        self._key, key = jax.random.split(self._key)
        self.weights, self._state = _updated(self.weights, self._state, batch, key, settings, self._optimiser)
        self._statistics.add(raw.reshape(-1, raw.shape[-1]))
        return float(np.mean(reward))

    def _period(self, policy: Policy) -> tuple[Any, ...]:
        """Move all episodes on by one period, and return its numbers."""
        raw = self._observation
        self._key, key = jax.random.split(self._key)
        seen, action, log_probability, value = (
            np.asarray(each) for each in _acted(self.weights, policy, raw, key)
        )
        found = self._episodes.step(action.astype(float))
        reward, observation = np.array(found.reward, dtype=float), np.array(found.observation)
        ended = np.asarray(found.terminated | found.truncated)
        # an episode that ran out of time would have gone on: its last observation has a value
        following = np.array(_values(self.weights, policy, observation), dtype=float)
        following = np.where(np.asarray(found.terminated), 0.0, following)
        where = np.flatnonzero(ended)
        if len(where):
            observation[where] = self._episodes.restart(where, self._keys(len(where)))
        self._observation = observation
        return seen, action, log_probability, value, reward, following, ended, raw

    def _keys(self, count: int) -> np.ndarray:
        return self._random.integers(2**32, size=(count, 2), dtype=np.uint32)
