"""Commands of the program `knode-cosserat` for robots: robot, robot-parts.

The entry points of this distribution name them. Modules with a long import time are imported inside the
commands.
"""

from knode_cosserat_hardware.cli.options import commands
from knode_cosserat_hardware.cli.parts import parts_command

# the order of the imports is the order of the commands in the help
from knode_cosserat_hardware.cli import maintenance, motion  # noqa: F401  isort: skip

__all__ = ["commands", "parts_command"]
