"""Figures of sweeps: rates, parallel efficiency, interrupted runs, and memory.

All sweeps are runs of the command in processes of their own. On a shared machine wall times depend on what
else runs. Ratios are therefore given by the time of the cores too.
"""

from __future__ import annotations

import hashlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from knode_cosserat.rods.parameters import parameter_at
from knode_cosserat.rods.wrapped import nominal_model
from knode_cosserat.solvers.simulate import simulate
from knode_cosserat.sweeps import Plan, Range, Sweep
from knode_cosserat.sweeps._folder import LOG, SHARDS
from knode_cosserat.sweeps._run import SHARDS_EACH
from knode_cosserat.sweeps._shards import require_pyarrow

#: steps of a rollout, and time step (s)
STEPS, DT = 20, 0.05
#: cases of a shard of the measured sweeps: enough shards for short sweeps too
SHARD = 1024
#: repetitions of a raw batch, of which the fastest counts
ROUNDS = 3
#: largest time (s) for a killed run to write its next shard
PATIENCE = 600.0


def sweep_of(rollouts: int, seed: int = 0) -> Sweep:
    """Return a sweep over a robot's stiffness and its tensions."""
    return Sweep(
        "delrin-tendon-robot",
        "sine:{period},amplitude={amplitude}",
        STEPS,
        DT,
        vary={
            "period": Range(0.8, 3.0),
            "amplitude": Range(0.5, 2.0),
            "youngs_modulus": Range(2e9, 3e9),
        },
        sampler="sobol",
        samples=rollouts,
        seed=seed,
        shard=min(SHARD, max(16, rollouts // 16)),
    )


def measure_sweep(
    folder: str | Path, rollouts: int = 32_768, *, kills: int = 5, log: Callable[[str], None] | None = None
) -> dict[str, Any]:
    """Return the figures of a sweep, measured in a folder that is emptied before.

    Args:
        folder: for the sweeps' folders; some 0.6 kB a rollout, three times.
        rollouts: number of rollouts with two workers; 2,048 take about a minute, a million is the full study.
        kills: how often the interrupted sweep is killed.
        log: receives a line for each step.

    Returns:
        Plain data: `rollouts_per_second` (wall, with start and compilation), `steady_per_second` (from the
        files' times, without them), `seconds_for_a_million` (by the steady rate), `ratio_to_raw` and
        `parallel_efficiency` (each by wall and by core time), `identical` after `kills` kills, and
        `megabytes` of the largest process.
    """
    require_pyarrow()
    tell, folder = log or (lambda _: None), Path(folder)
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    raw = _raw_batch(sweep_of(rollouts))
    tell(f"raw batch: {raw['per_second']:.0f} rollouts/s, {1.0 / raw['cpu']:.0f} a core")
    single = _run(folder / "one", sweep_of(max(64, rollouts // 2)), workers=1)
    tell(f"one worker: {single['steady_per_second']:.0f} rollouts/s")
    double = _run(folder / "two", sweep_of(rollouts), workers=2)
    tell(f"two workers: {double['steady_per_second']:.0f} rollouts/s")
    killed = _killed(folder / "killed", sweep_of(rollouts), kills)
    identical = digest(folder / "killed") == digest(folder / "two")
    tell(f"killed {killed} times: {'identical' if identical else 'DIFFERENT'}")
    steady = double["steady_per_second"]
    return {
        "rollouts": rollouts,
        "steps": STEPS,
        "seconds": double["seconds"],
        "rollouts_per_second": rollouts / double["seconds"],
        "steady_per_second": steady,
        "seconds_for_a_million": 1e6 / steady,
        "core_seconds_for_a_million": 1e6 * double["cpu"],
        "raw_per_second": raw["per_second"],
        "ratio_to_raw": {"wall": steady / raw["per_second"], "cores": raw["cpu"] / double["cpu"]},
        "parallel_efficiency": {
            "wall": steady / (2.0 * single["steady_per_second"]), "cores": single["cpu"] / double["cpu"],
        },
        "kills": killed,
        "identical": identical,
        "megabytes": double["megabytes"],
        "disk_megabytes": sum(file.stat().st_size for file in (folder / "two").rglob("*.parquet")) / 1e6,
    }  # fmt: skip


def _raw_batch(sweep: Sweep) -> dict[str, float]:
    """Return the rate of `simulate` for a batch of the same cases, and the time of a case on a core (s)."""
    plan = Plan.of(sweep)
    cases, nominal = plan.cases(0), nominal_model(plan.systems[0])
    values = {name: array for name, array in cases.values.items() if parameter_at(nominal, name)}
    count = len(cases.case)
    robots = [
        plan.systems[0].replace(**{name: each[k] for name, each in values.items()}) for k in range(count)
    ]
    times = []
    for _ in range(1 + ROUNDS):
        began, cpu = time.perf_counter(), time.process_time()
        simulate(robots, cases.controls, sweep.dt, on_failure="return", recovery_budget=0.0)
        times.append((time.perf_counter() - began, time.process_time() - cpu))
    wall, cores = np.min(times[1:], axis=0)
    return {"per_second": count / float(wall), "cpu": float(cores) / count}


def _command(folder: Path, sweep: Sweep, workers: int) -> list[str]:
    """Return the command of a sweep, whose description it writes."""
    path = folder.with_suffix(".yaml")
    path.write_text(yaml.safe_dump(sweep.described()), encoding="utf-8")
    program = [sys.executable, "-m", "knode_cosserat.cli", "sweep", str(path), "--out", str(folder)]
    return [*program, "--workers", str(workers), "--no-progress"]


def _run(folder: Path, sweep: Sweep, workers: int) -> dict[str, float]:
    """Return time (s), rate, time of a case on a core (s) and memory (MB) of an undisturbed sweep.

    One worker is kept on one core, as each of several is.
    """
    core = {min(os.sched_getaffinity(0))} if workers == 1 and hasattr(os, "sched_getaffinity") else None
    began = time.perf_counter()
    process = subprocess.Popen(_command(folder, sweep, workers), stdout=subprocess.DEVNULL)
    if core:
        os.sched_setaffinity(process.pid, core)
    megabytes = 0.0
    while process.poll() is None:
        megabytes = max(megabytes, _largest_process(process.pid))
        time.sleep(0.2)
    if process.returncode:
        raise RuntimeError(f"the sweep ended with status {process.returncode}")
    seconds = time.perf_counter() - began
    runs = [json.loads(line) for line in (folder / LOG).read_text(encoding="utf-8").splitlines()]
    # the first shards of each worker wait for compilation
    ends = sorted(file.stat().st_mtime_ns / 1e9 for file in (folder / SHARDS).glob("*.parquet"))
    skipped = min(SHARDS_EACH // 2 * workers, len(ends) - 2)
    rows = Plan.of(sweep).shard_cases
    steady = rows * (len(ends) - skipped) / (ends[-1] - ends[skipped - 1])
    return {
        "seconds": seconds,
        "steady_per_second": steady,
        "cpu": runs[-1]["case_cpu_seconds"],
        "megabytes": megabytes,
    }


def _largest_process(root: int) -> float:
    """Return the resident memory (MB) of the largest of a process and its descendants; 0 if not known."""
    largest, waiting = 0.0, [root]
    while waiting:
        pid = waiting.pop()
        try:
            for task in Path(f"/proc/{pid}/task").iterdir():
                waiting += [int(each) for each in (task / "children").read_text().split()]
            pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
        except (OSError, ValueError, IndexError):
            continue
        largest = max(largest, pages * os.sysconf("SC_PAGE_SIZE") / 1e6)
    return largest


def _killed(folder: Path, sweep: Sweep, kills: int, seed: int = 0) -> int:
    """Run a sweep that is killed at random times, then let it end; return how often it was killed."""
    generator, plan = random.Random(seed), Plan.of(sweep)
    # after random numbers of shards and a random time more: during a solution, or while a file is written
    places = sorted(generator.randrange(plan.shard_count) for _ in range(kills))
    count = 0
    for place in places:
        # what outlives a killed process complains of its death
        process = subprocess.Popen(
            _command(folder, sweep, 2), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        until = time.monotonic() + PATIENCE
        while process.poll() is None and len(list((folder / SHARDS).glob("*.parquet"))) < place:
            if time.monotonic() > until:
                process.kill()
                raise RuntimeError("the sweep takes too long")
            time.sleep(0.005)
        time.sleep(generator.uniform(0.0, 1.0))
        process.send_signal(signal.SIGKILL)
        count += process.wait() == -signal.SIGKILL
    subprocess.run(_command(folder, sweep, 2), stdout=subprocess.DEVNULL, check=True)
    return count


def digest(folder: Path) -> str:
    """Return a checksum of a sweep's manifest and shards, by name and content."""
    found = hashlib.sha256()
    for file in sorted(folder.rglob("*")):
        if file.is_file() and file.name != LOG:
            found.update(file.relative_to(folder).as_posix().encode() + b"\0" + file.read_bytes())
    return found.hexdigest()
