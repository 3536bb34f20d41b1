"""Tasks in which the tip reaches a pose: in the open, or past obstacles."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Float

from knode_cosserat.control import ControlLimits
from knode_cosserat.envs.tasks.base import Task, Tip
from knode_cosserat.envs.tasks.survey import Survey, check_reachable, surveyed
from knode_cosserat.rods.system import System


class PoseGoal(NamedTuple):
    """A pose to reach: position (m), and unit tangent."""

    position: Float[Any, "3"]
    tangent: Float[Any, "3"]


@dataclasses.dataclass(frozen=True)
class Reach(Task):
    """Reach a pose with the tip, and hold it. Poses are equilibria, so that each can be reached.

    Attributes:
        position: a fixed position (m) instead of random ones; the tangent does not count then.
        arm: error of the position (m) that counts like an error of the tangent of 1 rad.
    """

    name: ClassVar[str] = "reach"
    target_size: ClassVar[int] = 6

    position: tuple[float, float, float] | None = None
    arm: float = 0.05

    def survey(self, robot: System, limits: ControlLimits, seed: int) -> Survey:
        """Return reachable poses.

        Raises:
            TaskError: the fixed position cannot be reached.
        """
        found = surveyed(robot, limits, seed)
        if self.position is not None:
            check_reachable(robot, limits, self.position)
        return found

    def draw(self, key: Any, survey: Survey) -> PoseGoal:
        """Return a random pose of the survey, or the fixed one."""
        k = jax.random.randint(key, (), 0, survey.position.shape[0])
        position = survey.position[k] if self.position is None else jnp.asarray(self.position, dtype=float)
        return PoseGoal(position, survey.tangent[k])

    def target(self, goal: PoseGoal, t: Any) -> Float[Any, "6"]:
        """Return the wanted position (m) and tangent of the tip."""
        return jnp.concatenate([goal.position, goal.tangent])

    def error(self, goal: PoseGoal, t: Any, tip: Tip) -> Any:
        """Return the distance of the tip (m), and in addition `arm` times the error of its tangent."""
        apart = jnp.sqrt(jnp.sum((tip.position - goal.position) ** 2) + 1e-18)
        if self.position is not None:
            return apart
        # chord between unit vectors: the angle for small angles, and smooth at zero
        turned = jnp.sqrt(jnp.sum((tip.tangent - goal.tangent) ** 2) + 1e-18)
        return apart + self.arm * turned
