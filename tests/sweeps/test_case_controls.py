"""Controls of cases: words with varied numbers, read as `controls.parse` reads them."""

import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.sweeps import Plan, Sweep, SweepError

TENSIONS = "delrin-tendon-robot"


def test_every_case_has_the_controls_of_its_numbers():
    """A number is written with all its digits; a word that the numbers make impossible is refused."""
    heights = [1.0 / 3.0, -6.0, 2.0]
    sweep = Sweep(
        TENSIONS, ["step:{height},at=0.1", "random:{seed},low={height}"], 6, 0.05, vary={"height": heights}
    )
    cases, robot = Plan.of(sweep).cases(0), kc.load_robot(TENSIONS)
    np.testing.assert_array_equal(cases.word, [0, 1] * 3)
    np.testing.assert_array_equal(cases.controls[0], kc.controls.step(heights[0], 6, 0.05, at=0.1))
    for k, height in ((1, heights[0]), (5, heights[2])):
        expected = kc.controls.random(6, low=height, seed=int(cases.seed[k]))
        np.testing.assert_array_equal(cases.controls[k], expected)
    assert robot.control_layout.size == 4 and set(cases.refused) == {2, 3}
    assert "a tension is -1 N" in cases.refused[2] and not np.any(cases.controls[[2, 3]])


@pytest.mark.parametrize("word", ["sine:{", "sine:{}", "sine:{0}", "sine:{a.b}"])
def test_names_in_braces_are_names(word):
    with pytest.raises(SweepError, match="allowed is a name in braces"):
        Plan.of(Sweep(TENSIONS, word, 6, 0.05, vary={"a": [1.0]}))
