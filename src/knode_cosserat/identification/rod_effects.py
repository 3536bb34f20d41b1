"""Effects of the rod, its masses and its clamped end."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np

from knode_cosserat.estimation.parameters import Effect, Number, Replace
from knode_cosserat.identification.effects import Usual, along_axes, register
from knode_cosserat.rods.ends import Clamped
from knode_cosserat.rods.loads import AttachedMass
from knode_cosserat.rods.relaxation import Relaxation
from knode_cosserat.rods.section import ABOUT_X, ABOUT_Y, COUPLED, Sleeve, Stretch
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


@register(order=0)
def rod_effects(nominal: RoutedTendonRobot, usual: Usual) -> list[Effect]:
    """Return the effects of the rod."""
    placed = (PLACED_BY_REELS if nominal.drive == "reel" else PLACED) * float(nominal.length)
    return [
        *_stiffness_effects(nominal),
        *_inertia_effects(nominal),
        Effect(
            "base rotation", "rotation of the clamped end, or of gravity against the frame",
            along_axes("base_rotation", "rad", 0.05), _rotated, _placed,
        ),
        Effect(
            "base position", "position of the clamped end", along_axes("base_position", "m", placed),
            _displaced, _placed,
        ),
    ]  # fmt: skip


def _stiffness_effects(nominal: RoutedTendonRobot) -> list[Effect]:
    L = float(nominal.length)
    if nominal.youngs_modulus is None:
        modulus = Number("cross_section.stiffness", "", 1.0, 0.5, 1e-3, 1e3, True)
        stiffness = Effect(
            "stiffness", "factor of the table's stiffness", (modulus,), _with_table, basic=True
        )
    else:
        modulus = Number("youngs_modulus", "Pa", float(nominal.youngs_modulus), 0.5, 1e3, 2e12, True)
        stiffness = Effect(
            "stiffness", "Young's modulus", (modulus,), Replace(("youngs_modulus",)), basic=True
        )
    curvature = (
        *along_axes("curvature", "1/m", 0.3 / L, "xy"), *along_axes("curvature_slope", "1/m", 0.6 / L, "xy")
    )  # fmt: skip
    sleeve = (
        Number("sleeve.stiffening", "", 0.0, 1.0, 0.0, 100.0, begin=0.3),
        Number("sleeve.length", "", 0.15, 0.5, 0.01, 0.6, True, shape=True),
    )
    axes = tuple(Number(label, "", 0.0, 0.1, -0.9, 0.9) for label in ("anisotropy", "anisotropy_turned"))
    effects = [
        stiffness,
        Effect(
            "rest curvature", "curvature of the unloaded rod, constant and linear along it", curvature,
            _with_curvature, _stretchable,
        ),
        Effect(
            "taper", "change of the stiffness along the rod", (Number("taper", "", 0.0, 0.4, -1.8, 1.8),),
            _with_taper, _stretchable,
        ),
        Effect("sleeve", "stiffer base of the rod", sleeve, _with_sleeve, _sleeved, usual=True),
    ]  # fmt: skip
    if nominal.youngs_modulus is not None:
        about = "difference of the bending stiffness about two axes"
        effects.append(Effect("stiffness axes", about, axes, _with_axes))
    return effects


def _inertia_effects(nominal: RoutedTendonRobot) -> list[Effect]:
    """Return the effects of damping, drag and masses."""
    L, EI = float(nominal.length), float(nominal.Kbt[0, 0])
    masses = [(k, float(load.mass)) for k, load in enumerate(nominal.loads) if isinstance(load, AttachedMass)]
    carried = float(nominal.mass_per_length) * L + sum(mass for _, mass in masses)
    # frequency of the first mode (rad/s), damping (N m² s) and drag (kg/(m s)) for its usual damping ratio
    frequency = FIRST_MODE * (EI * L / carried) ** 0.5 / L**2
    damping, drag = 2.0 * DAMPING_RATIO * EI / frequency, 2.0 * DAMPING_RATIO * frequency * carried / L
    branch, linear = nominal.relaxation, nominal.linear_drag
    slow = (0.0, 1.0) if branch is None else (float(branch.stiffness), float(branch.time))
    creep = (
        Number("relaxation.stiffness", "", slow[0], 0.2, 0.0, 100.0, begin=0.3),
        Number("relaxation.time", "s", slow[1], 1.0, 0.02, 100.0, True, shape=True),
    )
    fluid = Number(
        "linear_drag", "kg/(m s)", 0.0 if linear is None else float(linear[0, 0]), 3.0 * drag, 0.0, 1e4,
        begin=0.1,
    )  # fmt: skip
    square = Number(
        "drag", "kg/m2", float(nominal.drag[0, 0]), 3.0 * drag / (0.2 * L * frequency), 0.0, 1e3, begin=0.1
    )
    viscous = Number("bending_damping", "N m2 s", damping, 1.5, 1e-9, 1e2, True)
    tip = Number("tip_mass", "kg", 0.0, 0.2 * carried, 0.0, 100.0 * carried, begin=0.1)
    if nominal.density is None:
        mass = "cross_section.mass_per_length"
        density = Number(mass, "kg/m", float(nominal.mass_per_length), 0.1, 1e-9, 1e6, True)
    else:
        mass = "density"
        density = Number(mass, "kg/m3", float(nominal.density), 0.1, 1.0, 1e5, True)
    ribs = [(k, mass) for k, mass in masses if mass > 0.0]
    known = tuple(Number(f"loads[{k}].mass", "kg", mass, 0.3, 0.0, 1e4, True) for k, mass in ribs)
    effects = [
        Effect(
            "damping", "Kelvin-Voigt damping of bending and twisting", (viscous,),
            Replace(("bending_damping",)), basic=True,
        ),
        Effect(
            "creep", "relaxation of the material: a Maxwell branch beside its stiffness", creep,
            Replace(("relaxation.stiffness", "relaxation.time")), _relaxing,
        ),
        Effect(
            "linear drag", "drag in proportion to velocity", (fluid,), Replace(("linear_drag",), "diagonal"),
            _draggable, usual=True,
        ),
        Effect(
            "square drag", "drag in proportion to the square of velocity", (square,),
            Replace(("drag",), "diagonal"),
        ),
        Effect(
            "tip mass", "mass at the tip beyond what is known", (tip,),
            Replace((f"loads.{len(nominal.loads)}.mass",)), _with_tip_mass,
        ),
        Effect("mass along the rod", "density of the rod", (density,), Replace((mass,), "multiple")),
    ]  # fmt: skip
    if known:
        change = Replace(tuple(f"loads.{k}.mass" for k, _ in ribs))
        effects.append(Effect("rib masses", "masses on the rod that are known", known, change))
    return effects


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
    C = jnp.linalg.cholesky(jnp.asarray(robot.section.Kbt))
    change = a * (ABOUT_X - ABOUT_Y) + b * COUPLED
    return robot.replace(bending_stiffness=C @ (np.eye(3) + change) @ C.T)


def _rotated(robot: Any, values: list[Any]) -> Any:
    orientation = jnp.asarray(robot.base_end.orientation)
    turned = quaternion_product(quaternion_of(jnp.stack(values)), orientation)
    return robot.replace(**{"base_end.orientation": turned})


def _displaced(robot: Any, values: list[Any]) -> Any:
    return robot.replace(**{"base_end.position": robot.base_end.position + jnp.stack(values)})
