"""Vibration about an equilibrium: natural frequencies, damping and mode shapes."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float

from knode_cosserat._arguments import check_arguments
from knode_cosserat.rods.strands import of_rods
from knode_cosserat.statics.dynamics import RESOLVED, displacements, linearised_modes, normalise
from knode_cosserat.statics.stability import checked_equilibrium
from knode_cosserat.trajectory import Trajectory

#: part by which eigenvalues of one motion in two planes differ at most; their shapes are made orthogonal
SAME = 1e-6


@dataclasses.dataclass(frozen=True)
class Modes:
    """Modes of small motions e^{λt} about an equilibrium, the lowest |λ| first; `print` shows a table.

    Attributes:
        values: λ (m,) in 1/s, growth rate and angular frequency; of a pair, the one of positive frequency.
        error: part by which λ may be wrong (m,): the difference between grids of 21 and 41 nodes (or 11 and
            21), of which the scheme of order 4 leaves a fifteenth.
        shapes: displacements of the nodes in each mode (m, nodes, 3), or (m, nodes, rods, 3), with maximum 1.
        position: positions of the nodes in the equilibrium (nodes, 3), or (nodes, rods, 3), in m.
    """

    values: Float[np.ndarray, " m"]
    error: Float[np.ndarray, " m"]
    shapes: Float[np.ndarray, "m nodes *rods 3"]
    position: Float[np.ndarray, "nodes *rods 3"]

    @property
    def frequency(self) -> Float[np.ndarray, " m"]:
        """Frequencies (Hz); 0 for motions without oscillation."""
        return self.values.imag / (2.0 * np.pi)

    @property
    def damping(self) -> Float[np.ndarray, " m"]:
        """Damping ratios -Re λ / |λ|: 0 without damping, 1 without oscillation, negative if it grows."""
        size = np.abs(self.values)
        return -self.values.real / np.where(size > 0.0, size, 1.0)

    def __repr__(self) -> str:
        rows = zip(self.frequency, self.damping, self.values.real, self.error, strict=True)
        form = "{:4}  {:13.6g}  {:13.4g}  {:16.5g}  {:14.1g}".format
        lines = [form(k, *row) for k, row in enumerate(rows, 1)]
        return "\n".join(["mode  frequency, Hz  damping ratio  growth rate, 1/s  relative error", *lines])


def modes(equilibrium: Trajectory, row: int = -1, count: int = 10) -> Modes:
    """Return the modes of vibration of a robot about an equilibrium, with its damping, ends and loads.

    The motion is linearised exactly, so gyroscopic and follower loads are in it, and no time step is. A round
    rod has each bending mode twice, in two planes.

    Args:
        equilibrium: result of `kc.equilibrium` for one robot, or a trajectory that has come to rest, such as
            `kc.simulate` of a rod with two free ends.
        row: index of the row.
        count: most modes; those that two grids do not agree on, and motions of the whole robot, are left out.

    Raises:
        ValueError: the row is no equilibrium, the motion has no linearisation (friction), it is too large for
            this method, or count is not positive.
    """
    check_arguments(modes, locals())
    if count < 1:
        raise ValueError(f"count is {count}; allowed is 1 or more")
    system, y, _, control = checked_equilibrium(equilibrium, row)
    found = linearised_modes(system, y, control)
    apart = np.abs(found.values - found.coarse)
    # not motions of the whole robot: double eigenvalues of zero, known to the square root of rounding only
    sizes = np.abs(found.values)
    moves = sizes > np.sqrt(np.finfo(float).eps) * np.max(sizes, initial=0.0)
    agreed = np.flatnonzero(moves & (apart <= RESOLVED * sizes))
    slowest = agreed[np.argsort(sizes[agreed], kind="stable")][:count]
    values, error = found.values[slowest], apart[slowest] / sizes[slowest] / 15.0
    shapes = list[np.ndarray]()
    for value, motion in zip(values, found.motions[slowest], strict=True):
        shape = displacements(system, motion)
        for same in np.flatnonzero(np.abs(values[: len(shapes)] - value) < SAME * abs(value)):
            other = shapes[same].reshape(shape.shape)
            shape = shape - other * np.vdot(other, shape) / np.vdot(other, other)
        shapes.append(normalise(shape))
    p = of_rods(system, y, "p")
    return Modes(values, error, np.stack(shapes), p[:, 0] if p.shape[1] == 1 else p)
