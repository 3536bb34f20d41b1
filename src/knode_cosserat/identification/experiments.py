"""Experiments: how a robot starts, its controls, and the data in each row, from any kind of input."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from knode_cosserat.estimation.outputs import BodyMotions, BodyPositions, Output, Several, States
from knode_cosserat.estimation.parameters import ParameterModel
from knode_cosserat.identification.steps import is_resolved, steps_per_row, time_scheme
from knode_cosserat.recordings.findings import RecordingError
from knode_cosserat.recordings.measurements import Measurements
from knode_cosserat.recordings.recording import Recording
from knode_cosserat.rods.aspects import Drawing
from knode_cosserat.rods.system import System
from knode_cosserat.schemes.settings import NewtonOptions, Settings
from knode_cosserat.schemes.space import LOBATTO2, SpaceScheme
from knode_cosserat.solvers.initial import begins_unstressed
from knode_cosserat.solvers.segments import DataError
from knode_cosserat.trajectory import Trajectory

#: a rotation counts as the displacement at this part of the length
ARM = 0.2
#: parts of one recording of equilibria, the fewest rows of each, and blocks of consecutive rows in each
PARTS, FEWEST, BLOCKS = 5, 6, 4


@dataclasses.dataclass(frozen=True, eq=False)
class Experiment:
    """One motion, or list of equilibria, of a robot: controls, start and data.

    Attributes:
        dt: time from row to row (s).
        control: from each row to the next (T, c).
        output: kind of the data, with the noise of its errors.
        data: values of the output (T + 1, p); NaN where nothing was measured.
        held: control of the equilibrium from which it starts (c,); by default it is zero.
        initial: "equilibrium"; "unstressed"; or rows from which it continues, states without noise.
        settings: of the simulation.
        name: for messages.
        moves: the first row in motion.
        static: true if each row is a separate equilibrium.
        continuous: true if controls are samples of a continuous signal.
        steps: time steps from row to row.
        readings: true if controls are what load cells read, with their latency.
        accurate: the same with an accurate scheme and steps; its differences count, and this experiment's
            are for derivatives only.
    """

    dt: float
    control: Float[np.ndarray, "T c"]
    output: Output
    data: Float[np.ndarray, "T+1 p"]
    held: Float[np.ndarray, " c"] | None = None
    initial: Trajectory | Literal["equilibrium", "unstressed"] = "equilibrium"
    settings: Settings = Settings()
    name: str = "experiment"
    moves: int = 0
    static: bool = False
    continuous: bool = False
    steps: int = 1
    readings: bool = False
    accurate: Experiment | None = None

    def __post_init__(self) -> None:
        if self.held is None and isinstance(self.initial, str) and self.initial == "equilibrium":
            object.__setattr__(self, "held", np.zeros(np.shape(self.control)[-1]))

    @functools.cached_property
    def fields(self) -> tuple[str, ...]:
        """Names of the data's fields; each has its own size of differences."""
        return tuple(dict.fromkeys(self.output.fields))

    @functools.cached_property
    def groups(self) -> np.ndarray:
        """Index in `fields` of every number of an error."""
        if len(self.fields) == 1:
            return np.zeros(len(self.noise), dtype=int)
        return np.array([self.fields.index(name) for name in self.output.fields])

    @functools.cached_property
    def noise(self) -> Float[np.ndarray, " e"]:
        """Unit of every number of an error."""
        if type(self.output) is BodyPositions:  # of two or three coordinates
            return np.full(self.data.shape[1], self.output.sigma)
        return self.output.noise

    def positions(self, rows: Float[np.ndarray, "rows w"]) -> Float[np.ndarray, "rows M d"] | None:
        """Return the positions in rows of data, or their errors in rows of errors; None: there are none."""
        outputs: tuple[Any, ...] = getattr(self.output, "outputs", (self.output,))
        output, *others = outputs
        if isinstance(output, States):
            where = np.flatnonzero([label == "p" for label in output.labels])
            return rows[:, where].reshape(len(rows), output.nodes, -1) if len(where) else None
        if not output.labels[0].startswith("position"):
            return None
        errors = rows.shape[1] == len(self.noise)
        width = rows.shape[1] - sum(len(it.noise) if errors else it.size for it in others)
        return rows[:, :width].reshape(len(rows), len(output.fractions), -1)[..., :3]

    @property
    def places(self) -> tuple[float, ...]:
        """Places of the bodies of `positions`, as parts of the length; none of nodes."""
        outputs: tuple[Any, ...] = getattr(self.output, "outputs", (self.output,))
        return tuple(getattr(outputs[0], "fractions", ()))

    @property
    def is_resolved(self) -> bool:
        """True if time steps follow a continuous signal, so that shorter ones are nearer to the robot."""
        return not self.static and is_resolved(self.dt, self.continuous)

    def rough(self) -> Experiment:
        """Return it with the cheaper scheme along the rod and one step from row to row, for derivatives.

        Equilibria are as quick with their own scheme.
        """
        if self.static:
            return self
        settings = dataclasses.replace(self.settings, space=LOBATTO2)
        return self.replace(settings=settings, steps=1, accurate=self)

    def replace(self, **changes: Any) -> Experiment:
        """Return a copy with changed attributes."""
        return dataclasses.replace(self, **changes)

    def padded(self, rows: int) -> Experiment:
        """Return it with so many controls, the last one held and nothing measured."""
        more = rows - len(self.control)
        return self.replace(
            control=np.concatenate([self.control, np.repeat(self.control[-1:], more, axis=0)]),
            data=np.pad(self.data, ((0, more), (0, 0)), constant_values=np.nan),
        )


