"""Library of identifiable effects: each is one physical cause with its numbers, units and prior ranges.

An effect changes parameters of a robot. At their nominal values it changes nothing, so one compiled program
serves any selection of effects: unselected parameters stay nominal.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from knode_cosserat.rods.loads import AttachedMass
from knode_cosserat.rods.routed_robot import RoutedTendonRobot
from knode_cosserat.rotation import quaternion_of, quaternion_product

#: first natural frequency of a clamped rod: β² with β = 1.8751
FIRST_MODE = 3.516
#: nominal damping ratio of the first mode where the data sheet says less or more
DAMPING_RATIO = 0.02


#: change of a robot by the values of an effect's parameters; equal for all robots of the same parts
Change = Callable[[Any, list[Any]], Any]


class Number(NamedTuple):
    """One number of an effect: its nominal value, and the standard deviation of its prior.

    The search moves x = (value - nominal) / width, or log(value / nominal) / width if `logarithmic`. It
    starts at `begin`, in these coordinates: for example, friction has no derivative at zero.
    """

    label: str
    unit: str
    nominal: float
    width: float
    low: float = -np.inf
    high: float = np.inf
    logarithmic: bool = False
    begin: float = 0.0

    def value(self, x: Any) -> Any:
        """Return the value at a coordinate; it may be traced."""
        if self.logarithmic:
            return self.nominal * jnp.exp(self.width * x)
        return self.nominal + self.width * x

    def coordinate(self, value: float) -> float:
        """Return the coordinate of a value: the inverse of `value`."""
        moved = np.log(value / self.nominal) if self.logarithmic else value - self.nominal
        return float(moved / self.width)

    @property
    def bounds(self) -> tuple[float, float]:
        """Lowest and highest coordinate."""
        if self.logarithmic:
            with np.errstate(divide="ignore"):
                low, high = (
                    np.log(max(end, 0.0) / self.nominal) / self.width for end in (self.low, self.high)
                )
        else:
            low, high = ((end - self.nominal) / self.width for end in (self.low, self.high))
        return float(low), float(high)


@dataclasses.dataclass(frozen=True)
class Effect:
    """A physical cause, its parameters, and the change that it makes to a robot.

    `needs` names effects that it requires. A `basic` effect is always identified. A search with few effects
    starts with the `usual` ones. An effect `of_recordings` belongs to the recordings, not to the robot.
    """

    name: str
    meaning: str
    numbers: tuple[Number, ...]
    apply: Change
    needs: tuple[str, ...] = ()
    basic: bool = False
    usual: bool = False
    of_recordings: bool = False


@dataclasses.dataclass(frozen=True)
class Replace:
    """Replaces parameters of a robot; equal to another by their names, so that programs are shared."""

    parameters: tuple[str, ...]

    def __call__(self, robot: Any, values: list[Any]) -> Any:
        """Return the robot with these values."""
        return robot.replace(**dict(zip(self.parameters, values, strict=True)))


@dataclasses.dataclass(frozen=True)
class ReplaceInPart:
    """Replaces parameters of one of the robot's parts."""

    part: str
    parameters: tuple[str, ...]

    def __call__(self, robot: Any, values: list[Any]) -> Any:
        """Return the robot with these values."""
        changes = dict(zip(self.parameters, values, strict=True))
        return robot.replace(**{self.part: dataclasses.replace(getattr(robot, self.part), **changes)})


@dataclasses.dataclass(frozen=True)
class ReplaceMasses:
    """Replaces the masses of a robot's loads, by their numbers in `loads`."""

    loads: tuple[int, ...]

    def __call__(self, robot: Any, values: list[Any]) -> Any:
        """Return the robot with these masses (kg)."""
        loads = list(robot.loads)
        for k, mass in zip(self.loads, values, strict=True):
            loads[k] = dataclasses.replace(loads[k], mass=mass)
        return robot.replace(loads=tuple(loads))


def _axes(label: str, unit: str, width: float, axes: str = "xyz", **more: Any) -> tuple[Number, ...]:
    return tuple(Number(f"{label}.{axis}", unit, 0.0, width, **more) for axis in axes)


