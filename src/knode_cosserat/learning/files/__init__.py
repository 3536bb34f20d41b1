"""Model files, whose loading runs no code."""
