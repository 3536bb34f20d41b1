"""Rods held at both ends: buckled and hanging shapes, turns of an end, positions of coiled rods."""

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.special import ellipe, ellipk

import knode_cosserat as kc
from knode_cosserat.solvers.energy import RodEnergy

ends, sections = kc.robots.ends, kc.robots
UPRIGHT = (1.0, 0.0, 0.0, 0.0)
LENGTH, RADIUS, G = 0.5, 0.003, 9.81
CABLE = kc.robots.SlenderRod(
    length=LENGTH,
    radius=RADIUS,
    density=1100.0,
    youngs_modulus=5e6,
    gravity=(0.0, 0.0, 0.0),
    nodes=21,
    tip_end=ends.Clamped(position=(0.0, 0.0, 0.4), orientation=UPRIGHT),
)
ROD = kc.robots.SlenderRod(
    length=1.0,
    radius=0.01,
    density=1e3,
    youngs_modulus=1e7,
    gravity=(0.0, 0.0, 0.0),
    nodes=21,
    base_end=ends.Driven(axes=("rz",)),
    tip_end=ends.Driven(axes=("rx", "rz")),
)
GJ = 1e7 / 2.6 * np.pi * 0.01**4 / 2.0


def is_stable(found):
    """True if the energy has no negative eigenvalue: independent of how the equilibrium was found."""
    return RodEnergy(found.system, np.asarray(found.y[-1]), found.control[-1]).mode() is None


def between_clamps(distance, **changes):
    end = ends.Clamped(position=(0.0, 0.0, distance), orientation=UPRIGHT)
    return kc.equilibrium(CABLE.replace(tip_end=end, **changes), np.zeros(0))


# nearer than the length


