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
from tqdm import tqdm

from knode_cosserat._arguments import check_arguments
from knode_cosserat.rods.system import System, unknowns_of
from knode_cosserat.schemes.problem import StepProblem
from knode_cosserat.schemes.result import Result
from knode_cosserat.schemes.settings import NewtonOptions, Settings
from knode_cosserat.schemes.space import SpaceScheme
from knode_cosserat.solvers.equilibrium import equilibrium
from knode_cosserat.solvers.replay import still_state
from knode_cosserat.statics.arguments import checked_control, static_settings
from knode_cosserat.statics.response import node_values
from knode_cosserat.statics.stability import stability
from knode_cosserat.trajectory import Trajectory

#: largest number of corrections of a point, and error above which there are no more (natural units);
#: thresholds for a longer or a shorter next step
MOST_CORRECTIONS, LARGEST_ERROR, FEW, MANY = 12, 1e6, 4, 7
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
    robot: System,
    first: Any,
    last: Any,
    *,
    initial: Any = None,
    space: str | SpaceScheme = "lobatto2",
    newton: NewtonOptions = NewtonOptions(),
    points: int = 200,
    with_stability: bool = True,
    progress: bool = False,
) -> EquilibriumPath:
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
        progress: show a progress bar.

    Returns:
        An `EquilibriumPath`. It ends at `last`, or earlier if `points` is reached or no further point is
        found. An interruption by Ctrl-C is a `KeyboardInterrupt`, whose `best` is the path so far.

    Raises:
        SimulationError: there is no equilibrium at the first control.
        ValueError: arguments of a wrong shape, or the same control twice.
    """
    check_arguments(equilibrium_path, locals())
    first, last = checked_control(robot, first), checked_control(robot, last)
    if np.array_equal(first, last):
        raise ValueError("first and last are the same control; there is no path between them")
    settings = static_settings(space, newton)
    found = equilibrium(
        robot, first, space=settings.space, initial=initial, newton=newton, with_stability=False
    )
    robot = found.system
    walk = _PathPoints(robot, settings, (first, last), np.asarray(found.y[0]))
    directions: list[int] = []

    def path() -> EquilibriumPath:
        trajectory, unknown = _trajectory(robot, settings, walk), [-1] * (len(walk.parts) - len(directions))
        return EquilibriumPath(
            np.array(walk.parts), trajectory, np.array([*directions, *unknown]), walk.complete
        )

    with tqdm(total=points, initial=1, disable=not progress, unit="point", leave=False) as bar:
        try:
            while len(walk.parts) < points and not walk.complete and walk.advance():
                bar.set_postfix_str(f"part {walk.parts[-1]:.3g}", refresh=False)
                bar.update()
            bar.reset(total=len(walk.parts))
            bar.set_postfix_str("stability")
            trajectory = path().trajectory
            for row in range(len(walk.parts)) if with_stability else ():
                try:
                    directions.append(stability(trajectory, row).unstable_directions)
                except ValueError:  # not decided
                    directions.append(-1)
                bar.update()
        except KeyboardInterrupt as stop:
            stop.best = path()  # type: ignore[attr-defined]
            raise
    return path()


class _PathPoints:
    """The points of a path that have been computed."""

    def __init__(self, system: System, settings: Settings, ends: tuple[Any, Any], nodes: np.ndarray):
        self.system, self.settings, self.ends = system, settings, ends
        y = np.asarray(still_state(system, settings.space, ends[0], nodes).y)
        self.y, self.parts, self.errors = [y], [0.0], [0.0]
        zero = np.zeros_like(self.y[0])
        y, _, _, _, tangent = _correct(system, settings, ends, (y, 0.0), (zero, 1.0))
        self.tangent, self.step, self.complete = tangent, FIRST, False

    def advance(self) -> bool:
        """Add a point; return False if none is found."""
        while self.step >= SHORTEST:
            y, part = self.y[-1], self.parts[-1]
            ty, tp = self.tangent
            guess = (y + self.step * ty, part + self.step * tp)
            if guess[1] >= 1.0 > part:
                # the last point is at the last control
                share = (1.0 - part) / (guess[1] - part)
                guess = (y + share * self.step * ty, 1.0)
                tangent = np.zeros_like(y), 1.0
            else:
                tangent = self.tangent
            found = _correct(self.system, self.settings, self.ends, guess, tangent)
            y_new, part_new, error, count, (way, rate) = found
            if error <= self.settings.newton.acceptable:
                scale = np.asarray(self.system.scales().y)
                sign = 1.0 if np.mean(way / scale * ty / scale) + rate * tp > 0.0 else -1.0
                self.tangent = (sign * way, sign * rate)
                self.y.append(y_new)
                self.parts.append(part_new)
                self.errors.append(error)
                self.complete = guess[1] == 1.0
                self.step *= 1.5 if count <= FEW else 0.5 if count >= MANY else 1.0
                self.step = min(self.step, LONGEST)
                return True
            self.step /= 3.0
        return False


@functools.partial(jax.jit, static_argnames="settings")
def _linearise(system, settings, ends, y, part):  # type: ignore[no-untyped-def]
    """Return the residuals of pieces, tip and base, and their derivatives by the part.

    Then those of pieces by y at their starts and ends, of the base by its unknowns, and of the tip by y.
    """
    unknowns = unknowns_of(system, y[0])

    def problem_at(part: Any) -> StepProblem:
        return StepProblem.still(system, settings.space, ends[0] + part * (ends[1] - ends[0]))

    def residuals(part: Any) -> Any:
        problem = problem_at(part)
        return *problem.residuals(y), problem.base(unknowns) - y[0]

    found, by_part = jax.jvp(residuals, (part,), (jnp.ones(()),))
    problem = problem_at(part)
    at_ends = jax.jacfwd(problem.base)(unknowns), jax.jacfwd(problem.tip_residual)(y[-1])
    return found, by_part, problem.linearise(y), at_ends


class _PathElimination:
    """The linear equations of a correction, eliminated from base to tip.

    δy_0 = S δξ + base, δy_{j+1} = A δy_j + B δy_{j+1} + r_j and M δy_N = -tip. As in the engine, every
    solution is δy_j = X_j α_j + w_j, with α_j the values at point j of the unknowns of the base.
    """

    def __init__(self, A: np.ndarray, B: np.ndarray, S: np.ndarray, M: np.ndarray, *, pivots: np.ndarray):
        self.G, self.S, self.M, self.pivots = np.linalg.inv(np.eye(A.shape[-1]) - B), S, M, pivots
        self.F, self.X, self.T = self.G @ A, [S], list[np.ndarray]()
        for F in self.F:
            X = F @ self.X[-1]
            self.T.append(np.linalg.inv(X[pivots]))
            self.X.append(X @ self.T[-1])

    def solved(self, inverse: np.ndarray, r: np.ndarray, tip: np.ndarray, base: np.ndarray) -> np.ndarray:
        """Return δy (points, y), by the inverse of M X at the tip."""
        ws, betas = [base], list[np.ndarray]()
        for F, X, added in zip(self.F, self.X[1:], np.einsum("jik,jk->ji", self.G, r), strict=True):
            w = F @ ws[-1] + added
            betas.append(w[self.pivots])
            ws.append(w - X @ betas[-1])
        alphas = [-inverse @ (tip + self.M @ ws[-1])]
        for T, beta in zip(reversed(self.T), reversed(betas), strict=True):
            alphas.append(T @ (alphas[-1] - beta))
        return np.stack([w + X @ alpha for w, X, alpha in zip(ws, self.X, reversed(alphas), strict=True)])


def _directions(
    system: System, settings: Settings, ends: tuple[Any, Any], y: np.ndarray, part: float
) -> tuple[float, np.ndarray, np.ndarray]:
    """Return the error of the residuals, and the changes of y that remove them or follow the load."""
    given = jax.tree.map(np.asarray, _linearise(system, settings, ends, y, part))
    (defects, tip, base), moved, pieces, at_ends = given
    scales = system.scales()
    scale, rows = np.asarray(scales.y), np.asarray(scales.tip)
    error = float(np.maximum(np.max(np.abs(defects) / scale), np.max(np.abs(tip) / rows)))
    try:
        pivots = np.asarray(system.y_layout.indices(system.base_unknowns))
        rod = _PathElimination(*pieces, *at_ends, pivots=pivots)
        at_tip, columns = rod.M @ rod.X[-1], scale[rod.pivots]
        # of a neutral family, the smallest solutions
        inverse = np.linalg.pinv(at_tip * columns / rows[:, None], NEUTRAL)
        inverse = columns[:, None] * inverse / rows
        follow = rod.solved(inverse, *moved)
        left = np.max(np.abs(moved[1] + rod.M @ follow[-1]) / rows)
        if left > DRIVEN * np.sqrt(np.mean((follow / scale) ** 2)):
            inverse = np.linalg.inv(at_tip)
            follow = rod.solved(inverse, *moved)
        return error, rod.solved(inverse, defects, tip, base), follow
    except np.linalg.LinAlgError:
        return np.inf, np.zeros_like(y), np.zeros_like(y)


def _correct(
    system: System,
    settings: Settings,
    ends: tuple[Any, Any],
    start: tuple[np.ndarray, float],
    tangent: tuple[np.ndarray, float],
) -> tuple[np.ndarray, float, float, int, tuple[np.ndarray, float]]:
    """Return y, part, error, corrections and the new tangent, by Newton's method across the tangent."""
    scale, (ty, tp), (y, part) = np.asarray(system.scales().y), tangent, start

    def along(change: np.ndarray) -> float:
        return float(np.mean(ty / scale * change / scale))

    for count in range(MOST_CORRECTIONS + 1):
        error, remove, follow = _directions(system, settings, ends, y, part)
        across = along(y - start[0]) + tp * (part - start[1])
        solved = error <= settings.newton.tolerance and abs(across) <= 1e-9
        if solved or count == MOST_CORRECTIONS or not error < LARGEST_ERROR:
            break
        change = -(across + along(remove)) / (along(follow) + tp)
        y, part = y + remove + change * follow, part + change
    size = float(np.sqrt(np.mean((follow / scale) ** 2) + 1.0))
    return y, part, error, count, (follow / size, 1.0 / size)


def _trajectory(system: System, settings: Settings, walk: _PathPoints) -> Trajectory:
    controls = walk.ends[0] + np.array(walk.parts)[:, None] * (walk.ends[1] - walk.ends[0])
    rows = [node_values(system, settings, control, y) for control, y in zip(controls, walk.y, strict=True)]
    y, z = (np.stack([np.asarray(row[k]) for row in rows]) for k in (0, 1))
    count = len(rows)
    return Trajectory(
        system=system,
        settings=settings,
        time=np.arange(float(count)),
        y=y,
        z=z,
        control=controls,
        result=np.full(count, int(Result.CONVERGED)),
        residual=np.array(walk.errors),
        iterations=np.zeros(count, dtype=int),
    )
