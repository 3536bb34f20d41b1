"""Simulate Cosserat-rod robots, learn what the physics misses, predict real robots.

The names that a first script needs are here; start with `load_robot`, `simulate` and `Trajectory`. All other
public names are in the namespaces `robots`, `solvers`, `learning`, `recordings`, `statics`,
`estimation`, `control`, `identification`, `metrics`, `figures`, `viewer`, `controls`, `envs`, `sweeps`,
`native` and `mujoco`.
Drivers of robots are a distribution of their own, `knode_cosserat_hardware`. Events are logged to the logger
"knode_cosserat", which is quiet unless a handler is added.
"""

import logging
from typing import TYPE_CHECKING

from knode_cosserat import _jax as _jax  # isort: split  (first: it sets JAX up)
from knode_cosserat._lazy import make_lazy

if TYPE_CHECKING:
    from knode_cosserat import (
        control,
        controls,
        envs,
        estimation,
        figures,
        identification,
        learning,
        metrics,
        mujoco,
        native,
        recordings,
        robots,
        solvers,
        statics,
        sweeps,
        viewer,
    )
    from knode_cosserat.errors import KnodeCosseratError
    from knode_cosserat.identification.fit import fit
    from knode_cosserat.identification.identify import identify
    from knode_cosserat.learning import KNODE, FitConfig, load_model
    from knode_cosserat.loading import load_trajectory
    from knode_cosserat.native import export
    from knode_cosserat.recordings import estimate_states, load_recording
    from knode_cosserat.rods.robot_file import catalog, load_robot, save_robot
    from knode_cosserat.rods.system import System
    from knode_cosserat.solvers import Result, SimulationError, equilibrium, simulate
    from knode_cosserat.statics.reach import inverse_kinematics
    from knode_cosserat.statics.workspace import workspace
    from knode_cosserat.trajectory import Trajectory, TrajectoryFileError
    from knode_cosserat.viewer import view

__all__ = [
    "KNODE",
    "FitConfig",
    "KnodeCosseratError",
    "Result",
    "SimulationError",
    "System",
    "Trajectory",
    "TrajectoryFileError",
    "catalog",
    "control",
    "controls",
    "envs",
    "equilibrium",
    "estimate_states",
    "estimation",
    "export",
    "figures",
    "fit",
    "identification",
    "identify",
    "inverse_kinematics",
    "learning",
    "load_model",
    "load_recording",
    "load_robot",
    "load_trajectory",
    "metrics",
    "mujoco",
    "native",
    "recordings",
    "robots",
    "save_robot",
    "simulate",
    "solvers",
    "statics",
    "sweeps",
    "view",
    "viewer",
    "workspace",
]

# a first simulation does not wait for the import of control, estimation, learning
make_lazy(
    __name__,
    {
        "knode_cosserat.errors": "KnodeCosseratError",
        "knode_cosserat.identification": "fit identify",
        "knode_cosserat.learning": "KNODE FitConfig load_model",
        "knode_cosserat.loading": "load_trajectory",
        "knode_cosserat.native": "export",
        "knode_cosserat.recordings": "estimate_states load_recording",
        "knode_cosserat.rods.robot_file": "catalog load_robot save_robot",
        "knode_cosserat.rods.system": "System",
        "knode_cosserat.solvers": "Result SimulationError equilibrium simulate",
        "knode_cosserat.statics": "inverse_kinematics workspace",
        "knode_cosserat.trajectory": "Trajectory TrajectoryFileError",
        "knode_cosserat.viewer": "view",
    },
)

logging.getLogger(__name__).addHandler(logging.NullHandler())