def listed_rows(data: Any) -> list[Measurements | Trajectory | Experiment]:
    """Return data in a list, recordings as rows with mean tensions.

    Raises:
        DataError: anything else, or time steps of recordings that differ.
    """
    if isinstance(data, str | Recording | Measurements | Trajectory | Experiment) or not isinstance(
        data, Sequence
    ):
        raise DataError(f"data is a {type(data).__name__}; allowed is a list of recordings or trajectories")
    if not data:
        raise DataError("there are no recordings and no trajectories")
    rows = [Measurements.of(it) if isinstance(it, Recording) else it for it in data]
    for it in rows:
        if not isinstance(it, Measurements | Trajectory | Experiment):
            raise DataError(
                f"data holds a {type(it).__name__}; allowed is what load_recording returns, its "
                "sampled(0.0125, mean=True), or a Trajectory"
            )
    steps = sorted({it.dt for it in rows if isinstance(it, Measurements)}) or [0.0]
    if steps[-1] - steps[0] > 1e-9:
        raise DataError(f"time steps differ: {', '.join(f'{dt:g}' for dt in steps)} s; allowed is one")
    return rows


def measured_rows(data: Any) -> list[Measurements]:
    """Return the rows of recordings; `DataError` for anything else."""
    rows = listed_rows(data)
    for it in rows:
        if not isinstance(it, Measurements):
            raise DataError(
                f"data holds a {type(it).__name__}; effects need recordings, or Measurements.of; "
                "name parameters to identify them from trajectories"
            )
    return rows  # type: ignore[return-value]


