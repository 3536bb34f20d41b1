"""Tasks of environments: randomised robots, goals of an episode, and the worth of a step.

A task is a small frozen object without arrays. Facts about a robot that need equilibria, such as reachable
poses, are computed once (`survey`). Everything else is a pure function on JAX.
"""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.control import ControlLimits, Reference, table
from knode_cosserat.errors import KnodeCosseratError
from knode_cosserat.rods.aspects import Drawing
from knode_cosserat.rods.loads import AttachedMass
from knode_cosserat.rods.parameters import ParameterError, value_at
from knode_cosserat.rods.surroundings import Sphere
from knode_cosserat.rods.system import System
from knode_cosserat.rods.wrapped import nominal_model
from knode_cosserat.rotation import rotation_matrix
from knode_cosserat.solvers.equilibrium import equilibrium
from knode_cosserat.statics.reach import inverse_kinematics


class TaskError(KnodeCosseratError, ValueError):
    """An environment that cannot be set up or used as asked; one line says why."""

    code = "environment"


# domain randomisation

#: longest delay of commands, in periods
LONGEST_DELAY = 50


@dataclasses.dataclass(frozen=True)
class Uniform:
    """Uniform distribution of a parameter's value, in its own unit."""

    low: float
    high: float

    def ends(self, value: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return the least and the greatest value of a parameter whose nominal value is `value`."""
        return np.full(np.shape(value), self.low), np.full(np.shape(value), self.high)


@dataclasses.dataclass(frozen=True)
class Factor(Uniform):
    """Uniform distribution of a factor on a parameter's nominal value; one factor for all its numbers."""

    def ends(self, value: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return the least and the greatest value of a parameter whose nominal value is `value`."""
        value = np.asarray(value, dtype=float)
        return self.low * value, self.high * value


@dataclasses.dataclass(frozen=True)
class Randomisation:
    """Distributions from which each episode draws its robot.

        Randomisation({"youngs_modulus": Factor(0.8, 1.2), "loads.0.mass": Uniform(0.0, 0.03)}, noise=5e-4)

    Attributes:
        parameters: distribution of each parameter, by its name in `System.replace`.
        change: probability that an episode draws the parameters again, at a random time within it.
        delay: least and greatest delay of the commands (periods).
        noise: standard deviation of measured positions (m).
        models: systems with the same structure as the robot, such as members of an ensemble with learned
            residuals; each episode has one of them instead of the robot.
    """

    parameters: Mapping[str, Uniform] = dataclasses.field(default_factory=dict)
    change: float = 0.0
    delay: tuple[int, int] = (0, 0)
    noise: float = 0.0
    models: tuple[System, ...] = ()

    def __post_init__(self) -> None:
        for name, distribution in self.parameters.items():
            if not isinstance(distribution, Uniform):
                raise TaskError(
                    f"the distribution of {name} is {distribution!r}; allowed is Uniform(low, high) or "
                    "Factor(low, high)"
                )
            if not -np.inf < distribution.low <= distribution.high < np.inf:
                raise TaskError(f"the distribution of {name} is {distribution!r}; low must not exceed high")
        if not 0.0 <= self.change <= 1.0:
            raise TaskError(f"change is {self.change!r}; allowed is a probability, 0 to 1")
        least, most = self.delay
        if not 0 <= least <= most <= LONGEST_DELAY or least != int(least) or most != int(most):
            raise TaskError(
                f"delay is {self.delay!r}; allowed are two whole numbers of periods, 0 to {LONGEST_DELAY}, "
                "the least first"
            )
        if not 0.0 <= self.noise < np.inf:
            raise TaskError(f"noise is {self.noise!r}; allowed is zero or more metres")

    def ends(self, robot: System) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
        """Return the least and the greatest value of each parameter of a robot.

        Raises:
            ParameterError: a parameter that does not exist, or a range with values that are not allowed.
        """
        low, high = {}, {}
        for name, distribution in self.parameters.items():
            value = value_at(nominal_model(robot), name)
            if value is None:
                raise ParameterError(
                    f"{name} is not set for this robot, so it cannot be varied; set it with replace first"
                )
            low[name], high[name] = distribution.ends(value)
        for ends in (low, high):
            robot.replace(**ends)
        return low, high


# facts about a robot

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


# the base of tasks


class Tip(NamedTuple):
    """Pose of the tip: position (m), and unit tangent."""

    position: Float[Any, "3"]
    tangent: Float[Any, "3"]


def _norm(vector: Any) -> Any:
    """Return the length of a vector, with a finite derivative at zero."""
    return jnp.sqrt(jnp.sum(vector**2, axis=-1) + 1e-18)


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
        _require_positive(self, "scale")

    def equipped(self, robot: System) -> System:
        """Return the robot with the parts that the task needs, such as obstacles; by default unchanged."""
        return robot

    def randomisation(self) -> Randomisation:
        """Return the default domain randomisation; by default none."""
        return Randomisation()

    def survey(self, robot: System, limits: ControlLimits, seed: int) -> Survey:
        """Return a survey of a robot, from equilibria under random controls within their limits.

        Raises:
            TaskError: no equilibrium was found.
        """
        random = np.random.default_rng(seed)
        low, high = np.asarray(limits.low), np.asarray(limits.high)
        controls = low + random.uniform(size=(SURVEYED, len(low))) * (high - low)
        # the middle of the range is the rest of tendons that pull alike
        middle = np.tile(np.asarray(limits.safe), (SURVEYED, 1))
        equilibria = equilibrium(
            robot, np.concatenate([controls, 0.5 * (controls + middle), middle[:1]]), on_failure="return"
        )
        y = np.asarray(equilibria.y)[:, -1, -1]
        valid = np.asarray(equilibria.result)[:, -1] >= 0
        usable = valid[:SURVEYED] & valid[SURVEYED:-1]
        if not valid[-1] or not np.any(usable):
            controls_name = "any of the random controls" if valid[-1] else "the safe controls"
            raise TaskError(
                f"{type(robot).__name__} has no equilibrium under {controls_name} "
                f"({limits.safe.tolist()}); give other limits"
            )
        position = np.asarray(Drawing.of(robot).positions(y))
        frame = np.tile(np.eye(3), (len(y), 1, 1))
        if "h" in robot.y_layout.names:
            rotation = jax.vmap(rotation_matrix)(jnp.asarray(Drawing.of(robot).quaternions(y)))
            frame = np.swapaxes(np.asarray(rotation), 1, 2)
        reached, lateral = position[:SURVEYED][usable], frame[-1][:2]
        distance = np.linalg.norm((reached - position[-1]) @ lateral.T, axis=1)
        return Survey(
            position[-1],
            frame[-1],
            reached,
            frame[:SURVEYED, 2][usable],
            position[SURVEYED:-1][usable],
            np.quantile(distance, EASY),
        )

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
        return _norm(tip.position - self.target(goal, t)[:3])

    def reward(self, error: Any, clearance: Any, length: Any) -> Any:
        """Return the reward of a period, by default exp(-error / (scale length)).

        Args:
            error: of the tip (m).
            clearance: least distance (m) of the robot from obstacles; infinite without obstacles.
            length: of the robot (m).
        """
        return jnp.exp(-error / (self.scale * length))

    def is_over(self, goal: Any, t: Any, tip: Tip) -> Any:
        """Return True if an episode ends by success or failure at a time (s); by default never."""
        return jnp.array(False)

    def observation(self, goal: Any, survey: Survey, length: Any) -> Float[Any, " o"]:
        """Return what is observed of the goal beside the target; by default nothing."""
        return jnp.zeros(0)

    def reference(self, goal: Any, survey: Survey) -> Reference:
        """Return the target of an episode as a reference of a controller; NaN for free coordinates."""

        def values(times: Any) -> Any:
            rows = jax.vmap(lambda t: self.target(goal, t)[:3])(jnp.asarray(times))
            return np.where(self.tracked(survey), np.asarray(rows), np.nan)

        return Reference(values, 3, self.name)

    def tracked(self, survey: Survey) -> np.ndarray:
        """Return True for the coordinates of the tip's position that count."""
        return np.array([True, True, True])


def _with_parts(robot: System, place: str, parts: Sequence[Any], task: str) -> Any:
    """Return the robot with more parts before its own ones. Raises `TaskError` if it has no such parts."""
    present = getattr(nominal_model(robot), place, None)
    if present is None:
        raise TaskError(f"the task {task} needs a robot with {place}; {type(robot).__name__} has none")
    return robot.replace(**{place: (*parts, *present)})


def _require_positive(task: Task, *names: str) -> None:
    """Raise `TaskError` unless fields of a task are positive numbers, or pairs of them in ascending order."""
    for name in names:
        values = np.atleast_1d(getattr(task, name))
        if not (np.all(values > 0.0) and np.all(np.isfinite(values)) and np.all(np.diff(values) >= 0.0)):
            words = "a positive number" if len(values) == 1 else "two positive numbers"
            raise TaskError(f"{name} is {getattr(task, name)!r}; allowed is {words}")


# following a moving point


class _PathGoal(NamedTuple):
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
        _require_positive(self, "period", "width")

    def draw(self, key: Any, survey: Survey) -> _PathGoal:
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
        return _PathGoal(survey.origin, survey.frame[:2], width, frequency * turns, phase)

    def target(self, goal: _PathGoal, t: Any) -> Float[Any, "3"]:
        """Return the wanted position of the tip (m)."""
        part = jnp.clip(t / self.rise, 0.0, 1.0) if self.rise else 1.0
        eased = part**3 * (10.0 - 15.0 * part + 6.0 * part**2)
        along = eased * goal.width * jnp.sin(goal.frequency * t + goal.phase)
        return goal.centre + along @ goal.across

    def error(self, goal: _PathGoal, t: Any, tip: Tip) -> Any:
        """Return the distance (m) of the tip from the target, across the tip's direction at rest."""
        return _norm(goal.across @ (tip.position - self.target(goal, t)))

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
        return _with_parts(robot, "loads", [AttachedMass()], "payload")

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


# reaching a pose


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
            TaskError: the fixed position cannot be reached by an equilibrium within limits.
        """
        if self.position is not None:
            target = np.asarray(self.position, dtype=float)
            length = float(np.max(nominal_model(robot).length))
            if target.shape != (3,) or not np.all(np.isfinite(target)):
                raise TaskError(f"the target is {self.position!r}; allowed are three finite numbers (m)")
            nearest = inverse_kinematics(robot, target, low=limits.low, high=limits.high)
            if nearest.result < 0:
                raise TaskError(
                    f"the target {target.tolist()} m cannot be reached: the nearest position found is "
                    f"{float(nearest.position_error):.3g} m away (the robot is {length:g} m long); choose "
                    "another target, or wider limits"
                )
        return super().survey(robot, limits, seed)

    def draw(self, key: Any, survey: Survey) -> Tip:
        """Return a random pose of the survey, or the fixed one."""
        k = jax.random.randint(key, (), 0, survey.position.shape[0])
        position = survey.position[k] if self.position is None else jnp.asarray(self.position, dtype=float)
        return Tip(position, survey.tangent[k])

    def target(self, goal: Tip, t: Any) -> Float[Any, "6"]:
        """Return the wanted position (m) and tangent of the tip."""
        return jnp.concatenate([goal.position, goal.tangent])

    def error(self, goal: Tip, t: Any, tip: Tip) -> Any:
        """Return the distance of the tip (m), and in addition `arm` times the error of its tangent."""
        distance = _norm(tip.position - goal.position)
        if self.position is not None:
            return distance
        # chord between unit vectors: the angle for small angles, and smooth at zero
        return distance + self.arm * _norm(tip.tangent - goal.tangent)


# reaching a position past obstacles

#: reward while the robot touches an obstacle, as a part of the reward without contact
TOUCHING = 0.5


class _CourseGoal(NamedTuple):
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
        _require_positive(self, "radius", "stiffness", "softness")

    @property
    def observed(self) -> int:  # type: ignore[override]
        """Number of numbers in `observation`."""
        return 3 * self.count

    def equipped(self, robot: System) -> System:
        """Return the robot with the balls in its surroundings."""
        ball = Sphere(radius=self.radius, stiffness=self.stiffness, smoothing=self.softness)
        equipped: System = _with_parts(robot, "surroundings", [ball] * self.count, self.name)
        return equipped

    def placed(self, system: System, goal: _CourseGoal) -> System:
        """Return the system with the balls of an episode."""
        return system.replace(**{f"surroundings.{k}.center": goal.centres[k] for k in range(self.count)})

    def draw(self, key: Any, survey: Survey) -> _CourseGoal:
        """Return a position of the survey with balls before it; positions near the rest are left out."""
        one, two = jax.random.split(key)
        lateral = (survey.position - survey.origin) @ survey.frame[:2].T
        far = jnp.sum(lateral**2, axis=-1) >= survey.reach**2
        k = jax.random.choice(one, len(far), p=far / jnp.sum(far))
        position, middle = survey.position[k], survey.halfway[k]
        aside = jnp.cross(survey.frame[2], position - survey.origin)
        aside = aside / _norm(aside) * jnp.where(jax.random.uniform(two) < 0.5, 1.0, -1.0)
        return _CourseGoal(position, self._centres(middle, aside), aside)

    def _centres(self, middle: Any, aside: Any) -> Float[Any, "k 3"]:
        # a little off the path: which way is shorter is then certain
        return (middle - 0.3 * self.radius * aside)[None]

    def target(self, goal: _CourseGoal, t: Any) -> Float[Any, "3"]:
        """Return the wanted position of the tip (m)."""
        return goal.position

    def reward(self, error: Any, clearance: Any, length: Any) -> Any:
        """Return the reward of a period."""
        return super().reward(error, clearance, length) * jnp.where(clearance < 0.0, TOUCHING, 1.0)

    def observation(self, goal: _CourseGoal, survey: Survey, length: Any) -> Float[Any, " o"]:
        """Return the centres of the balls from the tip at rest, in lengths of the robot."""
        return ((goal.centres - survey.origin) / length).ravel()

    def waypoint(self, goal: _CourseGoal) -> Float[np.ndarray, "3"]:
        """Return a position (m) on the way that is clear of the balls."""
        return np.asarray(goal.centres[0] + 2.5 * self.radius * goal.aside)

    def reference(self, goal: _CourseGoal, survey: Survey) -> Reference:
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
        centre, offset = middle + 0.5 * self.gap * aside, (self.radius + 0.5 * self.gap) * aside
        return jnp.stack([centre - offset, centre + offset])

    def waypoint(self, goal: _CourseGoal) -> Float[np.ndarray, "3"]:
        """Return the middle of the gate (m)."""
        return np.asarray(goal.centres).mean(axis=0)


#: tasks by name
TASKS: dict[str, type[Task]] = {
    task.name: task for task in (Follow, Reach, Pillar, Gate, Payload, Adaptation)
}
