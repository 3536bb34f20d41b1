"""Recordings of robots: what was measured, on one clock and in the robot's frame."""

from knode_cosserat.recordings.table import RecordingError, TipRecording, load_example, load_table

__all__ = ["RecordingError", "TipRecording", "load_example", "load_table"]
