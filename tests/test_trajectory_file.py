import dataclasses
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any, ClassVar

import h5py
import hypothesis.strategies as st
import jax
import numpy as np
import pytest
import xarray
from hypothesis import given, settings

import knode_cosserat as kc
from knode_cosserat import trajectory_file
from knode_cosserat.rods.parameters import parameter
from knode_cosserat.solvers.time import Static, TimeScheme
from knode_cosserat.trajectory_file import TrajectoryFileError, load_trajectory, save

ROBOT = kc.load_robot("delrin-tendon-robot")
PAPER = kc.Settings()
ARRAYS = ("time", "y", "z", "control", "result", "residual", "iterations")


def fails(*parts):
    """A `TrajectoryFileError` of one line that has all the parts, in order."""
    return pytest.raises(TrajectoryFileError, match=r"^(?!.*\n).*" + ".*".join(map(re.escape, parts)))


def assert_same(a, b):
    """Equal to the last bit, the sign of zeros and the payload of NaN included."""
    for name in ARRAYS:
        one, other = np.asarray(getattr(a, name)), np.asarray(getattr(b, name))
        assert (one.dtype, one.shape) == (other.dtype, other.shape), name
        assert one.tobytes() == other.tobytes(), name
    assert a.settings == b.settings
    assert jax.tree.structure(a.system) == jax.tree.structure(b.system)
    for one, other in zip(jax.tree.leaves(a.system), jax.tree.leaves(b.system), strict=True):
        assert np.array_equal(one, other)


def synthetic(batch=(), steps=4, nodes=5, robot=ROBOT, settings=PAPER, seed=0):
    """A trajectory of random numbers, and of what a file could spoil: -0, NaN, infinity, a subnormal."""
    rng = np.random.default_rng(seed)
    rows = (*batch, steps)
    y = rng.normal(size=(*rows, nodes, robot.y_layout.size))
    y.flat[:4] = [-0.0, np.nan, np.inf, 5e-324]
    return kc.Trajectory(
        system=robot,
        settings=settings,
        time=0.3 + np.arange(steps) * 0.1,
        y=y,
        z=rng.normal(size=(*rows, nodes, robot.z_layout.size)),
        control=rng.uniform(size=(*rows, robot.control_size)),
        result=rng.choice([int(result) for result in kc.Result], size=rows),
        residual=rng.normal(size=rows),
        iterations=rng.integers(0, 100, size=rows),
    )


def stacked(*robots):
    return jax.tree.map(lambda *leaves: np.stack(leaves), *robots)


ROBOTS = stacked(
    ROBOT,
    ROBOT.replace(length=0.4, drag=[1.0, 2.0, 3.0], gravity=[0.0, 0.0, 0.0]),
    ROBOT.replace(youngs_modulus=1e9 / 3, tendon_angles=[0.1, 0.2, 0.3, 0.4]),
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
    ],
    ids=lambda trajectory: f"{type(trajectory.system).__name__}{trajectory.y.shape}",
)
def test_trajectories_come_back_the_same(tmp_path, trajectory):
    trajectory.save(tmp_path / "a.nc")
    assert_same(kc.load_trajectory(tmp_path / "a.nc"), trajectory)
    assert_same(kc.load_trajectory(str(tmp_path / "a.nc")), trajectory)
    assert os.listdir(tmp_path) == ["a.nc"]


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2), st.integers(1, 6), st.integers(2, 12), st.integers(0, 2**32))
def test_trajectories_of_any_size_come_back_the_same(tmp_path_factory, batch, steps, nodes, seed):
    path = tmp_path_factory.mktemp("trajectories") / "a.nc"
    trajectory = synthetic((batch,) if batch else (), steps, nodes, seed=seed)
    save(trajectory, path)
    assert_same(load_trajectory(path), trajectory)


def test_a_simulation_comes_back_the_same(tmp_path):
    simulated = kc.simulate(ROBOT, kc.controls.sine(1.0, 5, 0.05), 0.05)
    simulated.save(tmp_path / "a.nc")
    loaded = kc.load_trajectory(tmp_path / "a.nc")
    assert_same(loaded, simulated)
    assert loaded.all_valid
    again = kc.simulate(loaded.system, loaded.tension[1:], loaded.dt)
    assert np.array_equal(again.y, simulated.y)


