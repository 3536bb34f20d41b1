"""Sweeps in a folder: results of `simulate`, resumed after kills to the same bytes."""

import concurrent.futures
import dataclasses
import json
import os
import random
import signal
import subprocess
import sys
import time
import warnings
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import numpy as np
import pyarrow.compute
import pytest

import knode_cosserat as kc
from knode_cosserat import _processes
from knode_cosserat.sweeps import Plan, Sweep, SweepError, load_sweep, run_sweep
from knode_cosserat.sweeps._run import Work
from knode_cosserat.sweeps._shards import require_pyarrow, shard_bytes
from tests.commands import run, succeeded, told
from tests.sweeps.small_sweep import ROBOT, content, described

ROOT = Path(__file__).parents[2]


# results


@pytest.mark.slow
def test_cases_are_simulations(whole):
    """A sweep has other programs than `simulate`, so that results may differ by rounding."""
    plan = Plan.of(described())
    robot, cases = kc.load_robot(ROBOT["robot"]).replace(**ROBOT["set"]), plan.cases(1)
    # one batch: one program
    systems = [robot.replace(length=length) for length in cases.values["length"]]
    motion = kc.simulate(systems, cases.controls, 0.05, on_failure="return", recovery_budget=0.0)
    own = cases.values["height"] > 0.0
    np.testing.assert_array_equal(whole["result"][16:32][own], motion.result[own])
    tip = whole["tip_position"][16:32]
    np.testing.assert_allclose(tip[own], motion.tip_position[own], rtol=1e-9, atol=1e-12)
    errors = whole["position_error"][16:32]
    np.testing.assert_allclose(errors[own], motion.position_error[own], rtol=1e-6, atol=1e-12)
    np.testing.assert_array_equal(whole["length"][16:32], cases.values["length"])
    np.testing.assert_allclose(whole.time, motion.time)
    assert whole.unit("length") == "m" and whole.unit("tip_position") == "m"


@pytest.mark.slow
def test_failed_cases_are_kept_with_their_reasons(whole):
    failed = {each.case: each for each in whole.failed()}
    assert len(failed) == whole.failed_count == 24
    result, tip = whole["result"], whole["tip_position"]
    for case, each in failed.items():
        if each.values["height"] < 0.0:
            assert "a tension is -1 N" in each.reason
            assert np.all(result[case] == kc.Result.NOT_REACHED) and np.all(np.isnan(tip[case]))
        else:
            # how far such a tension gets depends on rounding
            solved = int(np.argmin(result[case] >= 0))
            assert solved <= 3 and result[case, solved] == kc.Result.NO_CONVERGENCE
            assert np.all(result[case, solved + 1 :] == kc.Result.NOT_REACHED)
            assert each.reason.startswith(
                f"step {solved} (t = {0.05 * solved:g} s): no solution found. Likely cause: tension"
            )
            assert np.all(np.isnan(tip[case, solved:])) and np.all(np.isfinite(tip[case, :solved]))
    solved = np.setdiff1d(np.arange(48), list(failed))
    assert np.all(result[solved] >= 0) and np.all(np.isfinite(tip[solved]))


@pytest.mark.slow
def test_the_data_say_what_they_are(whole):
    text = repr(whole)
    assert "48 of 48 cases (complete), 24 failed" in text and "length 0.5 to 0.7 m" in text
    assert "tip_position (5, 3) m" in text and "failed case 2: step" in text
    assert whole.verify() == 3 and len(whole) == 48
    table = whole.to_pandas()
    assert len(table) == 48 and {"case", "length", "height", "reason"} <= set(table.columns)
    assert whole.provenance["made_by"]["jax"] and whole.provenance["machine"]["cpu"]
    assert str(whole["result"][0, 0]) == "CONVERGED"
    assert sum(len(part["case"]) for part in whole.shards(["case"])) == 48
    rows = whole.dataset().to_table(columns=["case"], filter=pyarrow.compute.field("length") > 0.6)
    assert len(rows) == np.count_nonzero(whole["length"] > 0.6)
    with pytest.raises(KeyError, match="no column 'tip'; there are case"):
        whole["tip"]
    for name in ("case", "tip_position"):  # a table of any other tool
        table = require_pyarrow().parquet.read_table(whole.folder / "shards" / "000002.parquet")
        assert len(table.column(name)) == 16


