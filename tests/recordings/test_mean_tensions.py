"""Mean tensions about the next row: what a simulation with an implicit time scheme is driven by."""

import dataclasses

import numpy as np
import pytest

from knode_cosserat.recordings import Recording, RecordingConfig, RecordingError
from knode_cosserat.recordings.config import ControlSource, MarkerSource
from knode_cosserat.recordings.streams import Body, ControlRows

LATENCY = 0.06
CONFIG = RecordingConfig(
    markers=(MarkerSource("tip", "tip", 1.0),),
    tension=ControlSource("tension", (1, 2)),
    command=ControlSource("command", (1, 2), latency=LATENCY),
)
#: messages at times of their own, as sensors send them
TIMES = np.round(0.02 * np.arange(201) + np.random.default_rng(0).uniform(0.0, 0.015, 201), 6)


def recorded(time, tension, command=None, until=4.0):
    """A recording whose tensions are known; its body stands still."""
    frames = np.round(np.arange(0.0, until + 1e-9, 0.01), 6)
    body = Body(frames, np.tile([0.0, 0.0, 0.5], (len(frames), 1)), None, "tip", "tip", 1.0)
    return Recording(
        source="it",
        config=CONFIG,
        bodies=(body,),
        base=None,
        control=ControlRows(time, tension, "tension"),
        command=command,
        rest=None,
        simulated=True,
        findings=(),
        delays={},
    )


@pytest.fixture(scope="module")
def uneven():
    values = np.random.default_rng(1).uniform(2.0, 9.0, (len(TIMES), 2))
    return recorded(TIMES, values)


def lines(recording, time):
    """Tensions on straight lines between messages; before the first and after the last, those."""
    known = recording.control
    return np.stack([np.interp(time, known.time, known.values[:, k]) for k in range(2)], axis=1)


def test_rows_begin_with_the_tensions(uneven):
    late = TIMES > 0.61
    recording = recorded(TIMES[late], uneven.control.values[late])
    for mean in (False, True):
        rows = recording.sampled(0.0125, mean=mean)
        assert abs(rows.time[0] - 0.61) < 0.12 and np.isfinite(rows.control).all()


def test_a_mean_is_that_of_the_lines_between_messages(uneven):
    given = uneven.sampled(0.05, start=0.2, mean=True)
    fine = np.linspace(0.025, 0.075, 20001)
    for row in (0, 1, 17, 40, len(given.time) - 3):
        values = lines(uneven, given.time[row] + fine)
        np.testing.assert_allclose(given.control[row], np.trapezoid(values, fine, axis=0) / 0.05, rtol=1e-5)
    held = uneven.sampled(0.05, start=0.2)
    assert np.abs(held.control - given.control).max() > 0.5
    # only the tensions are others
    np.testing.assert_array_equal(held.position, given.position)
    np.testing.assert_array_equal(held.time, given.time)


@pytest.mark.parametrize("dt", [0.005, 0.025, 0.05, 0.2])
def test_means_of_means_are_means(uneven, dt):
    """Whatever the time step, all rows together are the integral: no tension is lost or counted twice."""
    given = uneven.sampled(dt, start=0.2, end=3.0, mean=True)
    first, last = 0.2 + 0.5 * dt, 3.0 + 0.5 * dt
    breaks = np.unique(np.concatenate([[first, last], TIMES[(first < TIMES) & (last > TIMES)]]))
    integral = np.trapezoid(lines(uneven, breaks), breaks, axis=0)
    np.testing.assert_allclose(given.control[:-1].sum(axis=0) * dt, integral, rtol=1e-12)
    # three rows from the second on lie about the same row as one of three times the time
    coarse = uneven.sampled(3 * dt, start=0.2, end=3.0, mean=True)
    rows = (len(given.time) - 2) // 3
    triples = given.control[1 : 1 + 3 * rows].reshape(-1, 3, 2).mean(axis=1)
    np.testing.assert_allclose(coarse.control[:rows], triples, rtol=1e-12)


