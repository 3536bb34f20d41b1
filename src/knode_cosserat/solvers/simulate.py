"""From a system and its controls to a trajectory: one robot, or a batch."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Sequence
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from knode_cosserat.rods.system import System, is_traced
from knode_cosserat.solvers import sensitivity
from knode_cosserat.solvers.begin import Beginning, Run, beginning
from knode_cosserat.solvers.boundary import NewtonOptions
from knode_cosserat.solvers.linear import LinearSolver
from knode_cosserat.solvers.result import Result, SimulationError
from knode_cosserat.solvers.run import as_ended, run_batch, run_one
from knode_cosserat.solvers.settings import Settings
from knode_cosserat.solvers.space import SpaceScheme
from knode_cosserat.solvers.stability import natural_time
from knode_cosserat.solvers.task import Steps, Task
from knode_cosserat.solvers.time import Static, TimeScheme
from knode_cosserat.trajectory import Trajectory

#: time steps from this (s), and so many times the rod's natural time, look like milliseconds
LONG_STEP, LONG_STEPS = 1.0, 100.0
#: of the largest tension: so much below zero may be noise of a measurement
PUSHING = 0.02
#: of its length: so much may a robot differ from the one whose motion it goes on with
OTHER_LENGTH = 1e-3


def simulate(
    robot: System | Sequence[System],
    controls: Any,
    dt: float,
    *,
    time: str | TimeScheme = "bdf2",
    space: str | SpaceScheme = "euler",
    start: Literal["paper", "consistent"] = "paper",
    initial: Trajectory | None = None,
    newton: NewtonOptions = NewtonOptions(),
    elimination: str | LinearSolver | None = None,
    on_failure: Literal["raise", "return"] = "raise",
    progress: bool = False,
) -> Trajectory:
    """Simulate a robot, or a batch of them, under given controls.

    Args:
        robot: one system, or a sequence of systems that differ in their parameters only.
        controls: (T, c), or (B, T, c) for a batch; for a tendon robot the tensions in N. Control i is held
            from row i to row i + 1.
        dt: time step (s).
        time: "bdf1", "bdf2", "bdf-alpha", "trapezoidal", or a scheme.
        space: "euler", "rk4", or a scheme.
        start: how the first step is made from one state; see `Settings`.
        initial: start from this trajectory's last row instead of the robot's state at rest (where that is
            only a guess, such as of a platform on bent legs: the equilibrium under no control). If its time
            step is the same the motion goes on exactly. Rows from the middle of a motion, and measured ones,
            tell less: what lies between nodes is interpolated there, and a scheme that asks for their rates
            (BDF-α, the trapezoidal rule) may make its first step by BDF1.
        newton: tolerances and limits of the solve in each step.
        elimination: of the linear equations: "condensed", or "decoupled" for rods along which much grows
            (soft or long ones in short time steps), to which a run changes by itself where it needs it. None
            begins with what `initial` ended with, or else with the first.
        on_failure: "raise" a `SimulationError`, or "return" the trajectory with the rest marked invalid.
        progress: show a progress bar.

    Returns:
        A `Trajectory` of T + 1 rows; row 0 is the initial state. Every row carries its result. Inside `jit`,
        `grad` or `vmap` nothing can be raised: rows that are not solved are NaN there.

    Raises:
        SimulationError: a step has no solution, and nothing that was tried helped.
        ValueError: arguments of a wrong shape or name.
    """
    if initial is not None and not isinstance(initial, Trajectory):
        raise ValueError(f"initial is a {type(initial).__name__}; allowed is a Trajectory, or None")
    settings = settings_of(time, space, start, newton, elimination, initial)
    if on_failure not in ("raise", "return"):
        raise ValueError(f'on_failure is {on_failure!r}; allowed is "raise" or "return"')
    dt = checked_dt(dt)
    system, batch = _stacked(robot)
    controls, batch = _checked_controls(system, controls, batch)
    if not isinstance(settings.time, Static):
        _warn_of_long_steps(system, dt)
    if initial is not None:
        check_initial(system, initial, batch)
    run = Run(system, controls, initial, settings, dt, batch, isinstance(robot, Sequence))
    if is_traced((system, controls, initial)):
        return _traced(*run)
    if batch:
        return _batch(run, on_failure, progress)
    return _single(run, on_failure, progress)


# checking what was given


def settings_of(
    time: str | TimeScheme, space: str | SpaceScheme, start: str, newton: NewtonOptions,
    elimination: str | LinearSolver | None, initial: Trajectory | None,
) -> Settings:  # fmt: skip
    """What was chosen; of the elimination, what `initial` ended with unless it is given."""
    if elimination is None:
        before = None if initial is None else initial.settings
        elimination = "condensed" if before is None else before.elimination
    return Settings.of(time, space, start, newton, elimination)


def _stacked(robot: Any) -> tuple[System, int | None]:
    if isinstance(robot, System):
        return robot, None
    robots = list(robot) if isinstance(robot, Sequence) else []
    if not robots or not all(isinstance(one, System) for one in robots):
        raise ValueError(f"robot is {type(robot).__name__}; allowed is a robot or a non-empty list of robots")
    if len({jax.tree.structure(one) for one in robots}) > 1:
        raise ValueError("the robots of a batch must be of one class, with the same nodes and options given")
    return jax.tree.map(lambda *leaves: jnp.stack([jnp.asarray(x) for x in leaves]), *robots), len(robots)


def checked_dt(dt: Any) -> float:
    """A time step (s); `ValueError` for what is none."""
    if not isinstance(dt, int | float | np.number) or not 0.0 < dt < np.inf:
        raise ValueError(f"dt is {dt!r}; allowed is a positive number of seconds")
    return float(dt)


def _warn_of_long_steps(system: System, dt: float) -> None:
    """Say so where a time step looks like milliseconds: seconds long, and far beyond what the rod does."""
    if dt < LONG_STEP or is_traced(system):
        return
    natural = natural_time(system)
    if natural is not None and dt > LONG_STEPS * natural:
        warnings.warn(
            f"dt is {dt:g} s, {dt / natural:.2g} times this rod's natural time ({natural:.2g} s): "
            "is it meant in seconds?",
            stacklevel=3,
        )


def _checked_controls(system: System, controls: Any, batch: int | None) -> tuple[Any, int | None]:
    names = ", ".join(f"{field.name} ({field.unit})" for field in system.control_layout.fields)
    size = system.control_size
    allowed = f"allowed is (steps, {size}) or (batch, steps, {size}): {names}"
    if not is_traced(controls):
        try:
            if np.iscomplexobj(controls):
                raise ValueError("they are complex")
            controls = np.asarray(controls, dtype=float)
        except (TypeError, ValueError) as error:
            raise ValueError(f"controls are not numbers ({error}); {allowed}") from None
    shape = np.shape(controls)
    if len(shape) not in (2, 3) or shape[-1] != size or 0 in shape[:-1]:
        raise ValueError(f"controls have shape {shape}; {allowed}")
    if not is_traced(controls) and not np.all(np.isfinite(controls)):
        bad = tuple(np.argwhere(~np.isfinite(controls))[0].tolist())
        raise ValueError(f"controls are {controls[bad]} at index {bad}; they must be finite")
    check_limits(system, controls)
    if batch is None:
        return controls, shape[0] if len(shape) == 3 else None
    if len(shape) == 2:
        spread = jnp.broadcast_to if is_traced(controls) else np.broadcast_to
        return spread(controls, (batch, *shape)), batch
    if shape[0] != batch:
        raise ValueError(
            f"there are {batch} robots but {shape[0]} controls; give as many, or one (steps, {size})"
        )
    return controls, batch


def check_limits(system: System, controls: Any) -> None:
    """That controls are within their fields' limits (`ValueError`); and warn of tendons that would push."""
    if is_traced(controls):
        return
    layout = system.control_layout
    beyond = layout.beyond(controls)
    if beyond:
        raise ValueError(f"controls: {beyond}")
    if "tension" in layout.names:
        tension = np.asarray(layout.get(controls, "tension"))
        # of what was measured some may be a little less than nothing
        if np.min(tension) < -PUSHING * np.max(np.abs(tension)):
            warnings.warn(
                f"a tension is {np.min(tension):g} N: a tendon only pulls, but is computed as if it pushed",
                stacklevel=4,
            )


