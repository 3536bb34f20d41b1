"""Rods fed through a hole: statics of the exposed rod, momentum, refused parts."""

import equinox as eqx
import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import knode_cosserat as kc
from knode_cosserat.learning import NetworkOptions
from knode_cosserat.learning.residual import network
from knode_cosserat.robots import Insertion, Stretch
from knode_cosserat.rods.ends import Driven
from knode_cosserat.rods.fluids import Fluid
from knode_cosserat.rods.loads import AttachedMass, DistributedWrench, PointWrench
from knode_cosserat.rods.magnets import Magnet, UniformField
from knode_cosserat.rods.routing import Helical, Straight, Tapered
from knode_cosserat.rods.section import TabulatedSection
from knode_cosserat.solvers.damping import UndampedWarning

L, RADIUS, DENSITY = 0.5, 0.005, 1000.0
MASS = DENSITY * np.pi * RADIUS**2
FED = (Insertion(reserve=0.5, retraction=0.3),)


def rod(**changes):
    given = {
        "length": L,
        "radius": RADIUS,
        "density": DENSITY,
        "youngs_modulus": 1e7,
        "nodes": 11,
        "gravity": (0.0, 0.0, 0.0),
        "bending_damping": 1e-4,
        "effects": FED,
    }
    return kc.robots.SlenderRod(**given | changes)


def rest(robot, *control):
    return kc.equilibrium(robot, list(control), space="lobatto4")


# a stiff arm that turns while it is fed


def eased(time, start=0.1):
    """Integral of a rate that rises smoothly from 0 to 1 until `start` (s)."""
    x = time / start
    return start * np.where(x < 1.0, x**6 - 3.0 * x**5 + 2.5 * x**4, x - 0.5)


def test_material_that_moves_along_a_turning_arm_has_coriolis_forces():
    rate, speed, radius = 3.0, 0.5, 0.01
    arm = rod(
        radius=radius,
        youngs_modulus=2e12,
        bending_damping=40.0,
        shear_damping=2e4,
        nodes=7,
        base_end=Driven(axes=("rx",)),
    )
    way = eased(2e-3 * np.arange(1, 101))
    turning = kc.simulate(
        arm, np.stack([rate * way, speed * way], axis=1), 2e-3, time="bdf2", space="lobatto4"
    )
    y, get = turning.y[-1, 0], arm.y_layout.get
    R = Rotation.from_quat(get(y, "h"), scalar_first=True).as_matrix()
    n, m = R.T @ get(y, "n"), R.T @ get(y, "m")
    mass, inertia, exposed = DENSITY * np.pi * radius**2, DENSITY * np.pi * radius**4 / 4, L + speed * way[-1]
    # 2 Ω × c d₃ of every point; n and m are without the momentum that comes through the hole
    assert n[1] == pytest.approx(2.0 * mass * rate * speed * exposed, rel=1e-5)
    assert m[0] + speed * inertia * rate == pytest.approx(-mass * rate * speed * exposed**2, rel=1e-5)
    assert n[2] + mass * speed**2 == pytest.approx(0.5 * mass * rate**2 * exposed**2, rel=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("insertion", [-0.2, 0.0, 0.3])
def test_it_rests_and_vibrates_as_a_rod_of_the_exposed_length(insertion):
    """With magnets, water and a body at the tip, also at the same modes and stability."""
    laden = {
        "gravity": (0.3, 0.0, 0.0),
        "loads": (
            Magnet(magnetisation=(0.0, 0.0, 5.0), field=UniformField(flux_density=(0.0, 2e-3, 0.0))),
            Fluid(density=200.0), AttachedMass(mass=0.002), PointWrench(force=(0.0, 1e-3, 0.0)),
        ),
    }  # fmt: skip
    fed = rest(rod(**laden), insertion)
    cut = rest(rod(**laden, length=L + insertion, effects=()))
    np.testing.assert_allclose(fed.tip_position, cut.tip_position, atol=1e-9)
    assert np.abs(fed.tip_position[-1, :2]).min() > 1e-4
    modes = [kc.statics.modes(found, count=3).values for found in (fed, cut)]
    np.testing.assert_allclose(modes[0], modes[1], rtol=1e-5)
    assert kc.statics.stability(fed).kind == kc.statics.stability(cut).kind == "stable"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "control"),
    [("delrin-tendon-robot", [7.0, 5.0, 5.0, 7.0]), ("three-chamber-arm", [2e4, 0.0, 1e4])],
)
def test_tendons_and_chambers_act_on_the_exposed_length(name, control):
    robot = kc.load_robot(name)
    fed = rest(robot.replace(effects=(*robot.effects, Insertion(retraction=0.1))), *control, -0.05)
    cut = rest(robot.replace(length=robot.length - 0.05), *control)
    assert np.linalg.norm(fed.tip_position[-1, :2]) > 0.01
    np.testing.assert_allclose(fed.tip_position, cut.tip_position, atol=1e-9)


