"""Effects of the rod, its masses and its clamped end."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple, Self

import jax.numpy as jnp
import numpy as np

from knode_cosserat.identification.effects import (
    Effect,
    Number,
    Replace,
    ReplaceInPart,
    Usual,
    along_axes,
    register,
)
from knode_cosserat.rods.ends import Clamped
from knode_cosserat.rods.loads import AttachedMass
from knode_cosserat.rods.relaxation import Relaxation
from knode_cosserat.rods.section import Sleeve, Stretch
from knode_cosserat.rods.tendon_robots import RoutedTendonRobot
from knode_cosserat.rotation import quaternion_of, quaternion_product

#: first natural frequency of a clamped rod: β² with β = 1.8751
FIRST_MODE = 3.516
#: damping ratio of the first mode for which priors of damping are set
DAMPING_RATIO = 0.02
#: uncertainty of the clamped end's position, as a fraction of the length: tensions measured, or reels
PLACED, PLACED_BY_REELS = 0.004, 0.03
#: an upright base
UPRIGHT = (1.0, 0.0, 0.0, 0.0)


class UsualSizes(NamedTuple):
    """Usual sizes of a robot's quantities, for the widths of priors.

    Attributes:
        length: of the rod (m).
        carried: mass of the rod and of what is attached to it (kg).
        frequency: of the first mode (rad/s).
        damping: bending damping of a usual damping ratio (N m² s).
        drag: linear drag of that damping ratio (kg/(m s)).
    """

    length: float
    carried: float
    frequency: float
    damping: float
    drag: float

    @classmethod
    def of(cls, nominal: RoutedTendonRobot) -> Self:
        """Return the sizes of a robot."""
        L, EI = float(nominal.length), float(nominal.Kbt[0, 0])
        attached = sum(float(each.mass) for each in nominal.loads if isinstance(each, AttachedMass))
        carried = float(nominal.mass_per_length) * L + attached
        frequency = FIRST_MODE * (EI * L / carried) ** 0.5 / L**2
        return cls(
            L, carried, frequency, 2.0 * DAMPING_RATIO * EI / frequency,
            2.0 * DAMPING_RATIO * frequency * carried / L,
        )  # fmt: skip


@register(order=0)
def rod_effects(nominal: RoutedTendonRobot, usual: Usual) -> list[Effect]:
    """Return the effects of the rod."""
    sizes = UsualSizes.of(nominal)
    return [
        *_stiffness_effects(nominal, sizes),
        *_damping_effects(nominal, sizes),
        *_mass_effects(nominal, sizes),
        *_base_effects((PLACED_BY_REELS if nominal.drive == "reel" else PLACED) * sizes.length),
    ]


def _stiffness_effects(nominal: RoutedTendonRobot, sizes: UsualSizes) -> list[Effect]:
    L = sizes.length
    return [
        Effect(
            "stiffness",
            "Young's modulus",
            (Number("youngs_modulus", "Pa", float(nominal.youngs_modulus), 0.5, 1e3, 2e12, True),),
            Replace(("youngs_modulus",)),
            basic=True,
        ),
        Effect(
            "rest curvature",
            "curvature of the unloaded rod, constant and linear along it",
            (
                *along_axes("curvature", "1/m", 0.3 / L, "xy"),
                *along_axes("curvature_slope", "1/m", 0.6 / L, "xy"),
            ),
            _with_curvature,
            _stretchable,
        ),
        Effect(
            "taper",
            "change of the stiffness along the rod",
            (Number("taper", "", 0.0, 0.4, -1.8, 1.8),),
            _with_taper,
            _stretchable,
        ),
        Effect(
            "sleeve",
            "stiffer base of the rod",
            (
                Number("sleeve.stiffening", "", 0.0, 1.0, 0.0, 100.0, begin=0.3),
                Number("sleeve.length", "", 0.15, 0.5, 0.01, 0.6, True),
            ),
            _with_sleeve,
            _sleeved,
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
    ]


def _damping_effects(nominal: RoutedTendonRobot, sizes: UsualSizes) -> list[Effect]:
    branch, linear = nominal.relaxation, nominal.linear_drag
    slow = (0.0, 1.0) if branch is None else (float(branch.stiffness), float(branch.time))
    fluid = 0.0 if linear is None else float(linear[0, 0])
    return [
        Effect(
            "damping",
            "Kelvin-Voigt damping of bending and twisting",
            (Number("bending_damping", "N m2 s", sizes.damping, 1.5, 1e-9, 1e2, True),),
            Replace(("bending_damping",)),
            basic=True,
        ),
        Effect(
            "creep",
            "relaxation of the material: a Maxwell branch beside its stiffness",
            (
                Number("relaxation.stiffness", "", slow[0], 0.2, 0.0, 100.0, begin=0.3),
                Number("relaxation.time", "s", slow[1], 1.0, 0.02, 100.0, True),
            ),
            ReplaceInPart("relaxation", ("stiffness", "time")),
            lambda robot: robot.replace(relaxation=robot.relaxation or Relaxation(stiffness=0.0)),
        ),
        Effect(
            "linear drag",
            "drag in proportion to velocity",
            (Number("linear_drag", "kg/(m s)", fluid, 3.0 * sizes.drag, 0.0, 1e4, begin=0.1),),
            _with_linear_drag,
            _draggable,
            usual=True,
        ),
        Effect(
            "square drag",
            "drag in proportion to the square of velocity",
            (
                Number(
                    "drag", "kg/m2", float(nominal.drag[0, 0]),
                    3.0 * sizes.drag / (0.2 * sizes.length * sizes.frequency), 0.0, 1e3, begin=0.1,
                ),
            ),
            _with_square_drag,
        ),
    ]  # fmt: skip


def _mass_effects(nominal: RoutedTendonRobot, sizes: UsualSizes) -> list[Effect]:
    carried = sizes.carried
    effects = [
        Effect(
            "tip mass",
            "mass at the tip beyond what is known",
            (Number("tip_mass", "kg", 0.0, 0.2 * carried, 0.0, 100.0 * carried, begin=0.1),),
            _with_tip_mass,
            lambda robot: robot.replace(loads=(*robot.loads, AttachedMass(at=1.0, mass=0.0))),
        ),
        Effect(
            "mass along the rod",
            "density of the rod",
            (Number("density", "kg/m3", float(nominal.density), 0.1, 1.0, 1e5, True),),
            Replace(("density",)),
        ),
    ]
    known = [
        (k, float(each.mass)) for k, each in enumerate(nominal.loads)
        if isinstance(each, AttachedMass) and float(each.mass) > 0.0
    ]  # fmt: skip
    if known:
        numbers = tuple(Number(f"loads[{k}].mass", "kg", mass, 0.3, 0.0, 1e4, True) for k, mass in known)
        change = Replace(tuple(f"loads.{k}.mass" for k, _ in known))
        effects.append(Effect("rib masses", "masses on the rod that are known", numbers, change))
    return effects


def _base_effects(placed: float) -> list[Effect]:
    return [
        Effect(
            "base rotation",
            "rotation of the clamped end, or of gravity against the frame",
            along_axes("base_rotation", "rad", 0.05),
            _rotated,
            _placed,
        ),
        Effect(
            "base position",
            "position of the clamped end",
            along_axes("base_position", "m", placed),
            _displaced,
            _placed,
        ),
    ]


def _stretchable(robot: Any) -> Any:
    return robot.replace(sections=(*robot.sections, Stretch(stiffness=(1.0, 0.0))))


def _sleeved(robot: Any) -> Any:
    return robot.replace(sections=(*robot.sections, Sleeve()))


def _draggable(robot: Any) -> Any:
    return robot.replace(linear_drag=np.zeros((3, 3)) if robot.linear_drag is None else robot.linear_drag)


def _placed(robot: Any) -> Any:
    """Return the robot with a stated pose of its clamped end."""
    held = robot.base_end
    if not isinstance(held, Clamped):
        return robot
    position = np.zeros(3) if held.position is None else held.position
    orientation = np.array(UPRIGHT) if held.orientation is None else held.orientation
    return robot.replace(base_end=dataclasses.replace(held, position=position, orientation=orientation))


def _section(robot: Any, kind: type, **changes: Any) -> Any:
    """Change the last section of a kind, which the effect has added."""
    last = max(k for k, section in enumerate(robot.sections) if isinstance(section, kind))
    sections = list(robot.sections)
    sections[last] = dataclasses.replace(sections[last], **changes)
    return robot.replace(sections=tuple(sections))


def _with_curvature(robot: Any, values: list[Any]) -> Any:
    x, y, slope_x, slope_y = values
    zero = jnp.zeros(())
    return _section(
        robot,
        Stretch,
        curvature=jnp.stack([x - 0.5 * slope_x, y - 0.5 * slope_y, zero]),
        curvature_slope=jnp.stack([slope_x, slope_y, zero]),
    )


def _with_taper(robot: Any, values: list[Any]) -> Any:
    (taper,) = values
    return _section(robot, Stretch, stiffness=jnp.stack([1.0 - 0.5 * taper, 1.0 * taper]))


def _with_sleeve(robot: Any, values: list[Any]) -> Any:
    return _section(robot, Sleeve, stiffening=values[0], length=values[1])


def _with_axes(robot: Any, values: list[Any]) -> Any:
    a, b = values
    EI = robot.section.second_moment * robot.youngs_modulus
    GJ = 2.0 * robot.section.second_moment * robot.G
    zero = jnp.zeros(())
    rows = [[EI * (1.0 + a), EI * b, zero], [EI * b, EI * (1.0 - a), zero], [zero, zero, GJ]]
    return robot.replace(bending_stiffness=jnp.stack([jnp.stack(row) for row in rows]))


def _with_linear_drag(robot: Any, values: list[Any]) -> Any:
    return robot.replace(linear_drag=values[0] * np.eye(3))


def _with_square_drag(robot: Any, values: list[Any]) -> Any:
    return robot.replace(drag=values[0] * np.eye(3))


def _with_tip_mass(robot: Any, values: list[Any]) -> Any:
    *others, tip = robot.loads
    return robot.replace(loads=(*others, dataclasses.replace(tip, mass=values[0])))


def _rotated(robot: Any, values: list[Any]) -> Any:
    held = robot.base_end
    turned = quaternion_product(quaternion_of(jnp.stack(values)), jnp.asarray(held.orientation))
    return robot.replace(base_end=dataclasses.replace(held, orientation=turned))


def _displaced(robot: Any, values: list[Any]) -> Any:
    held = robot.base_end
    return robot.replace(base_end=dataclasses.replace(held, position=held.position + jnp.stack(values)))
