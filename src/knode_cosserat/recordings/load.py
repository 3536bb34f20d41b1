"""Recordings from files: bags of ROS 1 and 2, CSV and Parquet tables.

Slow imports (pandas, scipy) are deferred, because this module is imported with the package.
"""

from __future__ import annotations

import gzip
import importlib.resources
import io
import zlib
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from knode_cosserat._files import csv_rows
from knode_cosserat._files.limits import MORE, allowed, excess
from knode_cosserat._files.reading import ReadError, read_bytes
from knode_cosserat.recordings import ros1, ros2
from knode_cosserat.recordings.config import RecordingConfig
from knode_cosserat.recordings.container import ALLOWANCE, RATIO, Container
from knode_cosserat.recordings.findings import Finding, RecordingError
from knode_cosserat.recordings.messages import SIMULATED, Role, Stream, decoded_messages
from knode_cosserat.recordings.recording import Recording

if TYPE_CHECKING:
    from knode_cosserat.recordings.table import Table

GZIP_MAGIC = b"\x1f\x8b"
#: largest file of a bag (bytes), also when decompressed: ten bodies at 120 Hz make 0.4 GB in an hour
LARGEST_BAG = 4 << 30
#: bytes that are decompressed at a time
_PIECE = 1 << 20
#: file name of the package's own recording
EXAMPLE = "sine_1p0.csv"


def load_recording(path: str | Path, config: RecordingConfig | None = None) -> Recording:
    """Read a recording: a bag of ROS 1 (.bag, also .bag.active) or ROS 2 (.mcap, .db3, a folder), or a table.

    A CSV table may be compressed (.csv.gz).

    The content of the file decides its format; the name does only if the first bytes are damaged. A bag
    that was cut, or whose recorder was killed, is read as far as possible. Errors and repairs are reported
    in the recording's `findings`.

    Args:
        path: the file or folder.
        config: meaning of its topics or columns; None: the paper's robot for bags, and the titles and
            comments of tables.

    Raises:
        RecordingError: the file cannot be read, or a topic or column is missing or unusable; one line.
        ImportError: a library for this kind of file is not installed.
    """
    path = Path(path)
    begin = _beginning(path)
    if (
        path.is_dir()
        or begin.startswith((ros1.MAGIC, ros2.MCAP_MAGIC, ros2.SQLITE_MAGIC))
        or _named_bag(path)
    ):
        return _from_bag(path, begin, config or RecordingConfig.paper_robot())
    from knode_cosserat.recordings import parquet, table

    if begin.startswith(parquet.MAGIC):
        content = parquet.read_parquet(path)
    else:
        content = table.read_csv(_bytes(path, csv_rows.LARGEST_FILE), str(path))
    return _from_table(path.name, str(path), content, config)


def load_example() -> Recording:
    """Return the package's example: sinusoidal tensions of period 1 s, 16 s long, 20 rows per second.

    The robot was simulated with PyElastica as a stand-in for the paper's robot; it is not a physical one.
    """
    from knode_cosserat.recordings import table

    file = importlib.resources.files("knode_cosserat.recordings") / "data" / EXAMPLE
    return _from_table(EXAMPLE, EXAMPLE, table.read_csv(file.read_bytes(), EXAMPLE), None)


def _beginning(path: Path) -> bytes:
    if path.is_dir():
        return b""
    try:
        with path.open("rb") as file:
            return file.read(16)
    except FileNotFoundError:
        raise RecordingError(f"{path}: no such file") from None
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror}") from None


def _bytes(path: Path, limit: int) -> bytes:
    """Return a file's content, decompressed; `limit` is of the bytes before and after decompression."""
    try:
        data = read_bytes(path, limit)
        return _gunzipped(data, path, limit) if data.startswith(GZIP_MAGIC) else data
    except ReadError as error:
        raise RecordingError(f"{path}: {error}") from None
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise RecordingError(f"{path}: cannot be decompressed: {error}") from None


def _gunzipped(data: bytes, path: Path, limit: int) -> bytes:
    ratio, allowance = allowed(RATIO), allowed(ALLOWANCE)
    most, words = ratio * len(data) + allowance, f"{ratio} times the file and {allowance}"
    if allowed(limit) < most:
        most = allowed(limit)
        words = str(most)
    parts, size = [], 0
    with gzip.GzipFile(fileobj=io.BytesIO(data)) as file:
        # in pieces, because all bytes that are asked for would be allocated
        while size <= most and (part := file.read(_PIECE)):
            parts.append(part)
            size += len(part)
    if size > most:
        raise RecordingError(
            f"{path}: it has more than {most} bytes when decompressed; allowed are {words}; {MORE}"
        )
    return b"".join(parts)


def _named_bag(path: Path) -> bool:
    """True if the name is a bag's: a bag with damaged first bytes is recognised by it."""
    return path.suffix in (".bag", ".mcap", ".db3") or path.name.endswith(".bag.active")


# bags


def _from_bag(path: Path, begin: bytes, config: RecordingConfig) -> Recording:
    from knode_cosserat.recordings import assembly

    wanted = _roles(config)
    container = _container(path, begin, wanted)
    unused = config.command if config.tensions == "measured" else config.measured
    found: dict[str, Stream] = {}
    findings: list[Finding] = []
    for name, role in wanted.items():
        topic = container.topics.get(name)
        if topic is None and unused is not None and name == unused.topic:
            findings.append(Finding("note", name, f"there is no such topic, and so no {role}s"))
            continue
        if topic is None:
            there = ", ".join(sorted(container.topics)) or "none"
            raise RecordingError(f"{path}: topic {name} ({role}) is missing; the bag has {there}")
        found[name] = decoded_messages(topic, container.ros, role, config.command, str(path))
        # messages contain text verbatim
        if config.simulated is None and any(SIMULATED.encode() in bytes(raw) for raw in topic.raw[:100]):
            config = config.replace(simulated=True)
    if container.damage:
        findings.append(_said_damage(container, found.values()))
    return assembly.assembled(str(path), path.name, config, found, findings)


def _roles(config: RecordingConfig) -> dict[str, Role]:
    roles: dict[str, Role] = {marker.topic: "pose" for marker in config.markers}
    if config.base is not None:
        roles[config.base.topic] = "pose"
    if config.measured is not None:
        roles[config.measured.topic] = "tension"
    if config.command is not None:
        roles[config.command.topic] = "command"
    return roles


def _container(path: Path, begin: bytes, wanted: Iterable[str]) -> Container:
    names = set(wanted)
    if path.is_dir():
        files = ros2.storage_files(path)
        return ros2.merged([_container(file, _beginning(file), names) for file in files])
    if begin.startswith(ros2.SQLITE_MAGIC) or path.suffix == ".db3":
        if reason := excess(path.stat().st_size, LARGEST_BAG, "bytes"):
            raise RecordingError(f"{path}: {reason}")
        return ros2.read_sqlite(path, names, str(path))
    if begin.startswith(ros2.MCAP_MAGIC) or path.suffix == ".mcap":
        return ros2.read_mcap(_bytes(path, LARGEST_BAG), names, str(path))
    return ros1.read_ros1(_bytes(path, LARGEST_BAG), names, str(path))


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

    said, numbers, findings = content
    simulated = table.said_simulated(said, path)
    config = config or table.configured(said, list(numbers.columns), path)
    found, about_times = table.streams(numbers, config, path)
    if config.simulated is None:
        config = config.replace(simulated=simulated)
    return assembly.assembled(path, said.get("source", name), config, found, [*findings, *about_times])
