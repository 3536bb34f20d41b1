"""Parameters of parts that identification searches for: each against what it means, computed otherwise."""

import dataclasses

import numpy as np
import pytest
import scipy.optimize
from numpy.testing import assert_allclose

import knode_cosserat as kc
from knode_cosserat.rods.chambers import Chambers, Hyperelastic
from knode_cosserat.rods.parameters import ParameterError
from knode_cosserat.rods.powell import roots
from knode_cosserat.rods.tubes import ConcentricTubeRobot, Tube
from knode_cosserat.solvers.equilibrium import equilibria

THREE = (0.0, 2.094395, 4.18879)
CHAMBERS = Chambers(angles=THREE, offset=0.006, radius=0.003)
ARM = kc.robots.SlenderRod(
    length=0.15, radius=0.01, density=1100.0, youngs_modulus=4e5, effects=(CHAMBERS,), nodes=5
)
TUBES = ConcentricTubeRobot(
    length=0.12,
    nodes=9,
    tubes=tuple(
        Tube(
            radius=r, inner_radius=i, youngs_modulus=6e10, density=6450.0, curvature=k, transmission=d, end=e
        )
        for r, i, k, d, e in ((5e-4, 3e-4, 10.0, 0.1, 1.0), (9e-4, 6e-4, 6.0, 0.06, 0.6))
    ),
)
TURNED = np.array([[0.4, 0.005, -0.8, 0.002], [-1.0, 0.0, 0.3, 0.01]])


def shapes(robot, controls, **how):
    return np.asarray(equilibria(robot, controls, **how).position)


def with_chambers(**changes):
    return ARM.replace(effects=(dataclasses.replace(CHAMBERS, **changes),))


@pytest.mark.slow
def test_an_areas_factor_is_one_of_its_pressure():
    """A chamber of twice the area pushes as under twice the pressure, where the area is constant."""
    twice = with_chambers(area_factors=(2.0, 1.0, 0.5))
    controls = np.array([[1e4, 5e3, 8e3]])
    assert_allclose(shapes(twice, controls), shapes(ARM, controls * [2.0, 1.0, 0.5]), atol=1e-10)
    alike = with_chambers(area_factors=(1.0, 1.0, 1.0), offset_factors=(1.0, 1.0, 1.0))
    assert_allclose(shapes(alike, controls), shapes(ARM, controls), atol=1e-12)


@pytest.mark.slow
def test_one_chambers_offset_is_that_of_all_where_the_others_are_empty():
    further = with_chambers(offset_factors=(1.1, 1.0, 1.0))
    controls = np.array([[1e4, 0.0, 0.0]])
    assert_allclose(shapes(further, controls), shapes(with_chambers(offset=0.0066), controls), atol=1e-10)


@pytest.mark.slow
def test_a_share_of_hyperelasticity_leads_from_hookes_law_to_it():
    """Pulled along the axis, the stretch of the share w solves EA ((1 - w) (λ - 1) + w σ/E) = n."""
    force = 0.5 * float(ARM.Kse[2, 2])
    pulled = ARM.replace(
        gravity=(0.0, 0.0, 0.0),
        density=1.0,
        loads=(kc.robots.loads.PointWrench(force=(0.0, 0.0, force)),),
    )
    for share in (0.0, 0.4, 1.0):
        robot = pulled.replace(effects=(CHAMBERS, Hyperelastic(share=share)))
        stretch = scipy.optimize.brentq(
            lambda at, w=share: (1.0 - w) * (at - 1.0) + w * (at - at**-2) / 3.0 - 0.5, 1.0, 4.0
        )
        tip = shapes(robot, np.zeros((1, 3)))[0, -1, 2]
        assert tip == pytest.approx(stretch * ARM.length, rel=1e-8)


@pytest.mark.slow
def test_zeros_of_actuators_are_added_to_the_controls():
    zeros = {"tubes.0.rotation_zero": 0.1, "tubes.1.rotation_zero": -0.2, "tubes.1.insertion_zero": 0.003}
    moved = TURNED + np.array([0.1, 0.0, -0.2, 0.003])
    assert_allclose(shapes(TUBES.replace(**zeros), TURNED), shapes(TUBES, moved), atol=1e-9)


@pytest.mark.slow
def test_equilibria_found_by_themselves_do_not_depend_on_their_order():
    """In any order, and where the one before is far away, they are those of one by one."""
    controls = np.random.default_rng(0).uniform([-3.0, -0.01, -3.0, -0.01], [3.0, 0.02, 3.0, 0.02], (12, 4))
    found = shapes(TUBES, controls, initial="separate")
    assert_allclose(shapes(TUBES, controls[::-1], initial="separate")[::-1], found, atol=1e-9)
    near = shapes(TUBES, TURNED, initial="separate")
    assert_allclose(near, shapes(TUBES, TURNED), atol=1e-8)
    with pytest.raises(ValueError, match="that is for one robot"):
        equilibria([TUBES, TUBES], np.stack([controls, controls]), initial="separate")


def test_many_roots_are_those_of_minpack():
    """Problems with many solutions: each ends where `scipy.optimize.root` ends from the same start."""
    rng = np.random.default_rng(0)
    A, b = rng.normal(size=(60, 3, 3)), rng.normal(size=(60, 3))

    def every(x):
        return np.einsum("bij,bj->bi", A, np.sin(2.0 * x)) + 0.3 * x**3 - b

    x, found = roots(every, np.zeros((60, 3)))
    for k in range(60):
        one = scipy.optimize.root(lambda x, k=k: A[k] @ np.sin(2.0 * x) + 0.3 * x**3 - b[k], np.zeros(3))
        assert one.success == found[k]
        if one.success:
            assert_allclose(x[k], one.x, atol=1e-6)


def test_factors_of_another_number_are_refused():
    with pytest.raises(ParameterError, match="offset_factors has 2 numbers; allowed is one for each of 3"):
        with_chambers(offset_factors=(1.0, 1.0))
