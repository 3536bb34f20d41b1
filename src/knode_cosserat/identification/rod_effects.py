"""Effects of the rod, its masses and its clamped end."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np

from knode_cosserat.estimation.parameters import Number, PossibleEffect, Replace, numbers_at
from knode_cosserat.identification.effects import Usual, along_axes, register
from knode_cosserat.rods.ends import Clamped
from knode_cosserat.rods.loads import AttachedMass
from knode_cosserat.rods.parameters import slots_of
from knode_cosserat.rods.relaxation import Relaxation
from knode_cosserat.rods.rod import SlenderRod
from knode_cosserat.rods.section import ABOUT_X, ABOUT_Y, COUPLED, Sleeve, Stretch
from knode_cosserat.rods.tendon_robots import RoutedTendonRobot
from knode_cosserat.rods.tubes import ConcentricTubeRobot
from knode_cosserat.rotation import quaternion_of, quaternion_product

#: first natural frequency of a clamped rod: β² with β = 1.8751
FIRST_MODE = 3.516
#: damping ratio of the first mode for which priors of damping are set
DAMPING_RATIO = 0.02
#: uncertainty of the clamped end's position, as a fraction of the length: tensions measured, or reels
PLACED, PLACED_BY_REELS = 0.004, 0.03
#: an upright base
UPRIGHT = (1.0, 0.0, 0.0, 0.0)


@register(order=0, of=SlenderRod)
def shape_effects(nominal: SlenderRod, usual: Usual) -> list[PossibleEffect]:
    """Return the effects of any rod that its parts do not state: of its shape, masses and damping."""
    if isinstance(nominal, RoutedTendonRobot | ConcentricTubeRobot):
        return []
    stated = {"stiffness", "mass along the rod", "rib masses", "sleeve"}
    # a mass at the tip is in doubt itself
    stated |= {"tip mass"} if any(load.applied_at == 1.0 for load in nominal.loads) else set()
    return [it for it in (*_stiffness_effects(nominal), *_inertia_effects(nominal)) if it.name not in stated]


@register(order=0, of=RoutedTendonRobot)
def rod_effects(nominal: RoutedTendonRobot, usual: Usual) -> list[PossibleEffect]:
    """Return the effects of a rod with tendons."""
    placed = (PLACED_BY_REELS if nominal.drive == "reel" else PLACED) * float(nominal.length)
    return [
        *_stiffness_effects(nominal),
        *_inertia_effects(nominal),
        PossibleEffect("base rotation", along_axes("base_rotation", "rad", 0.05), _rotated, _placed),
        PossibleEffect("base position", along_axes("base_position", "m", placed), _displaced, _placed),
    ]


def _stiffness_effects(nominal: SlenderRod) -> list[PossibleEffect]:
    L = float(nominal.length)
    if nominal.youngs_modulus is None:
        # a factor of the table's stiffness
        modulus = Number("cross_section.stiffness", "", 1.0, 0.5, 1e-3, 1e3, True)
        stiffness = PossibleEffect("stiffness", (modulus,), _with_table, basic=True)
    else:
        stiffness = PossibleEffect(
            "stiffness", numbers_at(nominal, "youngs_modulus", 0.5, logarithmic=True), basic=True
        )
    curvature = along_axes("curvature", "1/m", 0.3 / L, "xy")
    slope = along_axes("curvature_slope", "1/m", 0.6 / L, "xy")
    sleeve = (
        Number("sleeve.stiffening", "", 0.0, 1.0, 0.0, 100.0, begin=0.3),
        Number("sleeve.length", "", 0.15, 0.5, 0.01, 0.6, True, shape=True),
    )
    effects = [
        stiffness,
        PossibleEffect("rest curvature", (*curvature, *slope), _with_curvature, _stretchable),
        PossibleEffect("taper", (Number("taper", "", 0.0, 0.4, -1.8, 1.8),), _with_taper, _stretchable),
        PossibleEffect("sleeve", sleeve, _with_sleeve, _sleeved, usual=True),
    ]
    if nominal.youngs_modulus is not None:
        axes = tuple(Number(label, "", 0.0, 0.1, -0.9, 0.9) for label in ("anisotropy", "anisotropy_turned"))
        effects.append(PossibleEffect("stiffness axes", axes, _with_axes))
    return effects


def _inertia_effects(nominal: SlenderRod) -> list[PossibleEffect]:
    """Return the effects of damping, drag and masses."""
    L, EI = float(nominal.length), float(nominal.Kbt[0, 0])
    masses = [(k, float(load.mass)) for k, load in enumerate(nominal.loads) if isinstance(load, AttachedMass)]
    carried = float(nominal.mass_per_length) * L + sum(mass for _, mass in masses)
    # frequency of the first mode (rad/s), and drag (kg/(m s)) for its usual damping ratio
    frequency = FIRST_MODE * (EI * L / carried) ** 0.5 / L**2
    drag = 2.0 * DAMPING_RATIO * frequency * carried / L
    # of a robot that states none (N m² s), that of the same ratio
    damping = float(np.ravel(nominal.bending_damping)[0]) or 2.0 * DAMPING_RATIO * EI / frequency
    viscous = Number("bending_damping", "N m2 s", damping, 1.5, 1e-9, 1e2, True)
    tip = Replace((f"loads.{len(nominal.loads)}.mass",))
    linear = numbers_at(_draggable(nominal), "linear_drag", 3.0 * drag, begin=0.1)
    square = numbers_at(nominal, "drag", 3.0 * drag / (0.2 * L * frequency), begin=0.1)
    added = Number("tip_mass", "kg", 0.0, 0.2 * carried, 0.0, 100.0 * carried, begin=0.1)
    if nominal.density is None:
        lines = numbers_at(nominal, "cross_section.mass_per_length", 0.1, logarithmic=True)
        along = PossibleEffect(
            "mass along the rod", lines, Replace(("cross_section.mass_per_length",), "multiple")
        )
    else:
        along = PossibleEffect("mass along the rod", numbers_at(nominal, "density", 0.1, logarithmic=True))
    effects = [
        PossibleEffect("damping", (viscous,), basic=True, of_motion=True),
        *_creep_effects(nominal),
        PossibleEffect("linear drag", linear, part=_draggable, usual=True, of_motion=True),
        PossibleEffect("square drag", square, of_motion=True),
        PossibleEffect("tip mass", (added,), tip, _with_tip_mass),
        along,
    ]
    ribs = [f"loads.{k}.mass" for k, mass in masses if mass > 0.0]
    known = [it for path in ribs for it in numbers_at(nominal, path, 0.3, logarithmic=True)]
    return [*effects, PossibleEffect("rib masses", tuple(known))] if known else effects


def _creep_effects(nominal: SlenderRod) -> list[PossibleEffect]:
    """Return creep, of robots that may have a Maxwell branch."""
    if "relaxation" not in slots_of(type(nominal)):
        return []
    relaxing = _relaxing(nominal)
    creep = (
        *numbers_at(relaxing, "relaxation.stiffness", 0.2, high=100.0, begin=0.3),
        *numbers_at(relaxing, "relaxation.time", 1.0, low=0.02, high=100.0, logarithmic=True, shape=True),
    )
    return [PossibleEffect("creep", creep, part=_relaxing, of_motion=True)]


# parts that effects change, where a robot lacks them


def _stretchable(robot: Any) -> Any:
    return robot.replace(sections=(*robot.sections, Stretch(stiffness=(1.0, 0.0))))


def _sleeved(robot: Any) -> Any:
    return robot.replace(sections=(*robot.sections, Sleeve()))


def _relaxing(robot: Any) -> Any:
    return robot.replace(relaxation=robot.relaxation or Relaxation(stiffness=0.0))


def _draggable(robot: Any) -> Any:
    return robot.replace(linear_drag=np.zeros((3, 3)) if robot.linear_drag is None else robot.linear_drag)


def _with_tip_mass(robot: Any) -> Any:
    return robot.replace(loads=(*robot.loads, AttachedMass(at=1.0, mass=0.0)))


def _placed(robot: Any) -> Any:
    """Return the robot with a stated pose of its clamped end."""
    end = robot.base_end
    if not isinstance(end, Clamped):
        return robot
    position = np.zeros(3) if end.position is None else end.position
    orientation = np.array(UPRIGHT) if end.orientation is None else end.orientation
    return robot.replace(base_end=dataclasses.replace(end, position=position, orientation=orientation))


# changes


def _section(robot: Any, kind: type, **changes: Any) -> Any:
    """Change the last section of a kind, which the effect has added."""
    last = max(k for k, section in enumerate(robot.sections) if isinstance(section, kind))
    return robot.replace(**{f"sections.{last}.{name}": value for name, value in changes.items()})


def _with_curvature(robot: Any, values: list[Any]) -> Any:
    x, y, slope_x, slope_y = values
    zero = jnp.zeros(())
    constant = jnp.stack([x - 0.5 * slope_x, y - 0.5 * slope_y, zero])
    return _section(robot, Stretch, curvature=constant, curvature_slope=jnp.stack([slope_x, slope_y, zero]))


def _with_taper(robot: Any, values: list[Any]) -> Any:
    (taper,) = values
    return _section(robot, Stretch, stiffness=jnp.stack([1.0 - 0.5 * taper, 1.0 * taper]))


def _with_sleeve(robot: Any, values: list[Any]) -> Any:
    return _section(robot, Sleeve, stiffening=values[0], length=values[1])


def _with_table(robot: Any, values: list[Any]) -> Any:
    names = (
        "bending_stiffness",
        "bending_stiffness_y",
        "torsional_stiffness",
        "axial_stiffness",
        "shear_stiffness",
    )
    table = {name: getattr(robot.cross_section, name) for name in names}
    scaled = {f"cross_section.{name}": one * values[0] for name, one in table.items() if one is not None}
    return robot.replace(**scaled)


def _with_axes(robot: Any, values: list[Any]) -> Any:
    """Change the stiffness to C (1 + A) Cᵀ, from C Cᵀ of the section and A = [[a, b], [b, -a]]."""
    a, b = values
    C = jnp.linalg.cholesky(jnp.asarray(robot.Kbt))
    change = a * (ABOUT_X - ABOUT_Y) + b * COUPLED
    return robot.replace(bending_stiffness=C @ (np.eye(3) + change) @ C.T)


def _rotated(robot: Any, values: list[Any]) -> Any:
    orientation = jnp.asarray(robot.base_end.orientation)
    turned = quaternion_product(quaternion_of(jnp.stack(values)), orientation)
    return robot.replace(**{"base_end.orientation": turned})


def _displaced(robot: Any, values: list[Any]) -> Any:
    return robot.replace(**{"base_end.position": robot.base_end.position + jnp.stack(values)})
