"""The rod that creeps: elastic at rest, stiffer in fast motion, a slender rod without its branch."""

import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.robots import Relaxation
from knode_cosserat.schemes import semi_discrete
from knode_cosserat.schemes.semi_discrete import History, Point

BODY = {
    "length": 0.1, "radius": 0.015, "density": 1070.0, "youngs_modulus": 2.6e5, "nodes": 6,
    "bending_damping": 1e-4, "loads": kc.robots.loads.PointWrench(force=(1.0, 0.0, 0.0), controlled=True),
    "gravity": (0.0, 0.0, 0.0),
}  # fmt: skip


def relaxing(stiffness, time=1.0, **body):
    return kc.robots.SlenderRod(**{**BODY, **body}, effects=(Relaxation(stiffness, time, shear=True),))


def bent(rod, force=0.05):
    return kc.equilibrium(rod, [force]).tip_position[0, 0]


@pytest.mark.slow
def test_at_rest_it_is_elastic():
    elastic = bent(kc.robots.SlenderRod(**BODY))
    assert bent(relaxing(2.0)) == pytest.approx(elastic, rel=1e-9)


@pytest.mark.slow
def test_without_its_branch_it_is_a_slender_rod():
    control = np.full((20, 1), 0.05)
    plain = kc.simulate(kc.robots.SlenderRod(**BODY), control, 5e-3)
    rod = kc.simulate(relaxing(0.0), control, 5e-3)
    np.testing.assert_allclose(rod.tip_position, plain.tip_position, atol=1e-9)


@pytest.mark.slow
def test_under_a_lasting_force_it_creeps_from_the_stiff_shape_to_that_at_rest():
    rod = relaxing(1.0, 5.0)
    stiff = bent(kc.robots.SlenderRod(**{**BODY, "youngs_modulus": 2 * BODY["youngs_modulus"]}))
    # the vibration has died out after a second; the branch is a fifth of the way
    x = kc.simulate(rod, np.full((2000, 1), 0.05), 0.02).tip_position[:, 0]
    assert stiff < x[50] < 1.2 * stiff
    # creep of a standard linear solid: retardation time (1 + r) T
    expected = bent(rod) * (1.0 - 0.5 * np.exp(-np.array([2.0, 10.0, 40.0]) / 10.0))
    np.testing.assert_allclose(x[[100, 500, 2000]], expected, rtol=0.01)


def test_its_strains_satisfy_the_law_with_its_branch():
    rod = relaxing(0.7, 0.3, shear_damping=0.2)
    rng = np.random.default_rng(0)
    y = np.asarray(rod.rest(0.05)[0]) + 0.01 * rng.normal(size=19)
    history = History(100.0, rng.normal(size=19), rng.normal(size=12), np.zeros(19))
    z = semi_discrete.strains(rod, Point(0.05, 0.0, y, np.zeros(1), history))
    values, rates = (
        dict(zip(rod.z_layout.names, rod.z_layout.split(x), strict=True)) for x in (z, history.z_t(z))
    )
    for name, law in rod.constitutive(0.05, 0.0, y, np.zeros(19), np.zeros(1)).strains.items():
        inner = values[f"{name}_branch"]
        stress = law.stiffness @ values[name] + law.damping @ rates[name]
        stress = stress + 0.7 * law.stiffness @ (values[name] - inner)
        np.testing.assert_allclose(stress, law.stress, atol=1e-8 * np.abs(law.stress).max())
        np.testing.assert_allclose(0.3 * rates[f"{name}_branch"], values[name] - inner, atol=1e-9)


@pytest.mark.campaign
def test_relaxation_of_a_tendon_robot_is_that_of_the_rod():
    """A robot whose tendons pull with nothing moves under its weight as a rod of the same material."""
    body = {name: value for name, value in BODY.items() if name != "loads"} | {"gravity": (9.81, 0.0, 0.0)}
    stiff = 1e9 * np.eye(3)
    rod = relaxing(1.5, 0.2, gravity=body["gravity"], loads=(), shear_stiffness=stiff)
    robot = kc.robots.RoutedTendonRobot(
        **body, shear_stiffness=stiff, tendon_offset=0.01, relaxation=Relaxation(stiffness=1.5, time=0.2)
    )
    none, slack = np.zeros((40, 0)), np.zeros((40, 4))
    expected = kc.simulate(rod, none, 0.01, initial=kc.equilibrium(rod.replace(gravity=(0.0, 0.0, 0.0)), []))
    found = kc.simulate(
        robot, slack, 0.01, initial=kc.equilibrium(robot.replace(gravity=(0.0, 0.0, 0.0)), np.zeros(4))
    )
    assert np.ptp(expected.tip_position[:, 0]) > 5e-3
    np.testing.assert_allclose(found.tip_position, expected.tip_position, atol=1e-7)
