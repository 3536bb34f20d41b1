"""Gymnasium's classes: spaces, ends of episodes in all modes, seeds, and no compilation in between."""

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

from knode_cosserat import envs
from knode_cosserat.control.loop import _COMPILATIONS
from tests.envs.conftest import STEPS


def again(vector, mode):
    """The same programs in another mode."""
    other = envs.VectorEnv(vector.environment, vector.num_envs, mode)
    other.reset(seed=0)
    return other


@pytest.mark.slow
def test_nothing_is_compiled_after_the_start(vector):
    vector.reset(seed=0)
    before = _COMPILATIONS.count
    for _ in range(STEPS + 2):
        vector.step(vector.action_space.sample())
    vector.reset(seed=1)
    assert _COMPILATIONS.count == before


def test_the_same_seed_gives_the_same_bits(vector):
    def played(seed):
        seen, _ = vector.reset(seed=seed)
        rows = [seen, *(vector.step(np.full((4, 4), 0.1 * k))[0] for k in range(STEPS + 3))]
        return np.stack(rows).tobytes()

    assert played(5) == played(5) != played(6)


def test_next_step(vector):
    assert vector.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    vector.reset(seed=0)
    for _ in range(STEPS):
        seen, _, terminated, truncated, info = vector.step(np.zeros((4, 4)))
    assert np.all(truncated) and not np.any(terminated)
    assert np.all(info["ending"] == envs.Ending.TIME_LIMIT)
    fresh, reward, _, truncated, _ = vector.step(np.ones((4, 4)))
    assert not np.any(truncated) and np.all(reward == 0.0)
    assert not np.allclose(fresh, seen)
    # the last command of a new episode is the one at the start
    np.testing.assert_allclose(fresh[:, 18:22], -1.0)


def test_same_step(vector):
    same = again(vector, "same-step")
    for _ in range(STEPS):
        seen, _, _, truncated, info = same.step(np.zeros((4, 4)))
    assert np.all(truncated) and np.all(info["_final_obs"])
    last = np.stack(info["final_obs"])
    assert not np.allclose(last, seen)
    np.testing.assert_allclose(seen[:, 18:22], -1.0)
    assert np.all(info["final_info"]["ending"] == envs.Ending.TIME_LIMIT)


def test_disabled(vector):
    disabled = again(vector, "disabled")
    for _ in range(STEPS):
        last, _, _, truncated, _ = disabled.step(np.zeros((4, 4)))
    assert np.all(truncated)
    with pytest.raises(envs.TaskError, match="episode 0 has ended"):
        disabled.step(np.zeros((4, 4)))
    seen, _ = disabled.reset(options={"reset_mask": np.array([True, True, False, False])})
    np.testing.assert_array_equal(seen[2:], last[2:])
    assert not np.allclose(seen[:2], last[:2])


@pytest.mark.parametrize("actions", [np.zeros(4), np.zeros((3, 4)), np.full((4, 4), np.nan), "left"])
def test_wrong_actions_are_refused(vector, actions):
    vector.reset(seed=0)
    with pytest.raises(envs.TaskError, match="action"):
        vector.step(actions)


@pytest.mark.parametrize(("count", "mode"), [(0, "next-step"), (2.5, "next-step"), (2, "never")])
def test_wrong_numbers_and_modes_are_refused(environment, count, mode):
    with pytest.raises(envs.TaskError, match="allowed"):
        envs.VectorEnv(environment, count, mode)


@pytest.mark.slow
def test_gymnasium_finds_nothing_to_complain_about(environment):
    check_env(envs.SingleEnv(environment), skip_render_check=True)


def test_a_step_before_the_first_reset_is_refused(environment):
    with pytest.raises(gymnasium.error.ResetNeeded):
        envs.SingleEnv(environment).step(np.zeros(4))


def test_an_episode_is_drawn(environment):
    single = envs.SingleEnv(environment)
    single.render_mode = "rgb_array"
    single.reset(seed=0)
    image = single.render()
    assert image.ndim == 3 and image.shape[2] == 3 and image.std() > 5


def test_names_are_registered(robot):
    envs.register()
    names = {f"knode_cosserat/{name.capitalize()}-v0" for name in envs.tasks.TASKS}
    assert names <= set(gymnasium.registry)
    made = gymnasium.make("knode_cosserat/Reach-v0", robot=robot, duration=0.5)
    assert made.unwrapped.environment.task.name == "reach"
    assert made.spec.id == "knode_cosserat/Reach-v0"


def test_stable_baselines(environment):
    pytest.importorskip(
        "stable_baselines3", reason="needs stable-baselines3: pip install 'knode-cosserat[sb3]'"
    )
    made = envs.StableBaselinesEnv(environment, 4)
    made.seed(3)
    seen = made.reset()
    assert seen.shape == (4, environment.observation_size)
    for _ in range(STEPS):
        _, reward, done, infos = made.step(np.zeros((4, 4), dtype=np.float32))
    assert np.all(done) and reward.dtype == np.float32
    assert all(info["TimeLimit.truncated"] for info in infos)
    assert infos[0]["terminal_observation"].shape == (environment.observation_size,)
    assert infos[0]["ending"] == "time limit"


@pytest.mark.campaign
@pytest.mark.parametrize("name", [name for name in envs.tasks.TASKS if name != "follow"])
def test_every_task_passes_the_check(name):
    check_env(envs.SingleEnv(envs.make(name)), skip_render_check=True)
