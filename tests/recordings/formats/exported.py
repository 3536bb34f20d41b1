"""A bending rod whose truth is known, and writers of what motion capture exports of it.

The writers follow public descriptions and samples of the formats, and use nothing of the package.
"""

import io
import struct

import numpy as np
from scipy.spatial.transform import Rotation

LENGTH = 0.4
BODIES = {"base": 0.0, "rib": 0.5, "tip": 1.0}
#: where the laboratory has the clamped end (z up, m)
CLAMP = np.array([0.31, -0.12, 0.85])


def times(rate=100.0, seconds=2.0):
    return np.round(np.arange(round(seconds * rate)) / rate, 9)


def bent(time, fraction=1.0):
    """Position (m, clamped end at zero, z up) and rotation of an arc that bends after half a second."""
    running = np.clip(time - 0.5, 0.0, None)
    angle = 0.9 * fraction * np.sin(2.0 * np.pi * 0.7 * running)
    plane = 1.3 * running
    along = fraction * LENGTH
    aside = along * 0.5 * angle * np.sinc(0.5 * angle / np.pi) ** 2
    up = along * np.sinc(angle / np.pi)
    position = np.stack([aside * np.cos(plane), aside * np.sin(plane), up], axis=1)
    axis = np.stack([-np.sin(plane), np.cos(plane), np.zeros_like(plane)], axis=1)
    return position, Rotation.from_rotvec(angle[:, None] * axis)


