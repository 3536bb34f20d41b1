"""Checkpoints of a fit or an identification: after an interruption it resumes from the last ones.

A checkpoint of a fit identifies it by settings, data and nominal model. A checkpoint of another fit is
refused, and so is a truncated or damaged one. Files are `container`s: they are written atomically, and
reading one runs no code.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Self

import jax
import numpy as np

from knode_cosserat.errors import KnodeCosseratError
from knode_cosserat.io import container
from knode_cosserat.learning.config import FitConfig
from knode_cosserat.rods.system import System
from knode_cosserat.trajectory import Trajectory


class CheckpointError(KnodeCosseratError, ValueError):
    """A checkpoint that cannot be used or written. The message is one line: the file and the reason."""

    code = "checkpoint"


KIND = container.Kind("knode-cosserat checkpoint", 1, CheckpointError)
SUFFIX = ".checkpoint"


@dataclasses.dataclass(frozen=True)
class Identity:
    """Identity of a fit, without its seed, which is in the checkpoint's name."""

    config: dict[str, Any]
    knowledge: str
    trajectories: tuple[str, ...]
    held_out: tuple[str, ...]

    @classmethod
    def of(
        cls,
        knowledge: System,
        trajectories: Sequence[Trajectory],
        held_out: Sequence[Trajectory],
        config: FitConfig,
    ) -> Self:
        """Return the identity of a fit from the arguments of `fit`."""
        settings = {name: value for name, value in config.to_dict().items() if name != "seed"}
        hashes = (tuple(map(data_hash, several)) for several in (trajectories, held_out))
        return cls(settings, _knowledge_hash(knowledge), *hashes)

    def difference(self, other: dict[str, Any]) -> str:
        """Return the difference from the fit of a file, in words; empty if it is the same fit."""
        changed = _first_change(self.config, other.get("config"))
        if changed:
            return f"of other settings: {changed}"
        for name, words in (
            ("knowledge", "another nominal model"),
            ("trajectories", "other trajectories"),
            ("held_out", "other held-out trajectories"),
        ):
            value = getattr(self, name)
            if (list(value) if isinstance(value, tuple) else value) != other.get(name):
                return f"of {words}"
        return ""


def data_hash(trajectory: Trajectory) -> str:
    """Return the SHA-256 of a trajectory's times, states, strains and controls."""
    return hashed(*(getattr(trajectory, name) for name in ("time", "y", "z", "control")))


def _knowledge_hash(knowledge: System) -> str:
    residual = getattr(knowledge, "residual", None)
    leaves, _ = jax.tree_util.tree_flatten_with_path(knowledge)
    names = [type(knowledge).__qualname__, type(residual).__qualname__, str(knowledge.nodes)]
    names += [jax.tree_util.keystr(path) for path, _ in leaves]
    return hashed(*names, *(leaf for _, leaf in leaves))


def hashed(*values: Any) -> str:
    """Return the SHA-256 of texts and arrays."""
    digest = hashlib.sha256()
    for value in values:
        if isinstance(value, str):
            digest.update(value.encode() + b"\0")
            continue
        array = np.asarray(value)
        digest.update(f"{array.dtype.str} {array.shape}\n".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _first_change(here: Any, there: Any, where: str = "") -> str:
    if isinstance(here, dict) and isinstance(there, dict):
        keys = sorted({*here, *there})
        changes = (_first_change(here.get(key), there.get(key), f"{where}.{key}".strip(".")) for key in keys)
        return next(filter(None, changes), "")
    if here == there:
        return ""
    return f"{where} is {json.dumps(there)[:60]} there and {json.dumps(here)[:60]} here"


class Checkpoints:
    """Checkpoints in a folder: one file for each independent part.

    Args:
        folder: created if it does not exist.
        identity: of the fit to which all files belong; None: their names identify them.

    Raises:
        CheckpointError: the folder cannot be created.
    """

    def __init__(self, folder: str | Path, identity: Identity | None = None):
        self.folder = Path(folder)
        self.identity = identity
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or error
            raise CheckpointError(f"{folder}: cannot be made a folder: {reason}") from None

    def path(self, name: str) -> Path:
        """Return the file of a part."""
        return self.folder / f"{name}{SUFFIX}"

    def save(self, name: str, snapshot: dict[str, Any]) -> None:
        """Write the state of a part; replaces its earlier file. Raises `CheckpointError`."""
        identity = json.loads(json.dumps(dataclasses.asdict(self.identity))) if self.identity else {}
        with KIND.naming(self.path(name)):
            content = container.encode(KIND, {"identity": identity, "name": name, "snapshot": snapshot})
        container.write(self.path(name), content, KIND)

    def load(self, name: str) -> dict[str, Any] | None:
        """Read the state of a part; None if there is no checkpoint yet. Raises `CheckpointError`."""
        path = self.path(name)
        for left_over in self.folder.glob(f".{path.name}.*.tmp"):
            with contextlib.suppress(OSError):
                left_over.unlink()
        if not path.exists():
            return None
        try:
            content = container.read(path, KIND)
            with KIND.naming(path):
                identity = content.fact("identity", dict)
                difference = self.identity.difference(identity) if self.identity else ""
                if content.fact("name", str) != name:
                    difference = f"of {content.facts['name'][:60]!r}"
                snapshot = content.fact("snapshot", dict)
        except CheckpointError as error:
            raise CheckpointError(f"{error}; delete it to start again") from None
        if difference:
            raise CheckpointError(
                f"{path}: it is {difference}; give this fit another folder, or delete it to start again"
            )
        return dict(snapshot)


def packed_tree(tree: Any) -> list[np.ndarray]:
    """Return the arrays of a pytree, for a snapshot."""
    return [np.asarray(leaf) for leaf in jax.tree.leaves(tree)]


def unpacked(arrays: Any, like: Any) -> Any:
    """Return a pytree of the same structure with the arrays of a snapshot. Raises `CheckpointError`."""
    leaves, structure = jax.tree.flatten(like)
    described = [(np.shape(leaf), np.asarray(leaf).dtype) for leaf in leaves]
    if not isinstance(arrays, list) or not all(isinstance(array, np.ndarray) for array in arrays):
        raise CheckpointError("a checkpoint has something else where arrays should be")
    if [(array.shape, array.dtype) for array in arrays] != described:
        raise CheckpointError("a checkpoint has arrays of other shapes than this fit")
    return jax.tree.unflatten(structure, [jax.numpy.asarray(array) for array in arrays])
