"""A law of the material in one file, known nowhere else."""

from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial

import knode_cosserat as kc
from knode_cosserat.robots import Effect, parameter


def cubic_moment(k, u, u_t):
    """Return k |u|² u."""
    return k * jnp.sum(u * u) * u


class Stiffening(Effect):
    """Bending and twisting that stiffen: the moment k |u|² u of the curvature u, beside Hooke's law."""

    kind: ClassVar[str] = "stiffening"

    cubic: Any = parameter(
        "N m4", "k, of the moment that grows with the cube of the curvature", low=0.0, high=1e3
    )

    def law(self, point, law, internal):
        bending = law.strains["u"]
        return law.with_strain("u", bending._replace(moment=Partial(cubic_moment, self.cubic)))


@pytest.mark.parametrize("cubic", [0.0, 2e-5])
def test_a_stiffening_rod_bends_to_a_circle(cubic):
    """EI κ + k κ³ is the moment at the tip; the height of the tip is sin(κ L) / κ."""
    length, curvature, EI = 0.3, 4.0, 2e9 * np.pi * 2e-3**4 / 4
    moment = EI * curvature + cubic * curvature**3
    rod = kc.robots.SlenderRod(
        length=length,
        radius=2e-3,
        density=1000.0,
        youngs_modulus=2e9,
        gravity=(0.0, 0.0, 0.0),
        nodes=41,
        loads=(kc.robots.loads.PointWrench(at=1.0, moment=(moment, 0.0, 0.0)),),
        effects=(Stiffening(cubic),),
    )
    found = kc.equilibrium(rod, np.zeros(0), space="lobatto4")
    height = np.sin(curvature * length) / curvature
    assert found.tip_position[0, 2] == pytest.approx(height, rel=1e-9)


class Stiffer(Effect):
    """Bending that is stiffer by `more`, as a stiffness or as a moment."""

    more: Any = parameter("N m2", "stiffness more", low=0.0, high=1e3)
    nonlinear: Any = parameter("", "part of it that is a moment", low=0.0, high=1.0)

    def law(self, point, law, internal):
        bending, more = law.strains["u"], self.more * np.diag([1.0, 1.0, 0.0])
        moment = Partial(lambda more, u, u_t: jnp.sum(more * u, axis=1), self.nonlinear * more)
        stiffness = bending.stiffness + (1.0 - self.nonlinear) * more
        return law.with_strain("u", bending._replace(stiffness=stiffness, moment=moment))


@pytest.mark.slow
def test_a_moment_acts_beside_tendons():
    """A linear moment is a stiffness, also where tendons couple the strains; it was ignored there."""
    nominal = kc.load_robot("delrin-routed-tendon-robot").replace(nodes=7)
    pulled = np.tile([6.0, 2.0, 0.0, 0.0], (4, 1))
    tips = {}
    for part in (0.0, 1.0):
        robot = nominal.replace(effects=(Stiffer(0.5 * float(nominal.Kbt[0, 0]), part),))
        still = kc.equilibrium(robot, pulled[0])
        moved = kc.simulate(robot, pulled, 0.05, initial="unstressed")
        tips[part] = np.concatenate([still.tip_position, moved.tip_position])
    np.testing.assert_allclose(tips[1.0], tips[0.0], rtol=0.0, atol=1e-8)
    plain = kc.equilibrium(nominal, pulled[0]).tip_position
    assert np.linalg.norm(tips[1.0][0] - plain[0]) > 1e-2


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        (lambda law: law.with_strain("k", law.strains["u"]), "strain is 'k'; allowed is v, u"),
        (lambda law: law.strains["u"], "Wrong.law returns a Viscoelastic; allowed is the law with the part"),
        (lambda law: with_moment(law, lambda u, u_t: u), "moment is a function; allowed is jax.tree_util.P"),
        (lambda law: with_moment(law, Partial(lambda u, u_t: u[0])), r"moment returns .* of shape \(3,\)"),
    ],
)
def test_a_law_of_another_form_is_refused(changed, message):
    """A moment that is one number bent the rod about all axes without a word."""

    class Wrong(Effect):
        def law(self, point, law, internal):
            return changed(law)

    rod = kc.robots.SlenderRod(0.3, radius=2e-3, density=1e3, youngs_modulus=2e9, effects=(Wrong(),))
    with pytest.raises((TypeError, ValueError), match=message):
        kc.equilibrium(rod, np.zeros(0))


def with_moment(law, moment):
    return law.with_strain("u", law.strains["u"]._replace(moment=moment))
