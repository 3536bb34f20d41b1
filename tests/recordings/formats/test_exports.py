"""Exports of motion capture: recognised by their content, in m with z up, with gaps, in all variants."""

import contextlib
import gzip

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from knode_cosserat.recordings import RecordingConfig, RecordingError, load_recording
from knode_cosserat.recordings.config import BaseSource, ColumnMap, ControlSource, MarkerSource
from knode_cosserat.recordings.formats import format_of, formats
from tests.recordings.formats import exported

TIME = exported.times()
LOST = range(80, 90)


def forces(at):
    return 5.0 + np.array([np.sin(at), np.cos(at), 0.1 * at, -0.2 * at])


def config(prefix="", ending="", **changes):
    """The configuration that a user writes: a base, and two bodies at measured places."""
    names = {name: f"{prefix}{name}{ending}" for name in exported.BODIES}
    markers = (MarkerSource("rib", names["rib"], 0.5), MarkerSource("tip", names["tip"], 1.0))
    given = {"markers": markers, "base": BaseSource(names["base"]), "controls": "none"} | changes
    return RecordingConfig(**given)


def agrees(recording, tolerance, angle=None, lost=()):
    """The bodies have the true poses, in the robot's frame, but where they are lost."""
    for body, fraction in zip(recording.bodies, (0.5, 1.0), strict=True):
        rows = np.delete(np.arange(len(TIME)), list(lost)) if fraction == 1.0 else np.arange(len(TIME))
        np.testing.assert_allclose(body.time, TIME[rows], atol=1e-6)
        position, rotation = exported.bent(TIME[rows], fraction)
        np.testing.assert_allclose(body.position, position, atol=tolerance)
        assert (body.quaternion is None) == (angle is None)
        if angle is not None:
            off = Rotation.from_quat(body.quaternion, scalar_first=True).inv() * rotation
            assert np.degrees(off.magnitude().max()) < angle
    assert not [each for each in recording.findings if each.severity == "problem"]


MOTIVE = {
    "as by default": {},
    "in mm, with gaps, rows of parents, and timecodes": {
        "version": "1.25",
        "unit": "Millimeters",
        "labelled": True,
        "timecode": True,
        "lost": LOST,
    },
    "in cm, rigid bodies only": {"unit": "Centimeters", "markers": False},
    "Euler angles XYZ": {"rotation": "XYZ"},
    "Euler angles ZYX": {"rotation": "ZYX"},
    "with semicolons and decimal commas": {"delimiter": ";", "decimal": ","},
}


@pytest.mark.parametrize("variant", MOTIVE)
def test_motive(tmp_path, variant):
    path = tmp_path / "it.csv"
    path.write_bytes(exported.motive(TIME, **MOTIVE[variant]))
    assert format_of(path).name == "OptiTrack Motive CSV"
    recording = load_recording(path, config())
    agrees(recording, 2e-6, 1e-3, MOTIVE[variant].get("lost", ()))
    assert recording.source.endswith("take Take 7") or "Take 7" in recording.source
    # without a configuration the bodies, their order and places are found, and the guess is reported
    guessed = load_recording(path)
    agrees(guessed, 2e-6, 1e-3, MOTIVE[variant].get("lost", ()))
    assert any("are guessed from distances from base" in each.message for each in guessed.findings)


def test_markers_of_motive_have_their_measured_places(tmp_path):
    path = tmp_path / "it.csv"
    path.write_bytes(exported.motive(TIME))
    one = config(markers=(MarkerSource("tip", "tip:Marker1", 1.0),))
    (body,) = load_recording(path, one).bodies
    # the solved ones come first in the file; measured ones are 1 mm aside, along Motive's z
    expected = exported.bent(TIME)[0] + [0.02, -0.001, 0.0]
    np.testing.assert_allclose(body.position, expected, atol=2e-6)
    solved = config(markers=(MarkerSource("tip", "tip:Marker1 (rigid body marker)", 1.0),))
    (body,) = load_recording(path, solved).bodies
    np.testing.assert_allclose(body.position, exported.bent(TIME)[0] + [0.02, 0.0, 0.0], atol=2e-6)


