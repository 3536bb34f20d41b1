"""Progress, time left, and the CPU time of each test file.

`costs.json` has the CPU time (s) of each file, and of each slow test by itself, in a run that compiles
everything. It serves two purposes: the costliest files start first, so that all processes finish together,
and the time left is estimated from the share of the cost that is done. `pytest --write-costs` writes those
of the tests that it runs.
"""

import json
import os
import time
from collections import Counter
from pathlib import Path

import pytest

COSTS = Path(__file__).parent / "costs.json"
#: CPU time (s) assumed for a test of a file that is not in the table
UNKNOWN = 0.2
#: time (s) from one line of progress to the next
INTERVAL = 15.0


def read_costs():
    return json.loads(COSTS.read_text(encoding="utf-8")) if COSTS.exists() else {}


def file_of(nodeid):
    return nodeid.split("::")[0]


def weights(nodeids, costs):
    """Cost (s) of each test: its own, or the cost of its file in equal parts."""
    counts = Counter(file_of(each) for each in nodeids if each not in costs)

    def cost(nodeid):
        count = counts[file_of(nodeid)]
        return costs[nodeid] if nodeid in costs else costs.get(file_of(nodeid), UNKNOWN * count) / count

    return {each: cost(each) for each in nodeids}


def cpu_time():
    """CPU time (s) of this process and of its children that have ended."""
    return sum(os.times()[:4])


class Recorder:
    """Adds up the CPU time of each file, in the process that runs the tests."""

    def __init__(self, config):
        self.config, self.costs = config, Counter()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item):
        started = cpu_time()
        try:
            return (yield)
        finally:
            alone = item.get_closest_marker("slow") is not None
            self.costs[item.nodeid if alone else file_of(item.nodeid)] += cpu_time() - started

    @pytest.hookimpl(tryfirst=True)
    def pytest_sessionfinish(self):
        if hasattr(self.config, "workeroutput"):
            self.config.workeroutput["costs"] = dict(self.costs)


class Progress:
    """Prints the number of tests done and the estimated time left, in the process that the user started."""

    def __init__(self, config, recorder):
        self.config, self.recorder = config, recorder
        self.weights, self.started, self.shown = {}, 0.0, 0.0
        self.tests = self.work = 0.0

    def begin(self, nodeids):
        if not self.weights:
            self.weights = weights(nodeids, read_costs())
            self.started = self.shown = time.monotonic()

    def pytest_collection_finish(self, session):
        self.begin([item.nodeid for item in session.items])

    @pytest.hookimpl(optionalhook=True)
    def pytest_xdist_node_collection_finished(self, ids):
        self.begin(ids)

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, node):
        self.recorder.costs.update(getattr(node, "workeroutput", {}).get("costs", {}))

    def pytest_runtest_logreport(self, report):
        if report.when != "teardown":
            return
        self.tests, self.work = self.tests + 1, self.work + self.weights.get(report.nodeid, 0.0)
        now = time.monotonic()
        if now - self.shown >= INTERVAL and self.work:
            self.shown = now
            self.show(now - self.started)

    def show(self, elapsed):
        total = sum(self.weights.values())
        left = elapsed * max(total / self.work - 1.0, 0.0)
        terminal = self.config.pluginmanager.get_plugin("terminalreporter")
        if terminal:
            terminal.ensure_newline()
            terminal.write_line(
                f"{self.tests:.0f} of {len(self.weights)} tests, {self.work / total:.0%} of the work; "
                f"about {left // 60:.0f} min {left % 60:02.0f} s left"
            )

    def pytest_terminal_summary(self, terminalreporter):
        count, files = self.config.option.dearest, Counter()
        for name, cost in self.recorder.costs.items():
            files[file_of(name)] += cost
        if count:
            total = sum(files.values())
            terminalreporter.section(f"{total:.0f} s of CPU time; the {count} dearest files")
            for name, cost in files.most_common(count):
                terminalreporter.write_line(f"{cost:7.1f} s {cost / total:5.1%}  {name}")

    def pytest_sessionfinish(self):
        if self.config.option.write_costs:
            files = COSTS.parents[1]
            kept = {name: cost for name, cost in read_costs().items() if (files / file_of(name)).exists()}
            table = kept | {name: round(cost, 1) for name, cost in self.recorder.costs.items()}
            COSTS.write_text(json.dumps(dict(sorted(table.items())), indent=0) + "\n", encoding="utf-8")


def sort_by_cost(items):
    """Sort tests so that the costliest files come first. The order within a file does not change."""
    by_test = weights([item.nodeid for item in items], read_costs())
    by_file = Counter()
    for nodeid, weight in by_test.items():
        by_file[file_of(nodeid)] += weight
    items.sort(key=lambda item: -by_file[file_of(item.nodeid)])


def register(config):
    recorder = Recorder(config)
    config.pluginmanager.register(recorder, "recorder")
    if not hasattr(config, "workerinput"):
        config.pluginmanager.register(Progress(config, recorder), "progress")
