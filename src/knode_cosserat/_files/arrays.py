"""NumPy archives (.npz), read without pickles and within limits of their size before and after unpacking."""

from __future__ import annotations

import io
import math
import zipfile
from pathlib import Path

import numpy as np

from knode_cosserat._files.reading import ReadError, read_bytes, require_limit
from knode_cosserat.errors import KnodeCosseratError, first_line


def read_arrays(path: str | Path, limit: int) -> dict[str, np.ndarray]:
    """Return the arrays of an archive by name; `limit` is of the bytes before and after unpacking.

    Raises:
        ReadError: the file cannot be read, is larger, damaged, or holds something else than plain arrays.
    """
    content = read_bytes(path, limit)
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            entries = archive.infolist()
            require_limit(sum(each.file_size for each in entries), limit, "bytes when unpacked")
            return {each.filename.removesuffix(".npy"): _array(archive.read(each)) for each in entries}
    except KnodeCosseratError:
        raise
    except Exception as error:  # a damaged archive fails in many ways
        raise ReadError(f"not an archive of arrays: {first_line(error)}") from None


def _array(content: bytes) -> np.ndarray:
    file = io.BytesIO(content)
    version = np.lib.format.read_magic(file)
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    if version not in readers:
        raise ReadError(f"an array has the version {version}; allowed are {', '.join(map(str, readers))}")
    shape, _, kind = readers[version](file)
    # NumPy allocates what the header states
    if kind.hasobject or math.prod(shape) * kind.itemsize != len(content) - file.tell():
        raise ReadError("an array has objects, or another number of bytes than it states")
    file.seek(0)
    return np.asarray(np.lib.format.read_array(file, allow_pickle=False))
