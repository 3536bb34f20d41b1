"""Test robot: a plant whose motion PyElastica simulates, with friction, lag and noise.

Its equations are those of PyElastica's explicit rod, not those of this package. Its tendons rub in their
holes by the distance that they slide, its motors lag, and its sensors are noisy.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple, Self

import numpy as np
from jaxtyping import Float

from knode_cosserat.cli.arguments import load_system, parse_numbers
from knode_cosserat.control.plants import Plant, Readings, Sensor
from knode_cosserat.estimation.outputs import BodyPoses, BodyPositions
from knode_cosserat.recordings.measurements import Measurements
from knode_cosserat.rods.tendon_robots import TendonRod
from studies.elastica.rod import ElasticaRod, Imperfections

#: time from row to row of a recording, and the rest before its first row (s)
ROW, REST = 0.0125, 2.0
#: places of the bodies, as parts of the length: those of the paper's robot
BODIES = (1 / 3, 5 / 9, 7 / 9, 1.0)


class Recorded(NamedTuple):
    """Recording of a plant: measurements by load cells and motion capture, and the commanded tensions."""

    measured: Measurements
    #: (T, c) commands (N), held from row to row
    commanded: Float[np.ndarray, "T c"]


class ElasticaPlant(Plant):
    """A tendon robot that PyElastica simulates; it needs the extra `studies`."""

    def __init__(self, rod: ElasticaRod, dt: float, sensor: Sensor):
        """Set up the robot at rest without tensions.

        Args:
            rod: the simulated robot.
            dt: period (s).
            sensor: positions or poses of bodies, with their errors.
        """
        if not isinstance(sensor.output, BodyPositions | BodyPoses):
            raise ValueError(
                f"the sensor measures {type(sensor.output).__name__}; the test robot has positions and poses "
                "of bodies: TipPosition, TipPose, BodyPositions, BodyPoses"
            )
        self.rod, self.dt, self.sensor = rod, float(dt), sensor
        self.start()

    @classmethod
    def like(
        cls,
        robot: TendonRod,
        dt: float,
        sensor: Sensor,
        imperfections: Imperfections | None = None,
        **changes: float,
    ) -> Self:
        """Return a plant with the dimensions, material, masses and tendons of a robot.

        Its tendons are routed ones: with exact numbers its model is `RoutedTendonRobot.like(robot)`. The
        paper's tendons (`TendonRobot`) bend a rod more.

        Args:
            robot: a robot with tendons beside its rod.
            dt: period (s).
            sensor: positions or poses of bodies, with their errors.
            imperfections: of the real robot; None: usual ones.
            changes: changed imperfections, such as `lag=0.1`.
        """
        chosen = Imperfections() if imperfections is None else imperfections
        return cls(ElasticaRod(robot, dataclasses.replace(chosen, **changes)), dt, sensor)

    def start(self) -> Float[np.ndarray, " c"]:
        """Go to rest without tensions, and return the control that acts there."""
        self.rod.restart()
        self._readings = Readings(self.sensor)
        self._sense()
        return self.rod.tension

    def apply(self, control: Float[np.ndarray, " c"]) -> None:
        """Move on by one period under commanded tensions (N)."""
        self.rod.advance(control, self.dt)
        self._sense()

    def _sense(self) -> None:
        output = self.sensor.output
        fractions = output.fractions  # type: ignore[attr-defined]
        found = self.rod.positions(fractions)
        if isinstance(output, BodyPoses):
            found = np.concatenate([found, self.rod.quaternions(fractions)], axis=1)
        self._readings.add(found.ravel())

    def measure(self) -> Float[np.ndarray, " p"]:
        """Return the measurement of this time, or an older one if the sensor has latency."""
        return self._readings.current()

    def tip(self) -> Float[np.ndarray, "3"]:
        """Return the true position of the tip (m)."""
        return self.rod.tip()


def record_elastica(
    rod: ElasticaRod,
    commands: Float[np.ndarray, "K c"],
    hold: float,
    *,
    bodies: Sequence[float] = BODIES,
    poses: BodyPoses | None = None,
    seed: int = 0,
) -> Recorded:
    """Record the robot under commanded tensions, in rows 12.5 ms apart.

    The robot first rests under the first command. Tensions are those of its load cells: row i has the reading
    at the time of row i + 1 (`Measurements.continuous`).

    Args:
        rod: the robot; it starts again.
        commands: tensions (N), each held for a time.
        hold: this time (s), a multiple of 12.5 ms.
        bodies: places of the measured bodies, as fractions of the length.
        poses: standard deviations of positions and rotations; None: 0.15 mm and 2 mrad.
        seed: of the noise.
    """
    each = round(hold / ROW)
    if each < 1 or abs(each * ROW - hold) > 1e-9:
        raise ValueError(f"hold is {hold:g} s; allowed is a multiple of {ROW:g} s")
    random = np.random.default_rng(seed)
    sigma = BodyPoses(tuple(bodies), 1.5e-4) if poses is None else poses
    commanded = np.repeat(np.asarray(commands, dtype=float), each, axis=0)
    rod.restart()
    rod.advance(commanded[0], REST)

    def reading() -> Float[np.ndarray, " c"]:
        return rod.tension + rod.imperfections.tension_noise * random.normal(size=commanded.shape[1])

    initial = np.mean([reading() for _ in range(round(1.0 / ROW))], axis=0)
    tension, position, quaternion = [], [], []
    for command in commanded:
        position.append(rod.positions(bodies))
        quaternion.append(rod.quaternions(bodies))
        rod.advance(command, ROW)
        tension.append(reading())
    position = position + sigma.sigma * random.normal(size=np.shape(position))
    measured = Measurements(
        time=ROW * np.arange(len(commanded)),
        control=np.array(tension),
        fractions=np.array(bodies),
        position=np.array(position),
        quaternion=_shaken(np.array(quaternion), sigma.sigma_rotation, random),
        measured=np.ones((len(commanded), len(bodies)), dtype=bool),
        simulated=True,
        source="simulated with PyElastica",
        initial_control=initial,
        continuous=True,
    )
    return Recorded(measured, commanded)


def _shaken(quaternion: Float[np.ndarray, "T M 4"], sigma: float, random: np.random.Generator) -> Any:
    """Return noisy orientations, turned about random axes of their own frames."""
    from scipy.spatial.transform import Rotation

    turns = Rotation.from_quat(quaternion.reshape(-1, 4), scalar_first=True)
    noise = Rotation.from_rotvec(sigma * random.normal(size=(len(turns), 3)))
    return (turns * noise).as_quat(canonical=True, scalar_first=True).reshape(quaternion.shape)


def sine_commands(
    seconds: float, hold: float, period: float, *, rest: float = 2.0, swing: float = 1.5
) -> Any:
    """Return sines of four opposed tendons about a rest tension (N), after half a second of rest.

    The swing grows over the first second of motion. It is at most the rest tension.
    """
    time = np.arange(0.0, seconds - 1e-9, hold) - 0.5
    phase, grown = 2.0 * np.pi * time / period, np.clip(time, 0.0, 1.0)[:, None]
    turns = np.stack([np.cos(phase), np.sin(phase), -np.cos(phase), -np.sin(phase)], axis=1)
    return rest + swing * grown * turns


def parsed_plant(text: str, dt: float, sensor: Sensor) -> ElasticaPlant:
    """Return a plant by ROBOT,NAME=NUMBER,…: a catalog name or a file, and imperfections."""
    name, *words = text.split(",")
    known = [field.name for field in dataclasses.fields(Imperfections)]
    changes: dict[str, Any] = {}
    for word in words:
        key, _, value = word.partition("=")
        if key not in known:
            raise ValueError(f"--plant has {word!r}; allowed is NAME=NUMBER with {', '.join(known)}")
        changes[key] = parse_numbers(f"--plant {key}", value, 1, "0.1")[0]
    robot: Any = load_system(name)
    return ElasticaPlant.like(robot, dt, sensor, Imperfections(**changes))
