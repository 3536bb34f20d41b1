"""Load cells: corrections of measured tensions by a gain and an offset."""

from __future__ import annotations

from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.parameters import parameter
from knode_cosserat.rods.parts import Part
from knode_cosserat.rods.wrapped import nominal_model


class LoadCells(Part):
    """Correction of measured tensions: true tension = gain * measured + offset, for each tendon.

    A tendon only pulls: a negative result is set to zero. `simulate` ignores the latency and applies the
    controls without a delay; `undelayed` corrects a recording for it.
    """

    kind: ClassVar[str] = "load-cells"

    gain: Any = parameter(
        "", "true over measured tension, one for each tendon", shape="list", low=1e-3, high=1e3,
        default=(1.0, 1.0, 1.0, 1.0),
    )  # fmt: skip
    offset: Any = parameter(
        "N", "true tension where none is measured, one for each tendon", shape="list", low=-1e3, high=1e3,
        default=(0.0, 0.0, 0.0, 0.0),
    )  # fmt: skip

    latency: Any = parameter(
        "s", "delay of the readings behind the poses of a recording", low=-10.0, high=10.0, default=0.0
    )

    def undelayed(
        self, measured: Float[np.ndarray, "T c"], dt: float, before: Float[np.ndarray, " c"] | None = None
    ) -> Float[np.ndarray, "T c"]:
        """Return the readings (N) at the times of the poses: each row's reading from `latency` later.

        Rows are means over steps of `dt` (s), with linear interpolation between them. The last row holds
        beyond the end. Before the first row the value is `before`, or by default the first row.
        """
        first = measured[0] if before is None else before
        rows = np.concatenate([[first], measured, measured[-1:]])
        at = np.clip(np.arange(1, len(measured) + 1) + float(self.latency) / dt, 0, len(measured) + 1)
        low = np.minimum(at.astype(int), len(measured))
        part = (at - low)[:, None]
        return np.asarray((1.0 - part) * rows[low] + part * rows[low + 1])

    def tension(self, measured: Float[Any, " c"]) -> Float[Any, " c"]:
        """Return true tensions (N)."""
        return jnp.maximum(self.gain * measured + self.offset, 0.0)


def undelayed(
    system: Any, measured: Float[np.ndarray, "T c"], dt: float, before: Float[np.ndarray, " c"] | None = None
) -> Float[np.ndarray, "T c"]:
    """Return the controls that acted on a system, from measured ones that are held for `dt` (s) each.

    They are equal unless the robot's load cells have a delay. `before` acted before the first row.
    """
    cells = getattr(nominal_model(system), "load_cells", None)
    return measured if cells is None else cells.undelayed(measured, dt, before)