@pytest.mark.slow
def test_recovery_solves_more_cases(tmp_path):
    robot = {"robot": ROBOT["robot"], "set": {"nodes": 5, "bending_damping": 1e-6}}
    sweep = described(robots=robot, vary={"height": [1.0, 300.0, 3e4]})
    failed = run_sweep(sweep, tmp_path / "failed", workers=1)
    assert np.any(failed["result"][1] < 0) and np.any(failed["result"][2] < 0)
    found = run_sweep(dataclasses.replace(sweep, recovery=True), tmp_path / "found", workers=1)
    one = kc.load_robot(ROBOT["robot"]).replace(**robot["set"])
    for k, height in enumerate((1.0, 300.0, 3e4)):
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="the grid is too coarse")
            motion = kc.simulate(
                one, kc.controls.step(height, 4, 0.05, at=0.1), 0.05, on_failure="return", recovery_budget=1e3
            )
        np.testing.assert_array_equal(found["result"][k], motion.result)
        np.testing.assert_allclose(found["tip_position"][k], motion.tip_position, rtol=1e-6, atol=1e-9)


@pytest.mark.campaign
def test_a_platform_starts_from_its_equilibrium(tmp_path):
    six = "six-legged-robot"
    radii = [0.9, 1.1] * np.asarray(kc.load_robot(six).platform_radius)
    sweep = Sweep(six, "none", 2, 0.02, vary={"platform_radius": radii.tolist()}, store=["position"])
    data = run_sweep(sweep, tmp_path / "a")
    for k, radius in enumerate(radii):
        robot = kc.load_robot(six).replace(platform_radius=radius)
        motion = kc.simulate(robot, kc.controls.parse("none", 2, 0.02, robot), 0.02)
        np.testing.assert_allclose(data["position"][k], motion.position, atol=1e-9)


# any executor, any interruption: the same bytes


@pytest.mark.slow
def test_two_processes_give_the_same_bytes(whole, tmp_path):
    run_sweep(described(), tmp_path / "two", workers=2)
    assert content(tmp_path / "two") == content(whole.folder)


@pytest.mark.slow
@pytest.mark.parametrize("cluster", ["debug", "local"])
def test_jobs_of_submitit_give_the_same_bytes(whole, tmp_path, cluster):
    submitit = pytest.importorskip("submitit")
    executor = submitit.AutoExecutor(tmp_path / "jobs", cluster=cluster)
    data = run_sweep(described(), tmp_path / "jobs-of", workers=2, executor=executor)
    assert data.is_complete and content(tmp_path / "jobs-of") == content(whole.folder)


def test_dask_gives_the_same_bytes(whole, tmp_path):
    distributed = pytest.importorskip("distributed")
    with (
        distributed.LocalCluster(
            n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None
        ) as cluster,
        distributed.Client(cluster, set_as_default=False) as client,
    ):
        data = run_sweep(described(), tmp_path / "dask", executor=client.get_executor(pure=False))
    assert data.is_complete and content(tmp_path / "dask") == content(whole.folder)


class Elsewhere(concurrent.futures.ThreadPoolExecutor):
    """A worker on a machine that does not see the folder of the sweep."""

    def submit(self, work, /):
        return super().submit(dataclasses.replace(work, folder=Path("/elsewhere")))


def test_workers_that_do_not_see_the_folder_give_the_same_bytes(whole, tmp_path):
    with Elsewhere(1) as executor:
        data = run_sweep(described(), tmp_path / "here", workers=2, executor=executor)
    assert data.is_complete and content(tmp_path / "here") == content(whole.folder)


#: a scheduler of one machine: it starts the script for each task of an array, and gives a number
FAKE_SBATCH = """#!{python}
import os, re, subprocess, sys
tasks = int(re.search(r"--array=0-(\\d+)", open(sys.argv[-1]).read())[1]) + 1
for k in range(tasks):
    names = {{"SLURM_JOB_ID": f"78{{k}}", "SLURM_ARRAY_JOB_ID": "77", "SLURM_ARRAY_TASK_ID": str(k)}}
    names |= {{"SLURM_NTASKS": "1", "SLURM_JOB_NUM_NODES": "1", "SLURM_JOB_NODELIST": "here"}}
    names |= dict.fromkeys(["SLURM_NODEID", "SLURM_PROCID", "SLURM_LOCALID"], "0")
    log = open(os.path.join(os.path.dirname(sys.argv[0]), f"log-{{k}}"), "w")
    subprocess.Popen(["bash", sys.argv[-1]], env=os.environ | names, stdout=log, stderr=log)
print("Submitted batch job 77")
"""
#: starts a command without the options before it
FAKE_SRUN = """#!/bin/sh
while [ "${1#-}" != "$1" ]; do case "$1" in --output|--error) shift 2;; *) shift;; esac; done
exec "$@"
"""


