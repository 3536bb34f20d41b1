"""Reading of recordings: from a file of any format to a `Recording` on one clock and in the robot's frame."""

from __future__ import annotations

import importlib.resources
from pathlib import Path

from knode_cosserat._arguments import check_arguments
from knode_cosserat.recordings import checks, frame
from knode_cosserat.recordings.config import RecordingConfig
from knode_cosserat.recordings.findings import SEVERITIES, Finding, naming
from knode_cosserat.recordings.formats import format_of
from knode_cosserat.recordings.formats.csv_table import read_csv
from knode_cosserat.recordings.messages import Bag, topics_read
from knode_cosserat.recordings.proposal import config_of_bag, config_of_table, default_config, useful_topics
from knode_cosserat.recordings.recording import Recording
from knode_cosserat.recordings.streams import offsets, rows_on_one_clock
from knode_cosserat.recordings.table import Table

#: file name of the package's own recording
EXAMPLE = "sine_1p0.csv"


def load_recording(path: str | Path, config: RecordingConfig | str | Path | None = None) -> Recording:
    """Read a recording: a bag, a table, or an export of motion capture.

    Bags are of ROS 1 (.bag, also .bag.active) or ROS 2 (.mcap, .db3, a folder). Tables are CSV (delimiters
    `,`, `;` or tab; decimal point or comma) or Parquet. Exports are CSV of OptiTrack Motive and Vicon Nexus,
    TRC and C3D. A text file may be compressed (.csv.gz). `formats` lists all formats and takes new ones.

    The content of the file decides its format; the name does only if the first bytes are damaged. A bag
    that was cut, or whose recorder was killed, is read up to that point. Errors and repairs are reported
    in the recording's `findings`.

    Args:
        path: the file or folder.
        config: meaning of its topics or columns, or the YAML file that states it; None: the paper's robot for
            bags, the titles and comments of tables, and the names of the bodies in exports of motion capture
            (see `proposed_config`).

    Raises:
        RecordingError: the file cannot be read, or a topic or column is missing or unusable; one line.
        ImportError: a library for this kind of file is not installed.
    """
    check_arguments(load_recording, locals())
    path = Path(path)
    if isinstance(config, str | Path):
        config = RecordingConfig.load(config)
    with naming(path):
        wanted = topics_read(config or RecordingConfig.paper_robot())
        return _recording(format_of(path).read(path, wanted), config, path.name)


def load_example() -> Recording:
    """Return the package's example: sinusoidal tensions of period 1 s, 16 s long, 20 rows per second.

    The robot was simulated with PyElastica as a stand-in for the paper's robot; it is not a physical one.
    """
    file = importlib.resources.files("knode_cosserat.recordings") / "data" / EXAMPLE
    with naming(EXAMPLE):
        return _recording(read_csv(file.read_bytes()), None, EXAMPLE)


def proposed_config(path: str | Path) -> RecordingConfig:
    """Return a configuration proposed for a recording, with remarks on its guesses.

    Bodies and tensions are recognised by the names and types of topics, or by the titles of columns. Places
    on the rod are guessed from distances at the start.

    Args:
        path: the file or folder.

    Raises:
        RecordingError: the file cannot be read, or nothing in it looks like the poses of a body.
    """
    check_arguments(proposed_config, locals())
    path = Path(path)
    with naming(path):
        kind = format_of(path)
        content = kind.read(path, ())
        if isinstance(content, Table):
            return config_of_table(content)
        bag = kind.read(path, useful_topics(content))
        assert isinstance(bag, Bag)
        return config_of_bag(bag)


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
    sensed = checks.cleaned(config, rows_on_one_clock(streams, config, findings))
    sensed, rest = frame.in_robot_frame(sensed, config, findings)
    findings += checks.implausible_sizes(sensed, frame.rest_positions(sensed.bodies, rest), config)
    if config.simulated:
        findings.append(Finding("note", "", "the robot was itself a simulation, and not a physical one"))
    source = content.source or name
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
    )
