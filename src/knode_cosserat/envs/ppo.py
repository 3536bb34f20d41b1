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

from knode_cosserat.envs.environment import Environment, Episodes
from knode_cosserat.envs.policy import Layers, Policy, evaluated, network
from knode_cosserat.envs.tasks import TaskError


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
        most = self.episodes * self.rollout
        if most < self.batch:
            raise TaskError(f"batch is {self.batch}; allowed is at most episodes × rollout, {most}")


class Progress(NamedTuple):
    """Progress of a training after an update."""

    #: periods of all episodes so far, and seconds since the start
    steps: int
    seconds: float
    #: mean reward of the last rollout, with exploration
    reward: float


class Networks(NamedTuple):
    """Optimised numbers: the networks, and the logarithm of the actions' deviation."""

    policy: Layers
    value: Layers
    log_deviation: Float[Any, " c"]

    def log_probability(self, mean: Any, action: Any) -> Any:
        """Return the logarithm of the probability density of an action, for its mean."""
        away = (action - mean) / jnp.exp(self.log_deviation)
        return jnp.sum(-0.5 * away**2 - self.log_deviation - 0.5 * np.log(2.0 * np.pi), axis=-1)


class _Batch(NamedTuple):
    """Transitions with normalised observations."""

    seen: Any
    action: Any
    log_probability: Any
    advantage: Any
    wanted: Any


@jax.jit
def _acted(networks: Networks, policy: Policy, observation: Any, key: Any) -> Any:
    """Return normalised observations, actions, their log-probabilities, and values."""
    seen = policy.normalised(observation)
    mean, deviation = evaluated(networks.policy, seen), jnp.exp(networks.log_deviation)
    action = mean + deviation * jax.random.normal(key, mean.shape, dtype=jnp.float32)
    return seen, action, networks.log_probability(mean, action), evaluated(networks.value, seen)[..., 0]


@jax.jit
def _values(networks: Networks, policy: Policy, observation: Any) -> Any:
    return evaluated(networks.value, policy.normalised(observation))[..., 0]


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
    rows, later = np.zeros_like(reward), np.zeros(reward.shape[1])
    for t in range(len(reward) - 1, -1, -1):
        error = reward[t] + discount * following[t] - value[t]
        later = error + discount * trace * np.where(ended[t], 0.0, later)
        rows[t] = later
    return rows


def _loss(networks: Networks, batch: _Batch, settings: PPOSettings) -> Any:
    mean = evaluated(networks.policy, batch.seen)
    ratio = jnp.exp(networks.log_probability(mean, batch.action) - batch.log_probability)
    advantage = (batch.advantage - jnp.mean(batch.advantage)) / (jnp.std(batch.advantage) + 1e-8)
    bounded = jnp.clip(ratio, 1.0 - settings.clip, 1.0 + settings.clip)
    gain = jnp.mean(jnp.minimum(ratio * advantage, bounded * advantage))
    error = jnp.mean((evaluated(networks.value, batch.seen)[..., 0] - batch.wanted) ** 2)
    return -gain + 0.5 * error - settings.entropy * jnp.sum(networks.log_deviation)


@functools.partial(jax.jit, static_argnames=("settings", "optimiser"))
def _updated(
    networks: Networks, state: Any, batch: _Batch, key: Any, settings: PPOSettings,
    optimiser: optax.GradientTransformation,
) -> Any:  # fmt: skip
    """Return the networks and the optimiser's state after all epochs over a rollout."""
    size = batch.advantage.shape[0]
    count = size // settings.batch

    def step(carry: Any, rows: Any) -> Any:
        networks, state = carry
        slopes = jax.grad(_loss)(networks, jax.tree.map(lambda leaf: leaf[rows], batch), settings)
        change, state = optimiser.update(slopes, state, networks)
        return (optax.apply_updates(networks, change), state), None

    keys = jax.random.split(key, settings.epochs)
    order = jax.vmap(lambda key: jax.random.permutation(key, size)[: count * settings.batch])(keys)
    rows = order.reshape(settings.epochs * count, settings.batch)
    return jax.lax.scan(step, (networks, state), rows)[0]