@pytest.mark.parametrize(
    "chosen",
    [
        kc.Settings(time=kc.BDF1(), space=kc.RK4(), start="consistent"),
        kc.Settings(time=kc.BDFAlpha(-1 / 3), newton=kc.NewtonOptions(tolerance=1 / 3e9, patience=2)),
        kc.Settings(time=kc.Trapezoidal()),
        kc.Settings(time=Static()),
    ],
)
def test_settings_come_back_the_same(tmp_path, chosen):
    synthetic(settings=chosen).save(tmp_path / "a.nc")
    loaded = kc.load_trajectory(tmp_path / "a.nc").settings
    assert loaded == chosen
    assert type(loaded.time) is type(chosen.time)
    assert hash(loaded) == hash(chosen)


@dataclasses.dataclass(frozen=True)
class Leapfrog(TimeScheme):
    """A user's scheme."""

    weight: float = 0.5
    order = 2

    def coefficients(self, dt, previous_dt):
        raise NotImplementedError


def test_a_users_scheme_is_found_while_it_exists(tmp_path):
    path = tmp_path / "a.nc"
    trajectory = synthetic(settings=kc.Settings(time=Leapfrog(0.25)))
    save(trajectory, path)
    assert_same(load_trajectory(path), trajectory)
    with h5py.File(path, "a") as file:
        file.attrs["settings"] = file.attrs["settings"].replace("Leapfrog", "Hopfrog")
    with fails("attribute 'settings'", "no TimeScheme is called 'Hopfrog'", "BDF2"):
        load_trajectory(path)


class Pendulum(kc.System):
    """A class that no robot file can name, with z and controls that hold nothing."""

    y_layout: ClassVar[kc.Layout] = kc.Layout(("angle", 1, "rad", "angle"), ("force", 3, "N", "force"))
    z_layout: ClassVar[kc.Layout] = kc.Layout()
    control_layout: ClassVar[kc.Layout] = kc.Layout()
    base_unknowns: ClassVar[tuple[str, ...]] = ()
    length: Any = parameter("m", "length", low=0.0, high=1.0)

    def rest(self, s):
        return np.zeros(4), np.zeros(0)

    def tip(self, t, control, y, history):
        return np.zeros(0)


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


@pytest.fixture
def codec(monkeypatch):
    """Pendulums as text, whose length in mm a file can hold; longer ones cannot be written."""

    def encode(pendulum, source):
        if pendulum.length > 0.9:
            raise ValueError(f"{source}: too long")
        return f"{float(pendulum.length) * 1000:.0f} mm".encode()

    def decode(data, source):
        try:
            return Pendulum(int(data.removesuffix(b" mm")) / 1000)
        except ValueError:
            raise ValueError(f"{source}: not a pendulum: {data!r}") from None

    monkeypatch.setattr(trajectory_file, "_codecs", {})
    trajectory_file.register_codec(Pendulum, encode, decode)


@pytest.mark.parametrize(
    ("batch", "lengths"),
    [((), 0.5), ((2,), 0.5), ((3,), [0.5, 0.1, 0.025]), ((1,), [0.25])],
)
def test_a_system_with_a_codec_is_in_the_file(tmp_path, codec, batch, lengths):
    robot = Pendulum(lengths) if isinstance(lengths, float) else stacked(*map(Pendulum, lengths))
    trajectory = synthetic(batch, robot=robot)
    trajectory.save(tmp_path / "a.nc")
    assert_same(load_trajectory(tmp_path / "a.nc"), trajectory)
    assert_same(load_trajectory(tmp_path / "a.nc", system=robot), trajectory)


def test_what_a_codec_cannot_write_is_asked_for(tmp_path, codec):
    for pendulum in (Pendulum(0.95), stacked(Pendulum(0.5), Pendulum(0.95))):
        trajectory = synthetic((2,), robot=pendulum)
        trajectory.save(tmp_path / "a.nc")
        with fails("does not describe its system, a Pendulum (a Pendulum: too long)", "system=…"):
            load_trajectory(tmp_path / "a.nc")
        assert_same(load_trajectory(tmp_path / "a.nc", system=pendulum), trajectory)


