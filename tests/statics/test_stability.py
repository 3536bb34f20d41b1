"""Stability of equilibria: classical buckling loads from both sides, an arch that snaps, several rods."""

import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.rods.ends import Clamped, Free, Pinned
from knode_cosserat.rods.loads import PointWrench
from knode_cosserat.rods.strands import strand_of
from knode_cosserat.rods.tendons import TendonFriction, Vibration
from tests.trajectories import synthetic

L, RADIUS, E = 0.5, 2e-3, 2e9
EI, EA = E * np.pi * RADIUS**4 / 4, E * np.pi * RADIUS**2
ROD = kc.robots.SlenderRod(
    length=L,
    radius=RADIUS,
    density=1200.0,
    youngs_modulus=E,
    bending_damping=1e-3,
    drag=1e-3,
    gravity=[0.0, 0.0, 0.0],
    nodes=21,
)
PINNED = 4.493409457909064**2


def squeezed(end, load):
    """Straight, its tip held where `load` EI/L² press it to."""
    tip = [0.0, 0.0, (1.0 - load * EI / L**2 / EA) * L]
    return straight(ROD.replace(tip_end=end(position=tip)), tip)


def straight(rod, tip):
    """The straight equilibrium, stable or not."""
    return kc.equilibrium(rod, np.zeros(0), space="lobatto4", initial=[[0.0, 0.0, 0.0], tip])


# columns


@pytest.mark.parametrize(
    ("end", "loads"),
    [
        # Timoshenko & Gere, Theory of elastic stability, 2.1: the symmetric and the antisymmetric mode
        (Clamped, (4.0 * np.pi**2, 4.0 * PINNED)),
        (Pinned, (PINNED, 7.725251836937707**2)),
    ],
)
@pytest.mark.campaign
def test_a_column_buckles_every_way_at_once_at_each_of_its_loads(end, loads):
    counts = [
        kc.statics.stability(squeezed(end, part * load)).unstable_directions
        for load in loads
        for part in (0.98, 1.02)
    ]
    # in two planes each
    assert counts == [0, 2, 2, 4]


@pytest.mark.campaign
def test_the_least_eigenvalue_crosses_zero_at_the_load_whatever_the_nodes():
    critical = []
    for nodes in (11, 21):
        rod = ROD.replace(nodes=nodes)
        at = np.array([0.99, 1.01]) * 4.0 * np.pi**2
        found = []
        for load in at:
            tip = [0.0, 0.0, (1.0 - load * EI / L**2 / EA) * L]
            rest = straight(rod.replace(tip_end=Clamped(position=tip)), tip)
            found.append(kc.statics.stability(rest).least)
        critical.append(at[0] - found[0] * (at[1] - at[0]) / (found[1] - found[0]))
    # P (1 + P/GA - P/EA) = 4π² EI/L²: shear makes it softer, and squeezing shorter
    exact = 4.0 * np.pi**2 * (1.0 - 4.0 * np.pi**2 * (EI / L**2) * (2.6 - 1.0) / EA)
    errors = np.abs(np.array(critical) - exact)
    assert errors[0] < 1e-4 * exact and errors[1] < errors[0] / 8


@pytest.mark.slow
@pytest.mark.parametrize("part", [0.5, 0.98, 1.02, 4.0])
@pytest.mark.parametrize("space", [pytest.param("euler", marks=pytest.mark.campaign), "lobatto4"])
def test_an_upright_column_falls_beyond_greenhills_load_by_either_scheme(part, space):
    density = 7.83735 * EI / L**3 * part / (np.pi * RADIUS**2 * 98.1)
    rod = ROD.replace(density=density, gravity=[0.0, 0.0, -98.1], tip_end=Free())
    found = kc.statics.stability(kc.equilibrium(rod, np.zeros(0), space=space))
    assert found.unstable_directions == (2 if part > 1.0 else 0)
    assert found.stable == (part < 1.0) and (found.least > 0.0) == (part < 1.0)
    # it falls over: the tip moves most, and sideways
    moved = np.linalg.norm(found.mode[:, :2], axis=1)
    assert np.argmax(moved) == len(moved) - 1 and moved[-1] == pytest.approx(1.0, abs=1e-6)


