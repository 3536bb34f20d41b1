"""Virtual robots with random imperfections, and what identification finds of twenty of them (a campaign)."""

import numpy as np
import pytest
from typer.testing import CliRunner

import knode_cosserat as kc
from knode_cosserat.identification.imperfections import SIZES, imperfect_robot
from knode_cosserat.recordings.findings import RecordingError
from knode_cosserat.recordings.virtual import record_virtual
from knode_cosserat.rods.parameters import ParameterError
from studies import virtual_robots

TENSION = np.array([[4.9, 4.9, 4.9, 4.9], [7.8, 4.9, 2.0, 4.9], [11.0, 6.0, 9.0, 8.0]])
NOMINAL = kc.load_robot("delrin-tendon-robot")


def drawn(seed):
    return imperfect_robot(NOMINAL, TENSION, seed)


def test_a_seed_is_one_robot_and_effects_are_drawn_with_their_probability():
    robots = [drawn(seed) for seed in range(60)]
    assert dict(robots[3].values) == dict(drawn(3).values)
    assert len({each.effects for each in robots}) > 50
    model = robots[0].model
    for effect in model.effects:
        share = np.mean([effect.name in each.effects for each in robots])
        if effect.basic:
            assert share == 1.0
        elif effect.of_recordings:
            # a robot has none of them
            assert share == 0.0
        elif not effect.needs:
            # 1/3, within four standard deviations of the mean of 60
            assert abs(share - 1.0 / 3.0) < 4.0 * np.sqrt(2.0 / 9.0 / 60.0)


def test_numbers_are_as_far_from_nominal_as_their_priors_are_wide():
    low, high = drawn(0).model.bounds
    for each in (drawn(seed) for seed in range(20)):
        on = each.model.mask(each.effects)
        assert np.all(each.x[~on] == 0.0)
        inside = (each.x > low) & (each.x < high) & on
        assert np.all((np.abs(each.x[inside]) >= SIZES[0]) & (np.abs(each.x[inside]) <= SIZES[1]))
        assert np.all((each.x >= low) & (each.x <= high))


@pytest.mark.campaign
def test_a_drawn_robot_comes_back_from_a_file(tmp_path):
    robot = drawn(7).robot
    kc.save_robot(robot, tmp_path / "true.yaml")
    again = kc.load_robot(tmp_path / "true.yaml")
    found = [kc.equilibrium(each, TENSION[0]).position for each in (robot, again)]
    assert np.allclose(*found, rtol=0.0, atol=1e-9)


def test_bad_seeds_and_robots(tmp_path):
    with pytest.raises(ParameterError, match="seed is -1; allowed is a whole number from 0"):
        drawn(-1)
    rod = kc.load_robot("delrin-tendon-robot").replace(tendon_angles=(0.0, 2.0, 4.0))
    with pytest.raises(RecordingError, match="3 controls; allowed is one with four tendons"):
        record_virtual(tmp_path / "x.bag", robot=rod)


def test_the_command_names_the_imperfections(tmp_path):
    from knode_cosserat.cli import app

    out = CliRunner().invoke(
        app, ["record-virtual", "sine:1", "--out", str(tmp_path / "x.bag"), "--truth", "y.yaml"]
    )
    assert out.exit_code == 2 and "--truth needs --imperfections" in out.output


@pytest.mark.campaign
def test_twenty_virtual_robots(tmp_path):
    """All predictions succeed and are better than before learning."""
    report = virtual_robots.rerun(tmp_path, range(20))
    told = virtual_robots.summary(report.cells)
    print(report.tables[0].read_text())
    assert told["failed"] == 0 and told["least_improvement"] > 0.0
    assert told["median_improvement"] >= 0.95