def test_bytes_of_systems_that_are_not_right(tmp_path, codec, monkeypatch):
    path = tmp_path / "a.nc"
    robots = stacked(Pendulum(0.5), Pendulum(0.025))
    synthetic((2,), robot=robots).save(path)
    data = xarray.load_dataset(path, decode_cf=False)
    assert data["system_sizes"].values.tolist() == [6, 5]
    for sizes in ([6, 6], [11, 0], [-1, 12], [2**62, 2**62], [6.0, 5.0]):
        changed = data.assign(system_sizes=("batch", np.array(sizes)))
        changed.to_netcdf(path, engine="h5netcdf")
        with fails("a.nc: the variable 'system_bytes' does not hold what it should"):
            load_trajectory(path)
    data.assign(system_sizes=("batch", [5, 6])).to_netcdf(path, engine="h5netcdf")
    with fails("a.nc: variable 'system_bytes': not a pendulum: b'500 m'", "or give it", "system=…"):
        load_trajectory(path)
    data.drop_vars("system_sizes").to_netcdf(path, engine="h5netcdf")
    with fails("a.nc: variable 'system_bytes': not a pendulum: b'500 mm25 mm'"):
        load_trajectory(path)
    data.assign(system_bytes=("system_byte", np.zeros(11))).to_netcdf(path, engine="h5netcdf")
    with fails("the variable 'system_bytes' does not hold"):
        load_trajectory(path)
    data.to_netcdf(path, engine="h5netcdf")
    monkeypatch.setattr(trajectory_file, "_codecs", {})
    with fails("nothing that is imported here reads its system, a Pendulum: give it"):
        load_trajectory(path)


def test_reading_asks_nothing_of_pickle_or_eval():
    source = Path(trajectory_file.__file__).read_text(encoding="utf-8")
    assert not re.search(r"\b(pickle|eval|exec|import_module)\b", source)


# labels


def test_labels(tmp_path):
    trajectory = synthetic((2,), steps=3)
    trajectory.save(tmp_path / "a.nc")
    with xarray.open_dataset(tmp_path / "a.nc") as data:
        assert dict(data.sizes) == {
            "batch": 2, "time": 3, "node": 5, "axis": 3, "quaternion": 4, "tension_index": 4,
        }  # fmt: skip
        assert data["p"].dims == ("batch", "time", "node", "axis")
        assert data["h"].dims == ("batch", "time", "node", "quaternion")
        assert data["tension"].dims == ("batch", "time", "tension_index")
        assert data["result"].dims == ("batch", "time")
        assert data["p"].attrs == {"units": "m", "long_name": "position, global frame"}
        assert {name: data[name].attrs["units"] for name in ("time", "arclength", "n", "u", "tension")} == {
            "time": "s", "arclength": "m", "n": "N", "u": "1/m", "tension": "N",
        }  # fmt: skip
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
        assert '"scheme": "BDF2"' in data.attrs["settings"]
        assert {"title", "knode_cosserat_version"} <= set(data.attrs)


def test_labels_of_a_batch_of_robots(tmp_path):
    synthetic((3,), robot=ROBOTS).save(tmp_path / "a.nc")
    with xarray.open_dataset(tmp_path / "a.nc") as data:
        assert data["arclength"].dims == ("batch", "node")
        assert data["robot_length"].values.tolist() == [0.635, 0.4, 0.635]
        assert data["robot_length"].attrs == {"units": "m", "long_name": "length of the rod"}
        assert data["robot_drag"].shape == (3, 3, 3)
        assert "robot_shear_modulus" not in data


# errors


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "a.nc"
    synthetic().save(path)
    return path


def edited(path, edit):
    with h5py.File(path, "a") as file:
        edit(file)
    return path


def test_files_that_are_something_else(tmp_path, path):
    with fails("nothing.nc: no such file"):
        load_trajectory(tmp_path / "nothing.nc")
    with fails(str(tmp_path), "cannot be read"):
        load_trajectory(tmp_path)
    for content in (b"", b"CDF\x01 an older netCDF", b"time,p\n0,1\n"):
        (tmp_path / "other.nc").write_bytes(content)
        with fails("other.nc: not a netCDF-4 file"):
            load_trajectory(tmp_path / "other.nc")
    xarray.Dataset({"p": ("time", [1.0, 2.0])}).to_netcdf(tmp_path / "foreign.nc", engine="h5netcdf")
    with fails("foreign.nc: not a trajectory of this package"):
        load_trajectory(tmp_path / "foreign.nc")
    with h5py.File(tmp_path / "plain.h5", "w") as file:
        file["a"] = np.zeros((3, 3))
    with fails("plain.h5: not a trajectory of this package"):
        load_trajectory(tmp_path / "plain.h5")


@pytest.mark.parametrize("part", [0.1, 0.5, 0.9, 0.999])
def test_truncated_files(path, part):
    content = path.read_bytes()
    path.write_bytes(content[: int(part * len(content))])
    with fails("a.nc: truncated or damaged: "):
        load_trajectory(path)


# h5netcdf stumbles once more when what it could not open is collected
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
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


def test_newer_and_older_versions(path):
    edited(path, lambda file: file.attrs.__setitem__("format_version", 2))
    edited(path, lambda file: file.attrs.__setitem__("knode_cosserat_version", "9.1"))
    with fails("a.nc: format_version is 2; allowed is 1", "knode-cosserat 9.1"):
        load_trajectory(path)
    edited(path, lambda file: file.attrs.__delitem__("format_version"))
    with fails("a.nc: format_version is None; allowed is 1"):
        load_trajectory(path)


