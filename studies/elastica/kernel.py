"""Time loop of the PyElastica test robot, compiled by Numba; PyElastica's functions evaluate the rod.

PyElastica's own time loop calls some twenty Python functions in each step of some microseconds, and takes
longer for them than for the rod. This loop does the same (`PositionVerlet`, a rod clamped at one end), with
tendons, drag and material damping, as one compiled function.
"""

from __future__ import annotations

import collections
from typing import Any, NamedTuple

import numpy as np
from elastica.rod.cosserat_rod import (
    _compute_internal_forces,
    _compute_internal_torques,
    _update_accelerations,
)
from elastica.rod.data_structures import overload_operator_kinematic_numba
from numba import njit

#: arrays of PyElastica's `CosseratRod`, n + 1 nodes, n elements, n - 1 joints, by their names here
ARRAYS = {
    "position": "position_collection", "velocity": "velocity_collection", "directors": "director_collection",
    "omega": "omega_collection", "acceleration": "acceleration_collection", "alpha": "alpha_collection",
    "joint_lengths": "rest_voronoi_lengths", "joint_dilatation": "voronoi_dilatation",
    "inertia": "mass_second_moment_of_inertia", "inverse_inertia": "inv_mass_second_moment_of_inertia",
    "stress": "internal_stress", "couple": "internal_couple", "forces": "external_forces",
    "torques": "external_torques",
}  # fmt: skip
ARRAYS |= {
    name: name
    for name in (
        "mass",
        "volume",
        "lengths",
        "tangents",
        "radius",
        "rest_lengths",
        "dilatation",
        "dilatation_rate",
        "sigma",
        "kappa",
        "rest_sigma",
        "rest_kappa",
        "shear_matrix",
        "bend_matrix",
        "internal_forces",
        "internal_torques",
    )
}
#: these arrays, which change in place, and the places of periodic nodes, of which there are none
Rod: Any = collections.namedtuple("Rod", [*ARRAYS, "ghosts"])  # type: ignore[misc]


class Tendons(NamedTuple):
    """State of the tendons: c tendons, each through a hole at every node between base and tip."""

    #: (c, 3) places in the cross-section (m)
    place: Any
    #: (c,) tension at the base (N)
    tension: Any
    #: (c, n - 1) mobilised fraction of the friction of each hole, with its direction
    mobilised: Any
    #: (c, n - 1) length from each hole to the anchor (m); negative before the first step
    beyond: Any


class Constants(NamedTuple):
    """Numbers of the loop."""

    #: time step (s)
    dt: float
    #: part of a tension's distance from its command that is left after a step
    remaining: float
    #: friction coefficient, angle of each hole's misalignment (rad), sliding until friction is full (m)
    friction: float
    misalignment: float
    sliding: float
    #: (3, 3) base frame: rows are directors; (3,) stiffness of the first half element (N m/rad)
    base: Any
    base_stiffness: Any
    #: (3,) gravity (m/s²); drag per length, linear (kg/(m s)) and by the square (kg/m²)
    gravity: Any
    linear_drag: float
    square_drag: float
    #: (n,) factors of the tridiagonal elimination of the material damping
    link: float
    pivots: Any


@njit(cache=True)
def advance(rod: Any, tendons: Tendons, numbers: Constants, command: Any, steps: int) -> None:
    """Move the rod by some time steps under commanded tensions (N)."""
    half = 0.5 * numbers.dt
    for _ in range(steps):
        overload_operator_kinematic_numba(half, rod.position, rod.directors, rod.velocity, rod.omega)
        for i in range(len(command)):
            tendons.tension[i] = command[i] + (tendons.tension[i] - command[i]) * numbers.remaining
        _internal(rod)
        rod.forces[:] = 0.0
        rod.torques[:] = 0.0
        _weight_and_drag(rod, numbers)
        _clamp(rod, numbers)
        _pull(rod, tendons, numbers)
        _accelerate(rod, numbers)
        overload_operator_kinematic_numba(half, rod.position, rod.directors, rod.velocity, rod.omega)


