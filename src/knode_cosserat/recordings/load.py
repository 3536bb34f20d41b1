"""Reading of recordings: from a file of any format to a `Recording` on one clock and in the robot's frame."""

from __future__ import annotations

import dataclasses
import importlib.resources
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from knode_cosserat._arguments import check_arguments
from knode_cosserat._files.limits import MORE
from knode_cosserat._files.yaml_text import shown
from knode_cosserat.recordings import checks, frame, streams, table
from knode_cosserat.recordings.config import PRESSURE_UNITS, RecordingConfig, TensionSource
from knode_cosserat.recordings.findings import SEVERITIES, Finding, RecordingError
from knode_cosserat.recordings.formats import format_of
from knode_cosserat.recordings.formats.csv_table import read_csv
from knode_cosserat.recordings.messages import SIMULATED, STATIC, Bag, Role, decoded, topics_of
from knode_cosserat.recordings.proposal import config_of_bag, config_of_table, useful_topics
from knode_cosserat.recordings.recording import Recording
from knode_cosserat.recordings.streams import Stream
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
    meaning = config or RecordingConfig.paper_robot()
    wanted = {STATIC, *(topic for source in _roles(meaning) for topic in topics_of(source))}
    content = format_of(path).read(path, wanted)
    if isinstance(content, Table):
        return _from_table(path.name, str(path), content, config)
    return _from_bag(path, content, meaning)


def load_example() -> Recording:
    """Return the package's example: sinusoidal tensions of period 1 s, 16 s long, 20 rows per second.

    The robot was simulated with PyElastica as a stand-in for the paper's robot; it is not a physical one.
    """
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
    check_arguments(proposed_config, locals())
    path = Path(path)
    kind = format_of(path)
    content = kind.read(path, ())
    if isinstance(content, Table):
        return config_of_table(content, str(path))
    bag = kind.read(path, useful_topics(content))
    assert isinstance(bag, Bag)
    return config_of_bag(bag, str(path))


# bags


def _roles(config: RecordingConfig) -> dict[Any, Role]:
    roles: dict[Any, Role] = dict.fromkeys((*config.markers, config.base), "pose")
    roles |= dict.fromkeys(config.sensors, "sensor")
    roles |= {config.measured: "tension", config.command: "command"}
    return {source: role for source, role in roles.items() if source is not None}


def _from_bag(path: Path, bag: Bag, config: RecordingConfig) -> Recording:
    unused = config.command if config.tensions == "measured" else config.measured
    numbers: dict[str, Stream] = {}
    findings: list[Finding] = []
    for source, role in _roles(config).items():
        missing = [name for name in topics_of(source) if name not in bag.topics]
        if missing and source is unused:
            findings.append(Finding("note", missing[0], f"there is no such topic, and so no {role}s"))
            continue
        if missing:
            listed = ", ".join(sorted(bag.topics)) or "none"
            raise RecordingError(f"{path}: topic {missing[0]} ({role}) is missing; the bag has {listed}")
        numbers[source.topic] = decoded(bag, source, role, str(path))
        # messages contain text verbatim
        raw = bag.topics[topics_of(source)[0]].raw
        if config.simulated is None and any(SIMULATED.encode() in bytes(message) for message in raw[:100]):
            config = config.replace(simulated=True)
    if bag.damage:
        received = [stream.received for stream in numbers.values() if len(stream.received)]
        duration = 0.0
        if received:
            duration = (max(int(at.max()) for at in received) - min(int(at.min()) for at in received)) * 1e-9
        lost = f", {bag.lost} bytes could not be read" if bag.lost else ""
        more = f"; {MORE}" if bag.is_limited else ""
        what = f"{bag.damage}: recovered up to {duration:.3f} s{lost}{more}"
        findings.append(Finding("warning", "", what))
    return _assembled(str(path), path.name, config, numbers, findings)


# tables