@pytest.mark.slow
def test_slurm_with_a_fake_scheduler_gives_the_same_bytes(whole, tmp_path, monkeypatch):
    submitit = pytest.importorskip("submitit")
    tools = tmp_path / "bin"
    tools.mkdir()
    for name, text in (
        ("sbatch", FAKE_SBATCH.format(python=sys.executable)),
        ("srun", FAKE_SRUN),
        ("sacct", "#!/bin/sh\necho 'JobID|State|NodeList'\n"),
        ("scontrol", "#!/bin/sh\necho here\n"),
    ):
        (tools / name).write_text(text)
        (tools / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{tools}:{os.environ['PATH']}")
    executor = submitit.AutoExecutor(tmp_path / "jobs", cluster="slurm")
    data = run_sweep(described(), tmp_path / "slurm", workers=2, executor=executor)
    assert data.is_complete and content(tmp_path / "slurm") == content(whole.folder)


def test_an_interrupted_job_goes_on_where_it_stopped(whole, copied):
    submitit = pytest.importorskip("submitit")
    (copied / "shards" / "000001.parquet").unlink()
    plan = Plan.of(described())
    again = Work(plan, copied, (0, 1, 2), whole.manifest["made_by"]).checkpoint()
    assert isinstance(again, submitit.helpers.DelayedSubmission)
    assert [shard.number for shard in again.result()] == [1]
    assert content(copied) == content(whole.folder)


SCRIPT = """
import sys
from pathlib import Path
from tests.sweeps.test_sweep import described
from knode_cosserat.sweeps import run_sweep
if __name__ == "__main__":
    run_sweep(described(), Path(sys.argv[1]), workers=int(sys.argv[2]))
"""


def started(tmp_path, folder, workers):
    (tmp_path / "start.py").write_text(SCRIPT)
    environment = os.environ | {"PYTHONPATH": f"{ROOT}:{ROOT / 'src'}"}
    return subprocess.Popen(
        [sys.executable, tmp_path / "start.py", folder, str(workers)], env=environment, cwd=tmp_path
    )


def shard_count(folder):
    return len(list((Path(folder) / "shards").glob("*.parquet")))


@pytest.mark.slow
def test_killed_again_and_again_it_ends_with_the_same_bytes(whole, tmp_path):
    """Killed as soon as a further shard is there: in the midst of the next one, or while it is written."""
    folder, generator = tmp_path / "killed", random.Random(0)
    for kills in range(2):
        process = started(tmp_path, folder, 1)
        until = time.monotonic() + 120.0
        while shard_count(folder) <= kills and process.poll() is None:
            assert time.monotonic() < until, "it takes too long"
            time.sleep(0.002)
        time.sleep(generator.uniform(0.0, 0.02))
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert load_sweep(folder).manifest == whole.manifest
    data = run_sweep(described(), folder, workers=1)
    assert data.is_complete and content(folder) == content(whole.folder)


@pytest.mark.campaign
def test_killed_at_random_five_times_with_two_processes(whole, tmp_path):
    folder, generator = tmp_path / "killed", random.Random(1)
    for _ in range(5):
        process = started(tmp_path, folder, 2)
        time.sleep(generator.uniform(1.0, 12.0))
        process.send_signal(signal.SIGKILL)
        process.wait()
    run_sweep(described(), folder)
    assert content(folder) == content(whole.folder)


def test_what_is_there_is_not_solved_again(whole, copied):
    (copied / "shards" / "000001.parquet").unlink()
    partial = load_sweep(copied)
    assert not partial.is_complete and len(partial) == 32 and "2 of 3 shards" in repr(partial)
    with pytest.raises(SweepError, match="1 of 3 shards are missing, first 1"):
        partial.verify()
    kept = (copied / "shards" / "000000.parquet").stat().st_mtime_ns
    run_sweep(described(), copied, workers=1)
    assert content(copied) == content(whole.folder)
    assert (copied / "shards" / "000000.parquet").stat().st_mtime_ns == kept
    runs = [json.loads(line) for line in (copied / "log.jsonl").read_text().splitlines()]
    assert runs[-1]["missing_shards"] == 1 and runs[-1]["solved_cases"] == 16
    assert runs[-1]["case_cpu_seconds"] > 0.0


# bad input


class Unable(concurrent.futures.Executor):
    """An executor that is not there, or whose workers die."""

    def __init__(self, error, accepts=True):
        self.error, self.accepts = error, accepts

    def submit(self, work, /):
        if not self.accepts:
            raise self.error
        future = concurrent.futures.Future()
        future.set_exception(self.error)
        return future


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"executor": "slurm"}, "executor is 'slurm'; allowed is one with submit"),
        ({"workers": 0}, "workers is 0; allowed is a whole number from 1 on"),
        ({"executor": Unable(OSError("no sbatch"), accepts=False)}, "jobs cannot be submitted: no sbatch$"),
        ({"executor": Unable(BrokenProcessPool("a\nb"))}, "died: b; complete shards are kept, and the same"),
        ({"executor": Unable(MemoryError())}, "died: MemoryError; complete"),
        ({"executor": Unable(SweepError("full"))}, "^full$"),
    ],
)
def test_executors_that_cannot_work(tmp_path, arguments, message):
    with pytest.raises(SweepError, match=message):
        run_sweep(described(), tmp_path / "a", **arguments)


