import os
import re
import subprocess
import sys
from pathlib import Path

import hypothesis.strategies as st
import numpy as np
import pytest
import xarray
from hypothesis import given, settings

import knode_cosserat as kc
from knode_cosserat import loading, trajectory
from knode_cosserat.io import container
from knode_cosserat.loading import load_trajectory
from tests.trajectories import (
    ROBOT,
    ROBOTS,
    Leapfrog,
    Pendulum,
    assert_same,
    edited,
    fails,
    stacked,
    synthetic,
)

# round trips


@pytest.mark.parametrize(
    "trajectory",
    [
        synthetic(),
        synthetic(steps=1),
        synthetic(settings=None),
        synthetic(robot=ROBOT.replace(nodes=5, shear_modulus=1e9, bending_stiffness=0.2)),
        synthetic(robot=ROBOT.replace(tendon_angles=[0.0, 2.0, 4.0])),
        synthetic(batch=(3,)),
        synthetic(batch=(1,), steps=1),
        synthetic(batch=(3,), robot=ROBOTS),
        synthetic(batch=(1,), robot=stacked(ROBOT)),
        synthetic(places=20),
        synthetic(batch=(3,), robot=ROBOTS, places=5),
    ],
    ids=lambda trajectory: f"{type(trajectory.system).__name__}{trajectory.y.shape}",
)
def test_trajectories_come_back_the_same(tmp_path, trajectory):
    trajectory.save(tmp_path / "a.nc")
    assert_same(kc.load_trajectory(tmp_path / "a.nc"), trajectory)
    assert_same(kc.load_trajectory(str(tmp_path / "a.nc")), trajectory)
    assert os.listdir(tmp_path) == ["a.nc"]


@pytest.mark.slow
@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2), st.integers(1, 6), st.integers(2, 12), st.integers(0, 2**32))
def test_trajectories_of_any_size_come_back_the_same(tmp_path_factory, batch, steps, nodes, seed):
    path = tmp_path_factory.mktemp("trajectories") / "a.nc"
    trajectory = synthetic((batch,) if batch else (), steps, nodes, seed=seed)
    trajectory.save(path)
    assert_same(load_trajectory(path), trajectory)


def test_a_simulation_comes_back_the_same(tmp_path):
    simulated = kc.simulate(ROBOT, kc.controls.sine(1.0, 5, 0.05), 0.05)
    simulated.save(tmp_path / "a.nc")
    loaded = kc.load_trajectory(tmp_path / "a.nc")
    assert_same(loaded, simulated)
    assert loaded.all_valid
    again = kc.simulate(loaded.system, loaded.held_tension[:-1], loaded.dt)
    assert np.array_equal(again.y, simulated.y)


@pytest.mark.parametrize(
    "chosen",
    [
        kc.solvers.Settings(time=kc.solvers.BDF1(), space=kc.solvers.Lobatto4(), start="consistent"),
        kc.solvers.Settings(
            time=kc.solvers.BDFAlpha(-1 / 3), newton=kc.solvers.NewtonOptions(tolerance=1 / 3e9, patience=2)
        ),
        kc.solvers.Settings(time=kc.solvers.Trapezoidal()),
        kc.solvers.Settings(time=None),
    ],
)
def test_settings_come_back_the_same(tmp_path, chosen):
    synthetic(settings=chosen).save(tmp_path / "a.nc")
    loaded = kc.load_trajectory(tmp_path / "a.nc").settings
    assert loaded == chosen
    assert type(loaded.time) is type(chosen.time)
    assert hash(loaded) == hash(chosen)


def test_a_users_scheme_is_found_while_it_exists(tmp_path):
    path = tmp_path / "a.nc"
    trajectory = synthetic(settings=kc.solvers.Settings(time=Leapfrog(0.25)))
    trajectory.save(path)
    assert_same(load_trajectory(path), trajectory)
    edited(path, facts=lambda text: text.replace("Leapfrog", "Hopfrog"))
    with fails("'settings' is not understood", "no TimeScheme is called 'Hopfrog'", "BDF2"):
        load_trajectory(path)


@pytest.mark.parametrize("batch", [(), (2,)])
def test_a_users_system_is_asked_for(tmp_path, batch):
    pendulum = Pendulum(0.5) if not batch else stacked(Pendulum(0.5), Pendulum(0.25))
    trajectory = synthetic(batch, robot=pendulum)
    trajectory.save(tmp_path / "a.nc")
    with fails("a.nc: the file does not describe its system, a Pendulum", "system=…"):
        load_trajectory(tmp_path / "a.nc")
    assert_same(load_trajectory(tmp_path / "a.nc", system=pendulum), trajectory)
    with fails("the variable 'p' is missing"):
        load_trajectory(tmp_path / "a.nc", system=ROBOT)


@pytest.mark.parametrize("batch", [(), (2,)])
@pytest.mark.parametrize("part", ["FunctionRouting", "FunctionSection"])
def test_a_robot_with_a_part_made_of_code_is_asked_for(tmp_path, part, batch):
    body = {"length": 0.5, "radius": 0.005, "density": 1000.0, "youngs_modulus": 1e6, "nodes": 5}
    robot = kc.robots.SlenderRod(**body, sections=(kc.robots.section.FunctionSection(),))
    if part == "FunctionRouting":
        routing = (kc.robots.routing.FunctionRouting(lambda s: (0.01 * s, 0.0 * s)),)
        robot = kc.robots.RoutedTendonRobot(**body, tendon_offset=0.01, tendon_angles=[0.0], routing=routing)
    robot = stacked(robot, robot.replace(length=0.25)) if batch else robot
    trajectory = synthetic(batch, robot=robot)
    trajectory.save(tmp_path / "a.nc")
    with fails("does not describe its system", f"(a {part} cannot be written", "made of code", "system=…"):
        load_trajectory(tmp_path / "a.nc")
    assert_same(load_trajectory(tmp_path / "a.nc", system=robot), trajectory)


