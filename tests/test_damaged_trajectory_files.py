import dataclasses
import os
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
import xarray

import knode_cosserat as kc
from knode_cosserat.learning.residual import Nothing
from knode_cosserat.loading import load_trajectory
from knode_cosserat.trajectory import TrajectoryFileError
from tests.trajectories import ROBOTS, Leapfrog, Pendulum, assert_same, edited, fails, synthetic

ROOT = Path(__file__).parents[1]


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "a.nc"
    synthetic().save(path)
    return path


def test_files_that_are_something_else(tmp_path, path):
    with fails("nothing.nc: no such file"):
        load_trajectory(tmp_path / "nothing.nc")
    with fails(str(tmp_path), "this is a folder"):
        load_trajectory(tmp_path)
    for content in (b"", b"CDF\x01 an older netCDF", b"time,p\n0,1\n"):
        (tmp_path / "other.nc").write_bytes(content)
        with fails("other.nc: not a netCDF-4 file; allowed is a knode-cosserat trajectory"):
            load_trajectory(tmp_path / "other.nc")
    xarray.Dataset({"p": ("time", [1.0, 2.0])}).to_netcdf(tmp_path / "foreign.nc", engine="h5netcdf")
    with fails("foreign.nc: truncated, or damaged, or written by another program"):
        load_trajectory(tmp_path / "foreign.nc")
    with h5py.File(tmp_path / "plain.h5", "w") as file:
        file["a"] = np.zeros((3, 3))
    with fails("plain.h5: truncated, or damaged, or written by another program"):
        load_trajectory(tmp_path / "plain.h5")
    kc.KNODE(synthetic().system, Nothing()).save(tmp_path / "model")
    with fails("model: this is a knode-cosserat model; allowed is a knode-cosserat trajectory"):
        load_trajectory(tmp_path / "model")


@pytest.mark.parametrize("part", [0.1, 0.5, 0.9, 0.999])
def test_truncated_files(path, part):
    content = path.read_bytes()
    path.write_bytes(content[: int(part * len(content))])
    with fails("a.nc: truncated, or damaged, "):
        load_trajectory(path)


@pytest.mark.parametrize("seed", range(20))
def test_damaged_files_give_an_error_or_a_trajectory(path, seed):
    rng = np.random.default_rng(seed)
    content = bytearray(path.read_bytes())
    for i in rng.integers(0, len(content), size=20):
        content[i] = rng.integers(256)
    path.write_bytes(content)
    try:
        load_trajectory(path)
    except TrajectoryFileError as error:
        assert "\n" not in str(error)  # noqa: PT017 - most seeds give an error, not all


def test_newer_versions(path):
    path.write_bytes(
        path.read_bytes().replace(b"trajectory, format 1, package 0", b"trajectory, format 2, package 9")
    )
    with fails("a.nc: its format is 2; this knode-cosserat reads 1", "knode-cosserat 9."):
        load_trajectory(path)


@pytest.mark.parametrize("name", ["time", "p", "u", "tension", "result", "residual", "iterations"])
def test_missing_variables(path, name):
    edited(path, lambda file: file.__delitem__(name))
    with fails(f"a.nc: the variable '{name}' is missing"):
        load_trajectory(path)


def test_variables_of_another_shape_or_type(path):
    def replaced(name, values):
        synthetic().save(path)
        edited(path, lambda file: (file.__delitem__(name), file.__setitem__(name, values)))

    replaced("n", np.zeros((4, 5, 2)))
    with fails("a.nc: the variable 'n' has shape (4, 5, 2); allowed is (4, 5, 3)"):
        load_trajectory(path)
    replaced("residual", ["a", "b", "c", "d"])
    with fails("a.nc: the variable 'residual' is missing"):
        load_trajectory(path)
    replaced("time", np.arange(3.0))
    with fails("a.nc: ", "it has another number of times than of rows"):
        load_trajectory(path)


