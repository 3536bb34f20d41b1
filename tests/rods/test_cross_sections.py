"""Cross-sections: stiffness against integrals and tables, rods against closed forms of beams."""

import jax
import jax.numpy as jnp
import jsonschema
import numpy as np
import pytest
from scipy.integrate import quad

import knode_cosserat as kc
from knode_cosserat._files.yaml_text import mapping_of
from knode_cosserat.cli.summaries import derived, parameters
from knode_cosserat.identification.effects import library_model
from knode_cosserat.identification.rod_effects import _with_axes, _with_table
from knode_cosserat.learning import NetworkOptions
from knode_cosserat.learning.residual import network
from knode_cosserat.robots import Observed, robot_schema
from knode_cosserat.rods.loads import DistributedWrench, PointWrench
from knode_cosserat.rods.robot_file import format_robot, parse_robot
from knode_cosserat.rods.section import (
    EllipticSection,
    HollowSection,
    RectangularSection,
    TabulatedSection,
    rectangle_torsion,
)
from knode_cosserat.rods.surroundings import Plane
from knode_cosserat.rods.tendon_robots import VirtualRobot
from knode_cosserat.rods.tendons import RibSpacing, stiffness_under_pressure
from knode_cosserat.viewer.scene import drawing

L, E, G, DENSITY = 0.5, 1e9, 4e8, 1200.0
MATERIAL = {"density": DENSITY, "youngs_modulus": E, "shear_modulus": G}
W, H = 0.012, 0.003
STRIP = RectangularSection(width=W, height=H)
TABLE = TabulatedSection(
    at=(0.0, 0.37, 1.0),
    bending_stiffness=(2.0, 0.8, 0.5),
    bending_stiffness_y=(3.0, 1.5, 0.6),
    torsional_stiffness=(0.9, 0.7, 0.3),
    axial_stiffness=(3e4,),
    mass_per_length=(0.05, 0.04, 0.03),
)
FORMS = {
    "elliptic": EllipticSection(semi_axis_x=0.006, semi_axis_y=0.002, angle=0.3),
    "hollow": HollowSection(radius=0.005, inner_radius=0.004),
    "rectangular": RectangularSection(width=W, height=H, angle=-0.4),
    "tabulated": TABLE,
}
SPACE = "lobatto4"


def rod(form=None, kind=kc.robots.SlenderRod, **changes):
    own = MATERIAL if form is None or form.is_homogeneous else {}
    given = {"length": L, "gravity": [0.0, 0.0, 0.0], "nodes": 11, "bending_damping": 1e-3, **own}
    return kind(**{**given, "cross_section": form, **changes})


def held(robot, force=(0.0, 0.0, 0.0), moment=(0.0, 0.0, 0.0)):
    """Return the equilibrium under a wrench at the tip."""
    load = {"loads.0.force": np.asarray(force), "loads.0.moment": np.asarray(moment)}
    return kc.equilibrium(robot.replace(**load), np.zeros(0), space=SPACE)


