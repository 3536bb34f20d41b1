"""Names, errors and texts that every user meets."""

import importlib
import inspect
import pkgutil
import subprocess
import sys
import types
from typing import Any, ClassVar

import jax
import numpy as np
import pytest

import knode_cosserat as kc
import knode_cosserat_hardware as kch
from knode_cosserat.learning.residual import Nothing
from knode_cosserat.statics.configuration import Ellipsoid, Manipulability

SPACES = [thing for name in sorted(kc.__all__) if isinstance(thing := getattr(kc, name), types.ModuleType)]
#: first words of a docstring that says nothing on its own
VAGUE = {"What", "Whether", "That", "Those", "How", "Of"}
#: errors of computations; all others are of arguments
RUNNING = {kc.SimulationError, kc.estimation.ObserverError, kch.HardwareError, kch.StoppedError}
ROBOT = kc.load_robot("delrin-tendon-robot")


def names_of(space):
    """The public names of a namespace; of a module without a list, all that it defines."""
    if hasattr(space, "__all__"):
        return list(space.__all__)
    return [
        name
        for name, thing in vars(space).items()
        if not name.startswith("_") and getattr(thing, "__module__", None) == space.__name__
    ]


# names


def test_the_top_level_is_small_and_lists_itself():
    assert dir(kc) == sorted(kc.__all__) and len(set(kc.__all__)) == len(kc.__all__) <= 40
    assert all(hasattr(kc, name) for name in kc.__all__)


@pytest.mark.parametrize("module", [kc, kch, *SPACES], ids=lambda module: module.__name__)
def test_every_public_name_is_there_and_says_what_it_is(module):
    assert names_of(module)
    for name in names_of(module):
        thing = getattr(module, name)
        said = inspect.getdoc(thing) if callable(thing) or inspect.ismodule(thing) else "A constant."
        assert said and said.split()[0] not in VAGUE, f"{module.__name__}.{name}: {said}"


@pytest.mark.parametrize("space", [kc, kc.solvers, kc.recordings, kch])
def test_a_lazy_package_has_the_names_that_it_lists(space):
    assert dir(space) == sorted(space.__all__)
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        space.nothing  # noqa: B018


def test_functions_win_over_the_modules_that_are_called_like_them():
    program = (
        "import knode_cosserat.solvers.simulate, knode_cosserat.identification.fit\n"
        "import knode_cosserat.statics.workspace\n"
        "import knode_cosserat as kc\n"
        "assert kc.solvers.simulate is kc.simulate and kc.solvers.equilibrium is kc.equilibrium\n"
        "assert kc.identification.fit is kc.fit\n"
        "assert kc.statics.workspace is kc.workspace and kc.identification.identify is kc.identify\n"
    )
    subprocess.run([sys.executable, "-W", "error", "-c", program], check=True)


@pytest.mark.parametrize("use", ["found.save('it.nc')", "kc.load_trajectory('it.nc')", "kc.viewer.view"])
def test_a_process_that_imports_nothing_else_finds_what_it_uses(use, tmp_path):
    program = "import knode_cosserat as kc\nrobot = kc.load_robot('delrin-tendon-robot')\n"
    program += "found = kc.simulate(robot, [[4.0] * 4] * 2, 0.05)\n"
    setup = "" if "save" in use else "found.save('it.nc')\n"
    subprocess.run([sys.executable, "-c", program + setup + use], check=True, cwd=tmp_path)


def test_a_model_and_its_motion_are_read_by_another_process(tmp_path):
    robot = kc.load_robot("delrin-tendon-robot")
    truth = kc.simulate(robot.replace(length=0.6), kc.controls.sine(1.5, 20, 0.05), 0.05)
    model = kc.fit(robot, [truth], kc.FitConfig())
    kc.simulate(model, truth.control[1:], 0.05).save(tmp_path / "it.nc")
    model.save(tmp_path / "it.model")
    program = (
        "import knode_cosserat as kc\n"
        "assert type(kc.load_trajectory('it.nc').system).__name__ == 'KNODE'\n"
        "kc.load_model('it.model').save('again.model')\n"
    )
    subprocess.run([sys.executable, "-c", program], check=True, cwd=tmp_path)


def test_a_name_that_never_was_is_an_attribute_error():
    with pytest.raises(AttributeError, match="has no attribute 'simulatee'"):
        kc.simulatee  # noqa: B018


# errors


def modules():
    """All modules of both packages that can be imported here."""
    for package in (kc, kch):
        for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            if found.name.endswith("__main__"):
                continue
            try:
                yield importlib.import_module(found.name)
            except ModuleNotFoundError as error:
                if error.name is None or error.name.startswith(kc.__name__):
                    raise
                # otherwise an extra is not installed


