"""Measurements on a common time grid, for training and comparison of models."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from jaxtyping import Bool, Float

from knode_cosserat._reprs import count_of, wrapped
from knode_cosserat.recordings.findings import RecordingError

if TYPE_CHECKING:
    from knode_cosserat.trajectory import Trajectory


@dataclasses.dataclass(frozen=True, eq=False)
class Measurements:
    """Tensions or motor angles, and poses of M bodies, at T evenly spaced times.

    Positions are in the robot's frame: z up, origin at the clamped end. Rows in a gap of motion capture that
    is too long to be bridged are NaN; `parts` returns the pieces without such rows.
    """

    #: s, from the recording's start
    time: Float[np.ndarray, " T"]
    #: tensions (N), held: row i drives the robot from row i to row i + 1 (`held_tension`). For a robot with
    #: motor-driven tendons: the motor angles (rad) or the wound-up lengths (m). For any other system without
    #: tensions: its controls
    tension: Float[np.ndarray, "T tendons"]
    #: places of the bodies, as fractions of the rod's length, from base to tip
    fractions: Float[np.ndarray, " M"]
    #: positions of the bodies (m); of a planar system, two numbers each
    position: Float[np.ndarray, "T M d"]
    #: orientation of the rod's local frame, scalar first; NaN for bodies or systems without orientation
    quaternion: Float[np.ndarray, "T M 4"]
    #: False where a pose is interpolated across a gap
    measured: Bool[np.ndarray, "T M"]
    #: True if the robot was itself a simulation; None: not stated
    simulated: bool | None
    #: description and origin of the recording
    source: str
    #: tensions before the first row (N): the mean over the preceding rest, if there is one; None: unknown
    initial_tension: Float[np.ndarray, " tendons"] | None = None
    #: True if each row is a separate equilibrium under its tensions, not part of a motion
    static: bool = False
    #: True if the tensions are samples of a continuous signal: row i's is then that at the time of row i + 1
    continuous: bool = False

    def __repr__(self) -> str:
        times = f" from {self.time[0]:g} to {self.time[-1]:g} s" if len(self.time) else ""
        kind = "equilibria" if self.static else "rows"
        origin = {True: "simulated", False: "real", None: "origin not stated"}[self.simulated]
        places = ", ".join(f"{each:.4g}" for each in self.fractions)
        return wrapped(
            f"Measurements ({origin}): {len(self.time)} {kind}{times}; "
            f"{count_of(self.tension.shape[-1], 'tendon')}; "
            f"{count_of(len(self.fractions), 'body', 'bodies')} at {places} of the length; "
            f"source: {self.source}"
        )

    @classmethod
    def of(cls, trajectory: Trajectory, fractions: Sequence[float] = (1.0,)) -> Self:
        """Return noise-free measurements of a trajectory of one robot.

        Args:
            trajectory: a whole trajectory, or consecutive rows, of a system with positions.
            fractions: places of the bodies, as fractions of the rod's length, from base to tip.

        Raises:
            AttributeError: the system has no positions.
            ValueError: the trajectory is a batch, or its rows are further apart than the time steps.
        """
        from knode_cosserat.recordings.exchange import measurement_fields

        return cls(**measurement_fields(trajectory, fractions))

    def save(self, path: str | Path) -> None:
        """Write a table or a bag (.csv, .parquet, .bag, .mcap, .db3); see `exchange.save`."""
        from knode_cosserat.recordings.exchange import save

        save(self, path)

    @property
    def held_tension(self) -> Float[np.ndarray, "T tendons"]:
        """`tension` (N), held from row i to row i + 1, as `Trajectory.held_tension`."""
        return self.tension

    @property
    def tip_position(self) -> Float[np.ndarray, "T d"]:
        """Positions of the last body (m)."""
        return self.position[:, -1]

    @property
    def dt(self) -> float:
        """Time from row to row (s). Raises `RecordingError` if there are fewer than two rows."""
        if len(self.time) < 2:
            raise RecordingError(f"{self.source}: one row has no time step")
        dt = float(self.time[-1] - self.time[0]) / (len(self.time) - 1)
        return float(f"{dt:.9g}")  # times in a file are rounded

    @property
    def complete(self) -> Bool[np.ndarray, " T"]:
        """Mask of the rows with tensions and the positions of all bodies."""
        known = np.isfinite(self.tension).all(axis=1) & np.isfinite(self.position).all(axis=(1, 2))
        return np.asarray(known)

    def between(self, start: float, end: float) -> Self:
        """Return the rows from time `start` (s) to before time `end`. Raises `RecordingError` if none."""
        first, last = np.searchsorted(self.time, np.array([start, end]) - 1e-9)
        if first >= last:
            there = f"from {self.time[0]:g} to {self.time[-1]:g} s" if len(self.time) else "none at all"
            raise RecordingError(
                f"{self.source}: no rows from {start:g} to {end:g} s; there are rows {there}"
            )
        return self.rows(int(first), int(last))

    def rows(self, first: int, last: int) -> Self:
        """Return the rows from index `first` to before index `last`."""
        names = ("time", "tension", "position", "quaternion", "measured")
        changes: dict[str, Any] = {name: getattr(self, name)[first:last] for name in names}
        if first:
            changes["initial_tension"] = None
        return dataclasses.replace(self, **changes)

    def parts(self, shortest: float = 0.0) -> list[Self]:
        """Return the longest pieces with complete rows only.

        Args:
            shortest: shorter pieces are left out (s); a piece has at least two rows.
        """
        known = np.concatenate([[False], self.complete, [False]])
        ends = np.flatnonzero(known[1:] != known[:-1]).reshape(-1, 2)
        pieces = [self.rows(int(first), int(last)) for first, last in ends if last - first >= 2]
        return [piece for piece in pieces if piece.time[-1] - piece.time[0] >= shortest - 1e-9]
