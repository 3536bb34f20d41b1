"""Latency of DDS messages from one process to another on the same host."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from typing import Any, NamedTuple

import numpy as np

from knode_cosserat.hardware.driver import HardwareError
from knode_cosserat.hardware.middleware.dds import open_participant, open_reader, open_writer

TOPIC = "rt/latency"


class LoopbackLatency(NamedTuple):
    """Time from writing a message to taking it in another process (s), and number of messages."""

    median: float
    p99: float
    messages: int
    #: number of messages that did not arrive
    lost: int


def measure_loopback(messages: int = 1000, *, domain: int = 91, rate: float = 500.0) -> LoopbackLatency:
    """Return the latency of JointState messages of four tendons between two processes on this host.

    Times are of the host's monotonic clock, which all processes share on Linux.

    Args:
        messages: number of messages.
        domain: number of a DDS domain that nothing else uses.
        rate: messages in a second (Hz).

    Raises:
        HardwareError: the other process failed, or no message arrived.
        ImportError: cyclonedds is not installed.
    """
    participant = open_participant(domain, loopback=True)
    from knode_cosserat.hardware.middleware import idl as definitions

    # cyclonedds has no types that mypy understands
    idl: Any = definitions
    writer = open_writer(participant, TOPIC, idl.JointState)
    program = [sys.executable, "-m", __name__, str(domain), str(messages)]
    with subprocess.Popen(program, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            end = time.monotonic() + 60.0
            while not writer.get_matched_subscriptions():
                if time.monotonic() > end or process.poll() is not None:
                    process.kill()
                    said = (process.stderr.read() if process.stderr else "").strip().splitlines()
                    raise HardwareError(f"the other process did not subscribe: {' '.join(said[-1:]):.150}")
                time.sleep(0.05)
            time.sleep(0.2)
            names = [f"tendon_{k + 1}" for k in range(4)]
            for _ in range(messages):
                # the time of writing travels as the position
                header = idl.Header(idl.Time(0, 0), "")
                sent = time.monotonic()
                writer.write(idl.JointState(header, names, [sent], [], [5.0] * 4))
                time.sleep(max(0.0, 1.0 / rate - (time.monotonic() - sent)))
            out, _ = process.communicate(timeout=30.0)
        except subprocess.TimeoutExpired:
            raise HardwareError("the other process did not end") from None
        finally:
            process.kill()
    latencies = np.array(json.loads(out or "[]"))
    if not len(latencies):
        raise HardwareError("no message arrived in the other process")
    return LoopbackLatency(
        float(np.median(latencies)), float(np.quantile(latencies, 0.99)), messages, messages - len(latencies)
    )


def receive(domain: int, messages: int) -> list[float]:
    """Return the latencies (s) of messages; ends 2 s after the last one."""
    participant = open_participant(domain, loopback=True)
    from cyclonedds.core import InstanceState, ReadCondition, SampleState, ViewState, WaitSet

    from knode_cosserat.hardware.middleware import idl

    reader = open_reader(participant, TOPIC, idl.JointState)
    waits = WaitSet(participant)
    waits.attach(ReadCondition(reader, SampleState.Any | ViewState.Any | InstanceState.Any))
    latencies: list[float] = []
    last = time.monotonic() + 10.0
    while len(latencies) < messages and time.monotonic() < last + 2.0:
        waits.wait(500_000_000)
        for message in reader.take(N=100):
            now = time.monotonic()
            latencies.append(now - message.position[0])
            last = now
    return latencies


if __name__ == "__main__":
    print(json.dumps(receive(int(sys.argv[1]), int(sys.argv[2]))))
