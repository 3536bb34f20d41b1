"""Files of earlier versions go on loading, and mean what they meant (tests/files/make.py made them)."""

import json
from pathlib import Path

import numpy as np
import pytest
import xarray

import knode_cosserat as kc
from knode_cosserat.learning.files import model_file
from knode_cosserat.learning.files.container import Writer

FILES = Path(__file__).with_name("files")
TOLD = json.loads((FILES / "told.json").read_text())


def test_a_robot_of_format_1():
    robot = kc.load_robot(FILES / "robot-1.yaml")
    assert isinstance(robot, kc.robots.TendonRobot) and robot.nodes == 5
    assert float(robot.youngs_modulus) == pytest.approx(2.757903e9)


def test_a_robot_of_format_2():
    robot = kc.load_robot(FILES / "robot-2.yaml")
    assert [load.kind for load in robot.loads] == ["point-wrench", "attached-mass"]
    assert float(robot.loads[0].at) == 0.5 and float(robot.loads[1].mass) == 0.001


def test_a_trajectory():
    found = kc.load_trajectory(FILES / "trajectory-1.nc")
    assert found.all_valid and found.dt == pytest.approx(0.05)
    np.testing.assert_allclose(found.tip_position[-1], TOLD["tip"], rtol=1e-12)
    np.testing.assert_allclose(found.control[-1], TOLD["tension"])


@pytest.mark.slow
def test_a_model_predicts_what_it_did():
    model = kc.load_model(FILES / "model-1.model")
    before = kc.load_trajectory(FILES / "prediction-1.nc")
    it = before.settings
    found = kc.simulate(
        model, np.asarray(before.control)[1:], before.dt, time=it.time, space=it.space, start=it.start
    )
    np.testing.assert_allclose(found.tip_position[-1], TOLD["predicted tip"], atol=1e-9)
    np.testing.assert_allclose(found.y, before.y, atol=1e-7)


# choices that are no longer there

NEWTON = {
    "tolerance": 1e-10,
    "acceptable": 1e-8,
    "max_linearisations": 12,
    "patience": 6,
    "least_damping": 1e-3,
}
DECOUPLED = {"scheme": "Decoupled", "group": 4}


@pytest.mark.parametrize("more", [{}, {"elimination": "Condensed"}, {"elimination": DECOUPLED}])
def test_a_trajectory_with_settings_and_results_of_earlier_versions(tmp_path, more):
    path = tmp_path / "a.nc"
    data = xarray.load_dataset(FILES / "trajectory-1.nc", engine="h5netcdf", decode_cf=False)
    settings = json.loads(data.attrs["settings"])
    settings |= {"space": {"scheme": "RK4"}, "newton": NEWTON | {"across_steps": True}, **more}
    data.attrs["settings"] = json.dumps(settings)
    # the stable elimination, load continuation, finer segments
    data["result"].values[1:4] = [1, 2, 5]
    data["begun"] = ("begun_state", "begun_stage", "begun_point", "begun_number"), np.zeros((3, 4, 5, 25))
    data["begun_step"] = "begun_coefficient", np.zeros(5)
    data.to_netcdf(path, engine="h5netcdf")
    found = kc.load_trajectory(path)
    assert found.settings == kc.solvers.Settings(
        kc.solvers.BDF2(), kc.solvers.Lobatto4(), "paper", kc.solvers.NewtonOptions(patience=6)
    )
    codes = kc.Result
    expected = [codes.CONVERGED, codes.RECOVERED_LOAD_CONTINUATION, codes.CONVERGED]
    assert found.result[1:4].tolist() == expected
    assert found.initial_state is None and found.final_state is None and found.position_error is None
    # saved again it is a file of this version
    found.save(tmp_path / "b.nc")
    np.testing.assert_array_equal(kc.load_trajectory(tmp_path / "b.nc").result, found.result)


@pytest.mark.slow
def test_a_trajectory_without_a_final_state_goes_on_by_a_replay_of_its_rows(tmp_path):
    """Before `final_state`, files had the history in row 0, and c0, c1, c2, d1 and dt of the first step."""
    robot = kc.load_robot("delrin-tendon-robot").replace(nodes=5)
    before = kc.simulate(robot, kc.controls.sine(1.0, 6, 0.05), 0.05, time="trapezoidal")
    before.save(tmp_path / "a.nc")
    data = xarray.load_dataset(tmp_path / "a.nc", engine="h5netcdf", decode_cf=False)
    data.attrs["format_version"] = 1  # without a checksum
    states = [name for name in data.variables if name.startswith(("initial_history", "final_history"))]
    assert len(states) == 12
    data = data.drop_vars([name for name in states if name != "initial_history"])
    data["initial_history_step"] = "history_coefficient", np.array([40.0, -40.0, 0.0, -1.0, 0.05])
    data.to_netcdf(tmp_path / "b.nc", engine="h5netcdf")
    found = kc.load_trajectory(tmp_path / "b.nc")
    assert found.final_state is None and found.initial_state is None
    controls = kc.controls.sine(1.0, 4, 0.05)
    again, whole = (
        kc.simulate(robot, controls, 0.05, time="trapezoidal", initial=x) for x in (found, before)
    )
    np.testing.assert_allclose(again.y, whole.y, atol=1e-8)


def test_a_model_with_settings_of_earlier_versions(tmp_path):
    model = kc.load_model(FILES / "model-1.model")
    writer = Writer()
    header = model_file._header(writer, model)
    header["about"]["settings"] = {
        "$class": "Settings",
        "fields": {
            "time": {"$class": "BDF2", "fields": {"alpha": 0.0}},
            "space": {"$class": "RK4", "fields": {}},
            "start": "paper",
            "newton": {"$class": "NewtonOptions", "fields": NEWTON | {"across_steps": True}},
            "elimination": {"$class": "Decoupled", "fields": {"group": 4}},
        },
    }
    path = tmp_path / "old.model"
    path.write_bytes(writer.file(model_file.TITLE, header))
    found = kc.load_model(path).about.facts["settings"]
    assert found == kc.solvers.Settings(
        kc.solvers.BDF2(), kc.solvers.Lobatto4(), "paper", kc.solvers.NewtonOptions(patience=6)
    )
