"""Recordings as tables, CSV or Parquet: columns with names and units, and metadata.

A CSV file (UTF-8) has the metadata as comments before its header, a Parquet file in its schema:

    # source: what the recording is and where it comes from
    # simulated: true
    # fraction rib: 0.5
    # fraction tip: 1
    # latency: 0.06
    time [s],tension_1 [N],tension_2 [N],…,command_1 [N],…,rib_x [m],rib_y [m],rib_z [m],rib_qw,…,tip_x [m],…

`tension_k` was measured at the row's time; in place of it, or beside it, there may be `pressure_k [Pa]`,
`rotation_k [rad]` and other quantities (`recordings.quantities`). A number that is held from its row to the
next, such as in a simulation, is named `held_tension_k`; a command is always held. `initial control: 5 5 5 5`
gives the controls before the first row. `simulated` is true if the robot was itself a simulation; without it
this is not stated. A single body is at the tip by default; several bodies need their `fraction` of the rod's
length.
Without a configuration, positions are in the robot's frame and quaternions (scalar first) are the rod's
orientation. A row has the measurements at its time: cells of slower sensors stay empty.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float

from knode_cosserat._files.yaml_text import did_you_mean, excerpt
from knode_cosserat.recordings.config import (
    COMMAND,
    PLACE,
    POSITION_UNITS,
    TIME_UNITS,
    ColumnMap,
    ControlSource,
    MarkerSource,
    RecordingConfig,
    TableSource,
)
from knode_cosserat.recordings.findings import Finding, RecordingError, counted
from knode_cosserat.recordings.quantities import QUANTITIES, UNITS, stated_unit
from knode_cosserat.recordings.streams import FAR, SLOW, Outgoing, Stream

if TYPE_CHECKING:
    import pandas as pd  # type: ignore[import-untyped]

TIME = "time [s]"
#: prefix of the columns of numbers that are held to the next row
HELD = "held_"
#: metadata key of the controls before the first row
INITIAL = "initial control"
ALLOWED = (
    f"{TIME}, tension_1 [N], tension_2 [N], …, NAME_x [m], NAME_y [m], NAME_z [m] for each body, and, if "
    "they were measured, NAME_qw, NAME_qx, NAME_qy, NAME_qz, and command_1 [N], …; tensions that are held "
    "from a row to the next are held_tension_1 [N], … instead, and other quantities have their own names, "
    f"such as pressure_1 [Pa] ({', '.join(QUANTITIES)})"
)
#: parts of a pose, in the order of their columns
POSE_PARTS = ("x", "y", "z", "qw", "qx", "qy", "qz")
#: largest number of unread columns that are listed
MOST_LISTED = 8
#: largest plausible time (s)
LATEST = 9e9


class Table(NamedTuple):
    """Content of a table: texts by key, such as the source, and columns by title.

    A column that is not of numbers is text. `bodies` are those of an export of motion capture, whose format
    states names, units and axes; its columns have this package's titles and units. `up` is the axis that
    points up.
    """

    metadata: dict[str, str]
    numbers: pd.DataFrame
    findings: tuple[Finding, ...] = ()
    bodies: tuple[str, ...] = ()
    up: str = "z"

    @property
    def source(self) -> str:
        """Description and origin of the recording; empty if they are not stated."""
        return self.metadata.get("source", "")

    def completed(self, config: RecordingConfig) -> RecordingConfig:
        """Return a configuration that has also what the table states. Raises `RecordingError`."""
        simulated = self.metadata.get("simulated")
        if simulated not in (None, "true", "false"):
            raise RecordingError(f"simulated is {excerpt(simulated)}; allowed is true or false")
        if self.bodies:
            config = config.replace(position_unit="m", up=config.up or self.up)
        if config.simulated is None and simulated is not None:
            config = config.replace(simulated=simulated == "true")
        return config

    @property
    def names(self) -> list[str]:
        """Titles of the columns."""
        return list(map(str, self.numbers.columns))

    def topics_there(self, config: RecordingConfig) -> list[str]:
        """Return the topics of a configuration whose columns are all there."""
        titles = _titles_by_topic(config, self.names)
        return [topic for topic, named in titles.items() if set(named) <= set(self.names)]

    def uses(self, config: RecordingConfig) -> dict[str, str]:
        """Return the use of each column; empty text for those that are not read."""
        columns, mapped = self.names, config.columns or ColumnMap()
        stated = {mapped.time, TIME, *(file.time for file in config.files)}
        uses = {title: "time" if {title, title.rpartition("/")[2]} & stated else "" for title in columns}
        bodies = [source.topic for source in (*config.markers, config.base) if source is not None]
        words: dict[str, str] = {}
        for drive in (*config.measured, config.command):
            if drive is not None:
                what = COMMAND if drive is config.command else drive.quantity
                words[drive.topic] = f"{what} {{}} [{drive.unit}]"
        for topic, titles in _titles_by_topic(config, columns).items():
            for k, title in enumerate(titles):
                if title not in uses and title.isdecimal() and 1 <= int(title) <= len(columns):
                    title = columns[int(title) - 1]
                if title in uses:
                    part = POSE_PARTS[k] if topic in bodies else k + 1
                    uses[title] = words.get(topic, f"{topic} {{}}").format(part)
        return uses

    def resets(self, config: RecordingConfig) -> list[float]:
        """Return the times (s) at which rows continue after the clock was set back."""
        time = _times(self.numbers, config.table or TableSource(), config.columns or ColumnMap())
        return _continued(time)[1]

    def streams(
        self, config: RecordingConfig, findings: list[Finding], topics: Collection[str] | None = None
    ) -> dict[str, Stream]:
        """Return the measured rows of each topic, and add findings on unread columns and rows without times.

        `topics` are those that are read; None: all of the configuration. After the clock was set back, the
        rows are taken to continue one step later.

        Raises:
            RecordingError: a column is missing, or the times are not plausible seconds.
        """
        columns = list(self.numbers.columns)
        titles = _titles_by_topic(config, columns)
        unused = [source.topic for source in config.idle]
        bodies = [source.topic for source in (*config.markers, config.base) if source is not None]
        templates, mapped = config.table or TableSource(), config.columns or ColumnMap()
        time, resets = _continued(_times(self.numbers, templates, mapped))
        if resets:
            what = (
                f"{counted(len(resets), 'reset', 'resets')} of the clock; the next rows are taken to follow"
            )
            findings.append(Finding("warning", "", what))
        has_rate = templates.rate is not None and mapped.time is None
        read = set[int]() if has_rate else {_place(mapped.time or TIME, columns)}
        streams = {}
        for topic, named in titles.items():
            if topics is not None and topic not in topics:
                continue
            # numbers that do not drive the robot may be missing
            if topic in unused and not set(named) & set(columns):
                continue
            places = [_place(title, columns) for title in named]
            read |= set(places)
            values = np.array(columns_of(self.numbers, places))
            if topic in bodies and config.position_unit is None:
                units = [stated_unit(columns[place], POSITION_UNITS) or "m" for place in places[:3]]
                values[:, :3] *= [POSITION_UNITS[unit] for unit in units]
            there = np.isfinite(time) & np.isfinite(values).any(axis=1)
            stamps = np.round(time[there] * 1e9).astype(np.int64)
            # received times may be negative, because a table may begin before zero
            streams[topic] = Stream(topic, stamps, stamps, values[there])
        rows = (np.flatnonzero(~np.isfinite(time)) + 1).tolist()
        if rows:
            what = f"{numbered(rows, 'row has no time', 'rows have no time')}; left out"
            findings.append(Finding("warning", "", what))
        others = [title for k, title in enumerate(columns) if k not in read]
        if others:
            listed = ", ".join(others[:MOST_LISTED]) + (", …" if len(others) > MOST_LISTED else "")
            verb = "column is" if len(others) == 1 else "columns are"
            findings.append(Finding("note", "", f"{len(others)} {verb} not read: {listed}"))
        return streams


def numbered(numbers: Sequence[int], one: str, several: str) -> str:
    """Return a count of lines or rows, and the first of their numbers."""
    listed = ", ".join(map(str, numbers[:3])) + (", …" if len(numbers) > 3 else "")
    return f"{len(numbers)} {one if len(numbers) == 1 else several} ({listed})"


def numbers_of(table: pd.DataFrame) -> pd.DataFrame:
    """Return the columns as numbers, NaN where they are empty; a column with other text stays text."""
    import pandas as pd

    numbers = table.apply(pd.to_numeric, errors="coerce")
    values = numbers.to_numpy(dtype=float, na_value=np.nan)
    is_text = (~table.isna().to_numpy() & ~np.isfinite(values)).any(axis=0)
    columns = []
    for k, text in enumerate(is_text):
        cells = table.iloc[:, k].reset_index(drop=True)
        wrong = text and not _is_missing(cells[~np.isfinite(values[:, k])]).all()
        columns.append(cells if wrong else pd.Series(values[:, k]))
    return pd.concat(columns, axis=1).set_axis(list(map(str, table.columns)), axis="columns")


def _is_missing(cells: pd.Series) -> pd.Series:
    """Return a mask of the common spellings of a missing number."""
    return cells.astype(str).str.strip().str.lower().isin(("nan", "none", "null", "na", "n/a", "-nan", ""))


def columns_of(table: pd.DataFrame, places: Sequence[int]) -> Float[np.ndarray, "n places"]:
    """Return columns of numbers by their places. Raises `RecordingError` for one that has text."""
    import pandas as pd

    for place in places:
        cells = table.iloc[:, place]
        if cells.dtype.kind not in "fiub":
            numbers = pd.to_numeric(cells, errors="coerce").to_numpy(dtype=float, na_value=np.nan)
            row = int(np.argmax(~np.isfinite(numbers) & ~_is_missing(cells).to_numpy()))
            raise RecordingError(
                f"row {row + 1}: {table.columns[place]} is {excerpt(str(cells.iloc[row]).strip())}; "
                "allowed is a finite number"
            )
    return table.iloc[:, list(places)].to_numpy(dtype=float)


# meaning of the columns


def configured(metadata: Mapping[str, str], columns: list[str]) -> RecordingConfig:
    """Return the configuration derived from a table's titles and metadata. Raises `RecordingError`."""
    others = [name for name in columns if name != TIME]
    controls: dict[str, tuple[str, int]] = {}
    for name in others:
        match = re.fullmatch(rf"((?:{HELD})?([a-z]+))_\d+ \[(.+)\]", name)
        if match is None:
            continue
        quantity = QUANTITIES.get(match[2])
        if match[3] == quantity.unit if quantity else match[1] == COMMAND and match[3] in UNITS:
            controls[match[1]] = match[3], controls.get(match[1], ("", 0))[1] + 1
    twice = next((prefix for prefix in controls if HELD + prefix in controls), None)
    if twice is not None:
        raise RecordingError(
            f"there are {twice}_1 (at the row's time) and {HELD}{twice}_1 (from its row to the next); "
            "allowed is one of them"
        )
    bodies = [name.removesuffix("_x [m]") for name in others if name.endswith("_x [m]")]
    known = list[str]()
    for prefix, (unit, count) in controls.items():
        known += control_titles(prefix, unit, count)
    for body in bodies:
        oriented = quaternion_titles(body)
        known += position_titles(body, "m") + (oriented if oriented[0] in columns else [])
    wrong = TIME not in columns or not bodies or not controls or len(set(columns)) < len(columns)
    if wrong or sorted(known) != sorted(others):
        raise RecordingError(f"the columns are {', '.join(columns)}; allowed is {ALLOWED}, once each")
    markers = []
    for body in bodies:
        key = f"fraction {body}"
        if key not in metadata and len(bodies) > 1:
            raise RecordingError(
                f"where on the rod {body} is, is not said; allowed is a line '# {key}: ' with a "
                "number from 0 to 1, or a configuration"
            )
        (fraction,) = _metadata_numbers(key, metadata) or (1.0,)
        markers.append(MarkerSource(body, body, fraction, rotation=(1.0, 0.0, 0.0, 0.0)))
    (latency,) = _metadata_numbers("latency", metadata) or (0.0,)
    sources = {
        prefix.removeprefix(HELD): ControlSource(
            prefix,
            tuple(range(1, count + 1)),
            unit,
            held=True if prefix.startswith(HELD) else None,
            latency=latency if prefix == COMMAND else 0.0,
        )
        for prefix, (unit, count) in controls.items()
    }
    return RecordingConfig(
        markers=tuple(sorted(markers, key=lambda marker: marker.fraction)),
        controls="measured" if set(sources) - {COMMAND} else "commanded",
        initial_control=_metadata_numbers(INITIAL, metadata),
        **sources,  # type: ignore[arg-type]
    )


