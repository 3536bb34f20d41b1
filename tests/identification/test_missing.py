"""What identification cannot find, since no effect of the library is it, is learned by the residual."""

import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.identification.evaluate import evaluate
from knode_cosserat.identification.fit import fit
from tests.identification.missing import ROBOT, ROBOTS, equilibria

#: effects that equilibria may show
EFFECTS = ["tendon offset", "load cell gains", "early anchors", "rest curvature", "taper", "tip mass"]
#: rows that are given, and the largest part that is left of the identified robot's error of unseen rows
GIVEN = {"kink": (36, 0.75), "rib": (36, 0.8), "cable": (72, 0.35), "one way": (72, 0.6)}


@pytest.mark.campaign
@pytest.mark.parametrize("name", ROBOTS)
def test_the_residual_carries_what_identification_does_not_know(name):
    count, left = GIVEN[name]
    given, unseen = equilibria(ROBOTS[name], 0, count), equilibria(ROBOTS[name], 1, count)
    found = kc.identify(ROBOT, [given], effects=EFFECTS)
    model = fit(found, [given])
    assert model.about.facts["residual"], model.about.facts["steps"]
    nominal, identified, learned = (evaluate(it, unseen).tip_rmse for it in (ROBOT, found.robot, model))
    print(f"{name}: {1e3 * nominal:.2f}, {1e3 * identified:.2f}, {1e3 * learned:.2f} mm")
    assert learned < left * identified and learned < 0.5 * nominal


@pytest.mark.slow
def test_the_robots_are_what_they_say():
    """A kink takes from its own tendon only; a rib moves with the tendons that pull."""
    rows = np.array([[6.0, 0.0, 0.0, 0.0], [0.0, 6.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]])
    plain, kink, rib = (
        np.asarray(kc.equilibrium(robot, rows, space="lobatto4").tip_position)[:, 0]
        for robot in (ROBOT, ROBOTS["kink"], ROBOTS["rib"])
    )
    less, more = (np.linalg.norm(it - plain, axis=1) for it in (kink, rib))
    assert less[0] > 5e-3 and np.all(less[1:] < 1e-6)
    np.testing.assert_allclose(more[0], more[1], rtol=1e-6)
    assert more[0] > 2e-3 and more[2] < 1e-6
    # it is farther from the axis on the side that pulls, and bends the rod more
    assert np.all(np.linalg.norm(rib[:2, :2], axis=1) > np.linalg.norm(plain[:2, :2], axis=1))
