"""Measurements on a common time grid, for training and comparison of models."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from jaxtyping import Bool, Float

from knode_cosserat._arguments import check_arguments
from knode_cosserat._files.writing import replacing
from knode_cosserat._numbers import real_array
from knode_cosserat._reprs import count_of, wrap_lines
from knode_cosserat.recordings.config import ControlSource, MarkerSource, RecordingConfig
from knode_cosserat.recordings.findings import RecordingError
from knode_cosserat.recordings.quantities import QUANTITIES, Quantity, counted_quantities
from knode_cosserat.recordings.streams import Body, ControlRows, Sensor
from knode_cosserat.recordings.table import HELD
from knode_cosserat.recordings.write import write_recording, writer_of
from knode_cosserat.solvers.initial import begins_unstressed
from knode_cosserat.solvers.places import places_at, positions_at, quaternions_at
from knode_cosserat.trajectory import Trajectory

if TYPE_CHECKING:
    from knode_cosserat.recordings.recording import Recording
    from knode_cosserat.rods.layout import Field, Layout
    from knode_cosserat.rods.system import System

#: time from row to row of recordings that models learn from (s)
DT = 0.0125


@dataclasses.dataclass(frozen=True, eq=False)
class Measurements:
    """Controls of a robot, such as tensions, and poses of M bodies, at T evenly spaced times.

    Positions are in the robot's frame: z up, origin at the clamped end. Rows in a gap of motion capture that
    is too long to be bridged are NaN; `parts` returns the pieces without such rows.
    """

    #: s, from the recording's start
    time: Float[np.ndarray, " T"]
    #: all controls of the system (SI units), held: row i drives the robot from row i to row i + 1, as
    #: `Trajectory.held_control`. They are in the order of the system's `control_layout`, unless `quantities`
    #: are stated: `controls_for` brings them to this order
    control: Float[np.ndarray, "T c"]
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
    #: controls before the first row: the mean over the preceding rest, if there is one; None: unknown
    initial_control: Float[np.ndarray, " c"] | None = None
    #: True for a simulation that begins with the unstressed robot; all other motions begin in equilibrium
    unstressed: bool = False
    #: True if each row is a separate equilibrium under its controls, not part of a motion
    static: bool = False
    #: True if the controls are samples of a continuous signal: row i's is then that at the time of row i + 1
    continuous: bool = False
    #: orientations, bending angles, curvatures or wrenches by other sensors, in the same rows
    sensors: tuple[Sensor, ...] = ()
    #: standard deviations of `fractions`, zero where they are known; others are identified
    deviations: tuple[float, ...] = ()
    #: quantities of the columns of `control`, each with the count of its columns; empty: not stated
    quantities: tuple[tuple[str, int], ...] = ()
    #: standard deviation of the time between controls and poses (s), zero if it is known; or it is identified
    clock_deviation: float = 0.0
    #: name and SHA-256 of the recording's files (`Recording.files`); empty for rows that were read from none
    files: tuple[tuple[str, str], ...] = ()

    def __repr__(self) -> str:
        times = f" from {self.time[0]:g} to {self.time[-1]:g} s" if len(self.time) else ""
        kind = "equilibria" if self.static else "rows"
        origin = {True: "simulated", False: "real", None: "origin not stated"}[self.simulated]
        places = ", ".join(f"{fraction:.4g}" for fraction in self.fractions) or "none"
        more = "".join(f"; {it.topic}" for it in self.sensors)
        return wrap_lines(
            f"Measurements ({origin}): {len(self.time)} {kind}{times}; "
            f"{self._named_controls}; "
            f"{count_of(len(self.fractions), 'body', 'bodies')} at {places} of the length{more}; "
            f"source: {self.source}"
        )

    @property
    def _named_controls(self) -> str:
        if self.quantities:
            return counted_quantities(self.quantities)
        return count_of(self.control.shape[-1], "control")

    @classmethod
    def of(
        cls, data: Trajectory | Recording | Measurements, fractions: Sequence[float] | None = None
    ) -> Self:
        """Return noise-free measurements of a trajectory, or the rows of a recording that models learn from.

        Args:
            data: a whole trajectory, or consecutive rows, of one system with positions; or a recording: rows
                of 0.0125 s with mean controls. Measurements are returned as they are.
            fractions: for a trajectory: places of the bodies, as fractions of the rod's length, from base to
                tip; by default the tip. A recording has its own.

        Raises:
            ValueError: the trajectory is a batch, its rows are further apart than the time steps, or its
                system has no positions; or fractions of a recording.
        """
        check_arguments(Measurements.of, locals())
        if not isinstance(data, Trajectory):
            if fractions is not None:
                raise ValueError("fractions are of trajectories; the bodies of a recording have their own")
            rows: Any = data if isinstance(data, Measurements) else data.sampled(DT, mean=True)
            return rows
        trajectory = data
        y, system = np.asarray(trajectory.y), trajectory.system
        if y.ndim == 4:
            raise ValueError("a batch of trajectories; allowed is one, such as `batch[0]`")
        held, initial = np.array(trajectory.held_control), np.asarray(trajectory.control)[0]
        # the last row has no following control; without a value it would not count as complete
        held[-1] = held[-2] if len(held) > 1 else initial
        along = real_array((1.0,) if fractions is None else fractions)
        if along.ndim != 1 or not np.all((along >= 0.0) & (along <= 1.0)):
            raise ValueError(f"fractions is {fractions!r}; allowed is a list of fractions from 0 to 1")
        places = places_at(along, system.nodes)
        try:
            position = np.asarray(positions_at(system, y, places, np.asarray(trajectory.z)))
        except AttributeError:
            raise ValueError(f"a {type(system).__name__} has no positions; nothing is measured") from None
        try:
            quaternion = np.asarray(quaternions_at(system, y, places))
        except AttributeError:
            # the system has no orientations
            quaternion = np.full((*position.shape[:2], 4), np.nan)
        return cls(
            time=np.asarray(trajectory.time, dtype=float),
            control=held,
            fractions=along,
            position=position,
            quaternion=quaternion,
            measured=np.isfinite(position).all(axis=-1),
            simulated=True,
            source=f"simulated {type(system).__name__}",
            initial_control=initial,
            unstressed=begins_unstressed(trajectory),
            quantities=_quantities_of(system.control_layout),
        )

    def save(self, path: str | Path) -> None:
        """Write a table or a bag (.csv, .parquet, .bag, .mcap, .db3), with controls held to the next row.

        A table's titles state everything: `load_recording(path).sampled(measurements.dt)` gives the same
        rows. Beside a bag its configuration is written, with the suffix .yaml, for
        `load_recording(path, config)`. Planar positions are written as x and z. Bridged poses are not
        written. Bodies are named `tip` and `body_1`, `body_2` and so on.

        Raises:
            RecordingError: the name's ending is not one of a format that is written, the quantities of the
                controls are not known, or a file cannot be written.
            ImportError: a library for this format is not installed.
        """
        path = Path(path)
        writer_of(path)
        if self.sensors:
            raise RecordingError(f"{path}: {self.sensors[0].topic} cannot be written; only poses can")
        is_table = path.suffix in (".csv", ".parquet")
        root = "" if is_table else "/"
        position = self.position
        if position.shape[-1] == 2:
            position = np.stack([position[..., 0], np.zeros(position.shape[:-1]), position[..., 1]], axis=-1)
        names = ["tip" if place == 1.0 else f"body_{k + 1}" for k, place in enumerate(self.fractions)]
        poses = {}
        for k, name in enumerate(names):
            rows = self.measured[:, k]
            oriented = bool(np.isfinite(self.quaternion[rows, k]).any())
            quaternion = self.quaternion[rows, k] if oriented else None
            poses[name] = Body(self.time[rows], position[rows, k], quaternion)
        columns = self._columns(path)
        order = [k for places in columns.values() for k in places]
        initial = self.initial_control
        config = RecordingConfig(
            markers=tuple(
                MarkerSource(name, root + name, float(place), rotation=(1.0, 0.0, 0.0, 0.0))
                for name, place in zip(names, self.fractions, strict=True)
            ),
            controls="measured" if columns else "none",
            simulated=self.simulated,
            description=self.source,
            initial_control=None if initial is None or not columns else tuple(initial[order].tolist()),
            **{  # type: ignore[arg-type]
                name: ControlSource(f"{root}{HELD}{name}", tuple(range(1, len(places) + 1)), held=True)
                for name, places in columns.items()
            },
        )
        control = ControlRows(self.time, self.control[:, order]) if columns else None
        if is_table:
            write_recording(path, config, poses, control)
            return
        # the configuration takes its name last: neither file is changed if the bag cannot be written
        try:
            with replacing(path.with_suffix(".yaml")) as beside:
                config.save(beside)
                write_recording(path, config, poses, control)
        except OSError as error:
            raise RecordingError(f"{path}: cannot be written: {error.strerror}") from None

    def _columns(self, path: Path) -> dict[str, list[int]]:
        """Return the places of each quantity's columns, in the order of `QUANTITIES`."""
        count = self.control.shape[1]
        if not count:
            return {}
        # a robot's own controls without stated quantities are tensions, as those of most robots
        stated = self.quantities or (("tension", count),)
        names = [name for name, number in stated for _ in range(number)]
        unknown = next((name for name in names if name not in QUANTITIES), None)
        if unknown is not None or len(names) != count:
            raise RecordingError(
                f"{path}: {counted_quantities(stated)} cannot be written; allowed are the {count} columns of "
                f"control, of {', '.join(QUANTITIES)}"
            )
        return {
            name: [k for k, each in enumerate(names) if each == name] for name in QUANTITIES if name in names
        }

    def controls_for(self, system: System) -> Self:
        """Return the measurements with the controls in the order of a system's `control_layout`.

        Columns of a quantity are matched with the system's controls of the same unit, in order; where several
        quantities have a unit, with those of its name. Controls whose quantities are not stated are returned
        as they are.

        Raises:
            RecordingError: the system has other controls.
        """
        layout = system.control_layout
        if not self.quantities:
            if self.control.shape[1] != layout.size:
                raise self._other_controls(system, f"{self.control.shape[1]} controls")
            return self
        names = [name for name, number in self.quantities for _ in range(number)]
        wanted = [_measured_as(field, names) for field in layout.fields for _ in range(field.size)]
        if sorted(names) != sorted(wanted):
            raise self._other_controls(system, counted_quantities(self.quantities))
        places = {name: iter([k for k, each in enumerate(names) if each == name]) for name in names}
        order = [next(places[name]) for name in wanted]
        initial = None if self.initial_control is None else self.initial_control[order]
        return dataclasses.replace(
            self,
            control=self.control[:, order],
            initial_control=initial,
            quantities=tuple((name, 1) for name in wanted),
        )

    def _other_controls(self, system: System, there: str) -> RecordingError:
        names = [
            (_measured_as(field, ()) or field.name, field.size) for field in system.control_layout.fields
        ]
        hint = ""
        if any(name == "current" for name, _ in self.quantities):
            hint = "; `gain` of the current (N/A) makes tensions of it"
        return RecordingError(
            f"{self.source}: the robot has the controls {counted_quantities(names)}; the recording has "
            f"{there}{hint}"
        )

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
        """Mask of the rows with controls and the positions of all bodies."""
        known = np.isfinite(self.control).all(axis=1) & np.isfinite(self.position).all(axis=(1, 2))
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
        names = ("time", "control", "position", "quaternion", "measured")
        changes: dict[str, Any] = {name: getattr(self, name)[first:last] for name in names}
        changes["sensors"] = tuple(
            dataclasses.replace(it, time=it.time[first:last], values=it.values[first:last])
            for it in self.sensors
        )
        if first:
            changes |= {"initial_control": None, "unstressed": False}
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


def _measured_as(field: Field, there: Collection[str]) -> str:
    """Return the quantity that measures a control, among those that are there; empty without one.

    Names of controls may have a prefix (of an assembly's rod) and a number, such as rod_a_rotation_2.
    """
    alike = [quantity for quantity in QUANTITIES.values() if quantity.unit == field.unit]
    alike = [quantity for quantity in alike if not there or quantity.name in there]
    stem = re.sub(r"_\d+$", "", field.name)

    def is_named(quantity: Quantity) -> bool:
        return any(stem == name or stem.endswith(f"_{name}") for name in quantity.controls)

    return next((it.name for it in sorted(alike, key=is_named, reverse=True)), "")


def _quantities_of(layout: Layout) -> tuple[tuple[str, int], ...]:
    """Return the quantities of a system's controls; empty if one of them is of no known quantity."""
    found = tuple((_measured_as(field, ()), field.size) for field in layout.fields)
    return found if all(name for name, _ in found) else ()