@pytest.mark.parametrize("insertion", [-0.2, 0.3])
def test_a_hanging_rod_is_stretched_by_its_exposed_weight(insertion):
    down = rest(rod(gravity=(0.0, 0.0, 9.81), youngs_modulus=1e6), insertion)
    exposed = L + insertion
    expected = exposed + DENSITY * 9.81 * exposed**2 / (2.0 * 1e6)
    assert down.tip_position[-1, 2] == pytest.approx(expected, abs=1e-10)


# the material moves through the hole: a fed rod agrees with a rod of the exposed stretch of material

PRECURVED, SAG = (8.0, 0.0, 3.0), (0.3, 0.0, 1.0)
SOFT = {"stiffness": (0.4,), "curvature": (0.0, 3.0, 0.0)}


def table(at, values):
    return TabulatedSection(
        bending_stiffness=values,
        torsional_stiffness=[4e-3],
        axial_stiffness=[800.0],
        mass_per_length=[0.08],
        at=at,
    )


def bare(**changes):
    """A rod without a radius, for tabulated sections."""
    given = {"length": L, "nodes": 21, "gravity": (0.3, 0.0, 1.0), "bending_damping": 1e-4}
    return kc.robots.SlenderRod(**given | changes)


def curved(begin, **changes):
    sections = (Stretch(begin=begin, curvature=PRECURVED),)
    return rod(nodes=21, gravity=(0.3, 0.0, 1.0), sections=sections, **changes)


def wound(turns, angle=0.0, **changes):
    given = {
        "length": L,
        "radius": RADIUS,
        "density": DENSITY,
        "youngs_modulus": 1e7,
        "nodes": 21,
        "gravity": (0.3, 0.0, 0.0),
        "bending_damping": 1e-4,
    }
    routing = (Helical(radius=0.008, phase=angle, turns=turns),)
    return kc.robots.RoutedTendonRobot(**given | {"routing": routing} | changes)


def inflated(dead_volume, **changes):
    chambers = kc.robots.chambers.Chambers(
        angles=(0.0, 2.0), offset=0.003, area=4e-6, drive="gas", dead_volume=dead_volume
    )
    return rod(**changes | {"nodes": 21, "effects": (chambers, *changes.get("effects", FED))})


