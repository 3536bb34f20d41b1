"""Structured residual: correction terms of length, stress and loads, solved in closed form."""
