"""Episodes move as simulations do, with drawn parameters, delays and changes; failures end them."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat import envs
from knode_cosserat.control import ControlLimits
from knode_cosserat.envs import dynamics
from knode_cosserat.robots import ParameterError


def tensions(steps, seed=0):
    return 2.0 + 3.0 * np.random.default_rng(seed).uniform(size=(steps, 4)).cumsum(axis=0) / steps


def actions(environment, tension):
    return 2.0 * tension / 10.0 - 1.0


@pytest.mark.slow
def test_an_episode_moves_as_its_robot_is_simulated(environment, keys):
    states, _ = environment.reset_many(keys)
    first, wanted = states, tensions(6)
    every = [states]
    for row in wanted:
        states, found = environment.step_many(states, np.tile(actions(environment, row), (2, 1)))
        every.append(states)
        assert np.all(np.asarray(found.ending) == envs.Ending.RUNNING)
    within = environment.limits
    for k in range(2):
        own = jax.tree.map(lambda leaf, k=k: leaf[k], first)
        if int(own.changes_at) <= len(wanted):
            continue
        command, commands = np.asarray(within.safe), []
        for row in wanted:
            command = within.applied(row, command, environment.dt)
            commands.append(command)
        delay = int(own.delay)
        acting = np.concatenate([np.tile(within.safe, (delay, 1)), commands])[: len(wanted)]
        simulated = kc.simulate(environment.system(own), acting, environment.dt)
        tip = np.asarray(every[-1].history.y[k, 0, -1, :3])
        np.testing.assert_allclose(tip, np.asarray(simulated.tip_position)[-1], atol=1e-8)


def test_drawn_parameters_are_in_their_ranges_and_change_at_their_time(environment):
    keys = jax.random.split(jax.random.PRNGKey(3), 200)
    states, _ = jax.vmap(environment.reset)(keys)
    nominal = float(environment.robot.youngs_modulus)

    def modulus(state):
        return environment.system(state).youngs_modulus

    before = np.asarray(jax.vmap(modulus)(states)) / nominal
    late = states._replace(count=jnp.full(200, environment.steps))
    after = np.asarray(jax.vmap(modulus)(late)) / nominal
    assert 0.7 <= before.min() < 0.75 and 1.25 < before.max() <= 1.3
    changes = np.asarray(states.changes_at) <= environment.steps
    assert 0.35 < changes.mean() < 0.65
    np.testing.assert_array_equal(before != after, changes)
    assert set(np.asarray(states.delay).tolist()) == {0, 1, 2}


def test_an_observation_has_the_error_of_the_tip(environment, keys):
    states, seen = environment.reset_many(keys)
    length = float(environment.robot.length)
    for k in range(2):
        state = jax.tree.map(lambda leaf, k=k: leaf[k], states)
        wanted = np.asarray(environment.task.target(state.goal, environment.dt))
        apart = (wanted - np.asarray(state.measured[0, -3:])) / length
        np.testing.assert_allclose(np.asarray(seen)[k, -3:], apart, atol=1e-6)
    assert seen.shape == (2, environment.observation_size)


def test_a_reference_is_the_target_of_the_episode(environment, keys):
    state = jax.tree.map(lambda leaf: leaf[0], environment.reset_many(keys)[0])
    times = np.array([0.0, 0.7, 2.5])
    values = environment.reference(state).at(times)
    wanted = [environment.task.target(state.goal, t) for t in times]
    assert np.all(np.isnan(values[:, 2])), "along the tip's direction is free"
    np.testing.assert_allclose(values[:, :2], np.asarray(wanted)[:, :2])


def test_an_unsolved_step_truncates_with_its_reason_and_without_nan(environment, keys):
    states, _ = environment.reset_many(keys)
    spoilt = states.history._replace(records=states.history.records.at[1].set(1e200))
    states, found = environment.step_many(states._replace(history=spoilt), np.zeros((2, 4)))
    assert np.asarray(found.ending)[1] == envs.Ending.UNSOLVED and np.asarray(found.truncated)[1]
    assert np.asarray(found.reward)[1] == 0.0
    assert np.all(np.isfinite(np.asarray(found.observation)[1]))
    assert np.all(np.asarray(found.ending)[[0]] == envs.Ending.RUNNING)


def test_an_action_that_is_not_finite_holds_the_control(environment, keys):
    states, _ = environment.reset_many(keys)
    action = np.zeros((2, 4))
    action[1, 1] = np.nan
    states, found = environment.step_many(states, action)
    assert np.asarray(found.ending)[1] == envs.Ending.INVALID_ACTION
    np.testing.assert_array_equal(np.asarray(found.control)[1], environment.limits.safe)
    assert np.all(np.isfinite(np.asarray(found.observation)))


def test_commands_keep_their_limits_and_rate(environment, keys):
    states, _ = environment.reset_many(keys)
    before = np.asarray(states.commands[:, 0])
    for k in range(5):
        states, found = environment.step_many(states, np.full((2, 4), 9.0 if k < 3 else -9.0))
        control = np.asarray(found.control)
        assert np.all(np.abs(control - before) <= 40.0 * environment.dt + 1e-12)
        assert np.all((control >= 0.0) & (control <= 10.0))
        before = control


@pytest.mark.slow
@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"task": "folow"}, "no task 'folow'.*did you mean follow"),
        ({"actions": "force"}, '"control" or "increment"'),
        ({"duration": 0.01}, "at least one period"),
        ({"bodies": (0.5,)}, "must be 1.0, the tip"),
        ({"randomisation": {"mass": 1}}, "randomisation is dict"),
        ({"limits": kc.control.ControlLimits(5.0, 1.0)}, "low must be below high"),
        ({"actions": "increment", "limits": kc.control.ControlLimits(0.0, 9.0)}, "finite rate"),
        (
            {"task": envs.tasks.Reach(position=(9.0, 0.0, 0.0))},
            "cannot be reached: the nearest position found",
        ),
        ({"task": envs.tasks.Reach(position=(np.nan, 0.0, 0.0))}, "three finite numbers"),
        ({"task": 3}, "allowed is a name"),
        ({"robot": 3}, "robot is int"),
    ],
)
def test_wrong_settings_are_refused_in_one_line(robot, wrong, message):
    with pytest.raises(envs.TaskError, match=message) as raised:
        envs.make(**{"task": "follow", "robot": robot, **wrong})
    assert "\n" not in str(raised.value)


def test_a_parameter_that_does_not_exist_is_refused(robot):
    for name in ("youngs_modulos", "loads.0.mass", "tendon_angles.7"):
        with pytest.raises(ParameterError):
            envs.make("follow", robot, randomisation=envs.Randomisation({name: envs.Factor(0.9, 1.1)}))
    with pytest.raises(ParameterError, match="length"):
        envs.make("follow", robot, randomisation=envs.Randomisation({"length": envs.Uniform(-1.0, 1.0)}))


@pytest.mark.parametrize(
    "wrong",
    [
        {"change": 1.5},
        {"delay": (2, 1)},
        {"delay": (0, 500)},
        {"noise": -1.0},
        {"parameters": {"length": (1, 2)}},
        {"parameters": {"length": envs.Factor(2.0, 1.0)}},
    ],
)
def test_wrong_randomisations_are_refused(wrong):
    with pytest.raises(envs.TaskError, match=r"allowed|must not"):
        envs.Randomisation(**wrong)


@pytest.mark.parametrize(
    ("robot", "settings", "words"),
    [
        ("delrin-tendon-robot", {}, r"actions \(4,\) are tension \[N\],"),
        ("delrin-tendon-robot", {"actions": "increment"}, r"are changes of tension \[N\],"),
        ("three-chamber-arm", {"limits": ControlLimits(0.0, 3e4, 1e5)}, r"\(3,\) are pressure \[Pa\],"),
    ],
)
def test_actions_have_the_names_and_units_of_the_controls(robot, settings, words):
    assert re.search(words, repr(envs.make("follow", robot, **settings)))


def test_a_robot_without_tensions_needs_limits():
    message = "limits are needed for the controls .*: give low, high and rate of ControlLimits"
    with pytest.raises(envs.TaskError, match=message):
        envs.make("follow", "six-legged-robot")


def test_a_robot_that_cannot_touch_has_no_obstacle_course():
    limits = kc.control.ControlLimits(-0.01, 0.01, 1.0, safe=0.0)
    with pytest.raises(envs.TaskError, match="needs a robot with surroundings"):
        envs.make("pillar", "six-legged-robot", limits=limits)


def test_observations_are_a_pure_function_of_the_state(environment, keys):
    state = jax.tree.map(lambda leaf: leaf[0], environment.reset_many(keys)[0])
    one = dynamics.observation(environment.spec, environment.arrays, state)
    other = jax.jit(lambda s: dynamics.observation(environment.spec, environment.arrays, s))(state)
    np.testing.assert_allclose(one, other, atol=1e-6)
