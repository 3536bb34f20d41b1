"""Static equilibrium of a robot or a batch, and of a robot under a list of controls."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from knode_cosserat._arguments import check_arguments
from knode_cosserat.engine.pattern import Pattern
from knode_cosserat.rods.passport import without_passport
from knode_cosserat.rods.system import System, is_traced
from knode_cosserat.schemes.grid import grid_of
from knode_cosserat.schemes.history import StepRows
from knode_cosserat.schemes.result import Result, Verdict
from knode_cosserat.schemes.settings import NewtonOptions, Settings
from knode_cosserat.schemes.space import SpaceScheme
from knode_cosserat.solvers.energy import is_tested
from knode_cosserat.solvers.guess import state_from_positions
from knode_cosserat.solvers.refinement import Solved, has_chosen, mark_unseen, refine, resample
from knode_cosserat.solvers.rest import unloaded_shape
from knode_cosserat.solvers.rollout import static_rollout
from knode_cosserat.solvers.run import (
    TimeIntegration,
    failure,
    rows_of,
    warn_of_coarse_grids,
    warn_of_results,
    warn_outside_rod_theory,
)
from knode_cosserat.solvers.simulate import (
    check_initial,
    check_tolerance,
    checked_controls,
    mark_extrapolated,
    stack_robots,
)
from knode_cosserat.solvers.small_motion import stable_near, verdicts
from knode_cosserat.solvers.static_run import separate_run, static_batch, static_run
from knode_cosserat.trajectory import Trajectory


def equilibrium(
    robot: System | Sequence[System],
    control: Any = None,
    *,
    space: str | SpaceScheme = "lobatto2",
    initial: Any = None,
    newton: NewtonOptions = NewtonOptions(),
    position_tolerance: float | None = None,
    recovery_budget: float | None = None,
    on_failure: Literal["raise", "return"] = "raise",
    with_stability: bool = True,
) -> Trajectory:
    """Return the static equilibrium under a constant control.

    Args:
        robot: one system, or a sequence of systems that differ in their parameters only.
        control: (c,), or (B, c) for a batch; for a tendon robot the tensions in N; a table's columns are
            matched by their names. None: for a robot without controls.
        space: "lobatto2", "lobatto4", "euler", or a scheme.
        initial: initial guess: a `Trajectory` (its last row), or measured positions (M, 3) in m, evenly
            spaced along the rod from its base to its tip. By default it is the unloaded robot, or a curve
            of the rod's length between two held ends that are nearer to each other than in that shape.
        newton: tolerances and limits of the solve.
        position_tolerance: largest discretisation error (m) of positions. The number of nodes is chosen for
            it; by default it is the robot's.
        recovery_budget: seconds that recovery may take; see `simulate`.
        on_failure: "raise" a `SimulationError`, or "return" the trajectory with its row marked invalid.
        with_stability: test the stability: 4 to 40 ms of CPU time for one rod where the energy does not
            decide, 80 to 180 ms for several. False for many equilibria in a loop.

    Returns:
        A `Trajectory` of one row, at time 0 and without a solver state; it can be the `initial` of a
        simulation. Driven ends are turned in parts of at most 1 rad from zero, or from the control of
        `initial`, and keep their turns; if not, the result is OTHER_TURNS. If direct iteration fails, the
        load is applied in parts, or a damped motion is simulated until the robot rests. There may be several
        equilibria. `stability` of the trajectory is the verdict, or the reason why it was not tested: rods
        under dead loads by their energy, one equilibrium of another robot by the growth of its small
        motions, of batches only the former. Without a guess, an unstable shape of a compressed rod, or of one
        robot whose motion does not oscillate as it grows, is replaced by the stable one to which it falls
        (for the latter, RECOVERED_RELAXATION); if none is found, and for all others, the result is UNSTABLE.

    Raises:
        SimulationError: no equilibrium was found.
        ValueError: arguments of a wrong shape or name.
    """
    check_arguments(equilibrium, locals())
    control = _checked_control(robot, control)
    check_tolerance(robot, initial, position_tolerance)
    solve = functools.partial(
        _solve,
        controls=control[..., None, :],
        settings=Settings.of(None, space, "paper", newton),
        initial=initial,
        recovery_budget=recovery_budget,
        on_failure=on_failure,
        with_stability=with_stability,
    )
    return refine(solve, robot, solve.keywords["settings"].space, position_tolerance)


def equilibria(
    robot: System | Sequence[System],
    controls: Any,
    *,
    space: str | SpaceScheme = "lobatto2",
    initial: Any = None,
    newton: NewtonOptions = NewtonOptions(),
    recovery_budget: float | None = None,
    on_failure: Literal["raise", "return"] = "raise",
    with_stability: bool = True,
) -> Trajectory:
    """Return the static equilibria under a list of controls, each found from the one before, or by itself.

    Args:
        robot: one system, or a sequence of systems that differ in their parameters only.
        controls: (T, c), or (B, T, c) for a batch.
        space: see `equilibrium`, as all other arguments; `initial` is the guess of the first equilibrium.
        initial: see `equilibrium`. "separate": each is found by itself, whatever the order of the controls,
            from the unloaded robot, or else from the one with the nearest controls (one robot only).
        newton: see `equilibrium`.
        recovery_budget: see `equilibrium`.
        on_failure: see `equilibrium`.
        with_stability: see `equilibrium`.

    Returns:
        A `Trajectory` of T rows. All are at time 0 of the robot's equations; `time` counts them from 0.

    Raises:
        SimulationError: an equilibrium was not found.
        ValueError: arguments of a wrong shape or name.
    """
    check_arguments(equilibria, locals())
    # refuses what is no robot
    stack_robots(robot)
    solve = functools.partial(
        _solve,
        controls=controls,
        settings=Settings.of(None, space, "paper", newton),
        initial=initial,
        recovery_budget=recovery_budget,
        on_failure=on_failure,
        with_stability=with_stability,
    )
    return refine(solve, robot, solve.keywords["settings"].space)


def _solve(
    robot: Any,
    controls: Any,
    settings: Settings,
    initial: Any,
    recovery_budget: float | None,
    on_failure: str,
    with_stability: bool,
) -> Solved[Trajectory]:
    """Return the equilibria of a robot or a batch on its grid; arguments as in `equilibria`."""
    system, batch = stack_robots(robot)
    controls, batch = checked_controls(system, controls, batch)
    separate = isinstance(initial, str) and initial == "separate"
    if separate and (batch or is_traced((system, controls))):
        raise ValueError('initial is "separate"; that is for one robot, neither a batch nor traced')
    initial = None if separate else initial
    if initial is not None and not isinstance(initial, Trajectory):
        initial = _guess(robot, initial, controls[(0,) * (np.ndim(controls) - 1)])
    elif initial is not None and isinstance(robot, System) and has_chosen(robot):
        initial = resample(initial, robot)
    if initial is not None:
        check_initial(system, initial, batch)
    bare = without_passport(system)
    y = before = None
    if initial is not None:
        y, before = grid_of(system).spread(initial.y[-1]), initial.control[-1]
    task = TimeIntegration(settings, steps=np.shape(controls)[-2], recovery_budget=recovery_budget)
    said: tuple[Callable[[], None], ...] = ()
    if is_traced((system, controls, y)):
        rest = unloaded_shape(bare, settings.space) if y is None else y
        if batch and rest.ndim == 2:
            rest = jnp.broadcast_to(rest, (batch, *rest.shape))
        rows = mark_unseen(system, _solve_traced(bare, controls, rest, task, Pattern.of(bare)))
        tested: Any = jnp.full(jnp.shape(rows.result), int(Verdict.UNTESTED_TRACED))
    else:
        if separate:
            rows, _, causes = separate_run(task, bare, controls)
        else:
            rows, _, causes = (static_batch if batch else static_run)(task, bare, controls, y, before)
        if on_failure == "raise" and causes:
            raise failure(rows, causes, None)
        tested = verdicts(bare, settings, rows, np.asarray(controls) if with_stability else None)
        alone = tested.shape == (1,) and tested[0] == Verdict.UNSTABLE and not is_tested(bare)
        if alone and initial is None and recovery_budget != 0.0 and rows.result[0] != Result.OTHER_TURNS:
            row = StepRows(*(leaf[0] for leaf in rows))
            if (fallen := stable_near(bare, settings, row, controls[0])) is not None:
                rows = StepRows(*(np.asarray(leaf)[None] for leaf in fallen))
                tested[0] = int(Verdict.STABLE)
        rows.result[(tested > 0) & (rows.result != Result.OTHER_TURNS)] = Result.UNSTABLE
        said = (
            functools.partial(warn_of_coarse_grids, system, settings, rows),
            functools.partial(warn_of_results, rows),
            functools.partial(warn_outside_rod_theory, system, rows),
        )
    time = np.arange(float(task.steps))
    found = Trajectory(system, settings, time, control=controls, **rows_of(system, rows), stability=tested)
    return Solved.of(mark_extrapolated(found, None), said)


@functools.partial(jax.jit, static_argnames=("task", "pattern"))
def _solve_traced(system, controls, y, task, pattern):  # type: ignore[no-untyped-def]
    """Solve inside JAX's transformations: without recovery; unsolved rows become NaN."""
    run: Any = static_rollout(task, pattern)
    if np.ndim(controls) == 3:
        run = jax.vmap(run, in_axes=(0 if np.ndim(system.length) else None, 0, 0))
    return run(system, controls, y)


def _checked_control(robot: Any, control: Any) -> Any:
    layout = stack_robots(robot)[0].control_layout
    if control is None:
        if layout.size:
            raise ValueError(f"control is None; allowed is ({layout.size},): {', '.join(layout.labels)}")
        control = np.zeros(0)
    if not isinstance(control, jax.Array):
        try:
            control = layout.numbers_of(control)
        except (TypeError, ValueError) as error:
            raise ValueError(f"control is not numbers ({error}); allowed is (c,), or (B, c)") from None
    if not control.ndim:
        raise ValueError(f"control is one number, {control}; allowed is (c,), or (B, c) for a batch")
    return control


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
        system=robot,
        settings=None,
        time=nothing,
        y=record[None, :, :ny],
        z=record[None, :, ny:],
        control=np.asarray(control)[None],
        result=nothing.astype(int),
        residual=nothing,
        iterations=nothing.astype(int),
    )
