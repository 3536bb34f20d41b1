"""Sections that differ along the rod, and by control."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp

import knode_cosserat as kc
from knode_cosserat.robots import loads
from knode_cosserat.robots import section as sections
from knode_cosserat.rotation import rotation_matrix

L, RADIUS, E = 0.4, 0.006, 1e7
EI, GA = E * np.pi * RADIUS**4 / 4, E / 2.6 * np.pi * RADIUS**2
CHANGED = kc.robots.SlenderRod(
    length=L, radius=RADIUS, density=1000.0, youngs_modulus=E, gravity=[0.0, 0.0, 0.0], nodes=11,
    bending_damping=1e-4,
    sections=(
        kc.robots.Stretch(
            end=0.47, radius=[1.0, 0.0], stiffness=[1.0, 0.0], controlled=True,
            stiffness_gain=0.0, curvature_gain=[0.0, 0.0, 0.0],
        ),
        kc.robots.Stretch(
            begin=0.47, radius=[1.0, 0.0], stiffness=[1.0, 0.0], controlled=True,
            stiffness_gain=0.0, curvature_gain=[0.0, 0.0, 0.0],
        ),
    ),
    loads=(loads.PointWrench(at=1.0),),
)  # fmt: skip


def changed(both=None, nodes=11, force=(0.0, 0.0, 0.0), **each):
    values = {f"sections.{k}.{name}": value for k in (0, 1) for name, value in (both or {}).items()}
    values |= {f"sections.{key[-1]}.{key[:-2]}": value for key, value in each.items()}
    return CHANGED.replace(nodes=nodes, **values, **{"loads.0.force": np.asarray(force)})


def rest(robot, control=(0.0, 0.0)):
    return kc.equilibrium(robot, np.asarray(control, dtype=float), space="lobatto4")


@pytest.mark.campaign
def test_a_rod_curved_at_rest_closes_to_a_ring():
    ring = changed({"curvature": [0.0, 2 * np.pi / L, 0.0]})
    found = rest(ring)
    np.testing.assert_allclose(found.tip_position[0], 0.0, atol=5e-4 * L)
    np.testing.assert_allclose(np.abs(found.quaternion[0, -1]), [1, 0, 0, 0], atol=1e-3)
    for name in "nm":
        np.testing.assert_allclose(found.part(name), 0.0, atol=1e-8 * EI)


@pytest.mark.campaign
def test_it_closes_with_order_four():
    gaps = [
        np.linalg.norm(rest(changed({"curvature": [0.0, 2 * np.pi / L, 0.0]}, nodes)).tip_position[0])
        for nodes in (21, 41, 81)
    ]
    assert np.all(np.log2(np.divide(gaps[:-1], gaps[1:])) > 3.5), gaps


@pytest.mark.campaign
def test_a_cone_bends_as_the_integral_of_its_stiffness():
    """Half as thick at its tip, in two stretches that meet."""
    F = 1e-3 * EI / L**2
    cone = changed(radius_0=[1.0, -0.235], radius_1=[0.765, -0.265], force=[F, 0.0, 0.0])

    def rate(s):
        factor = 1.0 - 0.5 * s / L
        return F * (L - s) ** 2 / (EI * factor**4) + F / (GA * factor**2)

    expected, _ = quad(rate, 0.0, L, epsabs=1e-14)
    # of order 4 on ten segments, and of the beam's small angles
    assert rest(cone).tip_position[0, 0] == pytest.approx(expected, rel=2e-5)


@pytest.mark.slow
def test_stiffness_along_the_rod_and_by_control():
    M = 0.5 * EI / L
    robot = changed({"stiffness_gain": 0.5}, stiffness_0=[2.0, 0.0], stiffness_1=[3.0, 2.0])
    robot = robot.replace(**{"loads.0.moment": [0.0, M, 0.0]})
    u = np.asarray(rest(robot, [0.4, -0.2]).part("u"))[0, :, 1]
    s = np.arange(11) / 10
    along = np.where(s < 0.47, 2.0 * 1.2, (3.0 + 2.0 * (s - 0.47) / 0.53) * 0.9)
    np.testing.assert_allclose(u, M / EI / along, rtol=1e-8)


def arc(curvature, length):
    """In the plane: displacement across and along, and the turn, of an arc."""
    turn = curvature * length
    return np.array([(1 - np.cos(turn)), np.sin(turn)]) / curvature, turn


#: of a rod curved at rest: at its base and at its tip, in two stretches that do not meet in one value
BENT = {0: ([1.0, 6.0, -2.0], [3.0, 5.0, -1.5]), 1: ([-4.0, 3.0, 5.0], [-4.5, 5.0, 6.5])}


def resting(*stretches, cut, nodes=11):
    """Curved at rest, each stretch from its first curvature to its second."""
    (a, b), (c, d) = (np.asarray(each) for each in stretches)
    return kc.robots.SlenderRod(
        length=L,
        radius=RADIUS,
        density=1000.0,
        youngs_modulus=E,
        gravity=[0.0, 0.0, 0.0],
        nodes=nodes,
        bending_damping=1e-3,
        sections=(
            kc.robots.Stretch(end=cut, curvature=a, curvature_slope=b - a),
            kc.robots.Stretch(begin=cut, curvature=c, curvature_slope=d - c),
        ),
    )


def frames(stretches, cut):
    """p and R at the tip, by a general solver of differential equations, stretch by stretch."""
    pose = np.concatenate([np.zeros(3), np.eye(3).ravel()])
    for (one, other), (low, high) in zip(stretches, ((0.0, cut), (cut, 1.0)), strict=True):
        first, more = np.asarray(one), np.subtract(other, one)

        def rate(s, pose, first=first, more=more, low=low, high=high):
            u, R = first + more * (s / L - low) / (high - low), pose[3:].reshape(3, 3)
            # row by row: R û, where û takes a to u × a
            return np.concatenate([R[:, 2], -np.cross(u, R).ravel()])

        found = solve_ivp(rate, (low * L, high * L), pose, method="DOP853", rtol=1e-13, atol=1e-15)
        pose = found.y[:, -1]
    return pose[:3], pose[3:].reshape(3, 3)


@pytest.mark.parametrize("cut", [0.37, 0.5])
def test_a_rod_rests_as_its_curvature_has_it(cut, monkeypatch):
    position, R = frames(BENT.values(), cut)
    robot, errors = resting(*BENT.values(), cut=cut), []
    for steps in (sections.REST_STEPS // 2, sections.REST_STEPS):
        monkeypatch.setattr(sections, "REST_STEPS", steps)
        # a new function each time: REST_STEPS is a constant of the compiled program
        y, _ = jax.jit(lambda s: robot.rest(s))(jnp.asarray(L))
        turned = np.abs(np.asarray(rotation_matrix(y[3:7])) - R).max()
        errors.append([np.abs(np.asarray(y[:3]) - position).max() / L, turned])
    assert np.max(errors[-1]) < 2e-8
    assert np.all(np.log2(np.divide(*errors)) > 3.8)


@pytest.mark.parametrize("cut", [1e-6, 0.3, 0.37, 0.5, 0.5 + 1e-12, 0.93])
def test_a_circle_is_exact_wherever_it_is_cut(cut):
    circle = [0.0, 2 * np.pi / L, 0.0]
    robot = resting((circle, circle), (circle, circle), cut=cut)
    s = np.linspace(0.0, L, 11)
    y, z = jax.vmap(robot.rest)(s)
    along = (arc(circle[1], each)[0] for each in s)
    np.testing.assert_allclose(y[:, [0, 2]], np.stack(list(along)), atol=1e-12 * L)
    half = np.pi * s / L
    np.testing.assert_allclose(y[:, [3, 5]], np.stack([np.cos(half), np.sin(half)], axis=1), atol=1e-12)
    np.testing.assert_allclose(y[:, [1, 4, 6]], 0.0, atol=1e-12)
    # on a cut too, where both stretches are
    np.testing.assert_allclose(z[:, 3:], np.tile(circle, (11, 1)), rtol=1e-12)


@pytest.mark.parametrize("slopes", [jax.jacfwd, jax.jacrev])
def test_slopes_of_an_arc_at_rest(slopes):
    """By its curvature and its length, of a straight one too."""

    def tip(curvature, length):
        robot = resting(*[[[0.0, 1.0, 0.0]] * 2] * 2, cut=0.37)
        bent = {f"sections.{k}.curvature": jnp.stack([0.0, curvature, 0.0]) for k in (0, 1)}
        return robot.replace(length=length, **bent).rest(length)[0][jnp.array([0, 2])]

    def closed(k, length):
        if k.real == 0.0:  # the first terms of it
            return np.array([k * length**2 / 2, length - k**2 * length**3 / 6])
        return np.array([1 - np.cos(k * length), np.sin(k * length)]) / k

    h, found = 1e-30, jax.jit(slopes(tip, argnums=(0, 1)))
    for k in (0.0, 1.5, 15.0):
        expected = [closed(k + 1j * h, L).imag / h, closed(k, L + 1j * h).imag / h]
        np.testing.assert_allclose(found(k, L), expected, atol=1e-12)


@pytest.mark.campaign
def test_a_rod_curved_at_rest_stays_so():
    """Also where a cut is on a node; it moves once, by the error of order 4 on ten segments along its arc."""
    bend = [0.0, 6.0, 0.0]
    robot = resting((bend, bend), (bend, bend), cut=0.5)
    moved = kc.simulate(robot, np.zeros((6, 0)), 0.02, space="lobatto4", initial="unstressed")
    position = np.asarray(moved.position)
    np.testing.assert_allclose(position[1:], position[:1].repeat(6, axis=0), atol=1e-5 * L)
    np.testing.assert_allclose(position[2:], position[1:2].repeat(5, axis=0), atol=1e-12 * L)
    np.testing.assert_allclose(moved.part("m"), 0.0, atol=1e-12 * EI / L)


@pytest.mark.parametrize("control", [(1.0, 1.0), (1.0, -0.5), (-0.3, 0.8)])
def test_a_robot_of_controlled_curvature_bends_to_arcs(control):
    robot = changed({"curvature_gain": [0.0, 6.0, 0.0]})
    found = rest(robot, control)
    (one, turn), (other, more) = (
        arc(6.0 * c, part * L) for c, part in zip(control, (0.47, 0.53), strict=True)
    )
    turned = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    expected = one + turned @ other
    np.testing.assert_allclose(found.tip_position[0, [0, 2]], expected, atol=1e-5 * L)
    h = found.quaternion[0, -1]
    assert 2 * np.arctan2(h[2], h[0]) == pytest.approx(turn + more, abs=1e-5)


def test_one_stretch_is_two():
    """A function over all of the rod is the polynomials in its two parts."""

    def function(part, control):
        return kc.robots.section.Differences(
            radius=1.0 - 0.3 * part, curvature=np.array([1.0, 0.0, 2.0]) * control[0]
        )

    whole = dataclasses.replace(
        CHANGED, sections=(kc.robots.section.FunctionSection(function=function, inputs=1),)
    )
    parts = changed({"curvature_gain": [1.0, 0.0, 2.0]}, radius_0=[1.0, -0.141], radius_1=[0.859, -0.159])
    for name in ("Kse", "Kbt", "u_star", "rhoA", "rhoJ", "radius"):
        for s in (0.0, 0.1, 0.3, 0.4):
            np.testing.assert_allclose(
                getattr(whole.material(s, np.array([0.7])), name),
                getattr(parts.material(s, np.array([0.7, 0.7])), name),
                rtol=1e-12,
                atol=1e-14,
            )


@pytest.mark.campaign
def test_the_catalogs_robot_of_controlled_curvature():
    robot = kc.load_robot("variable-curvature-robot").replace(gravity=[0.0, 0.0, 0.0])
    assert len(robot.sections) == robot.control_layout.size == 3
    control = np.array([0.5, -0.3, 0.8])
    u = np.asarray(kc.equilibrium(robot, control).part("u"))[0]
    s = np.linspace(0.0, 1.0, robot.nodes)
    for section, c in zip(robot.sections, control, strict=True):
        inside = (s > section.begin + 1e-9) & (s < section.end - 1e-9)
        assert inside.any()
        expected = c * np.asarray(section.curvature_gain)
        np.testing.assert_allclose(u[inside], np.tile(expected, (inside.sum(), 1)), atol=1e-7)
        assert np.linalg.norm(expected) > 0.5


@pytest.mark.campaign
def test_derivatives_with_respect_to_a_section_and_its_control():
    control = np.stack([np.sin(np.arange(20) / 4.0), np.cos(np.arange(20) / 5.0)], axis=1)

    def tip(gain, scale):
        robot = CHANGED.replace(
            **{
                "sections.0.curvature_gain": gain,
                "sections.1.stiffness_gain": 0.3,
                "gravity": [1.0, 2.0, -9.0],
            }
        )
        return kc.simulate(robot, scale * control, 0.02).position[-1, -1, 0]

    at, along = (np.array([1.0, 3.0, 0.2]), 0.8), (np.array([0.4, -0.3, 0.6]), 0.5)
    slope = float(jax.jvp(tip, at, along)[1])
    gradient = jax.grad(tip, argnums=(0, 1))(*at)
    h = 1e-3
    steps = [float(tip(*(a + k * h * d for a, d in zip(at, along, strict=True)))) for k in (-2, -1, 1, 2)]
    expected = (steps[0] - 8 * steps[1] + 8 * steps[2] - steps[3]) / (12 * h)
    assert slope == pytest.approx(expected, rel=1e-5)
    assert np.sum(gradient[0] * along[0]) + gradient[1] * along[1] == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"stiffness": [-1.0]}, "stiffness is .* which is -1 at ξ = 0"),
        ({"stiffness": [1.0, -2.0]}, "stiffness is .* which is -1 at ξ = 1"),
        ({"radius": [1.0, -4.0, 4.0]}, "radius is .* which is 0 at ξ = 0.5"),
        ({"radius": [0.0]}, "radius"),
    ],
)
def test_nothing_is_left_of_no_section(given, said):
    with pytest.raises(ValueError, match=said):
        kc.robots.Stretch(**given)
    kc.robots.Stretch(radius=[1.0, -3.9, 4.0])


@pytest.mark.slow
@pytest.mark.parametrize("gain", [0.2, -0.2])
def test_a_control_leaves_some_stiffness(gain):
    rod = kc.robots.SlenderRod(
        length=L,
        radius=RADIUS,
        density=1000.0,
        youngs_modulus=E,
        sections=(kc.robots.Stretch(controlled=True, stiffness_gain=gain),),
    )
    limit = -1.0 / gain
    assert kc.equilibrium(rod, np.array([0.9 * limit])).all_valid
    for beyond in (limit, 1.2 * limit):
        for ask in (
            kc.equilibrium,
            kc.statics.configuration,
            lambda rod, control: kc.workspace(rod, control[None]),
        ):
            with pytest.raises(ValueError, match=r"section0_input is .* allowed is (above|below)"):
                ask(rod, np.array([beyond]))
    stepper = kc.solvers.Stepper(rod, 0.02)
    with pytest.raises(ValueError, match="section0_input"):
        stepper.step(np.array([1.2 * limit]))


def segment(**changes):
    """A segment with three parameters: two curvatures and its extension."""
    gains = [
        {"curvature_gain": [1.0, 0.0, 0.0]},
        {"curvature_gain": [0.0, 1.0, 0.0]},
        {"extension_gain": 1.0},
    ]
    parts = tuple(kc.robots.Stretch(controlled=True, **gain) for gain in gains)
    return CHANGED.replace(sections=parts, loads=(), nodes=21, **changes)


def test_an_extended_segment_is_an_arc_of_its_own_length():
    x, y, extension = 3.0, -4.0, 0.25
    found = rest(segment(), (x, y, extension))
    bent = np.hypot(x, y)
    radius, angle = (1.0 + extension) / bent, bent * L
    across = radius * (1.0 - np.cos(angle))
    expected = [across * y / bent, -across * x / bent, radius * np.sin(angle)]
    np.testing.assert_allclose(found.tip_position[0], expected, atol=1e-7)
    np.testing.assert_allclose(found.part("n"), 0.0, atol=1e-7 * EI)
    # made so: at rest without a control
    made = segment().replace(
        **{
            "sections.0.curvature": [x, 0.0, 0.0],
            "sections.1.curvature": [0.0, y, 0.0],
            "sections.2.extension": extension,
        }
    )
    still, strains = made.rest(L)
    np.testing.assert_allclose(still[:3], expected, atol=1e-9)
    np.testing.assert_allclose(strains, [0.0, 0.0, 1.0 + extension, x, y, 0.0], atol=1e-12)
    assert made.control_layout.fields[2].low == pytest.approx(-1.25)


def test_an_extended_cantilever_vibrates_at_its_lower_frequency():
    """Mass ρA/(1+ε) and stiffness EI (1+ε) per present length: ω (1+ε) is constant."""
    thin = segment(radius=1e-3, bending_damping=1e-7)
    short, long = (
        np.abs(kc.statics.modes(rest(thin, (0.0, 0.0, extension)), count=1).values[0])
        for extension in (0.0, 0.3)
    )
    assert short / long == pytest.approx(1.3, rel=1e-4)
