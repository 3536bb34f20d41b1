"""Shards as Parquet files: one row a case, with a version and a checksum in the file's metadata.

Parquet, not Zarr: a shard is one file, so that it is there whole or not at all by one rename. A column with
an array in each row, such as the tip's positions, has Arrow's type of tensors with a fixed shape.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from knode_cosserat._files.json_text import json_checksum, parse_json
from knode_cosserat._files.parquet_file import expansion_limit, open_parquet, require_limited_expansion
from knode_cosserat._files.reading import ReadError
from knode_cosserat._files.writing import replacing
from knode_cosserat.errors import first_line
from knode_cosserat.sweeps._description import SweepError

#: key of the metadata, and version of the format
KEY, VERSION = b"knode-cosserat sweep", 2
#: column of text
REASON = "reason"
KEPT = "complete shards are kept, and the same command goes on where it stopped"


class Shard(NamedTuple):
    """Columns of a shard by name, and its metadata."""

    columns: dict[str, Any]
    about: dict[str, Any]


def shard_bytes(columns: Mapping[str, Any], about: Mapping[str, Any]) -> bytes:
    """Return the content of a shard's file; equal columns and metadata give equal bytes."""
    pyarrow = require_pyarrow()
    arrays, split = {}, []
    for name, values in columns.items():
        array = np.ascontiguousarray(values)
        is_tensor = array.ndim > 1
        make = pyarrow.FixedShapeTensorArray.from_numpy_ndarray if is_tensor else pyarrow.array
        arrays[name] = make(array)
        if array.dtype.kind == "f":
            split.append(f"{name}.list.element" if is_tensor else name)
    stated = {**about, "version": VERSION}
    stated["checksum"] = checksum(columns, stated)
    table = pyarrow.table(arrays).replace_schema_metadata({KEY: json.dumps(stated, sort_keys=True).encode()})
    sink = pyarrow.BufferOutputStream()
    # level 1 of zstd with split bytes takes a tenth off doubles at 300 MB/s
    pyarrow.parquet.write_table(
        table,
        sink,
        compression="zstd",
        compression_level=1,
        use_byte_stream_split=split,
        use_dictionary=[REASON],
        write_statistics=[name for name, values in columns.items() if np.ndim(values) == 1],
        row_group_size=len(table) or 1,
    )
    return bytes(sink.getvalue())


def write_shard(path: Path, content: bytes) -> None:
    """Write a shard whole or not at all. Raises `SweepError`."""
    try:
        with replacing(path) as temporary:
            temporary.write_bytes(content)
    except OSError as error:
        raise SweepError(f"{path}: cannot be written: {error.strerror or error}; {KEPT}") from None


def read_shard(path: Path, names: Sequence[str] | None = None, *, verify: bool = True) -> Shard:
    """Return columns of a shard, all or some by name.

    Args:
        path: the file.
        names: the columns; None: all.
        verify: read all columns, and compare the checksum.

    Raises:
        SweepError: the file cannot be read, has another version, or was changed.
    """
    require_pyarrow()
    if not path.exists():
        raise SweepError(f"{path}: there is no such shard; the sweep is not complete")
    try:
        # a text that many rows have is stored once, and must not be written out for each
        with open_parquet(path, read_dictionary=[REASON]) as file:
            about = _metadata(file, path)
            require_limited_expansion(file.metadata, path)
            table = file.read(columns=None if verify or names is None else list(names))
            columns = {name: _numpy(table.column(name).combine_chunks()) for name in table.column_names}
            _require_short_texts(columns.get(REASON, ()), path)
    except ReadError as error:
        raise SweepError(f"{path}: damaged: {error}") from None
    except (TypeError, AttributeError) as error:
        raise SweepError(f"{path}: damaged: {first_line(error)}") from None
    stated = about.pop("checksum", None)
    if verify and checksum(columns, about) != stated:
        raise SweepError(f"{path}: damaged: its contents do not have its checksum")
    if missing := set(names or ()) - set(columns):
        raise SweepError(f"{path}: damaged: it has no column {min(missing)}")
    return Shard(columns if names is None else {name: columns[name] for name in names}, about)


def _metadata(file: Any, path: Path) -> dict[str, Any]:
    try:
        about = dict(parse_json(file.schema_arrow.metadata[KEY]))
    except (KeyError, TypeError, ValueError):
        raise SweepError(f"{path}: no shard of a sweep: its metadata are missing or damaged") from None
    if about.get("version") != VERSION:
        raise SweepError(
            f"{path}: the shard has the version {about.get('version')!r}; allowed is {VERSION}, which this "
            "version of the package reads and writes. Nothing was changed"
        )
    return about


def _numpy(column: Any) -> Any:
    if hasattr(column, "to_numpy_ndarray"):
        return column.to_numpy_ndarray()
    return column.to_numpy(zero_copy_only=False)


def _require_short_texts(texts: Sequence[str], path: Path) -> None:
    total, (most, limit) = sum(map(len, texts)), expansion_limit(path)
    if total > most:
        raise ReadError(f"its texts have {total} characters; {limit}")


def checksum(columns: Mapping[str, Any], about: Mapping[str, Any]) -> str:
    """Return a checksum of metadata, and of the names, types, shapes and values of columns."""
    digest = hashlib.sha256(json_checksum(about).encode())
    for name in sorted(columns):
        values = np.asarray(columns[name])
        is_text = values.dtype.kind in "OU"
        content = "\0".join(values.tolist()).encode() if is_text else np.ascontiguousarray(values).tobytes()
        kind = "text" if is_text else values.dtype.str
        digest.update(f"{name} {kind} {values.shape} {len(content)}\n".encode() + content)
    return digest.hexdigest()


def require_pyarrow() -> Any:
    """Return pyarrow. Raises `ImportError` with the command that installs it."""
    try:
        import pyarrow  # type: ignore[import-not-found, import-untyped, unused-ignore]
        import pyarrow.compute  # type: ignore[import-not-found, import-untyped, unused-ignore]
        import pyarrow.parquet  # type: ignore[import-not-found, import-untyped, unused-ignore]
    except ImportError:
        raise ImportError("sweeps need pyarrow: pip install 'knode-cosserat[sweep]'") from None
    return pyarrow
