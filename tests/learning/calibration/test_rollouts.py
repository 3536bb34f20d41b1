"""Whole simulations against what was measured: their slopes are those of what is simulated."""

import numpy as np
import pytest

from knode_cosserat.learning.calibration.rollouts import RolloutMisfit
from knode_cosserat.learning.calibration.unknowns import searched, unknowns_of, values
from knode_cosserat.rods.aspects import Ends
from tests.learning.bar import BAR, Bar, pulled


class Guessed(Ends):
    """Ends of a bar whose state at rest is a guess."""

    rest_is_guess = True


class Hanging(Bar):
    """By its own weight: how far, an equilibrium says that has to be found before a motion begins."""

    @property
    def ends(self):
        return Guessed(self)

    def balance(self, s, t, y, y_t, z, z_t, control):
        return super().balance(s, t, y, y_t, z, z_t, control).at[1].add(-9.81 * self.density)


@pytest.mark.slow
@pytest.mark.parametrize("space", [pytest.param("euler", marks=pytest.mark.campaign), "lobatto4"])
def test_where_a_robot_begins_depends_on_its_parameters_too(space):
    bar = Hanging(**{name: getattr(BAR, name) for name in BAR.parameters()}, nodes=6)
    moved = pulled(1.0, robot=bar, space=space)
    assert moved.y[0, -1, 0] > 1.1
    other = bar.replace(stiffness=25.0)
    unknowns = unknowns_of(other, ["length", "density", "stiffness", "damping"])
    misfit, at, h = RolloutMisfit(other, [moved], unknowns), searched(unknowns, values(other, unknowns)), 1e-4
    slopes = misfit(at).slopes
    for k, along in enumerate(h * np.eye(len(at))):
        expected = (misfit(at + along).values - misfit(at - along).values) / (2.0 * h)
        np.testing.assert_allclose(slopes[:, k], expected, atol=1e-6 * np.max(np.abs(expected)))
