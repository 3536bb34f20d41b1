"""A recording in several files: which file has which topic, and all rows on the clock of the first file."""

from __future__ import annotations

import dataclasses
import fnmatch
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import scipy.ndimage
from jaxtyping import Float

from knode_cosserat.recordings.clocks import OVERLAP, Match, Signal, match_clocks
from knode_cosserat.recordings.config import ControlSource, FileSource, RecordingConfig, TableSource
from knode_cosserat.recordings.findings import Finding, RecordingError
from knode_cosserat.recordings.messages import Bag
from knode_cosserat.recordings.streams import Rows, Stream, rows_from_zero
from knode_cosserat.recordings.table import Table

#: smallest stamp of a clock that counts from 1970 (ns): others count from any time
ABSOLUTE = int(3e8 * 1e9)
#: difference of clocks that count from 1970, from which it is a finding (s, and standard deviations)
APART, SIGMAS = 0.1, 5.0


class File(NamedTuple):
    """Name of a file of a recording, without its folder, and its content."""

    name: str
    content: Bag | Table


class _Clocked(NamedTuple):
    """Rows of a file from its zero (ns on its own clock), and the beginnings of parts after resets (s)."""

    name: str
    zero: int
    rows: dict[str, Rows]
    findings: list[Finding]
    resets: list[float]

    @property
    def start(self) -> float:
        return min((float(rows.time[0]) for rows in self.rows.values() if len(rows.time)), default=0.0)

    @property
    def end(self) -> float:
        return max((float(rows.time[-1]) for rows in self.rows.values() if len(rows.time)), default=0.0)


def qualified(files: Sequence[File]) -> list[File]:
    """Return the files with unique titles of columns: those that are there twice become FILE/title.

    Raises:
        RecordingError: two files have one name.
    """
    names = [file.name for file in files]
    repeated = next((name for name in names if names.count(name) > 1), None)
    if repeated is not None:
        raise RecordingError(f"two files are called {repeated}; allowed is each name once")
    titles = [
        list(map(str, it.content.numbers.columns)) if isinstance(it.content, Table) else [] for it in files
    ]
    every = [title for own in titles for title in dict.fromkeys(own)]
    found = []
    for file, own in zip(files, titles, strict=True):
        content = file.content
        if isinstance(content, Table):
            unique = [f"{file.name}/{title}" if every.count(title) > 1 else title for title in own]
            content = content._replace(numbers=content.numbers.set_axis(unique, axis="columns"))
        found.append(File(file.name, content))
    return found


def streams_of_files(
    files: Sequence[File], config: RecordingConfig, findings: list[Finding]
) -> tuple[dict[str, Rows], dict[str, Stream], RecordingConfig]:
    """Return the rows of each topic on the clock of the first file, and the streams that they are from.

    The configuration that comes back states the clocks of the files.

    Raises:
        RecordingError: a topic is in no file or in several, or a clock is not known.
    """
    config = _of_these(files, config)
    there = {file.name: file.content.topics_there(_of_file(config, file)) for file in files}
    _require_topics(files, config, there)
    clocked, streams = list[_Clocked](), dict[str, Stream]()
    for file in files:
        own: list[Finding] = []
        meaning = _of_file(config, file)
        read = file.content.streams(meaning, own, there[file.name])
        zero, rows = rows_from_zero(read, config, own)
        if rows:
            begins = [at - zero * 1e-9 for at in file.content.resets(meaning)]
            clocked.append(_Clocked(file.name, zero, rows, own, begins))
        streams |= read
    if not clocked:
        raise RecordingError("no poses and no controls in these files")
    first = next((it for it in clocked if not it.resets), clocked[0])
    sources = {it.name: it for it in config.files}
    found: dict[str, FileSource] = {}
    moved: list[tuple[_Clocked, list[tuple[float, float, float]]]] = []
    for it in clocked:
        stated = sources.get(it.name, FileSource(it.name))
        parts, doubt = [(it.start, 0.0, 0.0)], stated.deviation
        if it is not first:
            parts, doubt = _parts(first, it, stated, config, findings)
        _, offset, drift = parts[0]
        # the offset is between the files' own stamps
        apart = offset - (it.zero - first.zero) * 1e-9
        clock = {"offset": round(apart, 6), "drift": round(1e6 * drift, 2)}
        found[it.name] = stated.replace(**clock, deviation=doubt and round(doubt, 6))
        moved.append((it, parts))
    rows = _on_one_clock(moved, config, findings)
    names = [it.name for it in files]
    return rows, streams, config.replace(files=tuple(found[name] for name in names if name in found))


