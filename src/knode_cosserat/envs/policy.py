"""Policies: networks from observations to actions, their files, their use as controllers, and scores."""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from typing import Any, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat._files.arrays import read_arrays
from knode_cosserat._files.json_text import parse_json
from knode_cosserat._files.limits import LimitSettingError, excess
from knode_cosserat._files.reading import ReadError
from knode_cosserat._files.writing import replacing
from knode_cosserat.control import (
    CONTROLLERS,
    Command,
    Controller,
    Plant,
    Reference,
    Status,
    controller_named,
    run_loop,
)
from knode_cosserat.control.planning import PlanController
from knode_cosserat.envs.dynamics import MEASURED, Ending, EpisodeState, commanded, observed, scaled
from knode_cosserat.envs.environment import Environment
from knode_cosserat.envs.tasks import TaskError
from knode_cosserat.estimation.outputs import TipPosition
from knode_cosserat.rods.system import System

#: version of the files
VERSION = 1
#: greatest size of a file (bytes), unpacked too, and greatest number of layers
LARGEST_FILE, MOST_LAYERS = 50_000_000, 20
#: normalised observations are clipped here
CLIP = 10.0

Layers = tuple[tuple[Float[Any, "i o"], Float[Any, " o"]], ...]


def network(key: Any, sizes: tuple[int, ...], last: float) -> Layers:
    """Return random layers with orthogonal weights; those of the last layer are multiplied by `last`."""
    layers = []
    for k, (before, after) in enumerate(itertools.pairwise(sizes)):
        key, own = jax.random.split(key)
        gain = last if k == len(sizes) - 2 else np.sqrt(2.0)
        weights = jax.nn.initializers.orthogonal(gain)(own, (before, after), jnp.float32)
        layers.append((weights, jnp.zeros(after, dtype=jnp.float32)))
    return tuple(layers)


def evaluated(layers: Layers, x: Float[Any, "... i"]) -> Float[Any, "... o"]:
    """Return the output of a network with tanh between its layers."""
    for weights, bias in layers[:-1]:
        x = jnp.tanh(x @ weights + bias)
    weights, bias = layers[-1]
    return x @ weights + bias


