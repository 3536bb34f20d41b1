"""The commands that operate a robot."""

import json
import os
import pty
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat_hardware.cli import options
from knode_cosserat_hardware.description import HardwareDescription
from knode_cosserat_hardware.driver import HardwareError
from knode_cosserat_hardware.middleware.mocap import PoseFrame
from knode_cosserat_hardware.open_driver import open_driver
from knode_cosserat_hardware.simulated import SimulatedRobot
from tests.commands import run
from tests.hardware.fake_board import FakeBoard
from tests.hardware.waiting import eventually, free_computation

pytestmark = pytest.mark.slow

ROD = kc.load_robot("delrin-tendon-robot").replace(nodes=6)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with a small robot's file."""
    monkeypatch.chdir(tmp_path)
    kc.save_robot(ROD, "rod.yaml")
    with open("rod.yaml", "a") as file:
        file.write("hardware:\n  tension: {low: 0.2, high: 6.0, rate: 60.0, total: 20.0}\n")
    return tmp_path


def facts(result):
    assert result.exit_code == 0, result.stderr
    return json.loads(result.stdout)


def error(result, code=2):
    assert result.exit_code == code, result.output
    lines = result.stderr.strip().splitlines()
    assert lines[-1].startswith("error: ")
    return lines[-1]


def answering(monkeypatch, *answers):
    """A person at a terminal, who answers."""
    left = list(answers)
    monkeypatch.setattr(options, "has_terminal", lambda: True)
    monkeypatch.setattr("typer.confirm", lambda *_, **__: left.pop(0))
    return left


def test_connect_shows_the_robot(folder):
    found = facts(run("robot", "connect", "--port", "simulated", "--robot", "rod.yaml", "--json"))
    assert found["state"] == "ready" and found["tendons"] == 4 and found["limits"]["high"] == 6.0
    result = run("robot", "connect", "--port", "simulated", "--robot", "rod.yaml")
    assert "simulated: ready" in result.stdout and "limits 0.2 to 6 N, 60 N/s, 20 N in total" in result.stdout


def test_a_fault_is_explained_and_cleared(folder):
    words = ("--port", "simulated?fault=slack:2,after=0.01", "--robot", "rod.yaml", "--yes")
    with FakeBoard() as board:
        board.latch("slack:2")
        result = run("robot", "connect", "--port", board.port, "--yes")
        assert "fault slack at tendon 2" in result.stdout and "knode-cosserat robot reset" in result.stdout
        found = facts(run("robot", "reset", "--port", board.port, "--yes", "--save", "--json"))
        assert found["cleared"] == "slack:2" and found["state"] == "ready" and board.saved
        assert board.settings["estop"] == 1
        run("robot", "reset", "--port", board.port, "--yes", "--no-estop")
        assert board.settings["estop"] == 0
    result = run("robot", "reset", *words, "--no-estop")
    assert "the setting 'estop' is unknown" in error(result)
    assert "no fault" in run("robot", "reset", *words).stdout


@pytest.mark.parametrize(
    ("port", "message"),
    [
        ("/dev/ttyNONE9", "no such serial port"),
        ("simulatd", "did you mean simulated?"),
        ("dynamixel:", "has no address"),
        ("dynamixel:/dev/ttyNONE9", "?ids=1,2,3,4"),
        ("simulated?colour=1", "option 'colour' is unknown"),
        ("simulated?noise", "NAME=VALUE"),
    ],
)
def test_a_wrong_port_is_one_line(folder, port, message):
    result = run("robot", "connect", "--port", port, "--yes")
    assert message in error(result) and "Traceback" not in result.output


