"""Compiled programs of one process: bounded memory maps, equal results, no deadlock between threads."""

import gc
import json
import subprocess
import sys
import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat import _programs
from knode_cosserat._programs import COMPILED, LARGE_MAPS, LONG, ProgramBudget, default_maps, memory_maps

SMALL, LARGE = LONG / 2, 2 * LONG
on_linux = pytest.mark.skipif(not memory_maps(), reason="the system does not tell its memory maps")


class Process:
    """A process whose programs have as many maps as a test says."""

    def __init__(self, monkeypatch, *foreign_maps):
        self.foreign = sum(foreign_maps)
        self.maps, self.counts, self.cleared = self.foreign, 0, 0
        monkeypatch.setattr(_programs.jax, "clear_caches", self.clear)

    def clear(self):
        self.maps, self.cleared = self.foreign, self.cleared + 1

    def count(self):
        self.counts += 1
        return self.maps


@pytest.fixture
def listening():
    """Lets a budget hear of all programs that JAX compiles during a test."""
    heard = []

    def listen(budget):
        jax.monitoring.register_event_duration_secs_listener(budget.compiled)
        heard.append(budget)
        return budget

    yield listen
    for budget in heard:
        jax.monitoring.unregister_event_duration_listener(budget.compiled)


@pytest.mark.slow
def test_maps_stay_below_the_limit(monkeypatch):
    process = Process(monkeypatch, 600)
    budget = ProgramBudget(30_000, programs=10**6, count=process.count)
    most = 0
    for _ in range(1000):
        process.maps += 470
        most = max(most, process.maps)
        budget.compiled(COMPILED, LARGE)
    assert 0 < most - 30_000 < LARGE_MAPS
    assert budget.releases == process.cleared == pytest.approx(1000 * 470 / 30_000, abs=1)
    # the file is read when the budget may be spent, not for every program
    assert process.counts < 300


@pytest.mark.slow
def test_small_programs_are_counted_too(monkeypatch):
    process = Process(monkeypatch, 600)
    budget = ProgramBudget(30_000, count=process.count)
    for _ in range(10_000):
        process.maps += 18
        budget.compiled(COMPILED, SMALL)
        assert process.maps < 31_000
    assert budget.releases == 6


@pytest.mark.slow
def test_without_memory_maps_large_programs_are_counted(monkeypatch):
    process = Process(monkeypatch)
    budget = ProgramBudget(30_000, programs=100, count=lambda: 0)
    for _ in range(1050):
        budget.compiled(COMPILED, LARGE)
        budget.compiled(COMPILED, SMALL)
        budget.compiled("/jax/core/compile/jaxpr_trace_duration", LARGE)
    assert process.cleared == budget.releases == 10


def test_maps_of_other_origin_do_not_make_every_program_release_all(monkeypatch):
    process = Process(monkeypatch, 32_000)
    budget = ProgramBudget(30_000, programs=10**6, count=process.count)
    for _ in range(100):
        process.maps += 500
        budget.compiled(COMPILED, LARGE)
        assert process.maps < 50_000
    assert 3 <= budget.releases <= 5


def test_budget_is_half_of_the_limit_or_chosen(monkeypatch, tmp_path):
    monkeypatch.delenv("KNODE_COSSERAT_MEMORY_MAPS", raising=False)
    limit = tmp_path / "max_map_count"
    monkeypatch.setattr(_programs, "MAPS_LIMIT", limit)
    assert default_maps() == 32_765
    for text, maps in (("20000\n", 10_000), ("1048576\n", 32_765)):
        limit.write_text(text)
        assert default_maps() == maps
    monkeypatch.setenv("KNODE_COSSERAT_MEMORY_MAPS", "5000")
    assert default_maps() == 5000
    monkeypatch.setenv("KNODE_COSSERAT_MEMORY_MAPS", "-1")
    with pytest.raises(ValueError, match="must be a positive integer"):
        default_maps()


