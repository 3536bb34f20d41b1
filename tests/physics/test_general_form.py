"""The tendon robot's own y_s and z are those of the general form A y_s + B y_st = f1, C z + D z_t = f2."""

import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis.extra.numpy import arrays
from jax.scipy.linalg import block_diag

import knode_cosserat as kc
from knode_cosserat.schemes.semi_discrete import History, Point, derivatives

NUMBERS = st.floats(-1, 1, allow_subnormal=False)


def vectors(size):
    return arrays(float, size, elements=NUMBERS)


@st.composite
def matrices(draw, low, high):
    """Symmetric 3×3 matrices with eigenvalues in this range, which is positive."""
    # any orthogonal matrix is the Q of some other
    Q, _ = np.linalg.qr(np.eye(3) + draw(arrays(float, (3, 3), elements=st.floats(-0.5, 0.5))))
    eigenvalues = draw(arrays(float, 3, elements=st.floats(low, high)))
    matrix = (Q * eigenvalues) @ Q.T
    return (matrix + matrix.T) / 2


@st.composite
def robots(draw):
    return kc.robots.TendonRobot(
        length=draw(st.floats(0.1, 2)),
        radius=draw(st.floats(1e-3, 2e-2)),
        density=draw(st.floats(500, 8000)),
        youngs_modulus=1e9,  # not used: the stiffness is given
        shear_damping=draw(matrices(1e-3, 10.0)),
        bending_damping=draw(matrices(1e-3, 10.0)),
        drag=draw(matrices(1e-4, 1.0)),
        gravity=10 * draw(vectors(3)),
        tendon_angles=7 * draw(vectors(3)),
        shear_stiffness=draw(matrices(1.0, 100.0)),
        bending_stiffness=draw(matrices(0.1, 10.0)),
    )


@st.composite
def points(draw):
    """Arclength, time, y, control and history at one point of the rod."""
    y, z = draw(vectors(19)), draw(vectors(6))
    y[3:7] += 2.0  # quaternions of any length but nearly none
    c0 = draw(st.floats(0, 1000))
    history = History(np.array(c0), c0 * draw(vectors(19)), c0 * z, np.zeros(19))
    return Point(draw(st.floats(0, 1)), draw(st.floats(0, 1)), y, 10 * draw(vectors(3)), history)


class GeneralRobot(kc.robots.TendonRobot):
    """The same robot, by the general form only."""

    def constitutive(self, s, t, y, y_t, control):
        (Kse, Bse, n, *_), (Kbt, Bbt, m, *_) = self.linear_law(s, y, control).strains.values()
        return block_diag(Kse, Kbt), block_diag(Bse, Bbt), jnp.concatenate([n, m])

    def balance(self, s, t, y, y_t, z, z_t, control):
        return jnp.eye(19), jnp.zeros((19, 19)), super().balance(s, t, y, y_t, z, z_t, control)


def general(robot):
    return GeneralRobot(**{name: getattr(robot, name) for name in robot.parameters()}, nodes=robot.nodes)


@jax.jit
def both(robot, point):
    return derivatives(robot, point), derivatives(general(robot), point)


@settings(max_examples=200, deadline=None)
@given(robots(), points())
def test_direct_and_general_derivatives_agree(robot, point):
    (y_s, z), (general_y_s, general_z) = both(robot, point)
    # relative to the largest number: the two sum in different orders. One solves with the inverse by
    # cofactors, whose rounding errors grow with the square of the condition (measured: 9e-18 of it), which
    # counts beyond 100
    c0 = point.history.c0
    stiffness = (
        robot.shear_stiffness + c0 * robot.shear_damping,
        robot.bending_stiffness + c0 * robot.bending_damping,
    )
    rounding = max(1.0, (max(map(np.linalg.cond, stiffness)) / 100.0) ** 2)
    np.testing.assert_allclose(z, general_z, rtol=0, atol=1e-12 * rounding * np.abs(general_z).max())
    np.testing.assert_allclose(y_s, general_y_s, rtol=0, atol=1e-11 * rounding * np.abs(general_y_s).max())


@pytest.mark.campaign
def test_simulations_agree():
    robot = kc.load_robot("delrin-tendon-robot")
    tensions = kc.controls.sine(1.0, 100, 0.05)
    direct, found = (kc.simulate(one, tensions, 0.05) for one in (robot, general(robot)))
    scales = np.asarray(robot.scales().y)
    np.testing.assert_allclose(found.y / scales, direct.y / scales, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.z, direct.z, rtol=0, atol=1e-9)