def _metadata_numbers(key: str, metadata: Mapping[str, str]) -> tuple[float, ...] | None:
    """Return the numbers of the metadata under a key, one except of controls; None without the key."""
    if key not in metadata:
        return None
    words = metadata[key].replace(",", " ").split() if key == INITIAL else [metadata[key]]
    try:
        return tuple(map(float, words))
    except ValueError:
        kind = "numbers (SI units)" if key == INITIAL else "a number"
        raise RecordingError(f"{key} is {excerpt(metadata[key])}; allowed is {kind}") from None


def position_titles(body: str, unit: str) -> list[str]:
    """Return the titles of a body's position."""
    return [f"{body}_{axis} [{unit}]" for axis in "xyz"]


def quaternion_titles(body: str) -> list[str]:
    """Return the titles of a body's orientation."""
    return [f"{body}_{part}" for part in ("qw", "qx", "qy", "qz")]


def control_titles(topic: str, unit: str, count: int) -> list[str]:
    """Return the titles of controls or commands, in the order of a message."""
    return [f"{topic}_{k + 1} [{unit}]" for k in range(count)]


def _titles_by_topic(config: RecordingConfig, columns: list[str]) -> dict[str, list[str]]:
    """Return the titles of each topic: from the map of columns, from templates, or the usual ones."""
    mapped, templates = config.columns or ColumnMap(), config.table or TableSource()
    titles: dict[str, list[str]] = {}
    for source in (*config.markers, config.base):
        if source is not None:
            topic = source.topic
            position, quaternion = (
                [title.replace(PLACE, topic) for title in named or ()]
                for named in (templates.position, templates.quaternion)
            )
            quaternion = quaternion or quaternion_titles(topic)
            usual = position or position_titles(topic, config.position_unit or "m")
            usual = usual + (quaternion if quaternion[0] in columns else [])
            titles[topic] = list(dict(mapped.bodies).get(topic, usual))
    for sensor in config.sensors:
        if sensor.columns is None:
            raise RecordingError(f"the columns of the sensor {sensor.topic} are missing; name them")
        titles[sensor.topic] = list(sensor.columns)
    for drive in (*config.measured, config.command):
        if drive is not None:
            named = dict(mapped.controls).get(COMMAND if drive is config.command else drive.quantity)
            count = len(drive.order)
            usual = control_titles(drive.topic, drive.unit or "", count)
            if templates.control is not None:
                usual = [templates.control.replace(PLACE, str(k + 1)) for k in range(count)]
            if named is not None and len(named) != count:
                raise RecordingError(
                    f"{len(named)} columns are mapped and order has {count} numbers; allowed is the "
                    "same number"
                )
            titles[drive.topic] = list(named or usual)
    return titles