NEXUS = {
    "as by default": {},
    "with gaps and another first frame": {"lost": LOST, "first": 101},
    "after blank lines, with semicolons and decimal commas": {
        "blank_lines": 2,
        "delimiter": ";",
        "decimal": ",",
    },
    "with devices before": {"forces": forces},
    "with devices, gaps and tabs": {"forces": forces, "lost": LOST, "delimiter": "\t"},
}


@pytest.mark.parametrize("variant", NEXUS)
def test_nexus(tmp_path, variant):
    path = tmp_path / "it.csv"
    path.write_bytes(exported.nexus(TIME, **NEXUS[variant]))
    assert format_of(path).name == "Vicon CSV"
    agrees(load_recording(path, config("Robot:")), 1e-6, None, NEXUS[variant].get("lost", ()))
    if "forces" in NEXUS[variant]:
        titles = tuple(f"Load cells - Force T{k} [N]" for k in (2, 1, 4, 3))
        source = ControlSource("cells", (2, 1, 4, 3))
        mapped = config(
            "Robot:", tension=source, columns=ColumnMap(controls=(("tension", titles),)), controls="measured"
        )
        tension = load_recording(path, mapped).control
        np.testing.assert_allclose(tension.time, np.arange(10 * len(TIME)) / 1000.0, atol=1e-9)
        np.testing.assert_allclose(tension.values, np.array([forces(at) for at in tension.time]), atol=1e-5)
        # the same channels are found without a configuration
        np.testing.assert_allclose(load_recording(path).control.values, tension.values, atol=1e-12)


@pytest.mark.parametrize(
    "variant", [{}, {"kind": "Segments", "unit": "rad"}, {"quaternion": True}, {"kind": "Segments"}]
)
def test_segments_and_objects_of_vicon(tmp_path, variant):
    path = tmp_path / "it.csv"
    path.write_bytes(exported.tracker(TIME, **variant))
    names = {name: f"{name}:{name}" for name in exported.BODIES}
    markers = (MarkerSource("rib", names["rib"], 0.5), MarkerSource("tip", names["tip"], 1.0))
    agrees(load_recording(path, config(markers=markers, base=BaseSource(names["base"]))), 1e-6, 1e-3)
    agrees(load_recording(path), 1e-6, 1e-3)


TRC = {
    "as by default": {},
    "with gaps": {"lost": LOST},
    "in m, without the blank line": {"unit": "m", "blank_line": False},
    "in cm, names one tab apart": {"unit": "cm", "tabs_after": False},
    "without the line of axes": {"axes": False, "blank_line": False},
}


@pytest.mark.parametrize("variant", TRC)
def test_trc(tmp_path, variant):
    path = tmp_path / "it.trc"
    path.write_bytes(exported.trc(TIME, **TRC[variant]))
    assert format_of(path).name == "TRC"
    agrees(load_recording(path, config()), 6e-6, None, TRC[variant].get("lost", ()))
    recording = load_recording(path)
    agrees(recording, 6e-6, None, TRC[variant].get("lost", ()))
    assert any("do not state which axis points up" in each.message for each in recording.findings)


C3D = {
    "Intel floats": {},
    "in m, with gaps": {"unit": "m", "lost": LOST},
    "MIPS": {"order": ">", "forces": forces},
    "DEC": {"order": "dec", "forces": forces, "lost": LOST},
    "integers": {"floats": False, "forces": forces, "lost": LOST},
    "integers of MIPS": {"floats": False, "order": ">", "per_frame": 10, "forces": forces},
    "y up": {"up": "y", "screen": ("+X", "+Y")},
    "without most parameters": {"leave_out": ("USED", "SCALE", "RATE", "FRAMES", "DATA_START", "X_SCREEN")},
}


