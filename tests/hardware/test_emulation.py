"""The emulated robot: the real firmware in simavr, driven through the package's own serial driver."""

from collections.abc import Iterator

import numpy as np
import pytest

import knode_cosserat as kc
import knode_cosserat_hardware.emulation as emulated
from knode_cosserat_hardware.driver import DriverState, HardwareError, Limits
from knode_cosserat_hardware.emulation import EmulatedPort, EmulatedRobot, PseudoTerminal, Switch, missing
from knode_cosserat_hardware.lines import GRAM_FORCE
from knode_cosserat_hardware.serial_board import SerialBoard

pytestmark = pytest.mark.slow

if missing():
    pytest.skip(f"the firmware cannot be built here: {missing()}", allow_module_level=True)

LIMITS = Limits(0.0, 15.0, 1e4, 60.0)


def board_of(robot: EmulatedRobot) -> SerialBoard:
    # the board's own limit is tried, not the driver's
    board = SerialBoard(EmulatedPort(robot), LIMITS, measured_high=40.0)
    board.connect()
    if board.fault:
        board.reset()
        board.tare()
    return board


@pytest.fixture
def robot() -> Iterator[EmulatedRobot]:
    """Return a robot at rest; its program is compiled once."""
    made = EmulatedRobot()
    yield made
    made.chip.close()


def tensions(board: SerialBoard, robot: EmulatedRobot, grams: list[float], seconds: float) -> np.ndarray:
    """Return the true tensions (gf) in steps of 1/256 s after a command."""
    board.command(np.array(grams) * GRAM_FORCE)
    rows = []
    for _ in range(round(256 * seconds)):
        board.wait(1 / 256)
        rows.append(robot.tension / GRAM_FORCE)
    return np.array(rows)


def pull(board: SerialBoard) -> None:
    """Pull harder and harder for 3 s."""
    for k in range(60):
        board.command(np.full(4, 3.0 + 0.2 * k))
        board.wait(0.05)


def test_tension_steps_settle(robot: EmulatedRobot) -> None:
    with board_of(robot) as board:
        board.arm()
        tensions(board, robot, [200.0] * 4, 1.0)
        for before, after in ((200.0, 300.0), (300.0, 600.0), (600.0, 1000.0)):
            rows = tensions(board, robot, [after] * 4, 0.5)
            late = np.flatnonzero(np.any(np.abs(rows - after) > 0.05 * after, axis=1))
            assert len(late) == 0 or (late[-1] + 1) / 256 <= 0.1
            assert np.max(rows) - after <= 0.1 * (after - before) + 15.0
        reading = board.read()
        assert reading.tension == pytest.approx(robot.tension, abs=0.2)
        assert board.state is DriverState.ARMED and not board.line_counts["lost telemetry"]


def test_the_watchdog_slackens_the_tendons(robot: EmulatedRobot) -> None:
    with board_of(robot) as board:
        board.arm()
        tensions(board, robot, [500.0] * 4, 0.5)
        board.command(np.full(4, 5.0))
        robot.advance(0.1)
        assert np.all(robot.tension < 20 * GRAM_FORCE), "slack 100 ms after the last line"
        robot.advance(0.6)
        board.wait(0.05)
        assert board.read().fault == "watchdog:0"
        with pytest.raises(HardwareError, match="watchdog"):
            board.command(np.full(4, 1.0))
        board.reset()
        board.arm()
        assert board.state is DriverState.ARMED


@pytest.mark.parametrize("fault", ["torn tendon", "stuck cell", "rail", "over-tension", "power"])
def test_faults_of_the_robot_are_caught(robot: EmulatedRobot, fault: str) -> None:
    names = {
        "torn tendon": "slack:2",
        "stuck cell": "sensor-stuck:2",
        "rail": "sensor-rail:2",
        "over-tension": "over-tension:2",
        "power": "restarted:0",
    }
    board = board_of(robot)
    board.arm()
    tensions(board, robot, [300.0] * 4, 0.4)
    if fault == "torn tendon":
        robot.torn[1] = True
    elif fault == "stuck cell":
        robot.cells.freeze(1)
    elif fault == "rail":
        robot.cells.stuck[1] = 0.0
    elif fault == "over-tension":
        robot.cells.offset[1] += 3.0
    else:
        robot.chip.reset()
    with pytest.raises(HardwareError):
        pull(board)
    assert board.fault == names[fault]
    robot.advance(0.7)
    assert robot.chip.drives() == [0.0] * 4
    if fault != "power":
        # without power the gears hold
        assert np.all(robot.tension < 0.5)
    board.close()


@pytest.mark.parametrize("switch", ["pressed", "broken"])
def test_the_emergency_stop_stops_the_motors(robot: EmulatedRobot, switch: Switch) -> None:
    board = board_of(robot)
    board.arm()
    tensions(board, robot, [400.0] * 4, 0.4)
    board.command(np.full(4, 8.0))
    robot.advance(1 / 64)
    assert max(robot.chip.drives()) > 0.1, "the motors drive"
    robot.switch = switch
    # one tick, and the conversions before it
    robot.advance(2 / 256)
    assert robot.chip.drives() == [0.0] * 4
    for _ in range(100):
        robot.step()
        assert robot.chip.drives() == [0.0] * 4, "nothing reels out by itself"
    with pytest.raises(HardwareError, match="emergency stop"):
        pull(board)
    assert board.fault == "emergency-stop:0"
    with pytest.raises(HardwareError, match="release the emergency stop first"):
        board.reset()
    robot.switch = "released"
    board.wait(0.5)
    assert board.fault == "emergency-stop:0" and robot.chip.drives() == [0.0] * 4
    board.reset()
    # disarmed; and the paper's plain lines
    robot.switch = switch
    board.wait(0.05)
    assert board.fault == "emergency-stop:0"
    with pytest.raises(HardwareError, match="emergency stop"):
        board.arm()
    robot.switch = "released"
    board.reset()
    board.arm()
    tensions(board, robot, [200.0] * 4, 0.3)
    assert np.min(robot.tension) > 100 * GRAM_FORCE, "works again"
    board.close()


