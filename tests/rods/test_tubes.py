"""Concentric tubes: closed forms of two tubes, an independent solver of three, bifurcation and snap."""

import itertools

import numpy as np
import pytest
from scipy.integrate import solve_bvp, solve_ivp
from scipy.optimize import fsolve
from scipy.spatial.transform import Rotation

import knode_cosserat as kc
from knode_cosserat.rods.loads import PointWrench
from knode_cosserat.rods.tubes import ConcentricTubeRobot, Tube

L, E, G = 0.2, 6e10, 6e10 / 2.6
NITINOL = {"youngs_modulus": E, "density": 6450.0}
#: radii of three tubes
RADII = np.array([[0.35e-3, 0.2e-3], [0.7e-3, 0.45e-3], [1.1e-3, 0.8e-3]])
MOMENT = np.pi / 4 * (RADII[:, 0] ** 4 - RADII[:, 1] ** 4)
EI, GJ = E * MOMENT, 2 * G * MOMENT


def tube(k, curvature, **more):
    return Tube(radius=RADII[k, 0], inner_radius=RADII[k, 1], curvature=curvature, **NITINOL | more)


def pair(*curvatures, nodes=11, **more):
    tubes = tuple(tube(k, curvature) for k, curvature in enumerate(curvatures))
    return ConcentricTubeRobot(
        **{"length": L, "gravity": (0.0, 0.0, 0.0), "bending_damping": 1e-5, "nodes": nodes, "tubes": tubes}
        | more
    )


def rest(robot, control, **options):
    return kc.equilibrium(robot, control, space="lobatto4", **options)


def twisting(*curvatures):
    """√C of two tubes: their relative angle obeys θ'' = C sin θ."""
    parallel = EI[0] * EI[1] / (EI[0] + EI[1])
    return np.sqrt(curvatures[0] * curvatures[1] * parallel * (1 / GJ[0] + 1 / GJ[1]))


def test_curvatures_in_one_plane_combine_by_stiffness():
    for angle, sign in ((0.0, 1.0), (np.pi, -1.0)):
        u = rest(pair(6.0, 3.0), [0.0, 0.0, angle, 0.0]).part("u")[0, :11]
        expected = (EI[0] * 6.0 + sign * EI[1] * 3.0) / (EI[0] + EI[1])
        np.testing.assert_allclose(u[:5], np.tile([0.0, expected, 0.0], (5, 1)), atol=1e-8)