def test_a_worker_of_another_version_refuses_to_work(tmp_path):
    with pytest.raises(SweepError, match="the workers have another"):
        Work(Plan.of(described()), tmp_path, (0,), {"jax": "0.1"})()


def test_equal_columns_give_equal_bytes():
    columns = {"case": np.arange(3), "a": np.random.default_rng(0).normal(size=(3, 2, 4)), "reason": [""] * 3}
    assert shard_bytes(columns, {"sweep": "x"}) == shard_bytes(dict(columns), {"sweep": "x"})


# the command

COMMAND = (
    "sweep",
    "delrin-tendon-robot",
    "--controls",
    "step:{height},at=0.1",
    "--vary",
    "height=0.5,1",
    "--steps",
    4,
    "--dt",
    0.05,
)


def test_the_command_runs_a_description_with_changes(whole, tmp_path):
    path = tmp_path / "sweep.yaml"
    path.write_text(
        "robots: {robot: delrin-tendon-robot, set: {nodes: 5, bending_damping: 0.02}}\n"
        "controls: 'step:{height},at=0.1'\nsteps: 9\ndt: 0.05\nshard: 16\n"
        "vary:\n  length: {low: 0.5, high: 0.7, count: 12}\n  height: [1]\n"
    )
    heights = "height=0.5,1,1e7,-6"
    facts = told("sweep", path, "--out", tmp_path / "a", "--steps", 4, "--vary", heights, "--workers", 1)
    assert (facts["cases"], facts["shards"], facts["failed"]) == (48, 3, 24)
    assert content(tmp_path / "a") == content(whole.folder)
    text = succeeded("sweep", path, "--out", tmp_path / "a", "--steps", 4, "--vary", heights)
    assert "48 of 48 cases (complete), 24 failed" in text and f"wrote {tmp_path / 'a'}" in text


def test_a_dry_run_writes_nothing(tmp_path):
    text = succeeded(*COMMAND, "--out", tmp_path / "a", "--dry-run")
    assert "2 cases" in text and "1 files of up to 4096 cases" in text and not (tmp_path / "a").exists()
    assert told(*COMMAND, "--out", tmp_path / "a", "--dry-run")["cases"] == 2


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (("--vary", "lenght=1:2:3"), "did you mean length"),
        (("--vary", "length=1:2:3:4"), "--vary must be NAME=LOW:HIGH"),
        (("--vary", "length"), "--vary must be NAME=LOW:HIGH"),
        (("--vary", "height=3"), "a name is given twice"),
        (("--dask", "tcp://a:1", "--workers", 2), "--dask without --workers"),
        (("--dask", "tcp://127.0.0.1:9"), "no Dask scheduler answers at"),
        (("--slurm", "mem_gb=3"), "required is --cluster slurm"),
        (("--cluster", "slrum"), "--cluster is 'slrum'; allowed is slurm, local or debug"),
        (("--cluster", "slurm"), "--cluster slurm: jobs cannot be submitted: "),
        (("--cluster", "local", "--slurm", "timeout=3"), "--cluster local: jobs cannot be submitted: "),
        (("--cluster", "debug", "--slurm", "mem_gb"), "--slurm must be NAME=VALUE"),
    ],
)
def test_the_command_refuses_mistakes_in_one_line(tmp_path, monkeypatch, more, message):
    monkeypatch.setattr(_processes, "PATIENCE", 0.3)
    result = run(*COMMAND, "--out", tmp_path / "a", *more)
    assert result.exit_code == 2 and message in result.stderr and result.stderr.count("\n") == 1
    assert not (tmp_path / "a" / "sweep.json").exists()
