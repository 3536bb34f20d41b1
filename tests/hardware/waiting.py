"""Waits for what threads and other programs do."""

import time
from types import SimpleNamespace


def eventually(condition, timeout=5.0):
    """Return the value of a condition as soon as it is true, or after a time (s)."""
    end = time.monotonic() + timeout
    while not (value := condition()) and time.monotonic() < end:
        time.sleep(0.005)
    return value


def wait_for(condition, timeout=60.0):
    """Wait for a condition."""
    assert eventually(condition, timeout), "waited too long"


def free_computation(monkeypatch):
    """Let computations of a loop take no time: only the robot's own clock moves."""
    monkeypatch.setattr("knode_cosserat.control.loop.clock", SimpleNamespace(perf_counter=lambda: 0.0))
