"""Exports of OptiTrack Motive as CSV (format versions from 1.2 on): rigid bodies, markers, bones.

    Format Version,1.23,Take Name,Take 1,…,Rotation Type,Quaternion,Length Units,Meters,…

    ,,Rigid Body,Rigid Body,…,Marker,…
    ,,Tip,Tip,…,Tip:Marker1,…
    ,,"2C4F…","2C4F…",…
    ,,Rotation,Rotation,Rotation,Rotation,Position,Position,Position,Mean Marker Error,Position,…
    Frame,Time (Seconds),X,Y,Z,W,X,Y,Z,,X,…
    0,0.000000,0.01,…

The rows of kinds and names come first, those of identities and parents may be absent, and the second column
may say which row it is. Quaternions have the scalar last. Euler angles are in degrees, about the moving axes
in the order of `Rotation Type`. Cells are empty where a body is lost. Motive's frame has y up.
"""

from __future__ import annotations

import csv
from collections.abc import Collection
from pathlib import Path

import numpy as np

from knode_cosserat.recordings import exports
from knode_cosserat.recordings.findings import Finding, RecordingError
from knode_cosserat.recordings.formats import RecordingFormat, register
from knode_cosserat.recordings.table import Table

_START = "Format Version"
#: lines of the header at most
_HEADER = 20
#: kinds of tracks by preference, where names are there twice
_KINDS = ("Rigid Body", "Bone", "Marker", "Rigid Body Marker", "Bone Marker")


def read_motive(path: Path, wanted: Collection[str] = ()) -> Table:
    """Return the bodies and markers of an export. Raises `RecordingError`."""
    lines = exports.text_lines(path)
    delimiter = lines[0][len(_START) : len(_START) + 1] or ","
    header = [[cell.strip() for cell in row] for row in csv.reader(lines[:_HEADER], delimiter=delimiter)]
    meta = dict(zip(header[0][::2], header[0][1::2], strict=False))
    is_axes = [row[:1] == ["Frame"] and "".join(row[1:2]).startswith("Time") for row in header]
    axes_row = is_axes.index(True) if any(is_axes) else 0
    above = [row for row in header[1:axes_row] if any(row)]
    if len(above) < 3:
        raise RecordingError(
            "the header of this export of Motive is incomplete; required are rows of kinds, names, "
            "Rotation and Position, and Frame,Time (Seconds),X,Y,Z,… (export with its header)"
        )
    axes = header[axes_row]
    kinds, names, measures = ([*row, *[""] * len(axes)] for row in (above[0], above[1], above[-1]))
    identities = [*next((row for row in above[2:-1] if "Parent" not in row), []), *[""] * len(axes)]
    findings: list[Finding] = []
    scale = exports.length_unit(meta.get("Length Units", ""), "m", findings)
    if meta.get("Coordinate Space", "Global") != "Global":
        what = (
            f"the coordinate space is {meta['Coordinate Space']}: are bodies in one frame? (export as Global)"
        )
        findings.append(Finding("warning", "", what))
    # the data begin after the row of axes, whose cells have no line breaks
    first = next(k for k, line in enumerate(lines) if line.startswith(("Frame", '"Frame"')))
    cells = exports.cells_reader(lines[first + 1 :], axes, delimiter)
    places: dict[tuple[str, str, str], dict[str, dict[str, int]]] = {}
    for k in range(2, len(axes)):
        if measures[k] in ("Position", "Rotation"):
            track = places.setdefault((kinds[k], names[k], identities[k]), {})
            track.setdefault(measures[k], {})[axes[k].upper()] = k
    tracks = []
    for (kind, name, _), columns in places.items():
        where, turned = columns.get("Position", {}), columns.get("Rotation", {})
        if not set("XYZ") <= set(where):
            continue
        quaternion = None
        if set("XYZW") <= set(turned):
            quaternion = cells([turned[axis] for axis in "WXYZ"])
        elif set("XYZ") <= set(turned):
            quaternion = _of_angles(cells, turned, meta.get("Rotation Type", "XYZ"))
        position = scale * cells([where[axis] for axis in "XYZ"])
        tracks.append(exports.Track(name, position, quaternion, kind.lower() or "marker"))
    if any(set(columns.get("Rotation", {})) == set("XYZ") for columns in places.values()):
        what = (
            f"its Euler angles ({meta.get('Rotation Type', 'XYZ')}) are read as turns about the moving axes"
        )
        findings.append(Finding("note", "", what))
    tracks.sort(key=lambda track: [*map(str.lower, _KINDS), track.kind].index(track.kind))
    take = meta.get("Take Name", "")
    source = f"{path.name}: {take}" if take else ""
    return exports.export_table(cells([1])[:, 0], tracks, up="y", findings=findings, source=source)


def _of_angles(cells: exports.Columns, places: dict[str, int], order: str) -> np.ndarray:
    """Return quaternions of Euler angles (degrees) about the moving axes in an order such as XYZ."""
    from scipy.spatial.transform import Rotation

    if sorted(order.upper()) != list("XYZ"):
        raise RecordingError(f"the rotation type is {order!r}; allowed is Quaternion, or an order as XYZ")
    angles = cells([places[axis] for axis in order.upper()])
    return exports.quaternions_of(
        angles, lambda known: Rotation.from_euler(order.upper(), known, degrees=True)
    )


register(
    RecordingFormat(
        "OptiTrack Motive CSV",
        recognise=lambda head: head.removeprefix(b"\xef\xbb\xbf").startswith(_START.encode()),
        read=read_motive,
    )
)