@pytest.mark.parametrize("variant", C3D)
def test_c3d(tmp_path, variant):
    options = C3D[variant]
    path = tmp_path / "it.c3d"
    path.write_bytes(exported.c3d(TIME, **options))
    assert format_of(path).name == "C3D"
    # scaled integers have steps of 0.05 mm
    tolerance = 1e-6 if options.get("floats", True) else 3e-5
    agrees(load_recording(path, config()), tolerance, None, options.get("lost", ()))
    if "forces" in options:
        titles = tuple(f"cell{k + 1} [N]" for k in range(4))
        source = ControlSource("cells", (1, 2, 3, 4))
        mapped = config(
            tension=source, columns=ColumnMap(controls=(("tension", titles),)), controls="measured"
        )
        tension = load_recording(path, mapped).control
        rate = 100.0 * options.get("per_frame", 2)
        np.testing.assert_allclose(np.diff(tension.time), 1.0 / rate, atol=1e-9)
        expected = np.array([forces(at) for at in tension.time])
        np.testing.assert_allclose(tension.values, expected, atol=5.1e-3 if tolerance > 1e-5 else 1e-5)


def test_a_c3d_file_that_was_cut_is_read_to_its_end(tmp_path):
    whole = exported.c3d(TIME)
    size = 4 * 4 * len(exported.BODIES)
    path = tmp_path / "it.c3d"
    # half of the frames and a part of another
    path.write_bytes(whole[: len(whole) - len(TIME) // 2 * size - 7])
    recording = load_recording(path, config())
    count = len(recording.bodies[0].time)
    assert 0 < count < len(TIME)
    np.testing.assert_allclose(recording.bodies[1].position, exported.bent(TIME[:count])[0], atol=1e-6)
    assert any(f"{count} of {len(TIME)} frames are complete" in each.message for each in recording.findings)


def test_the_content_decides_and_not_the_name(tmp_path):
    for name, data in (
        ("a.txt", exported.motive(TIME)),
        ("b.tsv", exported.trc(TIME)),
        ("c.bin", exported.c3d(TIME)),
        ("d.csv", b"\xef\xbb\xbf" + exported.motive(TIME)),
        ("e.csv", exported.nexus(TIME, blank_lines=2)),
    ):
        (tmp_path / name).write_bytes(data)
        assert len(load_recording(tmp_path / name).bodies) == 2
    (tmp_path / "f.csv.gz").write_bytes(gzip.compress(exported.motive(TIME)))
    agrees(load_recording(tmp_path / "f.csv.gz"), 2e-6, 1e-3)
    # a title whose second letter is the key of C3D is text
    (tmp_path / "g.csv").write_bytes(b"GP1,XP2\n1,2\n")
    assert format_of(tmp_path / "g.csv").is_fallback


def test_the_axis_that_points_up_can_be_stated(tmp_path):
    path = tmp_path / "it.trc"
    path.write_bytes(exported.trc(TIME))
    turned = load_recording(path, config(up="z")).bodies[1].position
    x, y, z = exported.bent(TIME)[0].T
    np.testing.assert_allclose(turned, np.stack([x, z, -y], axis=1), atol=1e-5)
    with pytest.raises(RecordingError, match="up is 'w'; allowed is z or y or x"):
        config(up="w")


def test_frames_at_exactly_zero_are_lost_ones(tmp_path):
    text = exported.trc(TIME).decode().split("\n")
    cells = text[26].split("\t")
    text[26] = "\t".join([*cells[:-3], "0.00000", "0.00000", "0.00000"])
    path = tmp_path / "it.trc"
    path.write_text("\n".join(text))
    recording = load_recording(path, config())
    assert len(recording.bodies[1].time) == len(TIME) - 1
    assert any("1 frame is at exactly 0, 0, 0; left out" in each.message for each in recording.findings)


def test_every_format_is_found_by_itself():
    names = {kind.name for kind in formats()}
    assert {"ROS 1 bag", "ROS 2 bag", "CSV table", "Parquet table", "OptiTrack Motive CSV"} <= names
    assert {"Vicon CSV", "TRC", "C3D"} <= names
    assert [kind.name for kind in formats() if kind.is_fallback] == ["CSV table"]


def changed(data, old, new):
    assert old in data
    return data.replace(old, new, 1)


SHORT = exported.times(seconds=0.1)
DAMAGED = {
    "no header of motive": (exported.motive(SHORT).split(b"\r\n")[0], "the header of this export of Motive"),
    "no rows": (exported.motive(SHORT[:0]), "no rows after the header"),
    "an unknown unit": (
        changed(exported.motive(SHORT), b"Meters", b"Furlongs"),
        "the unit of length is 'Furlongs'",
    ),
    "an unknown rotation": (
        changed(exported.motive(SHORT, rotation="XYZ"), b"Rotation Type,XYZ", b"Rotation Type,ABC"),
        "the rotation type is 'ABC'",
    ),
    "text for a number": (
        changed(exported.motive(SHORT), b"\r\n3,0.030000,", b"\r\n3,0.030000,what"),
        "allowed is a finite number",
    ),
    "no positions": (
        exported.motive(SHORT).replace(b"Position", b"Velocity"),
        "it has no bodies and no markers with positions",
    ),
    "a section of vicon without rows": (
        b"Trajectories\n100\n,,a,,\nFrame,Sub Frame,X,Y,Z\n",
        "Trajectories is incompl",
    ),
    "a section of vicon without frames": (
        changed(exported.nexus(SHORT), b"Frame,Sub Frame", b"A,B"),
        "required are Frame, Sub Frame",
    ),
    "an unknown angle": (exported.tracker(SHORT).replace(b"deg", b"gon"), "allowed is deg or rad"),
    "no names in trc": (changed(exported.trc(SHORT), b"Frame#", b"Number"), "the header of this TRC file"),
    "trc cut in its header": (exported.trc(SHORT)[:120], "the header of this TRC file"),
    "trc without rows": (exported.trc(SHORT[:0]), "no rows after the header"),
    "another processor": (
        exported.c3d(SHORT)[:515] + b"\x57" + exported.c3d(SHORT)[516:],
        "is of the processor 87; allowed is 84",
    ),
    "c3d cut in its parameters": (exported.c3d(SHORT)[:600], "C3D file"),
    "c3d without a rate": (
        changed(exported.c3d(SHORT, rate=100.0), b"RATE", b"RITE")[:20]
        + bytes(4)
        + changed(exported.c3d(SHORT, rate=100.0), b"RATE", b"RITE")[24:],
        "has the rate 0",
    ),
}


@pytest.mark.parametrize("damage", DAMAGED)
def test_a_damaged_export_gives_one_line(tmp_path, damage):
    data, words = DAMAGED[damage]
    path = tmp_path / ("it.c3d" if data[1:2] == b"\x50" else "it.trc" if b"Path" in data[:4] else "it.csv")
    path.write_bytes(data)
    with pytest.raises(RecordingError) as raised:
        load_recording(path)
    message = str(raised.value)
    assert message.startswith(f"{path}: ") and words in message and "\n" not in message


@pytest.mark.parametrize("kind", ["motive", "nexus", "trc", "c3d"])
def test_bytes_changed_at_random_give_a_recording_or_its_error(tmp_path, kind):
    whole = getattr(exported, kind)(SHORT)
    rng = np.random.default_rng(0)
    path = tmp_path / "it"
    for _ in range(25):
        data = bytearray(whole)
        for place in rng.integers(0, len(data) if rng.random() < 0.5 else min(len(data), 1200), 4):
            data[place] = rng.integers(0, 256)
        path.write_bytes(bytes(data[: rng.integers(20, len(data) + 1)] if rng.random() < 0.3 else data))
        with contextlib.suppress(RecordingError):
            load_recording(path)


def test_limits_of_exports(tmp_path, monkeypatch):
    path = tmp_path / "it.csv"
    path.write_bytes(exported.motive(SHORT))
    monkeypatch.setattr("knode_cosserat.recordings.exports.MOST_COLUMNS", 20)
    with pytest.raises(RecordingError, match="columns; allowed are 20; set KNODE_COSSERAT_LIMITS=10"):
        load_recording(path)
    path.write_bytes(exported.c3d(SHORT))
    monkeypatch.setattr("knode_cosserat.recordings.formats.c3d.MOST_COLUMNS", 5)
    with pytest.raises(RecordingError, match="it has 9 columns; allowed are 5; set KNODE_COSSERAT_LIMITS=10"):
        load_recording(path)
    monkeypatch.undo()
    monkeypatch.setattr("knode_cosserat._files.csv_rows.LARGEST_FILE", 1000)
    for name in ("motive", "trc", "c3d"):
        path.write_bytes(getattr(exported, name)(SHORT))
        with pytest.raises(RecordingError, match="bytes; allowed are 1000; set KNODE_COSSERAT_LIMITS=10"):
            load_recording(path)
