"""Checks of raw streams: errors that are removed or undone, and implausible values, each with a finding."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import scipy.ndimage
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from knode_cosserat.estimation.outputs import BaseWrench, BendingAngles, Curvatures, Orientations, Output
from knode_cosserat.recordings.config import (
    SENSOR_UNITS,
    ControlSource,
    RecordingConfig,
    SensorSource,
)
from knode_cosserat.recordings.findings import Finding, RecordingError, Severity, counted
from knode_cosserat.recordings.frame import NORMAL, rotation_steps
from knode_cosserat.recordings.quantities import QUANTITIES
from knode_cosserat.recordings.recording import bridge, continuous
from knode_cosserat.recordings.streams import SLOW, Body, ControlRows, Rows, Sensor, merged, period

#: allowed numbers in a row of a sensor, by its kind; of curvatures two for each place
SENSOR_COUNTS = {"orientation": (4, 3), "bending_angle": (2,), "base_wrench": (6,)}
#: smallest jumps that are removed (m, rad, N)
SMALLEST_SHIFT, SMALLEST_TURN, SMALLEST_PULL = 5e-3, np.radians(8.0), 0.5
#: longest spike of a load cell (s): spikes last one or two messages, a longer change can be a command
LONGEST_SPIKE = 0.04
#: smallest number of frames of a body
FEWEST_FRAMES = 2
#: plausible range of a tendon robot's tensions (N)
SLACK, STRONG = QUANTITIES["tension"].low, QUANTITIES["tension"].high
#: plausible range of a rod's length (m)
SHORT, LONG = 0.02, 20.0
#: largest plausible ratio of measured to commanded controls, or the inverse
FACTOR = 20.0
#: largest share of rows with implausible tensions; more of them are no accidents
RARE = 0.05


class Sensed(NamedTuple):
    """Streams of a recording without errors; positions are in the recording's own frame and unit."""

    bodies: list[Body]
    base: Body | None
    sensors: list[Sensor]
    control: ControlRows | None
    command: ControlRows | None


def cleaned(config: RecordingConfig, rows: Mapping[str, Rows]) -> Sensed:
    """Return the streams without errors; findings are added to those of the rows.

    Raises:
        RecordingError: a body or sensor has fewer than two usable rows, rows have another count of numbers
            than the configuration, or required controls have no usable row.
    """
    bodies = [_body(config, it.name, it.fraction, rows[it.topic]) for it in config.markers]
    base = _body(config, "base", math.nan, rows[config.base.topic]) if config.base else None
    sensors = [_sensor(config, source, rows[source.topic]) for source in config.sensors]
    there = [source for source in config.measured if source.topic in rows]
    measured = [_controls(config, source, rows[source.topic], "measured") for source in there]
    known = [stream for stream in measured if stream is not None]
    is_whole = bool(known) and len(known) == len(config.measured)
    control = merged(known, config.measured) if is_whole else None
    sent = config.command
    command = None
    if sent is not None and sent.topic in rows:
        command = _controls(config, sent, rows[sent.topic], "commanded")
    return Sensed(bodies, base, sensors, control, command)


def _drop(rows: Rows, wrong: Bool[np.ndarray, " n"], words: tuple[str, str, str], severity: Severity) -> None:
    """Remove rows, with a finding in words: for one row, for several, and the reason."""
    one, several, reason = words
    if wrong.any():
        rows.add(f"{counted(int(wrong.sum()), one, several)} {reason}; left out", severity, wrong)
        rows.keep(~wrong)


def _drop_unusable(rows: Rows, wrong: Bool[np.ndarray, " n"], words: tuple[str, str, str]) -> None:
    """Remove rows with numbers that are not finite or implausibly large, and others that are wrong."""
    large = ~np.all(np.abs(np.nan_to_num(rows.values, nan=np.inf)) < 1e9, axis=1)
    _drop(rows, wrong | large, words, "warning")


def _require(rows: Rows, config: RecordingConfig, what: str, name: str) -> None:
    """Remove repeated rows, unless they are kept; `RecordingError` with fewer than two rows."""
    if config.repeats == "drop":
        again = np.concatenate([[False], np.all(np.diff(rows.values, axis=0) == 0.0, axis=1)])
        words = f"{what} repeats", f"{what}s repeat", "the one before"
        _drop(rows, again[: len(rows.time)], words, "note")
    if len(rows.time) < FEWEST_FRAMES:
        count = f"{len(rows.time)} usable {what}s of {name}; required is {FEWEST_FRAMES} or more"
        raise RecordingError(f"topic {rows.topic}: {count}")


