"""Files: writing whole or not at all, and reading within limits."""
