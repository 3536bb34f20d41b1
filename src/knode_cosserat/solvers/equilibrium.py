"""Static equilibrium, by the solver of a time step with every rate zero."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

from knode_cosserat.rods.system import System
from knode_cosserat.solvers.boundary import NewtonOptions
from knode_cosserat.solvers.guess import state_from_positions
from knode_cosserat.solvers.settings import Settings
from knode_cosserat.solvers.simulate import refined_trajectory, simulate
from knode_cosserat.solvers.space import SpaceScheme
from knode_cosserat.solvers.time import Static
from knode_cosserat.trajectory import Trajectory


def equilibrium(
    robot: System | Sequence[System],
    control: Any,
    *,
    space: str | SpaceScheme = "lobatto2",
    initial: Any = None,
    newton: NewtonOptions = NewtonOptions(),
    position_tolerance: float | None = None,
    recovery_budget: float | None = None,
    on_failure: Literal["raise", "return"] = "raise",
) -> Trajectory:
    """Return the static equilibrium under a constant control.

    Args:
        robot: one system, or a sequence of systems that differ in their parameters only.
        control: (c,), or (B, c) for a batch; for a tendon robot the tensions in N.
        space: "lobatto2", "lobatto4", "euler", or a scheme.
        initial: initial guess, by default the unloaded robot: a `Trajectory` (its last row), or measured
            positions (M, 3) in m, evenly spaced along the rod from its base to its tip.
        newton: tolerances and limits of the solve.
        position_tolerance: largest discretisation error (m) of positions. The number of nodes is chosen for
            it; by default it is the robot's.
        recovery_budget: seconds that recovery may take; see `simulate`.
        on_failure: "raise" a `SimulationError`, or "return" the trajectory with its row marked invalid.

    Returns:
        A `Trajectory` of one row, at time 0; it can be the `initial` of a simulation. If direct iteration
        fails, three methods follow: a rod between two held ends starts from a hanging curve, the load is
        applied in parts, and a damped motion is simulated until the robot rests. If there are several
        equilibria, this is one of them, stable or unstable: see `kc.statics.stability`.

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
    if position_tolerance is not None:
        solve = functools.partial(
            equilibrium, control=control, space=space, initial=initial, newton=newton,
            recovery_budget=recovery_budget, on_failure=on_failure,
        )  # fmt: skip
        order = Settings.of("bdf2", space, "paper", newton).space.order
        return refined_trajectory(solve, robot, initial, position_tolerance, order)
    if initial is not None and not isinstance(initial, Trajectory):
        initial = _guess(robot, initial, control)
    found = simulate(
        robot, control[..., None, :], 1.0, time=Static(), space=space, initial=initial, newton=newton,
        recovery_budget=recovery_budget, on_failure=on_failure,
    )  # fmt: skip
    rows = (slice(None), slice(1, 2)) if found.y.ndim == 4 else slice(1, 2)
    names = ["y", "z", "control", "result", "residual", "iterations", "position_error"]
    names += [] if found.extrapolated is None else ["extrapolated"]
    return dataclasses.replace(
        found, time=np.zeros(1), **{name: getattr(found, name)[rows] for name in names}
    )


def _guess(robot: Any, positions: Any, control: Any) -> Trajectory:
    """Return a trajectory of one row through measured positions."""
    if not isinstance(robot, System):
        raise ValueError("initial holds positions, which are of one robot; give a batch no initial")
    try:
        positions = np.asarray(positions, dtype=float)
    except (TypeError, ValueError):
        raise ValueError(
            f"initial is a {type(positions).__name__}; allowed is a Trajectory, or positions (M, 3) in m"
        ) from None
    record, ny = state_from_positions(robot, positions, np.asarray(control)), robot.y_layout.size
    nothing = np.zeros(1)
    return Trajectory(
        system=robot, settings=None, time=nothing, y=record[None, :, :ny], z=record[None, :, ny:],
        control=np.asarray(control)[None], result=nothing.astype(int), residual=nothing,
        iterations=nothing.astype(int),
    )  # fmt: skip
