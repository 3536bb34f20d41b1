"""Recordings of robots: measured data, on one clock and in the robot's frame."""

from knode_cosserat.recordings.config import RecordingConfig
from knode_cosserat.recordings.estimation.estimate import estimate_parts, estimate_states
from knode_cosserat.recordings.findings import Finding, RecordingError
from knode_cosserat.recordings.load import load_example, load_recording, proposed_config
from knode_cosserat.recordings.measurements import Measurements
from knode_cosserat.recordings.recording import Body, Recording, Tensions
from knode_cosserat.recordings.sources import (
    BaseSource,
    ColumnMap,
    CommandSource,
    MarkerSource,
    MotorSource,
    TableSource,
    TensionSource,
)

__all__ = [
    "BaseSource",
    "Body",
    "ColumnMap",
    "CommandSource",
    "Finding",
    "MarkerSource",
    "Measurements",
    "MotorSource",
    "Recording",
    "RecordingConfig",
    "RecordingError",
    "TableSource",
    "TensionSource",
    "Tensions",
    "estimate_parts",
    "estimate_states",
    "load_example",
    "load_recording",
    "proposed_config",
]
