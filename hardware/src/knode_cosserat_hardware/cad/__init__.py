"""Parts of a robot as CAD models: ribs, spools, base, motor plate, brackets, load cells.

All dimensions follow from the robot's file. The solids need build123d, imported on first use:
`pip install 'knode-cosserat-hardware[cad]'`. No part was made or tested on a physical robot.
"""

from typing import TYPE_CHECKING

from knode_cosserat._lazy import make_lazy

if TYPE_CHECKING:
    from knode_cosserat_hardware.cad.dimensions import PartDimensions, load_dimensions, part_dimensions
    from knode_cosserat_hardware.cad.export import export_parts
    from knode_cosserat_hardware.cad.materials import Item, bill_of_materials
    from knode_cosserat_hardware.cad.shapes import PartError

__all__ = [
    "Item",
    "PartDimensions",
    "PartError",
    "bill_of_materials",
    "export_parts",
    "load_dimensions",
    "part_dimensions",
]

make_lazy(
    __name__,
    {
        "knode_cosserat_hardware.cad.dimensions": "PartDimensions load_dimensions part_dimensions",
        "knode_cosserat_hardware.cad.export": "export_parts",
        "knode_cosserat_hardware.cad.materials": "Item bill_of_materials",
        "knode_cosserat_hardware.cad.shapes": "PartError",
    },
)