def in_parts(rows: list[Measurements]) -> list[Measurements]:
    """Return one recording of many equilibria in parts, which are held out in turn; others as they are.

    Each part is made of short blocks of consecutive rows all along the recording, so that neighbours, which
    may be alike, are mostly held out together.
    """
    if len(rows) != 1 or not rows[0].static or len(rows[0].time) < PARTS * FEWEST:
        return rows
    (whole,) = rows
    block = max(1, len(whole.time) // (PARTS * BLOCKS))
    part_of = np.arange(len(whole.time)) // block % PARTS
    name, _, more = whole.source.partition(":")
    parts = []
    for k in range(PARTS):
        on = part_of == k
        source = f"{name}, part {k + 1} of {PARTS}" + (f":{more}" if more else "")
        sensors = tuple(
            dataclasses.replace(it, time=it.time[on], values=it.values[on]) for it in whole.sensors
        )
        arrays: dict[str, Any] = {
            it: getattr(whole, it)[on] for it in ("control", "position", "quaternion", "measured")
        }
        # rows of equilibria are evenly spaced by name only
        time = whole.time[: int(on.sum())]
        parts.append(dataclasses.replace(whole, time=time, sensors=sensors, source=source, **arrays))
    return parts


def experiments_of(
    rows: Sequence[Measurements | Trajectory | Experiment],
    model: ParameterModel,
    space: str | SpaceScheme = "lobatto4",
) -> list[Experiment]:
    """Return the experiments of measurements, trajectories or experiments.

    Those of measurements have one length, so that they share compiled programs.

    Raises:
        DataError: data that do not fit the robot, are too short or not finite.
    """
    names = iter(names_of([it for it in rows if isinstance(it, Measurements)]))
    experiments = [
        it
        if isinstance(it, Experiment)
        else of_measurements(it, model, next(names), space)
        if isinstance(it, Measurements)
        else of_trajectory(it, model.nominal, f"trajectory {k}")
        for k, it in enumerate(rows)
    ]
    if not all(isinstance(it, Measurements) for it in rows):
        return experiments
    longest = max(len(it.control) for it in experiments)
    return [it.padded(longest) for it in experiments]


def names_of(measured: Sequence[Measurements]) -> list[str]:
    """Return a name for each recording: the start of its source, numbered if several are alike."""
    names = [it.source.partition(":")[0].rpartition("/")[2] for it in measured]
    return [f"{name} ({k + 1})" if names.count(name) > 1 else name for k, name in enumerate(names)]


def of_measurements(
    measured: Measurements,
    model: ParameterModel,
    name: str = "recording",
    space: str | SpaceScheme = "lobatto4",
) -> Experiment:
    """Return the experiment of measurements, which start in the equilibrium before row 0.

    Those of simulations may have started unstressed (`Measurements.unstressed`).

    Raises:
        DataError: too short, unknown controls, nothing seen, or controls of another robot.
    """
    robot = model.nominal
    if len(measured.time) < 3:
        raise DataError(f"{name}: {len(measured.time)} rows; at least 3 are needed")
    try:
        measured = measured.controls_for(robot)
    except RecordingError as error:
        raise DataError(str(error)) from None
    if measured.static:
        measured = _as_steps(measured)
    if not np.all(np.isfinite(measured.control[:-1])):
        row = int(np.flatnonzero(~np.isfinite(measured.control).all(axis=1))[0])
        raise DataError(
            f"{name}: no control is known at {measured.time[row]:g} s; use the part before (`parts`)"
        )
    seen = [measured.position, measured.quaternion, *(it.values for it in measured.sensors)]
    if not any(np.any(np.isfinite(rows[1:])) for rows in seen):
        raise DataError(f"{name}: nothing was measured after the first row")
    control = measured.control[:-1]
    held = np.asarray(control[0] if measured.initial_control is None else measured.initial_control)
    swing = np.max(np.abs(control - held), axis=1, initial=0.0)  # a robot may have no controls
    moving = np.flatnonzero(swing > 0.05 * max(np.max(swing), 1e-12))
    scheme = time_scheme(measured.dt, measured.continuous)
    settings = dataclasses.replace(Settings.of(None, space, "paper", NewtonOptions()), time=scheme)
    output, data = _measured(measured, robot)
    if measured.unstressed:
        data[0] = np.nan
    return Experiment(
        measured.dt,
        control,
        output,
        data,
        None if measured.unstressed else held,
        "unstressed" if measured.unstressed else "equilibrium",
        settings,
        name,
        int(moving[0]) if len(moving) and not measured.static else 0,
        measured.static,
        measured.continuous,
        steps_per_row(measured.dt, measured.continuous),
        True,
    )


def _measured(measured: Measurements, robot: System) -> tuple[Output, np.ndarray]:
    """Return everything that was measured, as numbers in rows.

    These are positions, rotations if the robot has orientations, and values of other sensors. A rotation
    counts as a displacement of a part of the length, a usual value of another sensor as the length.
    """
    rows, length = len(measured.position), float(np.asarray(robot.length))
    outputs, data = list[Output](), list[np.ndarray]()
    if len(measured.fractions):
        fractions = tuple(np.clip(measured.fractions, 0.0, 1.0).tolist())
        try:
            Drawing.of(robot).quaternions(np.asarray(robot.rest(0.0)[0]))
        except AttributeError:
            if measured.sensors:
                raise DataError("sensors beside motion capture need a robot with orientations") from None
            return BodyPositions(fractions, 1.0), np.array(measured.position.reshape(rows, -1))
        outputs.append(BodyMotions(fractions, 1.0, 1.0 / (ARM * length)))
        data.append(np.concatenate([measured.position, measured.quaternion], axis=-1).reshape(rows, -1))
    for sensor in measured.sensors:
        output, values = sensor.output, sensor.values
        known = np.isfinite(values)
        sizes = (values / np.resize(output.noise, values.shape[1]))[known]
        usual = float(np.sqrt(np.mean(sizes**2))) if len(sizes) else 0.0
        sigmas = [it.name for it in dataclasses.fields(output) if it.name.startswith("sigma")]
        unit = (usual or 1.0) / length
        outputs.append(dataclasses.replace(output, **{it: unit * getattr(output, it) for it in sigmas}))
        data.append(values)
    return (outputs[0], data[0]) if len(outputs) == 1 else (Several(tuple(outputs)), np.hstack(data))


def _as_steps(measured: Measurements) -> Measurements:
    """Return equilibria as rows of a motion: each row's own tension leads to it, the first one not seen."""

    def late(rows: np.ndarray) -> np.ndarray:
        return np.concatenate([np.full_like(rows[:1], np.nan), rows])

    return dataclasses.replace(
        measured,
        control=np.concatenate([measured.control, measured.control[-1:]]),
        position=late(measured.position),
        quaternion=late(measured.quaternion),
        sensors=tuple(dataclasses.replace(it, values=late(it.values)) for it in measured.sensors),
        initial_control=measured.control[0],
    )


def of_trajectory(trajectory: Trajectory, robot: System, name: str) -> Experiment:
    """Return the experiment of full states; numbers that were not measured are NaN.

    From t = 0 it starts at rest: in the equilibrium under the control of row 0, or unstressed. Any other
    trajectory continues from its own first rows, which must then be states without noise.

    Raises:
        DataError: too short, a batch, of another robot, or controls that are not finite.
    """
    y, z, control = (np.asarray(it, dtype=float) for it in (trajectory.y, trajectory.z, trajectory.control))
    if y.ndim != 3:
        raise DataError(f"{name} is a batch of {len(y)}; give its robots one by one")
    if len(y) < 3:
        raise DataError(f"{name} has {len(y)} rows; at least 3 are needed")
    if y.shape[1:] != (robot.nodes, robot.y_layout.size):
        raise DataError(
            f"{name} has {y.shape[1]} nodes of {y.shape[2]} numbers; "
            f"the robot has {robot.nodes} of {robot.y_layout.size}"
        )
    if control.shape[1] != robot.control_layout.size:
        raise DataError(
            f"{name} has {control.shape[1]} controls a row; the robot has {robot.control_layout.size}"
        )
    if not np.all(np.isfinite(control)) or not np.any(np.isfinite(y[1:])):
        raise DataError(f"{name} has controls that are not finite, or no states")
    steps = np.diff(np.asarray(trajectory.time, dtype=float))
    if np.any(steps <= 0.0) or np.ptp(steps) > 1e-6 * steps.max():
        raise DataError(
            f"{name} has time steps from {steps.min():g} to {steps.max():g} s; "
            "they must be positive and equal"
        )
    settings, output = trajectory.settings or Settings(), States.of(robot)
    data = np.concatenate([y.reshape(len(y), -1), z.reshape(len(z), -1)], axis=1)
    first, held = 1, control[0]
    initial: Any = "equilibrium"
    if trajectory.time[0] != 0.0:
        first, held = 3, None  # the first row with the whole history of its scheme
        if len(y) <= first:
            raise DataError(f"{name} has {len(y)} rows and does not start at rest; at least 4 are needed")
        initial = trajectory[:first]
    elif begins_unstressed(trajectory):
        held, initial = None, "unstressed"
    data = data[first - 1 :]
    if held is None:
        data[0] = np.nan
    return Experiment(trajectory.dt, control[first:], output, data, held, initial, settings, name)


def poses_of_nodes(trajectory: Trajectory, name: str) -> Measurements:
    """Return the poses of a trajectory's nodes as if they had been measured, with its controls as tensions.

    Raises:
        DataError: it has positions or orientations of no one robot.
    """
    if np.ndim(trajectory.y) != 3:
        raise DataError(f"{name} is a batch; allowed is one robot's trajectory")
    position, quaternion = np.asarray(trajectory.position), np.asarray(trajectory.quaternion)
    control = np.asarray(trajectory.control)
    # a trajectory has with each row the control that led to it
    held = np.concatenate([control[1:], control[-1:]])
    nodes, seen = position.shape[1], np.ones((len(position), position.shape[1] - 1), dtype=bool)
    return Measurements(
        time=np.asarray(trajectory.time),
        control=held,
        fractions=np.arange(1, nodes) / (nodes - 1),
        position=position[:, 1:],
        quaternion=quaternion[:, 1:],
        measured=seen,
        simulated=True,
        source=name,
        initial_control=control[0],
        unstressed=begins_unstressed(trajectory),
    )