def test_two_tubes_twist_like_a_pendulum_with_order_four():
    errors = []
    for nodes in (11, 21):  # both tubes end at the tip: the second half of the grid has no length
        angle = rest(pair(6.0, 5.0, nodes=nodes), [0.0, 0.0, 2.5, 0.0]).part("angle")[0]
        exact = solve_bvp(
            lambda s, y: np.stack([y[1], twisting(6.0, 5.0) ** 2 * np.sin(y[0])]),
            lambda a, b: np.array([a[0] - 2.5, b[1]]),
            np.linspace(0.0, L, 50),
            np.stack([np.full(50, 2.5), np.zeros(50)]),
            tol=1e-11,
        ).sol(np.linspace(0.0, L, nodes // 2 + 1))[0]
        errors.append(np.abs(np.diff(angle, axis=1)[: nodes // 2 + 1, 0] - exact).max())
    assert errors[1] < 1e-6
    assert np.log2(errors[0] / errors[1]) == pytest.approx(4.0, abs=0.3)


@pytest.mark.slow
def test_opposed_tubes_are_unstable_beyond_the_known_product():
    """Opposite tubes bifurcate where √C L = π/2 (Dupont et al. 2010; Rucker et al. 2010)."""
    critical = np.pi / 2 / (L * twisting(1.0, 1.0))
    opposed = [0.0, 0.0, np.pi, 0.0]
    straight = rest(pair(0.99 * critical, 0.99 * critical, nodes=21), opposed)
    found = kc.statics.stability(straight)
    assert found.kind == "stable" and found.eigenvalue.real < 0.0
    assert np.isnan(found.least) and "the energy is not of poses alone" in repr(found)
    beyond = rest(pair(1.01 * critical, 1.01 * critical, nodes=21), opposed, initial=straight)
    if np.ptp(np.diff(beyond.part("angle")[0], axis=1)) < 1e-6:  # still the straight branch
        assert kc.statics.stability(beyond).kind == "divergence"
    else:
        assert kc.statics.stability(beyond).kind == "stable"


THREE = {"curved": (0.1, 0.12, 0.1), "curvature": (12.0, 8.0, 4.0), "end": (1.0, 0.7, 0.4)}
FORCE, LONG, BEHIND = np.array([0.05, -0.1, 0.05]), 0.3, 0.1


def three(**more):
    tubes = tuple(
        tube(k, THREE["curvature"][k], curved=THREE["curved"][k], end=THREE["end"][k], transmission=BEHIND)
        for k in range(3)
    )
    load = PointWrench(force=FORCE)
    return pair(**{"length": LONG, "tubes": tubes, "nodes": 25, "loads": (load,)} | more)


def by_shooting(control):
    """Return the tip by the equations of Rucker et al. (2010), inextensible tubes, by shooting."""
    base = np.zeros(5)
    for part in (0.25, 0.5, 0.75, 1.0):  # each from the one before: far controls have several solutions
        base, tip = shooting(part * np.asarray(control), base)
    return tip


def shooting(control, base):
    rotation, insertion = control[::2], control[1::2]
    ends = LONG * np.array(THREE["end"]) + insertion
    begins = np.maximum(ends - THREE["curved"], 0.0)
    bounds = np.unique([0.0, *begins, *ends])

    def shot(base):
        torsion = np.array([base[2] - base[3:].sum(), *base[3:]])
        angle = rotation + (BEHIND - insertion) * torsion / GJ
        y = np.concatenate([np.zeros(3), [0, 0, 0, 1], base[:3], angle, base[3:]])
        for low, high in itertools.pairwise(bounds):
            there = (low + high) / 2 < ends
            curvature = np.array(THREE["curvature"]) * ((low + high) / 2 > begins) * there

            def rates(s, y, there=there, curvature=curvature):
                h, angle, torsion = y[3:7], y[10:13], y[13:]
                R = Rotation.from_quat(h).as_matrix()
                m = R.T @ y[7:10]
                x, z = -curvature * np.sin(angle), curvature * np.cos(angle)
                u = np.append((m[:2] + np.array([EI @ x, EI @ z])) / (EI @ there), 0.0)
                turned = 0.5 * np.append(h[3] * u + np.cross(h[:3], u), -h[:3] @ u)
                torque = there * EI * (u[0] * z - u[1] * x)
                twist = there * np.array([m[2] - torsion.sum(), *torsion]) / GJ
                return np.concatenate([R[:, 2], turned, -np.cross(R[:, 2], FORCE), twist, torque[1:]])

            y = solve_ivp(rates, (low, high), y, rtol=1e-10, atol=1e-12).y[:, -1]
        return y

    def unbalanced(x):
        y = shot(x)
        return 100 * np.concatenate([y[7:10], y[13:]])

    base = fsolve(unbalanced, base, xtol=1e-12)
    assert np.abs(unbalanced(base)).max() < 1e-6
    return base, shot(base)[:3]


@pytest.mark.slow
@pytest.mark.parametrize(
    "control", [[0.0] * 6, [1.0, -0.05, -0.5, 0.03, 1.3, -0.06], [1.0, -0.15, -0.5, 0.03, 1.0, -0.12]]
)
def test_three_tubes_under_a_force_reach_the_tip_of_an_independent_solver(control):
    found = rest(three(), control).tip_position[0]
    np.testing.assert_allclose(found, by_shooting(control), atol=1e-5 * LONG)


@pytest.mark.slow
def test_turned_past_their_limit_tubes_snap_and_come_back_another_way():
    robot = pair(10.0, 10.0, nodes=17, tube_friction=1e-5)
    angle = np.linspace(0.0, 2 * np.pi, 200)[:, None] * np.array([0.0, 0.0, 1.0, 0.0])

    def turned(rotations):
        start = rest(robot, rotations[0])
        return kc.simulate(robot, rotations, 0.02, initial=start)

    there, back = turned(angle), turned(angle[::-1])
    assert there.all_valid and back.all_valid
    relative = [np.diff(motion.part("angle")[1:, -1], axis=1)[:, 0] for motion in (there, back)]
    assert np.max(np.abs(np.diff(relative[0]))) > 0.5
    # half-way both lag behind: hysteresis
    assert relative[1][100] - relative[0][100] > 1.0
    np.testing.assert_allclose(relative[0][-1], 2 * np.pi, atol=0.1)


def test_the_tip_has_exact_derivatives_by_every_control():
    robot = three()
    control = np.array([1.0, -0.05, -0.5, 0.03, 1.3, -0.06])
    slopes = kc.statics.configuration(robot, control).jacobian[:3]
    for k, step in enumerate([1e-4, 1e-5] * 3):
        ends = [
            kc.equilibrium(robot, control + sign * step * np.eye(6)[k]).tip_position[0] for sign in (1, -1)
        ]
        np.testing.assert_allclose(
            slopes[:, k], (ends[0] - ends[1]) / (2 * step), atol=2e-4 * np.abs(slopes).max()
        )


@pytest.mark.slow
def test_a_residual_finds_the_stiffness_of_one_tube():
    truth = kc.load_robot("three-tube-robot").replace(nodes=13)
    wrong = truth.replace(**{"tubes.1.youngs_modulus": 100e9})
    time = 0.05 * np.arange(1, 25)[:, None]
    seen, unseen = (
        np.array([0.6, 0.01, 0.5, 0.01, 0.4, 0.01]) * np.sin(2 * np.pi * time / period + np.arange(6))
        for period in (1.0, 1.6)
    )
    model = kc.fit(wrong, [kc.simulate(truth, seen, 0.05, space="lobatto2")])
    stiffer = np.asarray(truth.cross_section.EI - wrong.cross_section.EI)[1]
    softer = np.asarray(1.0 / truth.cross_section.GJ - 1.0 / wrong.cross_section.GJ)[1]
    terms = {(term.part, term.target, term.function): term.coefficient for term in kc.learning.explain(model)}
    for target, function in (("u_x", "bent_3"), ("u_y", "bent_4")):
        assert terms["stress", target, function] == pytest.approx(stiffer, rel=1e-5)
    assert terms["load", "torsion_1", "torque_y"] == pytest.approx(stiffer, rel=1e-5)
    assert terms["load", "angle_y", "twisting_y"] == pytest.approx(softer, rel=1e-5)
    assert terms["base", "angle_y", "straight_y"] == pytest.approx(softer, rel=1e-5)
    ends = [
        kc.simulate(robot, unseen, 0.05, space="lobatto2").tip_position for robot in (truth, wrong, model)
    ]
    assert np.max(np.abs(ends[1] - ends[0])) > 1e-3
    np.testing.assert_allclose(ends[2], ends[0], atol=1e-7)


def test_the_controls_are_named_by_their_tubes():
    robot = kc.load_robot("three-tube-robot")
    assert robot.control_layout.names[:3] == ("rotation_1", "insertion_1", "rotation_2")


def test_an_insertion_past_its_end_stops_with_one_line():
    with pytest.raises(ValueError, match=r"insertion_2 is 0.2 m .*; allowed is below 0.1") as error:
        kc.equilibrium(three(), [0.0, 0.0, 0.0, 0.2, 0.0, 0.0])
    assert "\n" not in str(error.value)


def straight(ends, moment, drawn=0.0, **more):
    """Straight tubes under a torque, the innermost drawn back: torsion and angles at the plate."""
    tubes = tuple(tube(k, 0.0, end=end, transmission=BEHIND) for k, end in enumerate(ends))
    loads = more.pop("loads", (PointWrench(moment=(0.0, 0.0, moment)),))
    control = [0.0, -drawn, *[0.0] * (2 * len(ends) - 2)]
    found = rest(pair(tubes=tubes, loads=loads, nodes=4 * 2 * len(ends) + 1, **more), control)
    torsion = found.part("torsion")[0] if len(ends) > 1 else None
    return torsion, found.part("angle")[0]


@pytest.mark.parametrize(
    ("ends", "drawn", "carries"),
    [
        ((1.0, 1.0), 0.0, 0),  # by convention the innermost of those that reach the tip
        ((1.0, 1.0), 0.1, 1),
        ((0.5, 1.0), 0.0, 1),
        ((1.0, 0.5), 0.05, 0),
        ((1.0, 0.4, 1.0), 0.1, 2),
        ((0.3, 1.0, 0.7), 0.0, 1),
    ],
)
def test_a_torque_at_the_tip_is_carried_by_the_innermost_tube_there(ends, drawn, carries):
    M = 1e-3
    torsion, angle = straight(ends, M, drawn)
    expected = np.zeros(len(ends))
    behind = BEHIND + (drawn if carries == 0 else 0.0)
    expected[carries] = behind * M / GJ[carries]
    np.testing.assert_allclose(angle[0], expected, atol=1e-9)
    own = np.where(np.arange(1, len(ends)) == carries, M, 0.0)
    np.testing.assert_allclose(torsion, np.tile(own, (len(torsion), 1)), atol=1e-12)
    long = ends[carries] * L - (drawn if carries == 0 else 0.0)
    np.testing.assert_allclose(
        angle[-1, carries] - angle[0, carries], long * M / GJ[carries], rtol=1e-7, atol=1e-9
    )


def test_a_torque_along_the_rod_is_carried_by_the_innermost_tube_at_each_place():
    m, end = 5e-3, 0.4
    load = kc.robots.loads.DistributedWrench(moment=(0.0, 0.0, m))
    torsion, angle = straight((end, 1.0), 0.0, loads=(load,))
    beyond = m * (1.0 - end) * L
    np.testing.assert_allclose(torsion[0], beyond, rtol=1e-6)
    np.testing.assert_allclose(
        angle[0], BEHIND * np.array([m * end * L, beyond]) / np.array(GJ[:2]), rtol=1e-6
    )


def test_a_soft_inner_tube_that_ends_early_changes_nothing_under_a_torque():
    load = (PointWrench(moment=(0.0, 0.0, 2e-3)),)
    outer, soft = tube(1, 5.0, transmission=BEHIND), tube(0, 0.0, end=0.02, youngs_modulus=1e4)
    found = [
        rest(pair(tubes=tubes, loads=load, nodes=33), [0.0] * (2 * len(tubes))).tip_position[0]
        for tubes in ((outer,), (soft, outer))
    ]
    np.testing.assert_allclose(found[1], found[0], atol=1e-6 * L)
    # out of plane by the torque
    assert np.min(np.abs(found[0])) > 1e-3 * L


@pytest.mark.parametrize("count", [1, 2, 3])
def test_the_default_grid_has_four_segments_for_each_interval(count):
    tubes = tuple(tube(k, 5.0, curved=0.05, end=1.0 - 0.2 * k) for k in range(count))
    robot = ConcentricTubeRobot(length=L, tubes=tubes, bending_damping=1e-5)
    assert robot.nodes == 8 * count + 1
    assert ConcentricTubeRobot(length=L, tubes=tubes, bending_damping=1e-5, nodes=9).nodes == 9
    control = [0.3 * k for k in range(2 * count)]
    control[1::2] = [0.0] * count
    coarse, fine = (rest(each, control) for each in (robot, robot.replace(nodes=16 * count + 1)))
    np.testing.assert_allclose(coarse.tip_position, fine.tip_position, atol=1e-4 * L)
