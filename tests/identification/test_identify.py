"""Identification: which effects are found, what is predicted then, and what is said of bad input."""

import dataclasses

import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.identification.effects import library_model
from knode_cosserat.identification.evaluate import coverage, evaluate
from knode_cosserat.identification.experiments import of_measurements
from knode_cosserat.identification.trials import failed_trial, has_coarse_rows
from knode_cosserat.rods.parameters import ParameterError
from knode_cosserat.rods.section import Sleeve, Stretch
from knode_cosserat.rods.tendons import LoadCells, RibSpacing, TendonFriction
from knode_cosserat.solvers.segments import DataError
from tests.identification.recorded import DT, measured, tensions

#: as ruler, scale and data sheet have it: lying along z, with gravity across
NOMINAL = kc.load_robot("delrin-tendon-robot").replace(
    length=0.5,
    radius=0.003,
    density=1200.0,
    youngs_modulus=2.0e9,
    tendon_offset=0.025,
    gravity=(0.0, -9.81, 0.0),
)
GAIN = np.array([1.0, 1.0, 0.93, 1.0])
TRUE = kc.robots.RoutedTendonRobot.like(
    NOMINAL,
    youngs_modulus=1.3e9,
    bending_damping=2e-3,
    tendon_angles=NOMINAL.tendon_angles + 0.05,
    sections=(Stretch(curvature=(0.3, 0.0, 0.0)),),
    friction=TendonFriction(wobble=0.3, reach=0.15),
)


def gauged(tension):
    return tension / GAIN


def recordings(robot=TRUE, seconds=3.0, kinds=(1.0, 2.0, "random"), reading=gauged):
    return [
        measured(robot, tensions(kind, seconds, seed=k), f"recording {k}", seed=k, reading=reading)
        for k, kind in enumerate(kinds)
    ]


@pytest.mark.campaign
def test_a_robot_is_found_and_predicts_what_it_has_not_seen():
    """Not straight at rest, bodies mounted anyhow, and three things that the data sheet does not say."""
    told = []
    found = kc.identify(NOMINAL, recordings(), progress=told.append)
    unseen = measured(TRUE, tensions("random", 4.0, seed=9), "unseen", seed=9, reading=gauged)
    before, after = (evaluate(robot, unseen) for robot in (NOMINAL, found.robot))
    assert after.tip_rmse < 0.03 * before.tip_rmse and after.tip_rmse < 3e-3
    clean = measured(TRUE, tensions("random", 4.0, seed=9), "clean", noise=0.0, reading=gauged)
    assert coverage(found.ensemble, clean, 0.95) > 0.9
    assert "friction" in found.effects and "stiffness" in found.effects
    # what is not there is not found
    assert not {"vibration", "early anchors", "friction by curvature"} & set(found.effects)
    by_label = {each.label: each for each in found.estimates}
    friction = by_label["friction.wobble"]
    assert friction.value == pytest.approx(0.3, rel=0.1)
    assert all(error < 3e-3 for error in found.held_out_error.values())
    assert told and "friction.wobble" in str(found) and "held out" in str(found)
    assert isinstance(found.robot, kc.robots.RoutedTendonRobot)


@pytest.mark.campaign
def test_named_effects_and_their_intervals(tmp_path):
    """All of the truth is searched for: the numbers lie where they are said to lie."""
    true = kc.robots.RoutedTendonRobot.like(
        NOMINAL, youngs_modulus=1.5e9, bending_damping=2e-3, load_cells=LoadCells(gain=GAIN)
    )
    given = recordings(true, kinds=(1.0, "random"), reading=None)
    found = kc.identify(NOMINAL, given, ["load cell gains"])
    by_label = {each.label: each for each in found.estimates}
    truth = {"youngs_modulus": 1.5e9, "bending_damping": 2e-3}
    truth |= {f"load_cells.gain[{k}]": gain for k, gain in enumerate(GAIN)}
    for label, value in truth.items():
        each = by_label[label]
        assert each.interval[0] <= value <= each.interval[1], label
        assert each.value == pytest.approx(value, rel=0.02), label
    # it says where it was identified, in a file too, and where it goes beyond
    kc.save_robot(found.robot, tmp_path / "found.yaml")
    saved = kc.load_robot(tmp_path / "found.yaml")
    assert all(evaluate(saved, each).extrapolated == 0.0 for each in given)
    harder = dataclasses.replace(given[0], control=1.5 * given[0].control)
    outside = evaluate(saved, harder)
    assert outside.extrapolated > 0.3 and "of the rows extrapolated" in str(outside)


