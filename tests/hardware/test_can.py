"""The driver of drives on a CAN bus, against drives in Python on python-can's virtual bus."""

import math
import struct
import threading
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from knode_cosserat_hardware.can_robot import (
    CanCommand,
    CanRobot,
    Heartbeat,
    identifier,
    node_and_command,
    read_heartbeat,
    read_two_floats,
)
from knode_cosserat_hardware.driver import DriverState, HardwareError, Limits
from knode_cosserat_hardware.motor_robot import MotorReel
from tests.hardware.waiting import eventually

can = pytest.importorskip("can")
NODES = (3, 5, 7, 9)
FAST = Limits(0.0, 10.0, 1e4, 40.0)
KT, GEAR = 0.5, 4.0
REEL = MotorReel(torque_constant=KT, directions=(1, 1, -1, -1))


class FakeDrive:
    """One axis: closed loop, torque, errors, watchdog; its tendon is tight from a quarter of a turn on."""

    def __init__(self, node):
        self.node, self.state, self.error, self.torque, self.turns = node, 1, 0, 0.0, 0.0
        self.mode, self.limits, self.torn, self.refuses = None, None, False, False
        self.fed, self.watchdog = time.monotonic(), math.inf

    def move(self):
        if self.state == 8 and time.monotonic() - self.fed > self.watchdog:
            self.error, self.state, self.torque = 1 << 24, 1, 0.0
        if self.state != 8 or not self.torque:
            return
        sign = np.sign(self.torque)
        self.turns = self.turns + 3.0 * sign if self.torn else sign * (0.25 + abs(self.torque))

    def take(self, command, data):
        self.fed = time.monotonic()
        if command == 0x07:
            wanted = struct.unpack("<I", data)[0]
            if not (wanted == 8 and (self.error or self.refuses)):
                self.state = wanted
        elif command == 0x0B:
            self.mode = struct.unpack("<II", data)
        elif command == 0x0E:
            self.torque = struct.unpack("<f", data)[0]
        elif command == 0x0F:
            self.limits = struct.unpack("<ff", data)
        elif command == 0x02:
            self.error, self.state, self.torque = 1 << 25, 1, 0.0
        elif command == 0x18:
            self.error = 0
        self.move()


class FakeBus:
    """Drives in a thread on a virtual bus."""

    def __init__(self, name):
        self.drives = {node: FakeDrive(node) for node in NODES}
        self.channel, self.silent, self.mute = name, set(), set()
        self._bus = can.Bus(interface="virtual", channel=name)
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self):
        self._end.set()
        self._thread.join(2.0)
        self._bus.shutdown()

    def send(self, arbitration_id, data):
        self._bus.send(can.Message(arbitration_id=arbitration_id, data=data, is_extended_id=False))

    def _run(self):
        sent = 0.0
        while not self._end.is_set():
            message = self._bus.recv(0.005)
            if message is not None:
                self._take(message)
            if time.monotonic() - sent > 0.02:
                sent = time.monotonic()
                for node, drive in self.drives.items():
                    drive.move()
                    if node not in self.silent | self.mute:
                        self.send(node << 5 | 1, struct.pack("<IBBBB", drive.error, drive.state, 0, 0, 0))

    def _take(self, message):
        node, command = message.arbitration_id >> 5, message.arbitration_id & 31
        drive = self.drives.get(node)
        if drive is None or node in self.silent:
            return
        drive.fed = time.monotonic()
        if not message.is_remote_frame:
            drive.take(command, bytes(message.data))
            return
        drive.move()
        measured = drive.torque * GEAR / KT if drive.state == 8 and not drive.torn else 0.0
        pair = {0x09: (drive.turns, 0.0), 0x14: (measured, measured)}[command]
        self.send(message.arbitration_id, struct.pack("<ff", *pair))

    @property
    def are_off(self):
        return all(drive.state == 1 for drive in self.drives.values())


