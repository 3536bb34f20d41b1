"""Every state agrees with the NumPy transcription of the paper's Algorithm 1, which shares no code."""

import numpy as np
import pytest

import knode_cosserat as kc
from benchmarks import paper_transcription as transcription

DT = 0.05
#: the transcription needs some 10 ms a step
STEPS = 40
TOLERANCE = 1e-6

#: parameters by name, in the package; the transcription has its own
MODELS = {
    "true robot": {},
    "self-weight": {"gravity": (0.0, 0.0, 0.0)},
    "length": {"length": 0.4},
    "stiffness": {"youngs_modulus": 10e9},
    "length & stiffness": {"length": 0.4, "youngs_modulus": 10e9},
}
# The package gets more steps than are compared, so that it runs the program that other tests have compiled.
CONTROLS = {
    "sine": kc.controls.sine(1.5, 100, DT, sampled="end"),
    "step": kc.controls.step(1.5, 100, DT, at=0.5, sampled="end"),
    "random": kc.controls.random(100, seed=1),
}


@pytest.fixture(scope="module")
def oracle():
    """By model and control: the transcription's results."""
    return {
        (model, control): transcription.simulate(
            transcription.IMPERFECT.get(model, transcription.TRUE_ROBOT), tensions[:STEPS], DT
        )
        for model in MODELS
        for control, tensions in CONTROLS.items()
    }


@pytest.mark.slow
def test_the_transcription_converges_nearly_always(oracle):
    # where it does not it says nothing, so it must not be the reason for agreement
    valid = [result.valid_rows for result in oracle.values()]
    assert min(valid) > STEPS / 2
    assert np.mean(valid) > 0.95 * (STEPS + 1)


@pytest.mark.parametrize("control", CONTROLS)
@pytest.mark.parametrize("model", MODELS)
def test_states_agree_with_the_transcription(oracle, model, control):
    expected = oracle[model, control]
    rows = expected.valid_rows
    robot = kc.load_robot("delrin-tendon-robot").replace(**MODELS[model])
    found = kc.simulate(
        robot, CONTROLS[control], DT, time="bdf2", start="paper", space="euler", initial="unstressed"
    )
    y, z = expected.state[:rows, :, :19], expected.state[:rows, :, 19:]
    np.testing.assert_allclose(found.y[:rows], y, rtol=0, atol=TOLERANCE)
    # the transcription leaves z of the last node as it was: no segment starts there
    np.testing.assert_allclose(found.z[:rows, :-1], z[:, :-1], rtol=0, atol=TOLERANCE)
