"""Recordings as tables of tensions and tip positions, and the one that comes with the package.

A CSV file, UTF-8, with comments before its header:

    # source: what the recording is and where it comes from
    # simulated: true
    time [s],tension_1 [N],tension_2 [N],…,tip_x [m],tip_y [m],tip_z [m]

`simulated: true` says that the robot was itself a simulation, a stand-in for a physical one.
"""

from __future__ import annotations

import dataclasses
import importlib.resources
import io
from pathlib import Path

import numpy as np
import pandas as pd  # type: ignore[import-untyped]
from jaxtyping import Float

TIME = "time [s]"
TIP = ("tip_x [m]", "tip_y [m]", "tip_z [m]")
ALLOWED = f"{TIME}, tension_1 [N], tension_2 [N], …, {', '.join(TIP)}"
#: where the package's own recording is
EXAMPLE = "sine_1p0.csv"


class RecordingError(ValueError):
    """A recording that cannot be read or used; the message is one line that says why."""


@dataclasses.dataclass(frozen=True)
class TipRecording:
    """Measured tensions and tip positions, row by row at the same times."""

    #: s
    time: Float[np.ndarray, " T"]
    #: N, each row held until the next: row i drives the robot from row i to row i + 1
    tension: Float[np.ndarray, "T tendons"]
    #: m, in the robot's frame: z up, origin at the clamped end
    tip_position: Float[np.ndarray, "T 3"]
    #: whether the robot was itself a simulation
    simulated: bool
    #: what the recording is and where it comes from
    source: str

    @property
    def dt(self) -> float:
        """Time from row to row (s). Raises `RecordingError` if it varies."""
        steps = np.diff(self.time)
        if len(steps) == 0:
            raise RecordingError(f"{self.source}: one row has no time step")
        dt = float(self.time[-1] - self.time[0]) / len(steps)
        if np.ptp(steps) > 1e-3 * dt:
            raise RecordingError(
                f"{self.source}: the time step varies from {steps.min():g} to {steps.max():g} s"
            )
        return float(f"{dt:.9g}")  # times in a file are rounded

    def between(self, start: float, end: float) -> TipRecording:
        """The rows from time `start` (s) on, before time `end`."""
        first, last = np.searchsorted(self.time, np.array([start, end]) - 1e-9)
        if first == last:
            raise RecordingError(
                f"{self.source}: no rows from {start:g} to {end:g} s; "
                f"there are rows from {self.time[0]:g} to {self.time[-1]:g} s"
            )
        parts = {name: getattr(self, name)[first:last] for name in ("time", "tension", "tip_position")}
        return dataclasses.replace(self, **parts)


def load_example() -> TipRecording:
    """The recording that comes with the package: tensions on sines of 1 s, 16 s long, 20 rows a second.

    The robot was a stand-in for the paper's, simulated with PyElastica, and not a physical one.
    """
    file = importlib.resources.files("knode_cosserat.recordings") / "data" / EXAMPLE
    return _parsed(file.read_text(encoding="utf-8"), EXAMPLE)


def load_table(path: str | Path) -> TipRecording:
    """Read a recording from a CSV file (see above); what its comments leave out is `path` and not simulated.

    Raises:
        RecordingError: the file cannot be read, or a column, unit or number is not right.
    """
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise RecordingError(f"{path}: no such file") from None
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise RecordingError(f"{path}: not a CSV text file: it is not UTF-8") from None
    return _parsed(text, str(path))


def _parsed(text: str, path: str) -> TipRecording:
    said = _comments(text, path)
    table = _table(text, path)
    tensions = _tension_columns(list(table.columns), path)
    numbers = _numbers(table[[TIME, *tensions, *TIP]], path)
    time = numbers[:, 0]
    backwards = np.diff(time) <= 0.0
    if backwards.any():
        row = int(np.argmax(backwards)) + 1
        raise RecordingError(
            f"{path}: row {row + 1}: time is {time[row]:g} s; allowed is one after {time[row - 1]:g} s"
        )
    return TipRecording(
        time=time,
        tension=numbers[:, 1:-3],
        tip_position=numbers[:, -3:],
        simulated=said.get("simulated") == "true",
        source=said.get("source", path),
    )


def _comments(text: str, path: str) -> dict[str, str]:
    """What the lines `# key: value` before the header say."""
    said = {}
    for line in text.splitlines():
        if not line.startswith("#"):
            break
        key, colon, value = line.removeprefix("#").partition(":")
        if colon:
            said[key.strip()] = value.strip()
    if said.get("simulated", "false") not in ("true", "false"):
        raise RecordingError(f"{path}: simulated is {said['simulated']!r}; allowed is true or false")
    return said


def _table(text: str, path: str) -> pd.DataFrame:
    """The cells as text, under the header's titles."""
    try:
        cells = pd.read_csv(io.StringIO(text), comment="#", header=None, dtype=str, skipinitialspace=True)
    except pd.errors.EmptyDataError:
        raise RecordingError(f"{path}: the file is empty; allowed is a header {ALLOWED}") from None
    except pd.errors.ParserError as error:
        reason = str(error).strip().splitlines()[-1]
        raise RecordingError(f"{path}: not a CSV table: {reason}") from None
    table = cells.iloc[1:].set_axis(cells.iloc[0].fillna("").str.strip(), axis="columns")
    if table.empty:
        raise RecordingError(f"{path}: no rows after the header")
    return table


def _tension_columns(columns: list[str], path: str) -> list[str]:
    """The titles of the tensions in the order of the tendons, once all columns are known to be right."""
    others = [name for name in columns if name not in (TIME, *TIP)]
    tensions = [f"tension_{k} [N]" for k in range(1, max(1, len(others)) + 1)]
    for wanted in (TIME, *tensions, *TIP):
        if columns.count(wanted) != 1:
            raise RecordingError(
                f"{path}: the columns are {', '.join(columns)}; allowed is {ALLOWED}, once each"
            )
    return tensions


def _numbers(table: pd.DataFrame, path: str) -> Float[np.ndarray, "rows columns"]:
    numbers = table.apply(pd.to_numeric, errors="coerce").to_numpy(dtype=float)
    if not np.all(np.isfinite(numbers)):
        row, column = np.argwhere(~np.isfinite(numbers))[0]
        given = table.iat[row, column]
        shown = "empty" if pd.isna(given) else repr(given)
        raise RecordingError(
            f"{path}: row {row + 1}: {table.columns[column]} is {shown}; allowed is a finite number"
        )
    return numbers
