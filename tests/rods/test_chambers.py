"""Pressure chambers: closed forms of extension, bending and twist, supply by volume, hyperelastic stretch."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import simpson
from scipy.optimize import brentq, fsolve

import knode_cosserat as kc
from knode_cosserat.rods.chambers import ATMOSPHERE, Chambers, Hyperelastic
from knode_cosserat.rods.loads import AttachedMass, PointWrench

L, R, E = 0.2, 0.0125, 1.5e5
EA, EI, GJ = E * np.pi * R**2, E * np.pi * R**4 / 4, 2 * E / 2.6 * np.pi * R**4 / 4
r, a = 0.007, 0.004
A = np.pi * a**2
THREE = tuple(2 * np.pi * k / 3 for k in range(3))
BODY = {
    "length": L,
    "radius": R,
    "density": 1080.0,
    "youngs_modulus": E,
    "bending_damping": 2e-4,
    "shear_damping": 0.5,
    "gravity": (0.0, 0.0, 0.0),
    "nodes": 6,
}
P = 3e4


def arm(*others, body=(), angles=THREE, **chambers):
    part = Chambers(**{"angles": angles, "offset": r, "radius": a} | chambers)
    return kc.robots.SlenderRod(**BODY | dict(body), effects=(part, *others))


def strains(robot, control, node=-2):
    shape = kc.equilibrium(robot, control)
    return shape.part("v")[0, node], shape.part("u")[0, node]


def fine(robot, control):
    return kc.equilibrium(robot, control, space="lobatto4")


def test_equal_pressures_lengthen_the_arm():
    v, u = strains(arm(), [P, P, P])
    np.testing.assert_allclose(v, [0.0, 0.0, 1.0 + 3 * P * A / EA], atol=1e-13)
    np.testing.assert_allclose(u, 0.0, atol=1e-12)


def test_one_pressure_bends_the_arm_away():
    v, u = strains(arm(), [P, 0.0, 0.0])
    np.testing.assert_allclose(v, [0.0, 0.0, 1.0 + P * A / EA], atol=1e-13)
    np.testing.assert_allclose(u, [0.0, -P * A * r / EI, 0.0], atol=1e-12)


def test_the_arm_bends_to_a_circle_with_order_four():
    """The circle has the length of the stretched arm."""
    curvature = P * A * r / EI
    turned, radius = curvature * L, (1.0 + P * A / EA) / curvature
    circle = [-radius * (1 - np.cos(turned)), 0.0, radius * np.sin(turned)]
    errors = [
        np.linalg.norm(fine(arm(body={"nodes": nodes}), [P, 0.0, 0.0]).tip_position[0] - circle)
        for nodes in (6, 21)
    ]
    assert errors[-1] < 1e-6 * L
    assert np.log(errors[0] / errors[1]) / np.log(4.0) == pytest.approx(4.0, abs=0.2)


def test_chambers_of_a_stretch_bend_only_that_stretch():
    robot = arm(begin=0.2, end=0.6, body={"nodes": 11})
    shape = kc.equilibrium(robot, [0.0, P, 0.0])
    bend = np.linalg.norm(shape.part("u")[0], axis=1)
    inside = slice(2, 6)
    np.testing.assert_allclose(bend[inside], P * A * r / EI, rtol=1e-12)
    assert np.all(np.delete(bend, np.r_[inside]) < 1e-9)


def test_helical_chambers_twist_the_arm():
    """Two opposite helices: uniform stretch and twist solve two equations of equilibrium."""
    twist = 6.0
    v, u = strains(arm(angles=(0.0, np.pi), twist=twist), [P, P])

    def unbalanced(x):
        across, along = r * (x[1] + twist / L), x[0]
        length = np.hypot(across, along)
        return EA * (x[0] - 1) - 2 * P * A * along / length, GJ * x[1] - 2 * P * A * r * across / length

    stretch, turn = fsolve(unbalanced, [1.0, 0.0], xtol=1e-14)
    assert turn > 0.5
    np.testing.assert_allclose([v[2], u[2]], [stretch, turn], rtol=1e-9)
    np.testing.assert_allclose([v[0], v[1], u[0], u[1]], 0.0, atol=1e-10)


def test_a_tendon_at_the_same_place_holds_a_chamber():
    """A chamber pushes as a tendon of the tension p A pulls: together they do nothing."""
    tendons = kc.robots.RoutedTendonRobot(
        **BODY, tendon_offset=r, tendon_angles=THREE, effects=(Chambers(angles=THREE, offset=r, radius=a),)
    )
    assert [f.name for f in tendons.control_layout.fields] == ["tension", "pressure"]
    pressures = np.array([P, 0.5 * P, 0.0])
    v, u = strains(tendons, [*(A * pressures), *pressures])
    np.testing.assert_allclose(np.concatenate([v, u]), [0, 0, 1, 0, 0, 0], atol=1e-12)
    alone = strains(tendons, [0.0, 0.0, 0.0, *pressures])
    np.testing.assert_allclose(alone, strains(arm(), pressures), atol=1e-12)


GROWING = {"area_by_stretch": 0.8, "area_by_pressure": 4e-6}
HANGING = {"nodes": 41, "gravity": (3.0, 0.0, 9.0), "loads": (AttachedMass(mass=0.03),)}


@pytest.mark.parametrize(
    ("drive", "areas"),
    [
        ("liquid", GROWING),
        pytest.param("gas", GROWING, marks=pytest.mark.slow),
        pytest.param("liquid", {}, marks=pytest.mark.slow),
        pytest.param("gas", {}, marks=pytest.mark.slow),
    ],
)
def test_volumes_that_pressures_need_give_those_pressures(drive, areas):
    """The volume of the chambers under pressure control, with line and compressible gas, closes the loop."""
    pressures = np.array([P, 0.6 * P, 0.0])
    supply = {"compliance": 2e-13} if drive == "liquid" else {"dead_volume": 2e-5}
    by_pressure = fine(arm(body=HANGING, **areas), pressures)
    robot = arm(body=HANGING, drive=drive, **supply, **areas)
    v, u = (by_pressure.part(name)[0] for name in "vu")
    places = np.stack([r * np.cos(THREE), r * np.sin(THREE), np.zeros(3)], axis=1)
    stretch = np.linalg.norm(v[:, None] + np.cross(u[:, None], places), axis=-1)
    growth = (
        areas.get("area_by_stretch", 0.0) * (stretch - 1) + areas.get("area_by_pressure", 0.0) * pressures
    )
    volume, rest = simpson(A * stretch * (1 + growth), dx=L / 40, axis=0), A * L
    if drive == "liquid":
        pumped = volume - rest + 2e-13 * pressures
    else:
        pumped = 2e-5 + volume - (2e-5 + rest) / (1 + pressures / ATMOSPHERE)
    found = fine(robot, pumped)
    np.testing.assert_allclose(found.part("effect0_pressure")[0, 0], pressures, atol=3e-5 * P)
    np.testing.assert_allclose(found.tip_position, by_pressure.tip_position, atol=1e-6 * L)


@pytest.mark.slow
def test_pressure_and_force_are_reciprocal():
    """Maxwell: a volume moves the tip against a force as the force changes the pressure at that volume."""
    force = (PointWrench(force=(0.0, 0.3, 1.0), controlled=True),)
    body = {"loads": force, "nodes": 21}
    robot = arm(body=body, drive="liquid", compliance=1e-12, **GROWING)
    control = np.array([1.0, 1.5e-6, 1e-6, 5e-7])  # the load's factor comes first

    def moved(*change):
        shape = fine(robot, control + change)
        return shape.tip_position[0] @ [0.0, 0.3, 1.0], shape.part("effect0_pressure")[0, 0, 0]

    pressure = (moved(1e-3, 0, 0, 0)[1] - moved(-1e-3, 0, 0, 0)[1]) / 2e-3
    work = (moved(0, 1e-9, 0, 0)[0] - moved(0, -1e-9, 0, 0)[0]) / 2e-9
    assert abs(pressure) > 100.0
    assert pressure == pytest.approx(-work, rel=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("ratios", [(0.0, 0.0), (0.4, 0.05)], ids=["neo-Hookean", "Yeoh"])
@pytest.mark.parametrize("force", [20.0, -20.0])
def test_the_axial_force_is_hyperelastic(ratios, force):
    """Pulled and pushed by up to a large strain, with half of the force from the chambers."""
    pull = PointWrench(force=(0.0, 0.0, force), controlled=True)
    robot = arm(Hyperelastic(*ratios), body={"loads": (pull,), "bending_stiffness": 1.0})
    pressure = 0.25 * abs(force) / A / 3

    def unbalanced(x):
        J = x * x + 2 / x - 3
        stress = EA / 3 * (x - x**-2) * (1 + 2 * ratios[0] * J + 3 * ratios[1] * J * J)
        return stress - force - 3 * pressure * A

    v, _ = strains(robot, [1.0, *[pressure] * 3])
    expected = brentq(unbalanced, 0.2, 5.0, xtol=1e-14)
    assert abs(expected - 1.0) > 0.15
    assert v[2] == pytest.approx(expected, rel=1e-10)


def test_small_strains_are_linear():
    pull = arm(Hyperelastic(0.4, 0.05))
    v, _ = strains(pull, [1.0, 1.0, 1.0])
    assert v[2] - 1.0 == pytest.approx(3 * A / EA, rel=1e-4)


@pytest.mark.slow
def test_an_arm_of_two_segments_moves_and_returns():
    """Names of equal controls have the parts' prefixes; the arm comes to rest at its equilibrium."""
    second = Chambers(angles=(0.5, 2.6, 4.7), offset=r, radius=a, begin=0.5)
    robot = arm(second, end=0.5, body={"gravity": (0.0, 0.0, 9.81), "bending_damping": 1e-3})
    assert [f.name for f in robot.control_layout.fields] == ["effect0_pressure", "effect1_pressure"]
    control = np.array([P, 0.0, 0.0, 0.0, P, 0.0])
    motion = kc.simulate(robot, np.tile(control, (300, 1)), 0.02, initial=kc.equilibrium(robot, 0 * control))
    rest = kc.equilibrium(robot, control)
    np.testing.assert_allclose(motion.tip_position[-1], rest.tip_position[0], atol=1e-5 * L)


