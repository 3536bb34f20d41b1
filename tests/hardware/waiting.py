"""Waits for what threads and other programs do."""

import time


def eventually(condition, timeout=5.0):
    """Return the value of a condition as soon as it is true, or after a time (s)."""
    end = time.monotonic() + timeout
    while not (value := condition()) and time.monotonic() < end:
        time.sleep(0.005)
    return value


def wait_for(condition, timeout=60.0):
    """Wait for a condition."""
    assert eventually(condition, timeout), "waited too long"