def _place(title: str, columns: Sequence[str]) -> int:
    """Return the index of a title; a number that is no title counts from 1. Raises `RecordingError`."""
    if columns.count(title) == 1:
        return columns.index(title)
    if title not in columns and title.isdecimal() and 1 <= int(title) <= len(columns):
        return int(title) - 1
    wrong = "there twice" if title in columns else "missing"
    hint = "; name it by its number, counted from 1" if title in columns else did_you_mean(title, columns)
    raise RecordingError(f"the column {title} is {wrong}; the columns are {', '.join(columns)}{hint}")


def _times(table: pd.DataFrame, templates: TableSource, mapped: ColumnMap) -> Float[np.ndarray, " n"]:
    """Return the rows' times (s). Raises `RecordingError` if they are not plausible seconds."""
    columns, title = list(table.columns), mapped.time or TIME
    if templates.rate is not None and mapped.time is None:
        time = np.arange(len(table)) / templates.rate
    elif mapped.time is None and columns.count(TIME) != 1:
        raise RecordingError(
            f"the columns are {', '.join(columns)}; required is {TIME}, once (the configuration "
            "names another title by `columns: {time: …}`, and the rate of rows without times by "
            "`table: {rate: …}`)"
        )
    else:
        time = columns_of(table, [_place(title, columns)])[:, 0]
        time = time * TIME_UNITS[mapped.time_unit or stated_time_unit(title) or "s"]
    late = np.abs(time) > LATEST
    known = np.sort(time[np.isfinite(time)])
    step = float(np.median(np.diff(known))) if len(known) > 1 else 0.0
    if late.any() or step > FAR:
        row = int(np.argmax(late))
        what, most = f"its rows are {step:g} s apart; allowed is up to {FAR:g} s", step / SLOW
        if late.any():
            what = f"row {row + 1}: {TIME} is {time[row]:g}; allowed is up to {LATEST:g}"
            most = abs(time[row]) / LATEST
        unit = next((unit for unit, size in (("ms", 1e3), ("µs", 1e6)) if most <= size), "ns")
        raise RecordingError(f"{what}. Are the times in {unit}?")
    return time