def effects_of(
    nominal: RoutedTendonRobot, tensions: float, highest: float, placed: float = 0.004
) -> list[Effect]:
    """Return the effects that a tendon robot may have.

    Args:
        nominal: the nominal robot, with the parts that effects need (see `model.extended`).
        tensions: a usual tension of one tendon (N).
        highest: the highest tension of all tendons together (N).
        placed: uncertainty of the clamped end's position, as a part of the length.
    """
    L, count = float(nominal.length), nominal.tendon_count
    mass = float(nominal.mass_per_length) * L
    carried = mass + sum(float(each.mass) for each in nominal.loads if isinstance(each, AttachedMass))
    EI = float(nominal.Kbt[0, 0])
    # the last mass is that of the effect "tip mass"
    ribs = [
        (k, float(each.mass)) for k, each in enumerate(nominal.loads[:-1])
        if isinstance(each, AttachedMass) and float(each.mass) > 0.0
    ]  # fmt: skip
    # above the usual tension: a robot that shakes at rest has no friction to be found
    shaking = 0.5 * (tensions * count + highest)
    shaking_width = max(0.5 * (highest - shaking), 0.05 * highest)
    frequency = FIRST_MODE * (EI * L / carried) ** 0.5 / L**2
    damping = 2.0 * DAMPING_RATIO * EI / frequency
    drag = 2.0 * DAMPING_RATIO * frequency * carried / L
    ribbed = nominal.rib_spacing
    spacing = (0.0, 0.0) if ribbed is None else (float(ribbed.softening), float(ribbed.share))
    effects = [
        Effect(
            "stiffness",
            "Young's modulus",
            (Number("youngs_modulus", "Pa", float(nominal.youngs_modulus), 0.5, 1e3, 2e12, True),),
            Replace(("youngs_modulus",)),
            basic=True,
        ),
        Effect(
            "damping",
            "Kelvin-Voigt damping of bending and twisting",
            (Number("bending_damping", "N m2 s", damping, 1.5, 1e-9, 1e2, True),),
            Replace(("bending_damping",)),
            basic=True,
        ),
        Effect(
            "tendon offset",
            "distance of the tendons from the axis",
            (Number("tendon_offset", "m", float(nominal.tendon_offset) or 1e-3, 0.1, 1e-5, 1.0, True),),
            Replace(("tendon_offset",)),
            usual=True,
        ),
        Effect(
            "tendon angles",
            "angles of the tendons about the rod",
            tuple(
                Number(f"tendon_angles[{k}]", "rad", float(angle), 0.06)
                for k, angle in enumerate(np.asarray(nominal.tendon_angles))
            ),
            _with_angles,
        ),
        Effect(
            "tendon twist",
            "angle by which ribs, and the tendons in them, turn about the rod from base to tip",
            (Number("tendon_twist", "rad", float(nominal.tendon_twist or 0.0), 0.06),),
            Replace(("tendon_twist",)),
        ),
        Effect(
            "load cell gains",
            "tension of each tendon over what its load cell measures",
            tuple(Number(f"load_cells.gain[{k}]", "", 1.0, 0.05, 0.1, 10.0, True) for k in range(count)),
            _with_gains,
        ),
        Effect(
            "load cell offsets",
            "tension of each tendon where its load cell measures none",
            tuple(Number(f"load_cells.offset[{k}]", "N", 0.0, 0.03 * tensions) for k in range(count)),
            _with_offsets,
        ),
        Effect(
            "early anchors",
            "tendons that are anchored at the last rib before the tip",
            tuple(Number(f"anchors.share[{k}]", "", 1.0, 0.5, 0.0, 1.0, begin=-0.3) for k in range(count)),
            _with_anchors,
        ),
        Effect(
            "rest curvature",
            "curvature of the unloaded rod, constant and linear along it",
            (
                *_axes("curvature", "1/m", 0.3 / L, "xy"),
                *_axes("curvature_slope", "1/m", 0.6 / L, "xy"),
            ),
            _with_curvature,
        ),
        Effect(
            "taper",
            "change of the stiffness along the rod",
            (Number("taper", "", 0.0, 0.4, -1.8, 1.8),),
            _with_taper,
        ),
        Effect(
            "sleeve",
            "stiffer base of the rod",
            (
                Number("sleeve.stiffening", "", 0.0, 1.0, 0.0, 100.0, begin=0.3),
                Number("sleeve.length", "", 0.15, 0.5, 0.01, 0.6, True),
            ),
            _with_sleeve,
            usual=True,
        ),
        Effect(
            "stiffness axes",
            "difference of the bending stiffness about two axes",
            (
                Number("anisotropy", "", 0.0, 0.1, -0.9, 0.9),
                Number("anisotropy_turned", "", 0.0, 0.1, -0.9, 0.9),
            ),
            _with_axes,
        ),
        Effect(
            "creep",
            "relaxation of the material: a Maxwell branch beside its stiffness",
            (
                Number("relaxation.stiffness", "", 0.0, 0.2, 0.0, 100.0, begin=0.3),
                Number("relaxation.time", "s", 1.0, 1.0, 0.02, 100.0, True),
            ),
            ReplaceInPart("relaxation", ("stiffness", "time")),
        ),
        Effect(
            "linear drag",
            "drag in proportion to velocity",
            (Number("linear_drag", "kg/(m s)", 0.0, 3.0 * drag, 0.0, 1e4, begin=0.1),),
            _with_linear_drag,
            usual=True,
        ),
        Effect(
            "square drag",
            "drag in proportion to the square of velocity",
            (Number("drag", "kg/m2", 0.0, 3.0 * drag / (0.2 * L * frequency), 0.0, 1e3, begin=0.1),),
            _with_square_drag,
        ),
        Effect(
            "tip mass",
            "mass at the tip beyond what is known",
            (Number("tip_mass", "kg", 0.0, 0.2 * carried, 0.0, 100.0 * carried, begin=0.1),),
            _with_tip_mass,
        ),
        Effect(
            "mass along the rod",
            "density of the rod",
            (Number("density", "kg/m3", float(nominal.density), 0.1, 1.0, 1e5, True),),
            Replace(("density",)),
        ),
        Effect(
            "base rotation",
            "rotation of the clamped end, or of gravity against the frame",
            _axes("base_rotation", "rad", 0.05),
            _rotated,
        ),
        Effect(
            "base position",
            "position of the clamped end",
            _axes("base_position", "m", placed * L),
            _displaced,
        ),
        Effect(
            "rib spacing",
            "softer bending under tension, for tendons are straight between ribs",
            (Number("rib_spacing.softening", "m2", spacing[0], (0.2 * L) ** 2 / 12.0, 0.0, L**2, begin=0.3),),
            ReplaceInPart("rib_spacing", ("softening",)),
        ),
        Effect(
            "rib spans",
            "softer bending under tension between the ribs, or bodies, whose places are known",
            (Number("rib_spacing.share", "", spacing[1], 0.5, 0.0, 10.0, begin=0.5),),
            ReplaceInPart("rib_spacing", ("share",)),
            usual=True,
        ),
        Effect(
            "friction",
            "friction of the tendons by their length, with its hysteresis",
            (
                Number("friction.wobble", "1/m", 0.0, 0.2 / L, 0.0, 100.0, begin=0.5),
                Number("friction.reach", "1/m", 0.06 / L, 1.0, 1e-4, 100.0, True),
                Number("friction.at_rest", "", 0.0, 1.0, -1.0, 1.0, begin=0.3),
            ),
            ReplaceInPart("friction", ("wobble", "reach", "at_rest")),
            usual=True,
        ),
        Effect(
            "friction by curvature",
            "friction of the tendons by the angle they turn",
            (Number("friction.curvature", "1/rad", 0.0, 0.1, 0.0, 10.0, begin=0.3),),
            ReplaceInPart("friction", ("curvature",)),
            needs=("friction",),
            usual=True,
        ),
        Effect(
            "vibration",
            "loss of friction where high tensions make the robot shake",
            (
                Number("vibration.tension", "N", shaking, shaking_width, 0.0, 1e6),
                Number("vibration.rate", "1/(N s)", 0.0, 0.5, 0.0, 1e3, begin=0.5),
                Number("vibration.softening", "m2", 0.0, (0.1 * L) ** 2 / 12.0, 0.0, L**2, begin=0.3),
            ),
            ReplaceInPart("vibration", ("tension", "rate", "softening")),
            needs=("friction",),
            usual=True,
        ),
    ]  # fmt: skip
    if ribs:
        numbers = tuple(Number(f"loads[{k}].mass", "kg", mass, 0.3, 0.0, 1e4, True) for k, mass in ribs)
        effects.append(
            Effect(
                "rib masses",
                "masses on the rod that are known",
                numbers,
                ReplaceMasses(tuple(k for k, _ in ribs)),
            )
        )
    # of a usual size: a few samples of 20 to 50 Hz
    late = Number("load_cells.latency", "s", 0.0, 0.02, -0.2, 0.2)
    meaning = "delay of the load cells' readings behind the poses"
    effects.append(Effect("latency", meaning, (late,), _with_latency, of_recordings=True))
    return effects


