"""Closed loops: checks of a reference, and a controller, a plant and a reference, period after period."""

from __future__ import annotations

import dataclasses
import functools
import time as clock
import warnings
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from knode_cosserat._arguments import check_arguments
from knode_cosserat._files.writing import replacing
from knode_cosserat.control.commands import Command, Controller, ControlLimits
from knode_cosserat.control.plants import Plant
from knode_cosserat.control.realtime import no_garbage_collection
from knode_cosserat.control.references import Reference, ReferenceFormatError
from knode_cosserat.errors import KnodeCosseratError
from knode_cosserat.estimation.outputs import BodyPoses, BodyPositions
from knode_cosserat.recordings.measurements import Measurements
from knode_cosserat.rods.aspects import Drawing
from knode_cosserat.rods.layout import Layout
from knode_cosserat.rods.passport import named
from knode_cosserat.rods.strands import strand_count
from knode_cosserat.rods.system import System
from knode_cosserat.rods.wrapped import nominal_model
from knode_cosserat.statics.reach import inverse_kinematics
from knode_cosserat.trajectory import Trajectory

#: seconds of a reference that are checked, and the time between two of them (s)
CHECKED, SAMPLING = 60.0, 0.02
#: distance from the base, in lengths of the rod, which a rod that stretches or a moving base may reach
STRETCH = 1.5
#: distance out of reach, as a part of the length, from which on it is reported
OUT_OF_REACH = 2e-3
#: points of a reference whose nearest tips are searched, initial controls of each search, and the part of the
#: length within which a point is reached
POINTS, STARTS, REACHED = 12, 2, 1e-4


# checks of a reference


def check_reference(controller: Any, reference: Reference, seconds: float = CHECKED) -> None:
    """Raise a `ReferenceFormatError` if a controller of positions cannot reach a reference at all.

    Controllers of other outputs, such as curvatures, are not checked.
    """
    robot, target = getattr(controller, "robot", None), getattr(controller, "target", None)
    if robot is not None and _is_position(target):
        _check_within_length(robot, reference, seconds)


def _is_position(target: Any) -> bool:
    """True for the target of a controller of positions, the tip's by default."""
    return target is None or isinstance(target, BodyPositions | BodyPoses)


def _check_within_length(robot: System, reference: Reference, seconds: float) -> None:
    """Raise a `ReferenceFormatError` if tip positions (m) are much further away than the rod is long.

    No rod of this length reaches them, even if it stretches or its base moves. Robots of several rods are not
    checked.
    """
    length = getattr(nominal_model(robot), "length", None)
    if length is None or strand_count(robot) > 1 or reference.size < 3:
        return
    y, _ = robot.rest(0.0)
    base = np.asarray(Drawing.of(robot).positions(np.asarray(y)[None]))[0]
    # controls in metres may feed more of it
    fields = (field for field in robot.control_layout.fields if field.unit == "m" and np.isfinite(field.high))
    length = float(length) + max((field.high for field in fields), default=0.0)
    times = np.arange(0.0, seconds, SAMPLING)
    distance = np.sqrt(np.nansum((reference.at(times)[:, :3] - base) ** 2, axis=1))
    k = int(np.argmax(distance))
    if distance[k] > STRETCH * length:
        raise ReferenceFormatError(
            f"the {reference.name} is {distance[k]:.4g} m from the base at t = {times[k]:.4g} s, and the "
            f"robot is {length:.4g} m long; are the positions in metres, in the robot's frame?"
        )