FED_AND_CUT = {
    # a curved tip of 0.2 m: all of it exposed, a part of it, and with more of the straight rod
    "curved tip": (-0.2, [], curved(0.6), curved(1.0 / 3.0, length=0.3, effects=())),
    "half of a curved tip": (-0.3, [], curved(0.4), curved(0.0, length=0.2, effects=())),
    "curved tip and straight rod": (0.3, [], curved(0.6), curved(0.75, length=0.8, effects=())),
    "curved all along, and behind": (0.1, [], curved(0.0), curved(0.0, length=0.6, effects=())),
    "two sections, one of them hidden": (
        -0.25, [],
        rod(nodes=21, gravity=SAG,
            sections=(Stretch(end=0.4, curvature=PRECURVED), Stretch(begin=0.8, **SOFT))),
        rod(nodes=21, gravity=SAG, length=0.25, effects=(), sections=(Stretch(begin=0.6, **SOFT),)),
    ),
    "taper": (
        -0.25, [], rod(tip_radius=0.003, gravity=(0.3, 0.0, 0.0)),
        rod(radius=0.004, tip_radius=0.003, gravity=(0.3, 0.0, 0.0), length=0.25, effects=()),
    ),
    "table": (
        -0.2, [], bare(cross_section=table((0.0, 0.6, 0.8, 1.0), [5e-3, 5e-3, 2e-3, 1e-3]), effects=FED),
        bare(length=0.3, cross_section=table((0.0, 1.0 / 3.0, 2.0 / 3.0, 1.0), [5e-3, 5e-3, 2e-3, 1e-3])),
    ),
    "load on the tip's half": (
        -0.3, [], rod(nodes=21, loads=(DistributedWrench(force=(0.2, 0.1, 0.0), begin=0.5),)),
        rod(nodes=21, loads=(DistributedWrench(force=(0.2, 0.1, 0.0)),), length=0.2, effects=()),
    ),
    "helix": (
        -0.2, [1.0], wound(2.0, effects=FED), wound(1.2, 4.0 * np.pi * 0.4, length=0.3),
    ),
    "more of a helix": (
        0.3, [0.5], wound(1.0, effects=FED), wound(1.6, -0.6 * 2.0 * np.pi, length=0.8),
    ),
    "tapered tendon": (
        -0.25, [2.0], wound(0, routing=(Tapered(base_offset=0.012, end_offset=0.004),), effects=FED),
        wound(0, routing=(Tapered(base_offset=0.008, end_offset=0.004),), length=0.25),
    ),
    "tendon anchored within": (
        -0.2, [2.0], wound(0, routing=(Straight(0.008, 0.0, end=0.7),), effects=FED),
        wound(0, routing=(Straight(0.008, 0.0, end=0.5),), length=0.3),
    ),
    # the gas behind the hole is in a dead volume
    "gas": (-0.2, [2e-6, 0.0], inflated(1e-6), inflated(1e-6 + 0.2 * 4e-6, length=0.3, effects=())),
    "more gas": (0.2, [2e-6, 0.0], inflated(2e-6), inflated(2e-6 - 0.2 * 4e-6, length=0.7, effects=())),
    "helix on a reel": (
        -0.2, [0.004], wound(2.0, effects=FED, drive="reel", tendon_compliance=1e-4),
        wound(1.2, 4.0 * np.pi * 0.4, length=0.3, drive="reel", tendon_compliance=1e-4),
    ),
}  # fmt: skip


@pytest.mark.parametrize(
    "case",
    [
        name if name in ("half of a curved tip", "helix") else pytest.param(name, marks=pytest.mark.slow)
        for name in FED_AND_CUT
    ],
)
def test_a_fed_rod_rests_as_a_rod_of_the_exposed_material(case):
    inserted, control, fed, cut = FED_AND_CUT[case]
    names = fed.control_layout.names
    fed = rest(fed, *([inserted, *control] if names[0] == "insertion" else [*control, inserted]))
    cut = rest(cut, *control)
    # the nodes lie differently where a stretch is shorter: errors of order 4
    np.testing.assert_allclose(fed.tip_position, cut.tip_position, atol=2e-6)
    assert np.hypot(*cut.tip_position[-1, :2]) > 0.003


