"""Marker trajectories in TRC files (Track Row Column), as OpenSim and most motion capture write them.

    PathFileType  4  (X/Y/Z)  take.trc
    DataRate  CameraRate  NumFrames  NumMarkers  Units  OrigDataRate  OrigDataStartFrame  OrigNumFrames
    100.00  100.00  300  2  mm  100.00  1  300
    Frame#  Time  base      tip
                  X1  Y1  Z1  X2  Y2  Z2
    1  0.000  …

Cells are divided by tabs, and empty where a marker is lost. The file does not state which axis points up: y
is assumed, as in OpenSim.
"""

from __future__ import annotations

import re
from collections.abc import Collection
from pathlib import Path

from knode_cosserat.recordings.exports import Track, cells_reader, export_table, length_unit, text_lines
from knode_cosserat.recordings.findings import Finding, RecordingError
from knode_cosserat.recordings.formats import RecordingFormat, register
from knode_cosserat.recordings.table import Table

_START = "PathFileType"


def read_trc(path: Path, wanted: Collection[str] = ()) -> Table:
    """Return the markers of a file. Raises `RecordingError`."""
    lines = text_lines(path)
    keys, values, names = (
        [cell.strip() for cell in line.split("\t")] for line in [*lines[1:4], "", "", ""][:3]
    )
    if not lines[0].startswith(_START) or names[:1] != ["Frame#"]:
        raise RecordingError(
            "the header of this TRC file is damaged; required are PathFileType, the lines of "
            "DataRate and its values, and Frame#, Time and the markers' names"
        )
    stated = dict(zip(keys, values, strict=False))
    markers = [name for name in names[2:] if name]
    has_axes = len(lines) > 4 and re.match(r"\s*X1\b", lines[4]) is not None
    if not has_axes and stated.get("NumMarkers", "") == str(len(markers) // 3):
        # some programs write tip_x, tip_y, tip_z in place of the line of axes
        markers = [re.sub(r"[_ .-]?[xX]$", "", name) for name in markers[::3]]
    findings: list[Finding] = []
    if stated.get("NumMarkers", "") != str(len(markers)):
        what = f"NumMarkers is {stated.get('NumMarkers') or 'missing'}, and {len(markers)} markers have names"
        findings.append(Finding("warning", "", what))
    scale = length_unit(stated.get("Units", ""), "mm", findings)
    findings.append(
        Finding("note", "", "TRC files do not state which axis points up; y is taken (`up` states it)")
    )
    titles = ["Frame#", "Time", *(f"{name} {axis}" for name in markers for axis in "XYZ")]
    cells = cells_reader(lines[5 if has_axes else 4 :], titles, "\t")
    tracks = [Track(name, scale * cells([3 * k + 2, 3 * k + 3, 3 * k + 4])) for k, name in enumerate(markers)]
    return export_table(cells([1])[:, 0], tracks, up="y", findings=findings)


register(
    RecordingFormat(
        "TRC",
        recognise=lambda head: head.removeprefix(b"\xef\xbb\xbf").startswith(_START.encode()),
        read=read_trc,
        suffixes=(".trc",),
    )
)
