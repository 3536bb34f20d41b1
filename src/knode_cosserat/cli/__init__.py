"""The command line: it parses, calls and prints, and knows nothing that the package does not.

Wrong input, and whatever the package says of it, ends in one line on stderr and exit status 2; a simulation
that finds no solution in status 1. Modules that take long to import are imported by the commands.
"""

from knode_cosserat.cli.program import app, main

# their commands, in the order in which the help has them
from knode_cosserat.cli import robots, view, kinematics, learn, identify  # noqa: F401  isort: skip
from knode_cosserat.cli import compare, inspect, record, study, study_measured, health  # noqa: F401  isort: skip

__all__ = ["app", "main"]
