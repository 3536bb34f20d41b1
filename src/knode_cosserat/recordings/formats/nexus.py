"""Exports of Vicon Nexus and Tracker as CSV: sections of trajectories, segments or objects, and devices.

    Trajectories
    100
    ,,Robot:base,,,Robot:tip,,
    Frame,Sub Frame,X,Y,Z,X,Y,Z
    ,,mm,mm,mm,mm,mm,mm
    1,0,12.1,…

    Devices
    1000
    …

A section has a rate (Hz), names, titles of columns, units, and rows up to a blank line. Segments and objects
have TX, TY, TZ and either a quaternion RX, RY, RZ, RW or a rotation vector (helical angles) RX, RY, RZ. Cells
are empty where a marker is lost. Vicon's frame has z up.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from knode_cosserat.recordings import exports
from knode_cosserat.recordings.findings import Finding, RecordingError
from knode_cosserat.recordings.formats import RecordingFormat, register
from knode_cosserat.recordings.formats.csv_table import delimiter_of
from knode_cosserat.recordings.table import Table

_SECTIONS = "Trajectories|Segments|Objects|Joints|Model Outputs|Devices"
_BEGIN = re.compile(rf'^["\s]*({_SECTIONS})["\s,;]*$')
_RATE = re.compile(r'^["\s]*(\d+(?:[.,]\d+)?)["\s,;]*$')
_SIGNATURE = re.compile(rf'^[\s,;]*"?({_SECTIONS})"?[ ,;\t]*\r?\n"?\d+([.,]\d+)?"?[ ,;\t]*\r?\n'.encode())
_ANGLES = {"deg": np.pi / 180.0, "rad": 1.0}


class _TableSection(NamedTuple):
    rate: float
    #: frame numbers and numbers of the samples within a frame
    frame: Float[np.ndarray, " n"]
    sample: Float[np.ndarray, " n"]
    cells: exports.Columns
    #: name of the group, title and unit of each column
    groups: Sequence[str]
    titles: Sequence[str]
    units: Sequence[str]


def read_nexus(path: Path, wanted: Collection[str] = ()) -> Table:
    """Return the bodies, markers and channels of an export. Raises `RecordingError`."""
    sections = list(_sections(exports.text_lines(path)))
    # several samples of a device are taken during one frame
    slow = [section.rate for section in sections if not section.sample.any()]
    rate = slow[0] if slow else sections[0].rate / (1.0 + float(np.nanmax(sections[0].sample)))
    time, tracks, channels, findings = None, [], [], list[Finding]()
    for section in sections:
        at = section.frame / rate + section.sample / section.rate
        bodies, others = _tracks(section, findings)
        if bodies and (time is None or np.array_equal(at, time)):
            time = at
            tracks += bodies
        elif bodies:
            names = ", ".join(track.name for track in bodies)
            findings.append(Finding("warning", "", f"{names:.200}: of another rate than the first; left out"))
        channels.append((at, others))
    return exports.export_table(
        np.zeros(0) if time is None else time, tracks, up="z", channels=channels, findings=findings
    )


def _sections(lines: list[str]) -> Iterator[_TableSection]:
    starts = [k for k in range(len(lines) - 1) if _BEGIN.match(lines[k]) and _RATE.match(lines[k + 1])]
    for start, end in zip(starts, [*starts[1:], len(lines)], strict=True):
        name = lines[start].strip('", ;\t')
        # rows end at a blank line
        rows = next((k for k in range(start + 2, end) if not lines[k].strip(" ,;\t")), end)
        if rows < start + 6:
            raise RecordingError(
                f"the section {name} is incomplete; required are names, titles, units and rows of numbers"
            )
        rate = float(_RATE.match(lines[start + 1])[1].replace(",", "."))  # type: ignore[index]
        delimiter = delimiter_of(lines[start + 3 : start + 6])
        groups, titles, units = (
            [cell.strip('" ') for cell in lines[start + k].split(delimiter)] for k in (2, 3, 4)
        )
        if titles[:2] != ["Frame", "Sub Frame"] or rate <= 0.0:
            raise RecordingError(
                f"the section {name} has the titles {', '.join(titles)[:80]} and the rate {rate:g}; "
                "required are Frame, Sub Frame, … and a rate above 0 Hz"
            )
        groups, units = ([*row, *[""] * len(titles)][: len(titles)] for row in (groups, units))
        for k in range(3, len(groups)):
            groups[k] = groups[k] or groups[k - 1]
        cells = exports.cells_reader(lines[start + 5 : rows], titles, delimiter)
        frame, sample = np.nan_to_num(cells([0, 1])).T
        yield _TableSection(rate, frame, sample, cells, groups, titles, units)


def _tracks(
    section: _TableSection, findings: list[Finding]
) -> tuple[list[exports.Track], dict[str, np.ndarray]]:
    """Return the bodies and markers of a section, and its other columns by title."""
    from scipy.spatial.transform import Rotation

    tracks, others = [], {}
    # a group is a run of columns with one name, in which no title comes twice
    begins = [
        k
        for k in range(2, len(section.titles))
        if section.groups[k] != section.groups[k - 1] or section.titles[k] == section.titles[2]
    ]
    for begin, end in zip(begins, [*begins[1:], len(section.titles)], strict=True):
        places = {section.titles[k].upper(): k for k in range(begin, end)}
        unit = {title: section.units[k].lower() for title, k in places.items()}
        name = section.groups[begin].removeprefix("Global Angle ")
        for where, rotated in (("XYZ", ()), (("TX", "TY", "TZ"), ("RX", "RY", "RZ"))):
            if not all(unit.get(axis) in exports.LENGTHS for axis in where):
                continue
            position = section.cells([places[axis] for axis in where]) * exports.LENGTHS[unit[where[0]]]
            quaternion = None
            if rotated and "RW" in places:
                quaternion = section.cells([places[axis] for axis in ("RW", *rotated)])
            elif rotated and all(axis in places for axis in rotated):
                size = _ANGLES.get(unit["RX"].rstrip("s"))
                if size is None:
                    raise RecordingError(f"the unit of RX of {name} is {unit['RX']!r}; allowed is deg or rad")
                vectors = size * section.cells([places[axis] for axis in rotated])
                quaternion = exports.quaternions_of(vectors, Rotation.from_rotvec)
                what = "rotations RX, RY, RZ are read as rotation vectors (helical angles)"
                findings.append(Finding("note", name, what))
            tracks.append(exports.Track(name, position, quaternion, "segment" if rotated else "marker"))
            break
        else:
            for title, k in places.items():
                ending = f" [{section.units[k]}]" if section.units[k] else ""
                others[f"{name} {title}{ending}".strip()] = section.cells([k])[:, 0]
    return tracks, others


register(
    RecordingFormat(
        "Vicon CSV",
        recognise=lambda head: _SIGNATURE.match(head.removeprefix(b"\xef\xbb\xbf")) is not None,
        read=read_nexus,
    )
)
