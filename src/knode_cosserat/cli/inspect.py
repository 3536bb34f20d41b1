"""The command that reports on a recording."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from knode_cosserat.cli.arguments import Json, Picture, figures, require_writable
from knode_cosserat.cli.program import app, examples
from knode_cosserat.cli.telling import table, tell

if TYPE_CHECKING:
    from knode_cosserat.recordings.quality import Health, StreamHealth


@app.command(
    epilog=examples(
        "inspect sine_1p0.bag",
        "inspect sine_1p0.bag --config my-robot.yaml --plot health.png",
        "inspect table.csv --json",
    )
)
def inspect(
    recording: Annotated[
        Path,
        typer.Argument(
            metavar="RECORDING", help="A bag of ROS 1 or 2 (a file or a folder), or a CSV or Parquet table."
        ),
    ],
    config: Annotated[
        Path | None,
        typer.Option(
            metavar="YAML",
            help="What its topics or columns mean.",
            show_default="the paper's robot for bags, what it says itself for a table",
        ),
    ] = None,
    plot: Annotated[Path | None, Picture] = None,
    as_json: Json = False,
) -> None:
    """Report how good a recording is.

    Rates, gaps, swapped axes, noise, how late tensions follow commands and how far they are from them; what
    was wrong, and what was done about it.
    """
    require_writable(figure=plot)
    if plot:
        figures()
    import knode_cosserat as kc

    read = kc.load_recording(recording, kc.RecordingConfig.load(config) if config else None)
    report = read.health()
    if plot:
        from knode_cosserat.evaluation import recording_figures

        recording_figures.health(read, report).savefig(plot)
    written = {"plot": plot} if plot or as_json else {}
    tell(as_json, {"recording": str(recording), **report.to_dict()}, _lines(report), **written)


def _lines(report: Health) -> list[str]:
    said = {True: "yes", False: "no", None: "not stated"}[report.simulated]
    lines = [report.source, f"simulated: {said}", _times(report)]
    if report.rod_length:
        lengths = ", ".join(f"{length:.4f}" for length in report.rod_length)
        lines.append(f"length of the rod by each body: {lengths} m")
    lines += ["", *table([_TITLES, *map(_row, report.streams)])]
    if report.latency is not None:
        it = report.latency
        lines += [
            "",
            f"tensions follow commands: nearest {it.shift:.3f} s later; as a lag, {it.lag:.3f} s after a "
            f"delay of {it.delay:.3f} s",
        ]
    if report.tension_errors:
        rows = [["tendon", "measured less commanded [N]", "root mean square [N]"]]
        rows += [[str(it.tendon), f"{it.bias:+.3f}", f"{it.rms:.3f}"] for it in report.tension_errors]
        lines += ["", *table(rows)]
    findings = [str(finding) for finding in report.findings]
    return [*lines, "", *(findings or ["nothing wrong was found"])]


def _times(report: Health) -> str:
    rest = (
        "never at rest"
        if report.rest is None
        else f"at rest from {report.rest[0]:.2f} to {report.rest[1]:.2f} s"
    )
    return f"{report.duration:.2f} s, {rest}"


_TITLES = [
    "topic", "what", "rows", "rate [Hz]", "jitter [ms]", "missing [%]", "gaps", "longest [ms]", "delay [ms]",
    "noise", "of angles [mrad]",
]  # fmt: skip


def _row(stream: StreamHealth) -> list[str]:
    noise = _told(stream.noise, 1.0, ".3f") + " N" if stream.what == "measured tensions" else None
    if noise is None:
        noise = _told(stream.noise, 1e3, ".3f") + " mm"
    return [
        stream.topic,
        stream.what,
        str(stream.rows),
        _told(stream.rate, 1.0, ".2f"),
        _told(stream.jitter, 1e3, ".3f"),
        _told(stream.missing, 100.0, ".2f"),
        "-" if stream.gaps is None else str(stream.gaps),
        _told(stream.longest_gap, 1e3, ".1f"),
        _told(stream.delay, 1e3, ".2f"),
        "-" if stream.noise is None else noise,
        _told(stream.turn_noise, 1e3, ".2f"),
    ]


def _told(value: Any, factor: float, form: str) -> str:
    return "-" if value is None else format(factor * value, form)
