"""Calibration of physical parameters from measured trajectories."""

from knode_cosserat.learning.calibration.calibrate import Calibration, CalibrationError, calibrate

__all__ = ["Calibration", "CalibrationError", "calibrate"]