def _add_pauses(rows: Rows, longest: float) -> None:
    """Add a finding on pauses that are too long to be bridged."""
    steps = np.diff(rows.time)
    long = steps > bridge(rows.time, longest)
    if long.any():
        begins = rows.time[:-1][long]
        pairs = zip(begins[:3], steps[long][:3], strict=True)
        listed = ", ".join(f"{begin:.2f} to {begin + step:.2f} s" for begin, step in pairs)
        more = f" and {len(begins) - 3} more" if len(begins) > 3 else ""
        pauses = counted(len(begins), "pause", "pauses")
        what = f"{pauses} too long to be bridged ({listed}{more}): the recording is in parts"
        rows.findings.append(Finding("warning", rows.topic, what, tuple(begins.tolist())))


# poses


def _body(config: RecordingConfig, name: str, fraction: float, rows: Rows) -> Body:
    """Return a body without jumps and swapped axes. Raises `RecordingError` with fewer than two frames."""
    is_oriented = rows.values.shape[1] == 7
    no_rotation = np.zeros(len(rows.time), dtype=bool)
    if is_oriented:
        # some drivers send a zero quaternion while the body is not seen
        with np.errstate(all="ignore"):
            no_rotation = ~(np.abs(np.linalg.norm(rows.values[:, 3:], axis=1) - 1.0) < 0.05)
    _drop_unusable(rows, no_rotation, ("pose is", "poses are", "not finite, or no rotation"))
    _require(rows, config, "pose", name)
    unclear = _undo_swaps(rows) if is_oriented else []
    wrong = np.zeros(len(rows.time), dtype=bool)
    if not config.static:
        # as many rows as can be bridged, but not most of the filter's window
        usual = float(np.median(np.diff(rows.time))) or 1.0
        longest = int(np.clip(config.longest_gap / usual, 1, 4))
        floor = SMALLEST_SHIFT / config.position_factor
        wrong = outliers(np.diff(rows.values[:, :3], axis=0), rows.time, floor=floor, longest=longest)
        if is_oriented:
            turns = rotation_steps(rows.values[:, 3:])
            wrong |= outliers(turns, rows.time, floor=SMALLEST_TURN, longest=longest)
    large = [row for row in unclear if not wrong[row - 1 : row + 1].any()]
    if large:
        what = f"{counted(len(large), 'turn', 'turns')} too large for a motion, and no swap of axes"
        rows.add(f"{what}; left as seen", "warning", np.isin(np.arange(len(wrong)), large))
    _drop(rows, wrong, ("pose jumps", "poses jump", "out of the motion and back"), "note")
    _add_pauses(rows, config.longest_gap)
    orientation = rows.values[:, 3:] if is_oriented else None
    return Body(rows.time, rows.values[:, :3], orientation, name, rows.topic, fraction)


def _undo_swaps(rows: Rows) -> list[int]:
    """Undo swapped axes of poses, with findings, and return the rows of other large rotations."""
    quaternion = rows.values[:, 3:] / np.linalg.norm(rows.values[:, 3:], axis=1, keepdims=True)
    quaternion, swaps, unclear = swaps_undone(rows.time, quaternion)
    rows.values = np.concatenate([rows.values[:, :3], quaternion], axis=1)
    for row, angle, axis in swaps:
        when = float(rows.time[row])
        what = f"its axes were swapped at {when:.3f} s, by {angle:.0f} degrees about {axis}; undone"
        rows.findings.append(Finding("warning", rows.topic, what, (when,)))
    return unclear


# other sensors


