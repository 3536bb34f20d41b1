"""Policies: files, advantages, learning, and scores."""

import contextlib

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from knode_cosserat import envs
from knode_cosserat.envs.policy import network
from knode_cosserat.envs.ppo import advantages


@pytest.fixture
def policy(environment):
    layers = network(jax.random.PRNGKey(0), (environment.observation_size, 8, 4), 0.5)
    size = environment.observation_size
    return envs.Policy(layers, np.zeros(size, np.float32), np.ones(size, np.float32))


def test_a_policy_is_read_as_it_was_written(policy, tmp_path):
    policy.save(tmp_path / "policy.npz")
    again = envs.Policy.load(tmp_path / "policy.npz")
    seen = np.random.default_rng(0).normal(size=(5, len(policy.mean)))
    np.testing.assert_array_equal(policy.action(seen), again.action(seen))
    assert np.max(np.abs(again.action(100.0 * seen))) <= 1.0


def test_files_that_are_no_policies_are_refused(policy, tmp_path):
    path = tmp_path / "policy.npz"
    with pytest.raises(envs.TaskError, match="cannot be read"):
        envs.Policy.load(path)
    policy.save(path)
    data = path.read_bytes()
    for k in range(0, len(data), max(1, len(data) // 60)):
        damaged = bytearray(data)
        damaged[k] ^= 0xFF
        path.write_bytes(bytes(damaged))
        # a flip that changes nothing, such as in the date of an entry, is read
        with contextlib.suppress(envs.TaskError):
            np.testing.assert_array_equal(envs.Policy.load(path).mean, policy.mean)
    policy._replace(deviation=np.zeros_like(policy.deviation)).save(path)
    with pytest.raises(envs.TaskError, match="not positive"):
        envs.Policy.load(path)
    np.savez_compressed(path, header=np.zeros(10_000_000))
    with pytest.raises(envs.TaskError, match="it has 80000128 bytes when unpacked"):
        envs.Policy.load(path)
    np.savez(path, header=np.array([{"version": 1}], dtype=object))
    with pytest.raises(envs.TaskError, match="cannot be read: an array has objects"):
        envs.Policy.load(path)


@given(st.integers(1, 8), st.floats(0.0, 1.0), st.floats(0.0, 1.0), st.integers(0, 2**32 - 1))
def test_advantages_are_the_sums_of_their_definition(steps, discount, trace, seed):
    random = np.random.default_rng(seed)
    reward, value, following = random.normal(size=(3, steps, 2))
    ended = random.uniform(size=(steps, 2)) < 0.3
    found = advantages(reward, value, following, ended, discount, trace)
    errors = reward + discount * following - value
    for b in range(2):
        for t in range(steps):
            total, weight = 0.0, 1.0
            for k in range(t, steps):
                total += weight * errors[k, b]
                weight *= discount * trace
                if ended[k, b]:
                    break
            assert found[t, b] == pytest.approx(total, abs=1e-9)


@pytest.fixture(scope="module")
def trained(environment):
    settings = envs.PPOSettings(episodes=4, rollout=2 * environment.steps, epochs=2, batch=32, hidden=(16,))

    def once():
        training = envs.PolicyTraining(environment, settings, steps=3 * 4 * 2 * environment.steps, seed=1)
        training.run()
        return training

    return once(), once()


def test_the_same_seed_gives_the_same_policy(trained):
    one, two = trained
    assert one.is_done and len(one.history) == 3
    for a, b in zip(jax.tree.leaves(one.networks), jax.tree.leaves(two.networks), strict=True):
        np.testing.assert_array_equal(a, b)
    assert all(0.0 <= each.reward <= 1.0 for each in one.history)
    assert one.history[-1].steps == 3 * 4 * 2 * one.environment.steps


def test_the_policy_of_a_training_moved(trained):
    policy = trained[0].policy
    assert np.all(policy.deviation > 0.0) and np.std(np.asarray(policy.layers[-1][0])) > 0.0


def test_settings_of_a_training_that_are_not_allowed(environment):
    with pytest.raises(envs.TaskError, match="episodes × rollout"):
        envs.PPOSettings(episodes=2, rollout=2, batch=64)
    with pytest.raises(envs.TaskError, match="at least one rollout"):
        envs.PolicyTraining(environment, steps=10)


@pytest.mark.slow
def test_scores_are_mean_rewards(environment, policy, keys):
    scores = envs.policy_scores(environment, policy, keys)
    states, seen = environment.reset_many(keys)
    total = np.zeros(2)
    for _ in range(environment.steps):
        states, found = environment.step_many(states, policy.action(seen))
        total += np.asarray(found.reward)
        seen = found.observation
    np.testing.assert_allclose(scores, total / environment.steps, rtol=1e-5)


@pytest.mark.slow
def test_a_policy_commands_a_plant_as_it_commands_the_environment(environment, policy, keys):
    """The controller sees measurements only, and gives the commands of an episode without noise and delay."""
    state, seen = jax.tree.map(lambda leaf: leaf[0], environment.reset_many(keys))
    controller = envs.PolicyController(environment, policy, state.goal)
    for k in range(4):
        reference = environment.reference(state)
        command = controller.command(k * environment.dt, np.asarray(state.measured[0]), reference)
        many = jax.tree.map(lambda leaf: np.repeat(np.asarray(leaf)[None], 2, axis=0), state)
        many, found = environment.step_many(many, np.tile(policy.action(seen), (2, 1)))
        np.testing.assert_allclose(command.control, np.asarray(found.control)[0], atol=1e-5)
        state = jax.tree.map(lambda leaf: leaf[0], many)
        seen = found.observation[0]


def test_a_plant_with_other_bodies_is_refused(environment, policy, keys):
    state = jax.tree.map(lambda leaf: leaf[0], environment.reset_many(keys)[0])
    controller = envs.PolicyController(environment, policy, state.goal)
    with pytest.raises(envs.TaskError, match="the policy needs 6"):
        controller.command(0.0, np.zeros(3), environment.reference(state))


@pytest.mark.campaign
def test_the_predictive_controller_and_a_trained_policy_follow(robot):
    environment = envs.make("follow", robot)
    keys = jax.random.split(jax.random.PRNGKey(4), 2)
    reference = envs.controller_scores(environment, keys).mean()
    assert reference > 0.98
    training = envs.PolicyTraining(environment, steps=500_000)
    training.run(seconds=400.0)
    assert envs.policy_scores(environment, training.policy, keys).mean() > 0.9 * reference


@pytest.mark.slow
def test_an_episode_is_animated(environment, policy, tmp_path):
    image = pytest.importorskip("PIL.Image", reason="needs Pillow, the extra viz")
    path = envs.animate_episode(environment, policy, jax.random.PRNGKey(3), tmp_path / "episode.gif")
    with image.open(path) as moving:
        # one picture more than periods; pictures that are equal are merged
        assert 2 <= moving.n_frames <= environment.steps + 1
        assert moving.info["duration"] == round(1000 * environment.dt)
    with pytest.raises(ValueError, match="allowed for a motion"):
        envs.animate_episode(environment, policy, jax.random.PRNGKey(3), tmp_path / "episode.avi")
