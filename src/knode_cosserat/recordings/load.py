"""Reading of recordings: from a file of any format to a `Recording` on one clock and in the robot's frame."""

from __future__ import annotations

import dataclasses
import importlib.resources
from collections.abc import Mapping, Sequence
from pathlib import Path

from knode_cosserat._arguments import check_arguments
from knode_cosserat._files.reading import file_hash
from knode_cosserat.recordings import checks, frame
from knode_cosserat.recordings.config import RecordingConfig
from knode_cosserat.recordings.files import File, clock_deviation, qualified, streams_of_files
from knode_cosserat.recordings.findings import SEVERITIES, Finding, RecordingError, naming
from knode_cosserat.recordings.formats import format_of
from knode_cosserat.recordings.formats.csv_table import read_csv
from knode_cosserat.recordings.messages import Bag, topics_read
from knode_cosserat.recordings.proposal import (
    config_of_content,
    config_of_files,
    default_config,
    useful_topics,
)
from knode_cosserat.recordings.recording import Recording
from knode_cosserat.recordings.streams import Rows, Stream, offsets, rows_on_one_clock
from knode_cosserat.recordings.table import Table

#: file name of the package's own recording
EXAMPLE = "sine_1p0.csv"


def load_recording(
    path: str | Path | Sequence[str | Path], config: RecordingConfig | str | Path | None = None
) -> Recording:
    """Read a recording: a bag, a table, an export of motion capture, or several of them as one recording.

    Bags are of ROS 1 (.bag, also .bag.active) or ROS 2 (.mcap, .db3, a folder). Tables are CSV (delimiters
    `,`, `;` or tab; decimal point or comma) or Parquet. Exports are CSV of OptiTrack Motive and Vicon Nexus,
    TRC and C3D. A text file may be compressed (.csv.gz). `formats` lists all formats and takes new ones.

    The content of the file decides its format; the name does only if the first bytes are damaged. A bag
    that was cut, or whose recorder was killed, is read up to that point. Errors and repairs are reported
    in the recording's `findings`.

    Several files, such as `["motors.csv", "mocap.csv"]`, are one recording of the same time. Each may have
    its own clock: offset and drift are those of `config.files`, or found from the motion that controls cause,
    with a finding on their doubt; `recording.config.files` states them. Dead time of the robot cannot be told
    from an offset of clocks; the effect `latency` of `identify` takes what is left.

    Args:
        path: the file or folder, or a list of them.
        config: meaning of its topics or columns, or the YAML file that states it; None: the paper's robot for
            bags, the titles and comments of tables, and the names of the bodies in exports of motion capture;
            for several files that of `proposed_config`.

    Raises:
        RecordingError: the file cannot be read, a topic or column is missing or unusable, or the clocks of
            several files cannot be matched; one line.
        ImportError: a library for this kind of file is not installed.
    """
    check_arguments(load_recording, locals())
    if isinstance(config, str | Path):
        config = RecordingConfig.load(config)
    if not isinstance(path, str | Path):
        paths = _listed(path)
        recording = _recording_of_files(paths, config)
        return dataclasses.replace(recording, files=_hashes(paths))
    path = Path(path)
    with naming(path):
        wanted = topics_read(config or RecordingConfig.paper_robot())
        recording = _recording(format_of(path).read(path, wanted), config, path.name)
    return dataclasses.replace(recording, files=_hashes([path]))


def _hashes(paths: Sequence[Path]) -> tuple[tuple[str, str], ...]:
    """Return name and hash of each file; none if one can be read once only."""
    found = tuple((path.name, file_hash(path)) for path in paths)
    return found if all(sha256 for _, sha256 in found) else ()


def load_example() -> Recording:
    """Return the package's example: sinusoidal tensions of period 1 s, 16 s long, 20 rows per second.

    The robot was simulated with PyElastica in place of the paper's robot; it is not a physical one.
    """
    file = importlib.resources.files("knode_cosserat.recordings") / "data" / EXAMPLE
    with naming(EXAMPLE):
        return _recording(read_csv(file.read_bytes()), None, EXAMPLE)


