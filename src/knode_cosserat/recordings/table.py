"""Recordings as tables, CSV or Parquet: columns with names and units, and what is said of all of them.

A CSV file, UTF-8, with comments before its header; a Parquet file has the same as metadata of its schema:

    # source: what the recording is and where it comes from
    # simulated: true
    # fraction rib: 0.5
    # fraction tip: 1
    # latency: 0.06
    time [s],tension_1 [N],tension_2 [N],…,command_1 [N],…,rib_x [m],rib_y [m],rib_z [m],rib_qw,…,tip_x [m],…

`simulated` says whether the robot was itself a simulation; without it nothing is claimed. A body alone is at
the tip, others need their `fraction` of the rod's length. Without a configuration positions are in the
robot's frame and orientations (quaternions, scalar first) those of the rod. A row has what was measured at
its time: where other sensors are faster, cells stay empty.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd  # type: ignore[import-untyped]
from jaxtyping import Float

from knode_cosserat._yaml import shown
from knode_cosserat.recordings.config import CommandSource, MarkerSource, RecordingConfig, TensionSource
from knode_cosserat.recordings.findings import RecordingError
from knode_cosserat.recordings.messages import Stream

TIME = "time [s]"
#: what columns of tensions begin with where no configuration says otherwise
TENSION, COMMAND = "tension", "command"
ALLOWED = (
    f"{TIME}, tension_1 [N], tension_2 [N], …, NAME_x [m], NAME_y [m], NAME_z [m] for each body, and, if "
    "they were measured, NAME_qw, NAME_qx, NAME_qy, NAME_qz, and command_1 [N], …"
)
PARQUET_MAGIC = b"PAR1"
_QUATERNION = ("qw", "qx", "qy", "qz")
#: larger numbers of seconds cannot be a time
_LATEST = 9e9


def read_csv(data: bytes, path: str) -> tuple[dict[str, str], pd.DataFrame]:
    """What a CSV file's comments say, and its columns of numbers. Raises `RecordingError`."""
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise RecordingError(f"{path}: not a recording: no bag, and no CSV text: it is not UTF-8") from None
    return _comments(text), _numbers(_cells(text, path), path)


def read_parquet(path: Path) -> tuple[dict[str, str], pd.DataFrame]:
    """What a Parquet file's metadata say, and its columns of numbers.

    Raises:
        RecordingError: the file cannot be read, or a column has no numbers.
        ImportError: pyarrow is not installed.
    """
    pyarrow = _pyarrow()
    try:
        table = pyarrow.parquet.read_table(path)
        said = {key.decode(): value.decode() for key, value in (table.schema.metadata or {}).items()}
        frame = pd.DataFrame({name: table.column(i).to_numpy() for i, name in enumerate(table.column_names)})
    except (pyarrow.ArrowException, OSError, ValueError) as error:
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise RecordingError(f"{path}: not a Parquet table: {reason}") from None
    if len(frame) == 0:
        raise RecordingError(f"{path}: no rows")
    return said, _numbers(frame, str(path))


def write_parquet(path: Path, table: pd.DataFrame, said: Mapping[str, str]) -> None:
    """Write columns and what is said of them. Raises `ImportError` if pyarrow is not installed."""
    pyarrow = _pyarrow()
    written = pyarrow.Table.from_pandas(table, preserve_index=False)
    pyarrow.parquet.write_table(written.replace_schema_metadata(dict(said)), path)


def _pyarrow() -> Any:
    try:
        import pyarrow  # type: ignore[import-not-found, import-untyped, unused-ignore]
        import pyarrow.parquet  # type: ignore[import-not-found, import-untyped, unused-ignore]
    except ImportError:
        raise ImportError("Parquet files need pyarrow: pip install 'knode-cosserat[parquet]'") from None
    return pyarrow


