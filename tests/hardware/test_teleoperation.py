"""Teleoperation by a gamepad, here a pipe with its events, and by keys."""

import os
import struct

import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat_hardware.driver import DriverState, HardwareError, Limits
from knode_cosserat_hardware.safety import EmergencyStop
from knode_cosserat_hardware.simulated import SimulatedRobot
from knode_cosserat_hardware.teleoperation import Gamepad, Keyboard, TensionMap, Wish, teleoperate

ROD = kc.load_robot("delrin-tendon-robot").replace(nodes=6)


def event(kind, number, value):
    return struct.pack("<IhBB", 0, value, kind, number)


@pytest.fixture
def pipe(tmp_path):
    path = tmp_path / "js0"
    os.mkfifo(path)
    reader = Gamepad(str(path))
    writer = os.open(path, os.O_WRONLY)
    yield reader, writer
    reader.close()


def test_a_gamepad_is_read(pipe):
    gamepad, writer = pipe
    # the first events state the present values
    os.write(writer, event(2 | 128, 0, 0) + event(2 | 128, 5, -32767))
    assert gamepad.wish() == Wish(0.0, 0.0, 0.0)
    os.write(writer, event(2, 0, 32767) + event(2, 1, -32767) + event(2, 5, 0) + event(2, 3, 9))
    assert gamepad.wish() == pytest.approx((1.0, 1.0, 0.5))
    # a stick at rest is never exactly in the middle
    os.write(writer, event(2, 0, 1500) + event(2, 1, -3000))
    assert gamepad.wish()[:2] == (0.0, 0.0)
    whole = event(2, 0, -32767)
    os.write(writer, whole[:3])
    assert gamepad.wish().x == 0.0
    os.write(writer, whole[3:])
    assert gamepad.wish().x == pytest.approx(-1.0)
    os.write(writer, event(1, 0, 1))
    gamepad.wish()
    os.write(writer, event(1, 1, 1))
    with pytest.raises(HardwareError, match="stop button 1"):
        gamepad.wish()
    os.close(writer)
    with pytest.raises(HardwareError, match="gamepad is lost"):
        gamepad.wish()


def test_a_missing_gamepad_is_one_line():
    with pytest.raises(HardwareError, match="js9: the gamepad cannot be opened"):
        Gamepad("/dev/input/js9")


def test_keys_move_by_steps():
    keys = Keyboard()
    keys.press(b"\x1b[C\x1b[C\x1b[A+x")
    assert keys.wish() == pytest.approx((0.2, 0.1, 0.1))
    keys.press(b"-" * 30 + b"\x1b[B" * 30)
    assert keys.wish() == pytest.approx((0.2, -1.0, 0.0))
    keys.press(b"0")
    assert keys.wish() == (0.0, 0.0, 0.0)


def test_tensions_of_wishes_keep_their_limits():
    mapping = TensionMap.of(Limits(low=0.5, high=20.0, total=40.0), 4)
    assert mapping.high == 10.0
    np.testing.assert_allclose(mapping.tensions(Wish(0, 0, 0)), 0.5)
    np.testing.assert_allclose(mapping.tensions(Wish(1, 0, 0)), [10.0, 0.5, 0.5, 0.5])
    np.testing.assert_allclose(mapping.tensions(Wish(0, -1, 0)), [0.5, 0.5, 0.5, 10.0])
    np.testing.assert_allclose(mapping.tensions(Wish(0, 0, 1)), 10.0)
    np.testing.assert_allclose(
        mapping.tensions(Wish(0.3, 0, 0.5)), 0.5 + 9.5 * np.array([0.8, 0.5, 0.2, 0.5])
    )
    random = np.random.default_rng(0)
    for count in (3, 4, 6):
        mapping = TensionMap.of(Limits(low=0.1, high=9.0, total=30.0), count)
        for x, y, contraction in random.uniform(-1.0, 1.0, (50, 3)):
            found = mapping.tensions(Wish(x, y, abs(contraction)))
            assert np.all(found >= 0.1 - 1e-12) and np.all(found <= 9.0) and np.sum(found) <= 30.0 + 1e-9
    with pytest.raises(HardwareError, match="below high"):
        TensionMap((0.0,), 5.0, 5.0)


def test_a_robot_follows_the_stick_and_stops_with_the_gamepad(pipe):
    gamepad, writer = pipe
    os.write(writer, event(2, 0, 32767))
    tips, shown = [], []
    with SimulatedRobot(ROD, Limits(high=4.0, total=20.0)) as robot, EmergencyStop(robot) as emergency:

        def show(wish, sent, reading):
            tips.append(robot.tip())
            shown.append(sent)
            if len(tips) == 20:
                os.close(writer)

        mapping = TensionMap.of(robot.limits, 4)
        with pytest.raises(HardwareError, match="gamepad is lost"):
            teleoperate(robot, gamepad, mapping, emergency, shown=show)
        assert robot.state is DriverState.FAULT and robot.fault == "stopped:0"
    assert len(tips) == 20 and tips[-1][0] > 0.02
    np.testing.assert_allclose(shown[-1], [4.0, 0.0, 0.0, 0.0], atol=1e-9)


def test_it_ends_after_its_time_with_released_tendons():
    with SimulatedRobot(ROD) as robot, EmergencyStop(robot) as emergency:
        count = teleoperate(robot, Keyboard(), TensionMap.of(robot.limits, 4), emergency, seconds=0.2)
        assert count == 5 and robot.state is DriverState.READY