def _stretch(robot: Any, **changes: Any) -> Any:
    """Change the stretch over the whole rod that `model.extended` has put last but one."""
    *others, stretch, sleeve = robot.sections
    return robot.replace(sections=(*others, dataclasses.replace(stretch, **changes), sleeve))


def _with_angles(robot: Any, values: list[Any]) -> Any:
    return robot.replace(tendon_angles=jnp.stack(values))


def _with_gains(robot: Any, values: list[Any]) -> Any:
    return _load_cells(robot, gain=jnp.stack(values))


def _with_offsets(robot: Any, values: list[Any]) -> Any:
    return _load_cells(robot, offset=jnp.stack(values))


def _with_latency(robot: Any, values: list[Any]) -> Any:
    return _load_cells(robot, latency=values[0])


def _with_anchors(robot: Any, values: list[Any]) -> Any:
    return robot.replace(anchors=dataclasses.replace(robot.anchors, share=jnp.stack(values)))


def _with_curvature(robot: Any, values: list[Any]) -> Any:
    x, y, slope_x, slope_y = values
    zero = jnp.zeros(())
    return _stretch(
        robot,
        curvature=jnp.stack([x - 0.5 * slope_x, y - 0.5 * slope_y, zero]),
        curvature_slope=jnp.stack([slope_x, slope_y, zero]),
    )