def laboratory(time, fraction, up="z"):
    """Pose in the laboratory's frame: position (m) and quaternion with the scalar last."""
    position, rotation = bent(time, fraction)
    position = position + CLAMP
    if up == "y":
        # (x, y, z) with z up are (x, z, -y) with y up
        turn = Rotation.from_matrix([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
        position, rotation = turn.apply(position), turn * rotation
    return position, rotation.as_quat()


def _number(value, digits=6):
    return "" if not np.isfinite(value) else f"{value:.{digits}f}"


def motive(
    time,
    *,
    version="1.23",
    unit="Meters",
    rotation="Quaternion",
    labelled=False,
    lost=(),
    delimiter=",",
    decimal=".",
    timecode=False,
    bodies=BODIES,
    markers=True,
):
    """CSV of Motive: rigid bodies, markers on the tip and an unlabelled one; y up."""
    scale = {"Meters": 1.0, "Millimeters": 1e3, "Centimeters": 100.0}[unit]
    kinds, names, ids, measures, axes, columns = [], [], [], [], [], []

    def add(kind, name, number, measure, letters, values):
        for letter, column in zip(letters, np.asarray(values).T, strict=True):
            for row, cell in zip(
                (kinds, names, ids, measures, axes), (kind, name, number, measure, letter), strict=True
            ):
                row.append(cell)
            columns.append(column)

    for k, (name, fraction) in enumerate(bodies.items()):
        position, quaternion = laboratory(time, fraction, "y")
        gone = np.isin(np.arange(len(time)), lost) if name == "tip" else np.zeros(len(time), bool)
        position, quaternion = position.copy(), quaternion.copy()
        position[gone], quaternion[gone] = np.nan, np.nan
        error = np.where(gone, np.nan, 0.0002 * scale)
        number = f"9F{k}:AB"
        if rotation == "Quaternion":
            add("Rigid Body", name, number, "Rotation", "XYZW", quaternion)
        else:
            angles = np.full((len(time), 3), np.nan)
            angles[~gone] = Rotation.from_quat(quaternion[~gone]).as_euler(rotation, degrees=True)
            add("Rigid Body", name, number, "Rotation", rotation, angles)
        add("Rigid Body", name, number, "Position", "XYZ", scale * position)
        add("Rigid Body", name, number, "Mean Marker Error", [""], error[:, None])
        if markers:
            for kind, shift in (("Rigid Body Marker", 0.0), ("Marker", 0.001)):
                seen = scale * (position + np.array([0.02, 0.0, shift]))
                add(kind, f"{name}:Marker1", f"9F{k}:M{shift}", "Position", "XYZ", seen)
    if markers:
        add("Marker", "Unlabeled 1189", "88", "Position", "XYZ", np.full((len(time), 3), 0.5 * scale))
    lead = (lambda word: ["", word]) if labelled else (lambda word: ["", ""])
    extra = [""] if timecode else []
    rows = [
        [*lead("Type"), *extra, *kinds],
        [*lead("Name"), *extra, *names],
        [*lead("ID"), *extra, *ids],
        *([[*lead("Parent"), *extra, *[""] * len(kinds)]] if labelled else []),
        ["", "", *extra, *measures],
        ["Frame", "Time (Seconds)", *(["TimeCode"] if timecode else []), *axes],
    ]
    meta = [
        "Format Version",
        version,
        "Take Name",
        "Take 7",
        "Capture Frame Rate",
        "100.000000",
        "Export Frame Rate",
        "100.000000",
        "Capture Start Time",
        "2026-08-04 03.25.39.123 PM",
        "Total Exported Frames",
        str(len(time)),
        "Rotation Type",
        rotation,
        "Length Units",
        unit,
        "Coordinate Space",
        "Global",
    ]
    lines = [delimiter.join(meta), "", *map(delimiter.join, rows)]
    for k, at in enumerate(time):
        cells = [_number(column[k]) for column in columns]
        stamp = [f"15:26:46:{k:02d}.00"] if timecode else []
        lines.append(delimiter.join([str(k), *[f"{at:.6f}", *stamp], *cells]).replace(".", decimal))
    return ("\r\n".join(lines) + "\r\n").encode()


def nexus(
    time,
    *,
    rate=100,
    first=1,
    delimiter=",",
    decimal=".",
    blank_lines=0,
    lost=(),
    forces=None,
    cells_after=True,
):
    """CSV of Nexus: devices (four cells at ten times the rate) and trajectories of markers, z up, in mm."""

    def row(cells):
        return delimiter.join(cells)

    lines = [""] * blank_lines
    if forces is not None:
        lines += ["Devices", str(10 * rate), row(["", "", "Load cells - Force", "", "", ""])]
        lines += [row(["Frame", "Sub Frame", "T1", "T2", "T3", "T4"]), row(["", "", "N", "N", "N", "N"])]
        for k in range(10 * len(time)):
            values = forces(time[0] + k / (10.0 * rate))
            lines.append(
                row([str(first + k // 10), str(k % 10), *map(_number, values)]).replace(".", decimal)
            )
        lines.append("")
    names = [f"Robot:{name}" for name in BODIES]
    lines += ["Trajectories", str(rate), row(["", "", *(cell for name in names for cell in (name, "", ""))])]
    lines += [row(["Frame", "Sub Frame", *"XYZ" * len(names)]), row(["", "", *["mm"] * 3 * len(names)])]
    places = [1e3 * laboratory(time, fraction)[0] for fraction in BODIES.values()]
    for k in range(len(time)):
        cells = [
            "" if name == "Robot:tip" and k in lost else _number(value, 3)
            for name, place in zip(names, places, strict=True)
            for value in place[k]
        ]
        lines.append(row([str(first + k), "0", *cells]).replace(".", decimal))
    return ("\r\n".join([*lines, ""])).encode()


def tracker(time, *, kind="Objects", rate=100, quaternion=False, unit="deg"):
    """CSV of Tracker or of Nexus' segments: rotation vectors or quaternions, and positions in mm."""
    letters = ["RX", "RY", "RZ", *(["RW"] if quaternion else []), "TX", "TY", "TZ"]
    names = [cell for name in BODIES for cell in (f"Global Angle {name}:{name}", *[""] * (len(letters) - 1))]
    units = [*([""] * 4 if quaternion else [unit] * 3), "mm", "mm", "mm"]
    lines = [
        kind,
        str(rate),
        ",".join(["", "", *names]),
        ",".join(["Frame", "Sub Frame", *letters * len(BODIES)]),
    ]
    lines.append(",".join(["", "", *units * len(BODIES)]))
    poses = [laboratory(time, fraction) for fraction in BODIES.values()]
    for k in range(len(time)):
        cells = []
        for position, turned in poses:
            vector = Rotation.from_quat(turned[k]).as_rotvec(degrees=unit == "deg")
            cells += [*map(_number, turned[k] if quaternion else vector), *map(_number, 1e3 * position[k])]
        lines.append(",".join([str(k + 1), "0", *cells]))
    return ("\n".join(lines) + "\n").encode()


def trc(time, *, unit="mm", blank_line=True, lost=(), axes=True, tabs_after=True):
    """TRC as OpenSim writes it; y up."""
    scale = {"mm": 1e3, "m": 1.0, "cm": 100.0}[unit]
    tail = "\t\t" if tabs_after else "\t"
    out = io.StringIO()
    out.write("PathFileType\t4\t(X/Y/Z)\tC:\\data\\take.trc\n")
    out.write(
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames\n"
    )
    out.write(f"100.00\t100.00\t{len(time)}\t{len(BODIES)}\t{unit}\t100.00\t1\t{len(time)}\n")
    out.write("Frame#\tTime\t" + "".join(f"{name}{tail}\t" for name in BODIES).rstrip("\t") + "\n")
    if axes:
        out.write("\t\t" + "\t".join(f"{axis}{k + 1}" for k in range(len(BODIES)) for axis in "XYZ") + "\n")
    if blank_line:
        out.write("\n")
    places = [scale * laboratory(time, fraction, "y")[0] for fraction in BODIES.values()]
    for k, at in enumerate(time):
        cells = [
            "" if name == "tip" and k in lost else _number(value, 5)
            for name, place in zip(BODIES, places, strict=True)
            for value in place[k]
        ]
        out.write("\t".join([str(k + 1), f"{at:.5f}", *cells]) + "\n")
    return out.getvalue().encode()


def c3d(
    time,
    *,
    unit="mm",
    order="<",
    floats=True,
    screen=("+X", "+Z"),
    lost=(),
    forces=None,
    rate=100.0,
    per_frame=2,
    first=1,
    up="z",
    labels=None,
    leave_out=(),
):
    """C3D of markers, and of four analog channels with `per_frame` samples a frame."""
    processor = {"<": 84, ">": 86, "dec": 85}[order]
    endian = "<" if order == "dec" else order
    scale = {"mm": 1e3, "m": 1.0, "cm": 100.0}[unit]
    factor = -0.1 if floats else 0.05 * scale / 1e3
    count = 0 if forces is None else 4
    per_frame = per_frame if count else 0
    names = list(labels or BODIES)

    def real(value):
        packed = struct.pack(f"{endian}f", value * 4.0 if order == "dec" else value)
        return packed[2:] + packed[:2] if order == "dec" else packed

    def group(number, name):
        body = struct.pack("B", 0)
        return (
            struct.pack("bb", len(name), -number)
            + name.encode()
            + struct.pack(f"{endian}h", 2 + len(body))
            + body
        )

    def parameter(number, name, kind, sizes, data):
        body = struct.pack("bB", kind, len(sizes)) + bytes(sizes) + data + struct.pack("B", 0)
        return (
            struct.pack("bb", len(name), number)
            + name.encode()
            + struct.pack(f"{endian}h", 2 + len(body))
            + body
        )

    def texts(words):
        width = max(map(len, words))
        return [width, len(words)], "".join(word.ljust(width) for word in words).encode()

    def word(value):
        return struct.pack(f"{endian}H", value)

    point = {
        "USED": (2, [], word(len(names))),
        "SCALE": (4, [], real(factor)),
        "RATE": (4, [], real(rate)),
        "FRAMES": (2, [], word(len(time))),
        "DATA_START": (2, [], word(0)),
        "LABELS": (-1, *texts(names)),
        "UNITS": (-1, [len(unit)], unit.encode()),
        "X_SCREEN": (-1, [2], screen[0].encode()),
        "Y_SCREEN": (-1, [2], screen[1].encode()),
    }
    analog = {
        "USED": (2, [], word(count)),
        "RATE": (4, [], real(rate * per_frame)),
        "GEN_SCALE": (4, [], real(0.5)),
        "SCALE": (4, [4], real(0.02) * 4),
        "OFFSET": (2, [4], word(100) * 4),
        "LABELS": (-1, *texts([f"cell{k + 1}" for k in range(4)])),
        "UNITS": (-1, *texts(["N"] * 4)),
    }

    def section(data_start):
        point["DATA_START"] = (2, [], word(data_start))
        body = group(1, "POINT")
        body += b"".join(parameter(1, key, *value) for key, value in point.items() if key not in leave_out)
        if count:
            body += group(2, "ANALOG") + b"".join(parameter(2, key, *value) for key, value in analog.items())
        body += bytes(2)
        blocks = -(-(len(body) + 4) // 512)
        return (struct.pack("BBBB", 1, 0x50, blocks, processor) + body).ljust(512 * blocks, b"\0"), blocks

    blocks = section(0)[1]
    parameters = section(2 + blocks)[0]
    header = struct.pack("BB", 2, 0x50)
    header += b"".join(map(word, (len(names), count * per_frame, first, first + len(time) - 1, 10)))
    header += real(factor) + word(2 + blocks) + word(per_frame) + real(rate)
    places = [scale * laboratory(time, BODIES.get(name, 1.0), up)[0] for name in names]
    data = []
    for k, at in enumerate(time):
        for name, place in zip(names, places, strict=True):
            gone = name == "tip" and k in lost
            where = np.zeros(3) if gone else place[k]
            if floats:
                data += [*map(real, where), real(-1.0 if gone else 0.0)]
            else:
                data += [struct.pack(f"{endian}h", round(value / factor)) for value in where]
                data.append(struct.pack(f"{endian}h", -1 if gone else 0))
        for j in range(per_frame):
            for value in forces(at + j / (rate * per_frame)) if count else ():
                raw = value / (0.5 * 0.02) + 100
                data.append(real(raw) if floats else struct.pack(f"{endian}h", round(raw)))
    return header.ljust(512, b"\0") + parameters + b"".join(data).ljust(512, b"\0")
