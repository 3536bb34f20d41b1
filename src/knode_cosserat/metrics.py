"""Metrics that compare a prediction with a reference."""

from knode_cosserat.evaluation.metrics import (
    dtw_distance,
    node_error,
    pose_mse,
    rotation_rmse,
    tip_dtw,
    tip_rmse,
)
from knode_cosserat.evaluation.state_errors import StateError, state_errors

__all__ = [
    "StateError", "dtw_distance", "node_error", "pose_mse", "rotation_rmse", "state_errors", "tip_dtw",
    "tip_rmse",
]  # fmt: skip
