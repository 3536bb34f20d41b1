"""A tendon-driven rod that PyElastica simulates, with the imperfections of a real robot."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.ends import Clamped
from knode_cosserat.rods.loads import AttachedMass
from knode_cosserat.rods.parameters import ParameterError
from knode_cosserat.rods.tendon_robots import TendonRod

#: elements: a static tip is 0.05 % of the length from that of our equations (tests/studies/test_elastica.py)
ELEMENTS = 12
#: rotary inertia of a cross-section, relative to the bare rod. Explicit steps shrink with its square root.
#: 30 is that of disks for tendons: four of 3.4 g and 40 mm of diameter have 20 times that of the rod
ROTARY_INERTIA = 30.0
#: part of the largest stable time step
SAFETY = 0.8
#: time of the motion to rest at the start (s)
SETTLING = 3.0
#: first natural frequency of a clamped rod: β² with β = 1.8751
FIRST_MODE = 3.516


@dataclasses.dataclass(frozen=True)
class Imperfections:
    """Imperfections of a robot that its model does not state.

    Attributes:
        friction: coefficient of friction of the tendons in their holes.
        misalignment: angle by which the holes of one metre of rod turn a straight tendon (rad/m).
        sliding: sliding of a tendon until its friction is full (m).
        lag: time constant of the motors (s).
        payload: unknown mass at the tip (kg).
        tension_noise: standard deviation of a load cell (N).
    """

    friction: float = 0.15
    misalignment: float = 0.5
    sliding: float = 3e-4
    lag: float = 0.06
    payload: float = 0.0
    tension_noise: float = 0.05

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            if not getattr(self, field.name) >= 0.0:
                raise ValueError(f"{field.name} is {getattr(self, field.name)}; allowed is zero or more")
        if self.sliding == 0.0:
            raise ValueError("sliding is 0; allowed is above zero")


#: a robot that differs from its model by numerical errors only
PERFECT = Imperfections(friction=0.0, misalignment=0.0, lag=0.0, tension_noise=0.0)


class ElasticaRod:
    """Rod with tendons, clamped at its base, in PyElastica's explicit time steps."""

    def __init__(
        self,
        robot: TendonRod,
        imperfections: Imperfections,
        *,
        elements: int = ELEMENTS,
        rotary_inertia: float = ROTARY_INERTIA,
    ):
        """Build the rod, and let it come to rest without tensions.

        Args:
            robot: dimensions, material, masses and tendons; its own model of tendons is not used.
            imperfections: of the robot.
            elements: number of elements.
            rotary_inertia: rotary inertia relative to the bare rod.

        Raises:
            ImportError: PyElastica is not installed.
            ParameterError: a robot with parts that the rod does not have.
        """
        try:
            from studies.elastica import kernel
        except ImportError:
            raise ImportError("the test robot needs PyElastica: pip install '.[studies]'") from None
        if elements < 3:
            raise ValueError(f"elements is {elements}; allowed is 3 or more")
        _check(robot)
        self.robot, self.imperfections, self.elements = robot, imperfections, elements
        self._kernel, self._spread = kernel, rotary_inertia
        self.dt = SAFETY * _stable_step(robot, elements, rotary_inertia)
        self._rod = self._built()
        count, places = robot.tendon_count, np.array(robot.routes_at(0.0)[0], dtype=float)
        self._tendons = kernel.Tendons(
            places, np.zeros(count), np.zeros((count, elements - 1)), -np.ones((count, elements - 1))
        )
        self._settle()

    def _built(self) -> Any:
        from elastica.rod.cosserat_rod import CosseratRod

        robot, n = self.robot, self.elements
        found = CosseratRod.straight_rod(
            n,
            np.zeros(3),
            np.array([0.0, 0.0, 1.0]),
            np.array([1.0, 0.0, 0.0]),
            float(robot.length),
            float(robot.radius),
            float(robot.density),
            youngs_modulus=float(robot.youngs_modulus),
            shear_modulus=float(robot.G),
        )
        inertia = self._spread * found.mass_second_moment_of_inertia[0, 0, 0]
        found.mass_second_moment_of_inertia[:] = inertia * np.eye(3)[:, :, None]
        found.inv_mass_second_moment_of_inertia[:] = np.eye(3)[:, :, None] / inertia
        for at, mass in _masses(robot, self.imperfections):
            node = min(int(at * n), n - 1)
            part = at * n - node
            found.mass[node] += (1.0 - part) * mass
            found.mass[node + 1] += part * mass
        arrays = [getattr(found, name) for name in self._kernel.ARRAYS.values()]
        return self._kernel.Rod._make([*arrays, np.zeros(0, dtype=np.int32)])

    def _constants(self, dt: float, linear_drag: float, *, sticking: bool = False) -> Any:
        robot, of = self.robot, self.imperfections
        h = float(robot.length) / self.elements
        bend = np.diag(np.asarray(self._rod.bend_matrix)[:, :, 0])
        inertia = float(self._rod.inertia[0, 0, 0])
        link = dt * _isotropic("bending_damping", robot.bending_damping) / (h * inertia)
        # the first element is half as far from the clamped end, and the last one has one neighbour
        pivots = 1.0 + link * np.array([3.0, *[2.0] * (self.elements - 2), 1.0])
        for k in range(1, self.elements):
            pivots[k] -= link * link / pivots[k - 1]
        return self._kernel.Constants(
            dt,
            float(np.exp(-dt / of.lag)) if of.lag > 0.0 else 0.0,
            0.0 if sticking else of.friction,
            of.misalignment * h,
            of.sliding,
            np.eye(3),
            2.0 * bend / h,
            np.array(robot.gravity, dtype=float),
            linear_drag,
            _isotropic("drag", robot.drag),
            link,
            pivots,
        )

    def _settle(self) -> None:
        """Move to rest without tensions, by drag that damps the first mode critically; keep the state."""
        robot = self.robot
        mass, length = float(robot.mass_per_length), float(robot.length)
        frequency = FIRST_MODE * (float(robot.Kbt[0, 0]) / mass) ** 0.5 / length**2
        constants = self._constants(self.dt, 2.0 * frequency * mass, sticking=True)
        command = np.zeros(robot.tendon_count)
        self._kernel.advance(self._rod, self._tendons, constants, command, round(SETTLING / self.dt))
        self._rod.velocity[:], self._rod.omega[:] = 0.0, 0.0
        self._tendons.mobilised[:] = 0.0
        self._start = [np.array(each) for each in (*self._rod, *self._tendons)]

    def restart(self) -> None:
        """Go back to rest without tensions."""
        for now, start in zip((*self._rod, *self._tendons), self._start, strict=True):
            now[...] = start

    def advance(self, command: Float[np.ndarray, " c"], seconds: float) -> None:
        """Move the rod for some time under commanded tensions (N); negative ones count as zero.

        Raises:
            RuntimeError: the motion is not finite.
        """
        steps = max(1, int(np.ceil(seconds / self.dt - 1e-9)))
        drag = 0.0 if self.robot.linear_drag is None else _isotropic("linear_drag", self.robot.linear_drag)
        command = np.maximum(np.array(command, dtype=float), 0.0)
        self._kernel.advance(self._rod, self._tendons, self._constants(seconds / steps, drag), command, steps)
        if not np.all(np.isfinite(self._rod.position)):
            raise RuntimeError("the test robot's motion is not finite: a time step was not stable")

    @property
    def tension(self) -> Float[np.ndarray, " c"]:
        """Tensions (N) at the base."""
        return np.array(self._tendons.tension)

    def tip(self) -> Float[np.ndarray, "3"]:
        """Return the position of the tip (m)."""
        return np.array(self._rod.position[:, -1])

    def positions(self, fractions: Any) -> Float[np.ndarray, "M 3"]:
        """Return positions (m) at fractions of the length, by cubic splines."""
        from scipy.interpolate import CubicSpline

        nodes = np.linspace(0.0, 1.0, self.elements + 1)
        return np.asarray(CubicSpline(nodes, self._rod.position.T)(np.asarray(fractions, dtype=float)))

    def quaternions(self, fractions: Any) -> Float[np.ndarray, "M 4"]:
        """Return orientations at fractions of the length, scalar first; directors are those of elements."""
        from scipy.spatial.transform import Rotation, Slerp

        middles = (np.arange(self.elements) + 0.5) / self.elements
        turns = Rotation.from_matrix(np.transpose(self._rod.directors, (2, 1, 0)))
        last = turns[-1] * (turns[-2].inv() * turns[-1]) ** 0.5
        every = Rotation.concatenate([Rotation.identity(1), turns, Rotation.concatenate([last])])
        found = Slerp([0.0, *middles, 1.0], every)(np.asarray(fractions, dtype=float))
        return np.asarray(found.as_quat(canonical=True, scalar_first=True))


