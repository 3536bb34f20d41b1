"""Operation of a robot: emergency stop, closed loops, commissioning."""

import json
import os
import pty
import signal
import sys
import threading
import time

import numpy as np
import pytest

import knode_cosserat as kc
from knode_cosserat_hardware.commissioning import CHECKLIST, Commissioning, Person
from knode_cosserat_hardware.driver import DriverState, HardwareError, Limits
from knode_cosserat_hardware.plant import HardwarePlant
from knode_cosserat_hardware.safety import EmergencyStop, SafeRegion, StoppedError
from knode_cosserat_hardware.simulated import MachineParameters, SimulatedRobot
from tests.hardware.waiting import eventually, free_computation

pytestmark = pytest.mark.slow

ROD = kc.load_robot("delrin-tendon-robot").replace(nodes=6)
DT = 0.06


class Stops:
    """Driver that counts its stops."""

    count = 0

    def stop(self):
        self.count += 1


# emergency stop


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_stops_the_robot_once(number):
    before, driver = signal.getsignal(number), Stops()
    emergency = EmergencyStop(driver)

    def work():
        with emergency:
            os.kill(os.getpid(), number)
            time.sleep(5.0)

    with pytest.raises(StoppedError, match=f"stopped by {number.name}"):
        work()
    assert driver.count == 1 and emergency.is_stopped and emergency.reason == number.name
    assert signal.getsignal(number) == before and signal.set_wakeup_fd(-1) == -1


def test_a_signal_during_a_destructor_is_not_lost(capfd):
    class Dropped:
        def __del__(self):
            signal.raise_signal(signal.SIGINT)

    driver, hook = Stops(), sys.unraisablehook
    with EmergencyStop(driver) as emergency:
        thing = Dropped()
        del thing
        assert eventually(lambda: driver.count == 1)
        with pytest.raises(StoppedError, match="stopped by SIGINT"):
            emergency.check()
    assert "Traceback" not in capfd.readouterr().err and sys.unraisablehook is hook


@pytest.mark.parametrize("key", [b" ", b"q", b"\n"])
def test_a_key_stops_the_robot_and_the_terminal_is_restored(key):
    import termios

    driver, (master, slave) = Stops(), pty.openpty()
    before, others = termios.tcgetattr(slave), []
    with EmergencyStop(driver, terminal=slave, other_keys=others.append) as emergency:
        assert termios.tcgetattr(slave) != before
        emergency.check()
        os.write(master, b"x")
        assert eventually(lambda: others == [b"x"]) and driver.count == 0
        os.write(master, key)
        assert eventually(lambda: driver.count == 1)
        os.write(master, key)
        with pytest.raises(StoppedError, match="stopped by a key"):
            emergency.check()
    assert driver.count == 1 and termios.tcgetattr(slave) == before
    os.close(master)
    os.close(slave)


def test_a_lost_terminal_stops_the_robot():
    driver, (master, slave) = Stops(), pty.openpty()
    with EmergencyStop(driver, terminal=slave) as emergency:
        os.close(master)
        assert eventually(lambda: driver.count == 1)
        assert emergency.reason == "a lost terminal"
    os.close(slave)


def test_a_stop_comes_at_once_while_the_program_is_busy():
    driver, times, matrix = Stops(), [], np.random.default_rng(0).normal(size=(1500, 1500))
    driver.stop = lambda: times.append(time.monotonic())

    def work():
        with EmergencyStop(driver):
            threading.Timer(0.05, lambda: os.kill(os.getpid(), signal.SIGTERM)).start()
            # one call that takes long: Python's handler runs after it
            np.linalg.svd(matrix)
            time.sleep(5.0)

    began = time.monotonic()
    with pytest.raises(StoppedError):
        work()
    assert len(times) == 1 and times[0] - began < 0.8 * (time.monotonic() - began)


def test_errors_stop_the_robot_and_normal_ends_do_not():
    driver = Stops()
    with EmergencyStop(driver):
        pass
    assert driver.count == 0
    with pytest.raises(ZeroDivisionError), EmergencyStop(driver):
        1 / 0  # noqa: B018
    assert driver.count == 1


def test_it_works_in_other_threads_without_signals():
    driver, done = Stops(), []

    def work():
        with EmergencyStop(driver) as emergency:
            emergency.stop("a test")
            done.append(emergency.is_stopped)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert done == [True] and driver.count == 1


def test_regions():
    region = SafeRegion(radius=0.2, low=0.1, high=0.7, speed=1.0)
    inside = np.array([0.1, 0.0, 0.5])
    assert region.violation(inside) == "" and region.violation(np.full(3, np.nan)) == ""
    assert "0.3 m from the axis" in region.violation(np.array([0.0, 0.3, 0.5]))
    assert "height is 0.05 m" in region.violation(np.array([0.0, 0.0, 0.05]))
    assert "moves at 2 m/s" in region.violation(inside, inside + np.array([0.1, 0.0, 0.0]), 0.05)
    with pytest.raises(HardwareError, match="above 0"):
        SafeRegion(radius=0.0)


