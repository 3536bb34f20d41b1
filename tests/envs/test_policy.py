"""Policies: scores, and their use as controllers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from knode_cosserat import envs
from studies.ppo import PolicyTraining, PPOSettings


@pytest.fixture
def policy(environment):
    weights = jax.random.normal(jax.random.PRNGKey(0), (environment.observation_size, 4)) / 8.0
    return lambda observation: jnp.tanh(observation @ weights)


@pytest.mark.slow
def test_scores_are_mean_rewards(environment, policy, keys):
    scores = envs.policy_scores(environment, policy, keys)
    states, seen = environment.reset_many(keys)
    total = np.zeros(2)
    for _ in range(environment.steps):
        states, found = environment.step_many(states, policy(seen))
        total += np.asarray(found.reward)
        seen = found.observation
    np.testing.assert_allclose(scores, total / environment.steps, rtol=1e-5)


@pytest.mark.slow
def test_a_policy_commands_a_plant_as_it_commands_the_environment(environment, policy, keys):
    """The controller sees measurements only, and gives the commands of an episode without noise and delay."""
    state, seen = jax.tree.map(lambda leaf: leaf[0], environment.reset_many(keys))
    controller = envs.PolicyController(environment, policy, state)
    for k in range(4):
        reference = environment.reference(state)
        command = controller.command(k * environment.dt, np.asarray(state.measured[0]), reference)
        many = jax.tree.map(lambda leaf: np.repeat(np.asarray(leaf)[None], 2, axis=0), state)
        many, found = environment.step_many(many, np.tile(policy(seen), (2, 1)))
        np.testing.assert_allclose(command.control, np.asarray(found.control)[0], atol=1e-5)
        state = jax.tree.map(lambda leaf: leaf[0], many)
        seen = found.observation[0]


def test_a_plant_with_other_bodies_is_refused(environment, policy, keys):
    state = jax.tree.map(lambda leaf: leaf[0], environment.reset_many(keys)[0])
    controller = envs.PolicyController(environment, policy, state)
    with pytest.raises(envs.TaskError, match="the policy needs 6"):
        controller.command(0.0, np.zeros(3), environment.reference(state))


@pytest.mark.campaign
def test_the_predictive_controller_and_a_trained_policy_follow(robot):
    environment = envs.make("follow", robot)
    keys = jax.random.split(jax.random.PRNGKey(4), 2)
    reference = envs.controller_scores(environment, keys).mean()
    assert reference > 0.98
    training = PolicyTraining(environment, PPOSettings(steps=500_000))
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
