"""Tasks in which the tip follows a moving point."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.envs.errors import TaskError
from knode_cosserat.envs.randomisation import Factor, Randomisation, Uniform
from knode_cosserat.envs.tasks.base import Task, Tip, with_part
from knode_cosserat.envs.tasks.survey import Survey
from knode_cosserat.rods.loads import AttachedMass
from knode_cosserat.rods.system import System


class PathGoal(NamedTuple):
    """A closed path across the tip's direction at rest, followed from its centre outwards."""

    centre: Float[Any, "3"]
    across: Float[Any, "2 3"]
    #: half-widths (m), angular frequencies (rad/s) and phases (rad)
    width: Float[Any, "2"]
    frequency: Float[Any, "2"]
    phase: Float[Any, "2"]


@dataclasses.dataclass(frozen=True)
class Follow(Task):
    """Follow a moving point with the tip: ellipses and figures of eight.

    The distance along the tip's direction at rest does not count.

    Attributes:
        period: shortest and longest time of one turn (s).
        width: least and greatest half-width, as parts of the distance that is easy to reach.
        rise: time in which the path grows from its centre (s).
    """

    name: ClassVar[str] = "follow"

    period: tuple[float, float] = (3.0, 6.0)
    width: tuple[float, float] = (0.3, 0.9)
    rise: float = 2.0

    def __post_init__(self) -> None:
        super().__post_init__()
        for label in ("period", "width"):
            low, high = getattr(self, label)
            if not 0.0 < low <= high < np.inf:
                raise TaskError(f"{label} is {getattr(self, label)!r}; allowed are two positive numbers")

    def draw(self, key: Any, survey: Survey) -> PathGoal:
        """Return a random path."""
        part = jax.random.uniform(key, (5,))
        (short, long), (thin, wide) = self.period, self.width
        frequency = 2.0 * np.pi / (short + part[0] * (long - short))
        width = (thin + part[1:3] * (wide - thin)) * survey.reach
        eight = part[3] < 0.5
        turns = jnp.where(eight, jnp.array([1.0, 2.0]), jnp.ones(2))
        phase = jnp.where(eight, jnp.zeros(2), jnp.array([0.0, 0.5 * np.pi]))
        # an eight is lower than wide, and may be run through backwards
        sign = jnp.where(part[4] < 0.5, 1.0, -1.0)
        width = width * jnp.where(eight, jnp.array([1.0, 0.5]), jnp.ones(2)) * jnp.stack([sign, 1.0])
        return PathGoal(survey.origin, survey.frame[:2], width, frequency * turns, phase)

    def target(self, goal: PathGoal, t: Any) -> Float[Any, "3"]:
        """Return the wanted position of the tip (m)."""
        part = jnp.clip(t / self.rise, 0.0, 1.0) if self.rise else 1.0
        eased = part**3 * (10.0 - 15.0 * part + 6.0 * part**2)
        along = eased * goal.width * jnp.sin(goal.frequency * t + goal.phase)
        return goal.centre + along @ goal.across

    def error(self, goal: PathGoal, t: Any, tip: Tip) -> Any:
        """Return the distance (m) of the tip from the target, across the tip's direction at rest."""
        return jnp.sqrt(jnp.sum((goal.across @ (tip.position - self.target(goal, t))) ** 2) + 1e-18)

    def tracked(self, survey: Survey) -> np.ndarray:
        """Return True for the coordinates that count: all but the one nearest to the tip's direction."""
        return np.arange(3) != np.argmax(np.abs(np.asarray(survey.frame)[2]))


@dataclasses.dataclass(frozen=True)
class Payload(Follow):
    """Follow with an unknown mass at the tip, which may change within an episode.

    Attributes:
        mass: greatest mass (kg).
    """

    name: ClassVar[str] = "payload"
    adapted: ClassVar[tuple[str, ...]] = ("loads.0.mass",)

    mass: float = 0.03

    def equipped(self, robot: System) -> System:
        """Return the robot with a mass at its tip, zero at first."""
        return with_part(robot, "loads", AttachedMass(), "payload")

    def randomisation(self) -> Randomisation:
        """Return the distribution of the mass."""
        return Randomisation({"loads.0.mass": Uniform(0.0, self.mass)}, change=0.5)


@dataclasses.dataclass(frozen=True)
class Adaptation(Follow):
    """Follow with a robot whose stiffness, damping and weight are unknown, and may change in an episode."""

    name: ClassVar[str] = "adaptation"
    adapted: ClassVar[tuple[str, ...]] = ("youngs_modulus",)

    def randomisation(self) -> Randomisation:
        """Return the distributions of the parameters."""
        names = {"youngs_modulus": (0.6, 1.4), "bending_damping": (0.5, 2.0), "density": (0.8, 1.5)}
        return Randomisation({name: Factor(*ends) for name, ends in names.items()}, change=0.5)