@pytest.mark.campaign
def test_a_buckled_column_has_nothing_to_lose_but_its_plane():
    """Pushed aside while it is squeezed, then let go: it may turn about its line for nothing, and no more."""
    load = 2.0 * 4.0 * np.pi**2
    end = Clamped(position=[0.0, 0.0, (1.0 - load * EI / L**2 / EA) * L])
    pushed = ROD.replace(tip_end=end, loads=(PointWrench(at=0.5, force=[1.0, 0.0, 0.0], controlled=True),))
    rest, least = None, []
    for push in (5.0, 2.0, 1.0, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01):
        rest = kc.equilibrium(pushed, [push * EI / L**2], space="lobatto4", initial=rest)
        found = kc.statics.stability(rest)
        least.append(found.least)
        assert found.stable
    assert np.max(np.abs(rest.position[0, :, 0])) > 0.005 * L
    # only the push keeps it in its plane
    assert least[-1] == pytest.approx(least[-2] / 2, rel=0.05)
    # the way that costs least is across the plane in which it has buckled
    assert np.max(np.abs(found.mode[:, 1])) > 0.99


# an arch


@pytest.mark.campaign
def test_an_arch_snaps_where_it_is_no_longer_stable_and_says_so():
    """Pushed in its middle against its bend, step by step: one row has snapped, and says so."""
    arch = ROD.replace(
        nodes=21,
        tip_end=Pinned(position=[0.0, 0.0, 0.9 * L]),
        loads=(PointWrench(at=0.5, force=[1.0, 0.0, 0.0], controlled=True),),
    )
    unit = EI / L**2
    rest = kc.equilibrium(arch, [20.0 * unit], space="lobatto4")
    side = np.sign(rest.position[0, 10, 0])
    middle, least, results = [], [], []
    for load in np.linspace(20.0, -40.0, 31) * unit * side:
        rest = kc.equilibrium(arch, [load], space="lobatto4", initial=rest)
        middle.append(side * float(rest.position[0, 10, 0]) / L)
        least.append(kc.statics.stability(rest).least)
        results.append(int(rest.result[0]))
    jumps = np.flatnonzero(np.abs(np.diff(middle)) > 0.1) + 1
    assert len(jumps) == 1
    snapped = int(jumps[0])
    assert results[snapped] == kc.Result.RECOVERED_RELAXATION
    assert set(np.delete(results, snapped)) == {kc.Result.CONVERGED}
    assert middle[snapped - 1] > 0.0 > middle[snapped]
    # out of its plane it gives way before, which a push in the plane does not tell it
    print("least eigenvalue by load:", np.round(least, 2))


# slender and bent: a segment's axis is stiffer by orders of magnitude than its bending


def wire(slenderness, bend, nodes):
    """Bent by a force across its tip, which nothing makes unstable."""
    r, modulus = 0.3 / slenderness, 70e9
    force = 2.0 * bend * modulus * np.pi * r**4 / 4 / 0.3**2
    return kc.robots.SlenderRod(
        length=0.3,
        radius=r,
        density=6450.0,
        youngs_modulus=modulus,
        gravity=[0.0, 0.0, 0.0],
        nodes=nodes,
        loads=(PointWrench(force=[force, 0.0, 0.0]),),
    )


@pytest.mark.campaign
@pytest.mark.parametrize("bends", [(2.0,), (0.1, 1.0)], ids=["far", "less"])
def test_a_slender_wire_is_stable_however_it_is_bent_and_at_few_nodes(bends):
    for slenderness in (50.0, 300.0, 600.0, 6000.0, 60000.0):
        for bend in bends:
            found = kc.statics.stability(
                kc.equilibrium(wire(slenderness, bend, 10), np.zeros(0), space="lobatto4")
            )
            assert found.unstable_directions == 0 and found.least == pytest.approx(1.7, rel=0.25)
            # rounding of the stretching stiffness, over the energy of bending
            assert found.asymmetry < 1e-9 + 1e-15 * slenderness**2


