import importlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import knode_cosserat as kc
import studies
from knode_cosserat import _processes
from studies import runner
from studies.runner import Job, StudyError, run

#: jobs have to be in a module that other processes can import
MODULE = """
import os, time
from pathlib import Path
from studies.runner import Product

def square(settings):
    with Path(settings["log"]).open("a") as log:
        log.write(f"{settings['x']} {os.getpid()}\\n")
    x = settings["x"]
    return Product({"square": x * x, "third": x / 3}, {f"files/{x}.txt": b"%d" % x})

def wait(settings):
    square(settings)
    time.sleep(60)

def die(settings):
    os._exit(1)

def refuse(settings):
    raise ValueError("this job cannot be done")
"""
NAME = "jobs_of_a_test"


@pytest.fixture
def work(tmp_path, monkeypatch):
    (tmp_path / f"{NAME}.py").write_text(MODULE)
    monkeypatch.syspath_prepend(tmp_path)
    yield importlib.import_module(NAME)
    del sys.modules[NAME]


def squares(work, folder, count=4):
    return [Job(f"job-{x}", work.square, {"x": x, "log": str(folder / "log")}) for x in range(count)]


def ran(folder):
    """Which jobs were run, each time it was."""
    log = folder / "log"
    return sorted(int(line.split()[0]) for line in log.read_text().splitlines()) if log.exists() else []


EXPECTED = {f"job-{x}": {"square": x * x, "third": x / 3} for x in range(4)}


@pytest.mark.parametrize("workers", [1, 2])
def test_every_job_is_run_once_and_its_facts_and_files_are_kept(tmp_path, work, workers):
    out = tmp_path / "out"
    for _ in range(2):
        found = run(squares(work, tmp_path), out, workers=workers)
        assert found == EXPECTED
        assert list(found) == list(EXPECTED)
    assert ran(tmp_path) == [0, 1, 2, 3]
    assert (out / "files/3.txt").read_text() == "3"
    own = str(os.getpid())
    pids = {line.split()[1] for line in (tmp_path / "log").read_text().splitlines()}
    assert pids == {own} if workers == 1 else own not in pids
    record = json.loads((out / "jobs/job-3.json").read_text())
    assert record["settings"]["x"] == 3
    assert record["made_by"]["jax"] and record["seconds"] >= 0


def test_what_is_stale_or_damaged_is_run_again_and_nothing_else(tmp_path, work):
    run(squares(work, tmp_path), tmp_path, workers=1)
    (tmp_path / "log").unlink()

    (tmp_path / "jobs/job-0.json").write_text("{")
    (tmp_path / "files/1.txt").write_text("7")
    jobs = squares(work, tmp_path)
    jobs[2] = Job("job-2", work.square, {**jobs[2].settings, "more": None})
    assert run(jobs, tmp_path, workers=1) == EXPECTED
    assert ran(tmp_path) == [0, 1, 2]
    assert (tmp_path / "files/1.txt").read_text() == "1"


def test_a_result_of_other_code_is_not_taken(tmp_path, work, monkeypatch):
    run(squares(work, tmp_path), tmp_path, workers=1)
    monkeypatch.setattr(runner, "made_by", lambda: {"code": "another"})
    run(squares(work, tmp_path, 2), tmp_path, workers=1)
    assert ran(tmp_path) == [0, 0, 1, 1, 2, 3]


def test_workers_that_run_other_code_are_refused(tmp_path, work, monkeypatch):
    own = runner.made_by()
    monkeypatch.setattr(runner, "made_by", lambda: {**own, "jax": "0.0.1"})
    with pytest.raises(
        StudyError, match=f"the workers run another jax than this process: {own['jax']}, not 0.0"
    ):
        run(squares(work, tmp_path), tmp_path, workers=2)


def test_an_error_of_a_job_is_the_studys_and_what_was_done_stays(tmp_path, work):
    jobs = [*squares(work, tmp_path, 1), Job("bad", work.refuse, {})]
    with pytest.raises(ValueError, match="this job cannot be done"):
        run(jobs, tmp_path, workers=1)
    assert sorted(path.name for path in (tmp_path / "jobs").iterdir()) == ["job-0.json"]


