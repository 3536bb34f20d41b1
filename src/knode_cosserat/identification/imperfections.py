"""Robots that differ from their data sheet by random effects, for tests of identification."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from knode_cosserat.estimation.parameters import ParameterModel
from knode_cosserat.identification.effects import library_model
from knode_cosserat.recordings.config import RecordingConfig
from knode_cosserat.recordings.virtual import commands
from knode_cosserat.rods.parameters import ParameterError
from knode_cosserat.rods.robot_file import load_robot
from knode_cosserat.rods.system import System
from knode_cosserat.rods.tendon_robots import TendonRod

#: probability that a robot has an effect
SHARE = 1.0 / 3.0
#: sizes of an effect's numbers, in standard deviations of their priors
SIZES = (0.5, 1.5)
#: data sheet of test robots, and its damping (N m² s), little: a fiftieth of the critical one;
#: their training recordings, by name, and the end of the part used (s)
NOMINAL, DAMPING = "delrin-tendon-robot", 4.55e-4
TRAINING = {"sine_1p0": "sine:1.0", "sine_3p0": "sine:3.0", "rand_0": "random:0"}
END = 7.5


@dataclasses.dataclass(frozen=True)
class Imperfect:
    """A robot with random imperfections.

    Attributes:
        robot: the robot.
        effects: the effects that it has.
        values: their numbers by label.
        model: all effects and their priors.
        x: coordinates (n,) of the robot.
    """

    robot: System
    effects: tuple[str, ...]
    values: Mapping[str, float]
    model: ParameterModel
    x: Float[np.ndarray, " n"]


def imperfect_robot(
    nominal: System,
    tension: Float[np.ndarray, "T c"],
    seed: int,
    bodies: Sequence[float] = (),
    static: bool = False,
) -> Imperfect:
    """Return a robot with imperfections drawn from the library of effects.

    Basic effects (stiffness, damping) are always drawn, every other one with probability 1/3; numbers lie 0.5
    to 1.5 standard deviations of their priors from their nominal values.

    Args:
        nominal: the robot of the data sheet.
        tension: its controls; tensions (N) set the sizes of some effects.
        seed: a whole number from 0 to 2**32 - 1.
        bodies: places of bodies, which may be on ribs, as parts of the length.
        static: leave out effects that change no equilibrium.

    Raises:
        ParameterError: a seed out of range.
    """
    if not 0 <= seed < 2**32:
        raise ParameterError(f"seed is {seed}; allowed is a whole number from 0 to {2**32 - 1}")
    model, random = library_model(nominal, tension, bodies, static=static), np.random.default_rng(seed)
    names: list[str] = []
    for effect in (it for it in model.effects if not it.of_recordings):
        present = bool(random.uniform() < SHARE) or effect.basic
        if present and set(effect.needs) <= set(names):
            names.append(effect.name)
    sizes = random.uniform(*SIZES, model.size) * random.choice([-1.0, 1.0], model.size)
    low, high = model.bounds
    # numbers with a bound at zero have one sign
    sizes = np.where((low >= 0.0) | (high <= 0.0), np.abs(sizes) * np.where(high <= 0.0, -1.0, 1.0), sizes)
    x = np.where(model.mask(names), np.clip(sizes, low, high), 0.0)
    mask, values = model.mask(names), model.values(x)
    kept = {label: value for label, value, on in zip(model.labels, values, mask, strict=True) if on}
    return Imperfect(model.reduced(x, names), tuple(names), kept, model, x)


def nominal_robot() -> TendonRod:
    """Return the robot of the data sheet of all test robots: the paper's, with little damping."""
    robot = load_robot(NOMINAL)
    assert isinstance(robot, TendonRod)
    return robot.replace(bending_damping=DAMPING)


def drawn_robot(seed: int) -> Imperfect:
    """Return the test robot of a seed: the paper's robot with random imperfections."""
    tension = np.concatenate([commands(signal, END).values for signal in TRAINING.values()])
    bodies = [marker.fraction for marker in RecordingConfig.paper_robot().markers]
    return imperfect_robot(nominal_robot(), tension, seed, bodies)