# closed loops


@pytest.fixture(scope="module")
def controller():
    return kc.control.controller_named("kinematic", ROD, DT, kc.control.ControlLimits(0.3, 6.0, 40.0))


@pytest.fixture
def robot():
    with SimulatedRobot(ROD, Limits(high=8.0), machine=MachineParameters(noise=0.0, offset=0.0)) as found:
        yield found


def plant_of(robot, **more):
    return HardwarePlant(robot, lambda: (robot.now(), robot.tip()), DT, **more)


AIM = kc.control.constant([0.05, 0.0, 0.62])


def test_a_loop_moves_the_robot_and_keeps_the_time(robot, controller, monkeypatch):
    free_computation(monkeypatch)
    plant = plant_of(robot)
    log = kc.control.run_loop(controller, plant, AIM, 1.5)
    assert len(log.time) == 25 and log.missed == 0 and plant.reduced == 0
    assert abs(log.tip[-1, 0] - 0.05) < 0.01 and abs(log.tip[-1, 1]) < 0.005
    np.testing.assert_array_equal(log.initial_control, np.zeros(4))
    # nothing moved during the rehearsal
    assert np.linalg.norm(log.tip[0][:2]) < 1e-6
    assert len(plant.readings) == 24 and robot.state is DriverState.ARMED
    stamps = np.array([reading.time for reading in plant.readings])
    np.testing.assert_allclose(np.diff(stamps), DT, atol=0.021)


def test_the_reported_tip_is_in_the_robots_frame(robot):
    seen = ROD.replace(camera=kc.robots.Camera(position=(0.01, 0.0, 0.0)))
    plant = HardwarePlant(robot, lambda: (robot.now(), np.array([0.03, 0.0, 0.6])), DT, robot=seen)
    plant.start()
    np.testing.assert_allclose(plant.measure(), [0.03, 0.0, 0.6])
    np.testing.assert_allclose(plant.tip(), [0.02, 0.0, 0.6], atol=1e-12)


def test_a_fault_ends_the_loop_and_the_log_is_kept(robot, controller):
    plant = plant_of(robot)
    robot.inject("slack:2", after=0.6)
    with pytest.raises(HardwareError, match="fault slack at tendon 2") as caught:
        kc.control.run_loop(controller, plant, AIM, 3.0)
    log = caught.value.log
    assert len(log.time) == 10 and np.isfinite(log.tip[-1]).all()
    assert robot.state is DriverState.FAULT


def test_a_lost_connection_keeps_the_log_too(robot, controller):
    robot.inject("lost", after=0.3)
    with pytest.raises(HardwareError, match="connection is lost") as caught:
        kc.control.run_loop(controller, plant_of(robot), AIM, 3.0)
    assert len(caught.value.log.time) == 5


def test_leaving_the_region_stops_the_robot(robot, controller):
    with pytest.raises(HardwareError, match=r"from the axis \(allowed: 0.02 m\); the robot was stopped"):
        kc.control.run_loop(controller, plant_of(robot, region=SafeRegion(radius=0.02)), AIM, 3.0)
    assert robot.fault == "stopped:0"


def test_a_signal_ends_the_loop_with_its_log(robot, controller):
    robot.observer = lambda each: each.now() > 0.5 and os.kill(os.getpid(), signal.SIGINT)
    with pytest.raises(StoppedError) as caught, EmergencyStop(robot) as emergency:
        kc.control.run_loop(controller, plant_of(robot, emergency=emergency), AIM, 3.0)
    assert 5 <= len(caught.value.log.time) <= 10 and robot.fault == "stopped:0"


def test_old_measurements_are_missing(robot):
    plant = HardwarePlant(robot, lambda: (robot.now() - 2 * DT, np.ones(3)), DT)
    plant.start()
    assert np.isnan(plant.measure()).all() and np.isnan(plant.tip()).all()
    assert np.isnan(HardwarePlant(robot, None, DT).measure()).all()
    with pytest.raises(HardwareError, match="must have 3 numbers"):
        HardwarePlant(robot, lambda: (robot.now(), np.ones(2)), DT).measure()
    with pytest.raises(HardwareError, match="positive number"):
        HardwarePlant(robot, None, 0.0)


def test_a_late_program_counts_missed_periods(robot):
    plant = plant_of(robot)
    plant.start()
    for late in (0.0, 2.0 * DT, 0.0):
        plant.measure()
        plant.apply(np.full(4, 0.5))
        robot.wait(late)
    plant.measure()
    assert plant.missed == 1


def test_commands_beyond_the_driver_are_counted(robot):
    plant = plant_of(robot)
    plant.start()
    plant.measure()
    plant.apply(np.array([20.0, 0.0, 0.0, 0.0]))
    assert plant.reduced == 1
    assert plant.start() is not None and robot.state is DriverState.READY and plant.reduced == 0


# commissioning


