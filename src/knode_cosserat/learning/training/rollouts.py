"""Whole simulations compared with trajectories: the loss of fine-tuning, and the held-out error.

Only the compared fields of a trajectory must be known. Every solved step is differentiable by the implicit
function theorem (`solvers.sensitivity`), so that any residual can be trained in this way.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.learning.config import RolloutTraining
from knode_cosserat.learning.knode import KNODE
from knode_cosserat.learning.samples import DataError, samples, settings_of
from knode_cosserat.rods.layout import Layout
from knode_cosserat.rods.system import System
from knode_cosserat.solvers.settings import Settings
from knode_cosserat.solvers.simulate import simulate
from knode_cosserat.trajectory import Trajectory

#: fields compared by default, if the system has them
POSE = ("p", "h")


class InitialRows(NamedTuple):
    """Rows of trajectories (B) up to the initial row of the simulations."""

    time: Float[Any, "B rows"]
    y: Float[Any, "B rows nodes y"]
    z: Float[Any, "B rows nodes z"]
    control: Float[Any, "B rows c"]


class TrajectoryBatch(NamedTuple):
    """Trajectories (B) of one length: controls and target states."""

    past: InitialRows | None
    control: Float[Any, "B T c"]
    #: row 0 is the initial state of the simulations
    y: Float[Any, "B T+1 nodes y"]


@dataclasses.dataclass(frozen=True)
class TrajectoryBatches:
    """All trajectories, grouped by length, with the settings of their simulation."""

    parts: tuple[TrajectoryBatch, ...]
    compared: tuple[str, ...]
    settings: Settings
    dt: float


def trajectory_batches(
    knowledge: System, trajectories: Sequence[Trajectory], options: RolloutTraining, what: str = ""
) -> TrajectoryBatches:
    """Return trajectories prepared for simulation and comparison; `what` precedes their number in messages.

    Raises:
        DataError: a trajectory does not fit the nominal model or the others, is too short, begins in motion,
            or is not finite where it is used.
    """
    compared = _checked_names(knowledge, options.compared)
    first = options.first_row
    try:
        samples(knowledge, [_relevant(knowledge, one, compared, first) for one in trajectories])
    except DataError as error:
        raise DataError(f"{what}{error}") from None
    by_length: dict[int, list[TrajectoryBatch]] = {}
    for k, trajectory in enumerate(trajectories):
        name = f"{what}trajectory {k}"
        if first is None and float(trajectory.time[0]) != 0.0:
            raise DataError(
                f"{name} begins at {float(trajectory.time[0]):g} s, in motion; simulations start at rest, at "
                "time 0, unless RolloutTraining.first_row says where"
            )
        start, rows = first or 0, len(trajectory.time)
        stop = min(rows, start + 1 + (options.horizon or rows))
        if stop - start < 2:
            raise DataError(f"{name} has {rows} rows; after row {start} there must be at least one more")
        part = _course(trajectory, first, start, stop)
        by_length.setdefault(stop, []).append(part)
    joined = [jax.tree.map(lambda *leaves: np.stack(leaves), *parts) for parts in by_length.values()]
    settings = settings_of(trajectories[0])
    return TrajectoryBatches(tuple(joined), compared, settings, trajectories[0].dt)


def _course(trajectory: Trajectory, first: int | None, start: int, stop: int) -> TrajectoryBatch:
    arrays = (trajectory.time, trajectory.y, trajectory.z, trajectory.control)
    time, y, z, control = (np.asarray(array, dtype=float) for array in arrays)
    before = slice(0, start + 1)
    past = None if first is None else InitialRows(time[before], y[before], z[before], control[before])
    return TrajectoryBatch(past, control[start + 1 : stop], y[start:stop])


def _checked_names(knowledge: System, given: tuple[str, ...] | None) -> tuple[str, ...]:
    known = knowledge.y_layout.names
    # a strand's number may follow
    pose = tuple(name for name in known if name.rstrip("0123456789") in POSE)
    names = pose if given is None else given
    for name in names:
        if name not in known:
            raise DataError(f"RolloutTraining.compared has {name!r}; y has {', '.join(known)}")
    if not names:
        raise DataError(f"y has no p or h; RolloutTraining.compared must say which of {', '.join(known)}")
    return names


def _relevant(knowledge: System, trajectory: Any, names: tuple[str, ...], first: int | None) -> Any:
    """Return a trajectory with zeros in all unused values, which may be unknown."""
    if not isinstance(trajectory, Trajectory) or np.ndim(trajectory.y) != 3:
        return trajectory
    y, z = np.array(trajectory.y, dtype=float), np.array(trajectory.z, dtype=float)
    after = slice(0 if first is None else first + 1, None)
    if y.shape[-1] == knowledge.y_layout.size:
        others = [name for name in knowledge.y_layout.names if name not in names]
        if others:
            y[after, :, knowledge.y_layout.indices(tuple(others))] = 0.0
    z[after] = 0.0
    return dataclasses.replace(trajectory, y=y, z=z)


# simulating


def simulated_batch(
    model: System, course: TrajectoryBatch, settings: Settings, dt: float
) -> Float[Any, "B T+1 nodes y"]:
    """Return y of all trajectories simulated by the model, one after the other; NaN in unsolved steps."""

    def one(given: Any) -> Any:
        past, control = given
        initial = None
        if past is not None:
            none, zero = jnp.zeros(past.time.shape[0], dtype=int), jnp.zeros(past.time.shape[0])
            initial = Trajectory(
                model, settings, past.time, past.y, past.z, past.control, none, zero, iterations=none
            )
        return simulate(
            model, control, dt, space=settings.space, start=settings.start, newton=settings.newton,
            between=settings.between, initial=initial, time=settings.time,  # type: ignore[arg-type]  # None is refused there
        ).y  # fmt: skip

    return jax.lax.map(one, (course.past, course.control))


@functools.partial(jax.jit, static_argnames=("settings", "dt"))
def _tip_errors(model: System, parts: tuple[TrajectoryBatch, ...], settings: Settings, dt: float) -> Any:
    errors = []
    for course in parts:
        found = model.drawing.positions(simulated_batch(model, course, settings, dt)[:, :, -1])
        distance = jnp.sum((found - model.drawing.positions(course.y[:, :, -1])) ** 2, axis=-1)
        errors.append(jnp.sqrt(jnp.mean(distance, axis=-1)))
    return jnp.concatenate(errors)


def held_out_batches(knowledge: System, trajectories: Sequence[Trajectory]) -> TrajectoryBatches | None:
    """Return trajectories to simulate from rest and compare at the tip; None if there are none.

    Raises:
        DataError: as for `trajectory_batches`, or the system has no positions.
    """
    if not trajectories:
        return None
    known = knowledge.y_layout.names
    places = tuple(name for name in known if name.rstrip("0123456789") == "p")
    if not places:
        raise DataError(f"held-out rollouts need positions; y has {', '.join(known)}")
    return trajectory_batches(knowledge, trajectories, RolloutTraining(compared=places), what="held-out ")


def tip_error(model: System, courses: TrajectoryBatches) -> float:
    """Return the rms tip error (m), averaged over trajectories; infinite if a step is not solved."""
    errors = np.asarray(_tip_errors(model, courses.parts, courses.settings, courses.dt))
    return float(np.mean(errors)) if np.all(np.isfinite(errors)) else float("inf")


# the loss


def scales(courses: TrajectoryBatches, layout: Layout) -> tuple[float, ...]:
    """Return the scale of each compared field's errors: the rms of its motion."""
    found = []
    for name in courses.compared:
        values = [layout.get(part.y, name) for part in courses.parts]
        moves = [np.mean(np.var(value, axis=1)) * len(value) for value in values]
        scale = float(np.sqrt(sum(moves) / sum(map(len, values))))
        found.append(scale if scale > 1e-12 else 1.0)
    return tuple(found)


