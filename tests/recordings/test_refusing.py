"""Files that are no recordings, or of another robot: each is refused in one line."""

import dataclasses
import sys

import pytest

import knode_cosserat as kc
from knode_cosserat.recordings import RecordingConfig, RecordingError, messages
from knode_cosserat.recordings.config import BaseSource, ControlSource
from knode_cosserat.recordings.formats import written_suffixes
from knode_cosserat.recordings.streams import ControlRows
from knode_cosserat.recordings.write import write_recording
from tests.recordings.made import PAPER, changed, write


def refused(path, config=None):
    with pytest.raises(RecordingError) as raised:
        kc.load_recording(path, config)
    message = str(raised.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    return message


def test_a_bag_of_another_robot_is_refused_by_the_topic_that_it_lacks(tmp_path, exact):
    path = write(tmp_path / "it.bag", exact)
    other = dataclasses.replace(PAPER, base=BaseSource("/optitrack/base/pose", 0.0))
    message = refused(path, other)
    assert "topic /optitrack/base/pose (pose) is missing; the bag has /rosout, /tension, /vicon/" in message


def test_a_topic_of_another_type_is_refused(tmp_path, exact):
    path = write(tmp_path / "it.bag", exact)
    other = dataclasses.replace(
        PAPER, tension=ControlSource("/vicon/continuum_0/pose", (1, 2, 3, 4)), markers=PAPER.markers[1:]
    )
    message = refused(path, other)
    assert (
        "topic /vicon/continuum_0/pose: its messages are geometry_msgs/PoseStamped; allowed for a" in message
    )
    assert "geometry_msgs/QuaternionStamped" in message


def test_a_type_that_is_not_the_standard_one_is_refused(tmp_path, exact):
    data = write(tmp_path / "it.bag", exact).read_bytes()
    store = messages.typestore(1)
    digest = store.generate_msgdef("geometry_msgs/msg/PoseStamped")[1].encode()
    (tmp_path / "it.bag").write_bytes(data.replace(digest, digest[::-1]))
    assert "is not the type that ROS defines by this name" in refused(tmp_path / "it.bag")


def test_another_number_of_tendons_is_refused(tmp_path, exact):
    path = write(tmp_path / "it.bag", exact)
    two = RecordingConfig(markers=PAPER.markers, tension=ControlSource("/tension", (1, 2), "gf"))
    assert "topic /tension: a message has 4 tensions; the configuration's order has 2 numbers" in refused(
        path, two
    )


def test_too_few_frames_are_refused(tmp_path, exact):
    path = write(tmp_path / "it.bag", changed(exact, "rib 3", rows=slice(1)))
    assert "topic /vicon/continuum_2/pose: 1 usable poses of rib 3; required is 2" in refused(path)


def test_commands_that_are_needed_are_asked_for(tmp_path, exact):
    poses, tension, _ = exact
    path = write(tmp_path / "it.bag", (poses, tension, None))
    recording = kc.load_recording(path)
    assert recording.command is None
    assert [str(it) for it in recording.findings] == [
        "note: /rosout: there is no such topic, and so no commands"
    ]
    with pytest.raises(RecordingError, match="there are no commanded controls"):
        recording.sampled(controls="commanded")
    driven = dataclasses.replace(PAPER, controls="commanded")
    assert "topic /rosout (command) is missing" in refused(path, driven)


def test_files_that_are_no_recordings_are_refused(tmp_path):
    assert "no such file" in refused(tmp_path / "nowhere.bag")
    (tmp_path / "folder").mkdir()
    assert "this folder holds no bag" in refused(tmp_path / "folder")
    (tmp_path / "folder" / "it.mcap.zstd").touch()
    with pytest.raises(RecordingError, match=r"it\.mcap\.zstd: no topic in this MCAP file can be read"):
        kc.load_recording(tmp_path / "folder")
    for name, data, words in (
        ("old.bag", b"#ROSBAG V1.2\n", "a bag of version '1.2'; allowed is 2.0"),
        ("empty.bag", b"", "no topic in this bag can be read; it has 0 bytes"),
        ("picture.png", b"\x89PNG\r\n\x1a\n\xff\xff", "not a recording"),
        ("no.mcap", b"\x89MCAP0\r\n" + bytes(99), "no topic in this MCAP file can be read; it has 107 bytes"),
        ("no.db3", b"SQLite format 3\x00" + bytes(99), "no topic in this SQLite file can be read"),
        ("no.parquet", b"PAR1" + bytes(99), "not a Parquet table"),
    ):
        (tmp_path / name).write_bytes(data)
        assert words in refused(tmp_path / name)


@pytest.mark.parametrize(
    ("library", "file", "words"),
    [
        ("rosbags.typesys", "it.bag", r"bags need rosbags: pip install 'knode-cosserat\[ros\]'"),
        ("pyarrow", "it.parquet", r"Parquet files need pyarrow: pip install 'knode-cosserat\[parquet\]'"),
    ],
)
def test_a_library_that_is_not_installed_is_named(tmp_path, exact, monkeypatch, library, file, words):
    path = write(tmp_path / file, exact)
    messages.typestore.cache_clear()
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(ImportError, match=f"^{words}$"):
        kc.load_recording(path)
    messages.typestore.cache_clear()


def test_what_cannot_be_written_is_said(tmp_path, exact):
    poses, tension, command = exact
    with pytest.raises(RecordingError, match=r"it\.txt: allowed is a name that ends in \.bag, \.mcap"):
        write_recording(tmp_path / "it.txt", PAPER, poses, tension, command)
    with pytest.raises(RecordingError, match="poses are given of"):
        write_recording(tmp_path / "it.bag", PAPER, {"tip": poses["rib 4"]}, tension, command)
    with pytest.raises(RecordingError, match=r"control of shape \(150, 3\); the configuration has 4 numbers"):
        write_recording(tmp_path / "it.bag", PAPER, poses, ControlRows(tension.time, tension.values[:, :3]))
    for ending in written_suffixes():
        with pytest.raises(RecordingError, match="cannot be written"):
            write_recording(tmp_path / "nowhere" / f"it{ending}", PAPER, poses, tension, command)
    assert list(tmp_path.iterdir()) == []
