"""Proximal policy optimisation on JAX (Schulman et al. 2017, arXiv:1707.06347) of an `Environment`.

Episodes move on all cores while the networks wait; the networks are small, and learn between two rollouts.

    training = PolicyTraining(kc.envs.make("follow"))
    training.run(seconds=600.0)
    training.policy.save("follow.npz")
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import time as clock
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax  # type: ignore[import-untyped]
from jaxtyping import Float

from knode_cosserat._files.arrays import read_arrays
from knode_cosserat.envs.environment import Environment, Episodes

#: normalised observations are clipped here
CLIP = 10.0
#: largest file of a policy (bytes)
LARGEST_FILE = 50_000_000

Layers = tuple[tuple[Float[Any, "i o"], Float[Any, " o"]], ...]


def network(key: Any, sizes: tuple[int, ...], gain: float) -> Layers:
    """Return random layers with orthogonal weights, those of the last layer times `gain`."""
    layers = []
    for k, (inputs, outputs) in enumerate(itertools.pairwise(sizes)):
        key, layer_key = jax.random.split(key)
        scale = gain if k == len(sizes) - 2 else np.sqrt(2.0)
        weights = jax.nn.initializers.orthogonal(scale)(layer_key, (inputs, outputs), jnp.float32)
        layers.append((weights, jnp.zeros(outputs, dtype=jnp.float32)))
    return tuple(layers)


def evaluated(layers: Layers, x: Float[Any, "... i"]) -> Float[Any, "... o"]:
    """Return the output of a network with tanh between its layers."""
    for weights, bias in layers[:-1]:
        x = jnp.tanh(x @ weights + bias)
    weights, bias = layers[-1]
    return x @ weights + bias


class Policy(eqx.Module):
    """A deterministic policy: the mean action of a network of normalised observations."""

    layers: Layers
    #: mean and standard deviation of the observations in training
    mean: Float[Any, " o"]
    deviation: Float[Any, " o"]

    def normalised(self, observation: Float[Any, "... o"]) -> Float[Any, "... o"]:
        """Return an observation in standard deviations from its mean."""
        return jnp.clip((observation - self.mean) / self.deviation, -CLIP, CLIP)

    def __call__(self, observation: Float[Any, "... o"]) -> Float[Any, "... c"]:
        """Return the action, -1 to 1."""
        return _action(self, observation)

    def save(self, path: str | Path) -> None:
        """Write the policy to a file (.npz), which holds arrays only."""
        leaves = enumerate(jax.tree.leaves(self.layers))
        layers = {f"layer{k}": np.asarray(leaf) for k, leaf in leaves}
        np.savez(path, mean=self.mean, deviation=self.deviation, **layers, allow_pickle=False)

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Return the policy of a file; no code of the file runs."""
        file = read_arrays(path, LARGEST_FILE)
        leaves = [file[f"layer{k}"] for k in range(len(file) - 2)]
        return cls(tuple(zip(leaves[::2], leaves[1::2], strict=True)), file["mean"], file["deviation"])


@jax.jit
def _action(policy: Policy, observation: Any) -> Any:
    return jnp.clip(evaluated(policy.layers, policy.normalised(observation)), -1.0, 1.0)


@dataclasses.dataclass(frozen=True)
class PPOSettings:
    """Settings of the training.

    Attributes:
        steps: periods of all episodes together, after which the training is done.
        episodes: episodes that move at once.
        rollout: periods between two updates.
        epochs: passes over a rollout in an update.
        batch: transitions in a step of the optimiser, at most episodes × rollout.
        rate: learning rate at the start; it falls to zero.
        discount: of later rewards, per period.
        trace: λ of the generalised advantage estimate.
        clip: largest change of a probability ratio that is rewarded.
        deviation: standard deviation of the actions at the start.
        hidden: widths of the hidden layers.
    """

    steps: int = 3_000_000
    episodes: int = 128
    rollout: int = 32
    epochs: int = 6
    batch: int = 1024
    rate: float = 1e-3
    discount: float = 0.95
    trace: float = 0.95
    clip: float = 0.2
    deviation: float = 0.5
    hidden: tuple[int, ...] = (128, 128)


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
        distance = (action - mean) / jnp.exp(self.log_deviation)
        return jnp.sum(-0.5 * distance**2 - self.log_deviation - 0.5 * np.log(2.0 * np.pi), axis=-1)


class Rollout(NamedTuple):
    """Transitions of a rollout (T, B, ...); observations are normalised."""

    seen: Any
    action: Any
    log_probability: Any
    #: of the observations before each period
    value: Any
    reward: Any
    #: after each period: value of the last observation where an episode was truncated, zero at its end
    following: Any
    ended: Any
    #: observations as they are
    raw: Any

    def advantages(self, discount: float, trace: float) -> Float[np.ndarray, "T B"]:
        """Return generalised advantage estimates (Schulman et al. 2016, equation (16)); `trace` is λ."""
        rows, later = np.zeros_like(self.reward), np.zeros(self.reward.shape[1])
        errors = self.reward + discount * self.following - self.value
        for t in range(len(rows) - 1, -1, -1):
            rows[t] = later = errors[t] + discount * trace * np.where(self.ended[t], 0.0, later)
        return rows


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