#: smallest step back of a clock that was reset (s), and rows after which it has not come back
_BACK, _STAYS = 1.0, 5


def _continued(time: Float[np.ndarray, " n"]) -> tuple[Float[np.ndarray, " n"], list[float]]:
    """Return times (s) that continue one step later where the clock was set back, and where that is."""
    known = np.flatnonzero(np.isfinite(time))
    seconds, begins = time[known].copy(), list[float]()
    step = float(np.median(np.abs(np.diff(seconds)))) if len(seconds) > 1 else 0.0
    for row in np.flatnonzero(np.diff(seconds) < -_BACK):
        after = seconds[row + 1 : row + 1 + _STAYS]
        # a row out of order comes back; whole parts out of order do not follow the last part
        if len(after) < _STAYS or np.any(np.diff(after) < 0.0) or after.max() > seconds[row] - _BACK / 2:
            continue
        seconds[row + 1 :] += seconds[row] + step - seconds[row + 1]
        begins.append(float(seconds[row + 1]))
    continued = np.array(time)
    continued[known] = seconds
    return continued, begins


#: spellings of units of time in titles
_SPELLINGS = {
    "ms": ("ms", "msec", "millis", "milliseconds"),
    "us": ("us", "µs", "μs", "usec", "micros", "microseconds"),
    "ns": ("ns", "nsec", "nanos", "nanoseconds"),
}