def test_a_process_that_dies_is_told_in_one_line(tmp_path, work):
    with pytest.raises(StudyError, match=r"a process that ran a job died.*goes on where it stopped"):
        run([Job("a", work.die, {}), Job("b", work.die, {})], tmp_path, workers=2)
    assert list((tmp_path / "jobs").iterdir()) == []


def alive(pid):
    try:
        status = Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return False
    return status.rsplit(")", 1)[1].split()[0] != "Z"


def until(condition, seconds=60.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it takes too long"
        time.sleep(0.02)


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="processes are looked up in /proc")
def test_killed_it_leaves_no_process_behind_and_the_rest_is_done_by_the_next_run(tmp_path, work):
    script = f"""
import sys; sys.path.insert(0, {str(tmp_path)!r})
import {NAME} as work
from pathlib import Path
from studies.runner import Job, run
log = {str(tmp_path / "log")!r}
jobs = [Job("job-0", work.square, {{"x": 0, "log": log}})]
jobs += [Job(f"job-{{x}}", work.wait, {{"x": x, "log": log}}) for x in (1, 2)]
if __name__ == "__main__":
    run(jobs, Path({str(tmp_path)!r}), workers=2)
"""
    sources = (str(Path(file).parents[1]) for file in (kc.__file__, studies.__file__))
    (tmp_path / "start.py").write_text(script)
    started = subprocess.Popen(
        [sys.executable, tmp_path / "start.py"],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sources)},
        stdin=subprocess.DEVNULL,
    )
    until(lambda: ran(tmp_path) == [0, 1, 2] and (tmp_path / "jobs/job-0.json").exists())
    pids = {int(line.split()[1]) for line in (tmp_path / "log").read_text().splitlines()}
    assert len(pids) == 2 and all(map(alive, pids))
    started.send_signal(signal.SIGKILL)
    started.wait()
    until(lambda: not any(map(alive, pids)), 20.0)

    kept = (tmp_path / "jobs/job-0.json").stat().st_mtime_ns
    assert sorted(path.name for path in (tmp_path / "jobs").iterdir()) == ["job-0.json"]
    assert run(squares(work, tmp_path, 3), tmp_path, workers=1) == dict(list(EXPECTED.items())[:3])
    assert ran(tmp_path) == [0, 1, 1, 2, 2]
    assert (tmp_path / "jobs/job-0.json").stat().st_mtime_ns == kept


# a cluster


def test_without_a_scheduler_there_is_one_line(tmp_path, work, monkeypatch):
    monkeypatch.setattr(_processes, "PATIENCE", 0.3)
    with pytest.raises(StudyError, match=r"no Dask scheduler answers at 'tcp://127\.0\.0\.1:1'"):
        run(squares(work, tmp_path), tmp_path, dask="tcp://127.0.0.1:1")
    with pytest.raises(StudyError, match="no Dask scheduler answers at 'nonsense://1'"):
        run(squares(work, tmp_path), tmp_path, dask="nonsense://1")


def test_without_dask_it_says_what_to_install(tmp_path, work, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ImportError, match=r"pip install 'knode-cosserat\[dask\]'"):
        run(squares(work, tmp_path), tmp_path, dask="tcp://127.0.0.1:1")


@pytest.fixture
def cluster():
    """A scheduler and two processes of one thread each."""
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None
    ) as cluster:
        yield cluster


@pytest.mark.campaign
def test_a_cluster_gives_the_same(tmp_path, work, cluster):
    out = tmp_path / "out"
    assert run(squares(work, tmp_path), out, dask=cluster.scheduler_address) == EXPECTED
    assert (out / "files/3.txt").read_text() == "3"
    assert str(os.getpid()) not in {line.split()[1] for line in (tmp_path / "log").read_text().splitlines()}
    assert run(squares(work, tmp_path), out, workers=1) == EXPECTED
    assert ran(tmp_path) == [0, 1, 2, 3]
