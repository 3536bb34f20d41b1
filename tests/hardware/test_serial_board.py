"""The driver of tension boards, against a board in Python behind a pseudo-terminal."""

import contextlib
import math
import re
import time

import numpy as np
import pytest

from knode_cosserat_hardware.driver import FAULTS, DriverState, HardwareError, Limits, fault_message
from knode_cosserat_hardware.lines import GRAM_FORCE
from knode_cosserat_hardware.plant import HardwarePlant
from knode_cosserat_hardware.serial_board import SerialBoard
from tests.hardware.fake_board import FakeBoard
from tests.hardware.waiting import eventually

pytest.importorskip("serial")
#: no rate limit that a test would wait for
FAST = Limits(0.0, 15.0, 1e4, 60.0)


@pytest.fixture
def board():
    with FakeBoard() as fake:
        yield fake


def driver(fake, limits=FAST, **options):
    return SerialBoard(fake.port, limits, **{"host_timeout": 1.0, **options})


def verbs(fake):
    return [line[0] for line in list(fake.accepted)]


# states


def test_a_session(board):
    robot = driver(board)
    assert robot.state is DriverState.DISCONNECTED and math.isnan(robot.latency.median)
    with robot:
        assert robot.is_framed and robot.tendon_count == 4 and robot.state is DriverState.READY
        with pytest.raises(HardwareError, match=r"not armed; call arm\(\)"):
            robot.command([1.0, 1.0, 1.0, 1.0])
        robot.arm()
        robot.arm()
        assert robot.state is DriverState.ARMED and board.state == "armed"
        sent = robot.command([1.0, 2.0, 0.5, 0.0])
        assert np.allclose(sent, [1.0, 2.0, 0.5, 0.0], atol=GRAM_FORCE / 2)
        grams = [round(each / GRAM_FORCE) for each in sent]
        assert np.allclose(np.array(grams) * GRAM_FORCE, sent, rtol=1e-12)
        assert eventually(lambda: board.wanted == grams)
        times = []
        for _ in range(10):
            reading = robot.read()
            times.append(reading.time)
            assert reading.state is DriverState.ARMED and reading.fault == ""
        assert np.allclose(reading.tension, sent) and np.allclose(reading.drive, [10 / 255, -20 / 255, 1, -1])
        assert np.all(np.diff(times) > 0.0) and times[-1] <= time.monotonic()
        assert robot.latency.count >= 1 and 0.0 < robot.latency.median <= robot.latency.p99
        robot.disarm()
        assert robot.state is DriverState.READY and board.wanted == [0, 0, 0, 0]
        robot.arm()
    assert (
        board.state == "ready" and robot.state is DriverState.DISCONNECTED and "disarm" in verbs(board)[-20:]
    )
    assert eventually(lambda: not board.framed)  # back to plain lines for other hosts
    robot.close()
    with pytest.raises(HardwareError, match="not connected"):
        robot.read()


def test_it_waits_for_the_tare_and_feeds_the_watchdog_meanwhile():
    with FakeBoard(taring=1.5) as fake, driver(fake, host_timeout=0.2) as robot:
        assert robot.state is DriverState.READY and verbs(fake).count("keep") >= 5


def test_a_board_that_does_not_end_its_tare_is_an_error():
    with (
        FakeBoard(taring=60.0) as fake,
        pytest.raises(HardwareError, match=r"not ready in 0.3 s.*tare_on_start"),
    ):
        driver(fake, start_timeout=0.3).connect()


def test_a_running_board_without_a_banner_is_found():
    with FakeBoard(banner=False) as fake, driver(fake) as robot:
        assert robot.is_framed


def test_a_port_without_a_board():
    with FakeBoard() as fake:
        fake.silent = True
        fake._end.set()
        with pytest.raises(HardwareError, match=r"no answer.*115200 baud") as caught:
            driver(fake, start_timeout=0.2).connect()
    assert "\n" not in str(caught.value)


def test_a_port_that_is_not_there_or_in_use(board):
    with pytest.raises(HardwareError, match="no such serial port"):
        SerialBoard("/dev/ttyNothing").connect()
    with driver(board), pytest.raises(HardwareError, match="another program uses this port"):
        driver(board).connect()


# the paper's board


def test_the_papers_board_is_commanded_by_plain_lines():
    with FakeBoard(paper=True) as fake, driver(fake) as robot:
        assert not robot.is_framed and robot.state is DriverState.READY
        robot.arm()
        sent = robot.command([1.0, 0.0, 2.0, 0.0])
        assert eventually(lambda: fake.wanted == [102, 0, 204, 0]) and robot.state is DriverState.ARMED
        assert eventually(lambda: np.allclose(robot.read().tension, sent))
        count = fake.received.count(b"102 0 204 0")
        robot.wait(0.5)
        assert fake.received.count(b"102 0 204 0") >= count + 2  # repeated: a silent host is disarmed
        for call in (robot.tare, lambda: robot.setting("kp"), lambda: robot.jog(0, 0.1)):
            with pytest.raises(HardwareError, match="needs protocol 2"):
                call()
        robot.stop()
        assert eventually(lambda: fake.wanted == [0, 0, 0, 0]) and robot.state is DriverState.FAULT
        with pytest.raises(HardwareError, match="stopped"):
            robot.command([1.0] * 4)
        robot.reset()
        robot.arm()
        robot.disarm()
        assert robot.state is DriverState.READY