def test_an_emergency_stop_at_the_start_and_a_board_without_one(robot: EmulatedRobot) -> None:
    board = board_of(robot)
    board.save_settings()
    board.close()
    robot.switch = "broken"
    plain = SerialBoard(EmulatedPort(robot), LIMITS, protocol=1)
    plain.connect()
    with pytest.raises(HardwareError, match="emergency stop"):
        plain.arm()
    with pytest.raises(HardwareError, match="emergency stop"):
        plain.reset()
    assert plain.fault == "emergency-stop:0"
    plain.close()
    board = SerialBoard(EmulatedPort(robot), LIMITS)
    board.connect()
    assert board.fault == "emergency-stop:0" and robot.chip.drives() == [0.0] * 4, "no tare"
    board.set_setting("estop", 0)
    board.reset()
    board.set_setting("tare_on_start", 0)
    board.save_settings()
    board.close()
    plain = SerialBoard(EmulatedPort(robot), LIMITS, protocol=1)
    plain.connect()
    plain.arm()
    tensions(plain, robot, [200.0] * 4, 0.3)
    assert np.min(robot.tension) > 100 * GRAM_FORCE
    plain.close()
    with pytest.raises(HardwareError, match="released, pressed, broken"):
        robot.switch = "on"  # type: ignore[assignment]


def test_a_bad_cable_neither_moves_wrongly_nor_stops_the_loop(robot: EmulatedRobot) -> None:
    random = np.random.default_rng(0)

    def damage(data: bytes) -> bytes:
        changed = bytearray(data)
        for k in range(len(changed)):
            if random.uniform() < 2e-3:
                changed[k] ^= 1 << random.integers(0, 8)
        return bytes(changed)

    board = board_of(robot)
    board.close()
    board = SerialBoard(EmulatedPort(robot, damage), LIMITS)
    board.connect()
    board.reset()
    board.arm()
    worst = 0.0
    for _ in range(60):
        if board.state is not DriverState.ARMED:
            board.reset()
            board.arm()
        board.command(np.full(4, 3.0))
        board.wait(0.05)
        worst = max(worst, float(np.max(robot.tension)))
    assert worst < 5.0
    assert sum(board.line_counts.values()) > 0
    board.close()


def test_two_runs_are_the_same_bits() -> None:
    def run() -> tuple[bytes, bytes]:
        robot = EmulatedRobot(seed=7)
        with board_of(robot) as board:
            board.arm()
            rows = tensions(board, robot, [300.0, 200.0, 100.0, 200.0], 0.5)
        return rows.tobytes(), robot.tip().tobytes()

    assert run() == run()


def test_the_step_of_the_rod_does_not_matter(monkeypatch: pytest.MonkeyPatch) -> None:
    tips = []
    for count in (4, 2):
        monkeypatch.setattr(emulated, "ROD_STEPS", count)
        robot = EmulatedRobot()
        with board_of(robot) as board:
            board.arm()
            tensions(board, robot, [200.0] * 4, 0.5)
            rows = tensions(board, robot, [400.0, 200.0, 100.0, 200.0], 1.0)
        tips.append(robot.tip())
        assert np.std(rows[-64:, 1]) < 5.0, "no oscillation by the coupling"
    assert np.linalg.norm(tips[0] - tips[1]) < 0.02 * float(robot.robot.length)


def test_settings_and_zeros_survive_a_restart(robot: EmulatedRobot) -> None:
    board = board_of(robot)
    zero = board.setting("zero1")
    assert abs(zero - 818) < 12, "0.5 V are 818 counts"
    board.set_setting("tare_on_start", 0)
    board.save_settings()
    board.close()
    board = SerialBoard(EmulatedPort(robot), LIMITS)
    board.connect()
    assert board.state is DriverState.READY and not board.fault
    assert board.setting("zero1") == zero
    # damaged EEPROM
    board.close()
    robot.chip.set_eeprom(b"\x55" * 20)
    board = SerialBoard(EmulatedPort(robot), LIMITS)
    board.connect()
    assert board.fault == "settings:0"
    board.close()


def test_a_pseudo_terminal_is_a_serial_port(robot: EmulatedRobot) -> None:
    pytest.importorskip("serial")
    with PseudoTerminal(robot) as terminal, SerialBoard(terminal.path, LIMITS) as board:
        board.reset()
        board.set_setting("tare_on_start", 0)
        board.save_settings()
        assert board.setting("tare_on_start") == 0
        assert board.read().tension.shape == (4,)
    assert terminal.error is None


def test_other_robots_are_refused() -> None:
    with pytest.raises(HardwareError, match="routed tendon robot with 4 tendons"):
        EmulatedRobot(kc.load_robot("soft-slender-robot"))  # type: ignore[arg-type]