@njit(cache=True)
def _internal(rod: Any) -> None:
    """Evaluate the internal forces and torques of PyElastica's rod."""
    _compute_internal_forces(
        rod.position,
        rod.volume,
        rod.lengths,
        rod.tangents,
        rod.radius,
        rod.rest_lengths,
        rod.joint_lengths,
        rod.dilatation,
        rod.joint_dilatation,
        rod.directors,
        rod.sigma,
        rod.rest_sigma,
        rod.shear_matrix,
        rod.stress,
        rod.internal_forces,
        rod.ghosts,
    )
    _compute_internal_torques(
        rod.position,
        rod.velocity,
        rod.tangents,
        rod.lengths,
        rod.rest_lengths,
        rod.directors,
        rod.joint_lengths,
        rod.bend_matrix,
        rod.rest_kappa,
        rod.kappa,
        rod.joint_dilatation,
        rod.inertia,
        rod.omega,
        rod.stress,
        rod.couple,
        rod.dilatation,
        rod.dilatation_rate,
        rod.internal_torques,
        rod.ghosts,
    )


@njit(cache=True)
def _weight_and_drag(rod: Any, numbers: Constants) -> None:
    """Add weight and drag to the forces on the nodes."""
    count = rod.mass.shape[0]
    for k in range(count):
        span = rod.rest_lengths[0] if 0 < k < count - 1 else 0.5 * rod.rest_lengths[0]
        square = 0.0
        for i in range(3):
            square += rod.velocity[i, k] * rod.velocity[i, k]
        drag = span * (numbers.linear_drag + numbers.square_drag * np.sqrt(square))
        for i in range(3):
            rod.forces[i, k] += rod.mass[k] * numbers.gravity[i] - drag * rod.velocity[i, k]


@njit(cache=True)
def _clamp(rod: Any, numbers: Constants) -> None:
    """Add the torque of the half element between the clamped end and the middle of the first element.

    PyElastica's clamp holds the whole first element, which makes the rod half an element shorter.
    """
    turned = np.zeros((3, 3))
    for i in range(3):
        for j in range(3):
            for k in range(3):
                turned[i, j] += rod.directors[i, k, 0] * numbers.base[j, k]
    x = 0.5 * (turned[1, 2] - turned[2, 1])
    y = 0.5 * (turned[2, 0] - turned[0, 2])
    z = 0.5 * (turned[0, 1] - turned[1, 0])
    sine = np.sqrt(x * x + y * y + z * z)
    cosine = 0.5 * (turned[0, 0] + turned[1, 1] + turned[2, 2] - 1.0)
    longer = np.arctan2(sine, cosine) / sine if sine > 1e-9 else 1.0
    rod.torques[0, 0] -= numbers.base_stiffness[0] * longer * x
    rod.torques[1, 0] -= numbers.base_stiffness[1] * longer * y
    rod.torques[2, 0] -= numbers.base_stiffness[2] * longer * z


@njit(cache=True)
def _pull(rod: Any, tendons: Tendons, numbers: Constants) -> None:
    """Add the forces of tendons on the edges of their holes and on their anchors.

    A tendon is straight between holes. A hole takes the part exp(-f μ (θ + θ₀)) of its tension, with the
    angle θ by which it turns there. The mobilised fraction f grows with sliding, until it is 1 or -1.
    """
    n = rod.lengths.shape[0]
    pieces, spans = np.empty((n, 3)), np.empty(n)
    place, before, after = np.empty(3), np.empty(3), np.empty(3)
    for c in range(tendons.place.shape[0]):
        x, y = tendons.place[c, 0], tendons.place[c, 1]
        for i in range(3):
            before[i] = rod.position[i, 0] + x * numbers.base[0, i] + y * numbers.base[1, i]
        for k in range(1, n + 1):
            square = 0.0
            for i in range(3):
                place[i] = _arm(rod, k - 1, i, x, y)
                if k < n:
                    place[i] = 0.5 * (place[i] + _arm(rod, k, i, x, y))
                place[i] += rod.position[i, k]
                pieces[k - 1, i] = place[i] - before[i]
                square += pieces[k - 1, i] ** 2
                before[i] = place[i]
            spans[k - 1] = np.sqrt(square)
            for i in range(3):
                pieces[k - 1, i] /= spans[k - 1]
        _slide(tendons, c, spans, numbers.sliding)
        tension = tendons.tension[c]
        for k in range(1, n):
            square = 0.0
            for i in range(3):
                square += (pieces[k, i] - pieces[k - 1, i]) ** 2
            bend = np.sqrt(square) + numbers.misalignment
            onward = tension * np.exp(-tendons.mobilised[c, k - 1] * numbers.friction * bend)
            for i in range(3):
                after[i] = onward * pieces[k, i] - tension * pieces[k - 1, i]
                rod.forces[i, k] += after[i]
            _turn(rod, k - 1, after, 0.5 * x, 0.5 * y)
            _turn(rod, k, after, 0.5 * x, 0.5 * y)
            tension = onward
        for i in range(3):
            after[i] = -tension * pieces[n - 1, i]
            rod.forces[i, n] += after[i]
        _turn(rod, n - 1, after, x, y)


