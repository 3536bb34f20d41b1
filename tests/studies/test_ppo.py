"""PPO of the study of environments: files of policies, advantages, and the same policy by the same seed."""

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from knode_cosserat import envs
from studies.ppo import Policy, PolicyTraining, PPOSettings, Rollout, network

STEPS = 12


def test_a_policy_is_read_as_it_was_written(tmp_path):
    layers = network(jax.random.PRNGKey(0), (9, 8, 4), 0.5)
    policy = Policy(layers, np.zeros(9, np.float32), np.ones(9, np.float32))
    policy.save(tmp_path / "policy.npz")
    again = Policy.load(tmp_path / "policy.npz")
    seen = np.random.default_rng(0).normal(size=(5, 9))
    np.testing.assert_array_equal(policy(seen), again(seen))
    assert np.max(np.abs(again(100.0 * seen))) <= 1.0


@given(st.integers(1, 8), st.floats(0.0, 1.0), st.floats(0.0, 1.0), st.integers(0, 2**32 - 1))
def test_advantages_are_the_sums_of_their_definition(steps, discount, trace, seed):
    random = np.random.default_rng(seed)
    reward, value, following = random.normal(size=(3, steps, 2))
    ended = random.uniform(size=(steps, 2)) < 0.3
    rollout = Rollout(None, None, None, value, reward, following, ended, None)
    advantages = rollout.advantages(discount, trace)
    errors = reward + discount * following - value
    for b in range(2):
        for t in range(steps):
            total, weight = 0.0, 1.0
            for k in range(t, steps):
                total += weight * errors[k, b]
                weight *= discount * trace
                if ended[k, b]:
                    break
            assert advantages[t, b] == pytest.approx(total, abs=1e-9)


def test_the_same_seed_gives_the_same_policy_which_moved():
    robot = envs.make("follow").robot.replace(nodes=6)
    environment = envs.make("follow", robot, duration=0.05 * STEPS)
    per_update = 4 * 2 * STEPS
    settings = PPOSettings(3 * per_update, 4, 2 * STEPS, epochs=2, batch=32, hidden=(16,))
    one, two = (PolicyTraining(environment, settings, seed=1) for _ in range(2))
    one.run()
    two.run()
    assert [progress.steps for progress in one.history] == [per_update, 2 * per_update, 3 * per_update]
    for a, b in zip(jax.tree.leaves(one.networks), jax.tree.leaves(two.networks), strict=True):
        np.testing.assert_array_equal(a, b)
    assert all(0.0 <= progress.reward <= 1.0 for progress in one.history)
    assert np.all(one.policy.deviation > 0.0) and np.std(np.asarray(one.policy.layers[-1][0])) > 0.0
