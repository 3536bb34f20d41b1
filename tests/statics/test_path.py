"""Paths of equilibria: neutral families, along which no load does work."""

import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.robots import ends
from knode_cosserat.statics import path

L, RADIUS, E = 1.0, 2e-3, 1e9


@pytest.mark.slow
def test_a_twisted_ring_stays_a_circle_and_has_no_limit_points():
    """It turns about its tangent without a force at any twist, below Michell's 2π√3 EI/GJ = 14.1 rad."""
    ring = kc.robots.SlenderRod(
        length=L,
        radius=RADIUS,
        density=1e3,
        youngs_modulus=E,
        gravity=[0.0, 0.0, 0.0],
        nodes=21,
        tip_end=ends.Driven(position=[0.0, 0.0, 0.0], axes=("rz",)),
    )
    s, r = 2.0 * np.pi * np.linspace(0.0, 1.0, 41), L / (2.0 * np.pi)
    circle = np.stack([r * (1.0 - np.cos(s)), 0.0 * s, r * np.sin(s)], axis=1)
    followed = kc.statics.equilibrium_path(
        ring, [0.0], [3.0], initial=circle, space="lobatto4", points=60, with_stability=False
    )
    assert followed.complete and not len(followed.limit_points)
    assert np.all(np.diff(followed.part) > 0.0)
    # the turn about the tangent, which costs nothing, is not made
    assert np.max(np.abs(followed.trajectory.position[:, :, 1])) < 1e-3 * L
    moment = followed.trajectory.y[:, 0, ring.y_layout.slice("m")]
    stiffness = float(ring.Kbt[2, 2])
    assert moment[:, 2] == pytest.approx(stiffness * 3.0 * followed.part / L, abs=0.02 * stiffness / L)
    for row in (0, -1):
        found = kc.statics.stability(followed.trajectory, row)
        assert found.kind == "neutral" and found.neutral_directions == 1 and found.unstable_directions == 0


def test_an_interrupted_path_is_kept(monkeypatch):
    """Each point that was found is an equilibrium; nothing is said of their stability."""
    robot = kc.load_robot("delrin-tendon-robot").replace(nodes=5)
    advance = path._PathPoints.advance

    def advance_thrice(walk):
        if len(walk.parts) > 3:
            raise KeyboardInterrupt
        return advance(walk)

    monkeypatch.setattr(path._PathPoints, "advance", advance_thrice)
    with pytest.raises(KeyboardInterrupt) as caught:
        kc.statics.equilibrium_path(robot, [0.0] * 4, [4.0, 0.0, 0.0, 2.0], progress=True)
    found = caught.value.best
    assert len(found.part) == 4 and not found.complete
    assert found.unstable_directions.tolist() == [-1] * 4
    for part, tip in zip(found.part, found.trajectory.tip_position, strict=True):
        wanted = kc.equilibrium(robot, part * np.array([4.0, 0.0, 0.0, 2.0])).tip_position[0]
        np.testing.assert_allclose(tip, wanted, atol=1e-8)
