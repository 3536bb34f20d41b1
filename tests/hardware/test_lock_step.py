"""The driver of tension boards on a simulated clock, in lock-step, and its reader of any bytes."""

import contextlib
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from knode_cosserat_hardware.board_link import BoardLink, Transport
from knode_cosserat_hardware.driver import DriverState, HardwareError, Limits
from knode_cosserat_hardware.lines import Answer, Telemetry, decode_framed
from knode_cosserat_hardware.serial_board import SerialBoard
from tests.hardware.fake_board import encode_message

pytest.importorskip("serial")
#: no rate limit that a test would wait for
FAST = Limits(0.0, 15.0, 1e4, 60.0)


# lock-step


class Clockwork(Transport):
    """A framed board whose time passes in `read` only."""

    real_time = False

    def __init__(self):
        self.time, self.lines, self.state, self.last, self.fed = 0.0, [], "ready", 0, 0.0
        self.waiting = b"# knode-tension 1.0.0 protocol 2 tendons 4\n"
        self.fault, self.count, self.due = "", 0, 0.02

    def write(self, data):
        line = data[:-1]
        self.lines.append((self.time, line))
        if line == b"hello 2":
            self.waiting += encode_message(Answer(0, "hello", ("2", "x", "1", "4", "256", "2300")), True)
            return
        if b"*" not in line:
            return
        number, verb, *_ = line.rpartition(b"*")[0].decode().split()
        self.last, self.fed = int(number), self.time
        if verb in ("arm", "disarm"):
            self.state = "armed" if verb == "arm" else "ready"
            self.waiting += encode_message(Answer(self.last, verb), True)

    def read(self, timeout):
        if not self.waiting:
            self.time += timeout
        if self.state == "armed" and self.time - self.fed > 0.06:
            self.state, self.fault = "fault", "watchdog:0"
        while self.time >= self.due:
            self.due += 0.02
            self.count += 1
            made = Telemetry((1,) * 4, (0,) * 4, 4, self.count % 65536, self.last, self.state, self.fault)
            self.waiting += encode_message(made, True)
        data, self.waiting = self.waiting, b""
        return data

    def now(self):
        return self.time

    def close(self):
        pass


def test_lock_step_needs_no_thread_and_keeps_the_watchdog_in_simulated_time():
    def run():
        transport = Clockwork()
        with SerialBoard(transport, FAST) as robot:
            robot.arm()
            for k in range(20):
                robot.command([0.1 * k] * 4)
                robot.wait(0.1)
                time.sleep(0.001)
            robot.read()
            assert robot.state is DriverState.ARMED
        return transport

    first, second = run(), run()
    assert first.lines == second.lines  # the same bytes at the same times
    times = [at for at, line in first.lines if b"*" in line]
    assert np.max(np.diff(times)) <= 0.03 and 2.0 < first.time < 3.0


def test_lock_step_latency_is_in_simulated_time():
    transport = Clockwork()
    with SerialBoard(transport, FAST) as robot:
        robot.arm()
        robot.command([1.0] * 4)
        robot.wait(0.1)
        assert robot.latency.count == 1 and 0.0 < robot.latency.median <= 0.025 + 1e-9


# any bytes


class Bytes(Transport):
    """A transport that delivers given bytes."""

    real_time = False

    def __init__(self, chunks):
        self.chunks, self.time = list(chunks), 0.0

    def write(self, data):
        assert data.endswith(b"\n")

    def read(self, timeout):
        self.time += timeout
        return self.chunks.pop(0) if self.chunks else b""

    def now(self):
        return self.time

    def close(self):
        pass


pieces = st.binary(max_size=80) | st.sampled_from(
    [
        b"\n",
        b"0 = hello 2\n",
        b"1 : 2 armed - 1,2,3\n",
        b"1,2,3,4,5,6,7,8,9\n",
        b"# knode-tension 1 protocol 2 tendons 4\n",
        encode_message(Telemetry((9999,) * 4, (0,) * 4, 4, 1, 2, "armed", ""), True),
    ]
)


@settings(deadline=None, max_examples=200)
@given(st.lists(pieces, max_size=20), st.sampled_from(["unknown", "plain", "framed"]))
def test_any_bytes_do_no_harm_to_the_reader(chunks, mode):
    link = BoardLink(Bytes(chunks), 0.25, 20.0)
    link.mode = mode
    link.until(lambda: None, 0.005 * (len(chunks) + 1))
    assert link.error is None


@settings(deadline=None, max_examples=60)
@given(st.lists(pieces, max_size=20), st.sampled_from([1, 2]))
def test_a_connection_to_any_bytes_is_made_or_an_error(chunks, protocol):
    robot = SerialBoard(Bytes(chunks), FAST, protocol=protocol, start_timeout=1.0)
    with contextlib.suppress(HardwareError):
        robot.connect()
        robot.arm()
        robot.command([1.0] * 4)
    robot.stop()
    robot.close()


def test_telemetry_of_the_description_is_read():
    line = encode_message(Telemetry((1, 2, 3, 4), (5, 6, 7, 8), 4, 1, 2, "armed", "slack:2"), True)
    assert decode_framed(line[:-1]).fault == "slack:2"