def stated_time_unit(title: str) -> str:
    """Return the unit that the title of a time states, such as t [ms] or time_ns; empty without one."""
    words = set(re.findall(r"[a-zµμ]+", title.lower())[1:])
    return next((unit for unit, spellings in _SPELLINGS.items() if words & set(spellings)), "")


def columns_and_metadata(outgoing: Outgoing) -> tuple[pd.DataFrame, dict[str, str]]:
    """Return a table to be written, with a row for each time of any topic, and its metadata."""
    import pandas as pd

    config, columns = outgoing.config, dict[str, pd.Series]()
    for stream in outgoing.streams:
        if stream.role == "pose":
            titles = position_titles(stream.topic, config.position_unit or "m")
            titles += quaternion_titles(stream.topic) if np.shape(stream.values)[1] == 7 else []
        else:
            titles = control_titles(stream.topic, stream.source.unit, len(stream.source.order))
        columns |= {
            title: pd.Series(values, index=stream.time)
            for title, values in zip(titles, stream.values.T, strict=True)
        }
    metadata = {f"fraction {marker.topic}": repr(marker.fraction) for marker in config.markers}
    if config.description:
        metadata["source"] = " ".join(config.description.split())
    if config.simulated is not None:
        metadata["simulated"] = "true" if config.simulated else "false"
    if config.initial_control is not None:
        metadata[INITIAL] = " ".join(map(repr, config.initial_control))
    if config.command is not None and config.command.latency:
        metadata["latency"] = repr(config.command.latency)
    # one concatenation, because repeated merges would sort the rows each time
    table = pd.concat(columns, axis=1).sort_index()
    return table.rename_axis(TIME).reset_index(), metadata
