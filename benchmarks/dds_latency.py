"""Latency of DDS messages from one process to another on the same host.

    python -m benchmarks.dds_latency --messages 2000 --real-time

Times are of the host's monotonic clock, which all processes share on Linux. On a busy machine the 99th
percentile is that of the scheduler: real-time priority, which needs the right to it, removes most of it.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from knode_cosserat_hardware.driver import HardwareError
from knode_cosserat_hardware.middleware.commands import tendon_names
from knode_cosserat_hardware.middleware.dds import open_participant, open_reader, open_writer

ROOT = Path(__file__).parent.parent
TOPIC = "rt/latency"
#: messages in a second (Hz)
RATE = 500.0
#: real-time priority of the processes, and longest time until both have found each other (s)
PRIORITY, DISCOVERY = 10, 60.0


class LoopbackLatency(NamedTuple):
    """Time from writing a message to taking it in another process (s), and numbers of messages."""

    median: float
    p99: float
    messages: int
    lost: int
    #: True if both processes had real-time priority
    real_time: bool


def measure_loopback(messages: int = 1000, domain: int = 91, real_time: bool = False) -> LoopbackLatency:
    """Return the latency of JointState messages of four tendons between two processes on this host.

    Raises:
        HardwareError: a process failed, priority was refused, or no message arrived.
        ImportError: cyclonedds is not installed.
    """
    # an error of the domain is raised here, and not in another process
    open_participant(domain, loopback=True)
    program = [sys.executable, "-m", "benchmarks.dds_latency", f"--domain={domain}", f"--messages={messages}"]
    program += ["--real-time"] * real_time
    pipes: Any = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "cwd": ROOT}
    limit = DISCOVERY + messages / RATE + 30.0
    with subprocess.Popen([*program, "--role=receive"], **pipes) as receiver:
        try:
            sender = subprocess.run([*program, "--role=send"], timeout=limit, check=False, **pipes)
            out, error = receiver.communicate(timeout=limit)
        except subprocess.TimeoutExpired:
            raise HardwareError("the measurement of latency did not end") from None
        finally:
            receiver.kill()
    for status, text in ((sender.returncode, sender.stderr), (receiver.returncode, error)):
        if status:
            reason = " ".join(text.strip().splitlines()[-1:])
            raise HardwareError(f"the measurement of latency failed: {reason:.200}")
    latencies = np.array(json.loads(out))
    if not len(latencies):
        raise HardwareError("no message arrived in the other process")
    median, p99 = np.quantile(latencies, [0.5, 0.99])
    return LoopbackLatency(float(median), float(p99), messages, messages - len(latencies), real_time)


def send(domain: int, messages: int) -> None:
    """Write messages once a reader is there; the time of writing travels as the position."""
    participant = open_participant(domain, loopback=True)
    from knode_cosserat_hardware.middleware import idl

    writer = open_writer(participant, TOPIC, idl.JointState)
    end = time.monotonic() + DISCOVERY
    while not writer.get_matched_subscriptions():
        if time.monotonic() > end:
            raise HardwareError("the other process did not subscribe")
        time.sleep(0.05)
    time.sleep(0.2)
    names, header = tendon_names(4), idl.Header(idl.Time(0, 0), "")
    for _ in range(messages):
        sent = time.monotonic()
        writer.write(idl.JointState(header, names, [sent], [], [5.0] * 4))
        time.sleep(max(0.0, 1.0 / RATE - (time.monotonic() - sent)))
    # reliable messages may be sent again
    time.sleep(0.5)


def receive(domain: int, messages: int) -> list[float]:
    """Return the latencies (s) of messages; ends 2 s after the last one."""
    participant = open_participant(domain, loopback=True)
    from cyclonedds.core import InstanceState, ReadCondition, SampleState, ViewState, WaitSet

    from knode_cosserat_hardware.middleware import idl

    reader = open_reader(participant, TOPIC, idl.JointState)
    waits = WaitSet(participant)
    waits.attach(ReadCondition(reader, SampleState.Any | ViewState.Any | InstanceState.Any))
    latencies: list[float] = []
    end = time.monotonic() + DISCOVERY
    while len(latencies) < messages and time.monotonic() < end:
        waits.wait(500_000_000)
        for message in reader.take(N=100):
            # a writer that has left is reported too, as another kind of object
            if isinstance(message, idl.JointState):
                now = time.monotonic()
                latencies.append(now - message.position[0])
                end = now + 2.0
    return latencies


def main() -> None:
    """Measure, or run one of the two processes."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.dds_latency")
    parser.add_argument("--domain", type=int, default=91, help="DDS domain that nothing else uses")
    parser.add_argument("--messages", type=int, default=1000)
    parser.add_argument("--real-time", action="store_true", help="give both processes real-time priority")
    parser.add_argument("--role", choices=("send", "receive"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    try:
        if options.role and options.real_time:
            # threads of Cyclone DDS are created later, and inherit it
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
        if options.role == "send":
            send(options.domain, options.messages)
        elif options.role == "receive":
            print(json.dumps(receive(options.domain, options.messages)))
        else:
            print(measure_loopback(options.messages, options.domain, options.real_time))
    except (OSError, AttributeError):
        sys.exit("real-time priority was refused; leave out --real-time, or run as root")
    except HardwareError as error:
        sys.exit(str(error))


if __name__ == "__main__":
    main()
