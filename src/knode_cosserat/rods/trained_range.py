"""Range of controls, strains and strain rates in the recordings used to train or identify a model.

Outside of it the model extrapolates: `simulate` marks such rows (`Trajectory.extrapolated`).
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, ClassVar, Self

import jax
import numpy as np
from jaxtyping import Bool, Float

from knode_cosserat.rods.kept import kept
from knode_cosserat.rods.layout import Layout
from knode_cosserat.rods.parameters import ParameterError, parameter
from knode_cosserat.rods.parts import Part
from knode_cosserat.rods.system import System, array_module

#: tolerance beyond a range, as a part of the largest range in its field. A mostly planar bend is then inside
#: in spite of a trace of bending in the other plane. A model's own motion under the controls of its training
#: data is inside too; its rates differ from the data by some percent
MARGIN = 0.1
#: relative tolerance for constant values, which have rounding errors only
ROUNDING = 1e-9
_LARGEST = 1e30


def _bound(meaning: str, default: Any = None) -> Any:
    return parameter("", meaning, shape="list", low=-_LARGEST, high=_LARGEST, default=default)


class TrainedRange(Part):
    """Smallest and largest controls, strains and strain rates in the training data, over all nodes."""

    kind: ClassVar[str] = "trained-range"

    strain_low: Any = _bound("smallest strains, in the order of z")
    strain_high: Any = _bound("largest strains, in the order of z")
    rate_low: Any = _bound("smallest strain rates, in the order of z (1/s)")
    rate_high: Any = _bound("largest strain rates, in the order of z (1/s)")
    control_low: Any = _bound("smallest controls")
    control_high: Any = _bound("largest controls")

    def __check_init__(self) -> None:
        for what in ("strain", "rate", "control"):
            low, high = getattr(self, f"{what}_low"), getattr(self, f"{what}_high")
            if np.shape(low) != np.shape(high) or (what != "control" and low is None):
                raise ParameterError(
                    f"{what}_low has shape {np.shape(low)} and {what}_high {np.shape(high)}; allowed is one "
                    "number for each component in both"
                )
            if low is not None and not isinstance(low, jax.core.Tracer) and np.any(low > high):
                raise ParameterError(f"{what}_low is above {what}_high: {low.tolist()}, {high.tolist()}")

    @classmethod
    def of(cls, trajectories: Iterable[Any]) -> Self | None:
        """Return the range of solved rows of trajectories; None if there are none.

        The control of a first row is ignored: it acted before the motion.
        """
        strains, rates, controls = [], [], []
        for trajectory in trajectories:
            z, solved = np.asarray(trajectory.z, dtype=float), np.asarray(trajectory.result) >= 0
            z = np.where(solved[:, None, None], z, np.nan)
            moving = slice(1 if len(z) > 1 else 0, None)
            strains.append(z.reshape(-1, z.shape[-1]))
            rates.append(np.asarray(_rates(trajectory.time, z)).reshape(-1, z.shape[-1]))
            controls.append(np.where(solved[:, None], trajectory.control, np.nan)[moving])
        ends = [_ends(np.concatenate(rows)) for rows in (strains, rates, controls) if rows]
        if len(ends) < 3 or not all(np.all(np.isfinite(end)) for end in ends):
            return None
        return cls(*ends[0], *ends[1], *(ends[2] if ends[2].shape[1] else (None, None)))

    def outside(
        self,
        system: System,
        time: Float[Any, " T"],
        control: Float[Any, "*batch T c"],
        z: Float[Any, "*batch T N z"],
    ) -> Bool[Any, "*batch T"]:
        """Return True for rows of a motion outside the range; the first control of several is ignored."""
        numeric = array_module((time, control, z))
        strain = system.z_layout
        beyond = _beyond(strain, z, self.strain_low, self.strain_high)
        beyond |= _beyond(strain, _rates(time, z), self.rate_low, self.rate_high)
        outside = numeric.any(beyond, axis=(-2, -1))
        if self.control_low is not None:
            driven = control[..., None, :]
            acted = _beyond(system.control_layout, driven, self.control_low, self.control_high)
            before = np.arange(np.shape(z)[-3]) == 0 if np.shape(z)[-3] > 1 else np.zeros(1, bool)
            outside |= numeric.any(acted, axis=(-2, -1)) & ~before
        return outside


def trained_range(system: Any) -> TrainedRange | None:
    """Return the range of a learned or identified model, or of its nominal model; None without one."""
    while system is not None:
        stated: TrainedRange | None = getattr(system, "trained", None)
        if stated is not None:
            return stated
        system = getattr(system, "knowledge", None)
    return None


def _rates(time: Any, z: Any) -> Any:
    """Return the rates of change since the previous row (…, T, N, z); zero in the first row."""
    numeric = array_module((time, z))
    steps = numeric.diff(numeric.asarray(time, dtype=float))[:, None, None]
    first = numeric.zeros_like(z[..., :1, :, :])
    return numeric.concatenate([first, numeric.diff(z, axis=-3) / steps], axis=-3)


def _ends(values: np.ndarray) -> np.ndarray:
    """Return the smallest and largest of each column (2, n) over rows without NaN; NaN without such rows."""
    known = values[np.all(np.isfinite(values), axis=1)]
    if not len(known):
        return np.full((2, values.shape[1]), np.nan)
    return np.stack([known.min(axis=0), known.max(axis=0)])


def _beyond(layout: Layout, values: Any, low: Any, high: Any) -> Any:
    """Return True for numbers (…, T, N, n) outside their range; bounds are (…, n)."""
    # batches of robots have leading axes in the bounds: the axes of rows and nodes are inserted
    low, high = (bound[..., None, None, :] for bound in (low, high))
    widths = [
        (layout.get(high - low, field.name).max(axis=-1, keepdims=True), field.size)
        for field in layout.fields
    ]
    numeric = array_module((values, low))
    width = numeric.concatenate([numeric.repeat(width, size, axis=-1) for width, size in widths], axis=-1)
    slack = MARGIN * width + ROUNDING * numeric.maximum(numeric.abs(low), numeric.abs(high))
    return (values < low - slack) | (values > high + slack)


def without_range(tree: Any) -> Any:
    """Return a system, or any tree of systems, without ranges, as the solvers' programs expect.

    For the same system it is the same one, with arrays of its own.
    """
    return _bare_system(tree) if isinstance(tree, System) else _bare(tree)


@kept
def _bare_system(system: System) -> System:
    bare: System = jax.tree.map(
        lambda leaf: leaf.copy() if isinstance(leaf, np.ndarray) else leaf, _bare(system)
    )
    return bare


def _bare(tree: Any) -> Any:
    def is_range(node: Any) -> bool:
        return isinstance(node, TrainedRange)

    return jax.tree.map(lambda node: None if is_range(node) else node, tree, is_leaf=is_range)