def test_a_constant_stays_and_a_line_is_taken_at_the_next_row():
    time = np.round(np.arange(0.0, 4.0, 0.02), 6)
    constant = recorded(time, np.tile([5.0, 2.0], (len(time), 1))).sampled(0.05, mean=True)
    np.testing.assert_allclose(constant.control, np.tile([5.0, 2.0], (len(constant.time), 1)), rtol=1e-12)
    rising = recorded(time, np.stack([time, 9.0 - 2 * time], axis=1)).sampled(0.05, end=3.9, mean=True)
    assert rising.continuous
    after = rising.time + 0.05
    np.testing.assert_allclose(rising.control, np.stack([after, 9.0 - 2 * after], axis=1), rtol=1e-12)


def test_before_the_first_message_and_after_the_last_its_tension_holds():
    time, values = np.array([0.03, 0.1, 0.13]), np.array([[1.0, 1.0], [3.0, 1.0], [7.0, 1.0]])
    given = recorded(time, values, until=0.13).sampled(0.1, start=0.0, mean=True)
    # from 0.05 to 0.15 s: 0.05 s on the way from 1 to 3 N, 0.03 s on the way to 7 N, then 0.02 s there
    np.testing.assert_allclose(given.time, [0.0, 0.1])
    np.testing.assert_allclose(
        given.control[:, 0], [0.5 * (11 / 7 + 3) / 2 + 0.3 * 5 + 0.2 * 7, 7.0], rtol=1e-12
    )
    alone = recorded(np.array([0.05]), np.array([[4.0, 5.0]]), until=0.05).sampled(0.05, mean=True)
    np.testing.assert_allclose(alone.control, [[4.0, 5.0], [4.0, 5.0]])


def test_commands_are_steps_and_come_late():
    """Each is held until the next, from its latency on."""
    sent = ControlRows(np.array([0.0, 1.0, 1.42]), np.array([[2.0, 2.0], [6.0, 2.0], [3.0, 2.0]]), "command")
    recording = recorded(np.array([0.0, 4.0]), np.zeros((2, 2)), sent)
    given = recording.sampled(0.1, controls="commanded", mean=True)
    rows = {round(float(t), 9): k for k, t in enumerate(given.time)}
    assert given.control[rows[0.9], 0] == pytest.approx(2.0)
    # 0.06 s of the old one, 0.04 s of the new one
    assert given.control[rows[1.0], 0] == pytest.approx(0.6 * 2.0 + 0.4 * 6.0)
    assert given.control[rows[1.1], 0] == pytest.approx(6.0)
    assert given.control[rows[1.4], 0] == pytest.approx(0.8 * 6.0 + 0.2 * 3.0)
    # the last one holds
    np.testing.assert_allclose(given.control[rows[1.5] :, 0], 3.0)
    held = recording.sampled(0.1, controls="commanded")
    assert held.control[rows[1.0], 0] == 2.0 and held.control[rows[1.4], 0] == 6.0


def test_a_pause_stays_unknown(uneven):
    """Nothing is averaged over what was not measured."""
    known = uneven.control
    kept = (known.time < 1.0) | (known.time > 2.0)
    paused = dataclasses.replace(uneven, control=ControlRows(known.time[kept], known.values[kept], "tension"))
    given = paused.sampled(0.05, start=0.2, mean=True)
    times = paused.control.time
    last, following = times[times < 1.0][-1], times[times > 2.0][0]
    unknown = ~np.isfinite(given.control).all(axis=1)
    begin, end = given.time + 0.025, given.time + 0.075
    # a tension is believed for as long as a pause is bridged
    np.testing.assert_array_equal(unknown, (end > last + 0.1) & (begin < following))
    plain = uneven.sampled(0.05, start=0.2, mean=True)
    whole = (end < last) | (begin > following)
    np.testing.assert_allclose(given.control[whole], plain.control[whole])
    # until then it is held, and no line leads to what was measured a second later
    held = ~unknown & (begin > last) & (begin < following)
    assert held.any()
    np.testing.assert_allclose(given.control[held], np.tile(lines(paused, np.array([last])), (held.sum(), 1)))


def test_without_such_tensions_it_says_so(uneven):
    with pytest.raises(RecordingError, match=r"^it: there are no commanded controls$"):
        uneven.sampled(0.05, controls="commanded", mean=True)