def clock_deviation(files: Sequence[File], config: RecordingConfig) -> float:
    """Return the standard deviation (s) of the time between controls and bodies, by their files' clocks."""
    doubts = {it.name: it.deviation or 0.0 for it in config.files}
    topics = [(it, set(it.content.topics_there(_of_file(config, it)))) for it in files]

    def doubts_of(wanted: set[str]) -> dict[str, float]:
        return {file.name: doubts.get(file.name, 0.0) for file, there in topics if there & wanted}

    sent = set() if config.command is None else {config.command.topic}
    driving = doubts_of({it.topic for it in config.measured} | sent)
    moving = doubts_of({it.topic for it in config.markers} | {it.topic for it in config.sensors})
    apart = [np.hypot(a, b) for one, a in driving.items() for other, b in moving.items() if one != other]
    return float(max(apart, default=0.0))


def _of_these(files: Sequence[File], config: RecordingConfig) -> RecordingConfig:
    """Return the configuration with names of files in place of patterns, such as *_motors.csv.

    Raises:
        RecordingError: the configuration is that of other files, or a file matches several patterns.
    """
    found: dict[str, FileSource] = {it.name: it for it in config.files}
    for file in files:
        alike = [it for it in config.files if fnmatch.fnmatchcase(file.name, it.name)]
        if file.name in found:
            continue
        if len(alike) > 1:
            names = " and ".join(it.name for it in alike)
            raise RecordingError(f"{file.name} matches {names}; allowed is one")
        found |= {file.name: alike[0].replace(name=file.name)} if alike else {}
    known = [file.name for file in files]
    if found and not set(found) & set(known):
        raise RecordingError(
            f"files states the clock of {next(iter(found))}; the files are {', '.join(known)}. "
            "A pattern, such as '*_motors.csv', serves several recordings"
        )
    return config.replace(files=tuple(found.values()))


def _of_file(config: RecordingConfig, file: File) -> RecordingConfig:
    """Return the configuration of one of the files: with the titles and rate of its times."""
    stated = next((it for it in config.files if it.name == file.name), None)
    if not isinstance(file.content, Table):
        return config
    columns, table = config.columns, config.table
    time, unit = (None, None) if columns is None else (columns.time, columns.time_unit)
    if stated is not None and (stated.time is not None or stated.rate is not None):
        time, unit = stated.time, stated.time_unit
    titles = list(map(str, file.content.numbers.columns))
    if time is not None and time not in titles and f"{file.name}/{time}" in titles:
        time = f"{file.name}/{time}"
    elif time is None and f"{file.name}/time [s]" in titles:
        time = f"{file.name}/time [s]"
    if stated is not None and stated.rate is not None:
        table = (table or TableSource()).replace(rate=stated.rate)
    if columns is None and time is None:
        return config.replace(table=table)
    from knode_cosserat.recordings.config import ColumnMap

    return config.replace(columns=(columns or ColumnMap()).replace(time=time, time_unit=unit), table=table)


def _require_topics(
    files: Sequence[File], config: RecordingConfig, there: Mapping[str, Sequence[str]]
) -> None:
    """Raise `RecordingError` if a topic that is needed is in no file, or one is in several."""
    idle = {source.topic for source in config.idle}
    needed = [
        it.topic
        for it in (*config.markers, config.base, *config.sensors, *config.measured, config.command)
        if it
    ]
    for topic in needed:
        having = [name for name, topics in there.items() if topic in topics]
        if len(having) > 1:
            raise RecordingError(f"{topic} is in {' and in '.join(having)}; allowed is one file")
        if not having and topic not in idle:
            columns = "; ".join(f"{file.name}: {', '.join(file.content.names)}" for file in files)
            raise RecordingError(f"{topic} is in none of the files; they have {columns}")


# clocks


