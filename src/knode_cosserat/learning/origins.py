"""Origins of models: recordings and trajectories with their hashes."""

from __future__ import annotations

from typing import Any

import numpy as np

from knode_cosserat.learning.training.checkpoint import data_hash, hashed
from knode_cosserat.recordings.measurements import Measurements
from knode_cosserat.rods.passport import Origin
from knode_cosserat.trajectory import Trajectory


def origin_of(data: Any, name: str, *, learned: bool = True, held_out_error: float | None = None) -> Origin:
    """Return the origin of a model that was learned from a trajectory, rows of a recording or an experiment.

    Args:
        data: the trajectory, `Measurements` or `Experiment`.
        name: its description, in place of which files have their names.
        learned: false if the model was only tested on it.
        held_out_error: error (m) of a prediction of it by a model that was not learned from it.
    """
    if isinstance(data, Trajectory):
        still = data.settings is not None and data.settings.time is None
        sha256, rows = data_hash(data), len(data.time)
        seconds = 0.0 if still else float(data.time[-1] - data.time[0])
    elif isinstance(data, Measurements):
        sensed = (it.values for it in data.sensors)
        arrays = data.time, data.control, data.position, data.quaternion, *sensed
        sha256, rows = hashed(*arrays), len(data.time)
        if data.files:
            name, sha256 = ("+".join(part) for part in zip(*data.files, strict=True))
        seconds = 0.0 if data.static else float(data.time[-1] - data.time[0])
    else:
        sha256, rows = hashed(data.control, data.data), len(data.data)
        seconds = 0.0 if data.static else data.dt * len(data.control)
    known = held_out_error is not None and np.isfinite(held_out_error)
    line = " ".join(name.split()) or "recording"
    return Origin(line, sha256, rows, seconds, learned, float(held_out_error) if known else None)  # type: ignore[arg-type]
