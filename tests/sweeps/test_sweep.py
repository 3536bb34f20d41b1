"""Sweeps in a folder: results of `simulate`, resumed after kills to the same bytes, and damaged folders."""

import dataclasses
import hashlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
import warnings
from pathlib import Path

import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat.sweeps import Dask, Local, Plan, Range, Slurm, Sweep, SweepError, load_sweep, run_sweep
from knode_cosserat.sweeps.shard_file import KEY, OWN, read_shard, require_pyarrow, shard_bytes
from knode_cosserat.sweeps.work import ShardJob, Work
from tests.commands import run, succeeded, told

ROOT = Path(__file__).parents[2]
ROBOT = {"robot": "delrin-tendon-robot", "set": {"nodes": 5, "bending_damping": 0.02}}
#: the last of the heights gives a tension below 0, and the one before has no solution
HEIGHTS = [0.5, 1.0, 1e7, -6.0]


def described(**changes):
    given = {
        "robots": ROBOT, "controls": "step:{height},at=0.1", "steps": 4, "dt": 0.05, "shard": 16,
        "vary": {"length": Range(0.5, 0.7, count=12), "height": HEIGHTS},
    }  # fmt: skip
    return Sweep(**{**given, **changes})


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """An undisturbed sweep of 48 cases in 3 shards."""
    return run_sweep(described(), tmp_path_factory.mktemp("whole") / "sweep", executor=Local(1))


@pytest.fixture
def copied(whole, tmp_path):
    """A copy of the folder, to damage."""
    shutil.copytree(whole.folder, tmp_path / "copy")
    return tmp_path / "copy"


def content(folder):
    """The bytes of manifest and shards; the log has dates."""
    files = [file for file in Path(folder).rglob("*") if file.is_file() and file.name != "log.jsonl"]
    return {str(file.relative_to(folder)): file.read_bytes() for file in files if "jobs" not in file.parts}


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
            assert each.reason.startswith("step 2 (t = 0.1 s): no solution found. Likely cause: tension is")
            assert result[case].tolist() == [0, 0, -1, -3, -3]
            assert np.all(np.isnan(tip[case, 2:])) and np.all(np.isfinite(tip[case, :2]))
    solved = np.setdiff1d(np.arange(48), list(failed))
    assert np.all(result[solved] >= 0) and np.all(np.isfinite(tip[solved]))


@pytest.mark.slow
def test_the_data_say_what_they_are(whole):
    text = repr(whole)
    assert "48 of 48 cases (complete), 24 failed" in text and "length 0.5 to 0.7 m" in text
    assert "tip_position (5, 3) m" in text and "failed case 2: step 2" in text
    assert whole.verify() == 3 and len(whole) == 48
    table = whole.to_pandas()
    assert len(table) == 48 and {"case", "length", "height", "reason"} <= set(table.columns)
    assert whole.provenance["made_by"]["jax"] and whole.provenance["machine"]["cpu"]
    assert str(whole["result"][0, 0]) == "CONVERGED"
    assert sum(len(part["case"]) for part in whole.shards(["case"])) == 48
    with pytest.raises(KeyError, match="no column 'tip'; there are case"):
        whole["tip"]
    for name in ("case", "tip_position"):  # a table of any other tool
        table = require_pyarrow().parquet.read_table(whole.folder / "shards" / "000002.parquet")
        assert len(table.column(name)) == 16


@pytest.mark.slow
def test_recovery_solves_more_cases(tmp_path):
    robot = {"robot": ROBOT["robot"], "set": {"nodes": 5, "bending_damping": 1e-6}}
    sweep = described(robots=robot, vary={"height": [1.0, 300.0, 3e4]})
    failed = run_sweep(sweep, tmp_path / "failed", executor=Local(1))
    assert np.any(failed["result"][1] < 0) and np.any(failed["result"][2] < 0)
    found = run_sweep(dataclasses.replace(sweep, recovery=True), tmp_path / "found", executor=Local(1))
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
        motion = kc.simulate(robot, kc.named_controls.parse(robot, "none", 2, 0.02), 0.02)
        np.testing.assert_allclose(data["position"][k], motion.position, atol=1e-9)


# any executor, any interruption: the same bytes


@pytest.mark.slow
def test_two_processes_give_the_same_bytes(whole, tmp_path):
    run_sweep(described(), tmp_path / "two", executor=Local(2))
    assert content(tmp_path / "two") == content(whole.folder)


@pytest.mark.slow
@pytest.mark.parametrize("cluster", ["debug", "local"])
def test_jobs_of_submitit_give_the_same_bytes(whole, tmp_path, cluster):
    pytest.importorskip("submitit")
    data = run_sweep(described(), tmp_path / "jobs-of", executor=Slurm(2, cluster, {"timeout_min": 5}))
    assert data.is_complete and content(tmp_path / "jobs-of") == content(whole.folder)