def _loss(networks: Networks, batch: Any, settings: PPOSettings) -> Any:
    seen, action, log_probability, advantage, returns = batch
    ratio = jnp.exp(networks.log_probability(evaluated(networks.policy, seen), action) - log_probability)
    advantage = (advantage - jnp.mean(advantage)) / (jnp.std(advantage) + 1e-8)
    bounded = jnp.clip(ratio, 1.0 - settings.clip, 1.0 + settings.clip)
    gain = jnp.mean(jnp.minimum(ratio * advantage, bounded * advantage))
    return -gain + 0.5 * jnp.mean((evaluated(networks.value, seen)[..., 0] - returns) ** 2)


@functools.partial(jax.jit, static_argnames=("settings", "optimiser"))
def _updated(learned: Any, batch: Any, key: Any, settings: PPOSettings, optimiser: Any) -> Any:
    """Return the networks and the optimiser's state after all epochs over a rollout."""
    size = batch[0].shape[0]
    count = size // settings.batch

    def step(carry: Any, rows: Any) -> Any:
        networks, state = carry
        slopes = jax.grad(_loss)(networks, jax.tree.map(lambda leaf: leaf[rows], batch), settings)
        change, state = optimiser.update(slopes, state, networks)
        return (optax.apply_updates(networks, change), state), None

    keys = jax.random.split(key, settings.epochs)
    order = jax.vmap(lambda key: jax.random.permutation(key, size)[: count * settings.batch])(keys)
    return jax.lax.scan(step, learned, order.reshape(settings.epochs * count, settings.batch))[0]


class PolicyTraining:
    """Training of a policy by PPO; `policy` may be used at any time."""

    def __init__(self, environment: Environment, settings: PPOSettings = PPOSettings(), seed: int = 0):
        """Set up the networks and the episodes; the same seed gives the same policy."""
        self.environment, self.settings = environment, settings
        per_update = settings.episodes * settings.rollout
        self._updates = settings.steps // per_update
        size, actions = environment.observation_size, environment.action_size
        policy_key, value_key, self._key = jax.random.split(jax.random.PRNGKey(seed), 3)
        sizes = (size, *settings.hidden)
        networks = Networks(
            network(policy_key, (*sizes, actions), 0.01),
            network(value_key, (*sizes, 1), 1.0),
            jnp.full(actions, np.log(settings.deviation), dtype=jnp.float32),
        )
        steps_of_optimiser = self._updates * settings.epochs * (per_update // settings.batch)
        self._optimiser = optax.chain(
            optax.clip_by_global_norm(0.5),
            optax.adam(optax.linear_schedule(settings.rate, 0.0, steps_of_optimiser)),
        )
        #: networks, and the optimiser's state
        self._learned = networks, self._optimiser.init(networks)
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
    def networks(self) -> Networks:
        """The present networks."""
        return self._learned[0]

    @property
    def policy(self) -> Policy:
        """The present policy, without exploration."""
        deviation = np.sqrt(self._squares / self._count + 1e-8)
        return Policy(self.networks.policy, self._mean.astype(np.float32), deviation.astype(np.float32))

    def run(
        self, seconds: float = np.inf, report: Callable[[Progress], None] | None = None
    ) -> list[Progress]:
        """Train until all steps are made, or for some seconds; return the progress after each update.

        Args:
            seconds: time after which no further update begins.
            report: called after each update.
        """
        start = clock.perf_counter() - (self.history[-1].seconds if self.history else 0.0)
        while len(self.history) < self._updates and clock.perf_counter() - start < seconds:
            reward = self.update()
            steps = (len(self.history) + 1) * self.settings.episodes * self.settings.rollout
            self.history.append(Progress(steps, clock.perf_counter() - start, reward))
            if report is not None:
                report(self.history[-1])
        return self.history

    def update(self) -> float:
        """Make one rollout and learn from it; return its mean reward."""
        settings, policy = self.settings, self.policy
        periods = [self._period(policy) for _ in range(settings.rollout)]
        rollout = Rollout(*map(np.stack, zip(*periods, strict=True)))
        advantage = rollout.advantages(settings.discount, settings.trace)
        parts = (*rollout[:3], advantage, advantage + rollout.value)
        batch = tuple(jnp.asarray(part.reshape(-1, *part.shape[2:]), dtype=jnp.float32) for part in parts)
        self._key, key = jax.random.split(self._key)
        self._learned = _updated(self._learned, batch, key, settings, self._optimiser)
        self._count_in(rollout.raw.reshape(-1, rollout.raw.shape[-1]))
        return float(np.mean(rollout.reward))

    def _period(self, policy: Policy) -> Rollout:
        """Move all episodes on by one period, and return its numbers (B, ...)."""
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
        seen, action, log_probability, value = acted
        return Rollout(seen, action, log_probability, value, reward, following, ended, raw)

    def _count_in(self, rows: np.ndarray) -> None:
        """Take observations (n, o) into account in the mean and the deviation."""
        count, shift = len(rows), rows.mean(axis=0) - self._mean
        total = self._count + count
        self._squares += rows.var(axis=0) * count + shift**2 * self._count * count / total
        self._mean, self._count = self._mean + shift * count / total, total

    def _keys(self, count: int) -> np.ndarray:
        return self._random.integers(2**32, size=(count, 2), dtype=np.uint32)
