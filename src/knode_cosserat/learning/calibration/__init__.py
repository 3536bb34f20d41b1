"""The physical parameters themselves, from the same trajectories."""
