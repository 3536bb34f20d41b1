"""Sliders in a window on a virtual display; logic without one."""

import os
import shutil
import subprocess
import time

import numpy as np
import pytest
from typer.testing import CliRunner

import knode_cosserat as kc
from knode_cosserat.cli import app
from knode_cosserat_hardware.driver import DriverState, HardwareError, Limits
from knode_cosserat_hardware.safety import EmergencyStop
from knode_cosserat_hardware.simulated import SimulatedRobot
from knode_cosserat_hardware.teleoperation import SliderWindow, teleoperate

pytest.importorskip("tkinter")
ROD = kc.load_robot("delrin-tendon-robot").replace(nodes=6)


@pytest.fixture(scope="module")
def display():
    """A virtual display; its name."""
    if shutil.which("Xvfb") is None:
        pytest.skip("Xvfb is not installed: apt-get install xvfb")
    read, write = os.pipe()
    command = ["Xvfb", "-displayfd", str(write), "-screen", "0", "900x700x24", "-nolisten", "tcp"]
    with subprocess.Popen(command, pass_fds=[write], stderr=subprocess.DEVNULL) as server:
        os.close(write)
        with os.fdopen(read) as pipe:
            # the whole line: the server ends if it cannot write the last byte
            name = pipe.readline().strip()
        yield f":{name}"
        server.terminate()


@pytest.fixture
def window(display, monkeypatch):
    monkeypatch.setenv("DISPLAY", display)
    made = SliderWindow(4, 0.2, 5.0)
    yield made
    made.close()
    made.close()


def test_sliders_set_tensions_and_readings_are_shown(window):
    np.testing.assert_allclose(window.wish(), 0.2)
    limits = Limits(low=0.2, high=5.0, total=20.0)
    with SimulatedRobot(ROD, limits) as robot, EmergencyStop(robot) as emergency:
        window._scales[0].set(4.0)
        texts = []

        def show(wish, sent, reading):
            window.show(wish, sent, reading)
            texts.append((window._state["text"], window._readings[0]["text"], sent[0], reading.tension[0]))

        teleoperate(robot, window, None, emergency, seconds=1.2, shown=show)
        assert robot.tip()[0] > 0.02
    state, shown, sent, measured = texts[-1]
    assert state == "armed" and shown == f"measured\n{measured:.2f} N" and sent == pytest.approx(4.0)
    window.release()
    np.testing.assert_allclose(window.wish(), 0.2)


@pytest.mark.parametrize("way", ["button", "key", "closed"])
def test_each_way_to_stop_stops_the_robot(window, way):
    with SimulatedRobot(ROD) as robot, EmergencyStop(robot) as emergency:

        def act(wish, sent, reading):
            if way == "button":
                window._button.invoke()
            elif way == "key":
                window._root.focus_force()
                window._root.update()
                window._root.event_generate("<space>")
            else:
                window._root.tk.call(*window._root.protocol("WM_DELETE_WINDOW").split())

        with pytest.raises(HardwareError, match=r"(pressed|closed).*; the robot was stopped"):
            teleoperate(robot, window, None, emergency, seconds=1.0, shown=act)
        assert robot.state is DriverState.FAULT and robot.fault == "stopped:0"


def test_sliders_keep_their_range(window):
    for scale in window._scales:
        scale.configure(from_=99.0)
        scale.set(99.0)
    assert np.all(window.wish() <= 5.0)
    with pytest.raises(HardwareError, match="below high"):
        SliderWindow(4, 3.0, 3.0)


def test_without_a_display_the_keys_are_used_and_said(monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    with pytest.raises(HardwareError, match="sliders need a display"):
        SliderWindow(4, 0.2, 5.0)
    words = ["robot", "steer", "--port", "simulated", "--device", "sliders", "--seconds", "0.1", "--yes"]
    result = CliRunner().invoke(app, words)
    lines = result.stderr.strip().splitlines()
    assert lines[0].startswith("sliders need a display")
    assert lines[0].endswith("; steering by keys: arrows, + and -")
    assert lines[-1].startswith("error: the keyboard needs a terminal") and result.exit_code == 2


def test_the_command_steers_by_sliders(display, monkeypatch):
    monkeypatch.setenv("DISPLAY", display)
    began = time.monotonic()
    words = ["robot", "steer", "--port", "simulated", "--device", "sliders", "--seconds", "0.2", "--yes"]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 0 and "5 commands" in result.stdout
    assert time.monotonic() - began < 60.0
