"""Loading of trajectories, of a robot or of a learned model."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from knode_cosserat import trajectory
from knode_cosserat._arguments import check_arguments
from knode_cosserat.rods.system import System
from knode_cosserat.trajectory import Trajectory


def load_trajectory(
    path: str | Path, *, system: System | None = None, residuals: Iterable[type] = ()
) -> Trajectory:
    """Read a trajectory that `Trajectory.save` wrote, with its robot or model.

    Args:
        path: the file.
        system: the trajectory's system. Only needed for a system that no file can describe, such as one of a
            user's class.
        residuals: classes of a model's residual that are not in the package, as for `load_model`.

    Raises:
        TrajectoryFileError: the file cannot be read, is not a trajectory, or has invalid contents.
    """
    check_arguments(load_trajectory, locals())

    def read_model(content: bytes) -> System:
        from knode_cosserat.learning.knode import decoded_model

        return decoded_model(content, "its model", residuals=residuals)

    return trajectory.load_trajectory(path, system=system, readers={"KNODE": read_model})