@pytest.mark.campaign
def test_a_robots_own_motion_is_predicted_however_bodies_are_mounted():
    true = kc.robots.RoutedTendonRobot.like(NOMINAL)
    seen = measured(true, tensions(1.0, 1.0), "own", noise=0.0)
    found = evaluate(true, seen)
    assert found.tip_rmse < 1e-7 and found.pose_mse < 1e-12 and found.failed is None
    assert "tip RMSE 0.00 mm" in str(found)
    assert evaluate(true, seen, every=2, last=5).tip.shape == (5, 3)
    hopeless = dataclasses.replace(seen, control=1e9 * seen.control, initial_control=None)
    failed = evaluate(true, hopeless)
    assert failed.failed and failed.to_dict()["tip_rmse"] is None and "no prediction" in str(failed)


@pytest.mark.campaign
def test_trials_name_what_fails():
    true = kc.robots.RoutedTendonRobot.like(NOMINAL)
    seen = measured(true, tensions(1.0, 1.0), "own", noise=0.0)
    data = of_measurements(seen, library_model(NOMINAL, seen.control), "own")
    assert failed_trial(true, [data], "lobatto2") is None
    # a rod that its own tendons buckle between its ribs
    weak = true.replace(rib_spacing=RibSpacing(softening=1.0))
    assert "own at 1 times their amplitude" in failed_trial(weak, [data], "lobatto2")


@pytest.mark.campaign
def test_a_grid_is_too_coarse_or_fine_enough():
    true = kc.robots.RoutedTendonRobot.like(NOMINAL)
    seen = measured(true, tensions(1.0, 1.0), "own", noise=0.0)
    data = [of_measurements(seen, library_model(NOMINAL, seen.control), "own")]
    assert not has_coarse_rows(true, data, "lobatto2")
    soft = true.replace(nodes=5, youngs_modulus=2e8, sections=(Sleeve(stiffening=8.0, length=0.1),))
    assert has_coarse_rows(soft, data, "lobatto2")


@pytest.mark.slow
def test_bad_input_says_what_is_wrong():
    rod = kc.robots.SlenderRod(length=0.5, radius=0.003, density=1000.0, youngs_modulus=1e9)
    seen = measured(kc.robots.RoutedTendonRobot.like(NOMINAL), tensions(1.0, 1.0), "own", noise=0.0)
    with pytest.raises(
        DataError, match=r"own: the robot has the controls none; the recording has 4 controls"
    ):
        kc.identify(rod, [seen])
    with pytest.raises(ValueError, match=r"allowed is a list.*did you mean \[data\]"):
        kc.identify(NOMINAL, seen)
    with pytest.raises(DataError, match="no recordings"):
        kc.identify(NOMINAL, [])
    with pytest.raises(ValueError, match=r"data holds 3; allowed is .*load_recording"):
        kc.identify(NOMINAL, [3])
    with pytest.raises(ParameterError, match="no effect 'frictoin'; did you mean friction"):
        kc.identify(NOMINAL, [seen], ["frictoin"])
    other = dataclasses.replace(seen, time=2.0 * seen.time)
    with pytest.raises(DataError, match="time steps differ"):
        kc.identify(NOMINAL, [seen, other])
    gone = dataclasses.replace(
        seen, control=np.where(np.arange(len(seen.time))[:, None] == 7, np.nan, seen.control)
    )
    with pytest.raises(DataError, match=f"no control is known at {7 * DT:g} s"):
        kc.identify(NOMINAL, [gone])
    with pytest.raises(DataError, match=r"the robot has the controls tension \(4\); the recording has"):
        kc.identify(NOMINAL, [dataclasses.replace(seen, control=seen.control[:, :3])])
    with pytest.raises(DataError, match="at least 3"):
        kc.identify(NOMINAL, [seen.rows(0, 2)])