def turn(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


# stiffness and inertia


def test_torsion_of_rectangles():
    """Timoshenko & Goodier, Theory of elasticity, table of section 109; a thin strip's is 1/3 - 0.21 b/a."""
    assert float(rectangle_torsion(1.0, 1.0)) == pytest.approx(0.140577015, abs=1e-9)
    table = {1.2: 0.166, 1.5: 0.196, 2.0: 0.229, 2.5: 0.249, 3.0: 0.263, 4.0: 0.281, 5.0: 0.291, 10.0: 0.312}
    for ratio, coefficient in table.items():
        assert float(rectangle_torsion(2.0 * ratio, 2.0)) / 16.0 / ratio == pytest.approx(
            coefficient, abs=6e-4
        )
    assert float(rectangle_torsion(1e3, 1.0)) == pytest.approx((1.0 - 0.63025e-3) * 1e3 / 3.0, rel=1e-8)
    n = np.arange(1.0, 2001.0, 2.0)
    for w, h in ((1.0, 1.0), (0.3, 1.0), (2.0, 1.5)):
        b, a = sorted((w, h))
        sum_ = np.sum(np.tanh(0.5 * np.pi * n * a / b) / n**5)
        expected = a * b**3 * (1 / 3 - 64 / np.pi**5 * b / a * sum_)
        assert float(rectangle_torsion(w, h)) == pytest.approx(expected, rel=1e-13)
        for x, y in ((w, h), (h, w)):
            slope = jax.grad(rectangle_torsion, argnums=(0, 1))(x, y)
            # homogeneous of degree 4 (Euler), and symmetric
            assert x * slope[0] + y * slope[1] == pytest.approx(4.0 * expected, rel=1e-12)
            assert float(slope[0]) == pytest.approx(float(jax.grad(rectangle_torsion, 1)(y, x)), rel=1e-12)


def test_stiffness_and_inertia_are_integrals_over_the_area():
    x, weight = np.polynomial.legendre.leggauss(40)
    a, b, r, inner = 0.006, 0.002, 0.005, 0.004
    angle, grow = np.meshgrid(np.pi * (x + 1), 0.5 * (x + 1), indexing="ij")
    of_angle, of_radius = np.pi * weight[:, None], 0.5 * weight[None, :]
    radius = inner + (r - inner) * grow
    ell, tube = of_angle * of_radius * a * b * grow, of_angle * of_radius * (r - inner) * radius
    plane = np.meshgrid(0.5 * W * x, 0.5 * H * x, indexing="ij")
    areas = {
        "elliptic": (a * grow * np.cos(angle), b * grow * np.sin(angle), ell),
        "hollow": (radius * np.cos(angle), radius * np.sin(angle), tube),
        "rectangular": (*plane, 0.25 * W * H * np.outer(weight, weight)),
    }
    for name, (x, y, dA) in areas.items():
        form, area = FORMS[name], np.sum(dA)
        J = np.diag([np.sum(y * y * dA), np.sum(x * x * dA), np.sum((x * x + y * y) * dA)])
        R = turn(float(getattr(form, "angle", 0.0)))
        found = rod(form).material(0.3, np.zeros(0))
        np.testing.assert_allclose(found.Kse, np.diag([G, G, E]) * area, rtol=1e-12)
        np.testing.assert_allclose(found.rhoJ, DENSITY * R @ J @ R.T, rtol=1e-12, atol=1e-18)
        np.testing.assert_allclose(found.Kbt[:2, :2], E * (R @ J @ R.T)[:2, :2], rtol=1e-12, atol=1e-12)
        assert found.rhoA == pytest.approx(DENSITY * area)
    # a hollow section's torsion constant is the polar moment, an ellipse's is less
    assert rod(FORMS["hollow"]).Kbt[2, 2] == pytest.approx(G * np.pi * (r**4 - inner**4) / 2)
    assert rod(FORMS["elliptic"]).Kbt[2, 2] == pytest.approx(G * np.pi * a**3 * b**3 / (a * a + b * b))
    assert [float(rod(form).section.radius) for form in (*FORMS.values(),)][:3] == pytest.approx(
        [a, r, 0.5 * np.hypot(W, H)]
    )


def test_a_tube_without_a_hole_is_the_default_of_every_robot():
    radius, tendons = 0.004, {"tendon_offset": 0.01, "tendon_angles": [0.0, 2.0]}
    for kind, more in (
        (kc.robots.SlenderRod, {}),
        (kc.robots.TendonRobot, tendons),
        (kc.robots.RoutedTendonRobot, tendons),
        (VirtualRobot, tendons),
    ):
        plain = rod(kind=kind, radius=radius, tip_radius=0.003, **more)
        tube = rod(HollowSection(radius=radius, inner_radius=0.0), kind, tip_radius=0.003, **more)
        stretch = rod(kind=kind, radius=radius, sections=(kc.robots.Stretch(radius=[1.0, -0.25]),), **more)
        for s in (0.0, 0.2, L):
            for other in (tube, stretch):
                materials = (robot.material(s, np.ones(len(more))) for robot in (plain, other))
                for one, same in zip(*materials, strict=True):
                    np.testing.assert_allclose(one, same, rtol=1e-14)
        np.testing.assert_allclose(plain.section.Kbt, E * np.pi * radius**4 / 4 * np.diag([1, 1, 2 * G / E]))


def test_a_table_is_interpolated_between_its_kinks():
    robot = rod(TABLE, shear_damping=0.1)
    assert robot.discontinuities.places == (0.37,) and not robot.is_uniform
    for part in (0.0, 0.2, 0.37, 0.8, 1.0):
        found = robot.material(part * L, np.zeros(0))
        values = [TABLE.bending_stiffness, TABLE.bending_stiffness_y, TABLE.torsional_stiffness]
        EI_x, EI_y, GJ = (np.interp(part, TABLE.at, np.asarray(row)) for row in values)
        rhoA = np.interp(part, TABLE.at, TABLE.mass_per_length)
        np.testing.assert_allclose(found.Kbt, np.diag([EI_x, EI_y, GJ]), rtol=1e-14, atol=1e-15)
        np.testing.assert_allclose(found.Kse, np.diag([3e4 / 2.6, 3e4 / 2.6, 3e4]), rtol=1e-14)
        rhoI = rhoA / 3e4 * np.array([EI_x, EI_y, EI_x + EI_y])
        np.testing.assert_allclose(found.rhoJ, np.diag(rhoI), rtol=1e-14, atol=1e-18)
        factors, damping = Observed.of(robot).law_factors(part * L, np.zeros(0))
        np.testing.assert_allclose(factors[3:], [EI_x / 2.0, EI_y / 3.0, GJ / 0.9], rtol=1e-14)
        np.testing.assert_array_equal(damping, 1.0)


# rods


@pytest.mark.parametrize(
    "form", ["rectangular", *(pytest.param(name, marks=pytest.mark.slow) for name in ("elliptic", "hollow"))]
)
def test_a_cantilever_bends_and_twists_about_its_axes(form):
    """F L³/(3EI) + F L/(GA) about each axis, and M L/(GJ); the small wrenches do not act on each other."""
    robot = rod(FORMS[form], loads=(PointWrench(),), nodes=6)
    (EI_x, EI_y), axes = np.linalg.eigh(np.asarray(robot.Kbt)[:2, :2])
    GA, GJ = float(robot.Kse[0, 0]), float(robot.Kbt[2, 2])
    F, M = 1e-6, 1e-6
    along = np.append(axes[:, 1], 0.0)  # bends about the other axis
    across = np.cross([0.0, 0.0, 1.0], along)
    found = held(robot, F * along + 2.0 * F * across, [0.0, 0.0, M])
    tip = found.tip_position[0]
    assert tip @ along == pytest.approx(F * L**3 / (3 * EI_x) + F * L / GA, rel=1e-6)
    assert tip @ across == pytest.approx(2.0 * (F * L**3 / (3 * EI_y) + F * L / GA), rel=1e-6)
    assert 2.0 * found.quaternion[0, -1, 3] == pytest.approx(M * L / GJ, rel=1e-6)


@pytest.mark.slow
def test_a_turned_section_is_as_turned_loads():
    robot = rod(FORMS["rectangular"], loads=(PointWrench(),), nodes=6)
    load, angle = np.array([0.3, 0.2, -0.1]), 1.1
    moment = np.array([0.01, -0.02, 0.03])
    here = held(robot, load, moment)
    there = held(
        robot.replace(**{"cross_section.angle": angle - 0.4}), turn(angle) @ load, turn(angle) @ moment
    )
    assert np.linalg.norm(here.tip_position[0, :2]) > 0.2 * L
    np.testing.assert_allclose(there.position[0], here.position[0] @ turn(angle).T, atol=1e-8)


@pytest.mark.slow
def test_a_batch_of_widths_is_each_by_itself():
    robot = rod(FORMS["rectangular"], loads=(PointWrench(force=(0.3, 0.2, -0.1)),), nodes=6)
    batch = [robot.replace(**{"cross_section.width": width}) for width in (0.006, 0.02)]
    together = kc.equilibrium(batch, np.zeros((2, 0)), space=SPACE)
    for k, one in enumerate(batch):
        alone = kc.equilibrium(one, np.zeros(0), space=SPACE)
        np.testing.assert_allclose(together.position[k], alone.position, atol=1e-9)


@pytest.mark.slow
def test_derivatives_with_respect_to_width_and_height():
    base = rod(FORMS["rectangular"], nodes=6, loads=(PointWrench(force=(0.3, 0.2, 0.0)),))

    def tip(sides):
        change = {"cross_section.width": sides[0], "cross_section.height": sides[1]}
        moved = kc.simulate(base.replace(**change), np.zeros((3, 0)), 0.05, initial="unstressed")
        return jnp.sum(moved.tip_position[-1] * np.array([1.0, 2.0, 3.0]))

    value = jax.jit(jax.value_and_grad(tip))
    sides, step = np.array([W, H]), 1e-4 * np.array([W, H])
    gradient = np.asarray(value(sides)[1])
    expected = [
        (value(sides + step * e)[0] - value(sides - step * e)[0]) / (2.0 * step @ e) for e in np.eye(2)
    ]
    np.testing.assert_allclose(gradient, expected, rtol=1e-5)


@pytest.mark.parametrize("nodes", [(41,), pytest.param((6, 11, 21), marks=pytest.mark.slow)])
def test_a_cone_by_its_end_radii(nodes):
    """F L³ r₀/(3E I₀ r₁) + F L/(G π r₀ r₁), with order 4 in the segments."""
    r0, r1, F = 0.005, 0.002, 1e-5
    I0 = np.pi * r0**4 / 4
    expected = F * L**3 * r0 / (3 * E * I0 * r1) + F * L / (G * np.pi * r0 * r1)
    by_quadrature, _ = quad(
        lambda s: F * (L - s) ** 2 / (E * I0 * (1 + (r1 / r0 - 1) * s / L) ** 4), 0.0, L, epsabs=0.0
    )
    assert expected == pytest.approx(by_quadrature + F * L / (G * np.pi * r0 * r1), rel=1e-12)
    cone = rod(radius=r0, tip_radius=r1, loads=(PointWrench(),))
    errors = [abs(held(cone.replace(nodes=n), [F, 0, 0]).tip_position[0, 0] / expected - 1.0) for n in nodes]
    assert np.all(np.log2(np.divide(errors[:-1], errors[1:])) > 3.5), errors
    assert errors[-1] < 1e-6 * (40 / (nodes[-1] - 1)) ** 4


@pytest.mark.slow
def test_a_table_bends_as_the_integral_of_its_compliance(tmp_path):
    """About both axes, with order 4 although the kink is no node; and a file holds it."""
    F = 1e-4

    def deflection(row):
        def rate(part):
            return F * L**3 * (1 - part) ** 2 / np.interp(part, TABLE.at, row)

        return quad(rate, 0.0, 1.0, points=[0.37], epsabs=0.0)[0] + F * L / (3e4 / 2.6)

    expected = [deflection(TABLE.bending_stiffness_y), deflection(TABLE.bending_stiffness)]
    robot = rod(TABLE, loads=(PointWrench(),))
    kc.save_robot(robot, tmp_path / "table.yaml")
    robot = kc.load_robot(tmp_path / "table.yaml")
    assert robot.cross_section.at == TABLE.at and robot.youngs_modulus is None
    errors = [
        np.abs(held(robot.replace(nodes=nodes), [F, F, 0]).tip_position[0, :2] / expected - 1.0).max()
        for nodes in (6, 11, 21)
    ]
    assert errors[-1] < 1e-6 and np.all(np.log2(np.divide(errors[:-1], errors[1:])) > 3.2), errors


@pytest.mark.slow
def test_a_table_moves_as_stretches_with_the_same_values():
    """Linear stiffness in two stretches."""
    radius = 0.004
    EI, EA, mass = E * np.pi * radius**4 / 4, E * np.pi * radius**2, DENSITY * np.pi * radius**2
    factors = np.array([1.0, 0.7, 0.3])
    table = TabulatedSection(
        at=(0.0, 0.4, 1.0),
        bending_stiffness=EI * factors,
        torsional_stiffness=2 * EI * G / E * factors,
        axial_stiffness=EA * factors,
        shear_stiffness=EA * G / E * factors,
        mass_per_length=[mass],
    )
    stretches = (
        kc.robots.Stretch(end=0.4, stiffness=[1.0, -0.3]),
        kc.robots.Stretch(begin=0.4, stiffness=[0.7, -0.4]),
    )
    falling = {"gravity": [20.0, 0.0, -9.81]}
    tabulated, stretched = rod(table, **falling), rod(radius=radius, sections=stretches, **falling)
    found, expected = (
        kc.simulate(robot, np.zeros((10, 0)), 0.05, initial="unstressed").position
        for robot in (tabulated, stretched)
    )
    # the inertia of a homogeneous section differs, by the radius over the length squared
    np.testing.assert_allclose(found, expected, atol=1e-4 * L)
    assert np.abs(expected[-1] - expected[0]).max() > 0.05 * L


@pytest.mark.slow
def test_frequencies_of_a_strip_about_both_axes():
    strip = rod(RectangularSection(width=0.004, height=0.002), length=1.0, bending_damping=0.0, nodes=21)
    found = kc.statics.modes(kc.equilibrium(strip, np.zeros(0)), count=2)
    EI, mass = np.diag(np.asarray(strip.Kbt))[:2], float(strip.mass_per_length)
    expected = 1.87510407**2 / (2 * np.pi) * np.sqrt(EI / mass)
    np.testing.assert_allclose(found.frequency, expected, rtol=1e-4)
    assert float(strip.bending_frequency) == pytest.approx(expected[0])
    # about x, along y
    assert np.argmax(np.abs(found.shapes[0][-1])) == 1 and np.argmax(np.abs(found.shapes[1][-1])) == 0


@pytest.mark.slow
@pytest.mark.parametrize("angle", [0.0, 0.7])
def test_a_strip_buckles_about_its_weak_axis(angle):
    """At π² EI/(4L²) less the shortening."""
    strip = rod(RectangularSection(width=W, height=H, angle=angle), loads=(PointWrench(),))
    weak = float(np.linalg.eigvalsh(np.asarray(strip.Kbt)[:2, :2])[0])
    critical = np.pi**2 * weak / (4 * L**2)
    kinds = [kc.statics.stability(held(strip, [0, 0, -part * critical])).kind for part in (0.99, 1.01)]
    assert kinds == ["stable", "divergence"]
    s = np.linspace(0.0, L, 11)
    bent = np.stack([0.6 * s * s / L, 0.6 * s * s / L, s], axis=1) @ turn(angle).T
    pressed_down = strip.replace(**{"loads.0.force": [0.0, 0.0, -1.1 * critical]})
    moved = kc.equilibrium(pressed_down, np.zeros(0), initial=bent, space=SPACE)
    tip = turn(angle).T @ moved.tip_position[0]
    assert moved.result[0] == kc.Result.CONVERGED and kc.statics.stability(moved).stable
    assert abs(tip[1]) > 0.4 * L and abs(tip[0]) < 1e-6 * L


@pytest.mark.slow
def test_legs_with_two_axes_hold_a_platform():
    """6 · 12 EI/L³ across each axis."""
    robot = kc.load_robot("six-legged-robot")
    angles, length = np.asarray(robot.base_angles), float(robot.length)
    robot = robot.replace(
        radius=None,
        cross_section=RectangularSection(width=0.002, height=0.001),
        gravity=[0.0, 0.0, 0.0],
        platform_angles=angles,
        platform_radius=robot.base_radius,
        platform_mass=0.1,
    )
    EI = np.diag(np.asarray(robot.strand.Kbt))
    force = 1e-6 * 72.0 * EI[:2].min() / length**2 * np.array([1.0, 1.0, 0.0])
    found = kc.equilibrium(robot.replace(platform_force=force), np.zeros(6), space=SPACE)
    expected = force[:2] * length**3 / (72.0 * EI[[1, 0]]) + force[:2] * length / (
        6 * float(robot.strand.Kse[0, 0])
    )
    # the platform tilts as the legs stretch
    np.testing.assert_allclose(found.tip_position[0, :2], expected, rtol=2e-3)


# other parts and tools with two axes


def test_ribs_soften_each_principal_axis_as_a_beam_column():
    tension, spacing = 20.0, 0.1
    softening = spacing**2 / 12.0

    @jax.jit
    def softened(Kbt):
        robot = rod(
            kind=kc.robots.RoutedTendonRobot,
            radius=0.003,
            bending_stiffness=Kbt,
            tendon_offset=0.01,
            tendon_angles=[0.0],
            rib_spacing=RibSpacing(softening=softening),
        )
        y = robot.rest(0.2)[0]
        return robot.constitutive(0.2, 0.0, y, 0.0 * y, np.array([tension])).strains["u"].softened

    def alone(EI):
        return EI * float(stiffness_under_pressure(3.0 * softening * tension / EI))

    R, K = turn(0.6), np.diag([0.05, 0.2, 0.1])
    np.testing.assert_allclose(softened(K), np.diag([alone(0.05), alone(0.2), 0.1]), rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(softened(R @ K @ R.T), R @ softened(K) @ R.T, rtol=1e-12, atol=1e-14)
    even = np.diag([0.1, 0.1, 0.1])
    np.testing.assert_allclose(softened(even), np.diag([alone(0.1), alone(0.1), 0.1]), rtol=1e-14, atol=1e-15)
    # with the derivative of two axes at equal ones
    slope = jax.jacfwd(lambda x: softened(jnp.asarray(even) + x * np.diag([1.0, 0.0, 0.0])))(0.0)
    expected = (alone(0.1 + 1e-6) - alone(0.1 - 1e-6)) / 2e-6
    np.testing.assert_allclose(slope, np.diag([expected, 0.0, 0.0]), rtol=1e-6, atol=1e-6)


def test_identified_axes_keep_the_stiffness_positive():
    tendons = {"kind": kc.robots.RoutedTendonRobot, "tendon_offset": 0.01}
    even = rod(radius=0.003, **tendons)
    EI, GJ = float(even.Kbt[0, 0]), float(even.Kbt[2, 2])
    found = _with_axes(even, [jnp.asarray(0.3), jnp.asarray(-0.2)]).Kbt
    expected = [[1.3 * EI, -0.2 * EI, 0.0], [-0.2 * EI, 0.7 * EI, 0.0], [0.0, 0.0, GJ]]
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-15)
    strip = rod(FORMS["rectangular"], **tendons)
    np.testing.assert_allclose(_with_axes(strip, [0.0, 0.0]).Kbt, strip.Kbt, rtol=1e-12, atol=1e-15)
    assert np.linalg.eigvalsh(_with_axes(strip, [0.6, 0.6]).Kbt)[0] > 0.0
    table = rod(TABLE, **tendons)
    twice = _with_table(table, [2.0])
    np.testing.assert_allclose(twice.Kbt_at(0.7), 2.0 * table.Kbt_at(0.7))
    effects = [
        {effect.name for effect in library_model(robot, np.full((3, 4), 2.0), [0.5, 1.0]).effects}
        for robot in (strip, table)
    ]
    assert effects[0] - effects[1] == {"stiffness axes"}
    assert {"stiffness", "mass along the rod"} <= effects[1] <= effects[0]


@pytest.mark.slow
def test_a_knode_and_parameters_of_a_strip(tmp_path):
    """Identified from its own motion, and a learned model comes back from its file."""
    robot = rod(STRIP, loads=(DistributedWrench(force=[0.02, 0.05, 0.0]),), nodes=6, bending_damping=1e-4)
    motion = kc.simulate(robot, np.zeros((20, 0)), 0.02, initial="unstressed")
    wrong = robot.replace(**{"cross_section.width": 0.9 * W, "cross_section.height": 1.05 * H})
    found = kc.identify(wrong, [motion], parameters=["cross_section.width", "cross_section.height"])
    section = found.robot.cross_section
    np.testing.assert_allclose([section.width, section.height], [W, H], rtol=1e-4)
    model = kc.KNODE(robot, network(robot, NetworkOptions(hidden=3), jax.random.PRNGKey(0)))
    model.save(tmp_path / "model.knode")
    again = kc.load_model(tmp_path / "model.knode")
    assert kc.simulate(again, np.zeros((2, 0)), 0.02, initial="unstressed").all_valid
    assert again.knowledge.cross_section == robot.cross_section


def test_contact_and_drawings_use_the_outer_radius():
    for form in FORMS.values():
        robot = rod(form, surroundings=(Plane(point=(0.0, 0.0, -1.0)),))
        radius = np.asarray(drawing(robot, np.arange(robot.nodes))["radii"])
        expected = [float(robot.section_at(part).radius) for part in np.linspace(0.0, 1.0, robot.nodes)]
        np.testing.assert_allclose(radius, expected, atol=1e-7)
        assert robot.material(0.5 * L, np.zeros(0)).radius == pytest.approx(
            float(robot.section_at(0.5).radius)
        )


def test_a_summary_has_the_mass_of_the_whole_rod():
    r0, r1 = 0.005, 0.002
    cone = derived(rod(radius=r0, tip_radius=r1))
    expected = DENSITY * np.pi * L * (r0**2 + r0 * r1 + r1**2) / 3
    assert cone["mass"]["value"] == pytest.approx(expected, rel=1e-6)
    table = derived(rod(TABLE))
    mass = 0.5 * L * (0.37 * (0.05 + 0.04) + 0.63 * (0.04 + 0.03))
    assert table["mass"]["value"] == pytest.approx(mass, rel=1e-6) and "G" not in table
    assert parameters(rod(TABLE))["density"]["value"] is None


# files and errors


@pytest.mark.parametrize("form", FORMS)
def test_files_come_back_equal(form):
    more = {"tip_radius": 0.003} if form == "hollow" else {}
    for kind in (kc.robots.SlenderRod, VirtualRobot):
        tendons = {} if kind is kc.robots.SlenderRod else {"tendon_offset": 0.01, "tendon_angles": [0.0]}
        robot = rod(FORMS[form], kind, **tendons, **more)
        text = format_robot(robot)
        again = parse_robot(text, "here")
        assert jax.tree.structure(again) == jax.tree.structure(robot) and format_robot(again) == text
        assert f"kind: {form}" in text
        jsonschema.Draft202012Validator(robot_schema()).validate(mapping_of(text, ""))