@pytest.mark.parametrize("name", ["time", "p", "u", "tension", "result", "residual", "iterations"])
def test_missing_variables(path, name):
    data = xarray.load_dataset(path, decode_cf=False)
    data.drop_vars(name).to_netcdf(path, engine="h5netcdf")
    with fails(f"a.nc: the variable '{name}' is missing"):
        load_trajectory(path)


def test_variables_of_another_shape_or_type(path):
    data = xarray.load_dataset(path, decode_cf=False)
    data.assign(n=(("time", "node", "a"), data["n"].values[..., :2])).to_netcdf(path, engine="h5netcdf")
    with fails("a.nc: the variable 'n' has shape (4, 5, 2); allowed is (4, 5, 3)"):
        load_trajectory(path)
    data.assign(residual=data["result"].astype(str)).to_netcdf(path, engine="h5netcdf")
    with fails("a.nc: the variable 'residual' has type", "allowed is numbers"):
        load_trajectory(path)
    data.assign(time=("time", np.zeros(4, dtype="S1"))).to_netcdf(path, engine="h5netcdf")
    with fails("a.nc: the variable 'time' has"):
        load_trajectory(path)


@pytest.mark.parametrize(
    ("name", "value", "parts"),
    [
        ("robot", "format: 1\nkind: tendon-robt", ["attribute 'robot': ", "is missing"]),
        ("robot", "[", ["attribute 'robot': line ", "not YAML"]),
        ("robot", "format: 3\nkind: a\nparameters:\n", ["attribute 'robot': format is 3"]),
        ("settings", "{", ["attribute 'settings' is not understood"]),
        ("settings", "{}", ["attribute 'settings' is not understood", "time"]),
        ("settings", "[1]", ["attribute 'settings' is not understood"]),
        (
            "settings",
            '{"time": {"scheme": "BDFAlpha", "alpha": 2.0}}',
            ["attribute 'settings'", "alpha is 2.0"],
        ),
        ("settings", '{"time": {"scheme": "BDF1", "magic": 2.0}}', ["attribute 'settings'", "magic"]),
        ("settings", '{"time": {"scheme": "os.system"}}', ["attribute 'settings'", "'os.system'"]),
    ],
)
def test_attributes_that_are_not_right(path, name, value, parts):
    edited(path, lambda file: file.attrs.__setitem__(name, value))
    with fails("a.nc: ", *parts):
        load_trajectory(path)


def test_robots_of_a_batch_that_are_not_right(tmp_path):
    path = tmp_path / "a.nc"
    synthetic((3,), robot=ROBOTS).save(path)
    edited(path, lambda file: file["robot_length"].__setitem__(1, -1.0))
    with fails("a.nc: a robot of the batch is not possible: length is -1.0", "0.001 to 20 m"):
        load_trajectory(path)
    data = xarray.load_dataset(path, decode_cf=False)
    data.drop_vars("robot_drag").to_netcdf(path, engine="h5netcdf")
    with fails("a.nc: the variable 'robot_drag' is missing"):
        load_trajectory(path)


def test_what_cannot_be_saved(tmp_path):
    trajectory = synthetic()
    with fails("a.nc: cannot be written: No such file or directory"):
        trajectory.save(tmp_path / "no" / "a.nc")
    (tmp_path / "folder.nc").mkdir()
    with fails("folder.nc: cannot be written"):
        trajectory.save(tmp_path / "folder.nc")
    with fails("the trajectory's arrays do not fit together", "time"):
        dataclasses.replace(trajectory, residual=np.zeros(3)).save(tmp_path / "a.nc")
    with fails("the settings cannot be written"):
        synthetic(settings=kc.Settings(time=Leapfrog(object()))).save(tmp_path / "a.nc")
    assert os.listdir(tmp_path) == ["folder.nc"]


@pytest.mark.parametrize(
    "name", ["time", "result", "a/b", "force", "robot_length", "force_index", "system_bytes", "system_sizes"]
)
def test_fields_whose_names_are_taken(tmp_path, monkeypatch, name):
    layout = kc.Layout(("angle", 1, "rad", "angle"), ("force", 3, "N", "force"), (name, 1, "1", "taken"))
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


def test_importing_the_package_loads_no_file_libraries():
    code = "import sys, knode_cosserat; print({'xarray', 'h5py', 'pandas'} & set(sys.modules))"
    ran = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert ran.stdout == "set()\n"