@pytest.mark.campaign
@pytest.mark.parametrize("nodes", [5, 20, 40])
def test_of_a_slender_wire_the_nodes_do_not_change_what_is_least(nodes):
    least = [
        kc.statics.stability(kc.equilibrium(wire(600.0, 1.5, each), np.zeros(0), space=space)).least
        for each, space in ((10, "euler"), (10, "lobatto4"), (nodes, "lobatto4"))
    ]
    assert least[0] == pytest.approx(least[1], rel=1e-6) and least[1] == pytest.approx(least[2], rel=0.02)


@pytest.mark.campaign
def test_the_six_legs_of_the_catalogs_robot_are_stable():
    robot = kc.load_robot("six-legged-robot")
    rest, moved = (
        kc.statics.stability(kc.equilibrium(robot, [push, 0.0, 0.0, 0.0, 0.0, 0.0])) for push in (0.0, 0.02)
    )
    # 7.29 at 40 nodes
    assert rest.stable and rest.least == pytest.approx(7.2, rel=0.02)
    assert moved.stable and moved.least == pytest.approx(6.9, rel=0.02)


@pytest.mark.campaign
def test_a_slender_robot_bent_by_its_tendon_is_stable():
    modulus, r = 70e9, 1e-3
    robot = kc.robots.RoutedTendonRobot(
        length=0.6,
        radius=r,
        density=6450.0,
        youngs_modulus=modulus,
        gravity=[0.0, 0.0, 0.0],
        tendon_offset=0.01,
        tendon_angles=[0.0],
    )
    for bend in (0.5, 1.0, 1.5):
        tension = bend * modulus * np.pi * r**4 / 4 / 0.6 / 0.01
        found = kc.statics.stability(kc.equilibrium(robot, [tension], space="lobatto4"))
        assert found.stable and found.least == pytest.approx(1.9, rel=0.02)


