"""What was measured, row by row at the same times: what models are compared with and learn from."""

from __future__ import annotations

import dataclasses
from typing import Self

import numpy as np
from jaxtyping import Bool, Float

from knode_cosserat.recordings.findings import RecordingError


@dataclasses.dataclass(frozen=True, eq=False)
class Measurements:
    """Tensions and poses of M bodies at T evenly spaced times.

    In the robot's frame: z up, origin at the clamped end. Where motion capture saw nothing for longer than
    can be bridged, rows are NaN; `parts` gives the pieces without such rows.
    """

    #: s, from the recording's start
    time: Float[np.ndarray, " T"]
    #: N, each row held until the next: row i drives the robot from row i to row i + 1
    tension: Float[np.ndarray, "T tendons"]
    #: where the bodies sit on the rod, as fractions of its length, from base to tip
    fractions: Float[np.ndarray, " M"]
    #: m
    position: Float[np.ndarray, "T M 3"]
    #: of the rod's frame there, scalar first; NaN for bodies without orientation
    quaternion: Float[np.ndarray, "T M 4"]
    #: False where a pose is bridged from what was seen before and after
    measured: Bool[np.ndarray, "T M"]
    #: whether the robot was itself a simulation; None: not stated
    simulated: bool | None
    #: what the recording is and where it comes from
    source: str

    @property
    def tip_position(self) -> Float[np.ndarray, "T 3"]:
        """Positions of the last body (m)."""
        return self.position[:, -1]

    @property
    def dt(self) -> float:
        """Time from row to row (s). Raises `RecordingError` if there is but one row."""
        if len(self.time) < 2:
            raise RecordingError(f"{self.source}: one row has no time step")
        dt = float(self.time[-1] - self.time[0]) / (len(self.time) - 1)
        return float(f"{dt:.9g}")  # times in a file are rounded

    @property
    def complete(self) -> Bool[np.ndarray, " T"]:
        """Which rows have tensions and the positions of all bodies."""
        known = np.isfinite(self.tension).all(axis=1) & np.isfinite(self.position).all(axis=(1, 2))
        return np.asarray(known)

    def between(self, start: float, end: float) -> Self:
        """The rows from time `start` (s) on, before time `end`. Raises `RecordingError` if there are none."""
        first, last = np.searchsorted(self.time, np.array([start, end]) - 1e-9)
        if first >= last:
            there = f"from {self.time[0]:g} to {self.time[-1]:g} s" if len(self.time) else "none at all"
            raise RecordingError(
                f"{self.source}: no rows from {start:g} to {end:g} s; there are rows {there}"
            )
        return self.rows(int(first), int(last))

    def rows(self, first: int, last: int) -> Self:
        """The rows from number `first` on, before number `last`."""
        names = ("time", "tension", "position", "quaternion", "measured")
        return dataclasses.replace(self, **{name: getattr(self, name)[first:last] for name in names})

    def parts(self, shortest: float = 0.0) -> list[Self]:
        """The longest pieces without a row that is not complete.

        Args:
            shortest: pieces that take less time are left out (s); a piece has two rows at least.
        """
        known = np.concatenate([[False], self.complete, [False]])
        ends = np.flatnonzero(known[1:] != known[:-1]).reshape(-1, 2)
        pieces = [self.rows(int(first), int(last)) for first, last in ends if last - first >= 2]
        return [piece for piece in pieces if piece.time[-1] - piece.time[0] >= shortest - 1e-9]