def _parts(
    first: _Clocked, it: _Clocked, stated: FileSource, config: RecordingConfig, findings: list[Finding]
) -> tuple[list[tuple[float, float, float]], float | None]:
    """Return beginning (s), offset (s, between the files' zeros) and drift of each part of a file's clock.

    The second result is the standard deviation of an offset that was estimated (s), the largest of all parts.
    """
    apart = (it.zero - first.zero) * 1e-9
    begins = [it.start, *it.resets]
    if stated.offset is not None:
        return [(begins[0], stated.offset + apart, 1e-6 * (stated.drift or 0.0))], stated.deviation
    if _is_absolute(first, it):
        _add_check(first, it, apart, config, findings)
        return [(begins[0], apart, 0.0)], stated.deviation
    parts, doubt = list[tuple[float, float, float]](), 0.0
    drives = ", ".join(source.topic for source in config.measured)
    for begin, end in zip(begins, [*begins[1:], np.inf], strict=True):
        try:
            if config.static:
                raise RecordingError("rows of equilibria do not tell")
            match = _match(first, it, config, (begin, end))
        except RecordingError as error:
            if not parts:
                raise RecordingError(
                    f"the offset of the clock of {it.name} against that of {first.name} is not known: "
                    f"{error} (controls are {drives or 'none'}). State it, in s: "
                    f"`files: [{{name: {it.name}, offset: …}}]`"
                ) from None
            # a short part after a reset follows the one before it
            what = f"{it.name}: after its clock was set back, {error}; the rows are taken to follow"
            findings.append(Finding("problem", "", what))
            parts.append((begin, *parts[-1][1:]))
            continue
        offset = match.offset + match.drift * (match.at - begin)
        parts.append((begin, offset, match.drift))
        doubt = max(doubt, match.offset_error)
        number = f", part {len(parts)}" if len(begins) > 1 else ""
        findings.append(
            Finding(
                "note" if match.offset_error < 0.02 else "warning",
                "",
                f"clock of {it.name}{number} against {first.name}: offset {offset - apart:.4f} ± "
                f"{match.offset_error:.4f} s, {_drift_text(match)}, by the motion that controls cause "
                "(dead time of the robot is in it)",
            )
        )
    return parts, doubt


def _drift_text(match: Match) -> str:
    if match.drift == 0.0:
        return f"no drift found (± {1e6 * match.drift_error:.0f} ppm)"
    return f"drift {1e6 * match.drift:.0f} ± {1e6 * match.drift_error:.0f} ppm"


def _is_absolute(first: _Clocked, it: _Clocked) -> bool:
    """True if both clocks count from 1970, and the files overlap on them."""
    if min(first.zero, it.zero) < ABSOLUTE:
        return False
    apart = (it.zero - first.zero) * 1e-9
    overlap = min(first.end, it.end + apart) - max(first.start, it.start + apart)
    return bool(overlap > OVERLAP * min(first.end - first.start, it.end - it.start))


def _add_check(
    first: _Clocked, it: _Clocked, apart: float, config: RecordingConfig, findings: list[Finding]
) -> None:
    """Add a finding on what the motion says about two clocks that agree by their stamps."""
    try:
        match = _match(first, it, config, (-np.inf, np.inf))
    except RecordingError:
        findings.append(
            Finding(
                "note",
                "",
                f"{it.name} and {first.name} are on one clock by their stamps; the motion does not tell",
            )
        )
        return
    off = match.offset - apart
    text = f"{off:.4f} ± {match.offset_error:.4f} s"
    if abs(off) > max(APART, SIGMAS * match.offset_error):
        what = (
            f"{it.name} and {first.name} are on one clock by their stamps, and by the motion it differs by "
            f"{text}: `files: [{{name: {it.name}, offset: {off:.4f}}}]` takes that"
        )
        findings.append(Finding("warning", "", what))
    else:
        what = f"{it.name} and {first.name} are on one clock by their stamps, and by the motion to {text}"
        findings.append(Finding("note", "", what))


