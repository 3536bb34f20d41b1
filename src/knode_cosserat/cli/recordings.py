"""Commands on recordings: inspect, and record-virtual."""

from __future__ import annotations

from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from knode_cosserat.cli.arguments import (
    Json,
    NetCDF,
    Picture,
    argument,
    figures,
    files_of,
    load_recordings,
    option,
    require_trajectory_name,
    require_writable,
)
from knode_cosserat.cli.output import table, write_output
from knode_cosserat.cli.program import app
from knode_cosserat.recordings.formats import formats, written_suffixes

if TYPE_CHECKING:
    from knode_cosserat.recordings import Recording
    from knode_cosserat.recordings.health import Health, StreamHealth


@app.command()
def inspect(
    recording: Annotated[
        list[Path],
        argument(
            "RECORDING",
            f"File or folder of one of these formats: {', '.join(kind.name for kind in formats())}. Several "
            "files are one recording, each with its own clock.",
        ),
    ],
    config: Path | None = None,
    plot: Annotated[Path | None, Picture] = None,
    out: Path | None = None,
    as_json: Json = False,
) -> None:
    """Report the quality of a recording.

    Sampling rates, gaps, swapped axes, noise, and the delay and error of measured controls relative to
    commands. Lists the defects found and their corrections, and the use of every column. For a recording
    with other topics or columns than those known, it proposes a configuration, and reads the recording with
    it. Offset and drift of the clocks of several files are found from the motion.

    Options:
        config (--config YAML): Meaning of the recording's topics or columns. Default: the paper's robot for
            bags; titles and comments for tables; or a proposal.
        out (--out YAML): Write the configuration to this file, for --config: the proposal, if there is one.

    Examples:
        inspect sine_1p0.bag
        inspect log.csv --out recording.yaml
        inspect sine_1p0.bag --config my-robot.yaml --plot health.png
        inspect table.csv --json
        inspect motors.csv mocap.csv
    """
    require_writable(out, plot)
    drawing = figures() if plot else None
    loaded, proposed = _loaded(recording, config)
    report = loaded.health()
    if drawing:
        drawing.health(loaded).savefig(plot)
    if out:
        out.write_text(loaded.config.to_yaml(brief=True), encoding="utf-8")
    written = {name: path for name, path in {"plot": plot, "out": out}.items() if path or as_json}
    named = " + ".join(map(str, recording))
    content = {"recording": named, **report.to_dict(), "columns": dict(loaded.uses)}
    lines = [*_lines(report), "", *_uses(loaded)]
    if proposed:
        content["proposed_config"] = proposed
        lines += ["", "proposed configuration, for a file of --config:", "", *proposed.splitlines()]
    write_output(as_json, content, lines, **written)


def _loaded(paths: list[Path], config: Path | None) -> tuple[Recording, str]:
    """Return the recording, and the YAML text of a configuration if one is proposed; else empty text."""
    from knode_cosserat.recordings import load_recording, proposed_config
    from knode_cosserat.recordings.findings import RecordingError

    paths = [file for path in paths for file in files_of(path)]
    if len(paths) > 1:
        proposed = None if config else proposed_config(paths)
        loaded = load_recording(paths, config or proposed)
        # other recordings have other offsets: each is found when it is read
        return loaded, loaded.config.replace(files=proposed.files).to_yaml(brief=True) if proposed else ""
    (path,) = paths
    try:
        (loaded,) = load_recordings([path], config, proposals=False)
        # exports of motion capture are read by a proposal, which states the axis that points up
        is_proposal = config is None and loaded.config.up is not None
    except ValueError as unread:
        if config is not None:
            raise
        try:
            meaning = proposed_config(path)
        except RecordingError:
            raise unread from None
        loaded, is_proposal = load_recording(path, meaning), True
    return loaded, loaded.config.to_yaml(brief=True) if is_proposal else ""


def _uses(loaded: Recording) -> list[str]:
    """Return lines on the use of each column or topic, those without any last."""
    placed = {name: use for name, use in loaded.uses.items() if use}
    others = [name for name in loaded.uses if name not in placed]
    lines = table([["column or topic", "use"], *([name, use] for name, use in placed.items())])
    return [*lines, *([f"not placed: {', '.join(others)}"] if others else [])]


def _lines(report: Health) -> list[str]:
    simulated = {True: "yes", False: "no", None: "not stated"}[report.simulated]
    rest = "never at rest" if report.rest is None else "at rest from {:.2f} to {:.2f} s".format(*report.rest)
    lines = [report.source, f"simulated: {simulated}", f"{report.duration:.2f} s, {rest}"]
    if report.rod_length:
        lengths = ", ".join(f"{length:.4f}" for length in report.rod_length)
        lines.append(f"length of the rod, from each body: {lengths} m")
    lines += ["", *table([_TITLES, *map(_row, report.streams)])]
    if report.latency is not None:
        it = report.latency
        lines += [
            "",
            f"controls follow commands: best shift {it.shift:.3f} s; or a delay of {it.delay:.3f} s and a "
            f"first-order lag of {it.lag:.3f} s",
        ]
    if report.control_errors:
        rows = [["control", "measured minus commanded", "root mean square"]]
        rows += [
            [it.control, f"{it.bias:+.3g} {it.unit}", f"{it.rms:.3g} {it.unit}"]
            for it in report.control_errors
        ]
        lines += ["", *table(rows)]
    findings = [str(finding) for finding in report.findings]
    return [*lines, "", *(findings or ["no defects found"])]


