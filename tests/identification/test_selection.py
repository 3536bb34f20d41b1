"""What an effect is worth: by how much it lowers the cost of held-out parts, and how sure that is."""

import hypothesis
import hypothesis.strategies as st
import numpy as np
import pytest

from knode_cosserat.identification.selection import ERRORS, WORTH, HeldOutCosts

AMOUNT = np.array([40.0, 40.0, 40.0])


def left(*falls):
    """Costs of three parts of ten blocks, lower by parts of those of one block."""
    cost = np.ones((3, 10))
    for part, block, fall in falls:
        cost[part, block] -= fall
    return HeldOutCosts(cost, AMOUNT)


EVERYWHERE = [(part, block, 0.3) for part in range(3) for block in range(10)]


def test_the_worth_is_the_logarithm_of_the_costs():
    worth, error = left().worth(left(*EVERYWHERE))
    assert worth == pytest.approx(-AMOUNT.sum() * np.log(0.7))
    # as much in each block: there is no doubt
    assert error == pytest.approx(0.0, abs=1e-12)
    assert left().promise(left(*EVERYWHERE), 2) == pytest.approx(worth / (2 * WORTH))


def test_a_fall_in_one_block_is_not_trusted():
    """What one second of one recording says may be anything that the model misses there."""
    once = left((0, 3, 0.9))
    worth, error = left().worth(once)
    assert worth == pytest.approx(-40.0 * np.log(0.91)) and error > 0.9 * worth
    assert left().promise(once, 1) == pytest.approx(worth / (ERRORS * error)) and worth < ERRORS * error


@hypothesis.given(st.lists(st.floats(0.1, 10.0), min_size=30, max_size=30))
@hypothesis.settings(deadline=None, max_examples=50)
def test_worth_of_the_way_back_is_the_loss(costs):
    one, other = left(), HeldOutCosts(np.array(costs).reshape(3, 10), AMOUNT)
    (there, error), (back, same) = one.worth(other), other.worth(one)
    assert there == pytest.approx(-back, abs=1e-9) and error == pytest.approx(same, abs=1e-9)
    assert one.worth(one) == (0.0, 0.0)