def check_initial(system: System, initial: Trajectory, batch: int | None) -> None:
    """That a trajectory is one robot's, fits the system, and is solved; `ValueError` otherwise."""
    if batch or initial.y.ndim == 4:
        raise ValueError("initial is for one robot, not for a batch")
    if not len(initial.time):
        raise ValueError("the initial trajectory has no rows; at least one is needed")
    for what, given, wanted in (
        ("nodes", initial.y.shape[-2], system.nodes),
        ("numbers in y", initial.y.shape[-1], system.y_layout.size),
        ("numbers in z", initial.z.shape[-1], system.z_layout.size),
        ("controls", initial.control.shape[-1], system.control_size),
    ):
        if given != wanted:
            raise ValueError(f"the initial trajectory has {given} {what}, the robot {wanted}")
    if is_traced((initial, system)):
        return
    initial.require_valid()
    length, before = float(system.length), float(initial.system.length)
    if abs(length - before) > OTHER_LENGTH * before:
        raise ValueError(
            f"the initial trajectory is of a robot {before:g} m long, this one is {length:g} m long: "
            "it cannot go on from there"
        )


# the three ways to run


def _single(run: Run, on_failure: str, progress: bool) -> Trajectory:
    system, controls, _, settings, dt, _, _ = run
    begins = beginning(run)
    task = Task(settings, dt, len(controls), begins.first)
    steps, cause = run_one(task, system, controls, begins.start, progress)
    if on_failure == "raise" and steps.result.min() < 0:
        raise _failure(task, float(begins.t0), steps, cause, None)
    return _trajectory(run._replace(settings=as_ended(settings, steps)), begins, steps)


