"""Motions of cables held at both ends, from motion capture: folders in the layout of DEFORM (CoRL 2024).

A cable's folder has `train/*.pkl` and `eval/*.pkl`, one file per motion: positions of N markers in T
frames, as a NumPy array or a list of arrays. `NAME.npz` holds the same in one file, as arrays `train` and
`eval` of shape (files, T, N, 3). Markers 0, 1, N - 2 and N - 1 are on the grippers.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from knode_cosserat._files.arrays import read_arrays
from knode_cosserat._files.reading import ReadError
from knode_cosserat.recordings.findings import RecordingError
from studies.cables.pickles import LARGEST_FILE, read_pickled_array

#: smallest number of frames, and of markers: four held ones and a free one
FEWEST_FRAMES, FEWEST_MARKERS = 3, 5
#: largest coordinate (m): larger values are in another unit
FARTHEST = 100.0


class CableMotion(NamedTuple):
    """Motion of a cable: its name and the marker positions (m) in all frames."""

    name: str
    markers: Float[np.ndarray, "T N 3"]


class CableData(NamedTuple):
    """Motions of one cable: for training, and held-out."""

    name: str
    train: tuple[CableMotion, ...]
    held_out: tuple[CableMotion, ...]


def load_cables(folder: str | Path) -> list[CableData]:
    """Return the cables of a folder, in the order of their names.

    Args:
        folder: folder with `NAME/train/*.pkl` and `NAME/eval/*.pkl`, or with files `NAME.npz`; or the
            folder of one cable. No code in the files is executed (see `pickles`).

    Raises:
        RecordingError: there is no cable, or a file cannot be used; the message is one line.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise RecordingError(f"{folder}: no such folder; expected is one with NAME/train/*.pkl or NAME.npz")
    if (folder / "eval").is_dir():
        return [_from_folder(folder)]
    found = [_from_folder(each) for each in sorted(folder.iterdir()) if (each / "eval").is_dir()]
    names = {each.name for each in found}
    found += [_from_npz(each) for each in sorted(folder.glob("*.npz")) if each.stem not in names]
    if not found:
        raise RecordingError(
            f"{folder}: no cables there; expected are NAME/train/*.pkl and NAME/eval/*.pkl, or NAME.npz"
        )
    return sorted(found, key=lambda each: _in_order(each.name))


def _from_folder(folder: Path) -> CableData:
    def motions(part: str) -> tuple[CableMotion, ...]:
        paths = sorted((folder / part).glob("*.pkl"), key=lambda path: _in_order(path.name))
        return tuple(
            CableMotion(path.stem, as_markers(read_pickled_array(path), str(path))) for path in paths
        )

    return _checked(CableData(folder.resolve().name, motions("train"), motions("eval")), str(folder))


def _from_npz(path: Path) -> CableData:
    try:
        parts: dict[str, Any] = dict(read_arrays(path, 4 * LARGEST_FILE))
    except ReadError as error:
        raise RecordingError(f"{path}: {error}") from None

    def motions(part: str) -> tuple[CableMotion, ...]:
        if part not in parts or np.ndim(parts[part]) != 4:
            raise RecordingError(f"{path}: no array {part!r} of shape (files, frames, markers, 3)")
        names = parts.get(f"{part}_names")
        if names is None or names.dtype.kind != "U" or names.shape != parts[part].shape[:1]:
            names = [str(k) for k in range(len(parts[part]))]
        return tuple(
            CableMotion(str(name).removesuffix(".pkl"), as_markers(one, f"{path} {part} {name}"))
            for name, one in zip(names, parts[part], strict=True)
        )

    return _checked(CableData(path.stem, motions("train"), motions("eval")), str(path))


def _checked(cable: CableData, source: str) -> CableData:
    """Return the cable after checking that both parts have motions, all with as many markers."""
    if not cable.train or not cable.held_out:
        raise RecordingError(
            f"{source}: {len(cable.train)} motions in train, {len(cable.held_out)} in eval; both are needed"
        )
    counts = {motion.markers.shape[1] for motion in (*cable.train, *cable.held_out)}
    if len(counts) > 1:
        raise RecordingError(f"{source}: motions have {sorted(counts)} markers; all need the same number")
    return cable


def as_markers(values: Any, source: str) -> Float[np.ndarray, "T N 3"]:
    """Return positions as (frames, markers, 3), from any order of these axes.

    More frames than markers are assumed. Leading axes of length 1 and rows of 3 N numbers are accepted.

    Raises:
        RecordingError: the shape or a number is invalid; the message names `source`.
    """
    try:
        array = np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        raise RecordingError(f"{source}: not an array of numbers") from None
    shape = array.shape
    while array.ndim > 3 and array.shape[0] == 1:
        array = array[0]
    if array.ndim == 2 and array.shape[1] % 3 == 0:
        array = array.reshape(len(array), -1, 3)
    if array.ndim != 3 or 3 not in array.shape:
        raise RecordingError(f"{source}: shape {shape}; expected is (frames, markers, 3)")
    axis = 2 if array.shape[2] == 3 else int(np.flatnonzero(np.equal(array.shape, 3))[-1])
    array = np.moveaxis(array, axis, 2)
    if array.shape[0] < array.shape[1]:
        array = np.swapaxes(array, 0, 1)
    if array.shape[0] < FEWEST_FRAMES or array.shape[1] < FEWEST_MARKERS:
        raise RecordingError(
            f"{source}: {array.shape[0]} frames of {array.shape[1]} markers; "
            f"at least {FEWEST_FRAMES} of {FEWEST_MARKERS} are needed"
        )
    if not np.all(np.isfinite(array)):
        frame, marker, _ = np.argwhere(~np.isfinite(array))[0]
        raise RecordingError(f"{source}: marker {marker} has no position in frame {frame}")
    if np.max(np.abs(array)) > FARTHEST:
        far = np.max(np.abs(array))
        raise RecordingError(
            f"{source}: a position is {far:.4g} m; expected are metres. Are these millimetres?"
        )
    return np.ascontiguousarray(array)


def _in_order(name: str) -> list[tuple[int, int, str]]:
    """Return a sort key that puts `2` before `10`."""
    parts = re.split(r"(\d+)", name)
    return [(0, int(part), "") if part.isdigit() and part.isascii() else (1, 0, part) for part in parts]
