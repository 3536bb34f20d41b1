"""Integrity of trajectory files: checksum, no data of other files, and rows that a simulation can have."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from knode_cosserat._files.limits import MORE, allowed
from knode_cosserat._files.reading import ReadError, read_bytes
from knode_cosserat.solvers.result import Result
from knode_cosserat.trajectory_system import TrajectoryFileError

if TYPE_CHECKING:
    import xarray

#: attribute with the checksum of all other contents
CHECKSUM = "checksum"
#: most bytes that the arrays of a file may take: so many times the file, and these besides. The package does
#: not compress; other programs may
EXPANSION, ALLOWANCE = 100, 100_000_000

#: first bytes of an HDF5 file
HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"
#: largest file (bytes)
LARGEST_FILE = 8 << 30
#: time (s) that HDF5 may take for a file without the checksum of its bytes; more at this speed (bytes/s)
PATIENCE, SPEED = 3.0, 2e7
#: script that reads a file in a process of its own
PROBE = Path(__file__).parent / "_files" / "hdf5_probe.py"
#: what stands before the checksum of all bytes at the end of a file. HDF5 ignores bytes after its own, and
#: drops them when another program changes the file
SEAL = b"\nknode-cosserat SHA-256 "


def seal(content: bytes) -> bytes:
    """Return the checksum of a file's bytes, as it stands at the file's end."""
    return SEAL + hashlib.sha256(content).hexdigest().encode()


def require_readable(path: Path) -> None:
    """Raise `TrajectoryFileError` if a file is not HDF5, or its bytes do not have the checksum at its end.

    The checksum is checked before HDF5 reads the file: damage of its internal lists can make HDF5 loop for
    ever. A file without the checksum (of an earlier version, or changed by another program) is read in a
    process of its own first.
    """
    try:
        content = read_bytes(path, LARGEST_FILE)
    except ReadError as error:
        raise TrajectoryFileError(f"{path}: {error}") from None
    if not content.startswith(HDF5_MAGIC):
        raise TrajectoryFileError(f"{path}: not a netCDF-4 file")
    end = content.rfind(SEAL, -len(seal(b"")))
    if end < 0:
        _require_hdf5_reads(path, len(content))
    elif seal(content[:end]) != content[end:]:
        raise TrajectoryFileError(f"{path}: truncated or damaged: its bytes do not have their checksum")


def _require_hdf5_reads(path: Path, size: int) -> None:
    """Raise `TrajectoryFileError` if HDF5 hangs or crashes on a file."""
    if not sys.executable or getattr(sys, "frozen", False):
        return  # within another program there is no interpreter to start
    # -P: the script's folder is no place of modules
    command = [sys.executable, "-P", str(PROBE), str(path)]
    with subprocess.Popen(
        [*command, str(_most_expanded(size))], stdin=subprocess.DEVNULL, stdout=subprocess.PIPE
    ) as child:
        try:
            # the time begins when the libraries are there
            assert child.stdout is not None
            child.stdout.readline()
            child.wait(PATIENCE + size / SPEED)
        except subprocess.TimeoutExpired:
            raise TrajectoryFileError(f"{path}: damaged: HDF5 hangs when it reads it") from None
        finally:
            child.kill()
    if child.returncode < 0:
        raise TrajectoryFileError(f"{path}: damaged: HDF5 crashes when it reads it")


def add_checksum(file: Any, value: str) -> None:
    """Add a checksum to a file, given by path or in memory."""
    import h5py

    with h5py.File(file, "r+") as opened:
        opened.attrs[CHECKSUM] = value


def checksum(data: xarray.Dataset) -> str:
    """Return the SHA-256 of the variables, their dimensions and all attributes, in hexadecimal."""
    digest = hashlib.sha256()

    def add(value: Any) -> None:
        array = np.asarray(value)
        if array.dtype.kind in "fiub":
            digest.update(f"{array.dtype.str}{array.shape}".encode())
            digest.update(np.ascontiguousarray(array).tobytes())
        else:
            digest.update(json.dumps([str(each) for each in array.ravel()]).encode())

    def add_attributes(attributes: Any) -> None:
        for name in sorted(attributes, key=str):
            if name != CHECKSUM:
                add(name)
                add(attributes[name])

    for name in sorted(data.variables, key=str):
        variable = data.variables[name]
        add([name, *variable.dims])
        add(variable.values)
        add_attributes(variable.attrs)
    add_attributes(data.attrs)
    return digest.hexdigest()


def require_own_data(path: Path) -> None:
    """Raise `TrajectoryFileError` if a file names data of other files, or expands far beyond its size."""
    import h5py

    expanded = 0
    with h5py.File(path, "r") as file:
        for name in file:
            link = file.get(name, getlink=True)
            if not isinstance(link, h5py.HardLink):
                raise TrajectoryFileError(f"{path}: {name!r} is a link; allowed are variables")
            each = file[name]
            if not isinstance(each, h5py.Dataset):
                raise TrajectoryFileError(f"{path}: {name!r} is a group; allowed are variables")
            if each.is_virtual or each.external:
                raise TrajectoryFileError(f"{path}: the data of {name!r} are in another file; not read")
            expanded += each.size * each.dtype.itemsize
    most = _most_expanded(path.stat().st_size)
    if expanded > most:
        raise TrajectoryFileError(
            f"{path}: its variables take {expanded / 1e9:.3g} GB; allowed are {most / 1e9:.3g} GB for a file "
            f"of this size; {MORE}"
        )


def _most_expanded(size: int) -> int:
    return allowed(EXPANSION) * size + allowed(ALLOWANCE)


def require_possible(path: Path, time: np.ndarray, numbers: dict[str, np.ndarray], y: np.ndarray) -> None:
    """Raise `TrajectoryFileError` if rows contradict each other, as those of no simulation do."""

    def refuse(reason: str) -> None:
        raise TrajectoryFileError(f"{path}: not a trajectory that a simulation wrote: {reason}")

    if not np.all(np.isfinite(time)) or np.any(np.diff(time) <= 0.0):
        refuse("its times do not increase")
    result = numbers["result"]
    unknown = np.setdiff1d(result, [int(each) for each in Result])
    if unknown.size:
        refuse(f"it has the result code {unknown[0]}")
    solved = result >= 0
    if not np.all(np.isfinite(y[solved])):
        refuse("a solved row has a state that is not finite")
    if not np.all(np.isfinite(numbers["residual"][solved])):
        refuse("a solved row has a residual that is not finite")
    if np.any(numbers["iterations"] < 0):
        refuse("a number of iterations is negative")