def _batch(run: Run, on_failure: str, progress: bool) -> Trajectory:
    system, controls, _, settings, dt, _, many = run
    begins = beginning(run)
    task = Task(settings, dt, controls.shape[1])
    steps, causes = run_batch(task, system, many, controls, begins.start, progress)
    if on_failure == "raise" and causes:
        robot, cause = next(iter(causes.items()))
        raise _failure(task, 0.0, Steps(*(leaf[robot] for leaf in steps)), cause, robot)
    return _trajectory(run, begins, steps)


def _failure(task: Task, t0: float, steps: Steps, cause: str, robot: int | None) -> SimulationError:
    i = int(np.argmax(steps.result < 0))
    number = 0 if isinstance(task.settings.time, Static) else i + 1
    return SimulationError(
        number, t0 + number * task.dt, float(steps.error[i]), Result(int(steps.result[i])), cause, robot
    )


@functools.partial(jax.jit, static_argnums=(3, 4, 5, 6))
def _traced(system, controls, initial, settings, dt, batch, many):  # type: ignore[no-untyped-def]
    """As seen by JAX's transformations: nothing is recovered, rows that are not solved become NaN.

    One jitted call, so that a transformation traces it once and not at every call.
    """
    run = Run(system, controls, initial, settings, dt, batch, many)
    begins = beginning(run)
    one = sensitivity.rollout(Task(settings, dt, np.shape(controls)[-2], begins.first))
    if batch:
        rows = jax.vmap(one, in_axes=(0 if many else None, 0, 0))(system, controls, begins.start.past)
    else:
        rows = one(system, controls, begins.start.past)
    result = jnp.where(rows.error <= settings.newton.acceptable, 0, int(Result.NO_CONVERGENCE))
    return _trajectory(run, begins, Steps._make([*rows, result]))


def _trajectory(run: Run, begins: Beginning, steps: Steps) -> Trajectory:
    """Put the initial row before the steps, and NaN where there is no solution."""
    system, controls, _, settings, dt, batch, _ = run
    numeric: Any = jnp if is_traced((begins.record, steps)) else np
    axis = 1 if batch else 0
    ny, nz = system.y_layout.size, system.z_layout.size
    invalid = numeric.asarray(steps.result) < 0
    records = numeric.where(invalid[..., None, None], numeric.nan, steps.records[..., : ny + nz])

    def joined(first: Any, rest: Any) -> Any:
        return numeric.concatenate([numeric.expand_dims(first, axis), rest], axis)

    states = joined(numeric.asarray(begins.record)[..., : ny + nz], records)
    zero = numeric.zeros(states.shape[:axis])
    return Trajectory(
        system=system,
        settings=settings,
        time=begins.t0 + np.arange(np.shape(controls)[-2] + 1) * dt,
        y=states[..., :ny],
        z=states[..., ny:],
        control=joined(begins.start.control, controls),
        result=joined(zero.astype(int), steps.result),
        residual=joined(zero, steps.error),
        iterations=joined(zero.astype(int), steps.corrections),
        begun=jax.tree.map(numeric.asarray, begins.begun),
    )
