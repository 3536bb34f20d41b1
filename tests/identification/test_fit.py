"""Learning on an identified robot: what is found, what is kept, what is said of it, and bad input."""

import dataclasses

import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.estimation.parameters import ParameterModel
from knode_cosserat.identification.evaluate import evaluate
from knode_cosserat.identification.experiments import experiments_of, poses_of_nodes
from knode_cosserat.identification.fit import fit
from knode_cosserat.identification.residual import Block, _verdict, blocks_of
from knode_cosserat.identification.result import Identified
from studies.truths import Stiffening, derived_robot
from tests.identification.recorded import DT

ROBOT = kc.load_robot("delrin-tendon-robot").replace(
    length=0.4, radius=0.003, youngs_modulus=2.0e9, tendon_offset=0.02, nodes=7
)
#: stiffer by 30 % where it bends in the positive sense: no effect of the library has this
TRUE = derived_robot(Stiffening, ROBOT, law="one way")
NOISE = 2e-4


def seen(robot, seed, count=36, noise=NOISE):
    """Noisy positions of the tip alone, in equilibria under random tensions."""
    rng = np.random.default_rng(seed)
    tension = np.sort(rng.uniform(0.0, 4.0, (count, 4)), axis=0)[rng.permutation(count)]
    tension = rng.permuted(tension, axis=0)
    tip = np.asarray(kc.equilibrium(robot, tension, space="lobatto4").tip_position)[:, 0]
    tip = tip + noise * rng.normal(size=tip.shape)
    return kc.recordings.Measurements(
        time=np.arange(count, dtype=float),
        control=tension,
        fractions=np.ones(1),
        position=tip[:, None],
        quaternion=np.full((count, 1, 4), np.nan),
        measured=np.ones((count, 1), dtype=bool),
        simulated=True,
        static=True,
        source=f"equilibria {seed}",
    )


@pytest.mark.slow
def test_what_the_library_lacks_is_found_from_the_tip_alone(tmp_path):
    given, unseen = seen(TRUE, 0), seen(TRUE, 1)
    lines = []
    model = fit(Identified(ROBOT), [given], held_out=[unseen], progress=lines.append, checkpoint=tmp_path)
    facts = model.about.facts
    assert facts["residual"] and facts["complete"], facts
    before, after = (evaluate(robot, unseen).tip_rmse for robot in (ROBOT, model))
    assert after < 0.3 * before
    assert facts["unseen_error"] == {"equilibria 1": pytest.approx(after)}
    assert np.mean(facts["held_out_error"]["with"]) < 0.5 * np.mean(facts["held_out_error"]["without"])
    assert "equilibria 0: 36 rows" in facts["given"][0]
    learned, tested = model.passport.origins
    assert (learned.name, learned.rows, learned.dt) == ("equilibria 0", 36, 0.0)
    assert (tested.name, tested.learned) == ("equilibria 1", False)
    assert tested.held_out_error == pytest.approx(after)
    errors = np.array(facts["held_out_error"]["with"])
    assert errors.min() <= learned.held_out_error <= errors.max()
    assert not evaluate(model, given).extrapolated and not model.passport.rates
    # a model file holds it all
    model.save(tmp_path / "model")
    same = kc.load_model(tmp_path / "model")
    assert same.passport.to_dict() == model.passport.to_dict()
    assert evaluate(same, unseen).tip_rmse == after
    # an interrupted fit resumes: the searches are not repeated, and the result is the same
    again = fit(ROBOT, [given], checkpoint=tmp_path)
    for name, value in model.coefficients().items():
        assert np.array_equal(again.coefficients()[name], value)


@pytest.mark.slow
def test_nothing_is_learned_from_noise():
    given = seen(ROBOT, 2, noise=5.0 * NOISE)
    model = fit(ROBOT, [given])
    assert not model.about.facts["residual"] and not model.coefficients()
    assert "no residual" in model.about.facts["steps"][-1] or "not kept" in model.about.facts["steps"][-1]
    assert evaluate(model, given).tip_rmse == pytest.approx(evaluate(ROBOT, given).tip_rmse)


def test_without_time_the_robot_is_as_it_was():
    model = fit(ROBOT, [seen(ROBOT, 3, 8)], minutes=1e-9)
    assert model.about.facts["complete"] is False and not model.coefficients()
    assert model.about.facts["steps"] == ["no residual: the time is over"]


def block(experiment, count):
    return Block(experiment, np.arange(count))