def test_words_of_drivers():
    opened = open_driver("dynamixel:/dev/ttyUSB0?ids=1,2,5&baud=57600", HardwareDescription(), lambda: ROD)
    assert opened.driver.tendon_count == 3 and opened.name == "dynamixel:/dev/ttyUSB0"
    words = "can:can0?ids=3,4&directions=1,-1&gear_ratio=8"
    opened = open_driver(words, HardwareDescription(), lambda: ROD)
    assert opened.driver.reel.directions == (1, -1) and opened.driver.reel.radius == 0.01
    opened = open_driver("simulated?noise=0,fault=slack:2,after=0.1", HardwareDescription(), lambda: ROD)
    with opened.driver as driver:
        opened.driver.advance(0.2)
        assert driver.fault == "slack:2" and opened.robot.poses((1.0,)).shape == (1, 7)
    assert "tares" in open_driver("COM3", HardwareDescription(), lambda: ROD).connecting_moves
    with pytest.raises(HardwareError, match="must be a number"):
        open_driver("simulated?noise=much", HardwareDescription(), lambda: ROD)


def test_without_a_terminal_nothing_moves_without_yes(folder, monkeypatch):
    def no(*_):
        raise AssertionError("connected")

    monkeypatch.setattr(SimulatedRobot, "connect", no)
    for words in (("tare",), ("jog", "1"), ("record", "--controls", "1,1,1,1", "--out", "a.bag"), ("steer",)):
        result = run("robot", *words, "--port", "simulated", "--robot", "rod.yaml")
        assert "confirm it in a terminal, or give --yes" in error(result)


def test_refused_consent_moves_nothing(folder, monkeypatch):
    with FakeBoard() as board:
        answering(monkeypatch, False)
        result = run("robot", "jog", "1", "--port", board.port)
        assert result.exit_code == 1 and "nothing was moved" in result.stderr
        # the port was not even opened, which would reset a board
        assert "opening the port resets the board, and the board tares" in result.stderr
        assert "then motor 1 reels in for 0.1 s" in result.stderr
        time.sleep(0.3)
        assert board.received == []


def test_jog_and_tare(folder, monkeypatch):
    assert answering(monkeypatch, True) == [True]
    found = facts(run("robot", "jog", "2", "--port", "simulated", "--robot", "rod.yaml", "--json"))
    assert np.argmax(found["change"]) == 1 and found["change"][1] > 0.3
    found = facts(run("robot", "tare", "--port", "simulated", "--robot", "rod.yaml", "--yes", "--json"))
    assert np.max(np.abs(found["tension"])) < 0.15
    assert "from 1 to 4 (got 5)" in error(run("robot", "jog", "5", "--port", "simulated", "--yes"))


def test_calibrate_on_a_robot_and_from_a_table(folder):
    pytest.importorskip("matplotlib")
    words = ("robot", "calibrate", "3", "--port", "simulated", "--robot", "rod.yaml", "--save", "--json")
    found = facts(run(*words, "--masses", "0", "0.2", "0.5", "0.2", "0", "--figure", "cell.png"))
    assert found["gain"] == pytest.approx(1.0, abs=0.02) and set(found["settings"]) == {"gain3", "zero3"}
    assert (folder / "cell.png").is_file() and found["hysteresis"] < 0.02
    (folder / "weights.csv").write_text("mass,reading\n0,100\n1,300\n2,500\n1,300\n0,100\n")
    result = run("robot", "calibrate", "1", "--table", "weights.csv")
    assert "warning: only 3 different weights" in result.stdout
    found = facts(run("robot", "calibrate", "1", "--table", "weights.csv", "--json"))
    assert found["gain"] == pytest.approx(9.80665 / 200)
    assert "either --port" in error(run("robot", "calibrate", "1"))
    assert "while weighing 3 kg: fault over-tension at tendon 3" in error(run(*words, "--masses", "0,3"))
    with FakeBoard() as board:
        assert "a person hangs the weights" in error(
            run("robot", "calibrate", "1", "--port", board.port, "--yes")
        )
        assert board.received == []


