"""Every example at a reduced size: what it returns is held against physics, and its picture is there."""

import importlib
import inspect
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import knode_cosserat as kc
from tools.pictures import LONG, PICTURES, names

ROOT = Path(__file__).parents[1]
CAMPAIGN = pytest.mark.campaign


@pytest.fixture
def run(tmp_path):
    def runs(name, **small):
        picture = tmp_path / f"{name}.png"
        found = importlib.import_module(f"examples.{name}").main(out=str(picture), **small)
        with Image.open(picture) as image:
            assert min(image.size) > 300 and len(image.convert("L").getcolors()) > 20
        return found

    return runs


# all alike


@pytest.mark.parametrize("name", names())
def test_an_example_is_short_says_its_idea_and_has_a_picture(name):
    lines = (ROOT / "examples" / f"{name}.py").read_text(encoding="utf-8").splitlines()
    module = importlib.import_module(f"examples.{name}")
    idea, empty, why, *_ = module.__doc__.splitlines()
    assert idea.endswith((".", "?")) or "." in idea
    assert len(idea) <= 110 and not empty and why
    # a design has bounds, a check of its gradient and held-out cases
    assert len(lines) <= (110 if name.startswith("design_") else 60)
    parameters = inspect.signature(module.main).parameters
    assert parameters["out"].default == f"{name}.png"
    assert all(each.default is not inspect.Parameter.empty for each in parameters.values())
    assert 5_000 < (PICTURES / f"{name}.png").stat().st_size < 150_000


def test_there_is_no_picture_without_an_example():
    assert {path.stem for path in PICTURES.iterdir()} == set(names())
    assert all((ROOT / "examples" / f"{name}.py").exists() for name in LONG)


# one by one


def test_papers_robot(run):
    truth = run("papers_robot", steps=40)
    assert truth.all_valid and len(truth.time) == 41
    # it neither stretches nor shears to speak of: by the trapezoidal rule a chord is half of two tangents
    chords = np.linalg.norm(np.diff(truth.position, axis=1), axis=2)
    curvature = np.linalg.norm(truth.part("u"), axis=2)
    angle = 0.635 / 9 * 0.5 * (curvature[:, 1:] + curvature[:, :-1])
    np.testing.assert_allclose(chords, 0.635 / 9 * np.cos(angle / 2.0), rtol=1e-3)


@CAMPAIGN
@pytest.mark.sample
def test_learn_stiffness(run):
    before, after = run("learn_stiffness", steps=40)
    assert before > 0.05 and after < 1e-6 * before


@CAMPAIGN
def test_hit_a_target(run):
    missed, tensions = run("hit_a_target", steps=20, iterations=25)
    assert missed < 2e-3
    assert tensions.min() >= 0.0  # a tendon cannot push
    # the target is nearer to the first tendon (45 degrees) than to the second, and away from the third
    assert tensions[-1, 0] > tensions[-1, 1] > tensions[-1, 2]


@CAMPAIGN
@pytest.mark.sample
def test_follow_a_path(run):
    found = run("follow_a_path", points=9)
    assert np.all(found.converged) and np.all(found.position_error < 1e-8)
    # what the robot does under these tensions by themselves
    robot = kc.load_robot("delrin-tendon-robot")
    for k in (1, 6):
        tip = kc.equilibrium(robot, found.control[k]).tip_position[0, :2]
        np.testing.assert_allclose(tip, found.position[k], atol=1e-8)
    # by symmetry the eight's second half is the first, turned by 180 degrees about the rod
    np.testing.assert_allclose(found.control[::-1], np.roll(found.control, 2, axis=1), atol=1e-6)


@CAMPAIGN
def test_where_it_reaches(run):
    found = run("where_it_reaches", count=512)
    assert found.unsolved == 0
    assert np.all(np.linalg.norm(found.position, axis=1) < 0.635 * (1 + 1e-3))
    middle = np.mean(found.position[:, :2], axis=0)
    assert np.all(np.abs(middle) < 0.02)  # four tendons about the rod: no side is preferred


@CAMPAIGN
def test_a_thousand_robots(run):
    batch = run("a_thousand_robots", robots=8, steps=20)
    assert batch.all_valid and batch.y.shape[:2] == (8, 21)
    farthest = np.max(np.linalg.norm(np.asarray(batch.tip_position)[..., :2], axis=2), axis=1)
    softness = np.asarray(batch.system.youngs_modulus)
    assert farthest[np.argmin(softness)] > farthest[np.argmax(softness)]