def _sensor(config: RecordingConfig, source: SensorSource, rows: Rows) -> Sensor:
    """Return a sensor's usable rows in SI units and in the robot's frame.

    Raises:
        RecordingError: another number of numbers than its kind has, or too few usable rows.
    """
    counts = SENSOR_COUNTS.get(source.kind, (2 * len(source.fractions),))
    if (count := rows.values.shape[1]) not in counts:
        words = f"allowed for {source.kind} is {' or '.join(map(str, counts))}"
        raise RecordingError(f"{source.topic} has {count} numbers in a row; {words}")
    is_turn = source.kind == "orientation" and count == 4
    length = np.linalg.norm(rows.values, axis=1) if is_turn else np.ones(len(rows.time))
    wrong = ~(np.abs(length - 1.0) < 0.05)
    _drop_unusable(rows, wrong, ("row is", "rows are", "not finite, or no rotation"))
    _require(rows, config, "row", source.kind)
    units = SENSOR_UNITS[source.kind]
    values = rows.values * units[source.unit or next(iter(units))]
    frame = Rotation.from_quat(source.rotation or (1.0, 0.0, 0.0, 0.0), scalar_first=True)
    output: Output = Curvatures(source.fractions)
    if source.kind == "orientation":
        output = Orientations(source.fractions)
        if count == 3:
            values = Rotation.from_euler("ZYX", values[:, ::-1]).as_quat(scalar_first=True)
        turned = frame * Rotation.from_quat(values, scalar_first=True)
        values = continuous(turned.as_quat(scalar_first=True))
    elif source.kind == "bending_angle":
        output = BendingAngles(source.fractions)
        values = values[:, :1] * np.stack([np.cos(values[:, 1]), np.sin(values[:, 1])], axis=1)
    elif source.kind == "base_wrench":
        output = BaseWrench()
        values = frame.apply(values.reshape(-1, 3)).reshape(values.shape)
    _add_pauses(rows, config.longest_gap)
    return Sensor(rows.time, values, output, rows.topic)


# controls


def _controls(config: RecordingConfig, source: ControlSource, rows: Rows, kind: str) -> ControlRows | None:
    """Return measured or commanded numbers in SI units, number 1 first; None without usable rows.

    Measured ones are at the times at which they act.

    Raises:
        RecordingError: messages have another count of numbers, or required numbers have no usable row.
    """
    plural = source.kind.plural
    if len(rows.time):
        _mend_controls(source, rows, is_sample=kind == "measured" and not source.held)
    else:
        rows.findings.append(Finding("warning", source.topic, f"there are no {kind} {plural}"))
    if not len(rows.time):
        if config.controls == kind:
            raise RecordingError(f"topic {source.topic}: no usable {kind} {source.kind.name}")
        return None
    time = rows.time
    if kind == "measured":
        _add_pauses(rows, config.longest_gap)
        time = time + source.latency
    return ControlRows(time, rows.values, source.topic, ((source.kind.name, len(source.order)),))


def _mend_controls(source: ControlSource, rows: Rows, *, is_sample: bool) -> None:
    """Bring numbers to SI units in order, and remove errors; samples of tensions also lose spikes."""
    name, plural = source.kind.name, source.kind.plural
    if rows.values.shape[1] != len(source.order):
        raise RecordingError(
            f"topic {source.topic}: a message has {rows.values.shape[1]} {plural}; "
            f"the configuration's order has {len(source.order)} numbers"
        )
    rows.values = rows.values[:, np.argsort(source.order)] * source.factor
    _drop_unusable(rows, np.zeros(len(rows.time), dtype=bool), (f"{name} is", f"{plural} are", "not finite"))
    if not source.kind.pulls:
        return
    wrong = implausible_tensions(rows.values)
    if wrong.any():
        worst = rows.values[wrong].ravel()
        what = (
            f"{counted(int(wrong.sum()), 'row has', 'rows have')} a tension that is not plausible, "
            f"{worst[np.argmax(np.abs(worst))]:.4g} N among tensions of "
            f"{np.median(np.abs(rows.values)):.3g} N"
        )
        # held tensions are kept, because they last until the next row
        fate: tuple[str, Severity] = ("left out", "warning") if is_sample else ("kept", "problem")
        rows.add(f"{what}; {fate[0]}", fate[1], wrong)
        if is_sample:
            rows.keep(~wrong)
    if is_sample and 0.0 < period(rows.time) <= LONGEST_SPIKE:
        longest = min(2, int(LONGEST_SPIKE / period(rows.time)))
        spikes = [
            outliers(np.diff(tendon)[:, None], rows.time, floor=SMALLEST_PULL, longest=longest)
            for tendon in rows.values.T
        ]
        _drop(rows, np.any(spikes, axis=0), ("tension jumps", "tensions jump", "up or down and back"), "note")


# outliers

#: threshold of a jump, in standard deviations of the steps around it
_SIGMAS = 12.0
#: numbers of steps on each side that measure the variation of the motion: locally, and over a wider window
_AROUND = (10, 50)


