"""Exported models: the same numbers as `simulate`, in C."""

import ctypes
import subprocess

import jax
import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.rods.passport import Passport, with_passport
from knode_cosserat.solvers.places import places_at, positions_at, quaternions_at
from tests.native.library import STRICT, Library, has

pytestmark = pytest.mark.skipif(not has("cc"), reason="no C compiler")
DT = 0.02
CONTROL = np.array([2.0, 0.5, 0.0, 0.0])


@pytest.fixture(scope="module")
def robot():
    return kc.load_robot("delrin-tendon-robot")


@pytest.fixture(scope="module")
def library(robot, tmp_path_factory):
    return Library(robot, tmp_path_factory.mktemp("arm"), DT, horizon=6)


@pytest.fixture
def arm(library):
    library.start()
    return library


@pytest.fixture(scope="module")
def motion(robot):
    return kc.simulate(robot, kc.controls.sine(period=1.5, steps=150, dt=DT), DT)


def test_steps_are_those_of_simulate(arm, motion):
    tips = arm.move(motion.control[1:])
    np.testing.assert_allclose(tips, motion.tip_position[1:], rtol=0, atol=1e-12)
    arm.function("time").restype = ctypes.c_double
    assert arm.call("time") == pytest.approx(motion.time[-1])


def test_poses_are_those_of_the_motion_at_and_between_nodes(robot, arm, motion):
    arm.move(motion.control[1:])
    result, p, h = arm.pose(0, 4)
    assert result == 0
    np.testing.assert_allclose(p, motion.position[-1, 4], rtol=0, atol=1e-12)
    np.testing.assert_allclose(h, motion.quaternion[-1, 4], rtol=0, atol=1e-12)
    fractions = np.array([0.0, 0.37, 0.5, 0.999, 1.0])
    places = places_at(fractions, robot.nodes)
    wanted = np.asarray(positions_at(robot, motion.y[-1:], places, motion.z[-1:])[0])
    turned = np.asarray(quaternions_at(robot, motion.y[-1:], places)[0])
    for place, one, other in zip(fractions, wanted, turned, strict=True):
        result, p, h = arm.pose_at(0, place)
        assert result == 0
        np.testing.assert_allclose(p, one, rtol=0, atol=1e-12)
        np.testing.assert_allclose(h, other, rtol=0, atol=1e-12)


def test_an_equilibrium_is_that_of_the_package_and_a_motion_goes_on_from_it(robot, arm):
    wanted = kc.equilibrium(robot, CONTROL)
    assert arm.equilibrium(CONTROL) == 0
    np.testing.assert_allclose(arm.tip(), wanted.tip_position[-1], rtol=0, atol=1e-9)
    # it rests there, and moves on as `simulate` does
    still = arm.move([CONTROL] * 3)
    np.testing.assert_allclose(still, np.repeat(wanted.tip_position[-1:], 3, axis=0), rtol=0, atol=1e-8)
    arm.equilibrium(CONTROL)
    later = kc.simulate(robot, np.zeros((20, 4)), DT, initial=wanted)
    np.testing.assert_allclose(arm.move(np.zeros((20, 4))), later.tip_position[1:], rtol=0, atol=1e-8)


def test_tangents_of_equilibria_and_of_steps_are_differences(arm):
    arm.move(np.tile(CONTROL, (3, 1)))
    controls = np.array(
        [[1.5, 0.0, 0.2, 0.0], [2.0, 0.1, 0.0, 0.0], [1.0, 0.3, 0.0, 0.5], [0.5, 0.5, 0.5, 0.5]]
    )
    for steps in (0, 1, 4):
        own = controls[: max(steps, 1)]
        before = arm.robot.copy()
        result, _, tangents = arm.predict(steps, own)
        assert result >= 0
        np.testing.assert_array_equal(arm.robot, before)
        for k in range(4):
            change = 1e-4 * np.eye(4)[k]
            ahead, behind = (arm.predict(steps, own + sign * change)[1] for sign in (1.0, -1.0))
            np.testing.assert_allclose(tangents[:, :, k], (ahead - behind) / 2e-4, rtol=1e-5, atol=1e-8)


def test_predicted_tips_are_those_of_the_steps(arm):
    controls = np.tile(CONTROL, (6, 1))
    _, tips, _ = arm.predict(6, controls)
    np.testing.assert_array_equal(tips, arm.move(controls))


