"""Command-line interface: parses arguments, calls the package and prints results.

Invalid input ends with one line on stderr and exit status 2, a failed simulation with exit status 1. Modules
with a long import time are imported inside the commands.
"""

from knode_cosserat.cli.program import app, main

# the order of the imports is the order of the commands in the help
from knode_cosserat.cli import init, robots, view, kinematics, learn, control  # noqa: F401  isort: skip
from knode_cosserat.cli import native, compare, recordings, health, sweep  # noqa: F401  isort: skip

__all__ = ["app", "main"]
