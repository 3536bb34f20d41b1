"""Journal of finished searches, so that an interrupted identification resumes.

Each search is a function of the model, the recordings, and where it begins. Its end is kept in a file named
after a hash of these. A repeated run reads the ends of the searches that were finished, and takes the same
decisions from them. Files are NumPy archives without pickles: reading one runs no code. A damaged file counts
as missing.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from knode_cosserat._files.arrays import read_arrays
from knode_cosserat._files.reading import ReadError
from knode_cosserat._files.writing import package_version, replacing

if TYPE_CHECKING:
    from knode_cosserat.identification.misfit import Misfit

#: first line of every identity: another format has other files
FORMAT = "search 3"
#: largest file (bytes)
LARGEST_FILE = 100_000_000


class Journal:
    """Ends of searches, in a folder.

    Args:
        folder: created if it does not exist.

    Raises:
        OSError: the folder cannot be created.
    """

    def __init__(self, folder: str | Path):
        self.folder = Path(folder)
        self.folder.mkdir(parents=True, exist_ok=True)

    def load(self, key: str) -> dict[str, np.ndarray] | None:
        """Return the arrays of a finished search; None if there is none."""
        try:
            return read_arrays(self._path(key), LARGEST_FILE)
        except ReadError:
            return None

    def save(self, key: str, arrays: dict[str, Any]) -> None:
        """Write the arrays of a finished search, whole or not at all."""
        with replacing(self._path(key)) as path, path.open("wb") as file:
            np.savez(file, **arrays)

    def _path(self, key: str) -> Path:
        return self.folder / f"{key}.search.npz"


def identity(misfit: Misfit, prior: np.ndarray) -> str:
    """Return a hash of what every search depends on: model, recordings, settings, and this package."""
    model = misfit.model
    words = [FORMAT, package_version(), repr(model.numbers), repr(model.names)]
    arrays = [prior, *jax.tree.leaves(model.robot)]
    for each in misfit.data:
        words.append(f"{each.name} {each.dt!r} {each.moves} {each.static} {each.continuous} {each.steps}")
        words += [repr(each.settings), repr(each.output)]
        arrays += [np.zeros(0) if each.held is None else each.held, each.control, each.data]
    return hashed(*words, *arrays)


def hashed(*values: Any) -> str:
    """Return the SHA-256 of texts and arrays."""
    digest = hashlib.sha256()
    for each in values:
        if not isinstance(each, str):
            array = np.asarray(each)
            each = f"{array.dtype} {array.shape} {array.tobytes().hex()}"
        digest.update(each.encode() + b"\0")
    return digest.hexdigest()
