"""Paths of equilibria under a growing load, through limit points (pseudo-arclength continuation).

A robot's equilibria G(y, ξ; control) = 0 form a curve as the control moves on a line. Parametrised by the
load, the curve ends at a maximum of the load: the robot snaps. Parametrised by its own arclength it continues
beyond (Keller 1977).

Some equilibria belong to a neutral family at one control: a closed ring of round section turns about its
tangent without a force. The path does not move along such a family: of all tangents and corrections it takes
the smallest.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from knode_cosserat.rods.system import System, unknowns_of
from knode_cosserat.solvers.boundary import NewtonOptions, factors_of, pivots_of
from knode_cosserat.solvers.equilibrium import equilibrium
from knode_cosserat.solvers.linear import solved_correction
from knode_cosserat.solvers.result import Result
from knode_cosserat.solvers.settings import Settings
from knode_cosserat.solvers.space import SpaceScheme
from knode_cosserat.statics.arguments import checked_control, checked_system, static_settings
from knode_cosserat.statics.response import node_values, static_problem
from knode_cosserat.statics.stability import stability
from knode_cosserat.trajectory import Trajectory

#: largest number of corrections of a point; thresholds for a longer or a shorter next step
MOST_CORRECTIONS, FEW, MANY = 12, 4, 7
#: shortest, longest and first step along the path, in natural units
SHORTEST, LONGEST, FIRST = 1e-5, 0.2, 0.05
#: singular value of the tip's conditions below which a direction may be neutral, as a fraction of the
#: largest. At a limit point the load drives the robot along it: the tip's conditions then have a residual,
#: as a fraction of the change of y in natural units
NEUTRAL, DRIVEN = 1e-7, 1e-5


@dataclasses.dataclass(frozen=True)
class EquilibriumPath:
    """Equilibria along a path, in order."""

    #: fraction of the way from the first control to the last, for each point: it may turn back
    part: np.ndarray
    #: a row for each point; its time is the number of the point
    trajectory: Trajectory
    #: number of unstable directions of each equilibrium; -1: not decided
    unstable_directions: np.ndarray
    #: True if the path reached the last control
    complete: bool

    @property
    def stable(self) -> np.ndarray:
        """True where the equilibrium is stable."""
        return self.unstable_directions == 0

    @property
    def limit_points(self) -> np.ndarray:
        """Indices of the points at which the load reverses."""
        steps = np.sign(np.diff(self.part))
        return np.flatnonzero(steps[1:] * steps[:-1] < 0.0) + 1

    def __repr__(self) -> str:
        turns = ", ".join(f"{self.part[k]:.4g}" for k in self.limit_points) or "none"
        end = "reaches the last control" if self.complete else f"ends at part {self.part[-1]:.4g}"
        return (
            f"EquilibriumPath of {len(self.part)} points: {end}; limit points at part {turns}; "
            f"{np.count_nonzero(self.stable)} stable"
        )


def equilibrium_path(
    robot: System, first: Any, last: Any, *, initial: Any = None, space: str | SpaceScheme = "lobatto2",
    newton: NewtonOptions = NewtonOptions(), points: int = 200, with_stability: bool = True,
) -> EquilibriumPath:  # fmt: skip
    """Follow the equilibria of a robot from one control to another, through limit points.

    Args:
        robot: one robot or model.
        first: control (c,) of the first equilibrium.
        last: control (c,) at which the path ends.
        initial: initial guess of the first equilibrium, as in `equilibrium`.
        space: "lobatto2", "lobatto4", "euler", or a scheme.
        newton: tolerances of the solve.
        points: largest number of points.
        with_stability: compute the stability of every point (`stability`).

    Returns:
        An `EquilibriumPath`. It ends at `last`, or earlier if `points` is reached or no further point is
        found.

    Raises:
        SimulationError: there is no equilibrium at the first control.
        ValueError: arguments of a wrong shape, or the same control twice.
    """
    system = checked_system(robot)
    first, last = checked_control(system, first), checked_control(system, last)
    if np.array_equal(first, last):
        raise ValueError("first and last are the same control; there is no path between them")
    settings = static_settings(space, newton)
    found = equilibrium(system, first, space=settings.space, initial=initial, newton=newton)
    nodes = [np.asarray(found.y[0])]
    walk = _Walk(system, settings, (first, last), nodes[0])
    while len(walk.parts) < points and not walk.complete:
        if not walk.advance():
            break
    trajectory = _trajectory(system, settings, walk)
    directions = np.full(len(walk.parts), -1)
    for row in range(len(directions)) if with_stability else ():
        try:
            directions[row] = stability(trajectory, row).unstable_directions
        except ValueError:  # not decided
            continue
    return EquilibriumPath(np.array(walk.parts), trajectory, directions, walk.complete)


class _Walk:
    """The points of a path that have been computed."""

    def __init__(self, system: System, settings: Settings, ends: tuple[Any, Any], nodes: np.ndarray):
        self.system, self.settings, self.ends = system, settings, ends
        y = _filled(system, settings, ends[0], jnp.asarray(nodes))
        self.y, self.parts, self.errors = [np.asarray(y)], [0.0], [0.0]
        zero = np.zeros_like(self.y[0])
        y, _, _, _, tangent = _corrected(system, settings, ends, (y, 0.0), (zero, 1.0), (y, 0.0))
        self.tangent, self.step, self.complete = tangent, FIRST, False

    def advance(self) -> bool:
        """Add a point; return False if none is found."""
        while self.step >= SHORTEST:
            y, part = self.y[-1], self.parts[-1]
            ty, tp = self.tangent
            guess = (y + self.step * ty, part + self.step * float(tp))
            if guess[1] >= 1.0 > part:
                # the last point is at the last control
                share = (1.0 - part) / (guess[1] - part)
                guess = (y + share * self.step * ty, 1.0)
                found = _corrected(
                    self.system, self.settings, self.ends, guess, (np.zeros_like(y), 1.0), guess
                )
            else:
                found = _corrected(self.system, self.settings, self.ends, guess, self.tangent, guess)
            y_new, part_new, error, count, (way, rate) = found
            if error <= self.settings.newton.acceptable:
                scale = np.asarray(self.system.scales().y)
                forward = float(np.mean(np.asarray(way) / scale * np.asarray(ty) / scale) + rate * tp) > 0.0
                sign = 1.0 if forward else -1.0
                self.tangent = (sign * np.asarray(way), sign * float(rate))
                self.y.append(np.asarray(y_new))
                self.parts.append(float(part_new))
                self.errors.append(float(error))
                self.complete = guess[1] == 1.0
                self.step *= 1.5 if count <= FEW else 0.5 if count >= MANY else 1.0
                self.step = min(self.step, LONGEST)
                return True
            self.step /= 3.0
        return False


@functools.partial(jax.jit, static_argnames="settings")
def _filled(system, settings, control, y):  # type: ignore[no-untyped-def]
    return static_problem(system, settings, control).filled(y)


@functools.partial(jax.jit, static_argnames="settings")
def _corrected(system, settings, ends, start, tangent, plane):  # type: ignore[no-untyped-def]
    """Return y, part, error, corrections and the new tangent, by Newton's method across the tangent."""
    scale, pivots = system.scales().y, pivots_of(system)
    ty, tp = tangent

    def across(y: Any, part: Any) -> Any:
        return jnp.mean(ty / scale * (y - plane[0]) / scale) + tp * (part - plane[1])

    def at(y: Any, part: Any) -> Any:
        """Return the error of the residuals, and the changes of y that remove them or follow the load."""

        def residuals(part: Any) -> Any:
            control = ends[0] + part * (ends[1] - ends[0])
            problem = static_problem(system, settings, control)
            base = problem.base(unknowns_of(system, y[0])) - y[0]
            return *problem.residuals(y), base

        (defects, tip, base), moved = jax.jvp(residuals, (part,), (jnp.ones(()),))
        error = jnp.maximum(jnp.max(jnp.abs(defects) / scale), jnp.max(jnp.abs(tip) / system.scales().tip))
        problem = static_problem(system, settings, ends[0] + part * (ends[1] - ends[0]))
        factors = factors_of(problem, y, unknowns_of(system, y[0]))
        # of a neutral family, the smallest solutions
        rows, columns = system.scales().tip, scale[pivots]
        at_tip = factors.tip @ factors.X[-1, -1] * columns / rows[:, None]
        smallest = factors._replace(inverse=columns[:, None] * jnp.linalg.pinv(at_tip, NEUTRAL) / rows)
        follow, _ = solved_correction(smallest, pivots, *moved)
        left = jnp.max(jnp.abs(moved[1] + factors.tip @ follow[-1]) / rows)
        driven = left > DRIVEN * jnp.sqrt(jnp.mean((follow / scale) ** 2))
        factors = factors._replace(inverse=jnp.where(driven, factors.inverse, smallest.inverse))
        remove, _ = solved_correction(factors, pivots, defects, tip, base)
        follow, _ = solved_correction(factors, pivots, *moved)
        return jnp.where(jnp.isnan(error), jnp.inf, error), remove, follow

    def correct(state: Any) -> Any:
        y, part, _, _, remove, follow, count = state
        slope = jnp.mean(ty / scale * follow / scale) + tp
        change = -(across(y, part) + jnp.mean(ty / scale * remove / scale)) / slope
        y, part = y + remove + change * follow, part + change
        return y, part, *_sized(at(y, part), across(y, part)), count + 1

    def _sized(found: Any, off: Any) -> Any:
        error, remove, follow = found
        return error, jnp.abs(off), remove, follow

    def going(state: Any) -> Any:
        _, _, error, off, _, _, count = state
        return (
            ((error > settings.newton.tolerance) | (off > 1e-9)) & (count < MOST_CORRECTIONS) & (error < 1e6)
        )

    state = (start[0], jnp.asarray(start[1]), *_sized(at(*start), across(*start)), 0)
    y, part, error, _, _, follow, count = jax.lax.while_loop(going, correct, state)
    size = jnp.sqrt(jnp.mean((follow / scale) ** 2) + 1.0)
    return y, part, error, count, (follow / size, 1.0 / size)


def _trajectory(system: System, settings: Settings, walk: _Walk) -> Trajectory:
    controls = walk.ends[0] + np.array(walk.parts)[:, None] * (walk.ends[1] - walk.ends[0])
    rows = [node_values(system, settings, control, y) for control, y in zip(controls, walk.y, strict=True)]
    y, z = (np.stack([np.asarray(row[k]) for row in rows]) for k in (0, 1))
    count = len(rows)
    return Trajectory(
        system=system, settings=settings, time=np.arange(float(count)), y=y, z=z, control=controls,
        result=np.full(count, int(Result.CONVERGED)), residual=np.array(walk.errors),
        iterations=np.zeros(count, dtype=int),
    )  # fmt: skip