def outliers(
    steps: Float[np.ndarray, "m size"], time: Float[np.ndarray, " n"], *, floor: float, longest: int
) -> Bool[np.ndarray, " n"]:
    """Return a mask of rows that jump out of a signal and back again within `longest` rows.

    A jump is a step that differs from the steps around it. The rows between two jumps that cancel are
    outliers. Even fast motion does not return to its expected position in one step.

    Args:
        steps: change from each row to the next (m = n - 1).
        time: times of the rows (s), increasing.
        floor: smallest size of a jump.
        longest: largest number of consecutive outliers.
    """
    mask = np.zeros(len(time), dtype=bool)
    # no jump is larger than two steps
    if len(steps) < 5 or 2.0 * np.max(np.linalg.norm(steps, axis=1)) < floor:
        return mask
    dt = np.diff(time)[:, None]
    # filter the rate, because some frames are missing
    expected = scipy.ndimage.median_filter(steps / dt, size=(9, 1), mode="nearest") * dt
    jump = steps - expected
    size = np.linalg.norm(jump, axis=1)
    windows = [min(2 * around + 1, len(size)) for around in _AROUND]
    medians = [scipy.ndimage.median_filter(size, size=window, mode="nearest") for window in windows]
    jumps = np.flatnonzero(size > np.maximum(floor, _SIGMAS * NORMAL * np.max(medians, axis=0)))
    for out, back in itertools.pairwise(jumps):
        returns = np.linalg.norm(jump[out] + jump[back]) < 0.5 * min(size[out], size[back])
        if back - out <= longest and returns and not mask[out]:
            mask[out + 1 : back + 1] = True
    return mask


# swapped axes


#: largest rotation by motion between two frames (rad): a larger one cannot be distinguished from a swap
_LARGEST_TURN = np.radians(45.0)
#: smallest tolerance of a swap about a multiple of 90 degrees, for motion between the two frames (rad)
_MOVED = np.radians(15.0)
#: rotation group of the cube, the identity first
_CUBE = Rotation.create_group("O")


def swaps_undone(
    time: Float[np.ndarray, " n"], quaternion: Float[np.ndarray, "n 4"]
) -> tuple[Float[np.ndarray, "n 4"], list[tuple[int, float, tuple[int, ...]]], list[int]]:
    """Return orientations without swapped axes, the swaps, and the rows of other large rotations.

    A swap is its row (it applies to all later rows, too), its angle (degrees), and its axis among the body's.
    Between two frames it rotates a body by one of the 23 rotations of a cube, plus its motion, which the
    neighbouring rotations bound. A large rotation is left unchanged if it is not a multiple of 90 degrees, or
    if the motion is too fast to decide.
    """
    rotation = Rotation.from_quat(quaternion, scalar_first=True)
    turn = rotation[:-1].inv() * rotation[1:] if len(time) > 1 else rotation[:0]
    angle = np.asarray(turn.magnitude())
    rate = np.where(angle > _LARGEST_TURN, 0.0, angle / np.diff(time))
    undo = Rotation.identity()
    pieces: list[Rotation] = []
    swaps: list[tuple[int, float, tuple[int, ...]]] = []
    unclear: list[int] = []
    begin = 0
    for step in np.flatnonzero(angle > _LARGEST_TURN):
        # bound on the body's own rotation: the fastest rate nearby, over the time between the two frames
        moved = np.max(rate[max(0, step - 10) : step + 11], initial=0.0) * (time[step + 1] - time[step])
        error = np.asarray((_CUBE.inv() * turn[step]).magnitude())
        nearest = int(np.argmin(error))
        is_identity = _CUBE[nearest].magnitude() < 1e-6
        if is_identity or error[nearest] > max(_MOVED, 1.5 * moved) or moved > _LARGEST_TURN:
            unclear.append(int(step) + 1)
            continue
        pieces.append(rotation[begin : step + 1] * undo)
        begin = int(step) + 1
        # rotations are measured in the swapped axes: undo the swaps in reverse order
        undo = _CUBE[nearest].inv() * undo
        axis = np.sign(np.round(_CUBE[nearest].as_rotvec(), 6)).astype(int).tolist()
        swaps.append((begin, float(np.degrees(_CUBE[nearest].magnitude())), tuple(axis)))
    if not swaps:
        return quaternion, [], unclear
    pieces.append(rotation[begin:] * undo)
    return Rotation.concatenate(pieces).as_quat(scalar_first=True), swaps, unclear


# plausibility