@pytest.mark.parametrize(
    ("name", "value", "parts"),
    [
        ("robot", "format: 1\nkind: tendon-robt", ["attribute 'robot': ", "is missing"]),
        ("robot", "[", ["attribute 'robot': line ", "not YAML"]),
        ("robot", "format: 3\nkind: a\nparameters:\n", ["attribute 'robot': format is 3"]),
        ("facts", "{", ["its facts are not JSON"]),
        ("facts", "[1]", ["its facts are a list"]),
        ("facts", '{"settings": {}}', ["'settings' is not understood", "time"]),
        ("facts", '{"settings": [1]}', ["its 'settings' is missing or a list"]),
        (
            "facts",
            '{"settings": {"time": {"scheme": "BDFAlpha", "alpha": 2.0}}}',
            ["'settings' is not understood", "alpha is 2.0"],
        ),
        (
            "facts",
            '{"settings": {"time": {"scheme": "BDF1", "magic": 2.0}}}',
            ["'settings' is not understood", "magic"],
        ),
        (
            "facts",
            '{"settings": {"time": {"scheme": "os.system"}}}',
            ["'settings' is not understood", "'os.system'"],
        ),
    ],
)
def test_attributes_that_are_not_right(path, name, value, parts):
    edited(path, lambda file: file.attrs.__setitem__(name, value))
    with fails("a.nc: ", *parts):
        load_trajectory(path)


@pytest.mark.parametrize(
    ("old", "new", "parts"),
    [
        ('"$class":"SolverState"', '"$class":"System"', ["initial_state is of a class 'System'"]),
        ('{"$array":"initial_state.history.t0"}', "0.5", []),
        ('{"$array":"initial_state.history.t0"}', "[0.5]", ["'initial_state' is no state of the solver"]),
        ("initial_state.history.records", "initial_state.history.y", ["'initial_state' is no state"]),
        ("initial_state.history.y", "initial_state.history.z", ["initial_state.history.y is an array that"]),
        ('"dt":null', '"dt":[1]', ["initial_state.dt is a list; allowed is a constant"]),
        ('"initial_state":', '"beginning":', []),
    ],
)
def test_the_states_of_the_solver_are_whole(path, old, new, parts):
    synthetic(places=7).save(path)
    assert load_trajectory(path).initial_state is not None
    edited(path, facts=lambda text: text.replace(old, new, 1))
    if parts:
        with fails("a.nc: ", *parts):
            load_trajectory(path)
    else:
        load_trajectory(path)


def test_robots_of_a_batch_that_are_not_right(tmp_path):
    path = tmp_path / "a.nc"
    synthetic((3,), robot=ROBOTS).save(path)
    edited(path, lambda file: file["robot_length"].__setitem__(1, -1.0))
    with fails("a.nc: a robot of the batch is not possible: length must be between 0.001 and 20 m (got -1)"):
        load_trajectory(path)
    synthetic((3,), robot=ROBOTS).save(path)
    edited(path, lambda file: file.__delitem__("robot_drag"))
    with fails("a.nc: the variable 'robot_drag' is missing"):
        load_trajectory(path)


def test_what_cannot_be_saved(tmp_path):
    trajectory = synthetic()
    with fails("a.nc: cannot be written: No such file or directory"):
        trajectory.save(tmp_path / "no" / "a.nc")
    (tmp_path / "folder.nc").mkdir()
    with fails("folder.nc: cannot be written"):
        trajectory.save(tmp_path / "folder.nc")
    with fails("its arrays do not fit together", "time"):
        dataclasses.replace(trajectory, residual=np.zeros(3)).save(tmp_path / "a.nc")
    with fails("settings.time.weight is a object; allowed is numbers"):
        synthetic(settings=kc.solvers.Settings(time=Leapfrog(object()))).save(tmp_path / "a.nc")
    assert os.listdir(tmp_path) == ["folder.nc"]


@pytest.mark.parametrize(
    "name", ["time", "result", "a/b", "force", "robot_length", "force_index", "arrays", "extrapolated"]
)
def test_fields_whose_names_are_taken(tmp_path, monkeypatch, name):
    layout = kc.robots.Layout(
        ("angle", 1, "rad", "angle"), ("force", 3, "N", "force"), (name, 1, "1", "taken")
    )
    monkeypatch.setattr(Pendulum, "y_layout", layout)
    with fails(f"a Pendulum has a field '{name}'", "taken"):
        synthetic(robot=Pendulum(0.5)).save(tmp_path / "a.nc")


