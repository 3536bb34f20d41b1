"""Poses of many equilibria: each is `kc.equilibrium`'s, and none is wrong in silence."""

import csv
import importlib
import subprocess
import sys

import numpy as np
import pytest
import xarray

import knode_cosserat as kc

ROBOT = kc.load_robot("delrin-tendon-robot")


@pytest.fixture(scope="module")
def found():
    return kc.workspace(ROBOT, 0.0, [10.0, 8.0, 6.0, 4.0], 40, seed=3)


def test_every_sample_is_the_equilibrium_of_its_control(found):
    for i in range(0, 40, 4):
        alone = kc.equilibrium(ROBOT, found.controls[i])
        np.testing.assert_allclose(found.position[i], alone.tip_position[0], atol=1e-9)
        np.testing.assert_allclose(found.quaternion[i], alone.quaternion[0, -1], atol=1e-9)
        bent = np.max(np.linalg.norm(alone.part("u")[0], axis=-1))
        assert found.peak("u")[i] == pytest.approx(bent, rel=1e-7)
    assert found.unsolved == 0
    assert np.all(found.residual <= 1e-8)


def test_interrupted_samples_are_kept(found, monkeypatch):
    """Those of the chunks that were computed, with their own controls."""
    module = importlib.import_module("knode_cosserat.statics.workspace")
    solve, calls = module.equilibrium_poses, []

    def solve_twice(*arguments):
        calls.append(None)
        if len(calls) > 2:
            raise KeyboardInterrupt
        return solve(*arguments)

    monkeypatch.setattr(module, "equilibrium_poses", solve_twice)
    monkeypatch.setattr(module, "usable_cores", lambda: 5)
    with pytest.raises(KeyboardInterrupt) as caught:
        kc.workspace(ROBOT, 0.0, [10.0, 8.0, 6.0, 4.0], 40, seed=3)
    best = caught.value.best
    assert len(best.controls) == 16 and best.unsolved == 0
    places = [int(np.flatnonzero(np.all(found.controls == each, axis=1))[0]) for each in best.controls]
    assert len(set(places)) == 16
    np.testing.assert_allclose(best.position, found.position[places], atol=1e-9)


def test_samples_fill_the_box_and_follow_the_seed(found):
    high = [10.0, 8.0, 6.0, 4.0]
    assert np.all(found.controls >= 0.0) and np.all(found.controls <= high)
    first = found.controls[:32] / high
    # each sixteenth of every axis has two of the first 32 points of a Sobol sequence
    for axis in range(4):
        np.testing.assert_array_equal(np.histogram(first[:, axis], bins=16, range=(0, 1))[0], 2)
    again, other = (kc.workspace(ROBOT, 0.0, high, 40, seed=seed) for seed in (3, 4))
    np.testing.assert_array_equal(again.position, found.position)
    assert np.any(other.controls != found.controls)


def test_limits_may_be_given_by_name(found):
    named = kc.workspace(ROBOT, low=0.0, high=[10.0, 8.0, 6.0, 4.0], count=40, seed=3)
    np.testing.assert_array_equal(named.position, found.position)
    either = r"allowed is workspace\(robot, controls\) or"
    for wrong in ({}, {"low": 0.0}, {"low": 0.0, "high": 1.0}, {"controls": np.ones((2, 4)), "low": 0.0}):
        with pytest.raises(ValueError, match=either):
            kc.workspace(ROBOT, **wrong)
    with pytest.raises(ValueError, match=either):
        kc.workspace(ROBOT, np.ones((2, 4)), 1.0, 8, low=0.0)


def test_limits_of_strain_leave_samples_out(found):
    limit = np.median(found.peak("u"))
    inside = found.within(u=limit, v=0.1)
    assert inside.sum() == 20
    np.testing.assert_array_equal(inside, found.peak("u") <= limit)
    with pytest.raises(ValueError, match="no strain 'curvature'; there are v, u"):
        found.within(curvature=1.0)


@pytest.mark.slow
def test_what_has_no_equilibrium_is_nan_and_counted():
    """Tensions so large that the equations overflow, among others."""
    controls = np.array([[1.0, 0.0, 0.0, 0.0], [1e160, 0.0, 0.0, 0.0], [0.0, 2.0, 0.0, 0.0]])
    found = kc.workspace(ROBOT, controls)
    np.testing.assert_array_equal(found.valid, [True, False, True])
    assert str(found.result) == "[CONVERGED NO_CONVERGENCE CONVERGED]"
    assert found.unsolved == 1
    assert np.all(np.isnan(found.position[1])) and np.all(np.isnan(found.quaternion[1]))
    assert not found.within(u=np.inf)[1]
    for i in (0, 2):
        alone = kc.equilibrium(ROBOT, controls[i]).tip_position[0]
        np.testing.assert_allclose(found.position[i], alone, atol=1e-9)


def test_files_hold_what_was_found(found, tmp_path):
    for name in ("a.nc", "a.csv", "a.npz"):
        found.save(tmp_path / name)
    with xarray.open_dataset(tmp_path / "a.nc", engine="h5netcdf") as read:
        np.testing.assert_array_equal(read["position"], found.position)
        assert read["position"].attrs["units"] == "m"
    with np.load(tmp_path / "a.npz") as read:
        np.testing.assert_array_equal(read["quaternion"], found.quaternion)
        np.testing.assert_array_equal(read["control"], found.controls)
    with open(tmp_path / "a.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 40
    assert float(rows[7]["position_2"]) == found.position[7, 2]
    assert float(rows[7]["tension_4 [N]"]) == found.controls[7, 3]
    with pytest.raises(ValueError, match=r"a\.txt: allowed is a name that ends in \.nc, \.csv, \.npz"):
        found.save(tmp_path / "a.txt")


def test_a_full_disk_leaves_the_old_files(tmp_path):
    """The limit of a file's size stands for the full disk, on which HDF5 ended the process."""
    script = """
import os, resource, signal
import numpy as np
from pathlib import Path
import knode_cosserat as kc
from knode_cosserat.statics.workspace import Workspace
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
robot, count = kc.load_robot("delrin-tendon-robot"), 40
one = lambda *shape: np.random.default_rng(0).normal(size=(count, *shape))
found = Workspace(robot, one(4), one(3), one(4), np.zeros(count, int), one(), one(6))
names = "a.nc", "a.csv", "a.npz"
for name in names:
    found.save(name)
before = [Path(name).read_bytes() for name in names]
for most in (0, 1000, 3000):
    resource.setrlimit(resource.RLIMIT_FSIZE, (most, resource.RLIM_INFINITY))
    for name in names:
        try:
            found.save(name)
        except OSError as error:
            print(error.strerror)
assert [Path(name).read_bytes() for name in names] == before and sorted(os.listdir()) == sorted(names)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0 and done.stdout == 9 * "File too large\n", done.stderr


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([1.0, 2.0, 3.0, 4.0],), r"controls have shape \(4,\); allowed is \(B, 4\)"),
        ((np.full((3, 4), np.nan),), r"controls is nan at index \(0, 0\)"),
        ((0.0, 10.0), r"allowed is workspace\(robot, controls\) or"),
        ((0.0, 10.0, 0), "count is 0; allowed is a whole number"),
        ((0.0, 10.0, 2.5), "count is 2.5; allowed is a whole number"),
        ((5.0, [10.0, 4.0, 10.0, 10.0], 8), "low is 5 and high 4 for control 1"),
        (("a", 10.0, 8), "low is not numbers"),
    ],
)
def test_wrong_arguments_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        kc.workspace(ROBOT, *arguments)