class Policy(NamedTuple):
    """A deterministic policy: the mean action of a network of normalised observations."""

    layers: Layers
    #: mean and standard deviation of the observations in training
    mean: Float[Any, " o"]
    deviation: Float[Any, " o"]

    def normalised(self, observation: Float[Any, "... o"]) -> Float[Any, "... o"]:
        """Return an observation in standard deviations from its mean."""
        return jnp.clip((observation - self.mean) / self.deviation, -CLIP, CLIP)

    def action(self, observation: Float[Any, "... o"]) -> Float[Any, "... c"]:
        """Return the action, -1 to 1."""
        return jnp.clip(evaluated(self.layers, self.normalised(observation)), -1.0, 1.0)

    def save(self, path: str | Path) -> None:
        """Write the policy to a file (.npz), which holds arrays only."""
        header = json.dumps({"version": VERSION, "layers": len(self.layers)})
        arrays: dict[str, Any] = {"header": np.array(header), "mean": self.mean, "deviation": self.deviation}
        for k, (weights, bias) in enumerate(self.layers):
            arrays |= {f"weights{k}": weights, f"bias{k}": bias}
        with replacing(Path(path)) as part, part.open("wb") as file:
            np.savez(file, allow_pickle=False, **{name: np.asarray(value) for name, value in arrays.items()})

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Return the policy of a file; no code of the file runs.

        Raises:
            TaskError: no file of a policy, or a damaged one.
        """
        path = Path(path)
        try:
            file = read_arrays(path, LARGEST_FILE)
            header = parse_json(str(file["header"]))
            if header.get("version") != VERSION:
                raise ValueError(f"its version is {header.get('version')!r}; this package reads {VERSION}")
            count = header["layers"]
            if not isinstance(count, int) or count < 1:
                raise ValueError(f"it has {count!r} layers")
            if reason := excess(count, MOST_LAYERS, "layers"):
                raise ValueError(reason)
            layers = tuple((file[f"weights{k}"], file[f"bias{k}"]) for k in range(count))
            policy = cls(layers, file["mean"], file["deviation"])
        except LimitSettingError:
            raise
        except ReadError as error:
            raise TaskError(f"the policy {path} cannot be read: {error}") from None
        except KeyError as error:
            raise TaskError(f"{path} is no policy: it has no {error.args[0]}") from None
        except (ValueError, TypeError, AttributeError) as error:
            raise TaskError(f"{path} is no policy: {error}") from None
        policy._check(path)
        return policy

    def _check(self, path: Path) -> None:
        size = np.shape(self.mean)
        shapes = [size == np.shape(self.deviation) and len(size) == 1]
        for weights, bias in self.layers:
            shapes.append(np.ndim(weights) == 2 and size == (len(weights),) and np.ndim(bias) == 1)
            size = np.shape(bias)
            shapes.append(np.shape(weights)[1:] == size)
        leaves = jax.tree.leaves(tuple(self))
        if not all(shapes) or not all(np.all(np.isfinite(leaf)) for leaf in leaves if leaf.dtype.kind == "f"):
            raise TaskError(f"{path} is no policy: its arrays do not fit together, or are not finite")
        if not np.all(np.asarray(self.deviation) > 0.0):
            raise TaskError(f"{path} is no policy: a standard deviation is not positive")


# controllers and plants


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
            action = policy.action(observed(environment.spec, arrays, state))
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
        self.state, after = self.environment.step(self.state, np.clip(action, -1.0, 1.0))
        self.rewards.append(float(after.reward))
        self.ending, self._tip = Ending(int(after.ending)), np.asarray(after.tip)

    def tip(self) -> Float[np.ndarray, "3"]:
        """Return the true position of the tip (m)."""
        return self._tip


# scores

#: standard deviation (m) of measured positions that a reference controller assumes, at least
LEAST_NOISE = 2e-4


def reference_controller(
    environment: Environment, state: EpisodeState, name: str = "predictive"
) -> Controller:
    """Return a controller whose model has the middle of all parameters, and the obstacles of an episode."""
    arrays, spec = environment.arrays, environment.spec
    middle = {name: 0.5 * (arrays.least[name] + arrays.greatest[name]) for name in spec.names}
    robot: System = spec.task.placed(arrays.robot.replace(**middle), state.goal)
    noise = max(float(arrays.noise), LEAST_NOISE)
    has_observer = CONTROLLERS[name].cls.has_observer
    adapt = [key for key in spec.task.adapted if has_observer and key in spec.names]
    return controller_named(name, robot, spec.dt, environment.limits, adapt, TipPosition(sigma=noise))


def controller_scores(
    environment: Environment, keys: Any, name: str = "predictive"
) -> Float[np.ndarray, " n"]:
    """Return the mean reward of a controller in the episode of each key (n, 2).

    It knows the middle of the parameters and the target, and measures the tip. It adapts the parameters that
    the task names. An episode that ends early counts zero for the rest of its time.
    """
    scores = []
    for key in np.asarray(keys):
        state, _ = environment.reset(jnp.asarray(key))
        controller = reference_controller(environment, state, name)
        if isinstance(controller, PlanController):
            controller.observer.restart()
        plant = EpisodePlant(environment, state)
        run_loop(controller, plant, environment.reference(state), environment.steps * environment.dt)
        scores.append(sum(plant.rewards) / environment.steps)
    return np.array(scores)


def policy_scores(environment: Environment, policy: Policy, keys: Any) -> Float[np.ndarray, " n"]:
    """Return the mean reward of a policy in the episode of each key (n, 2), as in `controller_scores`."""
    states, observations = environment.reset_many(jnp.asarray(keys))
    act = jax.jit(lambda observation: policy.action(observation))
    running, total = np.ones(len(keys), dtype=bool), np.zeros(len(keys))
    for _ in range(environment.steps):
        states, after = environment.step_many(states, act(observations))
        total += np.where(running, np.asarray(after.reward), 0.0)
        running &= ~np.asarray(after.terminated | after.truncated)
        observations = after.observation
    return total / environment.steps
