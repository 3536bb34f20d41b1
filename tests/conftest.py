"""Every test runs with the annotated shapes of equations and solver checked at each call.

Not the public functions: they say themselves, in one line, what is wrong with their arguments.
"""

from jaxtyping import install_import_hook

EQUATIONS = ("rotation", "rods.loads", "rods.section", "rods.tendons")
SOLVER = ("solvers.boundary", "solvers.linear", "solvers.march", "solvers.space", "solvers.time")

install_import_hook([f"knode_cosserat.{name}" for name in EQUATIONS + SOLVER], "beartype.beartype")