def test_what_is_kept():
    """A residual raises no recording's held-out error, and lowers those of blocks by more than scatter."""
    blocks, before = [block(k, 10) for k in range(3)], [1.0, 2.0, 3.0]
    assert _verdict(blocks, before, {1.0: [0.8, 1.7, 2.5]})[0] == 1.0
    part, words = _verdict(blocks, before, {1.0: [0.5, 2.5, 2.0]})
    assert part == 0.0 and "not kept" in words
    # an improvement of one recording may be chance
    assert _verdict(blocks, before, {1.0: [0.9, 2.0, 3.0]})[0] == 0.0
    # less of it where all of it is too much
    part, words = _verdict(blocks, before, {1.0: [0.7, 2.2, 2.4], 0.5: [0.8, 1.9, 2.6]})
    assert part == 0.5 and words.startswith("kept by a part of 0.5")
    assert _verdict(blocks, before, {1.0: [0.7, np.inf, 2.4]})[0] == 0.0
    # blocks of one recording count together
    blocks, after = [block(0, 10) for k in range(6)], [1.03, 1.6, 2.4, 0.8, 1.6, 2.4]
    assert _verdict(blocks, before * 2, {1.0: after})[0] == 1.0


def test_rows_are_left_out_together_as_long_as_the_controls_are_related():
    model = ParameterModel(ROBOT, ())
    quick = experiments_of([seen(ROBOT, 4, 24)], model)
    blocks = blocks_of(quick)
    assert len(blocks) == 6 and sorted(np.concatenate([it.rows for it in blocks])) == list(range(1, 25))
    assert np.all(np.diff(blocks[0].rows) > 1)
    slow = dataclasses.replace(quick[0], control=np.repeat(np.linspace(0.0, 3.0, 24)[:, None], 4, axis=1))
    assert np.all(np.diff(blocks_of([slow])[0].rows) == 1) and len(blocks_of([slow])[0].rows) >= 4
    # parts of a motion are spans of time
    moving = dataclasses.replace(quick[0], static=False)
    assert all(np.all(np.diff(it.rows) == 1) for it in blocks_of([moving])) and len(blocks_of([moving])) > 1
    # a release is one run
    still = dataclasses.replace(quick[0], control=np.zeros((24, 4)))
    assert len(blocks_of([still])) == 1 and len(blocks_of([still, still])) == 2
    # recordings that are many are left out one by one
    assert [it.experiment for it in blocks_of(quick * 7)] == list(range(7))


def test_poses_of_a_trajectory_are_measurements():
    """Each row's tension is held from it to the next, as in a recording."""
    tension = kc.controls.sine(1.0, 6, DT)
    robot = ROBOT.replace(nodes=5)
    states = kc.simulate(robot, tension, DT)
    rows = poses_of_nodes(states, "a trajectory")
    assert np.allclose(rows.control[:-1], tension, rtol=0.0, atol=0.0)
    assert rows.fractions[-1] == 1.0 and rows.dt == pytest.approx(DT)
    assert np.array_equal(rows.tip_position, np.asarray(states.position)[:, -1])


def test_bad_input():
    rows = poses_of_nodes(kc.simulate(ROBOT.replace(nodes=5), kc.controls.sine(1.0, 6, DT), DT), "a")
    with pytest.raises(kc.learning.FitError, match="needs full states"):
        fit(ROBOT, [rows], kc.FitConfig.paper())
    with pytest.raises(kc.learning.FitError, match="log_dir is for trajectories"):
        fit(ROBOT, [rows], log_dir="a")
    with pytest.raises(kc.learning.FitError, match="allowed is one seed"):
        fit(ROBOT, [rows], kc.FitConfig(seed=(0, 1)))
    with pytest.raises(kc.learning.FitError, match=r"minutes is -1\.0; allowed is a number above zero"):
        fit(ROBOT, [rows], minutes=-1.0)
    with pytest.raises(ValueError, match=r"data holds 3\.0; allowed is a list"):
        fit(ROBOT, [rows, 3.0])
    with pytest.raises(ValueError, match=r"data is a Measurements; allowed is .*did you mean \[data\]\?"):
        fit(ROBOT, rows)
    three = dataclasses.replace(rows, control=rows.control[:, :3])
    with pytest.raises(
        kc.learning.DataError, match=r"the robot has the controls tension \(4\); the recording has 3 controls"
    ):
        fit(ROBOT, [three])
