"""Steps a system in time and solves it along the rod. No physics: only the general class is seen."""
