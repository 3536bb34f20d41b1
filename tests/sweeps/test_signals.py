"""Controls of many cases at once are those of `controls.parse`, case by case."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import knode_cosserat as kc
from knode_cosserat.sweeps import SweepError
from knode_cosserat.sweeps._signals import case_controls, placeholders

TENSIONS, NAMED = kc.load_robot("delrin-tendon-robot"), kc.load_robot("soft-slender-robot")
WORDS = [
    (TENSIONS, "sine:{a}"),
    (TENSIONS, "sine:1.5,base={a},amplitude={b}"),
    (TENSIONS, "step:{a},at={b}"),
    (TENSIONS, "ramp:{a},base=3,start=0.1,end={b}"),
    (TENSIONS, "ramp:{a}"),
    (TENSIONS, "constant:{a}"),
    (TENSIONS, "random:{seed},low={a},hold=2"),
    (TENSIONS, "step:{a},at=0.1,tendons=2+3"),
    (TENSIONS, "7,{a},5,{b}"),
    (NAMED, "base_z=ramp:{a};base_ry=sine:{b},amplitude=0.1,phase=1"),
    (NAMED, "base_z=step:{a},at={b}"),
    (NAMED, "base_x=constant:{a}"),
]
NUMBERS = st.floats(-1.0, 6.0).map(lambda x: round(x, 3))


def parsed(robot, text):
    """Controls of one case, or the reason why there are none."""
    try:
        return kc.controls.parse(text, 6, 0.05, robot)
    except kc.controls.ControlsError as error:
        return str(error)


@pytest.mark.parametrize(("robot", "word"), WORDS, ids=[word for _, word in WORDS])
@settings(max_examples=15, deadline=None)
@given(values=st.lists(st.tuples(NUMBERS, NUMBERS), min_size=1, max_size=5))
def test_controls_at_once_are_those_case_by_case(robot, word, values):
    a, b = np.array(values).T
    numbers = {"a": a, "b": b, "seed": np.arange(len(a)) + 7}
    controls, refused = case_controls(robot, word, 6, 0.05, numbers)
    for k in range(len(a)):
        text = word.format(**{name: each[k].item() for name, each in numbers.items()})
        expected = parsed(robot, text)
        if isinstance(expected, str):
            # a signal without effect is no failed case of a sweep
            without_effect = "has the same value" in expected or "after the end of the run" in expected
            assert refused.get(k, expected if without_effect else None) == expected
            assert without_effect or not np.any(controls[k])
            continue
        assert k not in refused
        np.testing.assert_allclose(controls[k], expected, rtol=1e-14, atol=1e-14)


def test_names_in_braces():
    assert placeholders("sine:{period},base={base},amplitude={base}") == ["period", "base"]
    for word in ("sine:{", "sine:{}", "sine:{0}", "sine:{a.b}"):
        with pytest.raises(SweepError, match="allowed is"):
            placeholders(word)
