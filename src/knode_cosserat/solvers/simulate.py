"""Simulation of a system under given controls: one robot, or a batch."""

from __future__ import annotations

import dataclasses
import functools
import reprlib
import warnings
from collections.abc import Sequence
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from knode_cosserat._arguments import check_arguments
from knode_cosserat.engine.pattern import Pattern
from knode_cosserat.rods.passport import compared_numbers, with_passport, without_passport
from knode_cosserat.rods.rod import SlenderRod
from knode_cosserat.rods.system import ChosenNodes, System, array_module, is_traced
from knode_cosserat.rods.wrapped import nominal_model
from knode_cosserat.schemes.grid import grid_of
from knode_cosserat.schemes.history import StateHistory, StepRows, at_stages, no_rows
from knode_cosserat.schemes.settings import Errors, NewtonOptions, Settings
from knode_cosserat.schemes.space import SpaceScheme
from knode_cosserat.schemes.time import TimeScheme
from knode_cosserat.solvers.damping import warn_if_undamped, warn_of_long_steps
from knode_cosserat.solvers.initial import STARTS, start_of
from knode_cosserat.solvers.refinement import (
    Solved,
    as_seen,
    has_chosen,
    nodes_of,
    on_grid,
    refine,
    resample,
)
from knode_cosserat.solvers.rollout import Solves, rollout
from knode_cosserat.solvers.run import (
    TimeIntegration,
    carried_results,
    failure,
    refuse_far_turns,
    rows_of,
    run_batch,
    run_one,
    warn_of_coarse_grids,
    warn_outside_rod_theory,
)
from knode_cosserat.solvers.static_run import static_run
from knode_cosserat.trajectory import Trajectory

#: shortest and longest time steps (s): shorter ones are lost in rounding errors of the times
SHORTEST_STEP, LONGEST_STEP = 1e-9, 1e6
#: negative tensions up to this part of the largest tension may be measurement noise
PUSHING = 0.02
#: largest relative difference in length between a robot and the one whose motion it continues
OTHER_LENGTH = 1e-3


