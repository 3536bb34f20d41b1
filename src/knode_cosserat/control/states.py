"""States of a closed loop as trajectories: those that an observer estimates, row by row."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from knode_cosserat.trajectory import Trajectory


def estimated(controller: Any) -> Trajectory | None:
    """Return the state that a controller's observer estimates, a trajectory of one row, or None."""
    observer = getattr(controller, "observer", None)
    if observer is None:
        return None
    estimate = observer.estimate
    one = np.zeros(1)
    return Trajectory(
        observer.robot, None, np.array([estimate.time]), np.asarray(estimate.y)[None],
        np.asarray(estimate.z)[None], np.asarray(observer.control, dtype=float)[None],
        np.zeros(1, dtype=int), one, one,
    )  # fmt: skip


def joined(states: Sequence[Trajectory], times: Sequence[float]) -> Trajectory:
    """Return a trajectory of rows of one robot, at these times (s)."""
    y, z, control, result = (
        np.concatenate([np.asarray(getattr(state, name)) for state in states])
        for name in ("y", "z", "control", "result")
    )
    errors = [
        np.full(1, np.nan) if state.position_error is None else np.asarray(state.position_error)
        for state in states
    ]
    none = np.zeros(len(times))
    return Trajectory(
        states[0].system, states[0].settings, np.array(times), y, z, control, result, none,
        none.astype(int), position_error=np.concatenate(errors),
    )  # fmt: skip
