"""What a model learned, drawn."""

import io

import matplotlib.colors
import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.solvers.segments import DataError

# beyond the package's own warnings: those of matplotlib about what it is asked to draw
pytestmark = pytest.mark.filterwarnings("error")

DT = 0.05
ROBOT = kc.load_robot("delrin-tendon-robot")


@pytest.fixture(scope="module")
def states():
    return kc.simulate(ROBOT, kc.controls.sine(0.5, 20, DT), DT)


def curves(axes):
    return {line.get_label(): np.asarray(line.get_ydata()) for line in axes.get_lines()}


def test_it_draws_what_is_added_to_what_the_knowledge_has(states):
    """(K + c0 B) u is the same for both: the knowledge's u is too large by what its K is too small."""
    stiffness = float(ROBOT.youngs_modulus) * np.pi * float(ROBOT.radius) ** 4 / 4.0
    model = kc.fit(ROBOT.replace(youngs_modulus=0.25 * float(ROBOT.youngs_modulus)), [states])
    figure = kc.figures.residual(model, states)
    figure.savefig(io.BytesIO(), format="png")
    panels = {axes.get_ylabel(): curves(axes) for axes in figure.axes}
    assert list(panels) == ["v [1]", "u [1/m]", "n_s [N/m]", "m_s [N]"]
    of = panels["u [1/m]"]
    c0 = 1.0 / (kc.solvers.SDIRK2().ends[0] * DT)
    expected = 0.75 * stiffness / (stiffness + c0 * float(ROBOT.bending_damping[0, 0]))
    assert np.max(of["added"]) / np.max(of["nominal model"]) == pytest.approx(expected, rel=5e-3)
    # they change only as far as they depend on the strains
    for loads in ("n_s [N/m]", "m_s [N]"):
        assert np.max(panels[loads]["added"]) < 1e-4 * np.max(panels[loads]["nominal model"])
    first, second = figure.axes[0].get_lines()
    assert matplotlib.colors.to_hex(first.get_color()) != matplotlib.colors.to_hex(second.get_color())


def test_states_of_another_robot_are_refused(states):
    model = kc.fit(ROBOT.replace(youngs_modulus=10e9), [states])
    with pytest.raises(DataError, match=r"20 nodes .* the nominal model has 10"):
        kc.figures.residual(model, kc.simulate(ROBOT.replace(nodes=20), kc.controls.sine(0.5, 5, DT), DT))
