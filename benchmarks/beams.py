"""Rods of which something is known in closed form: how far the solver is from it.

For tests and for docs/validation.md. Rods are 1 m long; loads are in natural units, EI / L² and EI / L.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

import knode_cosserat as kc
from benchmarks import closed_forms
from benchmarks.buckling import critical_load
from benchmarks.shapes import resting
from knode_cosserat.rods.section import Differences, FunctionSection

#: so thin that its rotary inertia is 6e-9 of the first frequency
LENGTH, RADIUS, YOUNGS_MODULUS, DENSITY = 1.0, 1e-4, 3e9, 1200.0
AREA, EI = np.pi * RADIUS**2, YOUNGS_MODULUS * np.pi * RADIUS**4 / 4
FORCE, MOMENT = EI / LENGTH**2, EI / LENGTH
#: of a rod that neither shears nor stretches
RIGID = 1e10 * FORCE
#: so soft that shear is a tenth of the deflection
SOFT = 30 * FORCE
#: solved so far that what is left is the schemes' error
NEWTON = kc.solvers.NewtonOptions(tolerance=1e-13)
UP = np.array([1.0, 0.0, 0.0, 0.0])


def rod(
    nodes: int, *, force: Any = (0, 0, 0), moment: Any = (0, 0, 0), even: Any = (0, 0, 0), **changes: Any
) -> Any:
    """Clamped at its foot, upright, loaded at its tip and evenly; it resists twist as it does bending."""
    loads = (
        kc.robots.loads.PointWrench(force=np.multiply(force, FORCE), moment=np.multiply(moment, MOMENT)),
        kc.robots.loads.DistributedWrench(force=np.multiply(even, FORCE / LENGTH)),
    )
    parameters = {
        "length": LENGTH,
        "radius": RADIUS,
        "youngs_modulus": YOUNGS_MODULUS,
        "density": DENSITY,
        "gravity": (0, 0, 0),
        "shear_stiffness": (RIGID, RIGID, RIGID),
        "bending_stiffness": (EI, EI, EI),
    }
    return kc.robots.SlenderRod(nodes=nodes, loads=loads, **{**parameters, **changes})


def positions(robot: Any, space: str, control: Any = (), initial: Any = None) -> np.ndarray:
    """Of the nodes at rest (nodes, 3)."""
    found = kc.equilibrium(
        robot, np.asarray(control, dtype=float), space=space, newton=NEWTON, initial=initial
    )
    return np.asarray(found.position[0])


def _farthest(found: np.ndarray, expected: np.ndarray) -> float:
    """The largest distance from where a node should be, as a part of the length."""
    return float(np.linalg.norm(found - expected, axis=1).max() / LENGTH)


# statics with an exact solution


def small_tip_force(nodes: int, space: str) -> float:
    """Error of a small deflection that is a tenth shear; the nonlinear part is of the size of its square."""
    load = 1e-4
    tip = positions(rod(nodes, force=(load, 0, 0), shear_stiffness=(SOFT, SOFT, 1e3 * SOFT)), space)[-1, 0]
    return abs(tip / closed_forms.tip_force_deflection(load * FORCE, LENGTH, EI, SOFT) - 1)


def small_even_load(nodes: int, space: str) -> float:
    """The same of an even load."""
    load = 1e-4
    tip = positions(rod(nodes, even=(load, 0, 0), shear_stiffness=(SOFT, SOFT, 1e3 * SOFT)), space)[-1, 0]
    return abs(tip / closed_forms.even_load_deflection(load * FORCE / LENGTH, LENGTH, EI, SOFT) - 1)


def bent_by_moment(moment: Any) -> Callable[[int, str], float]:
    """Distance from the circle or helix of a moment at the tip, in EI / L."""

    def error(nodes: int, space: str) -> float:
        s = np.linspace(0, LENGTH, nodes)
        exact = closed_forms.helix(np.multiply(moment, MOMENT), s, EI)
        return _farthest(positions(rod(nodes, moment=moment), space), exact)

    return error


def elastica(load: float) -> Callable[[int, str], float]:
    """Relative error of deflection and shortening under a dead force across the tip, in EI / L²."""

    def error(nodes: int, space: str) -> float:
        tip = positions(rod(nodes, force=(load, 0, 0)), space)[-1]
        found = np.array([tip[0], LENGTH - tip[2]]) / LENGTH
        return float(np.abs(found / closed_forms.elastica(load) - 1).max())

    return error


TENDON_TENSION, TENDON_OFFSET = 3.0, 0.02


def tendon_circle(nodes: int, space: str) -> float:
    """Distance from the circle that one straight tendon makes of a rod."""
    robot = kc.robots.RoutedTendonRobot(
        length=LENGTH,
        radius=4e-3,
        youngs_modulus=YOUNGS_MODULUS,
        density=DENSITY,
        gravity=(0, 0, 0),
        tendon_offset=TENDON_OFFSET,
        tendon_angles=(0.0, np.pi / 2),
        nodes=nodes,
    )
    s = np.linspace(0, LENGTH, nodes)
    stiffness = float(robot.Kbt[0, 0]), float(robot.Kse[2, 2])
    exact = closed_forms.tendon_circle(TENDON_TENSION, TENDON_OFFSET, s, *stiffness)
    return _farthest(positions(robot, space, (TENDON_TENSION, 0.0)), exact)


CATENARY = closed_forms.Catenary(LENGTH, span=0.8, weight=60 * FORCE / LENGTH, EA=3e3 * FORCE)


def _curved_like_the_catenary(part: Any, control: Any) -> Differences:
    V = CATENARY.weight * LENGTH * (part - 0.5)
    bent = CATENARY.weight * CATENARY.tension / (CATENARY.tension**2 + V**2)
    zero = jnp.zeros_like(bent)
    return Differences(curvature=jnp.stack([-bent, zero, zero]))


def hanging(nodes: int, curved: bool = True) -> tuple[Any, kc.Trajectory]:
    """A rod between two pins and the catenary as a state of it, to start from.

    Curved at rest as the catenary is, it carries no moment there, and the cable's shape is exactly its own.
    """
    s = np.linspace(0, LENGTH, nodes)
    angle = np.arctan2(CATENARY.rise(s), CATENARY.tension)
    sideways, along = np.zeros((nodes, 3)), np.zeros((nodes, 3))
    along[:, 0], along[:, 2], sideways[:, 1] = np.cos(angle), np.sin(angle), 1.0
    # d1 across the plane, d3 along the cable
    frames = np.stack([sideways, np.cross(along, sideways), along], axis=2)
    p, h = CATENARY.positions(s), Rotation.from_matrix(frames).as_quat(scalar_first=True)
    h *= np.where(h @ h[0] < 0, -1.0, 1.0)[:, None]
    stretch = 1 + np.hypot(CATENARY.tension, CATENARY.rise(s)) / CATENARY.EA
    robot = kc.robots.SlenderRod(
        length=LENGTH,
        radius=RADIUS,
        youngs_modulus=YOUNGS_MODULUS,
        density=DENSITY,
        gravity=(0, 0, -CATENARY.weight / (DENSITY * AREA)),
        shear_stiffness=(RIGID, RIGID, CATENARY.EA),
        bending_stiffness=(EI, EI, EI),
        nodes=nodes,
        sections=(FunctionSection(function=_curved_like_the_catenary),) if curved else (),
        base_end=kc.robots.ends.Pinned(position=p[0]),
        tip_end=kc.robots.ends.Pinned(position=p[-1]),
    )
    return robot, resting(robot, p, h, stretch[:, None] * [0.0, 0.0, 1.0], np.zeros((nodes, 3)))


def catenary(nodes: int, space: str) -> float:
    """Distance from the catenary, of a rod curved at rest like it between two pins."""
    robot, start = hanging(nodes)
    exact = CATENARY.positions(np.linspace(0, LENGTH, nodes))
    return _farthest(positions(robot, space, initial=start), exact)


class Case(NamedTuple):
    """What it is, and its error for a number of nodes and a space scheme."""

    name: str
    error: Callable[[int, str], float]


STATICS = {
    "tip force": Case("tip force, small deflection with shear", small_tip_force),
    "even load": Case("even load, small deflection with shear", small_even_load),
    "half circle": Case("tip moment: half a circle", bent_by_moment((0, np.pi, 0))),
    "circle": Case("tip moment: a full circle", bent_by_moment((0, 2 * np.pi, 0))),
    "helix": Case("bending and twisting moment: a helix", bent_by_moment((3, -1, 4))),
    **{
        f"elastica {load}": Case(f"elastica, F L²/EI = {load}", elastica(load))
        for load in closed_forms.ELASTICA
    },
    "tendon": Case("straight tendon: a circle", tendon_circle),
    "catenary": Case("between two pins: the catenary", catenary),
}


# loss of stability


def column(nodes: int, space: str) -> float:
    """Relative error of the weight under which an upright column buckles."""

    def standing(weight: float) -> kc.Trajectory:
        gravity = (0, 0, -weight * FORCE / (DENSITY * AREA * LENGTH))
        return kc.equilibrium(rod(nodes, gravity=gravity), np.zeros(0), space=space, newton=NEWTON)

    return abs(critical_load(standing, 7.0, space) / closed_forms.COLUMN - 1)


def strut(nodes: int, space: str) -> float:
    """Relative error of the dead force along it under which a rod buckles."""

    def pressed(load: float) -> kc.Trajectory:
        return kc.equilibrium(rod(nodes, force=(0, 0, -load)), np.zeros(0), space=space, newton=NEWTON)

    return abs(critical_load(pressed, 2.3, space) / closed_forms.STRUT - 1)


def shaft(nodes: int, space: str) -> float:
    """Relative error of the torque under which a twisted shaft buckles, one clamped end free to slide."""
    robot = rod(nodes, tip_end=kc.robots.ends.Sliding(axes=("rz",), along="z"))
    s = np.linspace(0, LENGTH, nodes)[:, None]

    def twisted(torque: float) -> kc.Trajectory:
        turn = torque * MOMENT * LENGTH / EI
        half = turn * s / LENGTH / 2
        h = np.cos(half) * UP + np.sin(half) * np.array([0.0, 0.0, 0.0, 1.0])
        along = np.broadcast_to([0.0, 0.0, 1.0], (nodes, 3))
        start = resting(robot, s * along, h, along, turn / LENGTH * along)
        # an equilibrium adds the turns from the control of its initial guess
        start = dataclasses.replace(start, control=np.array([[turn]]))
        return kc.equilibrium(robot, np.array([turn]), space=space, newton=NEWTON, initial=start)

    return abs(critical_load(twisted, 8.8, space) / closed_forms.SHAFT - 1)


BUCKLING = {
    "column": Case("upright column under its own weight", column),
    "strut": Case("strut, clamped and free", strut),
    "shaft": Case("twisted shaft, both ends clamped", shaft),
}


# vibration

BDF2 = kc.solvers.BDF2()
#: steps of a period, of a run, and of the time in which it settles
PERIOD_STEPS, STEPS, SETTLED = 16, 96, 32


def swinging(mode: int, nodes: int, space: str = "lobatto4", scheme: Any = BDF2) -> tuple[np.ndarray, float]:
    """How much of a mode is in every row of a rod that is let go from its shape, and the time step."""
    robot = rod(nodes)
    part = np.linspace(0, 1, nodes)
    shape, slope = (1e-4 * each for each in closed_forms.mode_shape(mode, part))
    h = np.stack([np.cos(slope / 2), np.zeros(nodes), np.sin(slope / 2), np.zeros(nodes)], axis=1)
    p = np.stack([shape, np.zeros(nodes), part], axis=1) * LENGTH
    along = np.broadcast_to([0.0, 0.0, 1.0], (nodes, 3))
    bent = np.stack([np.zeros(nodes), np.gradient(slope, part) / LENGTH, np.zeros(nodes)], axis=1)
    dt = 2 * np.pi / closed_forms.frequency(mode, LENGTH, EI, DENSITY * AREA) / PERIOD_STEPS
    moving = kc.simulate(
        robot,
        np.zeros((STEPS, 0)),
        dt,
        time=scheme,
        space=space,
        newton=NEWTON,
        start="consistent",
        initial=resting(robot, p, h, along, bent),
    )
    return np.trapezoid(np.asarray(moving.position)[:, :, 0] * shape, part, axis=1), dt


def rate(amplitude: np.ndarray, dt: float, scheme: Any) -> complex:
    """What a vibration's rows say of its rate (1/s), less what the scheme damps and slows.

    From row to row a vibration is multiplied by some z: a[i + 1] = b a[i] + c a[i - 1], and z² = b z + c. The
    scheme takes the rate of zⁿ for (c0 + c1 / z + c2 / z²) / (1 - d1 / z).
    """
    past = np.stack([amplitude[1:-1], amplitude[:-2]], axis=1)
    (b, c), *_ = np.linalg.lstsq(past, amplitude[2:])
    z = np.roots([1.0, -b, -c])[0]
    c0, c1, c2, d1 = scheme.coefficients(dt, dt)
    return complex((c0 + c1 / z + c2 / z**2) / (1 - d1 / z))


def frequency_error(mode: int) -> Callable[[int, str], float]:
    """Relative error of a mode's frequency, with the rotary inertia of the sections (Rayleigh)."""
    shape, slope = closed_forms.mode_shape(mode, np.linspace(0, 1, 1001))
    turning = (RADIUS / (2 * LENGTH)) ** 2 * np.mean(slope**2) / np.mean(shape**2)
    exact = closed_forms.frequency(mode, LENGTH, EI, DENSITY * AREA) / np.sqrt(1 + turning)

    def error(nodes: int, space: str) -> float:
        amplitude, dt = swinging(mode, nodes, space)
        return float(abs(rate(amplitude[SETTLED:], dt, BDF2).imag) / exact - 1)

    return error


VIBRATION = {f"mode {mode}": Case(f"vibration, mode {mode}", frequency_error(mode)) for mode in (1, 2, 3)}


def order(errors: list[float], nodes: tuple[int, ...]) -> float:
    """Observed between the two finest grids."""
    return float(np.log(abs(errors[-2] / errors[-1])) / np.log((nodes[-1] - 1) / (nodes[-2] - 1)))
