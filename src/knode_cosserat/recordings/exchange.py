"""Conversion of trajectories to measurements and of measurements to files, with held tensions."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from knode_cosserat._files.writing import replacing
from knode_cosserat.recordings.config import RecordingConfig
from knode_cosserat.recordings.findings import RecordingError
from knode_cosserat.recordings.sources import HELD, MarkerSource, TensionSource
from knode_cosserat.recordings.write import BAGS, FORMATS, MocapPoses, Pulls, write_recording
from knode_cosserat.solvers.places import places_at, positions_at, quaternions_at

if TYPE_CHECKING:
    from knode_cosserat.recordings.measurements import Measurements
    from knode_cosserat.trajectory import Trajectory


def measurement_fields(trajectory: Trajectory, fractions: Sequence[float]) -> dict[str, Any]:
    """Return the fields of `Measurements` for a trajectory; see `Measurements.of`."""
    y, system = np.asarray(trajectory.y), trajectory.system
    if y.ndim == 4:
        raise ValueError("a batch of trajectories; allowed is one, such as `batch[0]`")
    held, before = np.array(trajectory.held_control), np.asarray(trajectory.control)[0]
    if "tension" in system.control_layout.names:
        held, before = (system.control_layout.get(each, "tension") for each in (held, before))
    # the last row has no following tension; without a value it would not count as complete
    held[-1] = held[-2] if len(held) > 1 else before
    along = np.array(fractions, dtype=float)
    places = places_at(along, system.nodes)
    position = np.asarray(positions_at(system, y, places, np.asarray(trajectory.z)))
    try:
        quaternion = np.asarray(quaternions_at(system, y, places))
    except AttributeError:
        # the system has no orientations
        quaternion = np.full((*position.shape[:2], 4), np.nan)
    return {
        "time": np.asarray(trajectory.time, dtype=float),
        "tension": held,
        "fractions": along,
        "position": position,
        "quaternion": quaternion,
        "measured": np.isfinite(position).all(axis=-1),
        "simulated": True,
        "source": f"simulated {type(system).__name__}",
        "initial_tension": before,
    }


def save(measurements: Measurements, path: str | Path) -> None:
    """Write measurements as a table or a bag, with tensions held from each row to the next.

    A table's titles state everything: `load_recording(path).sampled(measurements.dt)` gives the same rows.
    Beside a bag its configuration is written, with the suffix .yaml, for `load_recording(path, config)`.
    Planar positions are written as x and z. Bridged poses are not written. Bodies are named `tip` and
    `body_1`, `body_2` and so on.

    Raises:
        RecordingError: the name's ending is not .csv, .parquet, .bag, .mcap or .db3, or a file cannot be
            written.
        ImportError: a library for this format is not installed.
    """
    path = Path(path)
    if path.suffix not in FORMATS:
        raise RecordingError(f"{path}: allowed is a name that ends in {', '.join(FORMATS)}")
    it, root = measurements, "/" if path.suffix in BAGS else ""
    position = it.position
    if position.shape[-1] == 2:
        position = np.stack([position[..., 0], np.zeros(position.shape[:-1]), position[..., 1]], axis=-1)
    names = ["tip" if at == 1.0 else f"body_{k + 1}" for k, at in enumerate(it.fractions)]
    poses = {}
    for k, name in enumerate(names):
        rows = it.measured[:, k]
        oriented = bool(np.isfinite(it.quaternion[rows, k]).any())
        quaternion = it.quaternion[rows, k] if oriented else None
        poses[name] = MocapPoses(it.time[rows], position[rows, k], quaternion)
    before = it.initial_tension
    config = RecordingConfig(
        markers=tuple(
            MarkerSource(name, root + name, float(at), rotation=(1.0, 0.0, 0.0, 0.0))
            for name, at in zip(names, it.fractions, strict=True)
        ),
        tension=TensionSource(root + HELD, tuple(range(1, it.tension.shape[1] + 1)), held=True),
        simulated=it.simulated,
        description=it.source,
        initial_tension=None if before is None else tuple(before.tolist()),
    )
    pulls = Pulls(it.time, it.tension)
    if not root:
        write_recording(path, config, poses, pulls)
        return
    # the configuration takes its name last: neither file is changed if the bag cannot be written
    try:
        with replacing(path.with_suffix(".yaml")) as beside:
            config.save(beside)
            write_recording(path, config, poses, pulls)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be written: {error.strerror}") from None
