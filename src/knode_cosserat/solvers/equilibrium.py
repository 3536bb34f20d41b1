"""Static equilibrium, by the solver of a time step with every rate zero."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

from knode_cosserat.rods.system import System
from knode_cosserat.solvers.boundary import NewtonOptions
from knode_cosserat.solvers.simulate import simulate
from knode_cosserat.solvers.space import SpaceScheme
from knode_cosserat.solvers.time import Static
from knode_cosserat.trajectory import Trajectory


def equilibrium(
    robot: System | Sequence[System],
    control: Any,
    *,
    space: str | SpaceScheme = "euler",
    initial: Trajectory | None = None,
    newton: NewtonOptions = NewtonOptions(),
    on_failure: Literal["raise", "return"] = "raise",
) -> Trajectory:
    """The shape a robot takes under a constant control, at rest.

    Args:
        robot: one system, or a sequence of systems that differ in their parameters only.
        control: (c,), or (B, c) for a batch; for a tendon robot the tensions in N.
        space: "euler", "rk4", or a scheme.
        initial: where to look for it first: a trajectory's last row, instead of the robot unloaded.
        newton: tolerances and limits of the solve.
        on_failure: "raise" a `SimulationError`, or "return" the trajectory with its row marked invalid.

    Returns:
        A `Trajectory` of one row, at time 0; it can be the `initial` of a simulation. If direct iteration
        fails the load is applied in parts, and then the robot is let move, damped, until it rests; a robot
        with several equilibria gives the one that this finds, stable or not: `kc.stability` tells.

    Raises:
        SimulationError: no equilibrium was found.
        ValueError: arguments of a wrong shape or name.
    """
    if not hasattr(control, "ndim"):
        try:
            if control is None:
                raise TypeError("None")
            control = np.asarray(control, dtype=float)
        except (TypeError, ValueError) as error:
            raise ValueError(f"control is not numbers ({error}); allowed is (c,), or (B, c)") from None
    if not control.ndim:
        raise ValueError(f"control is one number, {control}; allowed is (c,), or (B, c) for a batch")
    found = simulate(
        robot, control[..., None, :], 1.0, time=Static(), space=space, initial=initial, newton=newton,
        on_failure=on_failure,
    )  # fmt: skip
    rows = (slice(None), slice(1, 2)) if found.y.ndim == 4 else slice(1, 2)
    names = ("y", "z", "control", "result", "residual", "iterations")
    return dataclasses.replace(
        found, time=np.zeros(1), **{name: getattr(found, name)[rows] for name in names}
    )
