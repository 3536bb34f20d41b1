"""CAD files of a robot's parts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from knode_cosserat_hardware.cad.assembly import make_assembly
from knode_cosserat_hardware.cad.dimensions import load_dimensions
from knode_cosserat_hardware.cad.parts import library, make_parts

#: greatest distance between the surface and its triangles (mm), and angle of neighbouring triangles (rad)
CHORD, ANGLE = 0.05, 0.2


def export_parts(robot: str | Path, folder: str | Path) -> dict[str, Path]:
    """Write the parts of a robot as STEP and STL files, and the assembled robot as a STEP file.

    Existing files of these names are replaced. Lengths in the files are in mm.

    Args:
        robot: a name of the catalog or the path of a robot file.
        folder: folder of the files; it is created if it does not exist.

    Returns:
        The files by their names, such as "rib.step".

    Raises:
        RobotFileError: there is no such robot, or its file is invalid.
        PartError: parts of this robot cannot be made.
        ImportError: build123d is not installed.
    """
    dimensions = load_dimensions(robot)
    cad = library()
    out = Path(folder)
    out.mkdir(parents=True, exist_ok=True)
    written: dict[str, Path] = {}
    for name, solid in make_parts(dimensions).items():
        written[f"{name}.step"] = _step(cad, solid, out / f"{name}.step")
        path = out / f"{name}.stl"
        if not cad.export_stl(solid, str(path), tolerance=CHORD, angular_tolerance=ANGLE):
            raise OSError(f"{path}: the STL file was not written")
        written[path.name] = path
    written["robot.step"] = _step(cad, make_assembly(dimensions), out / "robot.step")
    return written


def _step(cad: Any, solid: Any, path: Path) -> Path:
    # without its time, equal parts give equal files
    if not cad.export_step(solid, str(path), timestamp="2000-01-01T00:00:00"):
        raise OSError(f"{path}: the STEP file was not written")
    return path
