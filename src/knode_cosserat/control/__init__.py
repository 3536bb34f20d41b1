"""Static tasks of a robot: inverse kinematics, workspace, stability, compliance, equilibrium paths."""
