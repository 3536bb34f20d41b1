"""Paths of equilibria: neutral families, along which no load does work."""

import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.rods.ends import Driven

L, RADIUS, E = 1.0, 2e-3, 1e9


@pytest.mark.slow
def test_a_twisted_ring_stays_a_circle_and_has_no_limit_points():
    """It turns about its tangent without a force at any twist, below Michell's 2π√3 EI/GJ = 14.1 rad."""
    ring = kc.robots.SlenderRod(
        length=L, radius=RADIUS, density=1e3, youngs_modulus=E, gravity=[0.0, 0.0, 0.0], nodes=21,
        tip_end=Driven(position=[0.0, 0.0, 0.0], axes=("rz",)),
    )  # fmt: skip
    s, r = 2.0 * np.pi * np.linspace(0.0, 1.0, 41), L / (2.0 * np.pi)
    circle = np.stack([r * (1.0 - np.cos(s)), 0.0 * s, r * np.sin(s)], axis=1)
    path = kc.statics.equilibrium_path(
        ring, [0.0], [3.0], initial=circle, space="lobatto4", points=60, with_stability=False
    )
    assert path.complete and not len(path.limit_points)
    assert np.all(np.diff(path.part) > 0.0)
    # the turn about the tangent, which costs nothing, is not made
    assert np.max(np.abs(path.trajectory.position[:, :, 1])) < 1e-3 * L
    moment = path.trajectory.y[:, 0, ring.y_layout.slice("m")]
    stiffness = float(ring.Kbt[2, 2])
    assert moment[:, 2] == pytest.approx(stiffness * 3.0 * path.part / L, abs=0.02 * stiffness / L)
    for row in (0, -1):
        found = kc.statics.stability(path.trajectory, row)
        assert found.kind == "neutral" and found.neutral_directions == 1 and found.unstable_directions == 0
