"""Solvers in time and along the rod. They contain no physics and use only the class `System`."""