def distance_out_of_reach(
    robot: System, limits: ControlLimits, reference: Reference, seconds: float = CHECKED
) -> tuple[float, float]:
    """Return the largest distance (m) from a reference to the nearest tip at rest, and its time (s).

    Inverse kinematics within the limits gives the nearest tip of some points spread over the reference, so
    the distance is a lower bound of the largest one. A moving robot may swing further.

    Args:
        robot: the model.
        limits: of its controls.
        reference: positions (m); coordinates that are free (NaN) in the first row do not count.
        seconds: checked duration (s).
    """
    _check_within_length(robot, reference, seconds)
    bounds = limits.of(robot)
    times = np.arange(0.0, seconds, SAMPLING)
    wanted = reference.at(times)[:, :3]
    known = tuple(np.flatnonzero(np.isfinite(wanted[0])).tolist())
    if not known:
        return 0.0, 0.0
    wanted = wanted[:, known]
    # rows that are far from each other
    chosen = [int(np.nanargmax(np.linalg.norm(wanted - np.nanmean(wanted, axis=0), axis=1)))]
    distance = np.linalg.norm(wanted - wanted[chosen[0]], axis=1)
    while len(chosen) < POINTS and np.nanmax(distance) > 0.0:
        chosen.append(int(np.nanargmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(wanted - wanted[chosen[-1]], axis=1))
    chosen.sort()
    nearest = inverse_kinematics(
        robot,
        wanted[chosen],
        low=bounds.low,
        high=bounds.high,
        tolerance=REACHED,
        starts=STARTS,
        pose=_coordinates(known),
    )
    errors = np.where(nearest.converged, 0.0, np.nan_to_num(nearest.position_error))
    k = int(np.argmax(errors))
    return float(errors[k]), float(times[chosen[k]])


@functools.cache
def _coordinates(known: tuple[int, ...]) -> Any:
    """Return the pose function of some of the tip's coordinates; the same one each time, for compilation."""

    def pose(system: System, y: Any) -> tuple[Any, None]:
        return Drawing.of(system).positions(y)[np.array(known)], None

    return pose


# the log


@dataclasses.dataclass(frozen=True)
class LoopLog:
    """Log of a closed loop, one row a period.

    Row k holds the measurement at time k, and the control from time k to k + 1.

    Attributes:
        time: (T,) s.
        reference: (T, p), wanted at each time.
        measured: (T, m); positions are in the frame of the robot's `Camera`.
        tip: (T, 3) true or measured positions of the tip (m, robot's frame).
        control: (T, c).
        status: origin of each control.
        reason: reason of each fallback, else empty.
        violation: (T,) predicted violation of soft limits.
        feedback: (T,) time from measurement to command (s).
        preparation: (T,) time of the rest of the controller's work (s).
        parameters: adapted parameters by name, each (T,).
        missed: number of periods whose deadline was missed: the computation took longer than the period, or
            the next period began late. Simulations count it too, although their time waits.
        compiled: number of programs that were compiled during the loop; each may have delayed a period.
        initial_control: (c,) control before the first row, if the log begins at the start.
        settings: settings of the controller that were chosen or given, as plain numbers by name.
        extrapolation: periods in which controls or estimated strains are outside what the model learned from,
            and how far, in words; empty if there are none.
        out_of_reach: largest distance (m) from the reference to the nearest tip at rest within the limits;
            0 if it is below 0.2 % of the length, or the tip follows as closely; None: not known.
        control_layout: names and units of the controls; None: not known.
        estimated: estimated states, a trajectory that can be saved, drawn and viewed; None without an
            observer. Its robot has the parameters that the model had at first.
    """

    time: Float[np.ndarray, " T"]
    reference: Float[np.ndarray, "T p"]
    measured: Float[np.ndarray, "T m"]
    tip: Float[np.ndarray, "T 3"]
    control: Float[np.ndarray, "T c"]
    status: tuple[str, ...]
    reason: tuple[str, ...]
    violation: Float[np.ndarray, " T"]
    feedback: Float[np.ndarray, " T"]
    preparation: Float[np.ndarray, " T"]
    parameters: dict[str, Float[np.ndarray, " T"]]
    missed: int
    compiled: int = 0
    initial_control: Float[np.ndarray, " c"] | None = None
    settings: dict[str, int] = dataclasses.field(default_factory=dict)
    estimated: Trajectory | None = None
    out_of_reach: float | None = None
    extrapolation: str = ""
    control_layout: Layout | None = None

    @property
    def tip_distance(self) -> Float[np.ndarray, " T"]:
        """Distance (m) of the tip from a reference of positions; free coordinates (NaN) do not count."""
        return np.sqrt(np.nansum((self.tip - self.reference[:, :3]) ** 2, axis=1))

    def tip_rmse(self, after: float | None = None) -> float:
        """Return the root mean square of `tip_distance` (m) from a time (s) on.

        None: over the second half, after the start has died down. Reports and figures state this one.
        """
        start = 0.5 * float(self.time[-1]) if after is None else after
        return float(np.sqrt(np.mean(self.tip_distance[self.time >= start] ** 2)))

    @property
    def fallbacks(self) -> int:
        """Number of periods with a command that is not the controller's solution."""
        return sum(status != "optimal" for status in self.status)

    def summary(self) -> dict[str, Any]:
        """Return the figures of a loop as plain numbers; `tip_rmse` is that of its second half."""
        return {
            "periods": len(self.time),
            "tip_rmse": self.tip_rmse(),
            "fallbacks": self.fallbacks,
            "missed": self.missed,
            "compiled": self.compiled,
            "violation": float(np.max(self.violation, initial=0.0)),
            "feedback_ms": 1e3 * float(np.median(self.feedback)),
            "feedback_p99_ms": 1e3 * float(np.percentile(self.feedback, 99)),
            "preparation_ms": 1e3 * float(np.median(self.preparation)),
            "cycle_p99_ms": 1e3 * float(np.percentile(self.feedback + self.preparation, 99)),
            "settings": self.settings,
            "extrapolation": self.extrapolation,
            "parameters": {name: float(values[-1]) for name, values in self.parameters.items()},
        }

    def measurements(
        self, fractions: Sequence[float] = (1.0,), simulated: bool | None = None
    ) -> Measurements:
        """Return the loop as a recording, from which a model can be identified or learned.

        It can be saved as a table or a bag: `log.measurements().save("run.mcap")`.

        Args:
            fractions: places of the bodies whose positions were measured, as fractions of the length.
            simulated: True if the robot was simulated; None: not stated.

        Raises:
            ValueError: other numbers than these bodies' positions were measured.
        """
        rows, bodies = self.measured.shape[0], len(fractions)
        if self.measured.shape[1] != 3 * bodies:
            raise ValueError(
                f"a measurement has {self.measured.shape[1]} numbers; allowed are the positions of "
                f"{bodies} {'body' if bodies == 1 else 'bodies'}, {3 * bodies} numbers"
            )
        position = self.measured.reshape(rows, bodies, 3)
        return Measurements(
            time=self.time,
            control=self.control,
            fractions=np.asarray(fractions, dtype=float),
            position=position,
            quaternion=np.full((rows, bodies, 4), np.nan),
            measured=np.isfinite(position).all(axis=-1),
            simulated=simulated,
            source="closed loop",
            initial_control=self.initial_control,
        )

    def to_csv(self, path: str | Path) -> None:
        """Write one row a period: time, reference, tip, controls, status and times of the computation."""
        import pandas as pd  # type: ignore[import-untyped]

        columns: dict[str, Any] = {"t (s)": self.time}
        columns |= {f"reference {k}": column for k, column in enumerate(self.reference.T)}
        columns |= {f"tip {axis} (m)": column for axis, column in zip("xyz", self.tip.T, strict=True)}
        columns |= {f"control {k + 1}": column for k, column in enumerate(self.control.T)}
        columns |= self.parameters
        columns |= {
            "status": self.status,
            "feedback (s)": self.feedback,
            "preparation (s)": self.preparation,
        }
        with replacing(Path(path)) as part:
            pd.DataFrame(columns).to_csv(part, index=False)

    def __repr__(self) -> str:
        return (
            f"LoopLog: {len(self.time)} periods, tip RMSE {1e3 * self.tip_rmse():.2f} mm over the second "
            f"half, {self.fallbacks} fallbacks, {self.missed} missed deadlines, feedback "
            f"{1e3 * float(np.median(self.feedback)):.2f} ms (median)"
            + (
                f"; the reference is up to {1e3 * self.out_of_reach:.3g} mm out of reach"
                if self.out_of_reach
                else ""
            )
            + (f"\nEXTRAPOLATION: {self.extrapolation}" if self.extrapolation else "")
        )


# states as trajectories


def estimated_state(controller: Any) -> Trajectory | None:
    """Return the state that a controller's observer estimates, a trajectory of one row, or None."""
    observer = getattr(controller, "observer", None)
    if observer is None:
        return None
    estimate = observer.estimate
    one = np.zeros(1)
    return Trajectory(
        observer.robot,
        None,
        np.array([estimate.time]),
        np.asarray(estimate.y)[None],
        np.asarray(estimate.z)[None],
        np.asarray(observer.control, dtype=float)[None],
        np.zeros(1, dtype=int),
        one,
        one,
    )


def join_rows(states: Sequence[Trajectory], times: Sequence[float]) -> Trajectory:
    """Return a trajectory of rows of one robot, at these times (s)."""
    y, z, control, result = (
        np.concatenate([np.asarray(getattr(state, name)) for state in states])
        for name in ("y", "z", "control", "result")
    )
    errors = [
        np.full(1, np.nan) if state.position_error is None else np.asarray(state.position_error)
        for state in states
    ]
    none = np.zeros(len(times))
    return Trajectory(
        states[0].system,
        states[0].settings,
        np.array(times),
        y,
        z,
        control,
        result,
        none,
        none.astype(int),
        position_error=np.concatenate(errors),
    )


# periods


class _Compilations:
    """Counts the programs that JAX compiles or loads in this process."""

    def __init__(self) -> None:
        self.count = 0
        jax.monitoring.register_event_duration_secs_listener(self._heard)

    def _heard(self, event: str, duration_secs: float, **_: Any) -> None:
        self.count += event == COMPILED


#: JAX's event of a compilation, also of one that is read from the cache on disk
COMPILED = "/jax/core/compile/backend_compile_duration"
_COMPILATIONS = _Compilations()


class Period(NamedTuple):
    """One period of a closed loop: a row of its log."""

    time: float
    reference: Float[np.ndarray, " p"]
    measured: Float[np.ndarray, " m"]
    tip: Float[np.ndarray, "3"]
    command: Command
    #: time from the measurement to the command, and time of the controller's other work (s)
    feedback: float
    preparation: float
    parameters: dict[str, float]
    #: estimate of the state at this time, a trajectory of one row; None without an observer
    estimated: Trajectory | None = None


class Loop:
    """Closed loop that moves one period at a time.

    Everything is compiled at the start, by a copy of the controller. `reference` may be replaced between two
    periods: the next prediction follows the new one.

        loop = Loop(controller, plant, reference)
        row = loop.period()
    """

    def __init__(self, controller: Controller, plant: Plant, reference: Reference, kept: int | None = None):
        """Start the plant and the controller; the log has the last `kept` periods, None for all.

        Raises:
            ValueError: plant and controller have different periods.
        """
        if not np.isclose(controller.dt, plant.dt):
            raise ValueError(f"the controller's period is {controller.dt:g} s and the plant's {plant.dt:g} s")
        self.controller, self.plant, self.reference = controller, plant, reference
        #: number of periods that began late, counted by the caller that keeps the time
        self.missed = 0
        warm_up(controller, plant.rehearsal(), reference)
        self._initial = np.array(plant.start())
        controller.reset(self._initial)
        controller.prepare(0.0, reference)
        self._rows: deque[Period] = deque(maxlen=kept)
        #: number of periods whose computation took longer than the period
        self._overrun = 0
        self._count, self._compiled_before = 0, _COMPILATIONS.count

    @property
    def time(self) -> float:
        """Time of the next period (s)."""
        return self._count * self.controller.dt

    def period(self, applied: Callable[[], None] | None = None) -> Period:
        """Measure, command, move the plant, and prepare the next period.

        Args:
            applied: called after the plant has moved, while the controller's estimate is still of the
                measurement's time; its own time is not counted.
        """
        controller, plant, reference, time = self.controller, self.plant, self.reference, self.time
        measured, tip = plant.measure(), plant.tip()
        began = clock.perf_counter()
        if (acting := plant.acting()) is not None:
            controller.take_acting(*acting)
        command: Command = controller.command(time, measured, reference)
        sent = clock.perf_counter()
        plant.apply(command.control)
        if applied is not None:
            applied()
        state, observer = estimated_state(controller), getattr(controller, "observer", None)
        moved = clock.perf_counter()
        controller.advance(command.control)
        controller.prepare(time + controller.dt, reference)
        done = clock.perf_counter()
        row = Period(
            time,
            reference.at(time)[0],
            measured,
            tip,
            command,
            sent - began,
            done - moved,
            {} if observer is None else dict(observer.estimate.parameters),
            state,
        )
        self._rows.append(row)
        self._overrun += row.feedback + row.preparation > controller.dt
        self._count += 1
        return row

    def log(self) -> LoopLog:
        """Return the log of the kept periods.

        Raises:
            ValueError: no period has passed.
        """
        rows = list(self._rows)
        if not rows:
            raise ValueError("no period has passed; there is nothing in the log")
        columns: Any = Period._make(zip(*rows, strict=True))
        commands: Any = Command._make(zip(*columns.command, strict=True))
        states = [state for state in columns.estimated if state is not None]
        estimated = join_rows(states, columns.time) if states else None
        control = np.array(commands.control)
        robot = getattr(self.controller, "robot", None) or getattr(self.plant, "robot", None)
        return LoopLog(
            time=np.array(columns.time),
            reference=np.array(columns.reference),
            measured=np.array(columns.measured),
            tip=np.array(columns.tip),
            control=control,
            status=tuple(status.value for status in commands.status),
            reason=commands.reason,
            violation=np.array(commands.violation),
            feedback=np.array(columns.feedback),
            preparation=np.array(columns.preparation),
            parameters={
                name: np.array([row.parameters[name] for row in rows]) for name in rows[0].parameters
            },
            # plants and callers that keep the time count an overrun too, as the late begin that follows it
            missed=max(self.missed + self.plant.missed, self._overrun),
            compiled=_COMPILATIONS.count - self._compiled_before,
            initial_control=self._initial if rows[0].time == 0.0 else None,
            settings=self.controller.settings,
            estimated=estimated,
            extrapolation=_extrapolation(getattr(self.controller, "robot", None), control, estimated),
            control_layout=None if robot is None else robot.control_layout,
        )


def _extrapolation(robot: Any, control: Float[np.ndarray, "T c"], estimated: Trajectory | None) -> str:
    """Return the periods in which controls or estimated strains leave what a model learned from, in words."""
    passport = getattr(robot, "passport", None)
    if passport is None:
        return ""
    numbers = {"control": control, "z": None if estimated is None else estimated.z}
    outside = passport.outside(robot, **numbers)
    if not outside.any():
        return ""
    words = f"{np.count_nonzero(outside)} of {len(outside)} periods are outside what the model learned from"
    return f"{words}: {named(passport.excesses(robot, **numbers))}"


def run_loop(
    controller: Controller, plant: Plant, reference: Reference, seconds: float, *, paced: bool = False
) -> LoopLog:
    """Close the loop for some seconds, and return its log.

    Everything is compiled before the first period, by a copy of the controller. The controller computes the
    next period's prediction after it has sent its command.

    Args:
        controller: the controller.
        plant: the robot.
        reference: the wanted output.
        seconds: duration (s).
        paced: keep real time: each period begins dt after the one before, or late if the work took longer.
            A period that begins late counts as missed.

    Raises:
        ValueError: plant and controller have different periods, or a duration below one period.
        ReferenceFormatError: the reference is further away than the robot is long.
        KnodeCosseratError: the plant failed, such as hardware with a fault. The error's attribute `log` is
            the log of the periods before, None if there are none. Interruptions (Ctrl-C) have it too.
    """
    check_arguments(run_loop, locals())
    steps = round(seconds / controller.dt)
    if steps < 1:
        raise ValueError(f"seconds is {seconds:g}; allowed is at least one period, {controller.dt:g} s")
    check_reference(controller, reference, seconds)
    loop = Loop(controller, plant, reference)
    try:
        with no_garbage_collection():
            due = clock.perf_counter()
            for k in range(steps):
                if paced:
                    loop.missed += k > 0 and clock.perf_counter() > due
                    while (rest := due - clock.perf_counter()) > 0.0:
                        clock.sleep(max(0.0, rest - 5e-4))
                    due = max(due, clock.perf_counter() - loop.controller.dt) + loop.controller.dt
                loop.period()
    except (KnodeCosseratError, KeyboardInterrupt) as error:
        # measurements of a robot are not lost
        error.log = loop.log() if loop.time > 0.0 else None  # type: ignore[union-attr]
        raise
    return _with_reach(loop.log(), controller, reference, seconds)


def _with_reach(log: LoopLog, controller: Controller, reference: Reference, seconds: float) -> LoopLog:
    """Return the log with the distance of the reference out of reach, and warn of it."""
    robot, limits = getattr(controller, "robot", None), getattr(controller, "limits", None)
    if robot is None or limits is None or not _is_position(getattr(controller, "target", None)):
        return log
    least = OUT_OF_REACH * float(nominal_model(robot).length)
    beyond = 0.0
    if not log.tip_rmse() < least:
        beyond, time = distance_out_of_reach(robot, limits, reference, seconds)
        if beyond > least:
            warnings.warn(
                f"the {reference.name} is {1e3 * beyond:.3g} mm out of reach at t = {time:.3g} s: no "
                "controls within the limits were found that bring the tip nearer at rest",
                stacklevel=3,
            )
    return dataclasses.replace(log, out_of_reach=beyond if beyond > least else 0.0)


def warm_up(controller: Controller, plant: Plant, reference: Reference, periods: int = 2) -> None:
    """Compile all programs of a loop by some periods with a copy of the controller; the plant moves."""
    controller = controller.copied()
    controller.reset(plant.start())
    controller.prepare(0.0, reference)
    for k in range(periods):
        command = controller.command(k * controller.dt, plant.measure(), reference)
        plant.apply(command.control)
        controller.advance(command.control)
        controller.prepare((k + 1) * controller.dt, reference)
