"""The driver of Dynamixel motors, against motors with registers behind a pseudo-terminal."""

import math
import time

import numpy as np
import pytest

from knode_cosserat_hardware.driver import DriverState, HardwareError, Limits
from knode_cosserat_hardware.dynamixel import CURRENT, DynamixelRobot, Register
from knode_cosserat_hardware.motor_robot import MotorReel
from tests.hardware.fake_dynamixel import SYNC_READ, FakeDynamixel, crc, packet

pytest.importorskip("dynamixel_sdk")
IDS = (11, 12, 13, 14)
FAST = Limits(0.0, 10.0, 1e4, 40.0)
REEL = MotorReel(directions=(1, -1, 1, -1))


@pytest.fixture
def bus():
    with FakeDynamixel(IDS) as fake:
        for motor, sign in zip(IDS, REEL.directions, strict=True):
            fake.motors[motor].sign = sign
        yield fake


def driver(fake, limits=FAST, reel=REEL, **options):
    return DynamixelRobot(fake.port, IDS, limits, reel, **options)


def test_the_fake_speaks_the_protocol():
    # a ping to motor 1, as printed in the maker's description of protocol 2.0
    assert packet(1, 0x01, b"") == bytes.fromhex("FFFFFD00 01 0300 01 194E")
    assert crc(b"") == 0


def test_a_session(bus):
    robot = driver(bus)
    with robot:
        assert robot.state is DriverState.READY and robot.tendon_count == 4
        for motor in bus.motors.values():
            assert (motor.get(9, 1), motor.get(11, 1), motor.get(64, 1)) == (0, 5, 0)
        with pytest.raises(HardwareError, match=r"not armed; call arm\(\)"):
            robot.command([1.0] * 4)
        robot.arm()
        assert all(motor.get(64, 1) == 1 and motor.get(102, 2) == 0 for motor in bus.motors.values())
        sent = robot.command([1.0, 2.0, 0.0, 5.0])
        assert np.allclose(sent, [1.0, 2.0, 0.0, 5.0])
        count = bus.instructions.count(SYNC_READ)
        reading = robot.read()
        assert bus.instructions.count(SYNC_READ) == count + 1  # one packet for all motors and registers
        assert reading.state is DriverState.ARMED and reading.time <= time.monotonic()
        resolution = CURRENT * REEL.torque_constant / REEL.radius
        assert np.allclose(reading.tension, sent, atol=resolution)
        assert [motor.get(126, 2, True) > 0 for motor in bus.motors.values()] == [True, False, False, False]
        assert robot.latency.count == 1 and robot.latency.median > 0.0
        robot.disarm()
        assert robot.state is DriverState.READY and not any(m.get(64, 1) for m in bus.motors.values())
        robot.arm()
    assert robot.state is DriverState.DISCONNECTED and not any(m.get(64, 1) for m in bus.motors.values())
    robot.close()
    robot.stop()


def test_settings_in_eeprom_are_written_only_if_needed(bus):
    for _ in range(3):
        with driver(bus) as robot:
            robot.arm()
    assert [motor.worn for motor in bus.motors.values()] == [2] * 4


def test_tare_sets_the_zero_of_the_travel(bus):
    with driver(bus) as robot:
        robot.tare()
        assert robot.state is DriverState.READY and not any(m.get(64, 1) for m in bus.motors.values())
        robot.arm()
        with pytest.raises(HardwareError, match=r"tare moves the motors by itself; call disarm"):
            robot.tare()
        turn = 2 * math.pi / 4096 * REEL.radius
        for motor, sign in zip(bus.motors.values(), REEL.directions, strict=True):
            length = (sign * motor.get(116, 4, True) - motor.tight) * turn
            assert REEL.reel_in < length < 1.1 * REEL.reel_in


def test_a_torn_tendon_is_a_fault_and_the_motor_stops_at_its_goal(bus):
    with driver(bus) as robot:
        robot.arm()
        bus.motors[13].torn = True
        robot.command([1.0] * 4)
        reading = robot.read()
        assert reading.fault == "travel:3" and reading.state is DriverState.FAULT
        assert not any(m.get(64, 1) for m in bus.motors.values())
        with pytest.raises(HardwareError, match=r"travel at tendon 3 .*not torn.*then reset\(\)") as caught:
            robot.command([1.0] * 4)
        assert "\n" not in str(caught.value)
        bus.motors[13].torn = False
        bus.motors[13].set(132, 4, 0)
        robot.reset()
        robot.arm()


def test_the_motors_watchdog_stops_a_silent_host(bus):
    with driver(bus, host_timeout=0.06) as robot:
        robot.arm()
        robot.command([3.0] * 4)
        assert bus.motors[11].get(98, 1) == 3
        time.sleep(0.3)
        assert robot.read().fault.startswith("motor-watchdog:")
        with pytest.raises(HardwareError, match=r"received nothing in time.*host_timeout"):
            robot.command([1.0] * 4)
        robot.reset()
        assert robot.state is DriverState.READY and bus.motors[11].get(98, 1) == 0
        robot.arm()
        robot.command([1.0] * 4)


