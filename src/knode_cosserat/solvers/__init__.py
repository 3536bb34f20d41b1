"""Solvers in time and along the rod, their schemes and settings.

They contain no physics and use only the class `System`.
"""

from typing import TYPE_CHECKING

from knode_cosserat._lazy import make_lazy

if TYPE_CHECKING:
    from knode_cosserat.solvers.equilibrium import equilibria, equilibrium
    from knode_cosserat.solvers.result import Result, SimulationError
    from knode_cosserat.solvers.settings import NewtonOptions, Settings
    from knode_cosserat.solvers.simulate import simulate
    from knode_cosserat.solvers.space import Euler, Lobatto2, Lobatto4
    from knode_cosserat.solvers.stepper import Stepper
    from knode_cosserat.solvers.time import BDF1, BDF2, SDIRK2, BDFAlpha, Trapezoidal

__all__ = [
    "BDF1",
    "BDF2",
    "SDIRK2",
    "BDFAlpha",
    "Euler",
    "Lobatto2",
    "Lobatto4",
    "NewtonOptions",
    "Result",
    "Settings",
    "SimulationError",
    "Stepper",
    "Trapezoidal",
    "equilibria",
    "equilibrium",
    "simulate",
]

# a trajectory, which `simulate` returns, needs the result codes of this package
make_lazy(
    __name__,
    {
        "knode_cosserat.solvers.equilibrium": "equilibria equilibrium",
        "knode_cosserat.solvers.result": "Result SimulationError",
        "knode_cosserat.solvers.settings": "NewtonOptions Settings",
        "knode_cosserat.solvers.simulate": "simulate",
        "knode_cosserat.solvers.space": "Euler Lobatto2 Lobatto4",
        "knode_cosserat.solvers.stepper": "Stepper",
        "knode_cosserat.solvers.time": "BDF1 BDF2 SDIRK2 BDFAlpha Trapezoidal",
    },
)