def test_a_saved_state_goes_on_and_another_models_state_is_refused(arm, motion):
    arm.move(motion.control[1:21])
    saved = np.zeros(8192)
    assert arm.call("save", saved) == 0
    wanted = arm.move(motion.control[21:31])
    arm.start()
    assert arm.call("load", saved) == 0
    np.testing.assert_allclose(arm.move(motion.control[21:31]), wanted, rtol=0, atol=1e-9)
    other = saved.copy()
    other.view(np.uint64)[0] += 1
    assert arm.call("load", other) == -12
    other = saved.copy()
    other[40] = np.nan
    assert arm.call("load", other) == -12


def test_wrong_input_gives_a_code_and_changes_nothing(arm):
    arm.step(CONTROL)
    before = arm.robot.copy()
    for wrong in (np.nan, np.inf, -np.inf):
        assert arm.step([wrong, 0.0, 0.0, 0.0]) == -10
        assert arm.equilibrium([wrong, 0.0, 0.0, 0.0]) == -10
    assert arm.step(CONTROL, dt=0.01) == -11
    assert arm.step(CONTROL, dt=np.nan) == -11
    assert arm.pose(0, 10)[0] == arm.pose(0, -1)[0] == arm.pose(1, 0)[0] == arm.pose_at(0, np.nan)[0] == -14
    assert arm.predict(7, np.zeros((7, 4)))[0] == arm.predict(-1, np.zeros((1, 4)))[0] == -14
    np.testing.assert_array_equal(arm.robot, before)
    arm.robot[:] = 0
    assert arm.step(CONTROL) == arm.equilibrium(CONTROL) == arm.call("tip", np.zeros(3)) == -12


def test_a_step_without_a_solution_leaves_the_robot_where_it_is(arm, motion):
    arm.move(motion.control[1:4])
    before, tip = np.zeros(8192), arm.tip()
    arm.call("save", before)
    assert arm.step([1e8, 0.0, 0.0, 1e8]) == -1
    assert arm.equilibrium([1e8, 0.0, 0.0, 1e8]) == -1
    after = np.zeros(8192)
    arm.call("save", after)
    np.testing.assert_array_equal(after, before)
    np.testing.assert_array_equal(arm.tip(), tip)
    tips = arm.move(motion.control[4:8])
    np.testing.assert_allclose(tips, motion.tip_position[4:8], rtol=0, atol=1e-9)


def test_code_needs_nothing_but_mathematics(library):
    found = subprocess.run(
        ["nm", "-u", f"{library.name}.o"], cwd=library.exported.folder, capture_output=True, text=True
    )
    names = set(found.stdout.split()) - {"U", "_GLOBAL_OFFSET_TABLE_"}
    assert names <= {"log", "sin", "cos", "sincos", "exp", "pow", "tanh", "log1p", "expm1", "floor"}
    assert library.exported.object_size < 2e6


@pytest.mark.skipif(not has("c++"), reason="no C++ compiler")
def test_the_examples_run_without_python(library, motion):
    folder = library.exported.folder
    subprocess.run(
        ["cc", *STRICT, "example.c", "arm.c", "arm.o", "-lm", "-o", "steps"], cwd=folder, check=True
    )
    text = "\n".join(" ".join(map(repr, map(float, row))) for row in motion.control[1:])
    found = subprocess.run([folder / "steps"], input=text, capture_output=True, text=True, check=True)
    rows = np.loadtxt(found.stdout.splitlines())
    np.testing.assert_allclose(rows[:, 1:4], motion.tip_position[1:], rtol=0, atol=1e-12)
    subprocess.run(["cc", *STRICT, "-c", "arm.c"], cwd=folder, check=True)
    (folder / "arm_c.o").write_bytes((folder / "arm.o").read_bytes())
    subprocess.run(["cc", *STRICT, "-c", "arm.c", "-o", "arm_functions.o"], cwd=folder, check=True)


def test_what_cannot_be_exported_says_why(robot, tmp_path):
    with pytest.raises(kc.native.ExportError, match="batch"):
        kc.export(jax.tree.map(lambda leaf: np.stack([leaf, leaf]), robot), tmp_path, DT)
    with pytest.raises(kc.native.ExportError, match="name is '1arm'"):
        kc.export(robot, tmp_path, DT, name="1arm")
    for name in ("example", "fmu", "m", "math"):
        with pytest.raises(kc.native.ExportError, match=f"{name}_robot"):
            kc.export(robot, tmp_path / name, DT)
    (tmp_path / "arm").write_text("no folder")
    with pytest.raises(kc.native.ExportError, match="is a file"):
        kc.export(robot, tmp_path / "arm", DT)
    with pytest.raises(kc.KnodeCosseratError, match="target is 'arm'; allowed is native"):
        kc.export(robot, tmp_path, DT, target="arm")