@njit(cache=True, inline="always")
def _arm(rod: Any, k: int, i: int, x: float, y: float) -> float:
    """Return a component, in the global frame, of the place (x, y) in the cross-section of element k."""
    return x * rod.directors[0, i, k] + y * rod.directors[1, i, k]


@njit(cache=True)
def _slide(tendons: Tendons, c: int, spans: Any, sliding: float) -> None:
    """Move the mobilised friction of a tendon by the distances that it has slid through its holes."""
    beyond = 0.0
    for k in range(len(spans) - 1, 0, -1):
        beyond += spans[k]
        before = tendons.beyond[c, k - 1]
        tendons.beyond[c, k - 1] = beyond
        if before > 0.0:
            moved = tendons.mobilised[c, k - 1] + (before - beyond) / sliding
            tendons.mobilised[c, k - 1] = min(1.0, max(-1.0, moved))


@njit(cache=True)
def _turn(rod: Any, k: int, force: Any, x: float, y: float) -> None:
    """Add the torque of a force (global frame) at the place (x, y) of element k."""
    a, b, along = 0.0, 0.0, 0.0
    for i in range(3):
        a += rod.directors[0, i, k] * force[i]
        b += rod.directors[1, i, k] * force[i]
        along += rod.directors[2, i, k] * force[i]
    rod.torques[0, k] += y * along
    rod.torques[1, k] -= x * along
    rod.torques[2, k] += x * b - y * a


@njit(cache=True)
def _accelerate(rod: Any, numbers: Constants) -> None:
    """Move the velocities by a time step; the material's damping is implicit."""
    _update_accelerations(
        rod.acceleration,
        rod.internal_forces,
        rod.forces,
        rod.mass,
        rod.alpha,
        rod.inverse_inertia,
        rod.internal_torques,
        rod.torques,
        rod.dilatation,
    )
    for i in range(3):
        for k in range(rod.omega.shape[1]):
            rod.velocity[i, k + 1] += numbers.dt * rod.acceleration[i, k + 1]
            rod.omega[i, k] += numbers.dt * rod.alpha[i, k]
    if numbers.link > 0.0:
        _damp(rod, numbers)


@njit(cache=True)
def _damp(rod: Any, numbers: Constants) -> None:
    """Apply Kelvin-Voigt damping of bending and twisting for a step: backward Euler, Thomas' algorithm.

    The relative rates of neighbouring elements are compared in the global frame, where the equations of the
    three components are separate, because damping and rotary inertia are isotropic.
    """
    n = rod.omega.shape[1]
    turning = np.empty((3, n))
    for k in range(n):
        for i in range(3):
            total = 0.0
            for j in range(3):
                total += rod.directors[j, i, k] * rod.omega[j, k]
            turning[i, k] = total
    for k in range(1, n):
        for i in range(3):
            turning[i, k] += numbers.link / numbers.pivots[k - 1] * turning[i, k - 1]
    for i in range(3):
        turning[i, n - 1] /= numbers.pivots[n - 1]
    for k in range(n - 2, -1, -1):
        for i in range(3):
            turning[i, k] = (turning[i, k] + numbers.link * turning[i, k + 1]) / numbers.pivots[k]
    for k in range(n):
        for i in range(3):
            total = 0.0
            for j in range(3):
                total += rod.directors[i, j, k] * turning[j, k]
            rod.omega[i, k] = total