@CAMPAIGN
def test_over_an_obstacle(run):
    pushed = run("over_an_obstacle", seconds=2.5)
    assert pushed.all_valid
    # never through the table or the cylinder, but for how far contact gives way
    points = np.asarray(pushed.position)
    radius = float(pushed.system.radius)
    assert points[..., 2].min() > 0.5 * radius
    axis = np.array([0.65, -0.12])
    assert np.linalg.norm(points[..., [0, 2]] - axis, axis=-1).min() > 0.15 + 0.5 * radius
    tip = points[:, -1]
    assert tip[:, 2].max() > 0.03 and tip[-1, 0] > 0.7  # over the top, and beyond it


@CAMPAIGN
def test_helical_tendons(run):
    straight, left, right = run("helical_tendons")
    mirror = np.array([1.0, -1.0, 1.0])
    np.testing.assert_allclose(right.position, mirror * np.asarray(left.position), atol=1e-9)
    assert np.max(np.abs(np.asarray(straight.position)[..., 1])) < 1e-12
    # closed form: a straight tendon's bending moment is the same everywhere
    u = np.asarray(straight.part("u"))[0, :, 1]
    np.testing.assert_allclose(u, u[0], rtol=1e-6)


@CAMPAIGN
def test_platform_on_a_circle(run):
    found, moved = run("platform_on_a_circle", points=12, radius=0.02)
    assert np.all(found.converged) and moved.all_valid
    centre = np.asarray(moved.tip_position)[0]
    away = np.linalg.norm(np.asarray(moved.tip_position)[-6:] - centre, axis=1)
    np.testing.assert_allclose(away, 0.02, atol=1e-3)
    level = np.abs(np.sum(np.asarray(moved.quaternion)[:, -1] * np.asarray(moved.quaternion)[0, -1], axis=1))
    assert np.all(2 * np.arccos(np.minimum(level, 1.0)) < 0.02)  # rad


@CAMPAIGN
def test_bend_by_pressure(run):
    bent = run("bend_by_pressure", steps=50)
    assert bent.all_valid
    # an S: bent one way near the base and the other near the tip, in its plane
    u = np.asarray(bent.part("u"))[-1]
    assert u[1, 1] > 3.0 and u[-2, 1] < -3.0
    assert np.max(np.abs(np.asarray(bent.position)[..., 1])) < 1e-9


@CAMPAIGN
def test_magnetic_catheter(run):
    still, slow, fast = (np.hypot(*path[:, :2].T) for path in run("magnetic_catheter", turns=2).values())
    np.testing.assert_allclose(slow, still[0], rtol=1e-2)
    assert np.mean(fast[60:]) > 1.1 * still[0]


@CAMPAIGN
def test_feed_a_catheter(run):
    wanted, tip = run("feed_a_catheter", points=21, dt=0.1).values()
    assert wanted[-1, 0] > 0.015
    # the field leads by half a row, in which the tip moves by 1.9 mm
    np.testing.assert_allclose(tip, wanted, atol=1e-3)


@CAMPAIGN
def test_calibrate_parameters(run):
    found = run("calibrate_parameters", steps=40)
    for name, true in (("youngs_modulus", 2.757903e9), ("bending_damping", 0.03)):
        low, high = found[name].interval
        # three half-widths: a seed may lie outside one interval of 95 %
        assert abs(found[name].value - true) < 1.5 * (high - low)
        assert (high - low) < 0.02 * true


@CAMPAIGN
def test_bag_to_model(run):
    before, after = run("bag_to_model", seconds=3.0)
    assert before > 0.05 and after < 0.2 * before


@CAMPAIGN
def test_closed_form(run):
    nodes, errors = run("closed_form", most_nodes=21)
    assert nodes == [6, 11, 21]
    orders = {scheme: np.log2(np.array(each[:-1]) / each[1:]) for scheme, each in errors.items()}
    np.testing.assert_allclose(orders["euler"], 1.0, atol=0.15)
    np.testing.assert_allclose(orders["lobatto2"], 2.0, atol=0.15)
    np.testing.assert_allclose(orders["lobatto4"], 4.0, atol=0.25)


@CAMPAIGN
def test_cut_the_thread(run):
    found, known = run("cut_the_thread")
    # closed form of the trapezoidal rule at 40 steps a period: tan(w dt / 2) takes the place of w dt / 2
    assert found == pytest.approx(known * np.arctan(np.pi / 40) / (np.pi / 40), rel=5e-4)


@CAMPAIGN
def test_hanging_string(run):
    swing = run("hanging_string", steps=100)
    assert swing.all_valid
    p = np.asarray(swing.part("p"))
    lengths = np.sum(np.linalg.norm(np.diff(p, axis=1), axis=2), axis=1)
    np.testing.assert_allclose(lengths, 1.0, atol=5e-3)  # EA = 1 kN hardly gives
    assert p[0, :, 1].min() == pytest.approx(-0.363, abs=1e-3)


