"""Recordings from files: bags of ROS 1 and 2, tables, and exports of motion capture.

Slow imports (pandas, scipy) are deferred, because this module is imported with the package.
"""

from __future__ import annotations

import importlib.resources
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from knode_cosserat._files.limits import MORE
from knode_cosserat.recordings.config import RecordingConfig
from knode_cosserat.recordings.container import Container
from knode_cosserat.recordings.findings import Finding, RecordingError
from knode_cosserat.recordings.formats import format_of
from knode_cosserat.recordings.messages import SIMULATED, STATIC, Role, Stream, decoded, topics_of
from knode_cosserat.recordings.recording import Recording

if TYPE_CHECKING:
    from knode_cosserat.recordings.table import Table

#: file name of the package's own recording
EXAMPLE = "sine_1p0.csv"


def load_recording(path: str | Path, config: RecordingConfig | None = None) -> Recording:
    """Read a recording: a bag, a table, or an export of motion capture.

    Bags are of ROS 1 (.bag, also .bag.active) or ROS 2 (.mcap, .db3, a folder). Tables are CSV (delimiters
    `,`, `;` or tab; decimal point or comma) or Parquet. Exports are CSV of OptiTrack Motive and Vicon Nexus,
    TRC and C3D. A text file may be compressed (.csv.gz).

    The content of the file decides its format; the name does only if the first bytes are damaged. A bag
    that was cut, or whose recorder was killed, is read as far as possible. Errors and repairs are reported
    in the recording's `findings`.

    Args:
        path: the file or folder.
        config: meaning of its topics or columns; None: the paper's robot for bags, the titles and comments
            of tables, and the names of the bodies in exports of motion capture (see `proposed_config`).

    Raises:
        RecordingError: the file cannot be read, or a topic or column is missing or unusable; one line.
        ImportError: a library for this kind of file is not installed.
    """
    path = Path(path)
    kind = format_of(path)
    meaning = config or RecordingConfig.paper_robot()
    content = kind.read(path, _wanted(meaning))
    if isinstance(content, Container):
        return _from_bag(path, content, meaning)
    return _from_table(path.name, str(path), content, config)


def load_example() -> Recording:
    """Return the package's example: sinusoidal tensions of period 1 s, 16 s long, 20 rows per second.

    The robot was simulated with PyElastica as a stand-in for the paper's robot; it is not a physical one.
    """
    from knode_cosserat.recordings.formats.csv_table import read_csv

    file = importlib.resources.files("knode_cosserat.recordings") / "data" / EXAMPLE
    return _from_table(EXAMPLE, EXAMPLE, read_csv(file.read_bytes(), EXAMPLE), None)


def proposed_config(path: str | Path) -> tuple[RecordingConfig, tuple[str, ...]]:
    """Return a configuration proposed for a recording, and remarks on its guesses.

    Bodies and tensions are recognised by the names and types of topics, or by the titles of columns. Places
    on the rod are guessed from distances at the start.

    Args:
        path: the file or folder.

    Raises:
        RecordingError: the file cannot be read, or nothing in it looks like the poses of a body.
    """
    from knode_cosserat.recordings import proposal

    path = Path(path)
    kind = format_of(path)
    content = kind.read(path, ())
    if isinstance(content, Container):
        topics = proposal.useful_topics(content)
        return proposal.config_of_bag(kind.read(path, topics), str(path))  # type: ignore[arg-type]
    return proposal.config_of_table(content, str(path))


# bags


def _wanted(config: RecordingConfig) -> Collection[str]:
    return {STATIC, *(topic for source in _roles(config) for topic in topics_of(source))}


def _roles(config: RecordingConfig) -> dict[Any, Role]:
    roles: dict[Any, Role] = dict.fromkeys(config.markers, "pose")
    if config.base is not None:
        roles[config.base] = "pose"
    if config.measured is not None:
        roles[config.measured] = "tension"
    if config.command is not None:
        roles[config.command] = "command"
    return roles


def _from_bag(path: Path, container: Container, config: RecordingConfig) -> Recording:
    from knode_cosserat.recordings import assembly

    unused = config.command if config.tensions == "measured" else config.measured
    found: dict[str, Stream] = {}
    findings: list[Finding] = []
    for source, role in _roles(config).items():
        missing = [name for name in topics_of(source) if name not in container.topics]
        if missing and unused is not None and source.topic == unused.topic:
            findings.append(Finding("note", missing[0], f"there is no such topic, and so no {role}s"))
            continue
        if missing:
            there = ", ".join(sorted(container.topics)) or "none"
            raise RecordingError(f"{path}: topic {missing[0]} ({role}) is missing; the bag has {there}")
        found[source.topic] = decoded(container, source, role, str(path))
        # messages contain text verbatim
        raw = container.topics[topics_of(source)[0]].raw
        if config.simulated is None and any(SIMULATED.encode() in bytes(each) for each in raw[:100]):
            config = config.replace(simulated=True)
    if container.damage:
        findings.append(_said_damage(container, found.values()))
    return assembly.assembled(str(path), path.name, config, found, findings)


def _said_damage(container: Container, streams: Iterable[Stream]) -> Finding:
    received = [stream.received for stream in streams if len(stream.received)]
    reached = (
        (max(int(np.max(each)) for each in received) - min(int(np.min(each)) for each in received)) * 1e-9
        if received
        else 0.0
    )
    lost = f", {container.lost} bytes could not be read" if container.lost else ""
    more = f"; {MORE}" if container.is_limited else ""
    return Finding("warning", "", f"{container.damage}: recovered up to {reached:.3f} s{lost}{more}")


# tables


def _from_table(name: str, path: str, content: Table, config: RecordingConfig | None) -> Recording:
    from knode_cosserat.recordings import assembly, table

    findings = list(content.findings)
    simulated = table.said_simulated(content.said, path)
    if config is None and content.bodies:
        from knode_cosserat.recordings import proposal

        config, remarks = proposal.config_of_table(content, path)
        findings += [Finding("warning", "", remark) for remark in remarks]
    config = config or table.configured(content.said, list(map(str, content.numbers.columns)), path)
    if content.bodies:
        # the file states its unit and its axes
        config = config.replace(position_unit="m", up=config.up or content.up)
    found, about_times = table.streams(content.numbers, config, path)
    if config.simulated is None:
        config = config.replace(simulated=simulated)
    return assembly.assembled(
        path, content.said.get("source", name), config, found, [*findings, *about_times]
    )
