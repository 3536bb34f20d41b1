"""The virtual robot's recordings: the paper's format, and what was put into them comes out again."""

import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.recordings.streams import ControlRows
from knode_cosserat.recordings.virtual import (
    GRAM,
    Sensors,
    commands,
    lagged,
    record_virtual,
    simulated_sensors,
)


def grams(signal, seconds=6.0):
    sent = commands(signal, seconds)
    return sent.time, sent.values / GRAM


@pytest.mark.campaign
@pytest.mark.sample
def test_what_was_put_in_is_found(virtual):
    path, truth = virtual
    recording = kc.load_recording(path)
    health = recording.health()
    assert recording.simulated is True
    assert health.latency.delay == pytest.approx(0.0, abs=0.015)
    assert health.latency.lag == pytest.approx(0.06, abs=0.015)
    assert health.rod_length == pytest.approx([0.635] * 4, rel=2e-3)
    rigid = [stream for stream in health.streams if stream.turn_noise is not None]
    assert len(rigid) == 5
    for stream in rigid:
        assert stream.noise == pytest.approx(0.15e-3, rel=0.4)
        assert stream.turn_noise == pytest.approx(2e-3, rel=0.4)
        assert stream.rate == pytest.approx(100.0)
        assert 0.005 < stream.missing < 0.06
    [swap] = [finding for finding in recording.findings if "swapped" in finding.message]
    assert swap.topic == "/vicon/continuum_2/pose" and swap.times[0] == pytest.approx(3.0, abs=0.05)
    assert not [finding for finding in recording.findings if finding.severity == "problem"]
    # the poses are those of the robot: within the noise, in the robot's own frame
    tip = recording.bodies[-1]
    row = np.round(tip.time / 0.01).astype(int)
    assert np.std(tip.position - np.asarray(truth.tip_position)[row]) < 0.2e-3


@pytest.mark.campaign
@pytest.mark.sample
def test_a_bag_read_with_another_statement_keeps_that(virtual):
    path, _ = virtual
    config = kc.recordings.RecordingConfig.paper_robot().replace(simulated=False)
    assert kc.load_recording(path, config).simulated is False


@pytest.mark.campaign
@pytest.mark.sample
def test_the_robot_begins_in_equilibrium_and_rests(virtual):
    _, truth = virtual
    position = np.asarray(truth.position)
    assert np.ptp(position[:100], axis=0).max() < 1e-9
    assert np.ptp(position[:, -1], axis=0)[:2].min() > 0.3
    assert truth.all_valid and truth.dt == pytest.approx(0.01)


@pytest.mark.campaign
def test_friction_and_ribs_make_it_another_robot(virtual):
    from knode_cosserat.recordings.virtual import virtual_robot

    _, truth = virtual
    bare = virtual_robot(10).replace(friction=0.0, rib_mass=0.0, sleeve_factor=1.0)
    without = kc.simulate(bare, np.asarray(truth.control)[5::5], 0.05)
    assert kc.metrics.tip_rmse(without[21:], truth[105::5]) > 0.02


def test_signals_are_the_paper_s():
    time, sine = grams("sine:2.0")
    assert np.all(sine[time < 1.0 - 1e-9] == 500.0) and np.allclose(sine, np.round(sine), atol=1e-9)
    np.testing.assert_allclose(sine[20], [800, 500, 200, 500])
    np.testing.assert_allclose(sine[30], [500, 800, 500, 200])
    time, step = grams("step:4.41")
    assert np.all(step[time < 2.0 - 1e-9] == 500.0)
    assert np.all(step[time >= 2.0][:, :2] == 500.0) and np.all(step[time >= 2.0][:, 2:] == 950.0)
    time, random = grams("random:4")
    assert random.min() >= 500.0 and random.max() <= 1200.0
    # held for 0.4 s: eight commands
    assert np.all(random[20:28] == random[20]) and np.all(random[28] != random[20])
    assert np.all(grams("random:4")[1] == random)


def test_other_signals_come_after_a_rest(tmp_path):
    _, constant = grams("constant:6", 2.0)
    assert np.all(constant[:20] == 500.0) and np.all(constant[20:] == np.round(6.0 / GRAM))
    kc.controls.save(tmp_path / "own.csv", np.full((10, 4), 2.0), 0.05)
    _, own = grams(str(tmp_path / "own.csv"), 2.0)
    assert np.all(own[20:] == np.round(2.0 / GRAM))


def test_the_lag_is_a_first_order_lag():
    sent = ControlRows(np.array([0.0, 1.0]), np.array([[1.0] * 4, [2.0] * 4]))
    time = np.arange(0.0, 2.0, 0.01)
    expected = np.where(time < 1.0, 1.0, 2.0 - np.exp(-(time - 1.0) / 0.06))
    np.testing.assert_allclose(lagged(sent, time, 0.06)[:, 0], expected, atol=1e-12)


@pytest.mark.campaign
@pytest.mark.sample
def test_sensors_without_noise_tell_the_truth_but_for_axes_and_place(virtual):
    _, truth = virtual
    exact = Sensors(position_noise=0.0, turn_noise=0.0, lost=0.0, tension_noise=0.0, tension_step=0.0)
    sent = commands("sine:1.0", 5.0)
    poses, tension = simulated_sensors(truth, sent, 0, exact)
    moved = poses["rib 4"].position - poses["rib 4"].position[0]
    tip = np.asarray(truth.tip_position)
    np.testing.assert_allclose(moved, tip - tip[0], atol=1e-12)
    np.testing.assert_allclose(tension.values[:50], 500.0 * GRAM, rtol=1e-12)
    same, _ = simulated_sensors(truth, sent, 0, exact)
    np.testing.assert_array_equal(same["base"].position, poses["base"].position)
    other, _ = simulated_sensors(truth, sent, 1, exact)
    assert np.abs(other["base"].position - poses["base"].position).max() > 0.01


@pytest.mark.parametrize(
    ("path", "signal", "options", "said"),
    [
        ("x.txt", "sine:1", {}, "allowed is a name that ends in .bag"),
        ("x.bag", "sinus:1", {}, "no such signal or file"),
        ("x.bag", "sine:1", {"seconds": 0.5}, "allowed is 1.5 to 300 s"),
        ("x.bag", "sine:1", {"seed": -1}, "allowed is a whole number"),
        ("x.bag", "step:-9", {}, "a tension is -4.095 N"),
    ],
)
def test_bad_input_is_one_line_before_anything_is_simulated(tmp_path, path, signal, options, said):
    with pytest.raises(ValueError, match=said) as caught:
        record_virtual(tmp_path / path, signal, **options)
    assert "\n" not in str(caught.value) and not list(tmp_path.iterdir())