def implausible_sizes(
    sensed: Sensed, at_rest: Float[np.ndarray, "M 3"] | None, config: RecordingConfig
) -> list[Finding]:
    """Return findings on implausible times and units, with the likely error.

    The streams are in the robot's frame; `at_rest` are the positions of the bodies at rest (m), if known.
    Times of equilibria are arbitrary.
    """
    findings, sizes = list[Finding](), []
    sources = {source.topic: source for source in (*config.measured, *filter(None, (config.command,)))}
    for stream in _single(sensed.control, config), _single(sensed.command, config):
        for topic, values in stream.items():
            source = sources[topic]
            findings += _implausible_controls(source, values, is_command=source is config.command)
        known = np.concatenate([np.abs(values).ravel() for values in stream.values()] or [np.zeros(0)])
        if known.any() and len(stream) == 1:
            sizes.append(float(np.median(known[known > 0.0])))
    if len(sizes) == 2 and max(sizes) > FACTOR * min(sizes):
        kind = config.measured[0].kind
        what = (
            f"measured {kind.plural} are {sizes[0]:.3g} {kind.unit} and commanded ones {sizes[1]:.3g} "
            f"{kind.unit}: not the same unit?"
        )
        findings.append(Finding("problem", "", what))
    if not sensed.bodies:
        return findings
    places = [np.median(body.position, axis=0) for body in sensed.bodies] if at_rest is None else at_rest
    far = float(np.linalg.norm(places, axis=1).max())
    if not SHORT < far < LONG:
        what = (
            f"the bodies are up to {far:.3g} m from the clamped end: are positions in the unit that is said?"
        )
        findings.append(Finding("problem", "", what))
    time = min((body.time for body in sensed.bodies), key=period)
    if not config.static and SLOW <= period(time) < np.inf:
        what = (
            f"poses are {period(time):.3g} s apart, and the recording takes "
            f"{(time[-1] - time[0]) / 3600.0:.2g} h: are the times in ms? "
            "(Rows of shapes at rest need static: true.)"
        )
        findings.append(Finding("problem", "", what))
    return findings


def _single(stream: ControlRows | None, config: RecordingConfig) -> dict[str, Float[np.ndarray, "n c"]]:
    """Return the values of each source of a stream, by topic."""
    if stream is None:
        return {}
    if config.command is not None and stream.topic == config.command.topic:
        return {stream.topic: stream.values}
    ends = np.cumsum([len(source.order) for source in config.measured])[:-1]
    parts = np.split(stream.values, ends, axis=1)
    return {source.topic: part for source, part in zip(config.measured, parts, strict=True)}


def _implausible_controls(
    source: ControlSource, values: Float[np.ndarray, "n c"], *, is_command: bool
) -> list[Finding]:
    """Return findings on numbers of a size that their quantity does not have, or of the wrong sign."""
    kind, known = source.kind, np.abs(values[np.isfinite(values) & (values != 0.0)])
    if not len(known):
        return []
    size = float(np.median(known))
    if not kind.low <= size <= kind.high:
        stated = QUANTITIES[source.quantity].units
        raw = size / stated[source.unit or kind.unit]
        likely = [unit for unit, factor in stated.items() if kind.low <= raw * factor <= kind.high]
        hint = f"are {likely[0]} read as {source.unit}?" if likely else "is the column the right one?"
        what = f"{kind.plural} of {size:.3g} {kind.unit} are not plausible: {hint}"
        return [Finding("problem", source.topic, what)]
    if kind.pulls and not is_command and np.median(values.min(axis=1)) < -kind.low:
        return [Finding("warning", source.topic, f"{kind.plural} are below zero: is the sign right?")]
    return []


def implausible_tensions(newtons: Float[np.ndarray, "n tendons"]) -> Bool[np.ndarray, " n"]:
    """Return a mask of rows with a tension that no tendon has, among tensions that are plausible.

    It is below zero by more than the usual tension, because a tendon cannot push, or above `STRONG` and more
    than `FACTOR` times the usual one. The usual tension is the median of those that are not zero.
    """
    none = np.zeros(len(newtons), dtype=bool)
    size = np.abs(newtons)
    if not np.any(size > 0.0):
        return none
    usual = float(np.median(size[size > 0.0]))
    if not SLACK <= usual <= STRONG or np.median(newtons[size > 0.0]) < 0.0:
        return none
    rows = np.any((newtons < -usual) | (newtons > max(STRONG, FACTOR * usual)), axis=1)
    return rows if np.mean(rows) <= max(RARE, 1.0 / len(rows)) else none