@pytest.mark.slow
def test_pressures_move_the_tip_with_exact_gradients():
    robot = arm(Hyperelastic(), drive="pressure", **GROWING)
    controls = np.linspace(0.0, P, 12)[:, None] * np.array([1.0, 0.3, 0.0])

    def tip(area, pressures):
        own = robot.replace(**{"effects.0.radius": area})
        return kc.simulate(own, pressures, 0.02).y[-1, -1, :3]

    along = jax.jacobian(tip, argnums=(0, 1))(a, jnp.asarray(controls))
    for k, (step, change) in enumerate(((1e-7, 1.0), (1.0, np.ones_like(controls)))):
        ends = []
        for sign in (1, -1):
            values = [a, controls]
            values[k] = values[k] + sign * step * change
            ends.append(np.asarray(tip(*values)))
        expected = (ends[0] - ends[1]) / (2 * step)
        slope = np.asarray(along[k]) if k == 0 else np.asarray(along[k]).sum(axis=(1, 2))
        np.testing.assert_allclose(slope, expected, atol=1e-5 * np.abs(expected).max())


def test_a_batch_of_arms_is_each_of_them():
    radii = np.array([0.003, 0.0035, 0.004])
    control = np.tile([P, 0.0, 0.5 * P], (8, 1))
    many = kc.simulate([arm(radius=radius) for radius in radii], control, 0.02)
    for k, radius in enumerate(radii):
        alone = kc.simulate(arm(radius=radius), control, 0.02)
        np.testing.assert_allclose(many.tip_position[k], alone.tip_position, atol=1e-9)


def test_a_file_reads_back_equal(tmp_path):
    robot = arm(Hyperelastic(0.1, 0.2), drive="gas", dead_volume=1e-5, twist=1.0, begin=0.1, **GROWING)
    kc.save_robot(robot, tmp_path / "arm.yaml")
    assert jax.tree.all(jax.tree.map(np.array_equal, kc.load_robot(tmp_path / "arm.yaml"), robot))


def test_a_pressure_beyond_its_range_stops_with_one_line():
    robot = arm(highest=6e4)
    with pytest.raises(
        ValueError, match=r"pressure_2 is 70000 Pa at index .*; allowed is below 60000"
    ) as error:
        kc.equilibrium(robot, [0.0, 7e4, 0.0])
    assert "\n" not in str(error.value)