def errors():
    return {
        thing
        for module in modules()
        for thing in vars(module).values()
        if isinstance(thing, type)
        and issubclass(thing, BaseException)
        and not issubclass(thing, Warning)
        and thing.__module__.startswith(kc.__name__)
    }


def test_all_errors_have_one_base_and_a_code_each():
    found = errors()
    assert kc.SimulationError in found and kc.robots.ParameterError in found
    assert all(issubclass(error, kc.KnodeCosseratError) for error in found)
    codes = [error.code for error in found]
    assert len(set(codes)) == len(codes)
    assert all(code == code.lower() and code.replace("-", "").isalpha() for code in codes)
    assert kc.SimulationError.code == "simulation" and kc.robots.RobotFileError.code == "robot-file"


def test_public_errors_keep_their_built_in_bases():
    public = [
        kc.TrajectoryFileError,
        *(getattr(space, name) for space in [*SPACES, kch] for name in names_of(space)),
    ]
    raised = [thing for thing in public if isinstance(thing, type) and issubclass(thing, Exception)]
    assert len(raised) > 10
    for error in raised:
        assert issubclass(error, RuntimeError if error in RUNNING else ValueError)
    with pytest.raises(ValueError, match="length"):
        ROBOT.replace(length=-1.0)
    with pytest.raises(kc.KnodeCosseratError) as caught:
        ROBOT.replace(length=-1.0)
    assert caught.value.code == "parameter"


# texts


class Hanging(kc.System):
    """A system that a user may write: nothing about it is ours."""

    y_layout: ClassVar[Any] = kc.robots.Layout(("angle", 1, "rad", "angle"))
    z_layout: ClassVar[Any] = kc.robots.Layout()
    control_layout: ClassVar[Any] = kc.robots.Layout()
    base_unknowns: ClassVar[tuple[str, ...]] = ()

    mass: Any = kc.robots.parameter("kg", "its mass", low=0.0, high=9.0)
    length: Any = kc.robots.parameter("m", "its length", low=0.0, high=1.0, default=0.5)
    anything: Any = None

    def rest(self, s):
        raise NotImplementedError

    def tip(self, t, control, y, y_t):
        raise NotImplementedError


class Odd:
    """Nothing can be found out about it."""

    def __array__(self, *_, **__):
        raise RuntimeError("no array")

    def __repr__(self):
        raise RuntimeError("no text")


@pytest.fixture(scope="module")
def rest():
    return kc.equilibrium(ROBOT, [2.0, 0.0, 0.0, 0.0])


@pytest.fixture(scope="module")
def motion():
    return kc.simulate(ROBOT, kc.controls.sine(1.5, 4, 0.05), 0.05)


def short(thing, *expected):
    """The text of an object; it is short, has no array, and has what is expected."""
    text = repr(thing)
    assert "array(" not in text and "f64[" not in text and " object at " not in text
    assert len(text.splitlines()) <= 6 and all(len(line) <= 110 for line in text.splitlines())
    joined = " ".join(text.split())
    assert all(each in joined for each in expected), text
    return text


@pytest.mark.parametrize("name", kc.catalog())
def test_robots_show_their_parameters_with_units(name):
    robot = kc.load_robot(name)
    if isinstance(robot, kc.robots.Assembly):
        short(robot, f"Assembly(nodes={robot.nodes}, rods=(", "bodies=(RigidBody)", " m/s2")
        return
    unit = " N m2 s" if isinstance(robot, kc.robots.tubes.ConcentricTubeRobot) else " Pa"
    short(robot, f"{type(robot).__name__}(nodes={robot.nodes}, length={float(robot.length):.4g} m", unit)


def test_parts_and_batches_and_users_systems_have_texts():
    short(kc.robots.loads.PointWrench(force=[1.0, 0.0, -2.0]), "force=[1, 0, -2] N")
    body = {"length": 0.5, "radius": 0.005, "density": 1e3, "youngs_modulus": 1e6}
    rod = kc.robots.SlenderRod(**body, loads=kc.robots.loads.AttachedMass(mass=0.1))
    short(rod, "loads=(AttachedMass)")
    both = jax.tree.map(lambda *leaves: np.stack(leaves), ROBOT, ROBOT.replace(length=0.5))
    short(both, "length=[0.635, 0.5] m")
    short(jax.tree.map(lambda _: object(), ROBOT), "TendonRobot(nodes=10")
    short(Hanging(mass=2.0), "Hanging(nodes=10, mass=2 kg, length=0.5 m)")
    short(Hanging(mass=2.0, anything=Odd()), "anything=Odd")
    short(Hanging(mass=2.0, anything=len), "anything=len")


def test_models_show_what_they_correct():
    model = kc.KNODE(ROBOT, Nothing())
    short(model, "KNODE of a TendonRobot, 0.635 m, 10 nodes", "Nothing")
    short(kc.KNODE(model, Nothing()), "KNODE of a KNODE, 0.635 m, 10 nodes")
    short(kc.learning.Ensemble([model, model]), "Ensemble of 2 models", "0.635 m")