@pytest.mark.parametrize(("bit", "name"), [(0, "input-voltage"), (2, "overheating"), (5, "overload")])
def test_hardware_errors_are_faults_that_a_restart_clears(bus, bit, name):
    with driver(bus) as robot:
        robot.arm()
        bus.motors[12].set(70, 1, 1 << bit)
        assert robot.read().fault == f"{name}:2"
        assert robot.state is DriverState.FAULT and not any(m.get(64, 1) for m in bus.motors.values())
        with pytest.raises(HardwareError, match=f"fault {name} at tendon 2"):
            robot.arm()
        robot.reset()
        assert robot.state is DriverState.READY and bus.motors[12].get(70, 1) == 0
        robot.arm()
        robot.command([1.0] * 4)
        assert robot.read().fault == ""


def test_too_much_measured_tension_is_a_fault(bus):
    with driver(bus, reel=MotorReel(directions=(1, -1, 1, -1), measured_high=4.0)) as robot:
        robot.arm()
        robot.command([0.0, 5.0, 0.0, 0.0])
        assert robot.read().fault == "measured-tension:2"
        assert not any(m.get(64, 1) for m in bus.motors.values())


def test_stop_latches_and_errors_in_the_program_stop(bus):
    robot = driver(bus)
    with pytest.raises(ZeroDivisionError), robot:
        robot.command([robot.arm() or 1.0 / 0.0] * 4)
    assert not any(m.get(64, 1) for m in bus.motors.values())
    with robot:
        robot.arm()
        robot.stop()
        assert robot.state is DriverState.FAULT and robot.fault == "stopped:0"
        robot.reset()
        assert robot.state is DriverState.READY


def test_jog_moves_one_motor_and_turns_off(bus):
    with driver(bus) as robot:
        robot.jog(1, 0.5)
        assert bus.motors[12].get(132, 4, True) < 0 == bus.motors[11].get(132, 4, True)
        assert not any(m.get(64, 1) for m in bus.motors.values())
        before = bus.motors[11].get(132, 4, True)
        bus.motors[11].torn = True
        robot.jog(0, -0.5)
        assert bus.motors[11].get(132, 4, True) < before
        with pytest.raises(HardwareError, match="tendon must be"):
            robot.jog(4, 0.1)
        with pytest.raises(HardwareError, match="drive must be"):
            robot.jog(0, math.nan)


def test_damaged_answers_are_read_again(bus):
    bus.damage = 7
    with driver(bus) as robot:
        robot.arm()
        for _ in range(5):
            robot.command([1.0] * 4)
            assert robot.read().state is DriverState.ARMED
    assert bus.count > 14


def test_a_motor_that_does_not_answer_is_named(bus):
    bus.silent = {13}
    robot = driver(bus)
    with pytest.raises(HardwareError, match=r"motor 13 does not answer; check its power.*baud \(1000000\)"):
        robot.connect()
    assert robot.state is DriverState.DISCONNECTED
    bus.silent = set()
    with robot:
        robot.arm()
        bus.silent = {12}
        with pytest.raises(HardwareError, match=r"motor 1[1-4] does not answer"):
            robot.read(0.1)
        # the other motors are turned off
        assert robot.state is DriverState.DISCONNECTED and not bus.motors[11].get(64, 1)


def test_a_bus_that_is_unplugged_is_one_line(bus):
    robot = driver(bus)
    robot.connect()
    robot.arm()
    bus.unplug()
    with pytest.raises(HardwareError, match=r"check the USB cable|does not answer") as caught:
        robot.read(0.1)
    assert "\n" not in str(caught.value) and robot.state is DriverState.DISCONNECTED
    robot.stop()
    robot.close()


def test_arguments_are_checked(bus):
    with pytest.raises(HardwareError, match="ids must be different"):
        DynamixelRobot("port", [1, 1])
    with pytest.raises(HardwareError, match="host_timeout must be between"):
        DynamixelRobot("port", [1], host_timeout=5.0)
    with pytest.raises(HardwareError, match="directions must be"):
        DynamixelRobot("port", [1, 2], reel=MotorReel(directions=(1, 1, 1)))
    with pytest.raises(HardwareError, match="radius must be a positive number"):
        MotorReel(radius=0.0)
    with pytest.raises(HardwareError, match=r"reduce limits\.high, or raise the motor's Current Limit"):
        driver(bus, Limits(high=1000.0, total=4000.0)).connect()
    with pytest.raises(HardwareError, match="cannot be opened"):
        DynamixelRobot("/dev/ttyNothing", [1]).connect()


def test_limits_reduce_commands(bus):
    with driver(bus, Limits(0.0, 10.0, 20.0, 12.0)) as robot:
        robot.arm()
        first = robot.command([50.0] * 4)
        assert first.max() <= 20.0 * 0.1 + 1e-9
        for _ in range(30):
            robot.read()
            time.sleep(0.02)
            sent = robot.command([50.0] * 4)
        assert 11.0 < sent.sum() <= 12.0 + 1e-9
        with pytest.raises(HardwareError, match="tensions must be finite"):
            robot.command([np.nan] * 4)


@pytest.mark.parametrize(
    ("value", "register"), [(-5, Register.PRESENT_VELOCITY), (250, Register.BUS_WATCHDOG)]
)
def test_registers_are_read_as_written(value, register):
    assert register.decoded(bytes(register.encoded(value))) == value
