"""A robot with all effects at once, as a function of the coordinates of a search."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from knode_cosserat.identification.effects import Change, Effect, Number
from knode_cosserat.identification.library import effects_of
from knode_cosserat.rods.anchors import EarlyAnchors
from knode_cosserat.rods.ends import Clamped
from knode_cosserat.rods.load_cells import LoadCells
from knode_cosserat.rods.loads import AttachedMass
from knode_cosserat.rods.reels import Reels
from knode_cosserat.rods.relaxation import Relaxation
from knode_cosserat.rods.rib_spacing import RibSpacing
from knode_cosserat.rods.routed_robot import RoutedTendonRobot
from knode_cosserat.rods.section import Sleeve, Stretch
from knode_cosserat.rods.tendon_friction import TendonFriction, Vibration
from knode_cosserat.rods.tendon_rod import TendonRod

#: tendon offset of a robot that states none, over its radius
OFFSET = 5.0
#: where the last rib before the tip is, if the robot states none
LAST_RIB = 8.0 / 9.0
#: an upright base
UPRIGHT = (1.0, 0.0, 0.0, 0.0)


def routed(nominal: TendonRod) -> RoutedTendonRobot:
    """Return the robot with tendons that run beside it, as `RoutedTendonRobot` has them."""
    if isinstance(nominal, RoutedTendonRobot):
        return nominal
    offset = float(nominal.tendon_offset) or OFFSET * float(nominal.radius)
    return RoutedTendonRobot.like(nominal, tendon_offset=offset)


def extended_robot(robot: RoutedTendonRobot, ribs: Sequence[float] = ()) -> RoutedTendonRobot:
    """Return the same robot with every part that effects change: a stretch, a sleeve, a tip mass and so on.

    A base and load cells that the robot already has are unchanged; all added parts have no effect. Ribs may
    be where the robot has masses, or at the given places if it has none.
    """
    held = robot.base_end
    if isinstance(held, Clamped):
        held = dataclasses.replace(
            held,
            position=np.zeros(3) if held.position is None else held.position,
            orientation=np.array(UPRIGHT) if held.orientation is None else held.orientation,
        )
    robot = robot.replace(
        base_end=held,
        sections=(*robot.sections, Stretch(stiffness=(1.0, 0.0)), Sleeve()),
        loads=(*robot.loads, AttachedMass(at=1.0, mass=0.0)),
        linear_drag=np.zeros((3, 3)) if robot.linear_drag is None else robot.linear_drag,
        relaxation=robot.relaxation or Relaxation(stiffness=0.0),
    )
    if robot.routing is None and robot.tendon_twist is None:
        robot = robot.replace(tendon_twist=0.0)
    return _with_reels(robot) if robot.drive == "reel" else _with_load_cells(robot, _ribs(robot) or ribs)


def _ribs(robot: RoutedTendonRobot) -> list[float]:
    """Return the places of the robot's masses, if these are several: they are its ribs, as a rule."""
    masses = [each for each in robot.loads if isinstance(each, AttachedMass)]
    found = sorted({each.at for each in masses if each.at > 0.0 and float(each.mass) > 0.0})
    return found if len(found) > 1 else []


def _with_load_cells(robot: RoutedTendonRobot, ribs: Sequence[float]) -> RoutedTendonRobot:
    """Return the same robot with what changes tensions on their way from load cells to the tip."""
    count = robot.tendon_count
    return robot.replace(
        anchors=robot.anchors or EarlyAnchors(at=_last_rib(robot), share=np.ones(count)),
        load_cells=robot.load_cells or LoadCells(gain=np.ones(count), offset=np.zeros(count)),
        friction=robot.friction or TendonFriction(),
        vibration=robot.vibration or Vibration(tension=1e6, rate=0.0),
        rib_spacing=robot.rib_spacing or RibSpacing(at=tuple(ribs) if len(ribs) > 1 else None, share=0.0),
    )


def _with_reels(robot: RoutedTendonRobot) -> RoutedTendonRobot:
    """Return the same robot with all that lies between its controls and the lengths taken in."""
    count, reels = robot.tendon_count, robot.reels or Reels(motors=np.arange(1.0, robot.tendon_count + 1.0))
    motors = reels.motor_count(count)
    return robot.replace(
        reels=dataclasses.replace(
            reels,
            zero=np.zeros(motors) if reels.zero is None else reels.zero,
            taken_in=np.zeros(count) if reels.taken_in is None else reels.taken_in,
            compliance=np.zeros(count) if reels.compliance is None else reels.compliance,
        ),
    )


def _last_rib(robot: RoutedTendonRobot) -> float:
    """Return the place of the last mass before the tip, or a usual one."""
    ribs = [each.at for each in robot.loads if isinstance(each, AttachedMass) and 0.0 < each.at < 1.0]
    return max(ribs, default=LAST_RIB)


def _without_idle_reels(nominal: RoutedTendonRobot, found: Any, names: Sequence[str]) -> dict[str, Any]:
    """Return changes that take away parts of the reels, and stiffness, that no named effect needs."""
    given = nominal.reels
    gone = {"motor zeros": "zero", "taken in": "taken_in", "springs": "compliance"}
    idle = {
        part: None if given is None else getattr(given, part)
        for name, part in gone.items()
        if name not in names
    }
    changes: dict[str, Any] = {"reels": dataclasses.replace(found.reels, **idle)}
    if given is None and not {*gone, "reel radii"} & set(names):
        changes["reels"] = None
    if "axial stiffness" not in names:
        changes["shear_stiffness"] = nominal.shear_stiffness
    return changes