def simulate(
    robot: System | Sequence[System],
    controls: Any,
    dt: float,
    *,
    time: str | TimeScheme = "sdirk2",
    space: str | SpaceScheme = "lobatto2",
    start: Literal["paper", "consistent"] = "consistent",
    between: Literal["held", "linear"] = "held",
    initial: Trajectory | Literal["equilibrium", "unstressed"] = "equilibrium",
    newton: NewtonOptions = NewtonOptions(),
    position_tolerance: float | None = None,
    errors: Errors = True,
    recovery_budget: float | None = None,
    on_failure: Literal["raise", "return"] = "raise",
    progress: bool = False,
) -> Trajectory:
    """Simulate a robot, or a batch of them, under given controls.

    Args:
        robot: one system, or a sequence of systems that differ in their parameters only.
        controls: (T, c), or (B, T, c) for a batch; for a tendon robot the tensions in N; a table's columns
            are matched by their names. Control i is held from row i to row i + 1; see `between`.
        dt: time step (s).
        time: "sdirk2", or "bdf1", "bdf2", "bdf-alpha", "trapezoidal", or a scheme. Multistep schemes evaluate
            controls at the end of a step, so that one that is held acts half a step late: they are of order 2
            for controls that are continuous in time, of which control i is the value at row i + 1.
        space: "lobatto2" (order 2), "lobatto4" (order 4), "euler" (order 1, the paper's), or a scheme.
        start: how a multistep scheme makes its first step from one state; see `Settings`.
        between: "held": controls are constant from row to row, as a robot's controller sets them;
            displacements and rotations (controls in m or rad) cannot jump, and are linear from row to row.
            "linear": so are all others. Linear controls reach control i at row i + 1. A motion from rest or
            from an equilibrium begins suddenly: the first control of the others is held.
        initial: "equilibrium": start at rest under zero control; "unstressed": in the shape that the rod was
            made in, from which it falls by its weight, as in the paper's studies (the equilibrium too if that
            shape is only a guess, such as for a platform on bent legs); or from this trajectory's last row. A
            simulated motion continues exactly, by its `final_state`, with the same time step. A part of it,
            `motion[:k]`, has its rows evaluated again first. For a part from the middle, and for measured
            rows, states between nodes are interpolated, and a scheme that needs rates (BDF-α, the trapezoidal
            rule) makes its first step by BDF1.
        newton: tolerances and limits of the solve in each step.
        position_tolerance: largest discretisation error (m) of positions along the rod. The number of nodes
            is chosen so that the estimate stays below it in every row; by default it is the robot's.
        errors: estimate the errors of every row; "grid": those by the nodes only; False: none, which takes
            12 to 30 % less time. Errors that are not estimated are NaN, and no row is known to be COARSE.
        recovery_budget: seconds that recovery from failed steps may take, 0 for none; by default 20 times
            the run's own time or 5 s, whichever is more.
        on_failure: "raise" a `SimulationError`, or "return" the trajectory with the remaining rows invalid.
        progress: show a progress bar.

    Returns:
        A `Trajectory` of T + 1 rows; row 0 is the initial state. Every row carries its result, and estimates
        of its errors by the nodes (`position_error`) and by the time step (`time_error`). Rows in which a
        learned or identified model is outside the range of its data (`passport`) are marked (`extrapolated`).
        Inside `jit`, `grad` or `vmap` no error can be raised: unsolved rows are NaN there.

    Raises:
        SimulationError: a step was not solved, and recovery failed.
        ValueError: arguments of a wrong shape or name.
    """
    check_arguments(simulate, locals())
    if time in (None, "static"):
        raise ValueError(f"time is {time!r}; equilibria have no time steps: use solvers.equilibria")
    settings = Settings.of(time, space, start, newton, between, errors)
    dt = checked_dt(dt)
    if position_tolerance is not None and not errors:
        raise ValueError("position_tolerance needs estimates of errors: leave out errors=False")
    check_tolerance(robot, initial, position_tolerance)
    robot = on_grid_of(robot, initial) if isinstance(initial, Trajectory) else robot
    system, batch = stack_robots(robot)
    controls, batch = checked_controls(system, controls, batch)
    check_initial(system, initial, batch)
    warn_if_undamped(robot, dt)
    warn_of_long_steps(robot, dt)
    warn_of_contradictions(system, controls, dt)

    def solve(robot: Any) -> Solved[Trajectory]:
        system = stack_robots(robot)[0]
        before = initial
        # passports are not part of the equations: programs are compiled for systems without them
        bare = without_passport(system)
        if isinstance(before, Trajectory):
            before = _again_at_rest(before, system, settings)
            before = without_passport(dataclasses.replace(before, extrapolated=None))
        task = TimeIntegration(settings, dt, np.shape(controls)[-2], recovery_budget=recovery_budget)
        if is_traced((system, controls, before)):
            named, rows = (None, before) if isinstance(before, Trajectory) else (before, None)
            found = _simulate_traced(bare, controls, rows, named, Solves(task, Pattern.of(bare)))
            result, error = as_seen(system, found.result, found.position_error)
            found = dataclasses.replace(found, system=system, result=result, position_error=error)
            return Solved.of(mark_extrapolated(found, initial))
        run = _initial(bare, controls, before, task)
        every, last, said = _plain(bare, run, on_failure, progress)
        return Solved.of(mark_extrapolated(_trajectory(system, run, every, last), initial), said)

    # the state of a motion is known on its own grid only
    moving = isinstance(initial, Trajectory) and (
        initial.settings is None or initial.settings.time is not None
    )
    return refine(solve, robot, settings.space, position_tolerance, stays=moving)


def _again_at_rest(initial: Trajectory, system: System, settings: Settings) -> Trajectory:
    """Return the last equilibrium of a trajectory on the grid of a system."""
    if initial.y.shape[-2] == system.nodes:
        return initial
    guess, bare = resample(initial, system), without_passport(system)
    task = TimeIntegration(Settings(None, settings.space, newton=settings.newton))
    y, control = grid_of(bare).spread(guess.y[-1]), np.asarray(guess.control[-1:])
    rows, _, cause = static_run(task, bare, control, y, control[0])
    if rows.result[0] < 0:
        raise failure(rows, cause, None)
    return dataclasses.replace(guess, system=system, settings=task.settings, **rows_of(bare, rows))


def mark_extrapolated(trajectory: Trajectory, initial: Any) -> Trajectory:
    """Return a trajectory with `extrapolated` marked where its system extrapolates.

    The first row takes the mark of the last row of the trajectory that it continues (`initial`, if it is
    one).
    """
    system = trajectory.system
    if system.passport is None:
        return trajectory
    outside = system.passport.outside(system, **compared_numbers(trajectory))
    if isinstance(initial, Trajectory) and initial.extrapolated is not None:
        numeric = array_module(outside)
        first = numeric.arange(outside.shape[-1]) == 0
        outside = numeric.where(first, initial.extrapolated[-1], outside)
    return dataclasses.replace(trajectory, extrapolated=outside)


# checks of the arguments


def check_tolerance(robot: Any, initial: Any, tolerance: Any) -> None:
    """Check a position tolerance (m), if there is one. Raises `ValueError`."""
    if tolerance is None:
        return
    if not isinstance(robot, System) or np.ndim(robot.length):
        raise ValueError(
            "position_tolerance chooses the nodes of one robot; a batch has the nodes of its robots"
        )
    if isinstance(initial, Trajectory):
        raise ValueError(
            "position_tolerance chooses the nodes, and those of initial are given; leave one out"
        )
    if not isinstance(tolerance, int | float) or not 0.0 < tolerance < np.inf:
        raise ValueError(f"position_tolerance is {tolerance!r}; allowed is a positive number of metres")


