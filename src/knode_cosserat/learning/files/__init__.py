"""Models in files whose loading runs no code."""
