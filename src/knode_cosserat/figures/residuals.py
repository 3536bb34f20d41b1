"""Figures of a model's learned residual; they need matplotlib, the extra `viz`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from knode_cosserat._arguments import check_arguments
from knode_cosserat.figures.style import PALETTE, TWO_COLUMNS, new_figure
from knode_cosserat.rods.layout import Field
from knode_cosserat.rods.system import System
from knode_cosserat.schemes import semi_discrete
from knode_cosserat.solvers.segments import Samples, samples, start_point
from knode_cosserat.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from knode_cosserat.learning.knode import KNODE


def residual(model: KNODE, trajectory: Trajectory) -> Figure:
    """Return a figure of the residual's contribution to strains and load balances along a trajectory.

    There is one panel for each field of z, and for each field of y whose rate balances a load (all fields if
    the system states none). It shows over time the maximum along the rod of the nominal model and of the
    residual.

    Raises:
        DataError: the trajectory does not fit the model.
    """
    check_arguments(residual, locals())
    data = samples(model.knowledge, [trajectory]).segments
    used = np.unique(data.origin[:, 1])
    time = np.asarray(trajectory.time)[used]
    nominal, corrected = (
        [np.asarray(part).reshape(len(used), -1, part.shape[-1]) for part in _derivatives(system, data)]
        for system in (model.knowledge, model)
    )
    y_layout, z_layout = model.y_layout, model.z_layout
    stated = [field for field in y_layout.fields if field.load] or list(y_layout.fields)
    rows: list[tuple[Field, int, str]] = [
        *((field, 1, f"{field.name} [{field.unit}]") for field in z_layout.fields),
        *((field, 0, f"{field.name}_s [{field.load or field.unit + '/m'}]") for field in stated),
    ]
    with new_figure(TWO_COLUMNS, 0.8 + 1.1 * len(rows)) as figure:
        axes = figure.subplots(len(rows), 1, sharex=True, squeeze=False)[:, 0]
        for axis, (field, part, label) in zip(axes, rows, strict=True):
            layout = (y_layout, z_layout)[part]
            own, whole = (layout.get(parts[part], field.name) for parts in (nominal, corrected))
            for values, colour, name in ((own, "0.6", "nominal model"), (whole - own, PALETTE[0], "added")):
                size = np.linalg.norm(values, axis=-1).max(axis=1)
                axis.plot(time, size, color=colour, label=name)
            axis.set_ylabel(label)
            # the axis begins below zero, so that a zero residual is visible
            axis.set_ylim(bottom=-0.04 * axis.get_ylim()[1])
        axes[-1].set_xlabel("time [s]")
        axes[0].legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2)
        axes[0].set_title("Largest along the rod", loc="left")
    return figure


@jax.jit
def _derivatives(system: System, data: Samples) -> Any:
    """Return y_s and z at every segment's start."""
    return jax.vmap(lambda sample: semi_discrete.derivatives(system, start_point(system, sample)))(data)