def test_their_calls_are_public():
    """An example is what a user would write: nothing private, and of this package mostly `kc.`."""
    for name in names():
        text = (ROOT / "examples" / f"{name}.py").read_text(encoding="utf-8")
        assert "knode_cosserat._" not in text and "import knode_cosserat as kc\n" in text
        assert all(hasattr(kc, word) for word in ("figures", "simulate"))


@CAMPAIGN
def test_closed_loop(run):
    logs = run("closed_loop", seconds=6.0)
    predictive, kinematic = (logs[name].tip_rmse(3.0) for name in ("predictive", "kinematic"))
    assert predictive < 2e-3 < 2e-2 < kinematic


@CAMPAIGN
def test_keep_off_a_wall(run):
    log = run("keep_off_a_wall", seconds=6.0)
    assert log.fallbacks == 0 and log.tip[:, 0].max() < 0.052
    free = (log.reference[:, 0] < 0.03) & (log.time > 2.0)
    assert np.max(log.tip_distance[free]) < 3e-3


@CAMPAIGN
def test_control_a_learned_model(run):
    logs = run("control_a_learned_model", seconds=6.0)
    assert 3.0 * logs["learned"].tip_rmse(3.0) < logs["model"].tip_rmse(3.0)


@CAMPAIGN
def test_design_routing(run):
    missed, wrong = run("design_routing", iterations=30)
    # central differences with steps of 1e-5 have errors of some 1e-9
    assert wrong < 1e-6
    assert missed["after"].mean() < 0.25 * missed["before"].mean()
    assert missed["held-out"].mean() < 0.25 * missed["before"].mean()


@CAMPAIGN
def test_design_pareto(run):
    from examples import design_pareto

    study = run("design_pareto", generations=4, size=8)
    assert len(study.trials) == 32
    sag = [sag for _, sag in sorted({tuple(trial.values) for trial in study.best_trials})]
    assert np.all(np.diff(sag) > 0.0)  # more reach costs more sag
    # small deflections of a cantilever: payload g L³ / 3EI
    design = {"length": 200.0, "radius": 2.5, "base_offset": 10.0, "end_offset": 10.0}
    (values,), fine = design_pareto.objectives([design])
    EI = 40e9 * np.pi * 0.0025**4 / 4
    assert fine.all() and values[1] == pytest.approx(1e3 * 0.03 * 9.81 * 0.2**3 / (3 * EI), rel=5e-3)
    # a straight tendon bends the rod evenly: T r L² / 2EI
    assert values[0] == pytest.approx(1e3 * 15.0 * 0.01 * 0.2**2 / (2 * EI), rel=2e-2)


@CAMPAIGN
def test_syringe_or_regulator(run):
    moved = run("syringe_or_regulator", points=7)
    assert 0.01 < moved["syringes"] < 0.7 * moved["regulators"]


@CAMPAIGN
def test_gripper(run):
    found = run("gripper", points=5)
    # three fingers alike, which touch the ball at the end only
    assert np.ptp(found["grips"][-1]) < 1e-6 and found["grips"][0, 0] < 1e-6 < 0.2 < found["grips"][-1, 0]
    assert np.ptp(found["closed"]) < 0.1 * np.ptp(found["open"])


@CAMPAIGN
def test_concentric_tubes(run):
    jumps = run("concentric_tubes", steps=120)
    assert jumps[0.7] < 30.0 < 90.0 < jumps[1.6]


@pytest.mark.slow
def test_spinning_shaft(run):
    found, exact = run("spinning_shaft", speeds=2)
    np.testing.assert_allclose(found, exact, rtol=1e-4)
    # spin parts the two ways of whirl
    assert np.all(np.abs(exact[0, :, 0]) == pytest.approx(exact[0, :, 1]))
    assert np.all(exact[1, :, 1] > 1.01 * np.abs(exact[1, :, 0]))


@pytest.mark.slow
def test_on_an_arm(run):
    pytest.importorskip("mujoco")
    wrench, tips = run("on_an_arm", seconds=0.2)
    assert wrench.shape == (20, 6) and tips.shape == (20, 3)
    # it hangs from the flange of an arm that is level, 0.9 m from the shoulder
    np.testing.assert_allclose(tips[-1], [0.9, 0.0, 1.0 - 0.635], atol=0.03)
    hanging = kc.robots.ends.Clamped(orientation=[0.0, 1.0, 0.0, 0.0])
    robot = kc.load_robot("delrin-routed-tendon-robot").replace(base_end=hanging)
    weight = kc.equilibrium(robot, np.zeros(4)).base_wrench[0, 2]
    np.testing.assert_allclose(wrench[-1, 2], weight, rtol=0.1)
