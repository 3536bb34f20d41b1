"""The simulated robot behind the interface of drivers."""

import time

import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat_hardware.driver import Driver, DriverState, HardwareError, Limits
from knode_cosserat_hardware.simulated import MachineParameters, SimulatedRobot

ROD = kc.load_robot("delrin-tendon-robot").replace(nodes=6)
EXACT = MachineParameters(noise=0.0, offset=0.0)


@pytest.fixture
def robot():
    with SimulatedRobot(ROD, machine=EXACT) as found:
        yield found


def test_it_is_a_driver_and_starts_ready():
    found = SimulatedRobot(ROD)
    assert isinstance(found, Driver) and found.state is DriverState.DISCONNECTED
    with pytest.raises(HardwareError, match="not connected"):
        found.arm()
    with found:
        assert found.state is DriverState.READY
        with pytest.raises(HardwareError, match="not armed"):
            found.command(np.ones(4))
    assert found.state is DriverState.DISCONNECTED


def test_tensions_follow_commands_with_a_lag(robot):
    robot.arm()
    wanted = np.array([2.0, 0.5, 0.5, 0.5])
    for _ in range(50):
        sent = robot.command(wanted)
        robot.wait(0.02)
    np.testing.assert_allclose(sent, wanted)
    reading = robot.read()
    np.testing.assert_allclose(reading.tension, wanted, atol=0.02)
    assert reading.state is DriverState.ARMED and reading.fault == ""
    assert robot.tip()[0] > 0.01 and robot.poses((0.5, 1.0)).shape == (2, 7)
    assert robot.latency.count > 0 and 0.0 < robot.latency.median <= 0.021
    robot.disarm()
    robot.wait(1.0)
    assert robot.state is DriverState.READY and np.max(robot.tension) < 0.01


def test_lock_step_gives_the_same_numbers_again():
    def motion():
        with SimulatedRobot(ROD) as found:
            found.arm()
            rows = []
            for _ in range(5):
                found.command(np.array([1.0, 0.0, 0.0, 1.0]))
                rows.append(np.concatenate([found.read().tension, found.tip()]))
        return np.array(rows)

    np.testing.assert_array_equal(motion(), motion())


def test_limits_hold():
    with SimulatedRobot(ROD, Limits(high=3.0, rate=1000.0, total=4.0)) as found:
        found.arm()
        found.wait(0.1)
        sent = found.command(np.array([9.0, 9.0, 0.0, 0.0]))
        assert np.max(sent) <= 3.0 and np.sum(sent) <= 4.0 + 1e-9
        with pytest.raises(HardwareError, match="finite"):
            found.command(np.array([np.nan, 0.0, 0.0, 0.0]))


def test_a_silent_host_is_a_fault(robot):
    robot.arm()
    robot.command(np.ones(4))
    robot.advance(1.0)
    assert robot.state is DriverState.FAULT
    assert robot.read().fault == "watchdog:0"
    with pytest.raises(HardwareError, match="watchdog"):
        robot.command(np.ones(4))
    robot.reset()
    robot.arm()
    assert robot.state is DriverState.ARMED


def test_over_tension_and_injected_faults(robot):
    robot.set_setting("limit", 100)
    robot.arm()
    for _ in range(10):
        if robot.state is DriverState.FAULT:
            break
        robot.command(np.array([0.0, 2.0, 0.0, 0.0]))
        robot.wait(0.04)
    assert robot.fault == "over-tension:2"
    robot.reset()
    robot.inject("slack:1", after=0.1)
    robot.wait(0.05)
    assert robot.fault == ""
    robot.wait(0.1)
    assert robot.fault == "slack:1"
    with pytest.raises(HardwareError, match="did you mean"):
        robot.inject("slak")
    robot.inject("lost")
    assert robot.state is DriverState.DISCONNECTED
    with pytest.raises(HardwareError, match="connection is lost"):
        robot.read()
    robot.stop()


def test_tare_removes_the_offset_and_jog_winds():
    with SimulatedRobot(ROD, machine=MachineParameters(noise=0.01, offset=0.5)) as found:
        assert np.mean(found.read().tension) > 0.4
        found.tare()
        assert np.max(np.abs(found.read().tension)) < 0.06
        found.jog(2, 0.2)
        tension = found.read().tension
        assert np.argmax(tension) == 2 and tension[2] > 0.3
        with pytest.raises(HardwareError, match="drive must be"):
            found.jog(0, 1.0)
        with pytest.raises(HardwareError, match="tendon must be"):
            found.jog(4, 0.1)


def test_stop_latches_and_never_raises(robot):
    robot.arm()
    robot.command(np.ones(4))
    robot.stop()
    robot.stop()
    assert robot.state is DriverState.FAULT and robot.fault == "stopped:0"
    robot.close()
    robot.stop()


def test_real_time_follows_the_clock():
    with SimulatedRobot(ROD, machine=EXACT, real_time=True) as found:
        began = time.monotonic()
        found.arm()
        found.command(np.ones(4))
        found.wait(0.1)
        assert 0.1 <= time.monotonic() - began < 1.0
        reading = found.read()
        assert began < reading.time <= time.monotonic() and reading.tension[0] > 0.3
        time.sleep(0.5)
        assert found.state is DriverState.FAULT


def test_other_controls_are_refused():
    with pytest.raises(HardwareError, match=r"driven by tensions; this .* has base_x, base_z, base_ry"):
        SimulatedRobot(kc.load_robot("soft-slender-robot"))
