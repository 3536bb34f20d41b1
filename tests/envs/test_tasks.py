"""Tasks: goals can be reached, obstacles stand in the way, errors and rewards are those stated."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat import envs
from knode_cosserat.envs import tasks
from knode_cosserat.envs.dynamics import clearance_of, tip_of
from knode_cosserat.rods.aspects import Drawing


@pytest.fixture(scope="module")
def limits(robot):
    return kc.control.ControlLimits(0.0, 10.0, 40.0).of(robot)


@pytest.fixture(scope="module")
def survey(robot, limits):
    return tasks.Follow().survey(robot, limits, 0)


def goals(task, survey, count=50):
    return [task.draw(key, survey) for key in jax.random.split(jax.random.PRNGKey(1), count)]


def test_surveyed_poses_are_equilibria_within_limits(robot, survey):
    # the same controls by another path: inverse kinematics finds them
    wanted = np.asarray(survey.position[3])
    found = kc.statics.inverse_kinematics(robot, wanted, low=0.0, high=10.0)
    assert found.position_error < 1e-5
    assert np.all(np.abs(np.linalg.norm(survey.tangent, axis=1) - 1.0) < 1e-9)


def test_paths_begin_at_rest_and_are_within_reach(survey):
    task = tasks.Follow()
    for goal in goals(task, survey):
        np.testing.assert_allclose(task.target(goal, 0.0), survey.origin)
        times = np.linspace(0.0, 20.0, 200)
        places = np.asarray(jax.vmap(lambda t, goal=goal: task.target(goal, t))(times))
        across = (places - survey.origin) @ np.asarray(survey.frame[:2]).T
        assert 0.1 * survey.reach < np.max(np.abs(across)) <= 0.9 * survey.reach + 1e-9
        assert np.max(np.abs((places - survey.origin) @ np.asarray(survey.frame[2]))) < 1e-12


def test_the_reward_falls_to_1_e_at_the_scale(survey):
    task = tasks.Follow(scale=0.05)
    goal = goals(task, survey, 1)[0]
    for distance, reward in ((0.0, 1.0), (0.05, np.exp(-1.0)), (0.1, np.exp(-2.0))):
        position = task.target(goal, 1.0) + distance * survey.frame[0] + 0.3 * survey.frame[2]
        error = task.error(goal, 1.0, tasks.Tip(position, survey.frame[2]))
        assert float(task.reward(error, jnp.inf, 1.0)) == pytest.approx(reward, abs=1e-6)


def test_the_error_of_a_pose_has_its_tangent(survey):
    task = tasks.Reach(arm=0.05)
    goal = goals(task, survey, 1)[0]
    aside = np.cross(np.asarray(goal.tangent), [0.3, 0.5, 0.8])
    turned = goal.tangent + 0.01 * aside / np.linalg.norm(aside)
    tip = tasks.Tip(goal.position, turned / jnp.linalg.norm(turned))
    assert float(task.error(goal, 0.0, tip)) == pytest.approx(0.05 * 0.01, rel=1e-3)


@pytest.mark.parametrize("task", [tasks.Pillar(), tasks.Gate()])
def test_obstacles_stand_in_the_direct_way(robot, survey, task):
    equipped = task.equipped(robot)
    assert len(equipped.surroundings) == task.count
    sides = []
    for goal in goals(task, survey):
        placed = task.placed(equipped, goal)
        centres = np.asarray([each.center for each in placed.surroundings])
        middle = survey.halfway[np.argmin(np.linalg.norm(survey.position - goal.position, axis=1))]
        gaps = np.linalg.norm(centres - middle, axis=1) - task.radius
        # halfway of the direct motion the tip would be inside a ball, or next to the gate's post
        assert gaps.min() < 0.01 + (task.radius if task.count == 2 else 0.0)
        waypoint = task.waypoint(goal)
        free = np.linalg.norm(centres - waypoint, axis=1) - task.radius
        assert np.all(free > float(robot.radius)), "the way point is clear"
        target = np.linalg.norm(centres - np.asarray(goal.position), axis=1) - task.radius
        assert np.all(target > 0.0)
        sides.append(float(goal.aside @ survey.frame[0]))
    assert min(sides) < 0.0 < max(sides)


def test_clearance_is_the_distance_of_the_surface(robot, survey):
    task = tasks.Pillar(radius=0.02)
    goal = goals(task, survey, 1)[0]._replace(centres=jnp.array([[0.1, 0.0, 0.3]]))
    system = task.placed(task.equipped(robot), goal)
    y, _ = jax.vmap(system.rest)(np.linspace(0.0, float(system.length), system.nodes))
    nearest = np.linalg.norm(np.asarray(Drawing.of(system).positions(y)) - [0.1, 0.0, 0.3], axis=1).min()
    assert float(clearance_of(system, y)) == pytest.approx(nearest - 0.02 - float(system.radius))
    assert np.isinf(clearance_of(robot, y))
    np.testing.assert_allclose(tip_of(system, y).position, [0.0, 0.0, float(system.length)], atol=1e-12)


def test_a_touch_halves_the_reward():
    free, touching = (float(tasks.Pillar().reward(0.02, gap, 1.0)) for gap in (1e-3, -1e-3))
    assert touching == pytest.approx(0.5 * free)


def test_a_payload_and_a_changed_robot_are_drawn(robot):
    loaded = tasks.Payload(mass=0.02).equipped(robot)
    low, high = tasks.Payload(mass=0.02).randomisation().ends(loaded)
    assert low["loads.0.mass"] == 0.0 and high["loads.0.mass"] == 0.02
    low, high = tasks.Adaptation().randomisation().ends(robot)
    assert set(low) == {"youngs_modulus", "bending_damping", "density"}
    assert high["bending_damping"].shape == (3, 3)


@pytest.mark.parametrize(
    "wrong",
    [
        lambda: tasks.Follow(scale=0.0), lambda: tasks.Follow(period=(3.0, 1.0)),
        lambda: tasks.Follow(width=(0.0, 1.0)), lambda: tasks.Pillar(radius=-1.0),
        lambda: tasks.Gate(stiffness=0.0),
    ],
)  # fmt: skip
def test_wrong_settings_of_tasks_are_refused(wrong):
    with pytest.raises(envs.TaskError, match="allowed"):
        wrong()
