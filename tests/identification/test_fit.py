"""Fitting from recordings: what is kept, what is said of it, passive networks, and bad input."""

import dataclasses

import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.identification.effects import library_model
from knode_cosserat.identification.evaluate import coverage, evaluate
from knode_cosserat.identification.experiments import poses_of_nodes
from knode_cosserat.identification.fit import coordinates_of, fit
from knode_cosserat.identification.residual import PositionErrors, _verdict
from knode_cosserat.identification.result import Estimate, Identified
from knode_cosserat.identification.trials import failed_trial
from knode_cosserat.rods.routing import Polynomial
from tests.identification.recorded import DT, measured, tensions

NOMINAL = kc.load_robot("delrin-tendon-robot").replace(
    length=0.5,
    radius=0.003,
    density=1200.0,
    youngs_modulus=2.0e9,
    tendon_offset=0.025,
    gravity=(0.0, -9.81, 0.0),
)
#: tendons that run neither straight nor evenly: no effect of the library has them
TRUE = kc.robots.RoutedTendonRobot.like(
    NOMINAL,
    youngs_modulus=1.6e9,
    bending_damping=2e-3,
    routing=tuple(
        Polynomial(
            x=(0.025 * np.cos(angle), 0.004 * (-1) ** k), y=(0.025 * np.sin(angle), 0.003 * (-1) ** (k // 2))
        )
        for k, angle in enumerate(np.asarray(NOMINAL.tendon_angles))
    ),
)


def recordings(kinds=(1.0, 2.0, "random"), seconds=3.0):
    return [
        measured(TRUE, tensions(kind, seconds, seed=k), f"recording {k}", seed=k)
        for k, kind in enumerate(kinds)
    ]


@pytest.mark.campaign
def test_recordings_are_learned_from_and_what_was_done_is_said():
    given = recordings()
    model = fit(NOMINAL, given)
    unseen = measured(TRUE, tensions("random", 3.0, seed=9), "unseen", seed=9)
    identified = model.knowledge
    before, after = (evaluate(robot, unseen).tip_rmse for robot in (identified, model))
    assert after <= 1.01 * before
    facts = model.about.facts
    assert len(facts["given"]) == 3 and "recording 0" in facts["given"][0]
    assert any("residual" in step for step in facts["steps"])
    if facts["residual"]:
        assert after < before
        for errors in facts["held_out_error"].values():
            assert errors["residual"] <= 1.01 * errors["identified"]


@pytest.mark.campaign
def test_a_passive_network_does_not_diverge_and_its_spread_is_told():
    """From crude knowledge: a modulus that is wrong by a quarter, and tendons that run elsewhere."""
    given = recordings(kinds=(1.0, "random"), seconds=2.0)
    members = fit(
        NOMINAL, given, dataclasses.replace(kc.FitConfig.network_recordings(hidden=2), seed=(0, 1, 2))
    )
    unseen = measured(TRUE, tensions("random", 2.0, seed=9), "unseen", seed=9)
    before = evaluate(NOMINAL, unseen).tip_rmse
    model = library_model(NOMINAL, unseen.control)
    from knode_cosserat.identification.experiments import of_measurements

    data = [of_measurements(each, model, each.source) for each in given]
    for member in members:
        assert evaluate(member, unseen).tip_rmse < 0.5 * before
        assert failed_trial(member, data, "lobatto2") is None
    assert 0.0 <= coverage(members, unseen) <= 1.0


def errors(*tips):
    return [PositionErrors(tip, tip) for tip in tips]


def test_what_is_kept():
    """A residual raises no held-out error, and lowers them by more than their scatter."""
    before = errors(1.0, 2.0, 3.0)
    assert _verdict(before, {1.0: errors(0.8, 1.7, 2.5)})[0] == 1.0
    part, words = _verdict(before, {1.0: errors(0.5, 2.5, 2.0)})
    assert part == 0.0 and "+25.0 %" in words
    # an improvement of one recording may be chance
    assert _verdict(before, {1.0: errors(0.9, 2.0, 3.0)})[0] == 0.0
    # less of it where all of it is too much
    part, words = _verdict(before, {1.0: errors(0.7, 2.2, 2.4), 0.5: errors(0.8, 1.9, 2.6)})
    assert part == 0.5 and words.startswith("kept by a part of 0.5")
    assert _verdict(before, {1.0: errors(0.7, np.inf, 2.4)})[0] == 0.0


def test_coordinates_are_those_of_the_estimates():
    model = library_model(NOMINAL, np.full((4, 4), 5.0))
    x = np.where(model.mask(("stiffness", "damping", "rest curvature")), 0.3, 0.0)
    values = model.values(x)
    estimates = [
        Estimate(name, number.label, number.unit, number.nominal, values[k], (0.0, 0.0), False)
        for name in ("stiffness", "damping", "rest curvature")
        for k in range(*model.slice(name).indices(model.size))
        for number in [model.numbers[k]]
    ]
    found = Identified(NOMINAL, ("stiffness", "damping", "rest curvature"), tuple(estimates))
    assert np.allclose(coordinates_of(model, found), x, rtol=0.0, atol=1e-12)


def test_poses_of_a_trajectory_are_measurements():
    """Each row's tension is held from it to the next, as in a recording."""
    tension = kc.controls.sine(1.0, 6, DT)
    robot = NOMINAL.replace(nodes=5)
    states = kc.simulate(robot, tension, DT)
    rows = poses_of_nodes(states, "a trajectory")
    assert np.allclose(rows.control[:-1], tension, rtol=0.0, atol=0.0)
    assert rows.fractions[-1] == 1.0 and rows.dt == pytest.approx(DT)
    assert np.array_equal(rows.tip_position, np.asarray(states.position)[:, -1])


def test_bad_input():
    rows = poses_of_nodes(kc.simulate(NOMINAL.replace(nodes=5), kc.controls.sine(1.0, 6, DT), DT), "a")
    with pytest.raises(kc.learning.FitError, match="needs full states"):
        fit(NOMINAL, [rows], kc.FitConfig.paper())
    with pytest.raises(kc.learning.FitError, match="checkpoint is for trajectories"):
        fit(NOMINAL, [rows], checkpoint="a")
    with pytest.raises(ValueError, match=r"data holds 3\.0; allowed is a list"):
        fit(NOMINAL, [rows, 3.0])
    with pytest.raises(ValueError, match=r"data is a Measurements; allowed is .*did you mean \[data\]\?"):
        fit(NOMINAL, rows)
    with pytest.raises(kc.learning.ConfigError, match="no rollouts"):
        kc.FitConfig(kc.learning.PassiveOptions())
    config = kc.FitConfig.network_recordings(seed=(0, 1), hidden=3)
    assert kc.FitConfig.from_dict(config.to_dict()) == config