@pytest.fixture
def bus(request):
    fake = FakeBus(request.node.name)
    yield fake
    fake.close()


def driver(fake, limits=FAST, reel=REEL):
    return CanRobot(fake.channel, NODES, limits, reel, interface="virtual", gear_ratio=GEAR)


# messages


def test_identifiers_are_those_of_the_description():
    assert identifier(1, CanCommand(0x0E)) == 0x2E and node_and_command(0x2E) == (1, 0x0E)
    assert identifier(63, CanCommand.CLEAR_ERRORS) == 0x7F8


@given(st.integers(0, 2**32 - 1), st.integers(0, 255))
def test_heartbeats_are_read(error, state):
    for rest in (b"", b"\x00" * 3):
        assert read_heartbeat(struct.pack("<IB", error, state) + rest) == (error, state)


@given(st.binary(max_size=8))
def test_any_data_is_read_without_an_error(data):
    read_heartbeat(data)
    values = read_two_floats(data)
    assert values is None or np.all(np.isfinite(values))


def test_errors_have_names():
    assert Heartbeat(0, 1).fault == "" and Heartbeat(32, 1).fault == "drive-error"
    assert Heartbeat(1 << 24, 1).fault == "motor-watchdog" and Heartbeat(1 << 25 | 4, 1).fault == "stopped"


# states


def test_a_session(bus):
    robot = driver(bus)
    with robot:
        assert robot.state is DriverState.READY and bus.are_off
        assert eventually(lambda: all(drive.mode == (1, 1) for drive in bus.drives.values()))
        assert bus.drives[3].limits[1] == pytest.approx(1.5 * FAST.high * REEL.radius / KT)
        with pytest.raises(HardwareError, match=r"not armed; call arm\(\)"):
            robot.command([1.0] * 4)
        robot.arm()
        assert robot.state is DriverState.ARMED and all(drive.state == 8 for drive in bus.drives.values())
        sent = robot.command([1.0, 2.0, 0.0, 4.0])
        assert np.allclose(sent, [1.0, 2.0, 0.0, 4.0])
        reading = robot.read()
        assert np.allclose(reading.tension, sent, atol=1e-5) and reading.state is DriverState.ARMED
        assert [drive.torque for drive in bus.drives.values()] == pytest.approx(
            [0.01 / GEAR, 0.02 / GEAR, 0.0, -0.04 / GEAR]
        )
        assert reading.time <= time.monotonic() and robot.latency.count == 1
        robot.disarm()
        assert eventually(lambda: bus.are_off) and robot.state is DriverState.READY
        robot.arm()
    assert eventually(lambda: bus.are_off) and robot.state is DriverState.DISCONNECTED
    robot.stop()
    robot.close()


def test_tare_and_jog(bus):
    with driver(bus) as robot:
        robot.tare()
        assert eventually(lambda: bus.are_off)
        assert abs(bus.drives[3].turns) > 0.25
        robot.jog(2, 0.5)
        assert eventually(lambda: bus.are_off) and bus.drives[7].turns < -0.25


# faults


def test_a_torn_tendon_is_a_fault(bus):
    with driver(bus) as robot:
        robot.arm()
        bus.drives[5].torn = True
        robot.command([2.0] * 4)
        time.sleep(0.05)
        assert robot.read().fault == "travel:2" and robot.state is DriverState.FAULT
        assert eventually(lambda: bus.are_off)
        with pytest.raises(HardwareError, match=r"travel at tendon 2 .*not torn"):
            robot.command([1.0] * 4)


