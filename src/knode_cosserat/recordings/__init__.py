"""Recordings of robots: measured data, on one clock and in the robot's frame.

A file goes one way: `formats` reads it to messages or columns (`messages`, `table`), the configuration says
what these are (`config`), `streams` puts them on one clock, `checks` removes errors, `frame` turns them to
the robot's frame. The result is a `Recording`, whose `sampled` gives `Measurements` on a grid.
"""

from typing import TYPE_CHECKING

from knode_cosserat._lazy import make_lazy

__all__ = [
    "Finding",
    "Measurements",
    "Recording",
    "RecordingConfig",
    "RecordingError",
    "estimate_parts",
    "estimate_states",
    "load_example",
    "load_recording",
    "proposed_config",
]

if TYPE_CHECKING:
    from knode_cosserat.recordings.config import RecordingConfig
    from knode_cosserat.recordings.estimation.estimate import estimate_parts, estimate_states
    from knode_cosserat.recordings.findings import Finding, RecordingError
    from knode_cosserat.recordings.load import load_example, load_recording, proposed_config
    from knode_cosserat.recordings.measurements import Measurements
    from knode_cosserat.recordings.recording import Recording

make_lazy(
    __name__,
    {
        f"{__name__}.config": "RecordingConfig",
        f"{__name__}.estimation.estimate": "estimate_parts estimate_states",
        f"{__name__}.findings": "Finding RecordingError",
        f"{__name__}.load": "load_example load_recording proposed_config",
        f"{__name__}.measurements": "Measurements",
        f"{__name__}.recording": "Recording",
    },
)
