"""Recordings of robots: measured data, on one clock and in the robot's frame."""

from knode_cosserat.recordings.config import (
    BaseSource,
    CommandSource,
    MarkerSource,
    MotorSource,
    RecordingConfig,
    TableSource,
    TensionSource,
)
from knode_cosserat.recordings.estimation.estimate import estimate_parts, estimate_states
from knode_cosserat.recordings.findings import Finding, RecordingError
from knode_cosserat.recordings.load import load_example, load_recording
from knode_cosserat.recordings.measurements import Measurements
from knode_cosserat.recordings.recording import Body, Recording, Tensions

__all__ = [
    "BaseSource",
    "Body",
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
]