def test_plain_lines_can_be_chosen_and_repeats_end_with_the_program(board):
    with driver(board, protocol=1, host_timeout=0.2) as robot:
        assert not robot.is_framed
        robot.arm()
        robot.command([1.0] * 4)
        assert eventually(lambda: board.state == "armed")
        assert eventually(lambda: board.state == "ready")  # no calls: the board disarms itself
        assert robot.state is DriverState.READY
        # a call after the timeout does not repeat the earlier tensions either
        robot.wait(0.15)
        assert board.state == "ready"
        with pytest.raises(HardwareError, match="not armed"):
            robot.command([1.0] * 4)
        robot.arm()
        board.latch("slack:2")
        assert eventually(lambda: robot.state is DriverState.FAULT)
        with pytest.raises(HardwareError, match="slack at tendon 2"):
            robot.arm()
        robot.reset()
        robot.arm()


def test_arming_a_plain_board_waits_for_its_tare():
    with FakeBoard(taring=1.5) as fake, driver(fake, protocol=1) as robot:
        robot.arm()
        assert fake.state == "armed"


# watchdog


def test_the_watchdog_is_fed_while_the_program_lives_and_no_longer(board):
    with driver(board, host_timeout=0.2) as robot:
        robot.arm()
        robot.command([2.0] * 4)
        robot.wait(1.5)
        assert board.state == "armed" and robot.state is DriverState.ARMED
        # the program hangs: no calls
        assert eventually(lambda: board.fault == "watchdog:0")
        assert eventually(lambda: robot.state is DriverState.FAULT)
        with pytest.raises(HardwareError, match=r"fault watchdog.*host_timeout.*then reset\(\)"):
            robot.command([2.0] * 4)
        with pytest.raises(HardwareError, match="watchdog"):
            robot.arm()
        robot.reset()
        assert robot.state is DriverState.READY
        robot.arm()
        assert robot.state is DriverState.ARMED


# faults


@pytest.mark.parametrize("fault", ["over-tension:3", "slack:1", "sensor-rail:4", "new-fault:2"])
def test_a_fault_is_named_with_tendon_and_fix(board, fault):
    name, tendon = fault.split(":")
    with driver(board) as robot:
        robot.arm()
        board.latch(fault)
        reading = robot.read()
        while not reading.fault:
            reading = robot.read()
        assert reading.fault == fault and reading.state is DriverState.FAULT
        with pytest.raises(HardwareError, match=rf"fault {name} at tendon {tendon}") as caught:
            robot.command([1.0] * 4)
        assert "\n" not in str(caught.value)
        robot.reset()
        assert robot.state is DriverState.READY and robot.fault == ""


def test_every_fault_of_the_protocol_has_a_fix():
    from pathlib import Path

    text = (
        (Path(__file__).parents[2] / "firmware" / "PROTOCOL.md")
        .read_text()
        .split("## Faults")[1]
        .split("##")[0]
    )
    names = re.findall(r"^\| `([a-z-]+)` \|", text, re.MULTILINE)
    assert len(names) == 9 and set(names) <= set(FAULTS)
    assert all("reset()" in fault_message(f"{name}:0") for name in names)


def test_stop_latches_and_never_raises(board):
    robot = driver(board)
    robot.stop()
    with robot:
        robot.arm()
        robot.stop()
        assert robot.state is DriverState.FAULT and robot.fault == "stopped:0"
        robot.stop()
    robot.stop()


def test_an_error_in_the_program_stops_the_robot(board):
    with pytest.raises(ZeroDivisionError), driver(board) as robot:
        robot.command([robot.arm() or 1.0 / 0.0] * 4)
    assert board.fault == "stopped:0"


def test_the_driver_stops_a_robot_that_measures_too_much(board):
    with driver(board, measured_high=5.0) as robot:
        robot.arm()
        board.measured[2] = 600
        assert eventually(lambda: board.fault == "stopped:0")
        with pytest.raises(HardwareError, match=r"measured-tension at tendon 3.*measured_high"):
            robot.command([1.0] * 4)
        board.measured[2] = 0
        robot.reset()
        robot.arm()


def test_a_board_that_restarts_is_found_again(board):
    with driver(board) as robot:
        robot.arm()
        board.restart()
        assert eventually(lambda: robot.state is DriverState.FAULT)
        with pytest.raises(HardwareError, match="the board restarted; check the supply"):
            robot.command([1.0] * 4)
        robot.reset()
        assert robot.is_framed and robot.state is DriverState.READY
        robot.arm()


