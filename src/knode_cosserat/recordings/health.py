"""Quality report of a recording: rates, gaps, noise, latency and errors of the controls."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.optimize
import scipy.signal
from jaxtyping import Float

from knode_cosserat.recordings.findings import Finding
from knode_cosserat.recordings.frame import NORMAL, rest_mask, rest_positions, rod_lengths, rotation_steps
from knode_cosserat.recordings.quantities import labels, unit_of
from knode_cosserat.recordings.streams import SLOW, period

if TYPE_CHECKING:
    from knode_cosserat.recordings.recording import Recording
    from knode_cosserat.recordings.streams import Body, ControlRows

#: smallest standard deviation of commanded tensions for an estimate of their latency (N)
QUIET = 0.05
#: range and resolution of the search for a latency (s)
LONGEST_LATENCY, _FINE = 0.5, 0.002
#: smallest number of rows for an estimate of the noise
_ENOUGH = 20
#: smallest difference from the configuration's latency that is reported (s)
_OFF = 0.03


@dataclasses.dataclass(frozen=True)
class StreamHealth:
    """Quality of one topic.

    Attributes:
        topic: name of the topic.
        what: the body's name, or "measured tensions" (or another quantity), or "commands".
        rows: number of usable rows.
        rate: usual rate of rows (Hz); None for commands, which are irregular.
        jitter: standard deviation of the time from row to row, without gaps (s); None for commands.
        missing: fraction of missing rows; None for commands.
        gaps: number of gaps; None for commands.
        longest_gap: longest time from row to row (s).
        delay: median delay from stamp to recording (s); None without stamps.
        noise: standard deviation of a coordinate (m), or of a control; None if it cannot be estimated.
        turn_noise: standard deviation of orientation about an axis (rad); None without orientations.
        unit: SI unit of `noise`.
    """

    topic: str
    what: str
    rows: int
    rate: float | None
    jitter: float | None
    missing: float | None
    gaps: int | None
    longest_gap: float
    delay: float | None
    noise: float | None
    turn_noise: float | None
    unit: str = "m"


@dataclasses.dataclass(frozen=True)
class _Latency:
    """Latency of controls after commands (s): the best shift, or dead time and time constant of a lag."""

    shift: float
    delay: float
    lag: float

    @property
    def total(self) -> float:
        """Mean delay of a change of commands: dead time plus lag (s)."""
        return self.delay + self.lag


@dataclasses.dataclass(frozen=True)
class _ControlError:
    """Measured minus commanded number of one control (SI unit), with commands delayed by their latency."""

    control: str
    bias: float
    rms: float
    unit: str


@dataclasses.dataclass(frozen=True)
class Health:
    """Quality report of a recording.

    Attributes:
        source: description of the recording.
        simulated: True if the robot was a simulation; None: not stated.
        duration: time from the start for which all poses and tensions are known (s).
        rest: interval in which the robot rests (s), or None.
        rod_length: estimates (m) from each body away from the clamped end, at rest; none from bodies that
            lean by more than 10 degrees, and none without a rest.
        streams: quality of each topic.
        latency: latency of controls after commands, or None if it cannot be estimated.
        control_errors: errors of each control; empty without measured and commanded ones.
        findings: errors and repairs, the gravest first.
    """

    source: str
    simulated: bool | None
    duration: float
    rest: tuple[float, float] | None
    rod_length: tuple[float, ...]
    streams: tuple[StreamHealth, ...]
    latency: _Latency | None
    control_errors: tuple[_ControlError, ...]
    findings: tuple[Finding, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return the report as plain values for JSON."""
        return dataclasses.asdict(self)


def health_of(recording: Recording) -> Health:
    """Return the quality report of a recording."""
    streams = [_of_body(body, recording) for body in (*recording.bodies, recording.base) if body is not None]
    streams += [_stream(it.topic, it.output.fields[0], it.time, recording) for it in recording.sensors]
    if (control := recording.control) is not None:
        for k, source in enumerate(recording.config.measured):
            before = sum(len(each.order) for each in recording.config.measured[:k])
            values = control.values[:, before : before + len(source.order)]
            noise, what = _noise(control.time, values, recording.rest), f"measured {source.kind.plural}"
            streams.append(
                _stream(source.topic, what, control.time, recording, noise=noise, unit=source.kind.unit)
            )
    if recording.command is not None:
        none = {"rate": None, "jitter": None, "missing": None, "gaps": None}
        streams.append(
            _stream(recording.command.topic, "commands", recording.command.time, recording, **none)
        )
    where = rest_positions(recording.bodies, recording.rest)
    lengths = () if where is None else tuple(rod_lengths(recording.bodies, where).tolist())
    latency = latency_of(recording)
    return Health(
        source=recording.source,
        simulated=recording.simulated,
        duration=recording.end,
        rest=recording.rest,
        rod_length=lengths,
        streams=tuple(streams),
        latency=latency,
        control_errors=_control_errors(recording, latency),
        findings=(*recording.findings, *_about_latency(recording, latency)),
    )


# streams


def _of_body(body: Body, recording: Recording) -> StreamHealth:
    turn_noise = None
    if body.quaternion is not None:
        # cumulative sum of small rotations, whose differences are differences of angles
        turns = np.concatenate([np.zeros((1, 3)), np.cumsum(rotation_steps(body.quaternion), axis=0)])
        turn_noise = _noise(body.time, turns, recording.rest)
    noise = _noise(body.time, body.position, recording.rest)
    return _stream(body.topic, body.name, body.time, recording, noise=noise, turn_noise=turn_noise)


