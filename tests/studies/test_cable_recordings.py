"""Motions of cables: pickles without code, folders and archives, orders of axes, and one-line errors."""

import codecs
import contextlib
import io
import os
import pickle
import pickletools
import struct

import numpy as np
import pytest

from knode_cosserat.recordings import RecordingError
from studies.cables.pickles import read_pickled_array
from studies.cables.recordings import as_markers, load_cables

MARKERS = np.random.default_rng(0).normal(size=(20, 7, 3))


def written(path, content, protocol=4):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(pickle.dumps(content, protocol=protocol))
    return path


@pytest.mark.parametrize("protocol", range(6))
@pytest.mark.parametrize("kind", ["<f4", "<f8", ">f8", "<i4"])
def test_arrays_and_lists_of_arrays_of_all_protocols(tmp_path, protocol, kind):
    array = (100.0 * MARKERS).astype(kind)
    for content in (array, list(array), tuple(array), array.tolist(), np.asfortranarray(array), [array]):
        found = read_pickled_array(written(tmp_path / "x.pkl", content, protocol))
        np.testing.assert_array_equal(found.reshape(array.shape), array)


def test_old_and_new_names_of_numpy(tmp_path):
    data = pickle.dumps(MARKERS, protocol=2)
    for old, new in ((b"numpy._core", b"numpy.core"), (b"numpy.core", b"numpy._core")):
        (tmp_path / "x.pkl").write_bytes(data.replace(old, new))
        np.testing.assert_array_equal(read_pickled_array(tmp_path / "x.pkl"), MARKERS)


class Evil:
    """An object whose pickle calls a function."""

    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


HOLED = MARKERS.copy()
HOLED[3, 2, 1] = np.nan
RECORDS = np.zeros(3, dtype=[("a", "f8")])


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (Evil(os.system, "touch evil"), "system"),
        (Evil(eval, "1"), "eval"),
        (Evil(codecs.encode, "x", "rot13"), "bytes"),
        ([MARKERS, Evil(os.mkdir, "evil")], "mkdir"),
        (np.array([object()]), "format"),
        (np.array(["text"]), "format"),
        (RECORDS, "format"),
        (np.float64(1.0), "scalar"),
        (np.ma.masked_array(MARKERS), "name"),
        ({"x": MARKERS}, "dict"),
        ("text", "str"),
        ([True], "bool"),
        (None, "nonetype"),
    ],
)
@pytest.mark.parametrize("protocol", [0, 2, 4, 5])
def test_anything_but_numbers_is_refused_in_one_line(tmp_path, monkeypatch, content, reason, protocol):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(RecordingError, match=reason) as error:
        read_pickled_array(written(tmp_path / "x.pkl", content, protocol))
    assert "\n" not in str(error.value) and "x.pkl" in str(error.value)
    assert not (tmp_path / "evil").exists()


def with_memory_request():
    return pickle.PROTO + b"\x02N" + pickle.LONG_BINPUT + struct.pack("<I", 0xFFFFFFFF) + b"."


def nested():
    content = [1.0]
    for _ in range(40):
        content = [content] * 10
    return pickle.dumps(content)


def itself():
    content = []
    content.append(content)
    return pickle.dumps(content)


def with_a_shape(shape):
    """The pickle of an array whose shape was changed to one that its bytes do not fill."""
    file = io.BytesIO()
    pickler = pickle._Pickler(file, protocol=2)
    state = MARKERS.__reduce__()
    altered = (state[0], state[1], (1, shape, *state[2][2:]))
    pickler.save_reduce(*altered, obj=MARKERS)
    file.write(b".")
    return pickle.PROTO + b"\x02" + file.getvalue()


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\x80\x04",
        b"junk",
        with_memory_request(),
        nested(),
        itself(),
        pickle.dumps(MARKERS)[:-40],
        pickle.dumps(MARKERS)[:100],
        with_a_shape((10**9, 10**9)),
        with_a_shape((-1, 3)),
        with_a_shape((7,)),
    ],
)
def test_damaged_and_hostile_files(tmp_path, data):
    (tmp_path / "x.pkl").write_bytes(data)
    with pytest.raises(RecordingError, match=r"x\.pkl") as error:
        read_pickled_array(tmp_path / "x.pkl")
    assert "\n" not in str(error.value)


def test_every_byte_changed_is_read_or_refused(tmp_path):
    small = pickletools.optimize(pickle.dumps([np.ones((2, 2))], protocol=2))
    path, rng = tmp_path / "x.pkl", np.random.default_rng(1)
    for place in range(len(small)):
        path.write_bytes(small[:place] + bytes([rng.integers(256)]) + small[place + 1 :])
        with contextlib.suppress(RecordingError):
            assert read_pickled_array(path).dtype == float


def test_orders_of_axes():
    for given in (
        MARKERS,
        MARKERS.swapaxes(1, 2),
        MARKERS.swapaxes(0, 1),
        MARKERS.reshape(20, 21),
        MARKERS[None],
    ):
        np.testing.assert_array_equal(as_markers(given, "x"), MARKERS)


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        (MARKERS[:, :4], "at least"),
        (MARKERS[:2], "at least"),
        (HOLED, "marker 2 has no position in frame 3"),
        (1e3 * MARKERS, "millimetres"),
        (np.zeros((4, 5)), "shape"),
        ([[1.0], [1.0, 2.0]], "numbers"),
    ],
)
def test_impossible_measurements(given, reason):
    with pytest.raises(RecordingError, match=reason):
        as_markers(given, "x")


def test_folders_and_archives(tmp_path):
    for name in ("10", "2", "1"):
        written(tmp_path / "A" / "train" / f"{name}.pkl", list(MARKERS.astype("f4")))
    written(tmp_path / "A" / "eval" / "3.pkl", MARKERS.swapaxes(1, 2))
    np.savez(tmp_path / "B.npz", train=MARKERS[None], eval=MARKERS[None], eval_names=np.array(["7.pkl"]))
    first, second = load_cables(tmp_path)
    assert [motion.name for motion in first.train] == ["1", "2", "10"]
    assert (first.name, second.name) == ("A", "B")
    assert second.held_out[0].name == "7" and second.train[0].name == "0"
    np.testing.assert_array_equal(first.held_out[0].markers, second.held_out[0].markers)
    assert [cable.name for cable in load_cables(tmp_path / "A")] == ["A"]


def test_folders_that_cannot_be_used(tmp_path):
    with pytest.raises(RecordingError, match="no such folder"):
        load_cables(tmp_path / "none")
    with pytest.raises(RecordingError, match="no cables"):
        load_cables(tmp_path)
    written(tmp_path / "A" / "eval" / "1.pkl", MARKERS)
    with pytest.raises(RecordingError, match="0 motions in train"):
        load_cables(tmp_path)
    written(tmp_path / "A" / "train" / "1.pkl", MARKERS[:, 1:])
    with pytest.raises(RecordingError, match=r"\[6, 7\] markers"):
        load_cables(tmp_path)
    (tmp_path / "A" / "train" / "1.pkl").unlink()
    (tmp_path / "A" / "eval" / "1.pkl").unlink()
    (tmp_path / "A" / "eval").rmdir()
    (tmp_path / "B.npz").write_bytes(b"junk")
    with pytest.raises(RecordingError, match=r"B\.npz"):
        load_cables(tmp_path)
    np.savez(tmp_path / "B.npz", train=np.array([None]), eval=MARKERS)
    with pytest.raises(RecordingError, match=r"B\.npz"):
        load_cables(tmp_path)
