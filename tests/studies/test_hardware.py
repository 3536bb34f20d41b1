"""Study of the firmware and the closed loop: its jobs, its checks, and faults within the closed loop."""

import os

import numpy as np
import pytest

from knode_cosserat_hardware.emulation import missing
from studies import hardware
from studies.hardware import Cable
from studies.runner import Job, Product

FACTS = {
    "build": {"seconds": 5.0, "flash": 20_000, "ram": 1800},
    "fuzz": {"unsafe": 0, "armed": 1},
    "steps": {"settling": 0.09, "overshoot": 5.0, "rate": 250.0},
    "watchdog": {"left": 5.0},
    "repeat": {"different": 0, "speed": 4.0},
    "loop": {"rmse": 0.2, "unsafe": 0, "faults": 0},
    "loop-faults": {"missed": 0, "dead": 0, "unsafe": 0},
}


def process(settings):
    return Product({"process": os.getpid()}, {})


def test_each_figure_has_a_limit():
    assert all(each["ok"] for each in hardware.checks(FACTS))
    for name in ("missed", "dead", "unsafe"):
        changed = FACTS | {"loop-faults": FACTS["loop-faults"] | {name: 1}}
        failed = [each["check"] for each in hardware.checks(changed) if not each["ok"]]
        assert len(failed) == 1 and "closed loop" in failed[0]
    table = hardware.as_markdown(hardware.checks(FACTS))
    assert "emulation relative to real time" in table and "| yes |" in table


def test_quick_runs_have_each_fault():
    from studies.hardware import KINDS, NOISE_BURST

    by_key = {job.key: job.settings for job in hardware.jobs(quick=True)}
    assert by_key["loop-faults"]["runs"] >= len((*KINDS, NOISE_BURST))


def test_speeds_are_measured_after_the_other_jobs_in_this_process(tmp_path):
    keys = ("repeat", "build", "fuzz")
    facts = hardware.facts_of([Job(key, process, {}) for key in keys], tmp_path, workers=2)
    assert facts["repeat"]["process"] == os.getpid()
    assert os.getpid() not in {facts["build"]["process"], facts["fuzz"]["process"]}
    ages = {key: (tmp_path / "jobs" / f"{key}.json").stat().st_mtime_ns for key in keys}
    assert ages["repeat"] > max(ages["build"], ages["fuzz"])


def test_a_burst_of_bit_errors_ends():
    now = [0.0]
    cable = Cable(np.random.default_rng(0), lambda: now[0])
    line = bytes(1000)
    assert cable(line).count(0) > 995
    cable.begin_burst(0.02, 0.4)
    assert 700 < cable(line).count(0) < 950
    now[0] = 0.5
    assert cable(line).count(0) > 995


@pytest.mark.campaign
@pytest.mark.skipif(bool(missing()), reason=f"the firmware cannot be built here: {missing()}")
def test_faults_within_the_closed_loop_are_caught_and_recovered_from():
    from studies.hardware import loop_faults

    facts = loop_faults({"runs": 8}).facts
    assert facts["missed"] == facts["dead"] == facts["unsafe"] == 0, facts["trials"]
    assert {each["kind"] for each in facts["trials"]} >= {"emergency-stop", "line-noise", "restarted"}
    assert facts["highest"] < 15.0
