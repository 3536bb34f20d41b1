"""Tasks in which the tip reaches a position past obstacles that the robot may touch."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.control import Reference, table
from knode_cosserat.envs.errors import TaskError
from knode_cosserat.envs.tasks.base import Outcome, Task, Tip, with_part
from knode_cosserat.envs.tasks.survey import Survey
from knode_cosserat.rods.surroundings import Sphere
from knode_cosserat.rods.system import System

#: reward while the robot touches an obstacle, as a part of the reward without contact
TOUCHING = 0.5


class CourseGoal(NamedTuple):
    """A position to reach (m), and the centres of the obstacles before it."""

    position: Float[Any, "3"]
    centres: Float[Any, "k 3"]
    #: unit vector across the direct path, along which the course is passed
    aside: Float[Any, "3"]


@dataclasses.dataclass(frozen=True)
class Pillar(Task):
    """Reach a position behind a ball, which stands in the middle of the direct path.

    Contact is physical: see `rods.surroundings`. A touch halves the reward.

    Attributes:
        radius: of the balls (m).
        stiffness: of contact (N/m²).
        softness: depth over which contact sets in (m).
    """

    name: ClassVar[str] = "pillar"
    #: number of balls
    count: ClassVar[int] = 1
    moves_parts: ClassVar[bool] = True

    radius: float = 0.02
    stiffness: float = 2e3
    softness: float = 2e-3

    def __post_init__(self) -> None:
        super().__post_init__()
        for label in ("radius", "stiffness", "softness"):
            if not 0.0 < getattr(self, label) < np.inf:
                raise TaskError(f"{label} is {getattr(self, label)!r}; allowed is a positive number")

    @property
    def observed(self) -> int:  # type: ignore[override]
        """Number of numbers in `observation`."""
        return 3 * self.count

    def equipped(self, robot: System) -> System:
        """Return the robot with the balls in its surroundings."""
        ball = Sphere(radius=self.radius, stiffness=self.stiffness, smoothing=self.softness)
        for _ in range(self.count):
            robot = with_part(robot, "surroundings", ball, self.name)
        return robot

    def placed(self, system: System, goal: CourseGoal) -> System:
        """Return the system with the balls of an episode."""
        return system.replace(**{f"surroundings.{k}.center": goal.centres[k] for k in range(self.count)})

    def draw(self, key: Any, survey: Survey) -> CourseGoal:
        """Return a position of the survey with balls before it; positions near the rest are left out."""
        one, two = jax.random.split(key)
        lateral = (survey.position - survey.origin) @ survey.frame[:2].T
        far = jnp.sum(lateral**2, axis=-1) >= survey.reach**2
        k = jax.random.choice(one, len(far), p=far / jnp.sum(far))
        position, middle = survey.position[k], survey.halfway[k]
        ahead = position - survey.origin
        tangent = survey.frame[2]
        aside = jnp.cross(tangent, ahead)
        aside = aside / jnp.sqrt(jnp.sum(aside**2) + 1e-18)
        side = jnp.where(jax.random.uniform(two) < 0.5, 1.0, -1.0)
        return CourseGoal(position, self._centres(middle, side * aside), side * aside)

    def _centres(self, middle: Any, aside: Any) -> Float[Any, "k 3"]:
        # a little off the path: which way is shorter is then certain
        return (middle - 0.3 * self.radius * aside)[None]

    def target(self, goal: CourseGoal, t: Any) -> Float[Any, "3"]:
        """Return the wanted position of the tip (m)."""
        return goal.position

    def outcome(self, goal: CourseGoal, t: Any, tip: Tip, clearance: Any, length: Any) -> Outcome:
        """Return the outcome of a step that ends at a time (s)."""
        found = super().outcome(goal, t, tip, clearance, length)
        return found._replace(reward=found.reward * jnp.where(clearance < 0.0, TOUCHING, 1.0))

    def observation(self, goal: CourseGoal, survey: Survey, length: Any) -> Float[Any, " o"]:
        """Return the centres of the balls from the tip at rest, in lengths of the robot."""
        return ((goal.centres - survey.origin) / length).ravel()

    def waypoint(self, goal: CourseGoal) -> Float[np.ndarray, "3"]:
        """Return a position (m) on the way that is clear of the balls."""
        return np.asarray(goal.centres[0] + 2.5 * self.radius * goal.aside)

    def reference(self, goal: CourseGoal, survey: Survey) -> Reference:
        """Return a path by the way point to the target; 1 s to each."""
        points = [np.asarray(survey.origin), self.waypoint(goal), np.asarray(goal.position)]
        return table([0.0, 1.0, 2.0], points)


@dataclasses.dataclass(frozen=True)
class Gate(Pillar):
    """Reach a position behind a gate of two balls, whose middle is off the direct path.

    Attributes:
        gap: free width between the balls (m).
    """

    name: ClassVar[str] = "gate"
    count: ClassVar[int] = 2

    gap: float = 0.05

    def _centres(self, middle: Any, aside: Any) -> Float[Any, "k 3"]:
        between = middle + (0.5 * self.gap) * aside
        apart = (self.radius + 0.5 * self.gap) * aside
        return jnp.stack([between - apart, between + apart])

    def waypoint(self, goal: CourseGoal) -> Float[np.ndarray, "3"]:
        """Return the middle of the gate (m)."""
        return np.asarray(goal.centres).mean(axis=0)
