"""A model of a real robot from its recordings: tendons that bend and rub, and the numbers of that robot."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from knode_cosserat.learning.calibration.calibrate import Calibration, calibrate
from knode_cosserat.learning.calibration.search import CalibrationError
from knode_cosserat.learning.samples import DataError
from knode_cosserat.recordings.measurements import Measurements
from knode_cosserat.rods.routed_robot import RoutedTendonRobot
from knode_cosserat.rods.system import System
from knode_cosserat.rods.tendon_rod import TendonRod
from knode_cosserat.solvers.boundary import NewtonOptions
from knode_cosserat.solvers.places import places_at, positions_at
from knode_cosserat.solvers.settings import Settings
from knode_cosserat.solvers.simulate import simulate
from knode_cosserat.solvers.space import SpaceScheme

#: what is found unless other names are given. Density and gravity stay: with tensions known in newtons, only
#: the ratios of stiffness, tendon offset and weight can be told from poses
NAMES = (
    "youngs_modulus",
    "tendon_offset",
    "bending_damping",
    "sleeve_stiffening",
    "friction_wobble",
    "friction_curvature",
    "friction_reach",
)
#: what is found after that, if it explains more
VIBRATION = ("vibration_tension", "vibration_rate", "vibration_softening")
#: where the searches begin: some of everything that is searched, for what is zero shows no way
BEGIN: dict[str, Any] = {
    "sleeve_stiffening": 0.5,
    "friction_wobble": 0.3,
    "friction_curvature": 0.1,
    "friction_reach": 0.1,
}
BEGIN_VIBRATION: dict[str, Any] = {"vibration_rate": 0.3, "vibration_softening": 1e-3}
#: where that is tried
BEGINS = (0.35, 0.5, 0.65)
#: vibration has to explain this part of what is left, on average, or it is not there
WORTH = 0.02
#: the sleeve's length at first, a part of the rod's. It is found last, but not with a scheme of order 1: it
#: would make up for the lag of positions behind orientations
SLEEVE = 0.11
LAST = ("sleeve_length",)
#: robots begin to vibrate somewhere between the least and the greatest tension of all tendons together, if
#: these are further apart than this part of the greatest
SPREAD = 0.2
#: a rod that is damped more than this part of critical is begun with less: it would hide all motion
DAMPING = 0.02
#: a tendon offset that is found to be so many times what it was measured to be, or as many times less, is not
#: what the recordings determine
OFFSET, FARTHEST = "tendon_offset", 3.0


def identify(
    knowledge: System,
    measurements: Sequence[Measurements],
    names: Sequence[str] | None = None,
    *,
    space: str | SpaceScheme = "lobatto2",
) -> Calibration:
    """Find the model of a real robot from its recordings.

    The robot is taken for a `RoutedTendonRobot`: the knowledge's rod, with tendons that run beside it and
    rub. Its numbers are found by least squares through whole simulations, from rest, against the measured
    poses only: no velocity, force, moment or strain has to be estimated. Each recording counts by what the
    model leaves of it, so that one that it cannot explain does not spoil the others.

    Args:
        knowledge: what is known of the robot; its length and density are trusted.
        measurements: from rest on, at a time step that resolves the robot's motion, with mean tensions:
            `recording.sampled(0.025, mean=True)`.
        names: the parameters to find; None: `NAMES`, and `VIBRATION` if it explains more; of these what the
            recordings determine. Where stiffness and tendon offset run off together, for a light rod's weight
            says little, the offset stays as it is known.
        space: the scheme in arclength that the model is for; simulate it with the same. With Euler's, the
            positions of ten nodes lag behind their orientations by half a segment, and the sleeve's length is
            not found.

    Returns:
        The `Calibration`; its `robot` is the model.

    Raises:
        CalibrationError: the knowledge is no tendon-driven rod, or the search does not converge.
        DataError: measurements do not fit the robot, are too short, or have rows without tensions.
        ValueError: a scheme that does not exist.
    """
    scheme = Settings.of("bdf2", space, "paper", NewtonOptions()).space
    if not isinstance(knowledge, TendonRod):
        raise CalibrationError(
            f"knowledge is a {type(knowledge).__name__}; allowed is a tendon-driven robot (TendonRobot, "
            "RoutedTendonRobot)"
        )
    _check(measurements)
    start = _beginning(knowledge, NAMES if names is None else names)
    if names is not None:
        return calibrate(start, measurements, names, by="rollouts", space=scheme)
    still = _still(start, measurements, scheme, trusted=bool(knowledge.tendon_offset))
    shaking = _vibrating(still.robot, measurements, scheme)
    best = _better(still, shaking, measurements, VIBRATION, scheme, WORTH)
    if scheme.order > 1:
        best = _better(best, best.robot, measurements, LAST, scheme)
    return best


def _better(
    before: Calibration,
    start: System | None,
    measurements: Sequence[Measurements],
    more: Sequence[str],
    space: SpaceScheme,
    worth: float = 0.0,
) -> Calibration:
    """Return the calibration with more parameters, searched from a start, if it explains more."""
    if start is None:
        return before
    # of the names that were not determined, the others may be with these parameters
    fixed, free = (
        [name for name in before.undetermined if (name == OFFSET) is kept] for kept in (True, False)
    )
    names = (*before.estimates, *free, *more)
    try:
        other = calibrate(start, measurements, names, by="rollouts", undetermined="keep", space=space)
    except CalibrationError:
        return before
    if _left(other) >= _left(before) - worth:
        return before
    return dataclasses.replace(
        other,
        before={name: before.before.get(name, value) for name, value in other.before.items()},
        undetermined=(*fixed, *other.undetermined),
    )


def _still(
    start: RoutedTendonRobot, measurements: Sequence[Measurements], space: SpaceScheme, trusted: bool
) -> Calibration:
    """Return the robot without vibration.

    The weight of a light rod says so little that stiffness and tendon offset can run off together; then the
    offset is the one that is known (`trusted`: measured, and not a guess of ours).
    """
    try:
        whole = calibrate(start, measurements, NAMES, by="rollouts", undetermined="keep", space=space)
        assert isinstance(whole.robot, TendonRod)
        ratio = float(whole.robot.tendon_offset) / float(start.tendon_offset)
        if not trusted or 1.0 / FARTHEST <= ratio <= FARTHEST:
            return whole
    except CalibrationError:
        pass
    fewer = tuple(name for name in NAMES if name != OFFSET)
    part = calibrate(start, measurements, fewer, by="rollouts", undetermined="keep", space=space)
    return dataclasses.replace(part, undetermined=(OFFSET, *part.undetermined))


def _check(measurements: object) -> None:
    if not isinstance(measurements, Sequence):
        raise DataError(f"measurements is a {type(measurements).__name__}; allowed is a list of them")
    if not measurements:
        raise DataError("there are no measurements")
    for each in measurements:
        if not isinstance(each, Measurements):
            raise DataError(f"a {type(each).__name__} is no measurements; `Recording.sampled` gives them")


def _left(calibration: Calibration) -> float:
    """How much is left of the recordings, each by its own measure: the mean logarithm."""
    return float(np.mean(np.log(list(calibration.remainder.values()))))


def _vibrating(robot: System, measurements: Sequence[Measurements], space: SpaceScheme) -> System | None:
    """The robot with some vibration, if that explains more as it is: a search that finds none takes long."""
    total = np.concatenate([each.tension.sum(axis=1) for each in measurements])
    least, greatest = float(total.min()), float(total.max())
    if greatest - least < SPREAD * greatest:
        return None
    tried = [
        robot.replace(**BEGIN_VIBRATION, vibration_tension=least + part * (greatest - least))
        for part in BEGINS
    ]
    left = [_left_of(each, measurements, space) for each in tried]
    best = int(np.argmin(left))
    return tried[best] if left[best] < _left_of(robot, measurements, space) else None


def _left_of(robot: System, measurements: Sequence[Measurements], space: SpaceScheme) -> float:
    """As `_left`, of positions; infinite where the robot cannot be simulated."""
    found = 0.0
    for each in measurements:
        y = np.asarray(simulate(robot, each.tension[:-1], each.dt, space=space, on_failure="return").y)
        seen = positions_at(robot, y, places_at(each.fractions, robot.nodes))
        off = np.asarray(seen)[: len(each.time)] - each.position
        if not np.all(np.isfinite(y)):
            return float("inf")
        found += 0.5 * float(np.log(np.nanmean(off**2))) / len(measurements)
    return found


def _beginning(knowledge: TendonRod, names: Sequence[str]) -> RoutedTendonRobot:
    """The routed robot that the search begins from; what is not searched is as the knowledge has it."""
    some = {name: value for name, value in BEGIN.items() if name in names}
    if isinstance(knowledge, RoutedTendonRobot):
        return knowledge.replace(**{name: some[name] for name in some if not getattr(knowledge, name)})
    mass = float(knowledge.mass_per_length)
    L, EI = float(knowledge.length), float(knowledge.Kbt[0, 0])
    # of the first mode: B / EI is twice the damping ratio over the angular frequency
    frequency = 3.516 * (EI / mass) ** 0.5 / L**2
    most = 2.0 * DAMPING * EI / frequency
    return RoutedTendonRobot.like(
        knowledge,
        **some,
        bending_damping=min(float(knowledge.bending_damping[0, 0]), most) or most,
        tendon_offset=float(knowledge.tendon_offset) or 5.0 * float(knowledge.radius),
        sleeve_length=SLEEVE * L,
    )
