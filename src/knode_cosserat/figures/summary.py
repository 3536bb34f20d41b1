"""One figure that summarises a motion: shapes, tip, controls, errors and energies."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from knode_cosserat._arguments import check_arguments
from knode_cosserat.figures.drawing import (
    checked_view,
    curves_of,
    draw_tensions,
    draw_tips,
    one_of,
    tips_of,
)
from knode_cosserat.figures.style import PALETTE, TWO_COLUMNS, new_figure
from knode_cosserat.figures.trajectories import draw_motion
from knode_cosserat.rods.loads import PointLoad
from knode_cosserat.rods.parts import Contribution
from knode_cosserat.rods.rod import SlenderRod
from knode_cosserat.rods.wrapped import nominal_model
from knode_cosserat.rotation import rotation_matrix
from knode_cosserat.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def summary(motion: Trajectory, reference: Trajectory | None = None) -> Figure:
    """Return one page of a motion: shapes, tip, controls, errors, and a rod's energies.

    Errors are the estimated errors of positions by nodes and time steps, as far as they are known, and the
    distance of the tip from that of a reference with the same times. Energies are kinetic, elastic (linear
    law of the section) and potential (gravity), of a rod whose nodes keep their material; other systems have
    the speed of the tip in their place.

    Raises:
        ValueError: the reference has other times.
    """
    check_arguments(summary, locals())
    curves = curves_of(one_of(motion))
    time, tip, size = np.asarray(motion.time), tips_of(motion), curves[0].shape[-1]
    errors = _errors(motion, reference)
    with new_figure(TWO_COLUMNS, 6.4) as figure:
        above, below = figure.subfigures(2, 1, height_ratios=(1.7, 1.0))
        left, right = above.subfigures(1, 2, width_ratios=(1.15, 1.0), wspace=0.06)
        draw_motion(left, motion, 8, checked_view(None, size))
        column = right.subplots(size, 1, sharex=True)
        draw_tips(column, {"": (time, tip)})
        right.align_ylabels()
        controls, error, energy = below.subplots(1, 3)
        draw_tensions(controls, motion)
        _legend(controls)
        for k, (label, values) in enumerate(errors.items()):
            seen = np.where(values > 0.0, values, np.nan)
            error.plot(time, 1e3 * seen, label=label, color=PALETTE[k], marker="o" * (len(time) == 1))
        error.set(xlabel="time [s]", ylabel="error [mm]")
        if any(np.any(values > 0.0) for values in errors.values()):
            error.set_yscale("log")
        if errors:
            _legend(error)
        else:
            error.text(0.5, 0.5, "not estimated", ha="center", transform=error.transAxes)
        _mark_rows(error, motion)
        energies = energies_of(motion)
        for k, (label, values) in enumerate(energies.items()):
            energy.plot(time, values, label=label, color=PALETTE[k], marker="o" * (len(time) == 1))
        energy.set(xlabel="time [s]", ylabel="energy [J]")
        if energies:
            _legend(energy)
        elif len(time) > 1:
            speed = np.linalg.norm(np.gradient(tip, time, axis=0), axis=1)
            energy.plot(time, speed, color=PALETTE[0])
            energy.set_ylabel("speed of the tip [m/s]")
    return figure


def _legend(axes: Any) -> None:
    """Add a legend of two columns above narrow axes."""
    if axes.get_legend_handles_labels()[1]:
        place = {"loc": "lower center", "bbox_to_anchor": (0.5, 1.0)}
        axes.legend(ncols=2, columnspacing=1.0, handlelength=1.2, **place)


def _errors(motion: Trajectory, reference: Trajectory | None) -> dict[str, NDArray[np.float64]]:
    """Return the known errors (T,) in m by name."""
    named = {"by nodes": motion.position_error, "by time steps": motion.time_error}
    found = {name: np.asarray(each, dtype=float) for name, each in named.items() if each is not None}
    found = {name: each for name, each in found.items() if np.isfinite(each).any()}
    if reference is not None:
        tip, true = tips_of(motion), tips_of(reference)
        if tip.shape != true.shape or not np.allclose(motion.time, reference.time, rtol=0.0, atol=1e-9):
            raise ValueError(
                f"the reference has {len(true)} rows and the motion {len(tip)}; both must have the same times"
            )
        found["to reference"] = np.linalg.norm(tip - true, axis=1)
    return found


def _mark_rows(axes: Any, motion: Trajectory) -> None:
    """Shade rows that are not solved, or on too coarse a grid."""
    time, result = np.asarray(motion.time), np.asarray(motion.result)
    step = float(np.median(np.diff(time))) if len(time) > 1 else 1.0
    for at in time[result != 0]:
        axes.axvspan(at - step, at, color=PALETTE[1], alpha=0.15, linewidth=0)


def energies_of(motion: Trajectory) -> dict[str, NDArray[np.float64]]:
    """Return energies (T,) in J by name; none unless it is a rod whose nodes keep their material."""
    rod: Any = nominal_model(motion.system)
    fed = Contribution.arclength_rate
    if type(rod).balance is not SlenderRod.balance or any(
        type(part).arclength_rate is not fed for part in rod.parts.values()
    ):
        return {}
    layout, strains = rod.y_layout, rod.z_layout
    at = np.linspace(0.0, 1.0, np.shape(motion.y)[1])
    nodes, none = at * float(rod.length), np.zeros(rod.control_layout.size)
    ds = np.gradient(nodes)
    ds[[0, -1]] *= 0.5
    gravity = jnp.asarray(rod.gravity, dtype=float)
    bodies = [
        (round(part.at * (len(at) - 1)), part.body)
        for part in rod.parts.values()
        if isinstance(part, PointLoad) and part.body is not None
    ]

    def of_row(y: Any, z: Any) -> Any:
        p, h, q, w = (layout.get(y, name) for name in ("p", "h", "q", "w"))
        materials = jax.vmap(lambda s: jax.tree.map(jnp.asarray, rod.material(s, none)))(nodes)

        def size(K: Any, each: Any) -> Any:
            return 0.5 * jnp.einsum("ni,nij,nj->n", each, K, each)

        kinetic = 0.5 * materials.rhoA * jnp.sum(q * q, axis=-1) + size(materials.rhoJ, w)
        v, u = strains.get(z, "v") - materials.v_star, strains.get(z, "u") - materials.u_star
        elastic = size(materials.Kse, v) + size(materials.Kbt, u)
        potential = -materials.rhoA * (p @ gravity)
        sums = [jnp.sum(ds * each) for each in (kinetic, elastic, potential)]
        for node, body in bodies:
            none3 = jnp.zeros(3)
            S = none3 if body.first is None else body.first
            J = jnp.zeros((3, 3)) if body.inertia is None else body.inertia
            turning = q[node] @ jnp.cross(w[node], S) + 0.5 * w[node] @ (J @ w[node])
            sums[0] += 0.5 * body.mass * jnp.sum(q[node] ** 2) + turning
            sums[2] -= gravity @ (body.mass * p[node] + rotation_matrix(h[node]) @ S)
        return jnp.stack(sums)

    values = np.array(jax.jit(jax.vmap(of_row))(jnp.asarray(motion.y), jnp.asarray(motion.z)))
    # the potential is measured from the first row that is solved
    solved = np.flatnonzero(np.isfinite(values[:, 2]))
    values[:, 2] -= values[solved[0], 2] if len(solved) else 0.0
    named = dict(zip(("kinetic", "elastic", "gravity"), values.T, strict=True))
    return named | {"sum": values.sum(axis=1)}
