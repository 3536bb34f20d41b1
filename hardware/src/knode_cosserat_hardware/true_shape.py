"""True shape of a simulated or emulated robot, which no real robot tells."""

from __future__ import annotations

import abc
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from knode_cosserat.estimation.outputs import BodyPoses, BodyPositions, final_output
from knode_cosserat.rods.system import System
from knode_cosserat.trajectory import Trajectory


class TrueShape(abc.ABC):
    """A robot whose true shape is known."""

    #: the simulated rod
    robot: System

    @abc.abstractmethod
    def true_state(self) -> Trajectory:
        """Return the state at this time, a trajectory of one row."""

    def tip(self) -> Float[np.ndarray, "3"]:
        """Return the true position of the tip (m)."""
        return self.positions((1.0,))[0]

    def positions(self, fractions: Sequence[float]) -> Float[np.ndarray, "M 3"]:
        """Return true positions of places along the rod (m), by their fractions of its length."""
        return final_output(self.robot, self.true_state(), BodyPositions(tuple(fractions))).reshape(-1, 3)

    def poses(self, fractions: Sequence[float]) -> Float[np.ndarray, "M 7"]:
        """Return true positions (m) and quaternions (w, x, y, z) of places along the rod."""
        return final_output(self.robot, self.true_state(), BodyPoses(tuple(fractions))).reshape(-1, 7)