@pytest.mark.slow
def test_a_tapered_rod_carries_its_momentum_through_the_hole():
    """At a constant rate nothing accelerates: n is the momentum -c ρA ℓ_t that comes in with the rod."""
    rate, dt = 0.4, 2e-3
    tapered = rod(youngs_modulus=1e9, tip_radius=0.5 * RADIUS, shear_damping=20.0)
    way = rate * eased(dt * np.arange(1, 301)) - 0.25
    start = rest(tapered, -0.25)
    found = kc.simulate(tapered, way[:, None], dt, space="lobatto4", time="bdf2", initial=start)
    ahead = 1.0 - np.linspace(0.0, 1.0, 11)
    place = L - (L + way[-1]) * ahead
    mass = MASS * (1.0 - 0.5 * place / L) ** 2
    expected = -mass * ahead * rate**2
    np.testing.assert_allclose(found.part("n")[-1, :, 2], expected, atol=1e-4 * np.abs(expected).max())


@pytest.mark.slow
def test_a_curved_tip_that_is_pushed_out_slowly_passes_through_equilibria():
    """The place where the curved tip begins passes the hole at an insertion of -0.2 m."""
    catheter = curved(0.4)
    way = -0.29 + eased(np.arange(1, 101) / 100.0, 0.2) * 0.29 / 0.9
    start = rest(catheter, -0.29)
    found = kc.simulate(catheter, way[:, None], 1.0, space="lobatto4", initial=start, between="linear")
    for k in (30, 60, 100):
        np.testing.assert_allclose(
            found.tip_position[k], rest(catheter, way[k - 1]).tip_position[-1], atol=5e-5
        )


# motions


def fed_smoothly(duration, rows):
    """0.3 m of insertion, with rates and accelerations of zero at both ends."""
    part = np.arange(1, rows + 1) / rows
    return 0.3 * part**3 * (10.0 - 15.0 * part + 6.0 * part**2)


@pytest.mark.slow
def test_a_hanging_rod_let_out_slowly_is_stretched_by_its_exposed_weight():
    hanging = rod(gravity=(0.0, 0.0, 9.81), youngs_modulus=1e6, shear_damping=2.0)
    inserted = fed_smoothly(1.0, 400)
    exposed = L + inserted
    expected = exposed + DENSITY * 9.81 * exposed**2 / (2.0 * 1e6)
    errors = [
        kc.simulate(
            hanging,
            inserted[:, None],
            duration / 400,
            space="lobatto4",
            time="bdf2",
            between="linear",
            initial=rest(hanging, 0.0),
        ).tip_position[1:, 2]
        - expected
        for duration in (80.0, 160.0)
    ]
    assert np.abs(errors[1]).max() < 1e-6 * L
    # damping and momentum are proportional to the rate and to its square
    assert np.abs(errors[0]).max() == pytest.approx(2.0 * np.abs(errors[1]).max(), rel=0.02)
    assert abs(errors[1][-1]) < 1e-9


@pytest.mark.slow
def test_a_swinging_rod_let_out_slowly_keeps_the_ratio_of_energy_and_frequency():
    """The adiabatic invariant: the amplitude of a bending vibration grows with the root of the length."""
    dt, swinging = 0.02, rod(bending_damping=0.0)

    def rows_of_three_periods(exposed):
        rate = 1.8751040687**2 / exposed**2 * np.sqrt(float(swinging.Kbt[0, 0]) / MASS)
        return round(3.0 * 2.0 * np.pi / rate / dt)

    first, last = rows_of_three_periods(L), rows_of_three_periods(L + 0.3)
    control = np.concatenate([np.zeros(first), fed_smoothly(20.0, 1000), np.full(last, 0.3)])
    with pytest.warns(UndampedWarning):
        found = kc.simulate(
            swinging,
            control[:, None],
            dt,
            space="lobatto4",
            time="trapezoidal",
            between="linear",
            initial=rest(rod(gravity=(0.02, 0.0, 0.0)), 0.0),
        )
    swing = found.tip_position[1:, 0]
    growth = np.sqrt(np.mean(swing[-last:] ** 2) / np.mean(swing[:first] ** 2))
    assert growth == pytest.approx(np.sqrt((L + 0.3) / L), rel=2e-3)


