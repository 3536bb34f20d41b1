"""Why a time step is solved at all nodes at once: the same equations by single shooting, measured beside it.

`python -m benchmarks.elimination` prints, for each way, the time of a step and how far a load can be applied
in one go from the straight rod. Single shooting: y is integrated from base to tip, with the derivatives to
the six base unknowns carried along, and Newton's method works on those six alone.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import knode_cosserat as kc
from benchmarks.cases import DT, STEPS, medians, one_core
from knode_cosserat.solvers.boundary import newton
from knode_cosserat.solvers.linear import ELIMINATIONS, Condensed, Decoupled
from knode_cosserat.solvers.past import rest_record
from knode_cosserat.solvers.problem import StepProblem

Solve = Callable[[StepProblem, Any, Any], tuple[Any, Any, Any]]
OPTIONS = kc.NewtonOptions()


def shooting(problem: StepProblem, y: Any, unknowns: Any) -> tuple[Any, Any, Any]:
    """States, unknowns and the tip's residual in natural units, by single shooting."""
    system = problem.system
    ds = system.length / (system.nodes - 1)

    def shoot(xi: Any) -> tuple[Any, Any]:
        def segment(y: Any, node: Any) -> tuple[Any, Any]:
            s, start, end = node
            middle = (start + end) / 2
            after = problem.space.advance(
                lambda *at: problem.point_rates(*at)[0], s, ds, y, (start, middle, end)
            )
            return after, after

        first = problem.base(xi)
        nodes = (problem.arclength[:-1], problem.history[:-1], problem.history[1:])
        last, rest = jax.lax.scan(segment, first, nodes)
        tip = problem.tip_residual(last) / system.scales().tip
        return tip, (tip, jnp.concatenate([first[None], rest]))

    def correct(state: Any) -> Any:
        xi, _, _, count = state
        jacobian, (tip, y) = jax.jacfwd(shoot, has_aux=True)(xi)
        return xi - jnp.linalg.solve(jacobian, tip), y, jnp.max(jnp.abs(tip)), count + 1

    def unsolved(state: Any) -> Any:
        _, _, error, count = state
        return ~(error <= OPTIONS.tolerance) & (count < 30)

    state = (unknowns, y, jnp.array(jnp.inf), jnp.array(0))
    xi, y, error, _ = jax.lax.while_loop(unsolved, correct, state)
    return y, xi, error


def all_nodes(linear: Any, problem: StepProblem, y: Any, unknowns: Any) -> tuple[Any, Any, Any]:
    """The same by the package's own solver."""
    solution = newton(problem, y, unknowns, linear, OPTIONS)
    return solution.y, solution.unknowns, solution.error


WAYS: dict[str, Solve] = {
    "single shooting": shooting,
    "all nodes, condensed": functools.partial(all_nodes, Condensed()),
    "all nodes, decoupled": functools.partial(all_nodes, Decoupled()),
    "all nodes, decoupled in groups": functools.partial(all_nodes, ELIMINATIONS["decoupled"]),
}


def rollout(solve: Solve) -> Any:
    """BDF2 from rest with a linear guess: the loop of `solvers.march`, with any way to solve a step."""

    @jax.jit
    def run(robot: kc.System, controls: Any) -> Any:
        rest = rest_record(robot)
        ny = robot.y_layout.size

        def step(carry: Any, control: Any) -> Any:
            (x1, x2), (xi1, xi2) = carry
            history = (-2.0 * x1 + 0.5 * x2) / DT
            problem = StepProblem(
                robot, jnp.zeros(()), control, jnp.array(1.5 / DT), history[None], kc.Euler()
            )
            y, xi, error = solve(problem, (2.0 * x1 - x2)[:, :ny], 2.0 * xi1 - xi2)
            return ((problem.records(y)[0], x1), (xi, xi1)), error

        zero = jnp.zeros(robot.unknown_count)
        carry, errors = jax.lax.scan(step, ((rest, rest), (zero, zero)), controls)
        return carry[0][0], errors

    return run


def reach(solve: Solve, robot: kc.System) -> float:
    """The largest tension pair (N) whose equilibrium is found in one go from the straight rod."""

    @jax.jit
    def error(tension: Any) -> Any:
        rest = rest_record(robot)
        control = tension * jnp.array([1.0, 0.0, 0.0, 1.0])
        problem = StepProblem.still(robot, kc.Euler(), control)
        return solve(problem, rest[:, : robot.y_layout.size], jnp.zeros(robot.unknown_count))[2]

    largest = 0.0
    for tension in np.geomspace(0.1, 100.0, 61):
        if not error(tension) <= OPTIONS.acceptable:
            break
        largest = float(tension)
    return largest


def main() -> None:
    """Print the table."""
    one_core()
    catalog_robot = kc.load_robot("delrin-tendon-robot")
    controls = kc.controls.sine(1.5, STEPS, DT)
    print("| way | 10 nodes (µs/step) | 40 nodes | 100 nodes | largest load in one go (N) |")
    print("| --- | --- | --- | --- | --- |")
    rollouts = {name: rollout(solve) for name, solve in WAYS.items()}
    times: dict[str, list[float]] = {name: [] for name in WAYS}
    for nodes in (10, 40, 100):
        robot = catalog_robot.replace(nodes=nodes)
        calls = {
            name: functools.partial(
                lambda run, robot: jax.block_until_ready(run(robot, controls)), run, robot
            )
            for name, run in rollouts.items()
        }
        for name, taken in medians(calls, rounds=15).items():
            times[name].append(1e6 * taken / STEPS)
    for name, solve in WAYS.items():
        columns = " | ".join(f"{one:.0f}" for one in times[name])
        print(f"| {name} | {columns} | {reach(solve, catalog_robot):.1f} |")


if __name__ == "__main__":
    main()