@pytest.mark.campaign
@pytest.mark.parametrize("nodes", [10, 20])
def test_a_slender_arch_pushed_inwards_leaves_its_plane(nodes):
    """It turns about its line for nothing once nothing pushes it; pushed inwards it gains by that."""
    length, r = 0.6, 1e-3
    unit = 70e9 * np.pi * r**4 / 4 / length**2
    arch = kc.robots.SlenderRod(
        length=length,
        radius=r,
        density=6450.0,
        youngs_modulus=70e9,
        bending_damping=1e-3,
        nodes=nodes,
        gravity=[0.0, 0.0, 0.0],
        tip_end=Pinned(position=[0.0, 0.0, 0.9 * length]),
        loads=(PointWrench(at=0.5, force=[1.0, 0.0, 0.0], controlled=True),),
    )
    rest = kc.equilibrium(arch, [20.0 * unit], space="lobatto4")
    side = np.sign(rest.position[0, nodes // 2, 0])
    found = []
    for load in (20.0, 0.0, -5.0, -20.0):
        rest = kc.equilibrium(arch, [load * unit * side], space="lobatto4", initial=rest)
        found.append(kc.statics.stability(rest))
    assert [each.unstable_directions for each in found] == [0, 0, 1, 1]
    assert [each.least for each in found] == pytest.approx([1.81, 0.0, -4.27, -19.7], rel=0.02, abs=1e-3)
    # across the plane of the arch
    assert np.max(np.abs(found[-1].mode[:, 1])) > 0.99


@pytest.mark.campaign
@pytest.mark.parametrize("nodes", [2, 3, 5])
def test_what_buckles_between_two_nodes_is_counted_too(nodes):
    counts = []
    for part in (0.98, 1.02, 1.5, 9.0):
        tip = [0.0, 0.0, (1.0 - part * 4.0 * np.pi**2 * EI / L**2 / EA) * L]
        rest = straight(ROD.replace(tip_end=Clamped(position=tip), nodes=nodes), tip)
        counts.append(kc.statics.stability(rest).unstable_directions)
    assert counts[:3] == [0, 2, 2] and counts[3] >= 8


@pytest.mark.campaign
def test_what_rounding_hides_is_undecided():
    """A rod between two pins turns about itself for nothing: a zero, in a rod so slender of rounding only."""
    free = wire(1e5, 0.0, 10).replace(
        loads=(), base_end=Pinned(), tip_end=Pinned(position=[0.0, 0.0, 0.3 * (1.0 + 1e-9)])
    )
    found = kc.statics.stability(kc.equilibrium(free, np.zeros(0), space="lobatto4"))
    assert found.kind == "undecided" and found.unstable_directions == -1 and not found.stable
    assert "least eigenvalue" in found.reason and "less slender" in found.reason


# several rods, and others


@pytest.mark.campaign
def test_a_platform_on_upright_legs_falls_under_its_buckling_load():
    """Legs clamped at both ends of a platform that can move sideways: π² EI/L² each."""
    robot = kc.load_robot("six-legged-robot")
    even = np.arange(6) * np.pi / 3
    stiffness, length = float(strand_of(robot).Kbt[0, 0]), float(robot.length)
    for part in (0.95, 1.05):
        mass = part * 6.0 * np.pi**2 * stiffness / length**2 / 9.81
        loaded = robot.replace(
            base_angles=even,
            platform_angles=even,
            platform_radius=float(robot.base_radius),
            density=1.0,
            platform_mass=mass,
        )
        found = kc.statics.stability(kc.equilibrium(loaded, np.zeros(6), space="lobatto4"))
        assert found.stable == (part < 1.0)
        assert found.mode.shape == (robot.nodes, 6, 3)


@pytest.mark.campaign
def test_tendons_keep_a_potential():
    robot = kc.robots.RoutedTendonRobot.like(kc.load_robot("delrin-tendon-robot"), length=1.0)
    found = kc.statics.stability(kc.equilibrium(robot, [5.0, 2.0, 1.0, 3.0], space="lobatto4"))
    assert found.stable and found.asymmetry < 1e-3


def test_what_is_no_equilibrium_is_refused():
    robot = kc.load_robot("delrin-tendon-robot")
    moved = kc.simulate(robot, kc.controls.sine(1.0, 5, 0.05), 0.05)
    with pytest.raises(ValueError, match=r"row 3 is no equilibrium"):
        kc.statics.stability(moved, row=3)
    with pytest.raises(ValueError, match=r"row is 9; allowed is -6 to 5"):
        kc.statics.stability(moved, row=9)
    with pytest.raises(ValueError, match=r"of a batch"):
        kc.statics.stability(synthetic(batch=(2,)))


@pytest.mark.campaign
def test_reels_hold_a_column_that_would_fall():
    """By the motion: a column with slack tendons falls under its weight, and taut tendons do not let it."""
    robot = kc.load_robot("delrin-tendon-robot").replace(length=1.0, gravity=[0.0, 0.0, -60.0])
    reels = kc.robots.RoutedTendonRobot.like(robot, drive="reel", tendon_compliance=1e-3)
    slack = kc.statics.stability(kc.equilibrium(reels, np.full(4, -0.01)))
    assert slack.kind == "divergence" and np.isnan(slack.least)
    taut = kc.statics.stability(kc.equilibrium(reels, np.full(4, 1e-3)))
    assert taut.stable


@pytest.mark.campaign
def test_friction_is_not_counted():
    """All tendons together push a column down, with or without friction in it."""
    robot = kc.robots.RoutedTendonRobot.like(kc.load_robot("delrin-tendon-robot"), length=1.0)
    rough = robot.replace(
        friction=TendonFriction(wobble=0.5, curvature=0.1), vibration=Vibration(tension=1e6, rate=0.0)
    )
    for gravity in (-9.81, -60.0):
        found = [
            kc.statics.stability(kc.equilibrium(each.replace(gravity=[0.0, 0.0, gravity]), np.full(4, 5.0)))
            for each in (robot, rough)
        ]
        assert found[0].stable == (gravity > -20.0)
        assert found[1].unstable_directions == found[0].unstable_directions
        assert found[1].least == pytest.approx(found[0].least, rel=1e-6)