def _comments(text: str) -> dict[str, str]:
    """What the lines `# key: value` before the header say."""
    said = {}
    for line in text.splitlines():
        if not line.startswith("#"):
            break
        key, colon, value = line.removeprefix("#").partition(":")
        if colon:
            said[key.strip()] = value.strip()
    return said


def _cells(text: str, path: str) -> pd.DataFrame:
    """The cells as text, under the header's titles."""
    try:
        cells = pd.read_csv(io.StringIO(text), comment="#", header=None, dtype=str, skipinitialspace=True)
    except pd.errors.EmptyDataError:
        raise RecordingError(f"{path}: the file is empty; allowed is a header {ALLOWED}") from None
    except (pd.errors.ParserError, ValueError) as error:
        reason = (str(error).strip().splitlines() or ["it cannot be parsed"])[-1]
        raise RecordingError(f"{path}: not a CSV table: {reason}") from None
    table = cells.iloc[1:].set_axis(cells.iloc[0].fillna("").str.strip(), axis="columns")
    if table.empty:
        raise RecordingError(f"{path}: no rows after the header")
    return table


def _numbers(table: pd.DataFrame, path: str) -> pd.DataFrame:
    """All cells as numbers, NaN where they are empty."""
    numbers = table.apply(pd.to_numeric, errors="coerce")
    values = numbers.to_numpy(dtype=float, na_value=np.nan)
    said = ~table.isna().to_numpy()
    wrong = said & ~np.isfinite(values)
    for row, column in np.argwhere(wrong):
        given = table.iat[row, column]
        # how programs write that there is no number
        if str(given).strip().lower() not in ("nan", "none", "null", "na", "n/a", "-nan", ""):
            raise RecordingError(
                f"{path}: row {row + 1}: {table.columns[column]} is {shown(given)}; "
                "allowed is a finite number"
            )
    return pd.DataFrame(values, columns=list(map(str, table.columns)))


# what the columns are


def configured(said: Mapping[str, str], columns: list[str], path: str) -> RecordingConfig:
    """The configuration of a table that comes without one. Raises `RecordingError`."""
    others = [name for name in columns if name != TIME]
    tendons = {name: sum(each.startswith(f"{name}_") for each in others) for name in (TENSION, COMMAND)}
    bodies = [name.removesuffix("_x [m]") for name in others if name.endswith("_x [m]")]
    known = [f"{name}_{k + 1} [N]" for name, count in tendons.items() for k in range(count)]
    for body in bodies:
        known += position_titles(body, "m")
        oriented = quaternion_titles(body)
        known += oriented if oriented[0] in columns else []
    wrong = TIME not in columns or not bodies or not any(tendons.values()) or len(set(columns)) < len(columns)
    if wrong or sorted(known) != sorted(others):
        raise RecordingError(f"{path}: the columns are {', '.join(columns)}; allowed is {ALLOWED}, once each")
    markers = [
        MarkerSource(body, body, _fraction(body, said, len(bodies), path), rotation=(1.0, 0.0, 0.0, 0.0))
        for body in bodies
    ]
    order = {name: tuple(range(1, count + 1)) for name, count in tendons.items()}
    try:
        return RecordingConfig(
            markers=tuple(sorted(markers, key=lambda marker: marker.fraction)),
            tension=TensionSource(TENSION, order[TENSION]) if order[TENSION] else None,
            command=(
                CommandSource(COMMAND, order[COMMAND], latency=_said_number("latency", said, 0.0, path))
                if order[COMMAND]
                else None
            ),
            tensions="measured" if order[TENSION] else "commanded",
        )
    except RecordingError as error:
        raise RecordingError(f"{path}: {error}") from None


def _fraction(body: str, said: Mapping[str, str], bodies: int, path: str) -> float:
    key = f"fraction {body}"
    if key not in said and bodies > 1:
        raise RecordingError(
            f"{path}: where on the rod {body} is, is not said; allowed is a line '# {key}: ' with a number "
            "from 0 to 1, or a configuration"
        )
    return _said_number(key, said, 1.0, path)