def _check(robot: Any) -> None:
    if not isinstance(robot, TendonRod):
        raise ParameterError(f"robot is a {type(robot).__name__}; allowed is a robot with tendons")
    parts: dict[str, Any] = {"sections": robot.sections, "surroundings": robot.surroundings}
    absent = ("cross_section", "tip_radius", "routing", "tendon_twist", "reels")
    parts |= {name: getattr(robot, name, None) for name in absent}
    for name, part in parts.items():
        if part is not None and part != ():
            raise ParameterError(f"robot has {name}; the test robot is a uniform rod with straight tendons")
    base: Any = robot.base_end
    pose = (getattr(base, "position", None), getattr(base, "orientation", None))
    if not isinstance(base, Clamped) or robot.tip_end.held or any(each is not None for each in pose):
        raise ParameterError("the test robot has a clamped base at the origin, and a free tip")
    if not all(isinstance(each, AttachedMass) for each in robot.loads):
        raise ParameterError("robot has other loads than masses; the test robot has masses only")
    if float(robot.tendon_offset) <= 0.0:
        raise ParameterError("tendon_offset is 0; the test robot's tendons run beside the rod")


def _masses(robot: TendonRod, imperfections: Imperfections) -> list[tuple[float, float]]:
    """Return places, as parts of the length, and masses (kg)."""
    found = [(float(each.at), float(each.mass)) for each in robot.loads if isinstance(each, AttachedMass)]
    return [*found, (1.0, imperfections.payload)]


def _isotropic(name: str, value: Any) -> float:
    """Return the number of a matrix that is a multiple of the identity.

    Raises:
        ParameterError: another matrix.
    """
    matrix = np.asarray(value, dtype=float) * np.eye(3)
    if not np.allclose(matrix, matrix[0, 0] * np.eye(3)):
        raise ParameterError(f"{name} differs by direction; the test robot's is one number")
    return float(matrix[0, 0])


def _stable_step(robot: TendonRod, elements: int, rotary_inertia: float) -> float:
    """Return the largest stable time step (s): 2 over the highest frequency of stretch, shear or turning."""
    h, rho = float(robot.length) / elements, float(robot.density)
    E, G, r = float(robot.youngs_modulus), float(robot.G), float(robot.radius)
    stretch = 4.0 * E / (rho * h * h)
    turning = (G * 4.0 / (r * r) + 4.0 * E / (h * h)) / (rho * rotary_inertia)
    return 2.0 / float(np.sqrt(max(stretch, 4.0 * G / (rho * h * h) + turning)))