def _with_taper(robot: Any, values: list[Any]) -> Any:
    (taper,) = values
    return _stretch(robot, stiffness=jnp.stack([1.0 - 0.5 * taper, 1.0 * taper]))


def _with_linear_drag(robot: Any, values: list[Any]) -> Any:
    return robot.replace(linear_drag=values[0] * np.eye(3))


def _with_square_drag(robot: Any, values: list[Any]) -> Any:
    return robot.replace(drag=values[0] * np.eye(3))


def _with_sleeve(robot: Any, values: list[Any]) -> Any:
    *others, sleeve = robot.sections
    sleeve = dataclasses.replace(sleeve, stiffening=values[0], length=values[1])
    return robot.replace(sections=(*others, sleeve))


def _with_axes(robot: Any, values: list[Any]) -> Any:
    a, b = values
    EI = robot.section.second_moment * robot.youngs_modulus
    GJ = 2.0 * robot.section.second_moment * robot.G
    zero = jnp.zeros(())
    rows = [[EI * (1.0 + a), EI * b, zero], [EI * b, EI * (1.0 - a), zero], [zero, zero, GJ]]
    return robot.replace(bending_stiffness=jnp.stack([jnp.stack(row) for row in rows]))


def _with_tip_mass(robot: Any, values: list[Any]) -> Any:
    *others, tip = robot.loads
    return robot.replace(loads=(*others, dataclasses.replace(tip, mass=values[0])))


def _load_cells(robot: Any, **changes: Any) -> Any:
    return robot.replace(load_cells=dataclasses.replace(robot.load_cells, **changes))


def _rotated(robot: Any, values: list[Any]) -> Any:
    held = robot.base_end
    turned = quaternion_product(quaternion_of(jnp.stack(values)), jnp.asarray(held.orientation))
    return robot.replace(base_end=dataclasses.replace(held, orientation=turned))


def _displaced(robot: Any, values: list[Any]) -> Any:
    held = robot.base_end
    return robot.replace(base_end=dataclasses.replace(held, position=held.position + jnp.stack(values)))