def test_record_writes_a_bag_that_is_read(folder):
    words = ("robot", "record", "--port", "simulated", "--robot", "rod.yaml", "--yes", "--json")
    found = facts(run(*words, "--controls", "sine:0.5", "--seconds", "1", "--out", "a.bag"))
    assert found["commands"] == 20 and found["bodies"] == ["tip"] and found["messages"] > 100
    recording = kc.load_recording("a.bag", kc.recordings.RecordingConfig.load("a.yaml"))
    measured = recording.sampled(0.05)
    assert measured.simulated and measured.control.shape[1] == 4
    assert np.nanmax(np.abs(measured.tip_position[:, 0])) > 1e-3
    assert "this file exists" in error(
        run(*words, "--controls", "1,1,1,1", "--seconds", "1", "--out", "a.bag")
    )


def test_a_fault_while_recording_keeps_the_bag(folder):
    result = run(
        "robot",
        "record",
        "--port",
        "simulated?fault=slack:2,after=0.5",
        "--robot",
        "rod.yaml",
        "--yes",
        "--controls",
        "1,1,1,1",
        "--seconds",
        "5",
        "--out",
        "a.bag",
    )
    assert "fault slack at tendon 2" in error(result) and "messages in a.bag" in result.stderr
    recording = kc.load_recording("a.bag", kc.recordings.RecordingConfig.load("a.yaml"))
    assert recording.sampled(0.05).time[-1] > 0.3


def test_run_closes_the_loop(folder, monkeypatch):
    free_computation(monkeypatch)
    words = ("robot", "run", "rod.yaml", "--port", "simulated", "--robot", "rod.yaml", "--yes", "--json")
    aim = ("--reference", "circle:radius=0.03,period=3", "--method", "kinematic", "--dt", "0.06")
    found = facts(run(*words, *aim, "--seconds", "1.5", "--out", "log.csv", "--recording", "loop.csv"))
    assert found["periods"] == 25 and found["missed"] == 0 and found["tip_rmse"] < 0.02
    assert found["latency_ms"] <= 21 and (folder / "log.csv").is_file() and (folder / "loop.csv").is_file()
    assert "allows 6 N" in error(run(*words, *aim, "--high", "9"))
    assert "--capture" in error(run("robot", "run", "rod.yaml", "--port", "/dev/ttyNONE9", *aim, "--yes"))


def test_a_fault_while_running_keeps_the_log(folder):
    result = run(
        "robot",
        "run",
        "rod.yaml",
        "--port",
        "simulated?fault=over-tension:1,after=0.6",
        "--robot",
        "rod.yaml",
        "--reference",
        "circle:radius=0.03,period=3",
        "--method",
        "kinematic",
        "--dt",
        "0.06",
        "--yes",
    )
    assert "fault over-tension at tendon 1" in error(result)
    (log,) = folder.glob("run-*.csv")
    assert f"kept 10 periods in {log.name}" in result.stderr and len(log.read_text().splitlines()) == 11


def test_commission_without_a_person_is_not_complete(folder):
    words = (
        "robot",
        "commission",
        "--port",
        "simulated?noise=0.01",
        "--robot",
        "rod.yaml",
        "--yes",
        "--json",
    )
    found = facts(run(*words, "--report", "report.json", "--person", "A. Person"))
    results = {step["name"]: step["result"] for step in found["steps"]}
    assert results["power-switch"] == "not confirmed" and results["watchdog"] == "passed"
    assert not found["complete"] and found["steps"][0]["person"] == "A. Person"