_TITLES = [
    "topic",
    "what",
    "rows",
    "rate [Hz]",
    "jitter [ms]",
    "missing [%]",
    "gaps",
    "longest [ms]",
    "delay [ms]",
    "noise",
    "angle noise [mrad]",
]


def _row(stream: StreamHealth) -> list[str]:
    is_body = stream.what != "commands" and not stream.what.startswith("measured ")
    factor, unit = (1e3, "mm") if is_body else (1.0, stream.unit)
    noise = f"{_number_text(stream.noise, factor, '.3f' if is_body else '.3g')} {unit}"
    return [
        stream.topic,
        stream.what,
        str(stream.rows),
        _number_text(stream.rate, 1.0, ".2f"),
        _number_text(stream.jitter, 1e3, ".3f"),
        _number_text(stream.missing, 100.0, ".2f"),
        "-" if stream.gaps is None else str(stream.gaps),
        _number_text(stream.longest_gap, 1e3, ".1f"),
        _number_text(stream.delay, 1e3, ".2f"),
        "-" if stream.noise is None else noise,
        _number_text(stream.turn_noise, 1e3, ".2f"),
    ]


def _number_text(value: Any, factor: float, form: str) -> str:
    return "-" if value is None else format(factor * value, form)


# a test robot


class _MotionOptions(NamedTuple):
    """Motion of a test robot, and its noise.

    Options:
        signal (CONTROLS): Commanded tensions: sine:PERIOD (s), step:HEIGHT (N, after 2 s) or random:SEED,
            around the paper's rest tension; or any controls of `simulate`, after 1 s of rest.
        seconds (--seconds S): Duration (s).
        seed (--seed N≥0): Random seed of sensor noise and body mounting.
        swap (--swap S): Time when a tracked body swaps axes (s). Default: never.
    """

    signal: str
    seconds: float = 16.0
    seed: int = 0
    swap: float | None = None


class _RecordingFiles(NamedTuple):
    """Files of a recording and of the truth.

    Options:
        truth (--truth FILE): Write the robot with --imperfections to this YAML file.
    """

    out: Annotated[Path, option("FILE", f"Write this recording: {', '.join(written_suffixes())}.")]
    truth: Path | None = None
    states: Annotated[Path | None, NetCDF] = None


@app.command()
def record_virtual(
    motion: _MotionOptions,
    files: _RecordingFiles,
    imperfections: Annotated[
        int | None,
        option(
            "SEED",
            "Record the paper's robot with random imperfections (friction, sleeve, load-cell errors, …) "
            "instead; equal seeds give equal robots.",
            min=0,
            max=2**32 - 1,
            show_default="the test robot",
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Record a simulated robot as a bag or table.

    The recording has the format of the paper's robot. The simulation includes effects that models do not
    have: tendon friction, ribs with masses, a sleeve, motor lag and sensor noise. --states writes the true
    states. With --imperfections the robot is the paper's with random effects that `identify` can find, and
    little damping.

    Examples:
        record-virtual sine:1.0 --out x.bag
        record-virtual step:4.4 --out step.bag --seconds 12 --states truth.nc
        record-virtual random:0 --out random.bag --seed 3 --swap 9
        record-virtual sine:3.0 --out x.bag --imperfections 7 --truth true-robot.yaml
    """
    signal, seconds, seed, swap = motion
    out, truth, states = files
    require_trajectory_name(states)
    for path in (out, states, truth):
        require_writable(path)
    if truth and imperfections is None:
        raise typer.BadParameter("--truth needs --imperfections SEED: it writes that robot")
    import knode_cosserat as kc
    from knode_cosserat.identification.imperfections import drawn_robot
    from knode_cosserat.recordings import virtual

    begin = virtual.BEFORE_STEP if signal.startswith("step") else virtual.RESTING
    if 0.0 < seconds <= begin and not signal.startswith("constant"):
        raise ValueError(
            f"--seconds must be above {begin:g}, when the signal {signal} begins (got {seconds:g})"
        )
    began = perf_counter()
    drawn = None if imperfections is None else drawn_robot(imperfections)
    robot: Any = None if drawn is None else drawn.robot
    trajectory = virtual.record_virtual(out, signal, seconds, seed, virtual.Sensors(swap=swap), robot=robot)
    elapsed = perf_counter() - began
    facts: dict[str, Any] = {
        "signal": signal,
        "seconds": seconds,
        "seed": seed,
        "swap": swap,
        "simulated": True,
    }
    lines = [f"recorded {seconds:g} s of {signal} (simulated) in {elapsed:.1f} s"]
    written = {"out": out} | ({"states": states} if states or as_json else {})
    if states:
        trajectory.save(states)
    if drawn is not None:
        facts["imperfections"] = dict(drawn.values)
        lines.append(f"effects of the robot: {', '.join(drawn.effects)}")
    if drawn is not None and truth is not None:
        kc.save_robot(drawn.robot, truth)
        written["truth"] = truth
    write_output(as_json, facts | {"computing_time": round(elapsed, 2)}, lines, **written)
