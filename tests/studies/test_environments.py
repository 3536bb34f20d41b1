"""The study of environments: its table, and its jobs on a small scale."""

import numpy as np
import pytest

pytest.importorskip("gymnasium", reason="needs gymnasium: pip install 'knode-cosserat[rl]'")

from knode_cosserat import envs
from studies import environments


@pytest.fixture
def facts():
    found = {f"task-{name}": {"score": 0.9, "refused": ""} for name in envs.tasks.TASKS}
    found["rate"] = {"rate": 7e4, "raw": 8e4, "ratio": 0.875, "compiled": 0, "different": 0}
    found["ppo"] = {"ratio": 0.95, "until": 200.0, "curve": [[4096, 1.0, 0.2]]}
    found["sweep"] = {
        "parallel_efficiency": {"wall": 0.95, "cores": 0.97},
        "seconds_for_a_million": 700.0,
        "identical": True,
    }
    return found


def test_every_limit_is_checked(facts):
    assert all(each["ok"] for each in environments.checks(facts))
    facts["rate"] |= {"rate": 5e4, "ratio": 0.5, "compiled": 1, "different": 3}
    facts["task-gate"]["refused"] = "no"
    facts["ppo"] |= {"ratio": 0.8, "until": 1e9}
    facts["sweep"] |= {"identical": False, "seconds_for_a_million": 1000.0}
    facts["sweep"]["parallel_efficiency"] = {"wall": 0.5, "cores": 0.5}
    assert not any(each["ok"] for each in environments.checks(facts))
    text = environments.as_markdown(environments.checks(facts), facts)
    assert "| gate" in text and "no" in text


@pytest.mark.campaign
def test_the_rate_counts_steps_and_repeats_bit_for_bit():
    found = environments.rate({"episodes": 8}).facts
    assert found["compiled"] == 0 and found["different"] == 0
    assert found["ratio"] == pytest.approx(found["rate"] / found["raw"])


def test_scored_episodes_are_always_the_same():
    np.testing.assert_array_equal(environments.keys(3), environments.keys(3))


def test_jobs_of_the_quick_study_are_among_those_of_the_full_one():
    quick, full = ({job.key for job in environments.jobs(quick)} for quick in (True, False))
    assert quick <= full


@pytest.mark.campaign
def test_a_policy_is_taken_to_the_stand_in():
    pytest.importorskip("elastica", reason="needs pyelastica")
    found = environments.real({"seconds": 40.0, "episodes": 1}).facts
    assert 0.0 <= found["real"] <= 1.0 and found["gap"] == pytest.approx(1.0 - found["real"] / found["score"])