@pytest.mark.slow
@pytest.mark.parametrize("modulus", [1e6, 2e9])
@pytest.mark.parametrize("distance", [0.49, 0.4, 0.3])
def test_a_rod_between_clamps_buckles_to_the_elastica(distance, modulus):
    """Without gravity: d/L = 2 E/K - 1 and a deflection of k L/K, by complete elliptic integrals."""
    found = between_clamps(distance, youngs_modulus=modulus)
    m = brentq(lambda m: 2.0 * ellipe(m) / ellipk(m) - 1.0 - distance / LENGTH, 0.0, 0.9)
    middle = found.position[0, 10]
    assert found.result[0] == kc.Result.CONVERGED
    assert np.hypot(*middle[:2]) == pytest.approx(np.sqrt(m) * LENGTH / ellipk(m), rel=0.02)
    assert middle[2] == pytest.approx(distance / 2.0, abs=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("modulus", [1e6, 5e6, 1e8, 2e9])
@pytest.mark.parametrize("gravity", [(-G, 0.0, 0.0), (0.0, 0.0, -G), (0.0, 0.0, G), (3.0, -5.0, 7.0)])
def test_a_rod_between_clamps_hangs_and_is_stable(gravity, modulus):
    found = between_clamps(0.4, gravity=gravity, youngs_modulus=modulus)
    assert found.result[0] == kc.Result.CONVERGED and is_stable(found)
    assert np.min(found.part("v")[0, :, 2]) > 0.98
    # its middle is not above its ends
    assert (found.position[0, 10] - np.array([0.0, 0.0, 0.2])) @ np.array(gravity) > -1e-6


@pytest.mark.slow
def test_a_strip_buckles_about_its_weak_axis_also_against_gravity():
    for weak, gravity in ((0, (0.0, 0.0, 0.0)), (1, (0.0, 0.0, 0.0)), (1, (0.0, -0.3, 0.0))):
        stiffness = np.diag(np.where(np.arange(3) == weak, 2e-5, [1e-3, 1e-3, 3e-5]))
        found = between_clamps(0.4, bending_stiffness=stiffness, gravity=gravity)
        assert found.result[0] == kc.Result.CONVERGED
        assert np.argmax(np.max(np.abs(found.position[0, :, :2]), axis=0)) == 1 - weak


@pytest.mark.slow
@pytest.mark.parametrize("gravity", [(0.0, 0.0, 0.0), (0.0, 0.0, -G), (-G, 0.0, 0.0)])
def test_a_rod_between_a_clamp_and_a_pin_too(gravity):
    rod = CABLE.replace(gravity=gravity, tip_end=ends.Pinned(position=(0.0, 0.0, 0.4)))
    found = kc.equilibrium(rod, np.zeros(0))
    assert found.result[0] == kc.Result.CONVERGED and is_stable(found)
    assert np.min(found.part("v")[0, :, 2]) > 0.98
    np.testing.assert_allclose(found.moment[0, -1], 0.0, atol=1e-9)


@pytest.mark.slow
def test_a_driven_end_is_pushed_and_the_rod_follows_from_row_to_row():
    """A list of controls that begins taut, a batch, and the start of a simulation."""
    rod = CABLE.replace(tip_end=ends.Driven(axes=("z",)))
    rows = kc.solvers.equilibria(rod, [[0.0], [-0.001], [-0.05], [-0.1]])
    assert np.all(rows.result == kc.Result.CONVERGED) and is_stable(rows)
    batch = kc.equilibrium(rod, [[0.01], [-0.1]])
    assert np.all(batch.result == kc.Result.CONVERGED)
    for found in (rows.position[-1], batch.position[1, 0]):
        np.testing.assert_allclose(np.hypot(*found[10, :2]), 0.1327, rtol=0.02)
    start = ends.Driven(position=(0.0, 0.0, 0.4), orientation=UPRIGHT, axes=("z",))
    motion = kc.simulate(
        rod.replace(tip_end=start, bending_damping=1e-5), np.zeros((2, 1)), 0.01, initial="unstressed"
    )
    assert np.max(np.hypot(*motion.position[0, :, :2].T)) == pytest.approx(0.1327, rel=0.02)


@pytest.mark.slow
def test_a_column_that_falls_is_unstable_and_says_so():
    """Greenhill's load: it stands with a free tip, and no other shape is near."""
    EI = 5e6 * np.pi * RADIUS**4 / 4.0
    for part in (0.9, 1.1):
        weight = part * 7.83735 * EI / LENGTH**3
        gravity = (0.0, 0.0, -weight / (1100.0 * np.pi * RADIUS**2))
        rod = CABLE.replace(tip_end=ends.Free(), gravity=gravity)
        if part < 1.0:
            assert kc.equilibrium(rod, np.zeros(0)).result[0] == kc.Result.CONVERGED
            continue
        with pytest.warns(UserWarning, match="1 of 1 equilibria: in equilibrium, but unstable"):
            found = kc.equilibrium(rod, np.zeros(0))
        assert found.result[0] == kc.Result.UNSTABLE


@pytest.mark.slow
def test_a_guess_is_kept():
    straight = np.linspace([0.0, 0.0, 0.0], [0.0, 0.0, 0.4], 9)
    with pytest.warns(UserWarning, match="unstable"):
        found = kc.equilibrium(CABLE, np.zeros(0), initial=straight)
    assert found.result[0] == kc.Result.UNSTABLE and not is_stable(found)
    np.testing.assert_allclose(found.position[0, :, :2], 0.0, atol=1e-9)


# turns


def torsion(found):
    """Angle (rad) of the torsional moment at the tip, GJ φ / L."""
    return found.moment[-1, -1, 2] / GJ


@pytest.mark.slow
def test_an_end_makes_the_turns_of_its_control():
    for angle in (1.0, 4.0, 2.0 * np.pi, -7.0, 11.0):
        found = kc.equilibrium(ROD, [0.0, 0.0, angle], space="lobatto4")
        assert found.result[0] == kc.Result.CONVERGED
        assert torsion(found) == pytest.approx(angle, rel=1e-3)
    # both ends, also against each other
    for base, tip in ((7.0, 7.0), (-4.0, 5.0), (9.0, 2.0)):
        found = kc.equilibrium(ROD, [base, 0.0, tip], space="lobatto4")
        assert torsion(found) == pytest.approx(tip - base, rel=1e-3, abs=1e-6)
    many = kc.equilibrium(ROD, [[0.0, 0.0, 9.0], [9.0, 0.0, 0.5]], space="lobatto4")
    np.testing.assert_allclose(many.moment[:, 0, -1, 2] / GJ, [9.0, -8.5], rtol=1e-3)


@pytest.mark.slow
def test_turns_count_from_any_earlier_equilibrium():
    seven = kc.equilibrium(ROD, [0.0, 0.0, 7.0], space="lobatto4")
    for angle in (-7.0, 0.5, 10.0):
        found = kc.equilibrium(ROD, [0.0, 0.0, angle], space="lobatto4", initial=seven)
        assert torsion(found) == pytest.approx(angle, rel=1e-3)


@pytest.mark.slow
def test_no_turns_vanish_near_critical_loads():
    """Beyond 11.68 rad (8.98 EI/GJ) the twisted rod is unstable, and says so; its turns remain."""
    before = None
    for angle in (26.7, 26.9, 27.0, 27.3):
        with pytest.warns(UserWarning, match="unstable"):
            found = kc.equilibrium(ROD, [0.0, 0.0, angle], space="lobatto4")
        assert found.result[0] == kc.Result.UNSTABLE
        assert torsion(found) == pytest.approx(angle, rel=3e-3)
        if before is not None:
            found = kc.equilibrium(ROD, [0.0, 0.0, angle], space="lobatto4", initial=before)
            assert torsion(found) == pytest.approx(angle, rel=3e-3)
        before = found


@pytest.mark.slow
def test_turns_of_bent_rods_are_kept():
    """Gravity across the rod, and an end that is turned about a line across it."""
    sagging = ROD.replace(gravity=(-2.0, 0.0, 0.0))
    found = kc.equilibrium(sagging, [0.0, 0.0, 7.0], space="lobatto4")
    assert found.result[0] == kc.Result.CONVERGED and torsion(found) == pytest.approx(7.0, abs=0.1)
    path = kc.statics.equilibrium_path(
        sagging, [0.0, 0.0, 0.0], [0.0, 0.5, 4.0], space="lobatto4", with_stability=False
    )
    found = kc.equilibrium(sagging, [0.0, 0.5, 4.0], space="lobatto4")
    np.testing.assert_allclose(found.position[0], path.trajectory.position[-1], atol=1e-6)


@pytest.mark.slow
def test_the_result_says_if_turns_are_lost(monkeypatch):
    """Frames of two shapes differ by whole turns: counted, and reported where smaller parts do not help."""
    from knode_cosserat.solvers import static_run
    from knode_cosserat.solvers.guess import turns_between

    one, other = (kc.equilibrium(ROD, [0.0, 0.0, angle], space="lobatto4") for angle in (0.5, 7.0))
    assert [turns_between(ROD, a.y[0], b.y[0]) for a in (one, other) for b in (one, other)] == [0, 1, -1, 0]
    monkeypatch.setattr(static_run, "turns_between", lambda system, before, after: 1)
    with pytest.warns(UserWarning, match="another number of turns"):
        found = kc.equilibrium(ROD, [0.0, 0.0, 1.0], space="lobatto4", initial=one)
    assert found.result[0] == kc.Result.OTHER_TURNS


# positions of coiled rods


def helix(turns, pitch=0.1, hand=1.0, radius=0.015, wire=0.002):
    """A steel helix in its rest pose, held at both ends: positions, and the torsion over its length (rad)."""
    nodes = 121
    cosine, sine = np.cos(pitch), hand * np.sin(pitch)
    length = 2.0 * np.pi * radius * turns / cosine
    angle = np.linspace(0.0, length, nodes) * cosine / radius
    points = np.stack(
        [radius * (np.cos(angle) - 1.0), radius * np.sin(angle), angle / cosine * radius * sine], 1
    )

    def frame(a):
        tangent = np.array([-np.sin(a) * cosine, np.cos(a) * cosine, sine])
        normal = np.array([-np.cos(a), -np.sin(a), 0.0])
        matrix = np.stack([normal, np.cross(tangent, normal), tangent], axis=1)
        from scipy.spatial.transform import Rotation

        return tuple(np.roll(Rotation.from_matrix(matrix).as_quat(), 1))

    curvature = (0.0, cosine**2 / radius, cosine * sine / radius)
    rod = kc.robots.SlenderRod(
        length=length,
        radius=wire / 2.0,
        density=7800.0,
        youngs_modulus=200e9,
        gravity=(0.0, 0.0, 0.0),
        nodes=nodes,
        sections=(sections.Stretch(curvature=curvature),),
        base_end=ends.Clamped(position=(0.0, 0.0, 0.0), orientation=frame(0.0)),
        tip_end=ends.Driven(position=tuple(points[-1]), orientation=frame(angle[-1]), axes=("z",)),
    )
    return rod, points, float(np.pi * wire**4 / 64.0 * 200e9 / length)


@pytest.mark.slow
@pytest.mark.parametrize(("turns", "pitch", "hand"), [(2, 0.1, 1), (6, 0.1, 1), (5, 0.2, -1), (3.5, 0.5, 1)])
def test_positions_of_a_helix_at_rest_give_no_load(turns, pitch, hand):
    rod, points, moment = helix(turns, pitch, hand)
    for step in (1, 4):
        found = kc.equilibrium(rod, np.zeros(1), space="lobatto4", initial=points[::step])
        assert found.result[0] == kc.Result.CONVERGED
        assert np.max(np.abs(found.moment)) < 2e-2 * moment
        np.testing.assert_allclose(found.position[0], points, atol=1e-4)


@pytest.mark.slow
def test_positions_with_noise_and_of_a_free_tip_find_the_helix():
    rod, points, moment = helix(5)
    noisy = points[::3] + np.random.default_rng(0).normal(0.0, 2e-4, points[::3].shape)
    found = kc.equilibrium(rod, np.zeros(1), space="lobatto4", initial=noisy)
    assert np.max(np.abs(found.moment)) < 2e-2 * moment
    free = rod.replace(tip_end=ends.Free())
    found = kc.equilibrium(free, np.zeros(0), space="lobatto4", initial=points)
    np.testing.assert_allclose(found.position[0], points, atol=1e-4)


@pytest.mark.slow
def test_a_twisted_rod_keeps_its_twist_in_a_straight_line_and_its_turns_by_the_control():
    """Twisted by 12 rad at rest, also half each way; the moment is that of the control only."""
    line = np.linspace([0.0, 0.0, 0.0], [0.0, 0.0, 1.0], 5)
    twisted = ROD.replace(sections=(sections.Stretch(curvature=(0.0, 0.0, 12.0)),), nodes=41)
    for angle in (0.0, 2.0, -8.0):
        found = kc.equilibrium(twisted, [0.0, 0.0, angle], space="lobatto4", initial=line)
        assert found.result[0] == kc.Result.CONVERGED
        assert torsion(found) == pytest.approx(angle, rel=1e-2, abs=1e-2)