def test_trajectories_show_rows_results_and_the_tip(rest, motion):
    short(rest, "1 row at 0 s: 1 CONVERGED", "tip at 0 s: [", "] m", " mm")
    short(motion, "5 rows from 0 to 0.2 s", "tip at 0.2 s: [")
    assert str(motion) == repr(motion)
    short(motion[:0], "0 rows")


def test_texts_of_traced_objects_do_not_fail(motion):
    seen = []

    def traced(length):
        robot = ROBOT.replace(length=length)
        seen.append(short(robot, "length=traced"))
        short(kc.KNODE(robot, Nothing()), "KNODE of a TendonRobot, traced, 10 nodes")
        return robot.length

    jax.jit(jax.vmap(traced))(np.array([0.5, 0.6]))

    def rows(trajectory):
        seen.append(short(trajectory, "Trajectory of a TendonRobot (traced)"))
        return trajectory.result

    result = jax.jit(rows)(motion)
    assert len(seen) == 2 and result.shape == (5,)


def test_results_print_words(rest):
    assert str(rest.result) == "[CONVERGED]" and str(rest.result[0]) == f"{rest.result[0]}" == "CONVERGED"
    assert rest.result.dtype.kind == "i" and rest.result.tolist() == [0] and f"{rest.result[0]:d}" == "0"
    failed = kc.equilibrium(
        ROBOT,
        [2.0, 0.0, 0.0, 0.0],
        newton=kc.solvers.NewtonOptions(max_linearisations=1),
        recovery_budget=0.0,
        on_failure="return",
    )
    assert str(failed.result) == "[NO_CONVERGENCE]" and failed.result[0] is kc.Result.NO_CONVERGENCE
    assert type(failed.result < 0) is np.ndarray and (failed.result < 0).all()
    assert str(kc.statics.Reach.UNREACHABLE) == "UNREACHABLE"


def test_results_of_statics_show_poses_with_units(rest):
    statics, pose, control = kc.statics, np.array([0.1, 0.0, 0.62]), np.array([2.0, 0.0, 0.0, 0.0])
    found = statics.InverseKinematics(
        statics.Reach.UNREACHABLE, control, pose, None, 0.25, 0.0, control <= 0, control >= 9, True, 7, rest
    )
    short(found, "UNREACHABLE; tension [2, 0, 0, 0] N; tip at [0.1, 0, 0.62] m; error 250 mm")
    assert str(found.result) == "UNREACHABLE"
    ellipsoid = Ellipsoid(np.ones(3), np.eye(3), 1.0, 1.0)
    short(Manipulability(ellipsoid, ellipsoid, None), "singular values [1, 1, 1]")
    found = statics.Configuration(control, pose, None, np.zeros((6, 4)), np.zeros((6, 6)), 0.635)
    short(found, "position [0.1, 0, 0.62] m")
    poses, rows = np.stack([pose, 2 * pose]), np.zeros(2, int)
    found = statics.Workspace(ROBOT, np.zeros((2, 4)), poses, None, rows, np.zeros(2), np.zeros((2, 2)))
    short(found, "TendonRobot", "2 samples, 0 without a solution", "z [0.62, 1.24] m")
    short(statics.Stability(0, 1.5, np.zeros((5, 3)), 0.0), "stable; smallest eigenvalue 1.5")
    short(statics.Stability(2, -1.5, np.zeros((5, 3)), 0.0), "unstable in 2 directions")


def test_recordings_and_measurements_show_their_extent(motion):
    measured = kc.recordings.Measurements.of(motion, (0.5, 1.0))
    short(measured, "5 rows from 0 to 0.2 s", "2 bodies at 0.5, 1 of the length")
    recording = kc.recordings.load_example()
    short(recording, "Recording (simulated): 15.95 s; tension (4)", "tip at 1 of the length")
    short(recording.sampled(0.05), "Measurements (simulated)", " s; tension (4)")
    short(kc.controls.Controls(kc.controls.sine(1.5, 4, 0.05), 0.05), "4 steps of 0.05 s; 4 tendons, 5", " N")


def test_identified_robots_show_their_numbers():
    estimate = kc.identification.Estimate(
        "youngs_modulus", "youngs_modulus", "Pa", 1e9, 2.7e9, (2.6e9, 2.8e9), error=1e6
    )
    found = kc.identification.Identified(ROBOT, ("youngs_modulus",), (estimate,))
    short(found, "95 % intervals: youngs_modulus = 2.7e+09 Pa (2.6e+09 to 2.8e+09)")
    errors = {"one": 1e-3, "two": 3e-3}
    found = kc.identification.Identified(ROBOT, ("friction",), error=errors, held_out_error={"one": None})
    short(found, "effects: friction", "tip error, identified: 2 mm")
