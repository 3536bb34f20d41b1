"""How much data learning needs, and what it is compared with."""

import importlib.util
import json
import re

import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.learning.knode import KNODE
from knode_cosserat.rods.aspects import Observed
from knode_cosserat.schemes.settings import Settings
from studies import comparisons, data_efficiency, simulation
from studies.comparisons import NodePoses, NoKnowledge, compared, linear_predictor
from studies.data_efficiency import as_markdown, figure, rerun
from studies.methods import fitted

pydmd = pytest.mark.skipif(importlib.util.find_spec("pydmd") is None, reason="needs PyDMD")
matplotlib = pytest.mark.skipif(importlib.util.find_spec("matplotlib") is None, reason="needs matplotlib")
ROBOT = kc.load_robot(simulation.ROBOT)
DT = simulation.DT


# linear prediction


def linear_motion(tensions, rank=3, seed=0):
    """A motion of the robot's numbers that obeys x' = A x + B f exactly, from rest on."""
    draw = np.random.default_rng(seed)
    rest = np.stack(
        [np.asarray(ROBOT.rest(s)[0]) for s in np.linspace(0.0, float(ROBOT.length), ROBOT.nodes)]
    )
    basis = np.linalg.qr(draw.normal(size=(rest.size, rank)))[0]
    A = 0.8 * np.linalg.qr(draw.normal(size=(rank, rank)))[0]
    B = 0.02 * draw.normal(size=(rank, 2))
    x, rows = np.zeros(rank), []
    for row in tensions:
        rows.append(rest + (basis @ x).reshape(rest.shape))
        x = A @ x + B @ np.asarray(Observed.of(ROBOT).actuation(row))[:2]
    y = np.array(rows)
    zeros = np.zeros(len(y))
    controls = np.concatenate([np.zeros((1, 4)), tensions])[: len(y)]
    z = np.zeros((*y.shape[:2], 6))
    return kc.Trajectory(ROBOT, Settings(), np.arange(len(y)) * DT, y, z, controls, zeros, zeros, zeros)


@pydmd
def test_a_linear_motion_is_predicted_exactly():
    # two trajectories: the end of one does not lead to the start of the other
    training = [linear_motion(kc.controls.random(20, seed=seed)) for seed in (0, 1)]
    predictor = linear_predictor(ROBOT, training)
    tensions = kc.controls.sine(1.5, 100, DT)
    truth = linear_motion(tensions)
    poses = predictor(tensions)
    np.testing.assert_allclose(poses.position, truth.position, atol=1e-8)
    np.testing.assert_allclose(poses.quaternion, truth.quaternion, atol=1e-8)


@pydmd
def test_a_linear_predictor_of_the_robot_beats_standing_still():
    def moved(control, rows):
        return kc.simulate(ROBOT, kc.controls.parse(control, rows, DT), DT, space="euler")[:rows]

    predictor = linear_predictor(ROBOT, [moved(control, 30) for control in simulation.TRAINING])
    truth = moved("sine:1.5", 100)
    still = NodePoses(
        np.repeat(truth.position[:1], 100, axis=0), np.repeat(truth.quaternion[:1], 100, axis=0)
    )
    predicted = predictor(kc.controls.sine(1.5, 100, DT))
    assert kc.metrics.tip_dtw(predicted, truth) < 0.2 * kc.metrics.tip_dtw(still, truth)


def test_without_pydmd_it_says_how_to_get_it(monkeypatch):
    def missing(name):
        raise ImportError(name)

    monkeypatch.setattr(comparisons.importlib, "import_module", missing)
    with pytest.raises(ImportError, match=r"pip install '\.\[studies\]'"):
        linear_predictor(ROBOT, [linear_motion(kc.controls.random(10))])


# no knowledge


def test_a_robot_that_knows_nothing_does_not_move():
    nothing = NoKnowledge(ROBOT)
    moved = kc.simulate(nothing, kc.controls.sine(1.5, 10, DT), DT, initial="unstressed")
    assert moved.all_valid
    np.testing.assert_allclose(moved.position[1:], 0.0, atol=1e-9)
    np.testing.assert_allclose(moved.y[1:, :, 7:13], 0.0, atol=1e-9)
    np.testing.assert_array_equal(
        moved.position[0], kc.simulate(ROBOT, np.zeros((1, 4)), DT, initial="unstressed").position[0]
    )
    assert nothing.replace(nodes=19).nodes == 19


@pytest.mark.campaign
def test_what_knows_nothing_does_not_see_the_imperfection():
    training = [kc.simulate(ROBOT, kc.controls.sine(0.5, 10, DT), DT, space="euler")]
    config = kc.FitConfig.paper(seed=(0,))
    config = type(config)(config.residual, type(config.segments)(epochs=3, nodes=(3, 5, 7, 9)), seed=(0,))
    models = [
        fitted(NoKnowledge(knowledge), training, config).systems[0]
        for knowledge in (ROBOT, ROBOT.replace(youngs_modulus=10e9, gravity=(0.0, 0.0, 0.0)))
    ]
    assert all(isinstance(model, KNODE) and isinstance(model.knowledge, NoKnowledge) for model in models)
    np.testing.assert_array_equal(models[0].residual.input_weights, models[1].residual.input_weights)