def on_grid_of(robot: Any, initial: Trajectory) -> Any:
    """Return a robot whose nodes are chosen on the grid of a trajectory that it continues."""
    if not isinstance(robot, System) or not has_chosen(robot):
        return robot
    nodes = initial.y.shape[-2]
    return on_grid(robot, ChosenNodes(nodes) if nodes >= robot.needed_nodes else nodes)


def stack_robots(robot: Any) -> tuple[System, int | None]:
    """Return one system of a robot or of a batch of robots, and the number of robots in a batch."""
    if isinstance(robot, System):
        return robot, None
    robots = list(robot) if isinstance(robot, Sequence) else []
    if not robots or not all(isinstance(one, System) for one in robots):
        raise ValueError(f"robot is {type(robot).__name__}; allowed is a robot or a non-empty list of robots")
    if has_chosen(robots):
        robots = on_grid(robots, ChosenNodes(nodes_of(robots)))
    if len({one.passport is None for one in robots}) > 1:  # it is not known of all where they extrapolate
        robots = [with_passport(one, None) for one in robots]
    if len({jax.tree.structure(one) for one in robots}) > 1:
        raise ValueError("the robots of a batch must be of one class, with the same nodes and options given")
    numeric = array_module(robots)
    return jax.tree.map(lambda *leaves: numeric.stack(leaves), *robots), len(robots)


def checked_dt(dt: Any) -> float:
    """Return a valid time step (s). Raises `ValueError` otherwise."""
    number = isinstance(dt, int | float | np.number) and not isinstance(dt, bool | np.bool_)
    if not number or not SHORTEST_STEP <= dt <= LONGEST_STEP:
        raise ValueError(
            f"dt is {reprlib.repr(dt)}; allowed is a positive number of seconds, {SHORTEST_STEP:g} to "
            f"{LONGEST_STEP:g}"
        )
    return float(dt)


def checked_controls(system: System, controls: Any, batch: int | None) -> tuple[Any, int | None]:
    """Return controls (steps, c) or (batch, steps, c), and the size of the batch. Raises `ValueError`."""
    names = ", ".join(f"{field.name} ({field.unit})" for field in system.control_layout.fields)
    size = system.control_layout.size
    allowed = f"allowed is (steps, {size}) or (batch, steps, {size}): {names}"
    if not is_traced(controls):
        try:
            controls = system.control_layout.numbers_of(controls)
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
    """Check that controls are within their limits (`ValueError`); warn of tendons that would push."""
    if is_traced(controls):
        return
    layout = system.control_layout
    beyond = layout.beyond(controls)
    if beyond:
        raise ValueError(f"controls: {beyond}")
    # also of the rods of an assembly, such as thumb_tension
    pulling = tuple(name for name in layout.names if name.rpartition("_")[2] == "tension")
    if pulling:
        tension = np.asarray(controls)[..., layout.indices(pulling)]
        # measured tensions may be slightly negative
        if np.min(tension) < -PUSHING * np.max(np.abs(tension)):
            warnings.warn(
                f"a tension is {np.min(tension):g} N: a tendon only pulls, but is computed as if it pushed",
                stacklevel=4,
            )


def warn_of_contradictions(system: System, controls: Any, dt: float) -> None:
    """Warn of controls (…, T, c) that contradict each other, such as a base's pose and its velocities."""
    rod = nominal_model(system)
    if is_traced(controls) or not isinstance(rod, SlenderRod):
        return
    for part, input in rod.inputs(np.moveaxis(np.asarray(controls), -1, 0)):
        if said := part.contradiction(input, dt):
            warnings.warn(f"controls: {said}", stacklevel=4)


