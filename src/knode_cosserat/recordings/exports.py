"""Exports of motion capture as tables: bodies and channels, in m and scalar first, under the usual titles."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float

from knode_cosserat._files import csv_rows
from knode_cosserat._files.reading import require_limit
from knode_cosserat.recordings import content
from knode_cosserat.recordings.findings import Finding, RecordingError
from knode_cosserat.recordings.table import (
    TIME,
    Table,
    columns_of,
    numbers_of,
    position_titles,
    quaternion_titles,
)

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

#: units of length in m
LENGTHS = {
    "m": 1.0,
    "meters": 1.0,
    "metres": 1.0,
    "cm": 1e-2,
    "centimeters": 1e-2,
    "centimetres": 1e-2,
    "mm": 1e-3,
    "millimeters": 1e-3,
    "millimetres": 1e-3,
    "in": 0.0254,
    "inches": 0.0254,
    "ft": 0.3048,
    "feet": 0.3048,
}
#: largest number of columns: unlabelled markers that come and go have three each
MOST_COLUMNS = 20_000
#: beginnings of the names of markers that the motion capture did not recognise
_UNKNOWN = ("unlabeled", "unlabelled", "*", "_")


class Track(NamedTuple):
    """Poses of a body or marker in an export."""

    name: str
    #: (n, 3) m; NaN where it is lost
    position: Float[np.ndarray, "n 3"]
    #: (n, 4) scalar first; None for a marker
    quaternion: Float[np.ndarray, "n 4"] | None = None
    #: kind in the file, such as rigid body
    kind: str = "marker"


#: analog channels: their times (s), and values by title
Channels = tuple[Float[np.ndarray, " n"], Mapping[str, Float[np.ndarray, " n"]]]


def export_table(
    time: Float[np.ndarray, " n"],
    tracks: Sequence[Track],
    *,
    up: str,
    channels: Iterable[Channels] = (),
    findings: Iterable[Finding] = (),
    source: str = "",
) -> Table:
    """Return the table of an export. Bodies with orientations come before markers.

    Names of tracks that are there twice get the kind or a number. `up` is the axis of the file that points
    up; `channels` have times of their own; `source` names file and take.

    Raises:
        RecordingError: no body is there, or too many.
    """
    import pandas as pd  # type: ignore[import-untyped]

    if not tracks:
        raise RecordingError("it has no bodies and no markers with positions")
    require_limit(3 * len(tracks), MOST_COLUMNS, "columns")
    columns: dict[str, np.ndarray] = {TIME: time}
    remarks, names = list(findings), []
    for track in sorted(tracks, key=lambda track: track.quaternion is None):
        spellings = [track.name, f"{track.name} ({track.kind})"]
        numbered = (f"{track.name} ({k})" for k in itertools.count(2))
        candidates = itertools.chain(spellings, numbered)
        name = next(name for name in candidates if f"{name}_x [m]" not in columns)
        names.append((name, track.quaternion is not None))
        position = np.array(track.position, dtype=float)
        # no measured coordinate is exactly zero three times over
        nowhere = np.all(position == 0.0, axis=1)
        if nowhere.any():
            frames = "frame is" if nowhere.sum() == 1 else "frames are"
            remarks.append(
                Finding("warning", name, f"{int(nowhere.sum())} {frames} at exactly 0, 0, 0; left out")
            )
            position[nowhere] = np.nan
        columns |= dict(zip(position_titles(name, "m"), position.T, strict=True))
        if track.quaternion is not None:
            turned = np.where(nowhere[:, None], np.nan, track.quaternion)
            columns |= dict(zip(quaternion_titles(name), turned.T, strict=True))
    parts = [pd.DataFrame(columns)]
    # channels have rows of their own: cells of other rows are empty
    parts += [pd.DataFrame({TIME: at, **values}) for at, values in channels if values]
    table = (
        pd.concat(parts).sort_values(TIME, kind="stable", ignore_index=True) if len(parts) > 1 else parts[0]
    )
    oriented = [name for name, has_orientation in names if has_orientation]
    known = [name for name, _ in names if not name.rpartition(":")[2].lower().startswith(_UNKNOWN)]
    bodies = oriented or known or [name for name, _ in names]
    return Table({"source": source} if source else {}, table, tuple(remarks), tuple(bodies), up)


def quaternions_of(
    numbers: Float[np.ndarray, "n 3"], rotation: Callable[[np.ndarray], Rotation]
) -> Float[np.ndarray, "n 4"]:
    """Return the quaternions of rotations in other numbers; NaN in rows without all of these."""
    known = np.isfinite(numbers).all(axis=1)
    quaternion = np.full((len(numbers), 4), np.nan)
    quaternion[known] = rotation(numbers[known]).as_quat(scalar_first=True)
    return quaternion


def length_unit(word: str, default: str, findings: list[Finding]) -> float:
    """Return a unit of length in m; a finding states that the default is taken for a missing one.

    Raises:
        RecordingError: the unit is unknown.
    """
    if not word.strip():
        findings.append(
            Finding("warning", "", f"no unit of length is stated; positions are taken to be in {default}")
        )
        word = default
    if word.strip().lower() not in LENGTHS:
        raise RecordingError(f"the unit of length is {word.strip()!r}; allowed is m, cm, mm, in or ft")
    return LENGTHS[word.strip().lower()]


def text_lines(path: Path) -> list[str]:
    """Return the lines of a text file, whose names and units may be in the code page of Windows."""
    return content.lines_of(content.text_of(content.file_bytes(path, csv_rows.LARGEST_FILE), or_latin=True))


Columns = Callable[[Sequence[int]], Float[np.ndarray, "n places"]]


def cells_reader(lines: Sequence[str], titles: Sequence[str], delimiter: str) -> Columns:
    """Return a function from places to columns of numbers, NaN where a cell is empty.

    Raises:
        RecordingError: there are no rows, or one has more cells than titles; the function raises it for text.
    """
    from knode_cosserat.recordings.formats.csv_table import cells_of

    require_limit(len(titles), MOST_COLUMNS, "columns")
    rows = [line for line in lines if line.strip(f"{delimiter} \t")]
    if not rows:
        raise RecordingError("no rows after the header")
    # cells that are empty at the end of a line may be left out
    rows[0] += delimiter * (len(titles) - 1 - rows[0].count(delimiter))
    cells = cells_of("\n".join(rows), delimiter)
    titles = [*titles, *(f"column {k + 1}" for k in range(len(titles), cells.shape[1]))]
    table = numbers_of(cells.set_axis(titles[: cells.shape[1]], axis="columns"))
    return lambda places: columns_of(table, places)
