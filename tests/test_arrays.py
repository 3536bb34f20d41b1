"""NumPy archives: plain arrays are read, and nothing else."""

import io
import zipfile

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given

from knode_cosserat._files.arrays import read_arrays
from knode_cosserat._files.reading import ReadError

PLAIN = {
    "a": np.arange(6.0).reshape(2, 3),
    "b": np.asfortranarray(np.eye(3)[:, :2]),
    "text": np.array(["x", "yz"]),
    "one": np.array(3),
    "none": np.zeros((0, 4)),
}


def header(shape, content, kind="<f8"):
    """Return an array's bytes with a header that states another shape."""
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": kind, "fortran_order": False, "shape": shape})
    return file.getvalue() + content


def packed(path, content):
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("a.npy", content)
    return path


def test_arrays_are_read_as_they_were_written(tmp_path):
    for save in (np.savez, np.savez_compressed):
        save(tmp_path / "it.npz", **PLAIN)
        found = read_arrays(tmp_path / "it.npz", 10**6)
        assert set(found) == set(PLAIN)
        for name, values in PLAIN.items():
            np.testing.assert_array_equal(found[name], values)
            assert found[name].dtype == values.dtype


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\x93NUMPY\x03\x00",
        header((10**12,), bytes(80)),
        header((3,), bytes(80)),
        header((-1,), bytes(80)),
        header((1,), bytes(8), "|O"),
        header((10**30, 10**30), b""),
    ],
)
def test_arrays_that_are_no_plain_numbers_are_refused(content, tmp_path):
    with pytest.raises(ReadError) as refused:
        read_arrays(packed(tmp_path / "it.npz", content), 10**6)
    assert "\n" not in str(refused.value)


def test_an_object_is_not_unpickled(tmp_path):
    np.savez(tmp_path / "it.npz", a=np.array([{"a": 1}], dtype=object))
    with pytest.raises(ReadError, match="has objects"):
        read_arrays(tmp_path / "it.npz", 10**6)


@given(st.binary(max_size=200), st.integers(0, 600))
def test_damage_is_refused_in_one_line(tmp_path_factory, patch, at):
    path = tmp_path_factory.getbasetemp() / "it.npz"
    np.savez(path, **PLAIN)
    content = bytearray(path.read_bytes())
    content[at : at + len(patch)] = patch
    path.write_bytes(content)
    reason = ""
    try:
        read_arrays(path, 10**6)
    except ReadError as error:
        reason = str(error)
    assert "\n" not in reason
