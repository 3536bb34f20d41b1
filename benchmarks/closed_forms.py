"""What is known of rods in closed form: the formulas, free of any solver. SI units; s runs from base to tip.

Tests hold the solver to them (tests/physics/test_closed_forms.py), and docs/validation.md shows how it does.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import brentq
from scipy.special import ellipeinc, ellipk, ellipkinc, jv

# small deflection of a cantilever that bends (EI) and shears (GA)


def tip_force_deflection(force: float, length: float, EI: float, GA: float) -> float:
    """Of the tip, under a force across it."""
    return force * length**3 / (3 * EI) + force * length / GA


def even_load_deflection(load: float, length: float, EI: float, GA: float) -> float:
    """Of the tip, under a force per length (N/m)."""
    return load * length**4 / (8 * EI) + load * length**2 / (2 * GA)


def tip_moment_deflection(moment: float, length: float, EI: float) -> float:
    """Of the tip, under a moment there."""
    return moment * length**2 / (2 * EI)


# large deflection


def helix(moment: Any, s: Any, EI: float) -> np.ndarray:
    """Positions (len(s), 3) of a rod clamped along z that carries this moment (N m) everywhere.

    Its section resists twist as it does bending, 2 G I = E I: the tangent then turns about the moment's axis
    at |M| / EI. A moment across the rod makes a circle of any section.
    """
    rate = np.linalg.norm(moment) / EI
    axis = np.asarray(moment) / np.linalg.norm(moment)
    tangent = np.array([0.0, 0.0, 1.0])
    along = axis[2] * axis
    across = tangent - along
    s = np.asarray(s)[:, None]
    turning = np.sin(rate * s) * across + (1 - np.cos(rate * s)) * np.cross(axis, tangent)
    return s * along + turning / rate


def elastica(load: float) -> np.ndarray:
    """Deflection and shortening, parts of the length, under a dead force F across the tip, F L² / EI = load.

    By elliptic integrals, with k² = (1 + sin θ) / 2 of the tip's angle θ.
    """

    # the base, where θ = 0, is at sin φ = 1 / (k √2)
    def amplitude(m: float) -> float:
        return float(np.arcsin(1 / np.sqrt(2 * m)))

    def length(m: float) -> float:
        return float(ellipk(m) - ellipkinc(amplitude(m), m))

    m = brentq(lambda m: length(m) - np.sqrt(load), 0.5 + 1e-12, 1 - 1e-12, xtol=1e-15)
    phi = amplitude(m)
    second = ellipeinc(np.pi / 2, m) - ellipeinc(phi, m)
    deflection = 1 - 2 * second / np.sqrt(load)
    height = np.sqrt(2 * (2 * m - 1)) / np.sqrt(load)
    return np.array([deflection, 1 - height])


#: F L² / EI, and the two numbers of `elastica` to the five digits that are published
ELASTICA = {1: (0.30172, 0.05643), 2: (0.49346, 0.16064), 5: (0.71379, 0.38763), 10: (0.81061, 0.55500)}


def tendon_circle(tension: float, offset: float, s: Any, EI: float, EA: float) -> np.ndarray:
    """Positions (len(s), 3) of a rod clamped along z that a straight tendon on its x side bends.

    EI κ = τ r of the unstretched length, and the rod is shorter by τ / EA.
    """
    curvature, stretch = tension * offset / EI, 1 - tension / EA
    s = np.asarray(s)
    radius = stretch / curvature
    x, z = radius * (1 - np.cos(curvature * s)), radius * np.sin(curvature * s)
    return np.stack([x, np.zeros_like(x), z], axis=1)


class Catenary(NamedTuple):
    """A cable without bending stiffness between two pins of one height, that stretches (EA)."""

    length: float
    span: float
    #: weight per unstretched length (N/m)
    weight: float
    EA: float

    @property
    def tension(self) -> float:
        """The horizontal force (N), the same everywhere."""

        def misfit(H: float) -> float:
            half = self.weight * self.length / 2
            return H * self.length / self.EA + 2 * H / self.weight * np.arcsinh(half / H) - self.span

        heavy = self.weight * self.length
        return float(brentq(misfit, 1e-6 * heavy, 1e6 * heavy, xtol=1e-15 * heavy, rtol=1e-14))

    def rise(self, s: Any) -> Any:
        """The vertical force (N) at unstretched length s."""
        return self.weight * (np.asarray(s) - self.length / 2)

    def positions(self, s: Any) -> np.ndarray:
        """Positions (len(s), 3) at unstretched lengths s; it hangs in the x-z plane from the origin."""
        H, V, V0 = self.tension, self.rise(s), self.rise(0.0)
        x = H * np.asarray(s) / self.EA + H / self.weight * (np.arcsinh(V / H) - np.arcsinh(V0 / H))
        z = (V**2 - V0**2) / (2 * self.weight * self.EA) + (np.hypot(H, V) - np.hypot(H, V0)) / self.weight
        return np.stack([x, np.zeros_like(x), z], axis=1)

    def curvature(self, s: Any) -> Any:
        """How fast the tangent rises (1/m, of unstretched length)."""
        H, V = self.tension, self.rise(s)
        return self.weight * H / (H**2 + V**2)


# loss of stability, all in natural units of the rod

#: ρ A g L³ / EI of an upright column, clamped at its foot, under its own weight (Greenhill 1881): 7.837
COLUMN = 9 / 4 * brentq(lambda x: jv(-1 / 3, x), 1.0, 2.5, xtol=1e-15) ** 2
#: M L / EI of a shaft with both ends clamped, one free to slide (Greenhill 1883): 8.987
SHAFT = 2 * brentq(lambda x: np.sin(x) - x * np.cos(x), 4.0, 4.6, xtol=1e-15)
#: P L² / EI of a clamped and free rod under a dead force along it (Euler)
STRUT = np.pi**2 / 4

# vibration of a clamped and free beam


def wave_number(mode: int) -> float:
    """β of the mode (1, 2 …), the root of cos β cosh β = -1: 1.8751, 4.6941, 7.8548 …"""
    middle = (mode - 0.5) * np.pi
    return float(brentq(lambda b: np.cos(b) + 1 / np.cosh(b), middle - 0.5, middle + 0.5, xtol=1e-15))


def frequency(mode: int, length: float, EI: float, mass_per_length: float) -> float:
    """Angular frequency (rad/s) without shear, rotary inertia or damping."""
    return wave_number(mode) ** 2 * float(np.sqrt(EI / (mass_per_length * length**4)))


def mode_shape(mode: int, part: Any) -> tuple[Any, Any]:
    """The mode at these parts of the length, and its slope with respect to the part; the tip moves by one."""
    beta = wave_number(mode)
    ratio = (np.cosh(beta) + np.cos(beta)) / (np.sinh(beta) + np.sin(beta))
    x = beta * np.asarray(part)
    shape = np.cosh(x) - np.cos(x) - ratio * (np.sinh(x) - np.sin(x))
    slope = beta * (np.sinh(x) + np.sin(x) - ratio * (np.cosh(x) - np.cos(x)))
    tip = 2 * (-1) ** (mode + 1)
    return shape / tip, slope / tip
