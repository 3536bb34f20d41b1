"""What a fit gained, by simulations of the nominal and the fitted model."""

import warnings

import jax.numpy as jnp
import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.learning.states import rollout_errors
from tests.learning.bar import BAR, WRONG, Bar, pulled


class Breaking(Bar):
    """A bar whose equations have no value after a time."""

    def balance(self, s, t, y, y_t, z, z_t, control):
        return super().balance(s, t, y, y_t, z, z_t, control) + jnp.where(t > 0.75, jnp.nan, 0.0)


@pytest.fixture(scope="module")
def swing():
    return pulled(1.0, space="euler")


@pytest.mark.parametrize(
    ("model", "least", "most", "warning"),
    [
        pytest.param(BAR, 1.0 - 1e-6, 1.0, None, id="all of the error"),
        pytest.param(WRONG.replace(stiffness=24.0, drag=0.3), 0.2, 0.95, None, id="much of it"),
        pytest.param(WRONG, -1e-9, 1e-9, "the fit gained little", id="nothing"),
        pytest.param(WRONG.replace(stiffness=29.5), 0.0, 0.2, "the fit gained little", id="little"),
        pytest.param(WRONG.replace(stiffness=60.0), -9.0, 0.0, "the fit gained little", id="it is worse"),
    ],
)
def test_the_gain_of_a_model(swing, model, least, most, warning):
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        errors = rollout_errors(WRONG, model, swing)
    assert least <= 1.0 - errors[1] / errors[0] <= most
    assert [str(each.message) for each in seen if "gained" in str(each.message)][:1] == [
        str(each.message) for each in seen if warning and warning in str(each.message)
    ]
    # the same by hand
    found = kc.simulate(WRONG, swing.control[1:], 0.1, space="euler", initial=swing[:1])
    apart = (np.asarray(found.y)[1:] - swing.y[1:]) / np.asarray(WRONG.scales().y)
    assert errors[0] == pytest.approx(np.sqrt(np.mean(apart**2)))


def test_a_model_that_cannot_be_simulated_is_named(swing):
    broken = Breaking(**{name: getattr(BAR, name) for name in BAR.parameters()}, nodes=BAR.nodes)
    with pytest.warns(UserWarning, match="the fitted model cannot be simulated over its first training"):
        errors = rollout_errors(WRONG, broken, swing)
    assert errors[1] == np.inf


@pytest.mark.slow
def test_a_fit_of_a_system_of_ones_own_states_its_errors(swing):
    model = kc.fit(WRONG, [swing])
    nominal, after = model.about.facts["rollout_errors"]
    assert after < 0.1 * nominal
    assert "rollout_errors" not in kc.fit(WRONG, [swing], verify=False).about.facts