def proposed_config(path: str | Path | Sequence[str | Path]) -> RecordingConfig:
    """Return a configuration proposed for a recording, with remarks on its guesses.

    Bodies, and what drives the robot, are recognised by the names and types of topics, or by the titles of
    columns and their units. Places on the rod are guessed from distances at the start.

    Args:
        path: the file or folder, or a list of them that are one recording.

    Raises:
        RecordingError: the file cannot be read, or nothing in it looks like the poses of a body.
    """
    check_arguments(proposed_config, locals())
    if not isinstance(path, str | Path):
        return config_of_files(_contents(_listed(path), None))
    with naming(path):
        return config_of_content(_whole(Path(path)))


def _listed(paths: Sequence[str | Path]) -> list[Path]:
    """Return the paths of several files. Raises `RecordingError` for anything else."""
    for path in paths:
        if not isinstance(path, str | Path):
            raise RecordingError(f"path holds a {type(path).__name__}; allowed are paths of files")
    if not len(paths):
        raise RecordingError("path is an empty list; allowed is one file or more")
    return [Path(path) for path in paths]


def _whole(path: Path) -> Bag | Table:
    """Return a file's content, with all topics of a bag that may be of use."""
    kind = format_of(path)
    content = kind.read(path, ())
    return kind.read(path, useful_topics(content)) if isinstance(content, Bag) else content


def _contents(paths: Sequence[Path], config: RecordingConfig | None) -> list[File]:
    """Return the content of several files. Raises `RecordingError`."""
    files = []
    for path in paths:
        with naming(path):
            content = _whole(path) if config is None else format_of(path).read(path, topics_read(config))
        files.append(File(path.name, content))
    return qualified(files)


def _recording_of_files(paths: Sequence[Path], config: RecordingConfig | None) -> Recording:
    """Return the recording in several files. Raises `RecordingError`."""
    files = _contents(paths, config)
    findings = [finding for file in files for finding in file.content.findings]
    if config is None:
        config = config_of_files(files)
        findings += [Finding("warning", "", remark) for remark in config.remarks]
    for file in files:
        config = file.content.completed(config)
    names = " + ".join(path.name for path in paths)
    with naming(names):
        rows, streams, config = streams_of_files(files, config, findings)
        uses = {name: use for file in files for name, use in file.content.uses(config).items()}
        recording = _cleaned(rows, streams, config, findings, (names, uses))
        return dataclasses.replace(recording, clock_deviation=clock_deviation(files, config))


def _recording(content: Bag | Table, config: RecordingConfig | None, name: str) -> Recording:
    """Return the recording of a file's content; `name` is its source if the content states none.

    Raises:
        RecordingError: a topic or column is missing or unusable.
    """
    findings = list(content.findings)
    if config is None:
        config = default_config(content)
        findings += [Finding("warning", "", remark) for remark in config.remarks]
    config = content.completed(config)
    streams = content.streams(config, findings)
    rows = rows_on_one_clock(streams, config, findings)
    return _cleaned(rows, streams, config, findings, (content.source or name, content.uses(config)))


def _cleaned(
    rows: Mapping[str, Rows],
    streams: Mapping[str, Stream],
    config: RecordingConfig,
    findings: list[Finding],
    origin: tuple[str, Mapping[str, str]],
) -> Recording:
    """Return the recording of rows on one clock; `origin` are its source, and the uses of its columns.

    Raises:
        RecordingError: a topic is unusable.
    """
    source, uses = origin
    sensed = checks.cleaned(config, rows)
    sensed, rest = frame.in_robot_frame(sensed, config, findings)
    findings += checks.implausible_sizes(sensed, frame.rest_positions(sensed.bodies, rest), config)
    if config.simulated:
        findings.append(Finding("note", "", "the robot was itself a simulation, and not a physical one"))
    return Recording(
        source=f"{source}: {config.description}" if config.description else source,
        config=config,
        bodies=tuple(sensed.bodies),
        base=sensed.base,
        control=sensed.control,
        command=sensed.command,
        rest=rest,
        simulated=config.simulated,
        findings=tuple(sorted(findings, key=lambda finding: SEVERITIES.index(finding.severity))),
        delays=offsets(list(streams.values())),
        sensors=tuple(sensed.sensors),
        uses=uses,
    )