def commissioned(driver, path, answer=True, **more):
    person = Person("A. Person", lambda statement: answer, lambda motion: bool(answer))
    commissioning = Commissioning(driver, path, "simulated", person, **more)
    return commissioning.run(), commissioning


def results(report):
    return {step["name"]: step["result"] for step in report["steps"]}


def test_a_sound_robot_passes_every_check(tmp_path):
    with SimulatedRobot(ROD, machine=MachineParameters(noise=0.01, offset=0.2)) as robot:
        robot.tare()
        report, commissioning = commissioned(robot, tmp_path / "report.json")
    assert report["complete"] and commissioning.is_complete
    assert set(results(report)) == {step.name for step in CHECKLIST}
    assert set(results(report).values()) == {"confirmed", "passed"}
    assert json.loads((tmp_path / "report.json").read_text()) == report
    steps = {step["name"]: step for step in report["steps"]}
    assert max(steps["noise"]["values"]["noise"]) < 0.02 and min(steps["directions"]["values"]["rise"]) > 0.15
    assert steps["watchdog"]["values"]["fault"] == "watchdog:0"
    assert steps["over-tension"]["values"]["fault"] == "over-tension:1"
    assert robot.cells.settings["limit"] == 2300
    assert steps["latency"]["values"]["median"] <= 0.021 and steps["stop"]["person"] == "A. Person"


def test_a_failed_check_ends_it_and_the_report_is_resumed(tmp_path):
    path = tmp_path / "report.json"
    with SimulatedRobot(ROD, machine=MachineParameters(offset=0.9)) as robot:
        report, _ = commissioned(robot, path)
        assert results(report)["noise"] == "failed" and "directions" not in results(report)
        assert "0.9" in report["steps"][-1]["reason"] and "then tare" in report["steps"][-1]["reason"]
        robot.tare()
        first = json.loads(path.read_text())["steps"][0]
        report, commissioning = commissioned(robot, path)
        assert report["complete"] and report["steps"][0] == first
        with pytest.raises(HardwareError, match="another robot"):
            Commissioning(robot, path, "other", commissioning.person)
        path.write_text("[1]")
        with pytest.raises(HardwareError, match="no commissioning report"):
            Commissioning(robot, path, "simulated", commissioning.person)


def test_nothing_moves_without_consent_and_nobody_confirms_for_a_person(tmp_path):
    with SimulatedRobot(ROD, machine=MachineParameters(offset=0.0)) as robot:
        report, _ = commissioned(robot, tmp_path / "a.json", answer=False)
        assert results(report) == {"power-switch": "failed"}
        measured = [step for step in CHECKLIST if step.measure is not None]
        report, _ = commissioned(robot, tmp_path / "b.json", answer=False, steps=measured)
        assert results(report).pop("noise") == "passed"
        assert set(results(report).values()) == {"passed", "skipped"} and not report["complete"]
        assert np.max(robot.tension) == 0.0
        report, _ = commissioned(robot, tmp_path / "c.json", answer=None, steps=CHECKLIST[:6])
        assert results(report)["power-switch"] == "not confirmed"


def test_wrong_wiring_is_found(tmp_path):
    class Swapped(SimulatedRobot):
        def jog(self, tendon, drive):
            super().jog((tendon + 1) % 4, drive)

    class Dead(SimulatedRobot):
        def jog(self, tendon, drive):
            self.wait(0.1)

    step = [each for each in CHECKLIST if each.name == "directions"]
    machine = MachineParameters(noise=0.0, offset=0.0)
    for kind, message in ((Swapped, "motor 1 changes load cell 2"), (Dead, "motor 1 changes no load cell")):
        with kind(ROD, machine=machine) as robot:
            report, _ = commissioned(robot, tmp_path / f"{kind.__name__}.json", steps=step)
            assert message in report["steps"][0]["reason"]


def test_a_robot_without_a_watchdog_fails(tmp_path):
    with SimulatedRobot(ROD, machine=MachineParameters(noise=0.0, offset=0.0)) as robot:
        step = [each for each in CHECKLIST if each.name == "watchdog"]
        robot.advance = robot.wait
        report, _ = commissioned(robot, tmp_path / "a.json", steps=step)
        assert "still armed after 1 s without its host" in report["steps"][0]["reason"]
        assert robot.state is DriverState.FAULT


def test_a_signal_during_a_check_stops_and_is_in_the_report(tmp_path):
    with SimulatedRobot(ROD, machine=MachineParameters(noise=0.0, offset=0.0)) as robot:
        step = [each for each in CHECKLIST if each.name == "tracking"]
        robot.observer = lambda each: each.now() > 0.5 and os.kill(os.getpid(), signal.SIGTERM)
        with pytest.raises(StoppedError):
            commissioned(robot, tmp_path / "a.json", steps=step)
        robot.observer = None
        assert robot.fault == "stopped:0"
    assert "stopped by SIGTERM" in json.loads((tmp_path / "a.json").read_text())["steps"][0]["reason"]
