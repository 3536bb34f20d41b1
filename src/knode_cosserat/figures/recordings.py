"""Figures of recordings; they need matplotlib, the extra `viz`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from knode_cosserat._arguments import check_arguments
from knode_cosserat.figures.drawing import AXES, Tips, draw_tips, legend_above, line, tips_of
from knode_cosserat.figures.style import PALETTE, TWO_COLUMNS, new_figure
from knode_cosserat.metrics import dtw_distance, rms_distance
from knode_cosserat.recordings.quantities import QUANTITIES, labels

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from knode_cosserat.recordings.health import Health
    from knode_cosserat.recordings.measurements import Measurements
    from knode_cosserat.recordings.recording import Recording

#: markers of events: text in the finding, colour and label
_MARKS = (
    ("axes were swapped", PALETTE[1], "axes swapped"),
    ("clock", PALETTE[3], "clock jumped"),
    ("left out", PALETTE[4], "left out"),
)


def health(recording: Recording) -> Figure:
    """Return a figure of a recording and its quality: controls, positions, missing frames and noise."""
    check_arguments(health, locals())
    report = recording.health()
    robot = {True: "a simulated robot", False: "a physical robot", None: "not stated whether simulated"}
    with new_figure(TWO_COLUMNS, 6.0) as figure:
        figure.suptitle(f"{recording.source}\n{report.duration:.2f} s, {robot[recording.simulated]}")
        left, right = figure.subfigures(1, 2, width_ratios=(2.3, 1.0))
        axes = left.subplots(5, 1, sharex=True, height_ratios=(1.3, 1.0, 1.0, 1.0, 0.9))
        _draw_controls(axes[0], recording)
        _draw_positions(axes[1:4], recording)
        _draw_frames(axes[4], recording)
        axes[4].set_xlabel("time [s]")
        left.align_ylabels(axes)
        axes[0].set_xlim(min(0.0, *(body.time[0] for body in recording.bodies)), _end(recording))
        above, below = right.subplots(2, 1)
        _draw_noise(above, recording, report)
        _draw_errors(below, recording, report)
    return figure


def prediction_against_measurement(prediction: Tips, recording: Measurements) -> Figure:
    """Return a figure of a predicted and a measured tip path: over time, from above, and their distance.

    The title has the DTW distance and the RMSE. The label states if the robot was simulated.

    Raises:
        ValueError: the numbers of rows differ, or a position is not finite.
    """
    check_arguments(prediction_against_measurement, locals())
    predicted, measured = tips_of(prediction), tips_of(recording)
    if len(predicted) != len(measured):
        raise ValueError(
            f"the prediction has {len(predicted)} rows and the recording {len(measured)}; "
            "both must have the same number"
        )
    distance = np.linalg.norm(predicted - measured, axis=-1)
    dtw, rmse = dtw_distance(predicted, measured), float(rms_distance(predicted, measured))
    robot = "simulated robot" if recording.simulated else "robot"
    time = recording.time
    with new_figure(TWO_COLUMNS, 4.4) as figure:
        figure.suptitle(
            f"Tip, predicted and measured: DTW {dtw:.2f} m over {len(distance)} rows, "
            f"RMSE {100 * rmse:.1f} cm"
        )
        left, right = figure.subfigures(1, 2, width_ratios=(1.25, 1.0))
        axes = left.subplots(4, 1, sharex=True)
        draw_tips(axes[:3], {f"measured on a {robot}": (time, measured), "predicted": (time, predicted)})
        axes[2].set_xlabel("")
        legend_above(axes[0])
        axes[3].plot(time, distance, color=PALETTE[-1])
        axes[3].set(xlabel="time [s]", ylabel="distance [m]", ylim=(0.0, None))
        left.align_ylabels()
        above = right.subplots()
        for i, tip in enumerate((measured, predicted)):
            above.plot(tip[:, 0], tip[:, 1], **line(i))
        above.set(xlabel="tip x [m]", ylabel="tip y [m]", title="seen from above")
        above.set_aspect("equal", adjustable="datalim")
    return figure


def _end(recording: Recording) -> float:
    return float(max(body.time[-1] for body in recording.bodies))


def _draw_controls(axes: Any, recording: Recording) -> None:
    """Draw measured controls as lines and commanded ones as dotted steps."""
    end = _end(recording)
    stream = recording.control or recording.command
    quantities = stream.quantities if stream else ()
    names = [name.replace("_", " ") for name in labels(quantities)]
    if recording.command is not None:
        time = np.append(recording.command.time, max(end, recording.command.time[-1]))
        for k, sent in enumerate(recording.command.values.T):
            axes.step(
                time,
                np.append(sent, sent[-1]),
                where="post",
                linestyle=":",
                linewidth=1.1,
                color=PALETTE[k % len(PALETTE)],
                label="commanded (dotted)" if k == 0 else None,
            )
    if recording.control is not None:
        for k, (name, values) in enumerate(zip(names, recording.control.values.T, strict=True)):
            axes.plot(
                recording.control.time,
                values,
                linewidth=1.0,
                color=PALETTE[k % len(PALETTE)],
                label=name,
            )
    units = dict.fromkeys(f"{name} [{QUANTITIES[name].unit}]" for name, _ in quantities)
    axes.set_ylabel(", ".join(units) or "no controls")
    if not names:
        return
    axes.legend(
        loc="lower center",
        bbox_to_anchor=(0.5, 1.0),
        ncols=len(names) + 1,
        columnspacing=1.2,
        handlelength=1.8,
    )


def _draw_positions(axes: Any, recording: Recording) -> None:
    """Draw x, y and z of all bodies; lines break at gaps too long to be bridged."""
    from knode_cosserat.recordings.recording import bridge

    for k, body in enumerate(recording.bodies):
        long = np.diff(body.time) > bridge(body.time, recording.config.longest_gap)
        breaks = np.flatnonzero(long) + 1
        time, position = (np.insert(values, breaks, np.nan, axis=0) for values in (body.time, body.position))
        for axis in range(3):
            axes[axis].plot(
                time, position[:, axis], linewidth=1.0, color=PALETTE[k % len(PALETTE)], label=body.name
            )
    for axis, name in enumerate(AXES):
        axes[axis].set_ylabel(f"{name} [m]")
    if recording.rest is not None:
        for axis in axes:
            axis.axvspan(*recording.rest, color="#EEEEEE", zorder=0)
    legend_above(axes[0])


def _draw_frames(axes: Any, recording: Recording) -> None:
    """Draw missing frames and events, a row per stream."""
    from knode_cosserat.recordings.recording import bridge
    from knode_cosserat.recordings.streams import period

    streams = [(body.name, body.topic, body.time) for body in (*recording.bodies, recording.base) if body]
    if recording.control is not None:
        streams.append(("controls", recording.control.topic, recording.control.time))
    named: set[str] = set()

    def once(name: str) -> str | None:
        new = name not in named
        named.add(name)
        return name if new else None

    for row, (_, topic, time) in enumerate(streams):
        steps, limit = np.diff(time), bridge(time, recording.config.longest_gap)
        for begin, step in zip(time[:-1], steps, strict=True):
            if step > limit:
                axes.barh(row, step, left=begin, height=0.8, color=PALETTE[1], alpha=0.5, label=once("gap"))
        short = (steps > 1.5 * period(time)) & (steps <= limit)
        where = time[:-1][short] + steps[short] / 2
        if len(where):
            axes.plot(
                where, np.full(len(where), row), "|", color="#555555", markersize=7, label=once("bridged")
            )
        for finding in recording.findings:
            mark = next((mark for mark in _MARKS if mark[0] in finding.message), None)
            if finding.topic == topic and finding.times and mark is not None:
                at = np.array(finding.times)
                axes.plot(at, np.full(len(at), row), "v", color=mark[1], markersize=6, label=once(mark[2]))
    axes.set_yticks(range(len(streams)), [name for name, _, _ in streams])
    axes.set(ylim=(len(streams) - 0.4, -0.6), ylabel="frames")
    if named:
        legend_above(axes)


def _draw_noise(axes: Any, recording: Recording, report: Health) -> None:
    """Draw the noise of positions and, on a second axis, of orientations."""
    names = [body.name for body in (*recording.bodies, recording.base) if body]
    bodies = [stream for stream in report.streams if stream.what in names]
    at = np.arange(len(bodies))
    axes.bar(at - 0.2, [1e3 * (each.noise or 0.0) for each in bodies], 0.38, color=PALETTE[0])
    axes.set_ylabel("noise of position [mm]", color=PALETTE[0])
    axes.set_xticks(at, [each.what for each in bodies], rotation=30, ha="right")
    axes.set_title("noise (one σ)")
    if any(each.turn_noise is not None for each in bodies):
        other = axes.twinx()
        other.bar(at + 0.2, [1e3 * (each.turn_noise or 0.0) for each in bodies], 0.38, color=PALETTE[1])
        other.set_ylabel("of orientation [mrad]", color=PALETTE[1])
        other.grid(False)
        other.spines["right"].set_visible(True)


def _draw_errors(axes: Any, recording: Recording, report: Health) -> None:
    """Draw RMS and bias of measured minus commanded controls, or a note without commands."""
    if not report.control_errors:
        axes.axis("off")
        axes.text(0.5, 0.5, "no commands to compare\nmeasured controls with", ha="center", va="center")
        return
    at = np.arange(len(report.control_errors))
    colours = [PALETTE[k % len(PALETTE)] for k in at]
    axes.bar(at, [each.rms for each in report.control_errors], 0.6, color=colours)
    axes.plot(at, [each.bias for each in report.control_errors], "kD", markersize=5)
    axes.axhline(0.0, color="#333333", linewidth=0.8)
    axes.set_xticks(at, [each.control.replace("_", " ") for each in report.control_errors])
    units = dict.fromkeys(each.unit for each in report.control_errors)
    axes.set(ylabel=f"measured less commanded [{', '.join(units)}]")
    late = ""
    if report.latency is not None:
        late = f"\ncommands {1e3 * report.latency.shift:.0f} ms later; lag {1e3 * report.latency.lag:.0f} ms"
    axes.set_title(f"error of controls: RMS, and bias (diamonds){late}")