def test_steer_by_a_gamepad(folder):
    os.mkfifo("js0")
    keeps_open = os.open("js0", os.O_RDWR)
    words = ("robot", "steer", "--port", "simulated", "--robot", "rod.yaml", "--yes", "--json")
    found = facts(run(*words, "--device", "js0", "--seconds", "0.2"))
    os.close(keeps_open)
    assert found["commands"] == 5 and found["tension"] == [0.2, 0.2, 0.2, 0.2]
    assert "needs a terminal" in error(run(*words))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_stops_a_real_port(folder, number):
    with FakeBoard() as board:
        program = [sys.executable, "-m", "knode_cosserat.cli", "robot", "record", "--port", board.port]
        more = ["--yes", "--controls", "1,1,1,1", "--seconds", "60", "--out", "a.bag"]
        process = subprocess.Popen(
            [*program, *more], stderr=subprocess.PIPE, stdin=subprocess.DEVNULL, text=True
        )
        eventually(lambda: sum(board.wanted) >= 100 or process.poll() is not None, 60.0)
        assert board.state == "armed"
        process.send_signal(number)
        sent = time.monotonic()
        assert eventually(lambda: board.fault == "stopped:0") and time.monotonic() - sent < 1.0
        assert board.received.count(b"stop") == 1
        stderr = process.communicate(timeout=30)[1]
    assert process.returncode == 2 and f"error: stopped by {signal.Signals(number).name}" in stderr
    assert "Traceback" not in stderr and (folder / "a.bag").is_file()


def test_keys_steer_and_stop_and_the_terminal_is_restored(folder):
    import termios

    master, slave = pty.openpty()
    before = termios.tcgetattr(slave)
    program = [
        sys.executable,
        "-m",
        "knode_cosserat.cli",
        "robot",
        "steer",
        "--port",
        "simulated?real_time=1",
    ]
    process = subprocess.Popen(
        [*program, "--robot", "rod.yaml", "--yes"],
        stdin=slave,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert "space, Enter, q or Ctrl-C stops the robot" in process.stderr.readline()
    os.write(master, b"\x1b[C")
    time.sleep(0.5)
    assert process.poll() is None
    os.write(master, b" ")
    stderr = process.communicate(timeout=30)[1]
    assert process.returncode == 2 and "stopped" in stderr and "Traceback" not in stderr
    assert termios.tcgetattr(slave) == before
    os.close(master)
    os.close(slave)


@pytest.mark.campaign
def test_the_firmware_passes_its_commissioning(folder):
    from knode_cosserat_hardware.emulation import missing

    if missing():
        pytest.skip("the emulator is not installed")
    words = ("robot", "commission", "--port", "emulated", "--report", "report.json", "--yes", "--json")
    results = {step["name"]: step["result"] for step in facts(run(*words))["steps"]}
    names = ("noise", "directions", "stop", "watchdog", "tracking", "over-tension", "latency")
    assert {name: results[name] for name in names} == dict.fromkeys(names, "passed")


class Capture:
    """Motion capture with a base at (1, 2, 0.5) m."""

    names = ("base", "tip")

    def poses(self):
        position = np.array([[1.0, 2.0, 0.5], [1.1, 2.0, 1.0]])
        return PoseFrame(3.0, position, np.tile([1.0, 0.0, 0.0, 0.0], (2, 1)))


def test_the_measured_tip_is_relative_to_the_clamped_end():
    opened = open_driver("/dev/ttyACM0", HardwareDescription(), lambda: ROD)
    stamp, tip = options.tip_source(opened, Capture())()
    np.testing.assert_allclose(tip, [0.1, 0.0, 0.5 + 0.0635])
    assert stamp == 3.0 and options.tip_source(opened, None) is None
    config = options.recording_config(opened, ["base", "rib", "tip"])
    assert config.base.height == 0.0635 and [each.fraction for each in config.markers] == [0.5, 1.0]


@pytest.mark.parametrize("word", ["vicon:a?tip", "natnet:a?tip", "natnet:?tip=1", "natnet:a", "vrpn:a?tip=1"])
def test_a_wrong_capture_is_one_line(folder, word):
    words = ("robot", "record", "--port", "simulated", "--controls", "1,1,1,1", "--out", "a.bag", "--yes")
    assert "allowed is natnet:SERVER?base=1,tip=2" in error(run(*words, "--capture", word))