def check_initial(system: System, initial: Any, batch: int | None) -> None:
    """Check where a run starts; a trajectory is of one robot, fits the system and is solved.

    Raises:
        ValueError: it does not.
    """
    if isinstance(initial, str) and initial in STARTS:
        return
    if not isinstance(initial, Trajectory):
        given = f" {initial!r}" if isinstance(initial, str) else ""
        raise ValueError(
            f"initial is a {type(initial).__name__}{given}; allowed is {', '.join(map(repr, STARTS))}, or a "
            "Trajectory"
        )
    if batch or initial.y.ndim == 4:
        raise ValueError("initial is for one robot, not for a batch")
    if not len(initial.time):
        raise ValueError("the initial trajectory has no rows; at least one is needed")
    for what, given, wanted in (
        ("nodes", initial.y.shape[-2], system.nodes),
        ("numbers in y", initial.y.shape[-1], system.y_layout.size),
        ("numbers in z", initial.z.shape[-1], system.z_layout.size),
        ("controls", initial.control.shape[-1], system.control_layout.size),
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


# runs


def _initial(system: Any, controls: Any, initial: Any, task: TimeIntegration) -> Any:
    """Return the initial state of a run, its time steps, and the controls of their stages."""
    settings = task.settings
    batch = len(controls) if np.ndim(controls) == 3 else None
    at_start = start_of(system, initial, settings, task.dt, batch, task.recovery_budget)
    task = dataclasses.replace(task, known=at_start.state.known(settings))
    acting = at_stages(system, settings, controls, at_start.control[..., None, :], at_start.state.dt is None)
    return at_start, task, acting


def _plain(system: System, run: Any, on_failure: str, progress: bool) -> tuple[StepRows, StateHistory, Any]:
    """Return the initial row and those of the steps, the last history, and warnings to be given.

    `run` is as from `_initial`.
    """
    at_start, task, controls = run
    batch = np.shape(controls)[:-2]
    every = _initial_rows(system, task, (*batch, task.steps + 1))
    every.records[..., 0, :, : np.shape(at_start.record)[-1]] = at_start.record
    rows = StepRows(*(leaf[(slice(None),) * len(batch) + (slice(1, None),)] for leaf in every))
    start, watch = (at_start.state.history, at_start.control), "bar" if progress else "signals"
    solve: Any = run_batch if batch else run_one
    _, history, causes = solve(task, system, controls, start, watch, rows)
    if on_failure == "raise" and causes:
        times = float(np.ravel(at_start.state.history.t0)[0]) + (1.0 + np.arange(task.steps)) * task.dt
        raise failure(rows, causes, times)
    rows.result[:] = carried_results(rows.result, at_start.result)
    said = (
        functools.partial(warn_of_coarse_grids, system, task.settings, rows),
        functools.partial(warn_outside_rod_theory, system, rows),
    )
    return every, history, said


def _initial_rows(system: System, task: TimeIntegration, shape: tuple[int, ...]) -> StepRows:
    """Return rows of which the first is a state without errors; its record is to be set."""
    every = no_rows(system, shape, task.settings.stages)
    every.stages[..., 0, :, :, :] = np.nan
    every.result[..., 0] = 0
    for k, errors in enumerate((every.position_error, every.time_error)):
        errors[..., 0] = 0.0 if task.settings.estimates > k else np.nan
    return every


@functools.partial(jax.jit, static_argnames=("named", "spec"))
def _simulate_traced(system, controls, rows, named, spec):  # type: ignore[no-untyped-def]
    """Simulate inside JAX's transformations: without recovery; unsolved rows become NaN.

    A single jitted function, so that a transformation traces it once and not at every call.
    """
    at_start, task, acting = run = _initial(system, controls, rows if named is None else named, spec.task)
    solve: Any = rollout(task, spec.pattern)
    if np.ndim(controls) == 3:
        solve = jax.vmap(solve, in_axes=(0 if np.ndim(system.length) else None, 0, 0))
    rows, history = solve(system, acting, at_start.state.history)
    result = refuse_far_turns(system, rows.result, acting, at_start.control)
    rows = rows._replace(result=carried_results(result, at_start.result))
    axis = np.ndim(controls) - 2
    every, size = _initial_rows(system, task, (*np.shape(controls)[:axis], 1)), np.shape(at_start.record)[-1]
    records = jnp.asarray(every.records).at[..., 0, :, :size].set(at_start.record)
    every = every._replace(records=records)
    every = StepRows(*(jnp.concatenate(pair, axis=axis) for pair in zip(every, rows, strict=True)))
    return _trajectory(system, run, every, history)


def _trajectory(system: System, run: Any, every: StepRows, history: Any) -> Trajectory:
    """Return the trajectory of the initial row and those of the steps."""
    at_start, task, controls = run
    settings, dt = task.settings, task.dt
    numeric = array_module((at_start.record, every))
    axis = np.ndim(controls) - 2
    acted = controls[..., np.shape(controls)[-1] - system.control_layout.size :]
    acted = numeric.concatenate([numeric.expand_dims(at_start.control, axis), acted], axis)
    t0 = numeric.asarray(at_start.state.history.t0)
    time = (t0[0] if axis else t0) + np.arange(task.steps + 1) * dt
    final = history._replace(t0=numeric.full(np.shape(t0), time[-1]))
    final = at_start.state.after(final, dt, task.steps, settings)
    initial, final = jax.tree.map(numeric.asarray, (at_start.state, final))
    return Trajectory(
        system,
        settings,
        time,
        control=acted,
        **rows_of(system, every),
        initial_state=initial,
        final_state=final,
    )
