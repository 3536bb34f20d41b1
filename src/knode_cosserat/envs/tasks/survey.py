"""Survey of a robot: poses that it can reach, from equilibria under random controls."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.control import ControlLimits
from knode_cosserat.envs.errors import TaskError
from knode_cosserat.rods.system import System
from knode_cosserat.rotation import rotation_matrix
from knode_cosserat.solvers.equilibrium import equilibrium
from knode_cosserat.statics.reach import inverse_kinematics

#: number of random controls whose equilibria are computed for a survey
SURVEYED = 64
#: of the survey's lateral distances from the tip at rest, the quantile that counts as within easy reach
EASY = 0.5


class Survey(NamedTuple):
    """Reachable poses of a robot: equilibria under random controls."""

    #: position of the tip (m) and unit vectors of its frame at rest, the tangent last
    origin: Float[Any, "3"]
    frame: Float[Any, "3 3"]
    #: positions of the tip (m), its tangents, and positions under half of each control
    position: Float[Any, "n 3"]
    tangent: Float[Any, "n 3"]
    halfway: Float[Any, "n 3"]
    #: lateral distance (m) that is easy to reach
    reach: Float[Any, ""]


def surveyed(robot: System, limits: ControlLimits, seed: int) -> Survey:
    """Return a survey of a robot, from equilibria under random controls within their limits.

    Raises:
        TaskError: no equilibrium was found.
    """
    random = np.random.default_rng(seed)
    low, high = np.asarray(limits.low), np.asarray(limits.high)
    controls = low + random.uniform(size=(SURVEYED, len(low))) * (high - low)
    # the middle of the range is the rest of tendons that pull alike
    middle = np.tile(np.asarray(limits.safe), (SURVEYED, 1))
    every = np.concatenate([controls, 0.5 * (controls + middle), middle[:1]])
    found = equilibrium(robot, every, on_failure="return")
    y = np.asarray(found.y)[:, -1, -1]
    valid = np.asarray(found.result)[:, -1] >= 0
    usable = valid[:SURVEYED] & valid[SURVEYED:-1]
    if not valid[-1] or not np.any(usable):
        raise TaskError(
            f"{type(robot).__name__} has no equilibrium under "
            f"{'the safe controls' if not valid[-1] else 'any of the random controls'} "
            f"({limits.safe.tolist()}); give other limits"
        )
    position = np.asarray(robot.positions(y))
    frame = frames(robot, y)
    origin, lateral = position[-1], frame[-1][:2]
    apart = np.linalg.norm((position[:SURVEYED][usable] - origin) @ lateral.T, axis=1)
    return Survey(
        origin, frame[-1], position[:SURVEYED][usable], frame[:SURVEYED, 2][usable],
        position[SURVEYED:-1][usable], np.quantile(apart, EASY),
    )  # fmt: skip


def frames(robot: System, y: Float[np.ndarray, "n y"]) -> Float[np.ndarray, "n 3 3"]:
    """Return the unit vectors of cross-sections, the tangent last; those of the axes if there are none."""
    try:
        h = robot.quaternions(y)
    except AttributeError:
        return np.tile(np.eye(3), (len(y), 1, 1))
    return np.swapaxes(np.asarray(jax.vmap(rotation_matrix)(jnp.asarray(h))), 1, 2)


def check_reachable(robot: System, limits: ControlLimits, position: Any) -> None:
    """Check that an equilibrium within limits has its tip at a position (m). Raises `TaskError`."""
    wanted, length = np.asarray(position, dtype=float), float(np.max(robot.nominal.length))
    if wanted.shape != (3,) or not np.all(np.isfinite(wanted)):
        raise TaskError(f"the target is {position!r}; allowed are three finite numbers (m)")
    found = inverse_kinematics(robot, wanted, low=limits.low, high=limits.high)
    if found.result < 0:
        raise TaskError(
            f"the target {wanted.tolist()} m cannot be reached: the nearest position found is "
            f"{float(found.position_error):.3g} m away (the robot is {length:g} m long); choose another "
            "target, or wider limits"
        )
