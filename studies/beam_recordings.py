"""Recordings of a clamped beam that is held by hand and released: CSV files of motion-capture markers.

The columns are `time_s` and `mK_x_m`, `mK_y_m`, `mK_z_m` for markers 0 to 5. Markers 0 to 2 are on the tip,
3 to 5 on the base. x points up; z points along the beam. The file's name states the load: `…load52…` for
52 g at the tip, `…gravity…` for none.
"""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import numpy as np
from jaxtyping import Float

from knode_cosserat._files import csv_rows
from knode_cosserat._files.reading import ReadError, read_bytes
from knode_cosserat.recordings.findings import RecordingError
from knode_cosserat.recordings.formats.csv_table import read_csv
from knode_cosserat.recordings.table import columns_of

#: markers on the tip, and on the base
TIP, BASE = (0, 1, 2), (3, 4, 5)
COLUMNS = ("time_s", *(f"m{k}_{axis}_m" for k in TIP + BASE for axis in "xyz"))
#: drop of the tip (m) that aligns the clocks of recording and prediction; the noise and the creep of the
#: hand before the release are both below 0.1 mm
THRESHOLD = 2e-3
#: rows before the threshold that may already belong to the fall or to the release by the hand
MARGIN = 10
#: the fewest rows of a held beam
FEWEST_HELD = 5
#: rows in which the tip must stay below the threshold: a glitch of one row is not a release
LASTING = 4


@dataclasses.dataclass(frozen=True)
class BeamRecording:
    """Marker trajectories of a beam, its load and its release time."""

    name: str
    #: (T,) s
    time: Float[np.ndarray, " T"]
    #: (T, 3 markers, 3) displacements (m) from the held positions; NaN where a marker is lost
    tip: Float[np.ndarray, "T 3 3"]
    #: (3 markers, 3) tip positions (m) while the beam was held
    held: Float[np.ndarray, "3 3"]
    #: (3 markers, 3) base positions (m) while the beam was held
    base: Float[np.ndarray, "3 3"]
    #: mass of the load (kg)
    load: float
    #: time at which the tip has dropped by `THRESHOLD` (s)
    crossing: float

    @property
    def drop(self) -> Float[np.ndarray, " T"]:
        """Drop of the tip from its held position (m), averaged over its markers."""
        return tip_drop(self.tip)


def tip_drop(moved: Float[np.ndarray, "T 3 3"]) -> Float[np.ndarray, " T"]:
    """Return the mean drop (m) of markers from their displacements; NaN where a marker is lost."""
    return -np.asarray(moved[:, :, 0].mean(axis=1))


def load_of(name: str) -> float:
    """Return the mass of the load (kg) stated by a file's name.

    Raises:
        RecordingError: the name states no load.
    """
    grams = re.search(r"load[_-]?(\d+(?:\.\d+)?)", name, re.IGNORECASE)
    if grams:
        return 1e-3 * float(grams.group(1))
    if "gravity" in name.lower():
        return 0.0
    raise RecordingError(
        f"{name}: the name tells no load; allowed is a name with load<grams>, such as beam_load52_a.csv, or "
        "with gravity (no load); or give the load of each such file by --load NAME=GRAMS"
    )


def read_beam(path: Path, load: float | None = None) -> BeamRecording:
    """Read a beam's recording.

    Args:
        path: the CSV file.
        load: mass at the tip (kg); None: taken from the file's name.

    Raises:
        RecordingError: the file is invalid, its load is unknown, or the beam is never released.
    """
    load = load_of(path.stem) if load is None else load
    try:
        table = read_csv(read_bytes(path, csv_rows.LARGEST_FILE), str(path)).numbers
    except ReadError as error:
        raise RecordingError(f"{path}: {error}") from None
    missing = [name for name in COLUMNS if name not in table.columns]
    if missing:
        raise RecordingError(
            f"{path}: the column {missing[0]} is missing; needed are time_s and mK_x_m, mK_y_m, mK_z_m "
            "of the markers 0 to 5"
        )
    titles = list(table.columns)
    values = columns_of(table, [titles.index(name) for name in COLUMNS], str(path))
    time, markers = values[:, 0], values[:, 1:].reshape(-1, len(TIP + BASE), 3)
    if not np.all(np.diff(time) > 0.0):
        raise RecordingError(f"{path}: time_s does not grow from row to row")
    crossing, first = find_release(time, markers[:, TIP], str(path))
    held = np.nanmedian(markers[:first], axis=0)
    if not np.all(np.isfinite(held)):
        lost = int(np.argwhere(~np.isfinite(held))[0, 0])
        raise RecordingError(f"{path}: marker {lost} is lost all the time before the beam is let go")
    tip = markers[:, TIP] - held[list(TIP)]
    return BeamRecording(path.stem, time, tip, held[list(TIP)], held[list(BASE)], load, crossing)


def find_release(
    time: Float[np.ndarray, " T"], tip: Float[np.ndarray, "T 3 3"], source: str
) -> tuple[float, int]:
    """Return the time at which the tip has dropped by `THRESHOLD` (s), and the number of held rows.

    The held level is the running median of the earlier rows. Slow creep of the hand and glitches are
    therefore not detected as a fall.

    Raises:
        RecordingError: the tip never drops lastingly by the threshold, or it is not held before.
    """
    # the median of the markers would jump where one is lost
    height = np.asarray(tip[:, :, 0].mean(axis=1))
    for row in range(MARGIN + FEWEST_HELD, len(height) - LASTING):
        level = (
            np.nanmedian(height[: row - MARGIN]) if np.any(np.isfinite(height[: row - MARGIN])) else np.nan
        )
        lasting = level - height[row : row + LASTING]
        if np.any(lasting > THRESHOLD) and not np.any(lasting <= THRESHOLD):
            break
    else:
        raise RecordingError(
            f"{source}: no release found: after at least {MARGIN + FEWEST_HELD} rows in which the beam is "
            f"held, the markers m0 to m2 have to drop by more than {1e3 * THRESHOLD:g} mm along x"
        )
    held = row - MARGIN
    drop = tip_drop(tip - np.nanmedian(tip[:held], axis=0))
    # rows in which every marker is seen, on both sides of the threshold
    seen = np.flatnonzero(np.isfinite(drop))
    after = next((k for k in seen if k >= held and drop[k] > THRESHOLD), None)
    before = seen[:0] if after is None else seen[seen < after]
    if after is None or not len(before):
        raise RecordingError(f"{source}: no release found: a marker of m0 to m2 is lost all the time")
    return float(np.interp(THRESHOLD, drop[[before[-1], after]], time[[before[-1], after]])), held