class PolicyTraining:
    """Training of a policy by PPO; `policy` may be used at any time.

    training = kc.envs.PolicyTraining(environment)
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
        size, actions = environment.observation_size, environment.action_size
        one, two, self._key = jax.random.split(jax.random.PRNGKey(seed), 3)
        sizes = (size, *settings.hidden)
        self.networks = Networks(
            network(one, (*sizes, actions), 0.01), network(two, (*sizes, 1), 1.0),
            jnp.full(actions, np.log(settings.deviation), dtype=jnp.float32),
        )  # fmt: skip
        steps_of_optimiser = self._updates * settings.epochs * (per_update // settings.batch)
        self._optimiser = optax.chain(
            optax.clip_by_global_norm(0.5),
            optax.adam(optax.linear_schedule(settings.rate, 0.0, steps_of_optimiser)),
        )
        self._state = self._optimiser.init(self.networks)
        #: number, mean and sum of squared deviations of the observations
        self._count, self._mean, self._squares = 1e-4, np.zeros(size), np.zeros(size)
        self._random = np.random.default_rng(seed)
        self._episodes = Episodes(environment, settings.episodes)
        self._episodes.warm_up()
        self._observation = self._episodes.start(self._keys(settings.episodes))
        self._count_in(self._observation)
        #: progress after each update
        self.history: list[Progress] = []

    @property
    def policy(self) -> Policy:
        """The present policy, without exploration."""
        deviation = np.sqrt(self._squares / self._count + 1e-8)
        return Policy(self.networks.policy, self._mean.astype(np.float32), deviation.astype(np.float32))

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
        seen, action, log_probability, value, reward, following, ended, raw = map(
            np.stack, zip(*rows, strict=True)
        )
        advantage = advantages(reward, value, following, ended, settings.discount, settings.trace)
        parts = (seen, action, log_probability, advantage, advantage + value)
        batch = _Batch(*(jnp.asarray(part.reshape(-1, *part.shape[2:]), dtype=jnp.float32) for part in parts))
        self._key, key = jax.random.split(self._key)
        self.networks, self._state = _updated(
            self.networks, self._state, batch, key, settings, self._optimiser
        )
        self._count_in(raw.reshape(-1, raw.shape[-1]))
        return float(np.mean(reward))

    def _period(self, policy: Policy) -> tuple[Any, ...]:
        """Move all episodes on by one period, and return its numbers."""
        raw = self._observation
        self._key, key = jax.random.split(self._key)
        acted = [np.asarray(part) for part in _acted(self.networks, policy, raw, key)]
        after = self._episodes.step(acted[1].astype(float))
        reward, observation = np.array(after.reward, dtype=float), np.array(after.observation)
        ended = np.asarray(after.terminated | after.truncated)
        # an episode that ran out of time would have gone on: its last observation has a value
        following = np.array(_values(self.networks, policy, observation), dtype=float)
        following = np.where(np.asarray(after.terminated), 0.0, following)
        places = np.flatnonzero(ended)
        if len(places):
            observation[places] = self._episodes.restart(places, self._keys(len(places)))
        self._observation = observation
        return *acted, reward, following, ended, raw

    def _count_in(self, rows: np.ndarray) -> None:
        """Take observations (n, o) into account in the mean and the deviation."""
        count, away = len(rows), rows.mean(axis=0) - self._mean
        total = self._count + count
        self._squares += rows.var(axis=0) * count + away**2 * self._count * count / total
        self._mean, self._count = self._mean + away * count / total, total

    def _keys(self, count: int) -> np.ndarray:
        return self._random.integers(2**32, size=(count, 2), dtype=np.uint32)
