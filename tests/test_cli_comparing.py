"""Commands on trajectories that there are: evaluate, plot and animate."""

import numpy as np
import pytest

import knode_cosserat as kc
from tests.commands import ROBOT, run, simulated, succeeded, told

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def truth(tmp_path_factory):
    path = tmp_path_factory.mktemp("truth") / "truth.nc"
    succeeded(*simulated(path))
    return path


def test_evaluate_compares_trajectories(tmp_path, truth):
    other = tmp_path / "other.nc"
    succeeded(*simulated(other, "--set", "length=0.6"))
    facts = told("evaluate", other, truth, other)
    a, b = kc.load_trajectory(other), kc.load_trajectory(truth)
    expected = {
        "tip_dtw": kc.metrics.tip_dtw(a, b),
        "pose_mse": kc.metrics.pose_mse(a, b),
        "tip_rmse": kc.metrics.tip_rmse(a, b),
        "rotation_rmse": kc.metrics.rotation_rmse(a, b),
    }
    first, second = facts["references"]
    assert first == {"reference": str(truth), "rows": 17, **expected}
    assert second == {"reference": str(other), "rows": 17, **dict.fromkeys(expected, 0.0)}
    words = succeeded("evaluate", other, truth, other)
    assert f"{expected['tip_dtw']:.4g}" in words and "tip DTW [m]" in words
    assert f"{np.degrees(expected['rotation_rmse']):.4g}" in words and "orientations [deg]" in words


def test_evaluate_simulates_a_robot_as_the_papers_table_has_it(tmp_path):
    # protocol.md: stiffness, sine: DTW 19.99, MSE 12.52; the paper keeps the first 100 rows
    out = tmp_path / "truth.nc"
    tensions = kc.controls.sine(1.5, 100, 0.05, sampled="end")
    paper = {"time": "bdf2", "space": "euler", "start": "paper"}
    kc.simulate(kc.load_robot(ROBOT), tensions, 0.05, **paper).save(out)
    (row,) = told("evaluate", ROBOT, out, "--set", "youngs_modulus=10e9", "--rows", 100)["references"]
    assert row["rows"] == 100
    assert row["tip_dtw"] == pytest.approx(19.99, abs=0.005)
    assert row["pose_mse"] == pytest.approx(12.52, abs=0.005)


@pytest.mark.campaign
def test_evaluate_simulates_by_the_references_settings(tmp_path):
    out, robot = tmp_path / "a.nc", tmp_path / "robot.yaml"
    succeeded(*simulated(out, "--dt", 0.02, "--time", "bdf1", "--space", "lobatto4", "--nodes", 7))
    kc.save_robot(kc.load_robot(ROBOT).replace(nodes=7), robot)
    (row,) = told("evaluate", robot, out)["references"]
    assert row["tip_rmse"] < 1e-9


@pytest.mark.parametrize("kind", ["overview", "shape", "path", "tip", "states", "tensions"])
def test_plot_draws(tmp_path, truth, kind):
    out = tmp_path / "figure.svg"
    text = succeeded("plot", truth, "--out", out, "--kind", kind)
    assert text == f"wrote {out}\n"
    assert "<svg" in out.read_text()


def test_plot_tells_in_json(tmp_path, truth):
    out = tmp_path / "figure.pdf"
    facts = told("plot", truth, "--out", out)
    assert facts == {"trajectories": [str(truth)], "kind": "overview", "out": str(out)}
    assert out.read_bytes().startswith(b"%PDF")


def test_plot_draws_several_over_each_other(tmp_path, truth):
    other = tmp_path / "other.nc"
    succeeded(*simulated(other, "--set", "youngs_modulus=5e9"))
    for kind in ("compare", "error", "path"):
        out = tmp_path / f"{kind}.svg"
        succeeded("plot", truth, other, "--out", out, "--kind", kind, "--view", "xy", "--columns", 2)
        assert "<svg" in out.read_text()
    assert told("plot", truth, other, "--out", out)["kind"] == "compare"
    for given, words in (
        ((truth, other, "--kind", "shape"), "draws one"),
        ((truth, "--kind", "error"), "needs"),
    ):
        failed = run("plot", *given, "--out", out)
        assert failed.exit_code == 2 and words in failed.stderr


def test_animate_writes_a_motion(tmp_path, truth):
    out = tmp_path / "it.gif"
    assert succeeded("animate", truth, "--out", out, "--fps", 10, "--view", "xz") == f"wrote {out}\n"
    assert out.read_bytes().startswith(b"GIF89a")
    failed = run("animate", truth, "--out", tmp_path / "it.mov")
    assert failed.exit_code == 2 and "ends in .gif, .mp4" in failed.stderr
    failed = run("animate", truth, truth, "--out", out)
    assert failed.exit_code == 2 and "given twice" in failed.stderr


def test_trajectories_that_cannot_be_compared_give_one_line(tmp_path, truth):
    succeeded(*simulated(tmp_path / "short.nc", steps=9))
    result = run("evaluate", tmp_path / "short.nc", truth)
    assert result.exit_code == 2
    assert result.stderr == (
        f"error: {truth}: prediction has 10 rows and reference has 17; both must have the same number\n"
    )
    result = run("fit", ROBOT, truth, tmp_path / "short.nc", "--set", "nodes=8", "--out", tmp_path / "m")
    assert result.exit_code == 2
    assert result.stderr.startswith(f"error: {truth} has 10 nodes of 19 numbers; the nominal model has 8")
    result = run("info", truth)
    assert result.exit_code == 2
    assert "this is a trajectory" in result.stderr
    result = run("evaluate", truth, truth, "--set", "length=1")
    assert result.exit_code == 2
    assert "--set changes a robot" in result.stderr
