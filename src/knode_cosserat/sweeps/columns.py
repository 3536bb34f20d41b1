"""Columns of a sweep's tables: shapes, units and meanings."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from knode_cosserat.rods.system import System
from knode_cosserat.sweeps.description import STORED, Sweep


class Column(NamedTuple):
    """Column of a table: shape of one case's value, unit, and meaning."""

    shape: tuple[int, ...]
    unit: str
    meaning: str

    def described(self) -> dict[str, Any]:
        """Return the column as plain data."""
        return {"shape": list(self.shape), "unit": self.unit, "meaning": self.meaning}


def stored_shapes(system: System, sweep: Sweep) -> dict[str, tuple[int, ...]]:
    """Return the shape of each stored quantity of one case."""
    rows, nodes = sweep.steps + 1, system.nodes
    known = {
        "tip_position": (rows, 3),
        "tip_quaternion": (rows, 4),
        "position": (rows, nodes, 3),
        "y": (rows, nodes, system.y_layout.size),
        "z": (rows, nodes, system.z_layout.size),
        "controls": (sweep.steps, system.control_size),
    }
    return {name: known[name] for name in sweep.store}


def columns_of(system: System, sweep: Sweep, units: dict[str, str]) -> dict[str, Column]:
    """Return all columns of a robot's tables; `units` are those of the varied numbers."""
    rows = sweep.steps + 1
    found = {
        "case": Column((), "", "number of the case in the sweep"),
        "robot": Column((), "", "number of the robot in the description, from 0"),
        "word": Column((), "", "number of the word of controls, from 0"),
        "seed": Column((), "", "seed of the case"),
    }
    for name, each in sweep.vary.items():
        shape = () if not isinstance(each, tuple) else np.shape(each[0])
        found[name] = Column(shape, units.get(name, ""), "varied number")
    found["result"] = Column((rows,), "", "result codes of the rows; below 0: not solved")
    found["position_error"] = Column((rows,), "m", "estimated discretisation error of positions")
    found["reason"] = Column((), "", "reason of a failed case; empty for a solved one")
    for name, shape in stored_shapes(system, sweep).items():
        found[name] = Column(shape, STORED[name][1], STORED[name][0])
    return found