def test_a_board_that_restarts_within_a_line_is_found_too(board):
    with driver(board) as robot:
        robot.arm()
        # the banner follows a line that was cut off
        board.write(b"7 : 3 arm")
        board.restart()
        assert eventually(lambda: robot.fault == "restarted:0")
        # it sends no readings: a closed loop must not wait for one before it stops the robot
        plant = HardwarePlant(robot, None, 0.05)
        began = time.monotonic()
        with pytest.raises(HardwareError, match="the board restarted"):
            plant.measure()
        assert time.monotonic() - began < 0.9 and b"stop" in board.received
        board.fault, board.state = "", "ready"
        robot.reset()
        assert robot.is_framed and robot.state is DriverState.READY


# damage


def test_damaged_lines_are_counted_and_do_no_harm(board):
    with driver(board) as robot:
        board.damage = 3
        robot.arm()
        for _ in range(20):
            reading = robot.read()
            assert np.all((reading.tension >= 0.0) & (reading.tension < 16.0))
            robot.command([1.0] * 4)
        assert robot.line_counts["damaged"] >= 3 and robot.line_counts["lost telemetry"] >= 3
        assert robot.setting("kp") == 300


def test_commands_that_arrive_damaged_are_sent_again(board):
    with driver(board) as robot:
        board.damage_input = 3
        for value in range(5):
            assert robot.set_setting("kp", value) == value
        robot.arm()
        assert robot.line_counts["refused as checksum"] >= 1


def test_a_silent_board_is_an_error(board):
    with driver(board) as robot:
        robot.arm()
        board.silent = True
        time.sleep(0.1)
        with contextlib.suppress(HardwareError):
            robot.read(0.1)
        with pytest.raises(HardwareError, match=r"no reading in 0\.6 s"):
            robot.read(0.6)
        with pytest.raises(HardwareError, match=r"no telemetry for 0\.\d s; check the cable"):
            robot.command([1.0] * 4)
        # a board that cannot be supervised is not kept armed
        assert eventually(lambda: board.fault == "watchdog:0")
        board.silent = False
        robot.read()


def test_an_unplugged_board_is_disconnected(board):
    robot = driver(board)
    robot.connect()
    robot.arm()
    board.unplug()
    assert eventually(lambda: robot.state is DriverState.DISCONNECTED)
    for call in (
        robot.read,
        robot.arm,
        robot.disarm,
        lambda: robot.command([1.0] * 4),
        lambda: robot.wait(0.1),
    ):
        with pytest.raises(HardwareError, match=r"the connection is lost.*check the USB cable") as caught:
            call()
        assert "\n" not in str(caught.value)
    robot.stop()
    robot.close()


# limits


def test_commands_keep_to_the_limits(board):
    board.limit = 1000
    with driver(board, Limits(0.0, 15.0, 50.0, 20.0)) as robot:
        assert robot.limits.high == pytest.approx(1000 * GRAM_FORCE)
        robot.arm()
        first = robot.command([100.0] * 4)
        assert first.max() <= 50.0 * 0.1 + GRAM_FORCE
        for _ in range(20):
            robot.wait(0.05)
            sent = robot.command([100.0, 100.0, 0.0, 0.0])
        assert sent.max() <= robot.limits.high and 19.0 < sent.sum() <= 20.0


@pytest.mark.parametrize(
    "wrong", [[1.0, 2.0], [1.0, np.nan, 1.0, 1.0], [np.inf] * 4, "1 2 3 4", [[1.0] * 4], None]
)
def test_tensions_that_are_none_are_refused(board, wrong):
    with driver(board) as robot:
        robot.arm()
        with pytest.raises(HardwareError, match="tensions must be"):
            robot.command(wrong)
        assert robot.state is DriverState.ARMED


# settings, jog


def test_settings(board):
    with driver(board) as robot:
        assert robot.setting("kp") == 300 and robot.set_setting("kp", 200) == 200 == board.settings["kp"]
        robot.save_settings()
        assert board.saved
        with pytest.raises(HardwareError, match=r"refused as name.*did you mean kp"):
            robot.setting("kpp")
        with pytest.raises(HardwareError, match="must be a whole number"):
            robot.set_setting("kp", 1.5)


def test_jog_counts_tendons_from_zero(board):
    with driver(board) as robot:
        robot.jog(3, -0.2)
        assert board.accepted[-1] == ("drive", "4", "-51") or ("drive", "4", "-51") in board.accepted
        with pytest.raises(HardwareError, match="refused as range"):
            robot.jog(0, 0.9)
        for tendon, drive, message in (
            (4, 0.1, "tendon must be"),
            (0, 1.5, "drive must be"),
            (0, math.nan, "drive"),
        ):
            with pytest.raises(HardwareError, match=message):
                robot.jog(tendon, drive)