@pytest.mark.slow
@on_linux
def test_real_programs_are_released(listening):
    # programs of earlier tests go first: the process's own budget could release them in between
    jax.clear_caches()
    gc.collect()
    before = memory_maps()
    budget = listening(ProgramBudget(before + 200))
    kept, maps = [], [before]
    for i in range(100):
        kept.append(jax.jit(lambda x, i=i: jnp.cumsum(jnp.cumsum(x) * 2.0) + i))
        np.testing.assert_array_equal(kept[-1](np.ones(3)), np.array([2.0, 6.0, 12.0]) + i)
        maps.append(memory_maps())
    assert budget.releases >= 1
    # the threshold after a release leaves half the budget beside what is not a program's
    assert max(maps) < 1.5 * (before + 200) + 200
    # a release gives back the maps of many programs at once
    assert min(np.diff(maps)) < -50
    np.testing.assert_array_equal(kept[0](np.ones(3)), [2.0, 6.0, 12.0])


@pytest.mark.slow
def test_results_are_the_same_after_a_release(listening):
    robot = kc.load_robot("delrin-tendon-robot").replace(nodes=4)
    controls = np.full((3, 4), [1.0, 0.0, 0.0, 0.0])
    before = kc.simulate(robot, controls, 0.05)
    steppers = [kc.solvers.Stepper(robot, 0.05) for _ in range(2)]
    stepped = [steppers[0].step(control).y for control in controls]
    steppers[1].step(controls[0])
    budget = listening(ProgramBudget(10**6, programs=1))
    jax.jit(lambda x: jnp.linalg.eigh(x + x.T)[0].sum())(np.eye(3))
    budget.compiled(COMPILED, LARGE)
    assert budget.releases
    for control, y in zip(controls[1:], stepped[1:], strict=True):
        np.testing.assert_array_equal(steppers[1].step(control).y, y)
    np.testing.assert_array_equal(kc.simulate(robot, controls, 0.05).y, before.y)


@pytest.mark.slow
def test_programs_are_released_while_others_run(listening):
    """Threads compile, differentiate and run a longer program; each compilation releases all programs."""
    budget = listening(ProgramBudget(0, programs=10**6, count=lambda: 1))
    budget._threshold = 0
    inner = jax.jit(lambda x: jnp.cumsum(jnp.sin(x)).sum())
    run = jax.jit(lambda x: jax.lax.fori_loop(0, 300, lambda i, y: jnp.tanh(y @ y * 1e-3 + y), x))
    reference = np.asarray(run(jnp.eye(60)))
    failures = []

    def compiling(i):
        x = np.arange(3 + i) * 0.1
        got = jax.jit(lambda x: inner(x) * jnp.asarray(np.ones(i + 1)).sum())(x)
        np.testing.assert_allclose(got, np.cumsum(np.sin(x)).sum() * (i + 1))

    def differentiating(i):
        x = np.arange(3 + i) * 0.1
        np.testing.assert_allclose(jax.grad(inner)(x), np.cos(x) * np.arange(3 + i, 0, -1))

    def running(i):
        np.testing.assert_array_equal(run(jnp.eye(60)), reference)

    def repeated(work):
        try:
            for i in range(4):
                work(i)
        except Exception as error:
            failures.append(error)

    threads = [
        threading.Thread(target=repeated, args=[work]) for work in (compiling, differentiating, running)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(timeout=300)
    assert not failures
    assert not any(thread.is_alive() for thread in threads)
    assert budget.releases >= 4


MANY = """
import gc
import json
import jax, numpy as np
import knode_cosserat as kc
from pathlib import Path
from knode_cosserat._jax import program_budget
from knode_cosserat._programs import memory_maps

def resident():
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096e-6

robot = kc.load_robot("delrin-tendon-robot")
controls = np.full((2, robot.control_size), 1.0)
first, kept, maps, megabytes = {}, [], [], []
for i in range(1000):
    nodes = 5 + i % 4
    # a function of its own: JAX keeps a program for each, and XLA reads all but four from disk
    kept.append(jax.jit(lambda u, robot=robot.replace(nodes=nodes): kc.simulate(robot, u, 0.05).y[-1]))
    y = np.asarray(kept[-1](controls))
    np.testing.assert_array_equal(y, first.setdefault(nodes, y))
    maps.append(memory_maps())
    megabytes.append(resident())
print(json.dumps({"maps": max(maps), "megabytes": max(megabytes), "releases": program_budget.releases}))
"""


@on_linux
@pytest.mark.campaign
def test_a_thousand_programs_in_one_process():
    """Without releases they need 430,000 maps, and Linux ends the process after 150 programs."""
    done = subprocess.run([sys.executable, "-c", MANY], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    told = json.loads(done.stdout)
    print(told)
    assert told["releases"] >= 5
    assert told["maps"] < 36_000
    assert told["megabytes"] < 4_000