class RolloutTargets(NamedTuple):
    """Targets and scales of the loss."""

    knowledge: System
    rest: Any
    parts: tuple[TrajectoryBatch, ...]
    scales: Any


@functools.partial(jax.jit, static_argnames=("compared", "settings", "dt"))
def loss_and_slope(
    weights: Any, aim: RolloutTargets, compared: tuple[str, ...], settings: Settings, dt: float
) -> tuple[Float[Any, ""], Any]:
    """Return the rollout loss of a residual's weights and its gradient; NaN if a step is not solved.

    The loss is the mean of squared errors, each over its field's scale, over trajectories, rows (without the
    first), nodes and numbers, then over fields. Quaternions are normalised, and compared up to their sign.
    """

    def loss(weights: Any) -> Any:
        model = KNODE(aim.knowledge, eqx.combine(weights, aim.rest))
        total, count = jnp.zeros(()), 0
        for course in aim.parts:
            found = simulated_batch(model, course, settings, dt)[:, 1:]
            for i, name in enumerate(compared):
                pair = (model.y_layout.get(y, name) for y in (found, course.y[:, 1:]))
                error = _difference(name, *pair) / aim.scales[i]
                total = total + jnp.mean(error**2) * course.y.shape[0]
            count += course.y.shape[0]
        return total / (count * len(compared))

    return jax.value_and_grad(loss)(weights)


def _difference(name: str, found: Any, truth: Any) -> Any:
    if name != "h" or found.shape[-1] != 4:
        return found - truth
    found, truth = (h / jnp.sqrt(jnp.sum(h * h, axis=-1, keepdims=True)) for h in (found, truth))
    same = jnp.sum(found * truth, axis=-1, keepdims=True) >= 0.0
    return found - jnp.where(same, truth, -truth)