@pytest.mark.parametrize(("error", "name"), [(1 << 24, "motor-watchdog"), (0x4000, "drive-error")])
def test_an_error_of_a_drive_is_a_fault(bus, error, name):
    with driver(bus) as robot:
        robot.arm()
        bus.drives[7].error, bus.drives[7].state = error, 1
        assert eventually(lambda: robot.read().fault == f"{name}:3")
        assert robot.drive_errors[7] == error and eventually(lambda: bus.are_off)
        with pytest.raises(HardwareError, match=rf"fault {name} at tendon 3.*then reset\(\)") as caught:
            robot.arm()
        assert "\n" not in str(caught.value)
        robot.reset()
        assert robot.state is DriverState.READY and robot.fault == "" and bus.drives[7].error == 0
        robot.arm()


def test_the_drives_watchdog_is_a_fault(bus):
    for drive in bus.drives.values():
        drive.watchdog = 0.3
    with driver(bus) as robot:
        robot.arm()
        robot.command([1.0] * 4)
        assert eventually(lambda: bus.are_off)
        assert eventually(lambda: robot.read().fault == "motor-watchdog:1")


def test_a_drive_that_leaves_the_closed_loop_is_a_fault(bus):
    with driver(bus) as robot:
        robot.arm()
        bus.drives[9].state = 1
        assert eventually(lambda: robot.read().fault == "drive-idle:4")


def test_a_drive_without_heartbeat_is_a_fault(bus):
    with driver(bus) as robot:
        robot.arm()
        bus.mute = {9}
        assert eventually(lambda: robot.read().fault == "heartbeat:4") and eventually(lambda: bus.are_off)


def test_stop_is_an_emergency_stop_of_the_drives(bus):
    with driver(bus) as robot:
        robot.arm()
        robot.stop()
        assert eventually(lambda: all(drive.error == 1 << 25 for drive in bus.drives.values()))
        assert robot.state is DriverState.FAULT and robot.fault == "stopped:0" and bus.are_off
        robot.reset()
        robot.arm()
    with pytest.raises(ZeroDivisionError), robot:
        robot.command([robot.arm() or 1.0 / 0.0] * 4)
    assert eventually(lambda: bus.are_off)


# connection


def test_drives_that_do_not_answer_are_named(bus):
    bus.silent = {7}
    robot = driver(bus)
    with pytest.raises(HardwareError, match="drive 7 sends no heartbeat"):
        robot.connect()
    assert robot.state is DriverState.DISCONNECTED
    bus.silent = set()
    with robot:
        robot.arm()
        bus.silent = {5}
        with pytest.raises(HardwareError, match="drive 5 does not answer"):
            robot.read(0.2)
        assert robot.state is DriverState.DISCONNECTED
        bus.silent = {7}  # the others were turned off
        assert eventually(lambda: bus.drives[3].state == bus.drives[9].state == 1)
        with pytest.raises(HardwareError, match="not connected"):
            robot.command([1.0] * 4)


def test_a_drive_that_does_not_enter_the_closed_loop(bus):
    bus.drives[5].refuses = True
    with driver(bus) as robot:
        with pytest.raises(HardwareError, match="drive 5 did not enter the closed loop; calibrate"):
            robot.arm()
        assert eventually(lambda: bus.are_off)


def test_other_traffic_is_ignored(bus):
    with driver(bus) as robot:
        robot.arm()
        for data in (b"", b"\x01", b"\xff" * 8):
            for command in (0x09, 0x14, 0x1F):
                bus.send(3 << 5 | command, data)
            bus.send(62 << 5 | 1, data)
        robot.command([1.0] * 4)
        assert np.all(np.isfinite(robot.read().tension)) and robot.state is DriverState.ARMED


def test_arguments_are_checked():
    for nodes in ([], [1, 1], [64], [-1]):
        with pytest.raises(HardwareError, match="node_ids must be different whole numbers"):
            CanRobot("x", nodes)
    with pytest.raises(HardwareError, match="gear_ratio must be"):
        CanRobot("x", [1], gear_ratio=0.0)
    with pytest.raises(HardwareError, match=r"cannot be opened.*ip link set nothing0 up"):
        CanRobot("nothing0", [1], interface="no-such-interface").connect()
