"""Bags of recorders that were killed, files that were cut, and files with damage anywhere."""

import time

import numpy as np
import pytest

import knode_cosserat as kc
import knode_cosserat.recordings.health  # its import is not timed
from knode_cosserat.recordings import RecordingConfig, RecordingError
from tests.recordings.made import PAPER, compressed, made, write

#: two seconds to end up in chunks of their own
CHUNK = 60_000


@pytest.fixture(scope="module")
def streams():
    return made(seconds=3.0)


@pytest.fixture(scope="module")
def whole(tmp_path_factory, streams):
    """A bag of several chunks by the name of their compression, as a function."""
    folder = tmp_path_factory.mktemp("bags")
    plain = write(folder / "plain.bag", streams)

    def bag(compression=None):
        path = folder / f"{compression}.bag"
        if not path.exists():
            compressed(plain, path, compression, CHUNK)
        return path.read_bytes()

    return bag


def damage(recording):
    found = [str(finding) for finding in recording.findings if "recovered up to" in finding.message]
    assert len(found) == 1, recording.findings
    return found[0]


def assert_begins_alike(recording, streams):
    """What was recovered is the beginning of what there was."""
    for body, name in zip(recording.bodies, ("rib 1", "rib 2", "rib 3", "rib 4"), strict=True):
        np.testing.assert_allclose(body.time, streams[0][name].time[: len(body.time)], rtol=0, atol=1e-9)
        np.testing.assert_allclose(
            np.diff(body.position, axis=0),
            np.diff(streams[0][name].position[: len(body.time)], axis=0),
            rtol=0,
            atol=1e-12,
        )
    known = streams[1].values[: len(recording.control.time)]
    np.testing.assert_allclose(recording.control.values, known, rtol=0, atol=1e-12)


@pytest.mark.parametrize("compression", [None, "BZ2", "LZ4"])
def test_a_bag_that_was_cut_is_read_as_far_as_it_goes(tmp_path, whole, streams, compression):
    data = whole(compression)
    path = tmp_path / "it.bag"
    reached = []
    for share in (0.55, 0.8):
        path.write_bytes(data[: int(share * len(data))])
        recording = kc.load_recording(path)
        assert_begins_alike(recording, streams)
        line = damage(recording)
        assert "the file was cut: recovered up to " in line
        reached.append(recording.bodies[0].time[-1])
        assert f"recovered up to {reached[-1]:.1f}"[:-1] in line
    assert 0.4 < reached[0] < reached[1] < 2.9


@pytest.mark.parametrize("compression", [None, "BZ2", "LZ4"])
@pytest.mark.parametrize("closed", [True, False])
def test_a_bag_whose_recorder_was_killed_is_read_to_its_end(tmp_path, whole, streams, compression, closed):
    data = bytearray(whole(compression))
    index = int.from_bytes(data[data.index(b"index_pos=") + 10 :][:8], "little")
    at = data.index(b"index_pos=") + 10
    data[at : at + 8] = bytes(8)
    data = data[:index]
    if not closed:
        # the last chunk's lengths are written when it is closed; nothing comes after its records
        begin = data.rindex(b"compression=") - 12 if compression else data.rindex(b"compression=none") - 12
        header_end = data.index(b"size=", begin) + 9
        length = int.from_bytes(data[header_end : header_end + 4], "little")
        data[header_end - 4 : header_end + 4] = bytes(8)
        data = data[: header_end + 4 + length]
    path = tmp_path / "it.bag.active"
    path.write_bytes(data)
    recording = kc.load_recording(path)
    assert_begins_alike(recording, streams)
    assert len(recording.bodies[0].time) == 300
    line = damage(recording)
    assert "the recorder was stopped before it had finished the file: recovered up to 2.99" in line
    assert "bytes" not in line


def test_after_damage_in_the_middle_the_rest_is_read(tmp_path, whole):
    data = bytearray(whole())
    data[100_000:101_000] = bytes(1000)
    (tmp_path / "it.bag").write_bytes(data)
    recording = kc.load_recording(tmp_path / "it.bag")
    assert "the file is damaged: recovered up to 2.99" in damage(recording)
    lost = 5 * 300 - sum(len(body.time) for body in (*recording.bodies, recording.base))
    assert 2 <= lost <= 12


