"""Recordings of robots: measured data, on one clock and in the robot's frame."""

from typing import Any

from knode_cosserat._registry import provide
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


# these modules import SciPy's optimisation and tables: only when they are needed


def _health(recording: Recording) -> Any:
    from knode_cosserat.recordings.health import health_of

    return health_of(recording)


def _measured(*args: Any) -> Any:
    from knode_cosserat.recordings.exchange import measurement_fields

    return measurement_fields(*args)


def _save(*args: Any) -> None:
    from knode_cosserat.recordings.exchange import save

    save(*args)


provide(Recording, "health", _health)
provide(Measurements, "of", _measured)
provide(Measurements, "save", _save)