class ParametrisedRobot(eqx.Module):
    """A robot with all effects as a function of coordinates: a pytree, so that programs serve any robot.

    Attributes:
        robot: the nominal robot with every part.
        nominal: nominal values (n,) of all numbers.
        width: widths (n,) of their priors.
        logarithmic: true for logarithmic parameters.
        changes: for each effect, its change of a robot, and the number of its parameters.
    """

    robot: RoutedTendonRobot
    nominal: Float[Any, " n"]
    width: Float[Any, " n"]
    logarithmic: tuple[bool, ...] = eqx.field(static=True)
    changes: tuple[tuple[Change, int], ...] = eqx.field(static=True)

    def values(self, x: Float[Any, " n"]) -> Float[Any, " n"]:
        """Return the values of all numbers."""
        away, logarithmic = self.width * x, np.array(self.logarithmic)
        factors = jnp.exp(jnp.where(logarithmic, away, 0.0))
        return self.nominal * factors + jnp.where(logarithmic, 0.0, away)

    def __call__(self, x: Float[Any, " n"]) -> RoutedTendonRobot:
        """Return the robot at coordinates."""
        values = self.values(x)
        robot, first = self.robot, 0
        for change, count in self.changes:
            robot = change(robot, [values[k] for k in range(first, first + count)])
            first += count
        return robot


class Model:
    """All effects of one robot, and the robot with them for any coordinates.

    Attributes:
        effects: all of them, in the order of the coordinates.
        numbers: their numbers.
        robot: the robot with all effects, a function of coordinates.
    """

    def __init__(self, nominal: TendonRod, tension: Float[np.ndarray, "T c"], bodies: Iterable[float] = ()):
        """Start from the nominal robot, usual tensions (N), and places of measured bodies (parts of L)."""
        tensions, highest = float(np.nanmean(tension)), float(np.nanmax(tension.sum(axis=1)))
        self.nominal = routed(nominal)
        self._extended = extended_robot(self.nominal, [float(at) for at in bodies if at > 0.0])
        self.effects: tuple[Effect, ...] = tuple(effects_of(self._extended, tensions, highest))
        self.numbers: tuple[Number, ...] = tuple(each for effect in self.effects for each in effect.numbers)
        self.robot = ParametrisedRobot(
            self._extended,
            np.array([each.nominal for each in self.numbers]),
            np.array([each.width for each in self.numbers]),
            tuple(each.logarithmic for each in self.numbers),
            tuple((effect.apply, len(effect.numbers)) for effect in self.effects),
        )

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return len(self.numbers)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the effects."""
        return tuple(effect.name for effect in self.effects)

    def slice(self, name: str) -> slice:
        """Return the coordinates of an effect."""
        first = 0
        for effect in self.effects:
            if effect.name == name:
                return slice(first, first + len(effect.numbers))
            first += len(effect.numbers)
        raise KeyError(name)

    def effect(self, name: str) -> Effect:
        """Return the effect of that name."""
        return self.effects[self.names.index(name)]

    def mask(self, names: Iterable[str]) -> Bool[np.ndarray, " n"]:
        """Return which coordinates belong to these effects."""
        found = np.zeros(self.size, dtype=bool)
        for name in names:
            found[self.slice(name)] = True
        return found

    @property
    def begin(self) -> Float[np.ndarray, " n"]:
        """Coordinates where a search begins."""
        return np.array([each.begin for each in self.numbers])

    @property
    def bounds(self) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Lowest and highest coordinates."""
        low, high = zip(*(each.bounds for each in self.numbers), strict=True)
        return np.array(low), np.array(high)

    def values(self, x: Float[np.ndarray, " n"]) -> list[float]:
        """Return the numbers' values."""
        return [float(each.value(np.asarray(x[k]))) for k, each in enumerate(self.numbers)]

    def reduced(self, x: Any, names: Sequence[str]) -> RoutedTendonRobot:
        """Return the robot with the named effects only, and without the parts of all others.

        It moves as `robot` does with the other effects' coordinates at zero. Coordinates may be traced.
        """
        found = self._extended
        values = self.robot.values(x) if isinstance(x, jax.core.Tracer) else self.values(x)
        for each in self.effects:
            if each.name in names:
                found = each.apply(found, list(values[self.slice(each.name)]))
        nominal = self.nominal
        sections, loads = list(found.sections), list(found.loads)
        if "sleeve" not in names:
            sections.pop(-1)
        if not {"taper", "rest curvature"} & set(names):
            del sections[len(nominal.sections)]
        if "tip mass" not in names:
            loads.pop(-1)
        changes: dict[str, Any] = {"sections": tuple(sections), "loads": tuple(loads)}
        gone = {
            "friction": "friction", "vibration": "vibration", "early anchors": "anchors",
            "linear drag": "linear_drag", "creep": "relaxation", "tendon twist": "tendon_twist",
        }  # fmt: skip
        changes |= {part: getattr(nominal, part) for effect, part in gone.items() if effect not in names}
        if not {"rib spacing", "rib spans"} & set(names):
            changes["rib_spacing"] = nominal.rib_spacing
        if not {"load cell gains", "load cell offsets", "latency"} & set(names):
            changes["load_cells"] = nominal.load_cells
        if nominal.drive == "reel":
            changes |= _without_idle_reels(nominal, found, names)
        if not {"base rotation", "base position"} & set(names):
            changes["base_end"] = nominal.base_end
        return found.replace(**changes)