@pytest.mark.parametrize("ending", [".mcap", ".db3"])
def test_bags_of_ros_2_that_were_cut_are_read_as_far_as_they_go(tmp_path, streams, ending):
    path = write(tmp_path / f"it{ending}", streams)
    data = path.read_bytes()
    reached = []
    for share in (0.5, 0.75):
        path.write_bytes(data[: int(share * len(data))])
        recording = kc.load_recording(path)
        assert_begins_alike(recording, streams)
        assert "was cut" in damage(recording)
        reached.append(recording.bodies[0].time[-1])
    assert 0.5 < reached[0] < reached[1] < 2.9


def test_a_table_that_was_cut_loses_its_last_row(tmp_path, streams):
    path = write(tmp_path / "it.csv", streams)
    data = path.read_bytes()
    path.write_bytes(data[: int(0.7 * len(data)) - 3])
    recording = kc.load_recording(path, PAPER)
    assert 1.5 < recording.end < 2.5


# damage anywhere


def mutated(data, rng):
    """Bytes with one to four random mutations."""
    data = bytearray(data)
    for _ in range(rng.integers(1, 5)):
        at = int(rng.integers(0, max(1, len(data))))
        length = int(rng.choice([1, 4, 16, 200, 5000]))
        kind = rng.integers(0, 7)
        if kind == 0:
            data[at : at + 1] = bytes([rng.integers(0, 256)])
        elif kind == 1:
            data = data[:at]
        elif kind == 2:
            data[at:at] = rng.integers(0, 256, length, dtype=np.uint8).tobytes()
        elif kind == 3:
            data[at : at + length] = bytes(min(length, len(data) - at))
        elif kind == 4:
            data[at : at + 4] = bytes([255, 255, 255, 255])
        elif kind == 5:
            del data[at : at + length]
        elif kind == 6:
            other = int(rng.integers(0, max(1, len(data))))
            data[at : at + length] = data[other : other + length]
    return bytes(data)


def refusal(read):
    """What a reader says that refuses a file, in one line; None if it does not refuse it."""
    try:
        read()
    except RecordingError as error:
        return str(error)
    return None


def survives(path, data, config):
    """Whether a file loads; if it does not, by one line. It takes no longer than two seconds either way."""
    path.write_bytes(data)
    loaded = []
    began = time.perf_counter()
    said = refusal(lambda: loaded.append(kc.load_recording(path, config)))
    if said is None:
        loaded[0].health()
        later = refusal(lambda: loaded[0].sampled(0.05))
        assert later is None or "\n" not in later
    else:
        assert said.startswith(f"{path}: ")
        assert "\n" not in said
    assert time.perf_counter() - began < 2.0
    return said is None


def fuzzed(tmp_path, data, name, seeds, config=PAPER):
    """How many of so many mutations are read nevertheless."""
    path = tmp_path / name
    return sum(survives(path, mutated(data, np.random.default_rng(seed)), config) for seed in seeds)


@pytest.fixture(scope="module")
def tiny():
    return made(seconds=0.3)


@pytest.mark.parametrize("seeds", [range(200), pytest.param(range(200, 1000), marks=pytest.mark.campaign)])
def test_mutated_bags_load_or_are_refused(tmp_path, tiny, seeds):
    data = write(tmp_path / "it.bag", tiny).read_bytes()
    read = fuzzed(tmp_path, data, "mutated.bag", seeds)
    # most can be read: the mutations are not all in the first record
    assert 0.5 * len(seeds) < read < len(seeds)


@pytest.mark.parametrize("compression", ["BZ2", "LZ4"])
def test_mutated_bags_that_are_compressed_load_or_are_refused(tmp_path, whole, compression):
    assert fuzzed(tmp_path, whole(compression), "mutated.bag", range(20)) > 0


@pytest.mark.parametrize("ending", [".mcap", ".db3", ".csv", ".parquet"])
def test_other_mutated_recordings_load_or_are_refused(tmp_path, tiny, ending):
    data = write(tmp_path / f"it{ending}", tiny).read_bytes()
    assert fuzzed(tmp_path, data, f"mutated{ending}", range(100)) > 0


def test_mutated_configurations_load_or_are_refused(tmp_path):
    PAPER.save(tmp_path / "it.yaml")
    data = (tmp_path / "it.yaml").read_bytes()
    path = tmp_path / "mutated.yaml"
    read = 0
    for seed in range(300):
        path.write_bytes(mutated(data, np.random.default_rng(seed)))
        said = refusal(lambda: RecordingConfig.load(path))
        read += said is None
        if said is not None:
            assert said.startswith(f"{path}: ")
            assert "\n" not in said
    assert 0 < read < 300
