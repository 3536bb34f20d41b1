"""Solvers in time and along the rod, with their schemes and settings.

They contain no physics and use only the class `System`.
"""

from typing import TYPE_CHECKING

from knode_cosserat._lazy import make_lazy

if TYPE_CHECKING:
    from knode_cosserat.schemes.result import Result, SimulationError
    from knode_cosserat.schemes.settings import NewtonOptions, Settings
    from knode_cosserat.schemes.space import Euler, Lobatto2, Lobatto4
    from knode_cosserat.schemes.time import BDF1, BDF2, SDIRK2, BDFAlpha, Trapezoidal
    from knode_cosserat.solvers.equilibrium import equilibria, equilibrium
    from knode_cosserat.solvers.simulate import simulate
    from knode_cosserat.solvers.stepper import Stepper

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

make_lazy(
    __name__,
    {
        "knode_cosserat.solvers.equilibrium": "equilibria equilibrium",
        "knode_cosserat.schemes.result": "Result SimulationError",
        "knode_cosserat.schemes.settings": "NewtonOptions Settings",
        "knode_cosserat.solvers.simulate": "simulate",
        "knode_cosserat.schemes.space": "Euler Lobatto2 Lobatto4",
        "knode_cosserat.solvers.stepper": "Stepper",
        "knode_cosserat.schemes.time": "BDF1 BDF2 SDIRK2 BDFAlpha Trapezoidal",
    },
)