def test_a_learned_model_says_where_it_extrapolates(robot, tmp_path):
    controls = kc.controls.sine(period=1.5, steps=40, dt=DT)
    motion = kc.simulate(robot, controls, DT)
    passport = Passport.of("fit", [], robot, [motion])
    library = Library(with_passport(robot, passport), tmp_path, DT)
    assert "learned by fit" in (tmp_path / "arm.h").read_text()
    library.start()
    for control, row in zip(controls, motion.tip_position[1:], strict=True):
        library.step(control)
        assert library.call("extrapolates") == 0
        np.testing.assert_allclose(library.tip(), row, rtol=0, atol=1e-12)
    # a state in which no control acts yet, then controls just beyond the range, then strains alone
    saved = np.zeros(8192)
    library.start()
    library.call("save", saved)
    library.step(controls[-1])
    library.call("load", saved)
    assert library.call("extrapolates") == 0
    low, high = passport.limits("controls", robot.control_layout)
    library.step(np.where(np.arange(4) == 1, high + 1e-3, controls[-1]))
    assert library.call("extrapolates") == 1
    # at rest under controls of the range, the rod is bent farther than in the motion
    library.start()
    assert library.call("extrapolates") == 0
    library.equilibrium(np.where(np.arange(4) < 2, high, low))
    assert library.call("extrapolates") == 1 and np.all(low < high)


def test_changed_parameters_are_those_of_a_robot_with_them(robot, arm):
    controls = np.tile(CONTROL, (5, 1))
    at = int(np.frombuffer(arm.robot[40:48], np.uint64)[0])
    count = int(arm.exported.values["parameters"])
    known = np.ctypeslib.as_array((ctypes.c_double * count).from_address(at))
    names = [
        jax.tree_util.keystr(path).lstrip(".") for path, _ in jax.tree_util.tree_flatten_with_path(robot)[0]
    ]
    for name, factor in (("length", 0.8), ("youngs_modulus", 0.7)):
        place = names.index(name)  # parameters before these are scalars
        changed = known.copy()
        changed[place] *= factor
        other = kc.simulate(robot.replace(**{name: factor * float(getattr(robot, name))}), controls, DT)
        arm.start()
        arm.robot[40:48].view(np.uint64)[0] = changed.ctypes.data
        assert arm.equilibrium(np.zeros(4)) == 0
        np.testing.assert_allclose(arm.move(controls), other.tip_position[1:], rtol=0, atol=1e-9)
        wanted = positions_at(
            other.system, other.y[-1:], places_at(np.array([0.37]), robot.nodes), other.z[-1:]
        )
        np.testing.assert_allclose(arm.pose_at(0, 0.37)[1], np.asarray(wanted)[0, 0], rtol=0, atol=1e-9)


def test_a_robot_without_controls_is_exported_without_warnings(tmp_path):
    spinning = kc.robots.SpinningFrame(rate=20 * np.pi, axis=(1.0, 0.0, 0.0))
    robot = kc.robots.SlenderRod(
        length=0.2,
        radius=0.002,
        density=1100.0,
        youngs_modulus=5e6,
        bending_damping=1e-5,
        gravity=(0.0, 0.0, 9.81),
        nodes=5,
        effects=(spinning,),
    )
    library = Library(robot, tmp_path, DT)
    wanted = kc.simulate(robot, np.zeros((10, 0)), DT).tip_position
    library.start()
    tips = library.move(np.zeros((10, 0)))
    np.testing.assert_allclose(tips, wanted[1:], rtol=0, atol=1e-12)
    # time goes on in an equilibrium: after two steps gravity has another direction, after five the same
    library.start()
    library.equilibrium([])
    first, moved = library.tip(), library.move(np.zeros((5, 0)))
    library.start()
    library.move(np.zeros((2, 0)))
    library.equilibrium([])
    assert np.abs(library.tip() - first).max() > 1e-4
    library.move(np.zeros((3, 0)))
    library.equilibrium([])
    np.testing.assert_allclose(library.tip(), first, rtol=0, atol=1e-9)
    np.testing.assert_allclose(library.move(np.zeros((5, 0))), moved, rtol=0, atol=1e-9)
