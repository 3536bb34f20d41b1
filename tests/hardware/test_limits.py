"""Limits of commanded tensions hold after any commands, and limits that contradict each other are refused."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from knode_cosserat_hardware.driver import HardwareError, Limits, TensionLimiter
from knode_cosserat_hardware.serial_board import SerialBoard


@given(
    st.lists(st.tuples(st.lists(st.floats(-50, 200), min_size=3, max_size=3), st.floats(0, 1)), max_size=20),
    st.floats(0, 3),
    st.floats(4, 30),
    st.floats(0.1, 300),
    st.floats(9, 60),
)
@example([([0.0] * 3, 0.0), ([0.0, 6.0, 6.0], 1.0), ([0.0] * 3, 0.0)], 2.0, 6.0, 74.0, 13.92)
@example([([0.0] * 3, 0.0)], 3.0, 4.0, 1.0, 9.0)
def test_limits_hold_after_any_commands(commands, low, high, rate, total):
    limiter = TensionLimiter(Limits(low, high, rate, total), 3)
    limiter.reset(0.0)
    now, last = 0.0, np.zeros(3)
    for tension, elapsed in commands:
        now += elapsed
        sent = limiter.reduced(np.array(tension), now)
        assert np.all(sent >= 0.0) and np.all(sent <= high + 1e-9) and sent.sum() <= total + 1e-6
        assert np.all(np.abs(sent - last) <= rate * min(elapsed + 0.02, 0.1) + 1e-9)
        last = sent
    reachable = min(low + 0.1, total / 3)
    for _ in range(10_000 if commands else 0):
        now += 0.1
        sent = limiter.reduced(np.full(3, reachable), now)
        if np.allclose(sent, reachable):
            break
    assert not commands or np.allclose(sent, reachable)


@pytest.mark.parametrize(
    "limits", [{"high": -1.0}, {"rate": 0.0}, {"low": 20.0}, {"low": 5.0, "total": 15.0}]
)
def test_limits_that_contradict_each_other_are_refused(limits):
    with pytest.raises(HardwareError, match="must be"):
        SerialBoard("port", Limits(**limits))
