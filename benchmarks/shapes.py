"""Initial states of a rod at rest in a given shape."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from knode_cosserat.rods.rod import SlenderRod
from knode_cosserat.trajectory import Trajectory


def resting(
    system: SlenderRod,
    p: Float[np.ndarray, "nodes 3"],
    h: Float[np.ndarray, "nodes 4"],
    v: Float[np.ndarray, "nodes 3"],
    u: Float[np.ndarray, "nodes 3"],
) -> Trajectory:
    """Return a trajectory of one row, for the `initial` of a simulation or of an equilibrium.

    Args:
        system: the rod, whose material law gives n and m; its sections are taken to be all alike.
        p: positions of the nodes (m).
        h: their orientations, quaternions with the scalar first.
        v: rates of p along s, material frame.
        u: curvatures (1/m), material frame.
    """
    frames = Rotation.from_quat(h, scalar_first=True)
    n = frames.apply((v - np.asarray(system.v_star)) @ np.asarray(system.Kse).T)
    m = frames.apply(u @ np.asarray(system.Kbt).T)
    y = np.concatenate([p, h, n, m, np.zeros((len(p), 6))], axis=1)
    z = np.concatenate([v, u], axis=1)
    row, none = np.zeros(1), np.zeros((1, system.control_layout.size))
    count = row.astype(int)
    return Trajectory(system, None, row, y[None], z[None], none, count, row, count)
