"""Parts of a robot as CAD models: ribs, spools, base, motor plate, brackets, load cells.

All dimensions follow from the robot's file. The solids need build123d, imported on first use:
`pip install 'knode-cosserat-hardware[cad]'`. No part was made or tested on a physical robot.
"""

from knode_cosserat_hardware.cad.dimensions import (
    PartDimensions,
    PartError,
    load_dimensions,
    part_dimensions,
)
from knode_cosserat_hardware.cad.materials import Item, bill_of_materials
from knode_cosserat_hardware.cad.parts import export_parts

__all__ = [
    "Item",
    "PartDimensions",
    "PartError",
    "bill_of_materials",
    "export_parts",
    "load_dimensions",
    "part_dimensions",
]