def test_a_crash_leaves_the_old_file(path, monkeypatch):
    before = path.read_bytes()

    def crash(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", crash)
    with fails("a.nc: cannot be written: No space left on device"):
        synthetic(seed=1).save(path)
    assert path.read_bytes() == before
    assert os.listdir(path.parent) == ["a.nc"]


# what loads is what was saved


def test_no_change_of_the_content_is_read(path):
    content, rng = path.read_bytes(), np.random.default_rng(0)
    for place in rng.integers(0, len(content), size=150):
        changed = bytearray(content)
        changed[place] ^= 1 << rng.integers(8)
        path.write_bytes(changed)
        with fails("a.nc: "):
            load_trajectory(path)


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("time", 9.0, "its times do not increase"),
        ("time", np.nan, "its times do not increase"),
        ("result", 77, "it has the result code 77"),
        ("residual", np.inf, "a solved row has a residual that is not finite"),
        ("iterations", -1, "a number of iterations is negative"),
        ("p", np.nan, "a solved row has a state that is not finite"),
    ],
)
def test_rows_that_no_simulation_has(path, name, value, reason):
    def change(file):
        file["result"][:] = 0
        values = file[name][:]
        values.flat[0] = value
        file[name][:] = values

    # NaN and infinity are in the first row of the random trajectory
    clean = load_trajectory(path)
    dataclasses.replace(clean, y=np.nan_to_num(clean.y, posinf=1.0)).save(path)
    edited(path, change)
    with fails("a.nc: not a trajectory that a simulation wrote", reason):
        load_trajectory(path)


def test_nothing_is_read_from_other_files(path, tmp_path):
    with h5py.File(tmp_path / "secret.h5", "w") as file:
        file["residual"] = np.full(4, 42.0)
    (tmp_path / "raw").write_bytes(np.full(4, 42.0).tobytes())
    os.mkfifo(tmp_path / "pipe")
    content = path.read_bytes()

    def replaced(make):
        path.write_bytes(content)

        def edit(file):
            del file["residual"]
            make(file)

        edited(path, edit)

    for other in ("secret.h5", "pipe"):
        replaced(
            lambda file, other=other: file.__setitem__("residual", h5py.ExternalLink(other, "/residual"))
        )
        with fails("a.nc: 'residual' is a link; allowed are variables"):
            load_trajectory(path)
    replaced(lambda file: file.__setitem__("residual", h5py.SoftLink("/time")))
    with fails("a.nc: 'residual' is a link; allowed are variables"):
        load_trajectory(path)
    external = [(str(tmp_path / "raw"), 0, 32)]
    replaced(lambda file: file.create_dataset("residual", (4,), "f8", external=external))
    with fails("a.nc: the data of 'residual' are in another file; not read"):
        load_trajectory(path)
    layout = h5py.VirtualLayout((4,), "f8")
    layout[:] = h5py.VirtualSource(str(tmp_path / "secret.h5"), "residual", (4,))
    replaced(lambda file: file.create_virtual_dataset("residual", layout))
    with fails("a.nc: the data of 'residual' are in another file; not read"):
        load_trajectory(path)
    replaced(lambda file: file.create_group("residual"))
    with fails("a.nc: 'residual' is a group; allowed are variables"):
        load_trajectory(path)


def test_variables_of_gigabytes_that_were_never_written_are_not_read(path):
    def enlarge(file):
        file.create_dataset("more", (2**30,), "f8", chunks=(2**20,))

    edited(path, enlarge)
    with fails("a.nc: its arrays take 8.59 GB; allowed are 0.1"):
        load_trajectory(path)


@pytest.mark.slow
def test_a_disk_that_fills_up_leaves_the_old_file_and_nothing_else(tmp_path):
    """The limit of a file's size stands for the full disk; HDF5 crashed the interpreter there."""
    script = """
import resource, signal, sys
from pathlib import Path
import knode_cosserat as kc
from tests.trajectories import synthetic
path = Path(sys.argv[1])
synthetic(seed=1).save(path)
before = path.read_bytes()
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
for most in (0, 1000, len(before) - 1):
    resource.setrlimit(resource.RLIMIT_FSIZE, (most, resource.RLIM_INFINITY))
    try:
        synthetic(seed=2).save(path)
    except ValueError as error:
        print(error)
    assert path.read_bytes() == before and list(path.parent.iterdir()) == [path]
"""
    done = subprocess.run(
        [sys.executable, "-c", script, str(tmp_path / "a.nc")], capture_output=True, text=True, cwd=ROOT
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("a.nc: cannot be written: File too large") == 3


def test_bytes_are_checked_before_hdf5_reads_them(path, monkeypatch):
    """A damaged internal list made HDF5 loop for ever."""
    content = bytearray(path.read_bytes())
    entry = content.index(b"GCOL") + 16
    content[entry : entry + 16] = bytes(16)
    path.write_bytes(content)
    monkeypatch.setattr(h5py, "File", None)
    with fails("damaged or changed: its bytes do not have their checksum"):
        load_trajectory(path)


def test_a_file_that_another_program_changed_is_refused(path):
    assert_same(load_trajectory(path), synthetic())
    xarray.load_dataset(path).to_netcdf(path, engine="h5netcdf")
    with fails("a.nc: truncated, or damaged, or written by another program"):
        load_trajectory(path)
