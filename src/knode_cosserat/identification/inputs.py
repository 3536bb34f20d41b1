"""Input of an identification: recordings, their rows, or trajectories."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from knode_cosserat.identification.misfit import RecordingData
from knode_cosserat.recordings.measurements import Measurements
from knode_cosserat.recordings.recording import Recording
from knode_cosserat.solvers.segments import DataError
from knode_cosserat.trajectory import Trajectory

#: time from row to row of recordings (s)
DT = 0.0125


def measurements_of(recordings: Any) -> list[Measurements]:
    """Return the rows of recordings, with mean tensions; `DataError` for anything else."""
    if isinstance(recordings, str | Recording | Measurements) or not isinstance(recordings, Sequence):
        raise DataError(f"recordings is a {type(recordings).__name__}; allowed is a list of them")
    if not recordings:
        raise DataError("there are no recordings")
    found = []
    for each in recordings:
        if isinstance(each, Recording):
            each = each.sampled(DT, mean=True)
        if not isinstance(each, Measurements):
            raise DataError(
                f"recordings holds a {type(each).__name__}; allowed is what load_recording returns, its "
                "sampled(0.0125, mean=True), or, for kc.fit, a Trajectory"
            )
        found.append(each)
    steps = {each.dt for each in found}
    if max(steps) - min(steps) > 1e-9:
        raise DataError(
            f"time steps differ: {', '.join(f'{dt:g}' for dt in sorted(steps))} s; allowed is one"
        )
    return found


def names_of(given: Sequence[Measurements]) -> list[str]:
    """Return a name for each recording: how its source begins, numbered where several begin alike."""
    names = [each.source.partition(":")[0].rpartition("/")[2] for each in given]
    return [f"{name} ({k + 1})" if names.count(name) > 1 else name for k, name in enumerate(names)]


def padded(data: Sequence[RecordingData]) -> list[RecordingData]:
    """Return recordings of one length, the last tension held and nothing measured: one compiled program."""
    longest = max(len(each.tension) for each in data)
    found = []
    for each in data:
        more = longest - len(each.tension)
        found.append(
            each._replace(
                tension=np.concatenate([each.tension, np.repeat(each.tension[-1:], more, axis=0)]),
                position=np.pad(each.position, ((0, more), (0, 0), (0, 0)), constant_values=np.nan),
                rotation=np.pad(each.rotation, ((0, more), (0, 0), (0, 0)), constant_values=np.nan),
            )
        )
    return found


def poses_of_nodes(trajectory: Trajectory, name: str) -> Measurements:
    """Return the poses of a trajectory's nodes as if they had been measured, with its controls as tensions.

    Raises:
        DataError: it has positions or orientations of no one robot.
    """
    if np.ndim(trajectory.y) != 3:
        raise DataError(f"{name} is a batch; allowed is one robot's trajectory")
    position, quaternion = np.asarray(trajectory.position), np.asarray(trajectory.quaternion)
    control = np.asarray(trajectory.control)
    # a trajectory has with each row the control that led to it
    held = np.concatenate([control[1:], control[-1:]])
    nodes, seen = position.shape[1], np.ones((len(position), position.shape[1] - 1), dtype=bool)
    return Measurements(
        time=np.asarray(trajectory.time), tension=held, fractions=np.arange(1, nodes) / (nodes - 1),
        position=position[:, 1:], quaternion=quaternion[:, 1:], measured=seen,
        simulated=True, source=name, initial_tension=control[0],
    )  # fmt: skip