def _match(first: _Clocked, it: _Clocked, config: RecordingConfig, part: tuple[float, float]) -> Match:
    """Return the clock of a file against the first one, by what they have. Raises `RecordingError`."""
    drive, other = _driving(first, config), _driving(it, config, part)
    moved, seen = _moving(first, config), _moving(it, config, part)
    if drive is not None and seen is not None:
        return match_clocks(drive, seen)
    if other is not None and moved is not None:
        return match_clocks(other, moved, is_reversed=True)
    a, b = (moved, seen) if moved is not None and seen is not None else (drive, other)
    if a is None or b is None:
        raise RecordingError("one of them has no rows that move")
    return match_clocks(a, b)


def _driving(
    it: _Clocked, config: RecordingConfig, part: tuple[float, float] = (-np.inf, np.inf)
) -> Signal | None:
    """Return what drives the robot: measured controls, or else commands; None without any."""
    measured = [source for source in config.measured if source.topic in it.rows]
    sent = [config.command] if config.command is not None and config.command.topic in it.rows else []
    sources: list[ControlSource] = measured or sent
    is_held = bool(sources) and all(source.held or source is config.command for source in sources)
    return _joined([it.rows[source.topic] for source in sources], part, is_held=is_held)


def _moving(
    it: _Clocked, config: RecordingConfig, part: tuple[float, float] = (-np.inf, np.inf)
) -> Signal | None:
    """Return the positions of the bodies, or else the values of sensors; None without any."""
    bodies = [it.rows[marker.topic] for marker in config.markers if marker.topic in it.rows]
    rows = [dataclasses.replace(each, values=each.values[:, :3]) for each in bodies]
    return _joined(rows or [it.rows[each.topic] for each in config.sensors if each.topic in it.rows], part)


def _joined(rows: Sequence[Rows], part: tuple[float, float], *, is_held: bool = False) -> Signal | None:
    """Return the finite rows of several topics in a part of the time, at the times of the first one."""
    columns, time = list[np.ndarray](), None
    for each in rows:
        used = np.isfinite(each.values).all(axis=1) & (each.time >= part[0] - 1e-9) & (each.time < part[1])
        if np.sum(used) < 8:
            continue
        at, values = each.time[used], each.values[used]
        if not is_held:
            # single frames that jump would be the fastest motion
            values = scipy.ndimage.median_filter(values, size=(3, 1), mode="nearest")
        time = at if time is None else time
        columns += [np.interp(time, at, column) for column in values.T]
    return None if time is None else Signal(time, np.stack(columns, axis=1), is_held)


def _on_one_clock(
    moved: Sequence[tuple[_Clocked, list[tuple[float, float, float]]]],
    config: RecordingConfig,
    findings: list[Finding],
) -> dict[str, Rows]:
    """Return all rows on the first clock, from the first pose or control on."""

    def on_first(
        parts: list[tuple[float, float, float]], time: Float[np.ndarray, " n"]
    ) -> Float[np.ndarray, " n"]:
        begins = np.array([begin for begin, _, _ in parts])
        k = np.clip(np.searchsorted(begins, time + 1e-9, side="right") - 1, 0, None)
        offset, drift = np.array([part[1] for part in parts])[k], np.array([part[2] for part in parts])[k]
        return np.asarray(time + offset - drift * (time - begins[k]))

    command = config.command.topic if config.command is not None and config.measured else None
    times = {
        topic: on_first(parts, rows.time)
        for it, parts in moved
        for topic, rows in it.rows.items()
        if len(rows.time)
    }
    zero = min(float(time[0]) for topic, time in times.items() if topic != command)
    found: dict[str, Rows] = {}
    for it, parts in moved:
        for finding in it.findings:
            at = on_first(parts, np.array(finding.times)) - zero
            findings.append(dataclasses.replace(finding, times=tuple(at.tolist())))
        for topic, rows in it.rows.items():
            time = np.round(times.get(topic, rows.time) - zero, 9)
            # parts after a reset may overlap those before it
            rising = np.concatenate(
                [np.ones(len(time[:1]), dtype=bool), np.diff(np.maximum.accumulate(time)) > 0.0]
            )
            if not rising.all():
                count = int((~rising).sum())
                what = f"{count} rows after a reset of the clock overlap those before it; left out"
                findings.append(Finding("warning", topic, what))
            found[topic] = Rows(topic, time[rising], rows.values[rising], findings)
    return found