# the cells


def test_a_cell_without_figures_has_a_reason():
    poses = NodePoses(np.zeros((5, 2, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (5, 2, 1)))
    assert compared(poses, poses) == {"tip_dtw": 0.0, "pose_mse": 0.0, "rotation_rmse": 0.0}
    away = poses._replace(position=np.add(poses.position, [0.0, 0.0, 0.1]))
    assert compared(away, poses)["tip_dtw"] == pytest.approx(0.5)
    none = {"tip_dtw": None, "pose_mse": None, "rotation_rmse": None}
    assert compared("it broke", poses) == {**none, "failed": "it broke"}
    assert compared(poses, "no truth") == {**none, "failed": "no truth"}
    grown = poses._replace(position=np.full((5, 2, 3), np.inf))
    assert compared(grown, poses) == {**none, "failed": "the prediction grows beyond all numbers"}


def test_jobs_are_plain_and_each_has_its_own_name():
    made = data_efficiency.jobs([0, 1])
    keys = [job.key for job in made]
    assert len(set(keys)) == len(keys) and all(re.fullmatch(r"[\w-]+", key) for key in keys)
    json.dumps([dict(job.settings) for job in made])
    # the methods without knowledge once for all imperfections, the baseline once for all data
    assert len(made) == 4 + 2 * 4 * 8 + 3 * 8
    with pytest.raises(ValueError, match=r"^method 'beste' is unknown; allowed is some of baseline, "):
        data_efficiency.jobs([0], methods=["beste"])


@pytest.mark.campaign
def test_five_rows_of_one_sine_are_enough_with_the_right_knowledge():
    job = next(job for job in data_efficiency.jobs([0], [5], ["best"]) if job.key == "best-stiffness-1x5")
    cells = job.work(job.settings).facts["cells"]
    assert {(cell["control"], cell["sines"], cell["rows"]) for cell in cells} == {
        ("sine", 1, 5),
        ("step", 1, 5),
    }
    # a hundredth of what the paper's method gives from all the rows
    for cell in cells:
        paper = simulation.PUBLISHED["stiffness", cell["control"]].learned
        assert cell["tip_dtw"] < 0.01 * paper[0] and cell["pose_mse"] < 0.01 * paper[1]


# the report


def cells():
    of = {"imperfection": "stiffness", "control": "sine", "seed": 0, "rotation_rmse": None}
    made = [{**of, "method": "baseline", "sines": 0, "rows": 0, "tip_dtw": 20.0, "pose_mse": 12.0}]
    for rows in (5, 10):
        for sines in (1, 2):
            amount = {"sines": sines, "rows": rows}
            made += [
                {**of, **amount, "method": "best", "tip_dtw": 1.0 / rows, "pose_mse": 1e-3},
                {**of, **amount, "imperfection": "any", "method": "network, no knowledge", "tip_dtw": None,
                 "pose_mse": None, "failed": "no solution found"},
            ]  # fmt: skip
    return made


def test_the_table_has_a_column_for_each_amount_of_data():
    lines = [line for line in as_markdown(cells()).splitlines() if line.startswith("| ")]
    heads, _, baseline, best, alone = [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines[:5]]
    assert heads[3:] == ["1 x 5 rows", "1 x 10 rows", "2 x 5 rows", "2 x 10 rows"]
    assert baseline[2:] == ["baseline", "20", "20", "20", "20"]
    assert best[2:] == ["best", "0.2", "0.1", "0.2", "0.1"]
    assert alone == ["any", "sine", "network, no knowledge", "failed", "failed", "failed", "failed"]


@matplotlib
def test_the_figure_shows_curves_and_failures():
    (axes,) = figure(cells()).axes
    assert axes.get_yscale() == "log" and axes.get_title() == "stiffness, sine"
    curves = {
        line.get_label(): line.get_data() for line in axes.lines if not line.get_label().startswith("_")
    }
    assert set(curves) == {"baseline", "best, 1 sine", "best, 2 sines"}
    np.testing.assert_allclose(curves["best, 1 sine"][1], [0.2, 0.1])
    crosses = [line for line in axes.lines if line.get_marker() == "x" and len(line.get_xdata())]
    assert sorted(round(x) for line in crosses for x in line.get_xdata()) == [5, 5, 10, 10]


@pytest.mark.campaign
@pydmd
@matplotlib
def test_what_is_there_is_not_computed_again(tmp_path):
    methods = ["baseline", data_efficiency.LINEAR]
    report = rerun(tmp_path, seeds=[0], rows=[5], methods=methods, workers=1)
    assert len(report.cells) == 4 * 2 + 2 * 2
    assert json.loads((tmp_path / "data.json").read_text()) == report.cells
    assert all(path.stat().st_size for path in [*report.tables, *report.figures])
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "jobs").iterdir()}
    again = rerun(tmp_path, seeds=[0], rows=[5], methods=methods, workers=1)
    assert again.cells == report.cells
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "jobs").iterdir()} == before
