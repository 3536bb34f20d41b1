"""Sweeps: many simulations over robots, parameters, controls and seeds, into a folder of Parquet files.

Optional packages: `pip install 'knode-cosserat[sweep]'`. They are imported on first use.
"""

from typing import TYPE_CHECKING

from knode_cosserat._lazy import make_lazy

if TYPE_CHECKING:
    from knode_cosserat.sweeps.data import FailedCase, SweepData, load_sweep
    from knode_cosserat.sweeps.description import Range, Robot, Sweep
    from knode_cosserat.sweeps.errors import SweepError
    from knode_cosserat.sweeps.executors import Dask, Executor, Local, Slurm
    from knode_cosserat.sweeps.plan import Plan
    from knode_cosserat.sweeps.run import run_sweep

__all__ = [
    "Dask",
    "Executor",
    "FailedCase",
    "Local",
    "Plan",
    "Range",
    "Robot",
    "Slurm",
    "Sweep",
    "SweepData",
    "SweepError",
    "load_sweep",
    "run_sweep",
]

make_lazy(
    __name__,
    {
        "knode_cosserat.sweeps.data": "FailedCase SweepData load_sweep",
        "knode_cosserat.sweeps.description": "Range Robot Sweep",
        "knode_cosserat.sweeps.errors": "SweepError",
        "knode_cosserat.sweeps.executors": "Dask Executor Local Slurm",
        "knode_cosserat.sweeps.plan": "Plan",
        "knode_cosserat.sweeps.run": "run_sweep",
    },
)
