"""Description of a robot's hardware: tension limits and dimensions, from a section of its robot file.

    format: 1
    kind: tendon-robot
    parameters: …
    hardware:
      tension: {low: 0.0, high: 15.0, rate: 100.0, total: 60.0}  # N, N/s
      spool_radius: 0.01  # m

`load_robot` ignores the section: it describes the machine around the rod.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from knode_cosserat._files.yaml_text import did_you_mean, excerpt
from knode_cosserat.rods.robot_file import RobotFileError, file_mapping
from knode_cosserat_hardware.driver import HardwareError, Limits, require_number


def _length(default: float, low: float, high: float) -> Any:
    return dataclasses.field(default=default, metadata={"low": low, "high": high, "unit": "m"})


def _count(default: int, low: int, high: int) -> Any:
    return dataclasses.field(default=default, metadata={"low": low, "high": high, "unit": ""})


@dataclasses.dataclass(frozen=True)
class Dimensions:
    """Dimensions of the parts around the rod. Lengths in m; the defaults fit the paper's robot.

    Attributes:
        spool_radius: radius of the reels, at the tendon.
        spool_width: width of the reels, between their flanges.
        flange_height: height of the flanges above the tendon.
        shaft_diameter: diameter of the motors' shafts.
        rib_diameter: outer diameter of the ribs.
        rib_thickness: thickness of the ribs.
        rib_count: number of ribs, the tip's included.
        hole_diameter: diameter of the tendons' holes in the ribs.
        rod_clearance: difference of the diameters of hole and rod in the ribs.
        base_height: height of the base, from the plate to the rod's clamped end.
        base_diameter: outer diameter of the base.
        mount_diameter: diameter of the circle of the mounting holes.
        mount_hole_diameter: diameter of the mounting holes.
        mount_hole_count: number of mounting holes.
        motor_diameter: diameter of the motors (the paper's JGA25-371: 25 mm).
        marker_diameter: diameter of the motion-capture markers.

    Raises:
        HardwareError: a dimension is no number or not in its range.
    """

    spool_radius: float = _length(0.01, 0.001, 0.2)
    spool_width: float = _length(0.006, 0.001, 0.2)
    flange_height: float = _length(0.004, 0.0, 0.1)
    shaft_diameter: float = _length(0.004, 0.0005, 0.05)
    rib_diameter: float = _length(0.05, 0.002, 0.5)
    rib_thickness: float = _length(0.003, 0.0002, 0.1)
    rib_count: int = _count(4, 1, 1000)
    hole_diameter: float = _length(0.0012, 0.0001, 0.05)
    rod_clearance: float = _length(0.0001, 0.0, 0.005)
    base_height: float = _length(0.0635, 0.001, 1.0)
    base_diameter: float = _length(0.08, 0.002, 1.0)
    mount_diameter: float = _length(0.066, 0.002, 1.0)
    mount_hole_diameter: float = _length(0.0043, 0.0005, 0.05)
    mount_hole_count: int = _count(4, 1, 64)
    motor_diameter: float = _length(0.025, 0.002, 0.2)
    marker_diameter: float = _length(0.0095, 0.0005, 0.1)

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            require_number(field.name, getattr(self, field.name), field.metadata, type(field.default) is int)


@dataclasses.dataclass(frozen=True)
class HardwareDescription:
    """Description of a robot's hardware.

    Attributes:
        tension: limits of commanded tensions (N, N/s).
        dimensions: dimensions of parts (m).
    """

    tension: Limits = dataclasses.field(default_factory=Limits)
    dimensions: Dimensions = dataclasses.field(default_factory=Dimensions)


def load_hardware(name_or_path: str | Path) -> HardwareDescription:
    """Return the hardware of a robot: the section `hardware` of its file; the defaults without a section.

    Args:
        name_or_path: a name of the catalog or a path of a robot file, as for `load_robot`.

    Raises:
        RobotFileError: there is no such file, or a key or value of the section is not allowed.
    """
    return _described(file_mapping(name_or_path).get("hardware"), str(name_or_path))


def _described(section: Any, source: str) -> HardwareDescription:
    if section is None:
        return HardwareDescription()
    if not isinstance(section, dict):
        raise RobotFileError(
            f"{source}: hardware is {excerpt(section)}; allowed is a mapping from names to values"
        )
    dimensions = {field.name for field in dataclasses.fields(Dimensions)}
    _require_known(section, ["tension", *sorted(dimensions)], f"{source}: hardware")
    tension = {} if section.get("tension") is None else section["tension"]
    if not isinstance(tension, dict):
        raise RobotFileError(
            f"{source}: hardware.tension is {excerpt(tension)}; allowed is low, high, rate, total"
        )
    _require_known(
        tension, [field.name for field in dataclasses.fields(Limits)], f"{source}: hardware.tension"
    )
    try:
        limits = Limits(**tension)
    except HardwareError as error:
        raise RobotFileError(f"{source}: hardware.tension: {error}") from None
    try:
        made = Dimensions(**{name: value for name, value in section.items() if name in dimensions})
    except HardwareError as error:
        raise RobotFileError(f"{source}: hardware: {error}") from None
    return HardwareDescription(limits, made)


def _require_known(mapping: dict[Any, Any], known: Iterable[str], where: str) -> None:
    names = list(known)
    for key in mapping:
        if key not in names:
            raise RobotFileError(
                f"{where}: the key {excerpt(key)} is unknown; allowed is {', '.join(names)}"
                f"{did_you_mean(key, names)}"
            )