def _from_table(name: str, path: str, content: Table, config: RecordingConfig | None) -> Recording:
    findings = list(content.findings)
    simulated = content.metadata.get("simulated")
    if simulated not in (None, "true", "false"):
        raise RecordingError(f"{path}: simulated is {shown(simulated)}; allowed is true or false")
    if config is None and content.bodies:
        config, remarks = config_of_table(content, path)
        findings += [Finding("warning", "", remark) for remark in remarks]
    config = config or table.configured(content.metadata, list(map(str, content.numbers.columns)), path)
    if content.bodies:
        # the file states its unit and its axes
        config = config.replace(position_unit="m", up=config.up or content.up)
    numbers, about_times = table.streams_of(content.numbers, config, path)
    if config.simulated is None and simulated is not None:
        config = config.replace(simulated=simulated == "true")
    source = content.metadata.get("source", name)
    return _assembled(path, source, config, numbers, [*findings, *about_times])


# streams


def _assembled(
    path: str, name: str, config: RecordingConfig, numbers: Mapping[str, Stream], findings: list[Finding]
) -> Recording:
    """Return the recording of raw streams by topic. Raises `RecordingError` if one has no usable data."""
    for stream in numbers.values():
        findings.extend(stream.remarks)
        if stream.broken:
            what = f"{stream.broken} messages could not be understood, and are left out"
            findings.append(Finding("warning", stream.topic, what))
    times, about_clocks = streams.measurement_times(list(numbers.values()), config.clock)
    rows = {}
    for topic in numbers:
        rows[topic], about_order = streams.ordered(topic, times[topic])
        about_clocks += about_order
    # time zero is the first pose or measured tension (ns): commands may start much earlier
    command = config.command.topic if config.command is not None and config.measured is not None else None
    begins = (times[topic][kept[0]] for topic, kept in rows.items() if len(kept) and topic != command)
    zero = min(begins, default=None)
    if zero is None:
        raise RecordingError(f"{path}: no poses and no tensions in this recording")
    seconds = {topic: np.round((times[topic][kept] - zero) * 1e-9, 9) for topic, kept in rows.items()}
    values = {topic: stream.values[rows[topic]] for topic, stream in numbers.items()}
    findings += [
        dataclasses.replace(finding, times=tuple((time - zero) * 1e-9 for time in finding.times))
        for finding in about_clocks
    ]
    bodies, base = [], None
    sources = [(marker.name, marker.topic, marker.fraction) for marker in config.markers]
    for source in [*sources, *([("base", config.base.topic, float("nan"))] if config.base else [])]:
        topic = source[1]
        body, about_body = checks.cleaned_body(config, source, seconds[topic], values[topic], path)
        findings += about_body
        bodies.append(body)
    if config.base:
        base = bodies.pop()
    sensors = []
    for sensor in config.sensors:
        numbers_of = seconds[sensor.topic], values[sensor.topic]
        cleaned, about_sensor = checks.cleaned_sensor(config, sensor, *numbers_of, path)
        findings += about_sensor
        sensors.append(cleaned)
    tension, commanded, about_tensions = checks.cleaned_tensions(config, seconds, values, path)
    bodies, base, rest, about_frame = frame.bodies_in_robot_frame(bodies, base, config)
    at_rest = frame.rest_positions(bodies, rest)
    findings += about_tensions + about_frame
    both = [
        pulls if isinstance(source, TensionSource) and source.unit not in PRESSURE_UNITS else None
        for source, pulls in ((config.measured, tension), (config.command, commanded))
    ]
    findings += checks.implausible_sizes(bodies, (both[0], both[1]), at_rest, is_static=config.static)
    if config.simulated:
        findings.append(Finding("note", "", "the robot was itself a simulation, and not a physical one"))
    return Recording(
        source=f"{name}: {config.description}" if config.description else name,
        config=config,
        bodies=tuple(bodies),
        base=base,
        tension=tension,
        command=commanded,
        rest=rest,
        simulated=config.simulated,
        findings=tuple(sorted(findings, key=lambda finding: SEVERITIES.index(finding.severity))),
        delays=streams.offsets(list(numbers.values())),
        sensors=tuple(sensors),
    )
