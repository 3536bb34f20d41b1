"""Sweeps: many simulations over robots, parameters, controls and seeds, into a folder of Parquet files.

Optional packages: `pip install 'knode-cosserat[sweep]'`. They are imported on first use.
"""

from typing import TYPE_CHECKING

from knode_cosserat._lazy import make_lazy

if TYPE_CHECKING:
    from knode_cosserat.sweeps._data import SweepData, load_sweep
    from knode_cosserat.sweeps._description import Range, Sweep, SweepError
    from knode_cosserat.sweeps._plan import Plan as Plan
    from knode_cosserat.sweeps._run import run_sweep

__all__ = ["Range", "Sweep", "SweepData", "SweepError", "load_sweep", "run_sweep"]

make_lazy(
    __name__,
    {
        "knode_cosserat.sweeps._data": "SweepData load_sweep",
        "knode_cosserat.sweeps._description": "Range Sweep SweepError",
        "knode_cosserat.sweeps._plan": "Plan",
        "knode_cosserat.sweeps._run": "run_sweep",
    },
)