class Measured(Pendulum):
    """A pendulum that a file can hold as text, its length in mm; longer ones cannot be written."""

    def to_bytes(self):
        if self.length > 0.9:
            raise ValueError("too long")
        return f"{float(self.length) * 1000:.0f} mm".encode()

    @staticmethod
    def read(data):
        try:
            return Measured(int(data.removesuffix(b" mm")) / 1000)
        except ValueError:
            raise ValueError(f"not a pendulum: {data!r}") from None


READERS = {"Measured": Measured.read}


@pytest.mark.parametrize(
    ("batch", "lengths"), [((), 0.5), ((2,), 0.5), ((3,), [0.5, 0.1, 0.025]), ((1,), [0.25])]
)
def test_a_system_of_bytes_is_in_the_file(tmp_path, batch, lengths):
    robot = Measured(lengths) if isinstance(lengths, float) else stacked(*map(Measured, lengths))
    moved = synthetic(batch, robot=robot)
    moved.save(tmp_path / "a.nc")
    assert_same(trajectory.load_trajectory(tmp_path / "a.nc", readers=READERS), moved)
    assert_same(load_trajectory(tmp_path / "a.nc", system=robot), moved)
    with fails("there is no reader of its system, a Measured: give it"):
        load_trajectory(tmp_path / "a.nc")


def test_a_system_that_cannot_be_written_is_asked_for(tmp_path):
    for pendulum in (Measured(0.95), stacked(Measured(0.5), Measured(0.95))):
        moved = synthetic((2,), robot=pendulum)
        moved.save(tmp_path / "a.nc")
        with fails("does not describe its system, a Measured (too long)", "system=…"):
            trajectory.load_trajectory(tmp_path / "a.nc", readers=READERS)
        assert_same(load_trajectory(tmp_path / "a.nc", system=pendulum), moved)


def test_bytes_of_systems_that_are_not_right(tmp_path):
    path = tmp_path / "a.nc"
    for readers, parts in (
        ({"Measured": lambda data: Measured.read(data[1:])}, ("a Measured: not a pendulum", "or give it")),
        ({"Measured": lambda data: ROBOT if data == b"25 mm" else Measured.read(data)}, ("or give it",)),
    ):
        synthetic((2,), robot=stacked(Measured(0.005), Measured(0.025))).save(path)
        with fails("a.nc: its system, ", *parts):
            trajectory.load_trajectory(path, readers=readers)


def test_reading_asks_nothing_of_pickle_or_eval():
    for module in (trajectory, loading, container):
        source = Path(module.__file__).read_text(encoding="utf-8")
        assert not re.search(r"\b(pickle|eval|exec|import_module)\b", source)


# labels


def test_labels(tmp_path):
    trajectory = synthetic((2,), steps=3)
    trajectory.save(tmp_path / "a.nc")
    with xarray.open_dataset(tmp_path / "a.nc") as data:
        assert dict(data.sizes) == {
            "batch": 2,
            "time": 3,
            "node": 5,
            "axis": 3,
            "quaternion": 4,
            "tension_index": 4,
        }
        assert data["p"].dims == ("batch", "time", "node", "axis")
        assert data["h"].dims == ("batch", "time", "node", "quaternion")
        assert data["tension"].dims == ("batch", "time", "tension_index")
        assert data["result"].dims == ("batch", "time")
        assert data["p"].attrs == {"units": "m", "long_name": "position, global frame"}
        assert set(data.coords) == {"time", "arclength", "axis", "quaternion", "tension_index"}
        assert {name: data[name].attrs["units"] for name in ("time", "arclength", "n", "u", "tension")} == {
            "time": "s",
            "arclength": "m",
            "n": "N",
            "u": "1/m",
            "tension": "N",
        }
        assert all(data[name].attrs["long_name"] for name in data.data_vars)
        assert np.array_equal(data["time"], trajectory.time)
        assert np.array_equal(data["arclength"], trajectory.arclength)
        tip = data["p"].isel(node=-1).sel(axis="z", batch=1)
        assert np.array_equal(tip, trajectory.tip_position[1, :, 2])
        assert data["tension_index"].values.tolist() == [1, 2, 3, 4]
        flags = dict(
            zip(data["result"].flag_meanings.split(), data["result"].flag_values.tolist(), strict=True)
        )
        assert flags["converged"] == 0
        assert flags["no_convergence"] == int(kc.Result.NO_CONVERGENCE)
        assert data["result"].flag_values.dtype == data["result"].dtype
        assert data.attrs["format"] == "knode-cosserat trajectory"
        assert data.attrs["format_version"] == 1
        assert "length: 0.635  # m" in data.attrs["robot"]
        assert '"scheme":"SDIRK2"' in data.attrs["facts"]
        assert {"title", "knode_cosserat_version"} <= set(data.attrs)


def test_labels_of_a_batch_of_robots(tmp_path):
    synthetic((3,), robot=ROBOTS).save(tmp_path / "a.nc")
    with xarray.open_dataset(tmp_path / "a.nc") as data:
        assert data["arclength"].dims == ("batch", "node")
        assert data["robot_length"].values.tolist() == [0.635, 0.4, 0.635]
        assert data["robot_length"].attrs == {"units": "m", "long_name": "length of the rod"}
        assert data["robot_drag"].shape == (3, 3, 3)
        assert "robot_shear_modulus" not in data


def test_importing_the_package_loads_no_file_libraries():
    code = "import sys, knode_cosserat; print({'xarray', 'h5py', 'pandas'} & set(sys.modules))"
    ran = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert ran.stdout == "set()\n"
