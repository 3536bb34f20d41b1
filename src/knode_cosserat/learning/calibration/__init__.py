"""Calibration of physical parameters from trajectories."""
