"""Comparison of predictions with references: metrics, tables and figures."""
