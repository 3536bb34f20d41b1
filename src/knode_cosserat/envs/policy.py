"""Policies: networks from observations to actions, their files, and their use as controllers."""

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
from knode_cosserat.envs.errors import TaskError

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
            found = cls(layers, file["mean"], file["deviation"])
        except LimitSettingError:
            raise
        except ReadError as error:
            raise TaskError(f"the policy {path} cannot be read: {error}") from None
        except KeyError as error:
            raise TaskError(f"{path} is no policy: it has no {error.args[0]}") from None
        except (ValueError, TypeError, AttributeError) as error:
            raise TaskError(f"{path} is no policy: {error}") from None
        found._check(path)
        return found

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