@pytest.mark.slow
def test_a_motion_converges_with_order_four():
    inserted = eased(0.02 * np.arange(1, 101), 0.5)[:, None] / 8.0

    def tip(nodes):
        bent = rod(nodes=nodes, gravity=(3.0, 0.0, 5.0))
        moved = kc.simulate(bent, inserted, 0.02, space="lobatto4", time="bdf2", initial=rest(bent, 0.0))
        return np.asarray(moved.tip_position[-1])

    finest = tip(49)
    errors = [np.linalg.norm(tip(nodes) - finest) for nodes in (7, 13, 25)]
    assert np.log2(np.divide(errors[:-1], errors[1:])).min() > 3.9
    assert errors[-1] < 1e-6 * L


def test_a_straight_rod_takes_its_momentum_from_the_hole():
    """The force at s is -ρA (ℓ - s) ℓ_tt, and n there less the momentum ρA c ℓ_t that enters with the rod."""
    steps, rate = 250, 0.4
    t = np.linspace(0.0, 0.5, steps + 1)
    inserted = rate * t**2 / 2.0
    stiff = rod(youngs_modulus=1e9)
    found = kc.simulate(
        stiff, inserted[1:, None], t[1], space="lobatto4", time="bdf2", initial=rest(stiff, 0.0)
    )
    speed, exposed = rate * t[-1], L + inserted[-1]
    ahead = 1.0 - np.linspace(0.0, 1.0, 11)
    n, q = found.part("n")[-1, :, 2], found.part("q")[-1, :, 2]
    np.testing.assert_allclose(q, speed * (1.0 - ahead), atol=1e-6 * speed)
    expected = -MASS * (exposed * ahead * rate + ahead * speed**2)
    np.testing.assert_allclose(n, expected, atol=1e-6 * np.abs(expected).max())
    assert found.tip_position[-1, 2] == pytest.approx(exposed, rel=1e-6)


# what it excludes


def test_the_control_has_the_limits_of_the_hole():
    field = rod().control_layout.fields[0]
    assert (field.name, field.low, field.high) == ("insertion", -0.3, 0.5)
    with pytest.raises(ValueError, match=r"insertion"):
        rest(rod(), 0.6)


@pytest.mark.slow
def test_it_runs_in_batches_has_gradients_carries_a_model_and_is_identified():
    control = np.linspace(0.0, 0.2, 21)[1:, None]

    def moved(modulus, **options):
        robot = rod(youngs_modulus=modulus, gravity=(1.0, 0.0, 0.0), nodes=6, base_end=Driven(axes=("x",)))
        return kc.simulate(robot, np.hstack([0.1 * control, control]), 0.01, **options)

    robots = [moved(modulus).system for modulus in (1e7, 3e7)]
    both = kc.simulate(robots, np.tile(np.hstack([0.1 * control, control]), (2, 1, 1)), 0.01)
    np.testing.assert_allclose(both[1].tip_position, moved(3e7).tip_position, rtol=0.0, atol=1e-12)
    slope = jax.grad(lambda modulus: moved(modulus).tip_position[-1, 0])(3e7)
    apart = moved(3.003e7).tip_position[-1, 0] - moved(2.997e7).tip_position[-1, 0]
    assert float(slope) == pytest.approx(float(apart) / 6e4, rel=1e-3)
    none = jax.tree.map(
        lambda leaf: 0.0 * leaf if eqx.is_inexact_array(leaf) else leaf,
        network(robots[0], NetworkOptions(hidden=3), jax.random.PRNGKey(0)),
    )
    model = kc.KNODE(robots[0], none).replace(youngs_modulus=3e7)
    found = kc.simulate(model, np.hstack([0.1 * control, control]), 0.01)
    np.testing.assert_allclose(found.tip_position, moved(3e7).tip_position, atol=1e-9)
    fit = kc.identify(robots[0], [moved(3e7)], parameters=["youngs_modulus"])
    assert fit.robot.youngs_modulus == pytest.approx(3e7, rel=1e-5)
