"""Grids, schemes, settings, results and the equations of a step: data that engine and solvers share."""
