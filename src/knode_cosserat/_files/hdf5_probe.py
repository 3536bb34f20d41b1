"""Script that reads an HDF5 file in a process of its own: HDF5 can hang or crash on a damaged one.

`python hdf5_probe.py FILE BYTES` prints a line when it begins. Links and variables of more than BYTES are
left out; other errors are left to the reader of the file. It imports nothing of the package, so that it
starts fast.
"""

from __future__ import annotations

import contextlib
import sys

import h5py


def read_all(path: str, most: int) -> None:
    """Read the variables of a file, as far as they are in it, and all attributes."""
    with h5py.File(path, "r") as file:
        _read_attributes(file)
        for name in file:
            if isinstance(file.get(name, getlink=True), h5py.HardLink):
                with contextlib.suppress(Exception):
                    _read(file[name], most)


def _read(each: h5py.Dataset | h5py.Group, most: int) -> None:
    _read_attributes(each)
    if not isinstance(each, h5py.Dataset) or each.is_virtual or each.external:
        return
    if each.size * each.dtype.itemsize <= most:
        each[()]


def _read_attributes(each: h5py.Dataset | h5py.Group) -> None:
    for name in each.attrs:
        with contextlib.suppress(Exception):
            each.attrs[name]


if __name__ == "__main__":
    print("reads", flush=True)
    with contextlib.suppress(Exception):
        read_all(sys.argv[1], int(sys.argv[2]))