def _stream(
    topic: str, what: str, time: Float[np.ndarray, " n"], recording: Recording, **known: Any
) -> StreamHealth:
    """Return the quality of a topic; `known` are numbers that its times do not tell."""
    steps, usual = np.diff(time), period(time)
    delay = recording.delays.get(topic, float("nan"))
    numbers: dict[str, Any] = dict.fromkeys(("rate", "jitter", "missing", "gaps", "noise", "turn_noise"))
    if usual > 0.0:
        expected = int(np.sum(np.round(steps / usual))) + 1
        numbers |= {
            "rate": round(1.0 / usual, 6),
            "jitter": float(np.std(steps[steps <= 1.5 * usual])),
            "missing": max(0.0, 1.0 - len(time) / expected),
            "gaps": int(np.sum(steps > 1.5 * usual)),
        }
    return StreamHealth(
        topic=topic,
        what=what,
        rows=len(time),
        longest_gap=float(np.max(steps, initial=0.0)),
        delay=delay if np.isfinite(delay) else None,
        **numbers | known,
    )


def _noise(
    time: Float[np.ndarray, " n"], values: Float[np.ndarray, "n size"], rest: tuple[float, float] | None
) -> float | None:
    """Return the noise's standard deviation from third differences, at rest if possible; None if unknown."""
    # equilibria are not smooth in time
    if period(time) > 0.95 * SLOW:
        return None
    still = values[rest_mask(time, rest)]
    known = still if len(still) >= _ENOUGH else values
    if len(known) < _ENOUGH:
        return None
    # third differences remove smooth motion and multiply the noise by √20
    return float(NORMAL * np.median(np.abs(np.diff(known, 3, axis=0))) / np.sqrt(20.0))


# controls and commands


def latency_of(recording: Recording) -> _Latency | None:
    """Return the latency of measured controls after commands; None without both, or if they hardly change."""
    control, command = recording.control, recording.command
    if control is None or command is None or len(control.time) < _ENOUGH:
        return None
    quiet = QUIET if command.quantities[:1] and command.quantities[0][0] == "tension" else 0.0
    if np.max(np.std(command.values, axis=0)) <= quiet:
        return None
    fine = np.arange(control.time[0], control.time[-1] + _FINE, _FINE)
    if len(fine) > 1_000_000:
        return None

    def missed(delay: float, lag: float) -> float:
        expected = _followed(command, fine, delay, lag)
        seen = expected[np.clip(np.searchsorted(fine, control.time - 1e-9), 0, len(fine) - 1)]
        error = control.values - seen
        return float(np.sqrt(np.mean((error - error.mean(axis=0)) ** 2)))

    shifts = np.arange(0.0, LONGEST_LATENCY, 5 * _FINE)
    by_shift = [missed(shift, 0.0) for shift in shifts]
    shift = float(shifts[int(np.argmin(by_shift))])
    lags = (0.0, 0.01, 0.02, 0.04, 0.08, 0.16)
    delays = (0.0, 0.02, 0.04, 0.06, 0.08, 0.1, 0.15, 0.2)
    first = min((missed(delay, lag), delay, lag) for delay in delays for lag in lags)
    simplex = np.array(first[1:]) + np.array([[0.0, 0.0], [0.01, 0.0], [0.0, 0.01]])
    options: Any = {"xatol": 5e-4, "fatol": 1e-6, "maxiter": 80, "initial_simplex": simplex}
    minimize: Any = scipy.optimize.minimize
    best = minimize(lambda pair: missed(*np.abs(pair)), first[1:], method="Nelder-Mead", options=options)
    delay, lag = np.abs(best.x)
    return _Latency(shift, round(float(delay), 4), round(float(lag), 4))


def _followed(command: ControlRows, time: Float[np.ndarray, " n"], delay: float, lag: float) -> np.ndarray:
    """Return commands, each held until the next, after a delay (s) and a first-order lag (s)."""
    last = np.searchsorted(command.time, time - delay + 1e-9, side="right") - 1
    held = command.values[np.maximum(last, 0)]
    if lag < 1e-6:
        return held
    stays = np.exp(-_FINE / lag)
    begin = scipy.signal.lfiltic([1.0 - stays], [1.0, -stays], [1.0])
    filtered, _ = scipy.signal.lfilter(
        [1.0 - stays], [1.0, -stays], held, axis=0, zi=begin[:, None] * held[:1]
    )
    return np.asarray(filtered)


def _control_errors(recording: Recording, latency: _Latency | None) -> tuple[_ControlError, ...]:
    control, command = recording.control, recording.command
    if control is None or command is None:
        return ()
    late = latency.shift if latency else recording.config.command.latency if recording.config.command else 0.0
    known = control.time - late >= command.time[0]
    if not known.any():
        return ()
    last = np.searchsorted(command.time, control.time[known] - late + 1e-9, side="right") - 1
    error = control.values[known] - command.values[np.maximum(last, 0)]
    return tuple(
        _ControlError(name, float(column.mean()), float(np.sqrt(np.mean(column**2))), unit_of(name))
        for name, column in zip(labels(control.quantities), error.T, strict=True)
    )


def _about_latency(recording: Recording, latency: _Latency | None) -> list[Finding]:
    if latency is None or recording.config.command is None:
        return []
    source = recording.config.command
    stated = source.latency
    if abs(latency.total - stated) <= _OFF:
        return []
    what = (
        f"{source.kind.plural} follow commands after {latency.total:.2f} s; the configuration's latency is "
        f"{stated:g} s"
    )
    return [Finding("warning", source.topic, what)]
