"""Emulated robots: the real firmware in simavr, with motors, load cells, tendons and the rod around it.

The emulator is built when it is first used; that needs Debian's packages of simavr and of the AVR compiler.
"""

from typing import TYPE_CHECKING

from knode_cosserat._lazy import make_lazy

if TYPE_CHECKING:
    from knode_cosserat_hardware.emulation.chip import Chip
    from knode_cosserat_hardware.emulation.motors import LoadCellParameters, MotorParameters
    from knode_cosserat_hardware.emulation.port import EmulatedPort, PseudoTerminal
    from knode_cosserat_hardware.emulation.robot import EmulatedRobot
    from knode_cosserat_hardware.emulation.toolchain import missing

__all__ = [
    "Chip",
    "EmulatedPort",
    "EmulatedRobot",
    "LoadCellParameters",
    "MotorParameters",
    "PseudoTerminal",
    "missing",
]

make_lazy(
    __name__,
    {
        "knode_cosserat_hardware.emulation.chip": "Chip",
        "knode_cosserat_hardware.emulation.motors": "LoadCellParameters MotorParameters",
        "knode_cosserat_hardware.emulation.port": "EmulatedPort PseudoTerminal",
        "knode_cosserat_hardware.emulation.robot": "EmulatedRobot",
        "knode_cosserat_hardware.emulation.toolchain": "missing",
    },
)
