"""Base of tasks: what is drawn for an episode, what is wanted at each time, and what it is worth.

A task is a small frozen object without arrays. Facts about a robot that need equilibria, such as reachable
poses, are computed once (`survey`). Everything else is a pure function on JAX.
"""

from __future__ import annotations

import abc
import dataclasses
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.control import ControlLimits, Reference
from knode_cosserat.envs.errors import TaskError
from knode_cosserat.envs.randomisation import Randomisation
from knode_cosserat.envs.tasks.survey import Survey, surveyed
from knode_cosserat.rods.system import System


class Tip(NamedTuple):
    """Pose of the tip: position (m), and unit tangent."""

    position: Float[Any, "3"]
    tangent: Float[Any, "3"]


class Outcome(NamedTuple):
    """Reward of a step, True if the episode ended by success or failure, and the error (m)."""

    reward: Any
    terminated: Any
    error: Any


@dataclasses.dataclass(frozen=True)
class Task(abc.ABC):
    """A task. Subclasses define `draw`, `target` and `observation`.

    Attributes:
        scale: error at which the reward falls to 1/e, as a part of the robot's length.
    """

    name: ClassVar[str]
    #: number of numbers in a target: 3 for a position, 6 for a position and a tangent
    target_size: ClassVar[int] = 3
    #: number of numbers in `observation`
    observed: ClassVar[int] = 0
    #: parameters that the reference controller adapts, if they are randomised
    adapted: ClassVar[tuple[str, ...]] = ()
    #: True if `placed` changes the robot from episode to episode
    moves_parts: ClassVar[bool] = False

    scale: float = 0.1

    def __post_init__(self) -> None:
        if not 0.0 < self.scale < np.inf:
            raise TaskError(f"scale is {self.scale!r}; allowed is a positive part of the length")

    def equipped(self, robot: System) -> System:
        """Return the robot with the parts that the task needs, such as obstacles; by default unchanged."""
        return robot

    def randomisation(self) -> Randomisation:
        """Return the default domain randomisation; by default none."""
        return Randomisation()

    def survey(self, robot: System, limits: ControlLimits, seed: int) -> Survey:
        """Return facts about the robot, from equilibria under random controls."""
        return surveyed(robot, limits, seed)

    def placed(self, system: System, goal: Any) -> System:
        """Return the system with the parts of an episode, such as its obstacles; by default unchanged."""
        return system

    @abc.abstractmethod
    def draw(self, key: Any, survey: Survey) -> Any:
        """Return the goal of an episode, a pytree of arrays."""

    @abc.abstractmethod
    def target(self, goal: Any, t: Any) -> Float[Any, " p"]:
        """Return the wanted pose at a time (s)."""

    def error(self, goal: Any, t: Any, tip: Tip) -> Any:
        """Return the error of the tip (m) at a time (s): by default its distance from the target."""
        return jnp.sqrt(jnp.sum((tip.position - self.target(goal, t)[:3]) ** 2) + 1e-18)

    def outcome(self, goal: Any, t: Any, tip: Tip, clearance: Any, length: Any) -> Outcome:
        """Return the outcome of a step that ends at a time (s).

        Args:
            goal: of the episode.
            t: time (s).
            tip: pose of the tip.
            clearance: least distance (m) of the robot from obstacles; infinite without obstacles.
            length: of the robot (m).
        """
        error = self.error(goal, t, tip)
        return Outcome(jnp.exp(-error / (self.scale * length)), jnp.array(False), error)

    def observation(self, goal: Any, survey: Survey, length: Any) -> Float[Any, " o"]:
        """Return what is observed of the goal beside the target; by default nothing."""
        return jnp.zeros(0)

    def reference(self, goal: Any, survey: Survey) -> Reference:
        """Return the target of an episode as a reference of a controller; NaN for free coordinates."""

        def values(times: Any) -> Any:
            found = jax.vmap(lambda t: self.target(goal, t)[:3])(jnp.asarray(times))
            return np.where(self.tracked(survey), np.asarray(found), np.nan)

        return Reference(values, 3, self.name)

    def tracked(self, survey: Survey) -> np.ndarray:
        """Return True for the coordinates of the tip's position that count."""
        return np.array([True, True, True])


def with_part(robot: System, place: str, part: Any, task: str) -> Any:
    """Return the robot with one more part before its own ones. Raises `TaskError` if it has no such parts."""
    own = getattr(robot.nominal, place, None)
    if own is None:
        raise TaskError(f"the task {task} needs a robot with {place}; {type(robot).__name__} has none")
    return robot.replace(**{place: (part, *own)})