def test_dask_gives_the_same_bytes(whole, tmp_path):
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None
    ) as cluster:
        data = run_sweep(described(), tmp_path / "dask", executor=Dask(cluster.scheduler_address))
    assert data.is_complete and content(tmp_path / "dask") == content(whole.folder)


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
    pytest.importorskip("submitit")
    tools = tmp_path / "bin"
    tools.mkdir()
    for name, text in (
        ("sbatch", FAKE_SBATCH.format(python=sys.executable)), ("srun", FAKE_SRUN),
        ("sacct", "#!/bin/sh\necho 'JobID|State|NodeList'\n"), ("scontrol", "#!/bin/sh\necho here\n"),
    ):  # fmt: skip
        (tools / name).write_text(text)
        (tools / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{tools}:{os.environ['PATH']}")
    data = run_sweep(described(), tmp_path / "slurm", executor=Slurm(2, "slurm", {"timeout_min": 5}))
    assert data.is_complete and content(tmp_path / "slurm") == content(whole.folder)


def test_an_interrupted_job_goes_on_where_it_stopped(whole, copied):
    submitit = pytest.importorskip("submitit")
    (copied / "shards" / "000001.parquet").unlink()
    plan = Plan.of(described())
    work = Work(plan, str(copied), whole.manifest["made_by"])
    again = ShardJob(work, (0, 1, 2)).checkpoint()
    assert isinstance(again, submitit.helpers.DelayedSubmission)
    assert again.result() == 1
    assert content(copied) == content(whole.folder)


SCRIPT = """
import sys
from pathlib import Path
from tests.sweeps.test_sweep import described
from knode_cosserat.sweeps import Local, run_sweep
if __name__ == "__main__":
    run_sweep(described(), Path(sys.argv[1]), executor=Local(int(sys.argv[2])))
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
    data = run_sweep(described(), folder, executor=Local(1))
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
    run_sweep(described(), copied, executor=Local(1))
    assert content(copied) == content(whole.folder)
    assert (copied / "shards" / "000000.parquet").stat().st_mtime_ns == kept
    runs = [json.loads(line) for line in (copied / "log.jsonl").read_text().splitlines()]
    assert runs[-1]["missing_shards"] == 1 and runs[-1]["solved_cases"] == 16
    assert runs[-1]["case_cpu_seconds"] > 0.0


# damaged folders and bad input


def read_or_reason(path):
    try:
        return read_shard(path)
    except SweepError as error:
        return str(error)


def rewritten(path, **changes):
    """Write a shard with other metadata."""
    pyarrow = require_pyarrow()
    table = pyarrow.parquet.read_table(path)
    about = json.loads(table.schema.metadata[KEY]) | changes
    # as earlier versions wrote it
    del about[OWN]
    pyarrow.parquet.write_table(table.replace_schema_metadata({KEY: json.dumps(about).encode()}), path)


def test_a_shard_of_another_version_is_refused_and_stays(copied):
    path = copied / "shards" / "000001.parquet"
    rewritten(path, version=2)
    before = content(copied)
    for call in (lambda: run_sweep(described(), copied), lambda: load_sweep(copied).verify()):
        with pytest.raises(SweepError, match=r"000001\.parquet: the shard has the version 2; allowed is 1"):
            call()
    assert content(copied) == before


def test_a_shard_of_another_sweep_is_refused(copied):
    rewritten(copied / "shards" / "000001.parquet", sweep="other")
    for call in (lambda: run_sweep(described(), copied), lambda: load_sweep(copied)["length"]):
        with pytest.raises(SweepError, match="belongs to another sweep"):
            call()


def test_damaged_shards_are_told_and_solved_again(whole, copied):
    path = copied / "shards" / "000001.parquet"
    good, generator = path.read_bytes(), random.Random(3)
    damaged = [good[: len(good) // 2], b"", b"PAR1"]
    for _ in range(20):
        at = generator.randrange(len(good))
        damaged.append(good[:at] + bytes([good[at] ^ (1 << generator.randrange(8))]) + good[at + 1 :])
    for text in damaged:
        path.write_bytes(text)
        shard = read_or_reason(path)
        if isinstance(shard, str):
            assert str(path) in shard and "\n" not in shard
            continue
        # a change where no value depends on it, such as the name of the writer
        for name, values in read_shard(whole.folder / "shards" / "000001.parquet").columns.items():
            np.testing.assert_array_equal(shard.columns[name], values)
    path.write_bytes(good[: len(good) // 2])
    run_sweep(described(), copied, executor=Local(1))
    assert content(copied) == content(whole.folder)


def signed(manifest):
    """Return a manifest's text with the checksum of its other keys."""
    digest = hashlib.sha256(json.dumps(manifest, sort_keys=True).encode()).hexdigest()
    return json.dumps(manifest | {"checksum": digest})


def test_another_description_in_the_same_folder_is_refused(copied):
    with pytest.raises(SweepError, match="another sweep is here: its steps is 4; allowed is the same"):
        run_sweep(described(steps=5), copied)
    manifest = json.loads((copied / "sweep.json").read_text())
    del manifest["checksum"]
    for changes, message in (
        ({"made_by": manifest["made_by"] | {"jax": "0.1"}}, "begun with jax 0.1, and this is"),
        ({"version": 9}, "the sweep has the version 9; allowed is 1 or 2"),
        ({"format": "other"}, "not the manifest of a sweep"),
        ({"cases": "many"}, "must be whole numbers above 0"),
        ({"shard_cases": 0}, "must be whole numbers above 0"),
        ({"shards": 10**15}, "contradict each other"),
        ({"robots": [None] * len(manifest["robots"])}, "a robot has no columns"),
        ({"sweep": []}, "allowed are the keys"),
    ):
        (copied / "sweep.json").write_text(signed(manifest | changes))
        with pytest.raises(SweepError, match=message):
            run_sweep(described(), copied)
    (copied / "sweep.json").write_text(signed(manifest).replace('"seed": 0', '"seed": 1'))
    with pytest.raises(SweepError, match="damaged or changed: its contents do not have its checksum"):
        load_sweep(copied)
    # as earlier versions wrote it
    (copied / "sweep.json").write_text(json.dumps(manifest | {"version": 1}))
    assert load_sweep(copied).manifest["cases"] == manifest["cases"]
    (copied / "sweep.json").write_text("[" * 100_000)
    with pytest.raises(SweepError, match="damaged: not JSON that is read: it is nested too deeply"):
        load_sweep(copied)
    (copied / "sweep.json").write_text("{")
    with pytest.raises(SweepError, match="damaged: not JSON"):
        load_sweep(copied)
    (copied / "sweep.json").unlink()
    with pytest.raises(SweepError, match="no sweep is here"):
        load_sweep(copied)
    with pytest.raises(SweepError, match=r"there are shards without their sweep\.json"):
        run_sweep(described(), copied)


@pytest.mark.slow
def test_a_disk_that_fills_up_loses_nothing(whole, copied, tmp_path):
    """The limit of a file's size stands for the full disk."""
    (copied / "shards" / "000002.parquet").unlink()
    before = content(copied)
    script = f"""
import resource, signal, sys
from pathlib import Path
from tests.sweeps.test_sweep import described
from knode_cosserat.sweeps import Local, run_sweep
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
import jax
jax.config.update("jax_enable_compilation_cache", False)
resource.setrlimit(resource.RLIMIT_FSIZE, (1000, resource.RLIM_INFINITY))
try:
    run_sweep(described(), Path({str(copied)!r}), executor=Local(1))
except ValueError as error:
    print(error)
"""
    environment = os.environ | {"PYTHONPATH": f"{ROOT}:{ROOT / 'src'}"}
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("\n") == 1
    assert "000002.parquet: cannot be written: File too large; complete shards are kept" in done.stdout
    assert content(copied) == before
    run_sweep(described(), copied, executor=Local(1))
    assert content(copied) == content(whole.folder)


def test_executors_that_cannot_work(tmp_path, monkeypatch):
    from knode_cosserat import _processes

    monkeypatch.setattr(_processes, "PATIENCE", 0.3)
    for executor, message in (
        (Dask("tcp://127.0.0.1:9"), "no Dask scheduler answers at"),
        (Slurm(1, "slrum"), "cluster is 'slrum'; allowed is slurm, local or debug"),
        (Slurm(1, "slurm"), "slurm: jobs cannot be submitted: "),
        (Slurm(1, "local", {"timeout": 3}), "local: jobs cannot be submitted: "),
    ):
        with pytest.raises(SweepError, match=message):
            run_sweep(described(), tmp_path / "a", executor=executor)
    with pytest.raises(SweepError, match="executor is a str"):
        run_sweep(described(), tmp_path / "b", executor="slurm")
    work = Work(Plan.of(described()), None, {"jax": "0.1"})
    with pytest.raises(SweepError, match="the workers have another"):
        work.solve(0)


def test_equal_columns_give_equal_bytes():
    columns = {"case": np.arange(3), "a": np.random.default_rng(0).normal(size=(3, 2, 4)), "reason": [""] * 3}
    assert shard_bytes(columns, {"sweep": "x"}) == shard_bytes(dict(columns), {"sweep": "x"})


# the command

COMMAND = (
    "sweep", "delrin-tendon-robot", "--controls", "step:{height},at=0.1", "--vary", "height=0.5,1",
    "--steps", 4, "--dt", 0.05,
)  # fmt: skip


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
        (("--slurm", "mem_gb=3"), "required is --cluster slurm"),
        (("--cluster", "debug", "--slurm", "mem_gb"), "--slurm must be NAME=VALUE"),
    ],
)
def test_the_command_refuses_mistakes_in_one_line(tmp_path, more, message):
    result = run(*COMMAND, "--out", tmp_path / "a", *more)
    assert result.exit_code == 2 and message in result.stderr and result.stderr.count("\n") == 1
    assert not (tmp_path / "a").exists()