def _said_number(key: str, said: Mapping[str, str], otherwise: float, path: str) -> float:
    try:
        return float(said.get(key, otherwise))
    except ValueError:
        raise RecordingError(f"{path}: {key} is {shown(said[key])}; allowed is a number") from None


def said_simulated(said: Mapping[str, str], path: str) -> bool | None:
    """Whether a table says that the robot was a simulation; None if it does not. Raises `RecordingError`."""
    given = said.get("simulated")
    if given not in (None, "true", "false"):
        raise RecordingError(f"{path}: simulated is {shown(given)}; allowed is true or false")
    return None if given is None else given == "true"


def position_titles(body: str, unit: str) -> list[str]:
    """The titles of a body's position."""
    return [f"{body}_{axis} [{unit}]" for axis in "xyz"]


def quaternion_titles(body: str) -> list[str]:
    """The titles of a body's orientation."""
    return [f"{body}_{part}" for part in _QUATERNION]


def tension_titles(topic: str, unit: str, count: int) -> list[str]:
    """The titles of tensions, or commands, in the order of a message."""
    return [f"{topic}_{k + 1} [{unit}]" for k in range(count)]


def streams(table: pd.DataFrame, config: RecordingConfig, path: str) -> dict[str, Stream]:
    """By topic, the rows in which it was measured. Raises `RecordingError` if a column is missing."""
    columns = list(table.columns)
    if columns.count(TIME) != 1:
        raise RecordingError(f"{path}: the columns are {', '.join(columns)}; required is {TIME}, once")
    time = table[TIME].to_numpy()
    if np.any(np.abs(time) > _LATEST):
        row = int(np.argmax(np.abs(time) > _LATEST))
        raise RecordingError(f"{path}: row {row + 1}: {TIME} is {time[row]:g}; allowed is up to {_LATEST:g}")
    wanted: dict[str, list[str]] = {}
    for source in (*config.markers, config.base):
        if source is not None:
            titles, turned = (
                position_titles(source.topic, config.position_unit),
                quaternion_titles(source.topic),
            )
            wanted[source.topic] = titles + (turned if turned[0] in columns else [])
    for tendons in (config.tension, config.command):
        if tendons is not None:
            wanted[tendons.topic] = tension_titles(tendons.topic, tendons.unit, len(tendons.order))
    optional = _optional(config)
    found = {}
    for topic, titles in wanted.items():
        missing = [title for title in titles if columns.count(title) != 1]
        if missing and topic in optional and len(missing) == len(titles):
            continue
        if missing:
            wrong = "missing" if missing[0] not in columns else "there twice"
            raise RecordingError(
                f"{path}: the column {missing[0]} is {wrong}; the columns are {', '.join(columns)}"
            )
        found[topic] = _stream(topic, time, table[titles].to_numpy())
    return found


def _optional(config: RecordingConfig) -> set[str]:
    """The tensions that nobody needs."""
    unused = config.command if config.tensions == "measured" else config.tension
    return {unused.topic} if unused is not None else set()


def _stream(topic: str, time: Float[np.ndarray, " n"], values: Float[np.ndarray, "n size"]) -> Stream:
    there = np.isfinite(time) & np.isfinite(values).any(axis=1)
    stamps = np.round(time[there] * 1e9).astype(np.int64)
    # tables may begin before zero, and a stamp below zero would be none
    return Stream(topic, stamps, stamps, values[there])


def frame_of(columns: Mapping[str, Any]) -> pd.DataFrame:
    """A table of columns that each have their own times: a row for each time at which something was measured.

    Args:
        columns: by title, times (s) and numbers.
    """
    parts = {title: pd.Series(values, index=time) for title, (time, values) in columns.items()}
    # together, because one by one each would be sorted into all others
    table = pd.concat(parts, axis=1).sort_index()
    return table.rename_axis(TIME).reset_index()
