"""The firmware: its logic on this computer, and the same scripts on the emulated chip."""

import re
import subprocess
from binascii import crc_hqx

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from knode_cosserat_hardware.emulation import missing

if missing():
    pytest.skip(f"the firmware cannot be built here: {missing()}", allow_module_level=True)

from knode_cosserat_hardware.emulation import CLOCK, Chip, HostBoard, built

#: reading of a slack tendon (counts), and counts per gram-force, by the default settings
ZERO, PER_GRAM = 800, 2


def run_on_chip(lines):
    """Return what each line of a script prints on the emulated chip, with its 16-bit integers."""
    chip = Chip(built() / "vectors.elf")
    printed, pending = [], _until_dot(chip, "")[1]
    for line in lines:
        chip.send(line.encode("latin-1") + b"\n")
        found, pending = _until_dot(chip, pending)
        printed.append(found)
    chip.close()
    return printed


def _until_dot(chip, text):
    """Return the chip's output until a line with a dot, and the rest."""
    for _ in range(20_000):
        text += chip.received().decode("latin-1")
        head, dot, rest = ("\n" + text).partition("\n.\n")
        if dot:
            return head[1:] + ("\n" if head[1:] else ""), rest
        chip.run(CLOCK // 1000)
    pytest.fail("the chip does not answer in 20 s")


def counts(*grams: float) -> str:
    return " ".join(str(round(ZERO + PER_GRAM * each)) for each in grams)


def frame(number: int, text: str) -> str:
    body = f"{number} {text}"
    return f"r {body}*{crc_hqx(body.encode(), 0xFFFF):04X}"


REST = f"t 3 {counts(0, 0, 0, 0)}"
ARMED = ["s", "r reset", "r hello 2", frame(1, "arm")]


class Session:
    """A board on this computer with its numbered lines."""

    def __init__(self, framed: bool = True) -> None:
        self.board, self.number = HostBoard(), 0
        for line in ["s", "r reset"] + (["r hello 2"] if framed else []):
            self.board.run(line)

    def say(self, text: str) -> str:
        self.number = (self.number + 1) % 65536
        return self.board.run(frame(self.number, text))

    def tick(self, ticks: int, *grams: float) -> list[str]:
        """Return state, fault, drives and tensions after some ticks; the host keeps the board alive."""
        line = ""
        for k in range(ticks):
            if k % 8 == 0:
                self.say("keep")
            line = self.board.run(f"t 1 {counts(*grams)}").splitlines()[-1]
        return line.split()


def test_the_checksum_is_the_standard_one() -> None:
    assert crc_hqx(b"123456789", 0xFFFF) == 0x29B1
    assert "= arm" in Session().say("arm")


def test_host_and_chip_do_the_same() -> None:
    random = np.random.default_rng(3)
    lines = [*ARMED, frame(2, "tension 100 200 300 2300")]
    for k in range(60):
        readings = np.clip(ZERO + random.integers(-100, 4600, 4), 20, 8160)
        lines += [f"t {random.integers(1, 9)} {' '.join(map(str, readings))}", frame(3 + k, "keep")]
    lines += [
        frame(100, "set gain1 32000"),
        frame(101, "set kp 4000"),
        frame(102, "get zero3"),
        "r stop",
        REST,
    ]
    # PID at the ends of its range, where 16-bit products would wrap
    extremes = [0, 1, -1, 8 * 2300, 8 * 3500, 32000, -32000, 16000, -16000]
    lines += ["s", "r reset", *(f"p {a} {b}" for a in (0, 8 * 2300) for b in extremes), "r hello 2"]
    # sequence numbers wrap
    lines += [frame(n, "keep") for n in (40000, 65535, 0, 1, 65535, 32769, 1, 2)]
    lines += ["o 1", REST, frame(3, "reset"), "o 0", frame(4, "reset"), REST]
    lines += [f"t 2 {counts(2400, 0, 0, 0)}", f"t 3 {counts(2400, 0, 0, 0)}", f"t 200 {counts(0, 0, 0, 0)}"]
    host = HostBoard()
    assert [host.run(line) for line in lines] == run_on_chip(lines)


@settings(max_examples=5, deadline=None)
@given(st.lists(st.binary(max_size=70).map(lambda b: b.replace(b"\n", b"")), min_size=1, max_size=30))
def test_host_and_chip_answer_any_bytes_alike(noise: list[bytes]) -> None:
    lines = ["s", "r hello 2", *(f"r {each.decode('latin-1')}".split("\0")[0] for each in noise), REST]
    host = HostBoard()
    assert [host.run(line) for line in lines] == run_on_chip(lines)


def test_fuzzed_frames_never_move_a_motor_wrongly() -> None:
    for seed in range(3):
        unsafe, armed = HostBoard().fuzz(seed, 100_000)
        assert unsafe == 0
        assert armed > 1000, "the fuzzer must reach the armed state"


@pytest.mark.parametrize(
    ("line", "answer"),
    [
        ("r 1 arm*0000", "0 ! checksum"), ("r 1 arm", "0 ! frame"), ("r arm*A1B2", "0 ! checksum"),
        (frame(70000, "arm"), "! frame"), (frame(5, "dance"), "5 ! verb"),
        (frame(5, "tension 1 2 3"), "5 ! arguments"), (frame(5, "tension 1 2 3 -4"), "5 ! range"),
        (frame(5, "tension 1 2 3 2301"), "5 ! range"), (frame(5, "tension 1 2 3 99999999"), "5 ! arguments"),
        (frame(5, "tension 1 2 3 4"), "5 ! state"), (frame(5, "set kp 9999"), "5 ! range"),
        (frame(5, "set nothing 1"), "5 ! name"), (frame(5, "drive 1 200"), "5 ! range"),
        (frame(5, "disarm"), "5 ! state"), ("r " + 70 * "x", "0 ! long"), ("r \x01", "0 ! frame"),
    ],
)  # fmt: skip
def test_malformed_lines_change_nothing_and_are_answered(line: str, answer: str) -> None:
    session = Session()
    before = session.tick(1, 0, 0, 0, 0)
    assert answer in session.board.run(line)
    assert session.board.run(f"t 1 {counts(0, 0, 0, 0)}").split()[-10:] == before[-10:]


def test_old_lines_are_refused() -> None:
    board = HostBoard()
    for line in ["s", "r reset", "r hello 2"]:
        board.run(line)
    assert board.run(frame(65535, "keep")) == ""
    assert board.run(frame(0, "keep")) == "", "numbers wrap"
    assert "order" in board.run(frame(65535, "keep"))
    assert "order" in board.run(frame(0, "arm"))
    assert "= arm" in board.run(frame(1, "arm"))


def test_an_old_host_still_works() -> None:
    session = Session(framed=False)
    board = session.board
    assert board.run("r 100 100 100 100") == ""
    found = board.run(f"t 6 {counts(50, 50, 50, 50)}").splitlines()
    assert found[-1].startswith("armed -")
    assert re.fullmatch(r">(\d+,){4}(-?\d+,){4}4", found[0])
    assert "! arguments" in board.run("r 1 2 3") and "! range" in board.run("r 1 2 3 9000")
    # half a second of silence stops the motors; the next command goes on
    assert board.run(f"t 140 {counts(100, 100, 100, 100)}").splitlines()[-1].startswith("releasing -")
    assert board.run(f"t 140 {counts(0, 0, 0, 0)}").splitlines()[-1].startswith("ready -")
    board.run("r 100 100 100 100")
    assert board.run(f"t 1 {counts(0, 0, 0, 0)}").splitlines()[-1].startswith("armed -")


def test_every_fault_releases_and_latches() -> None:
    def armed(*wanted: int) -> Session:
        session = Session()
        session.say("arm")
        session.say("tension " + " ".join(map(str, wanted)))
        return session

    def checked(session: Session, name: str, last: list[str]) -> None:
        assert last[1] == name and last[0] in ("releasing", "fault")
        assert max(map(int, last[2:6])) <= 0, "nothing reels in"
        assert session.tick(200, 0, 0, 0, 0)[:6] == ["fault", name, "0", "0", "0", "0"]
        assert "! state" in session.say("arm"), "latched"
        assert "= reset" in session.say("reset")
        assert session.tick(1, 0, 0, 0, 0)[:2] == ["ready", "-"]

    session = armed(100, 100, 100, 100)
    checked(session, "over-tension", session.tick(3, 2400, 100, 100, 100))
    session = armed(100, 100, 100, 100)
    last = session.board.run(f"t 20 {counts(90, 90, 90, 90)}").splitlines()[-1].split()
    checked(session, "watchdog", last)
    for rail in (-ZERO / PER_GRAM, 3692):
        session = armed(100, 100, 100, 100)
        # the first reading is halfway
        session.tick(1, 100, 0.5 * (100 + rail), 100, 100)
        last = session.tick(3, 100, rail, 100, 100)
        assert last[1] == "sensor-rail"
        assert max(map(int, last[2:6])) <= 0
    session = armed(1000, 0, 0, 0)
    checked(session, "sensor-stuck", session.tick(200, 300, 0, 0, 0))
    session = armed(1000, 0, 0, 0)
    checked(session, "slack", session.tick(300, 0, 0, 0, 0))
    session = armed(10, 10, 10, 10)
    session.say("stop")
    checked(session, "stopped", session.tick(1, 0, 0, 0, 0))
    session = Session()
    session.say("tare")
    checked(session, "tare-timeout", session.tick(1400, 0, 0, 0, 0))
    board = HostBoard()
    assert "! fault settings:0" in board.run("s")


@pytest.mark.parametrize("state", ["ready", "armed", "taring", "releasing", "boot"])
@pytest.mark.parametrize("framed", [True, False])
def test_the_emergency_stop_stops_within_one_tick_and_latches(state: str, framed: bool) -> None:
    session = Session(framed)
    board = session.board

    def told(text: str) -> str:
        return session.say(text) if framed else board.run(f"r {text}")

    if state == "taring" and not framed:
        pytest.skip("plain boards tare at their start only")
    if state in ("armed", "releasing"):
        if framed:
            session.say("arm")
        told("tension 500 500 500 500" if framed else "500 500 500 500")
        assert int(board.run(f"t 9 {counts(50, 50, 50, 50)}").split()[-8]) > 0, "a motor drives"
    if state == "releasing":
        told("disarm" if framed else "hello 1")
    if state == "taring":
        session.say("tare")
        board.run(f"t 9 {counts(0, 0, 0, 0)}")
    if state == "boot":
        told("save" if framed else "hello 2")
        if not framed:
            session.say("save")
    board.run("o 1")
    found = board.run("s") if state == "boot" else board.run(f"t 1 {counts(50, 50, 50, 50)}")
    assert "! fault emergency-stop:0" in found
    for wait in (1, 200):
        last = board.run(f"t {wait} {counts(50, 50, 50, 50)}").splitlines()[-1].split()
        assert last[:6] == ["fault", "emergency-stop", "0", "0", "0", "0"]
    if state == "boot" and framed:
        board.run("r hello 2")
    assert "! emergency-stop" in told("reset"), "latched while the contact is open"
    board.run("o 0")
    last = board.run(f"t 200 {counts(50, 50, 50, 50)}").splitlines()[-1].split()
    assert last[:6] == ["fault", "emergency-stop", "0", "0", "0", "0"], "closing is no reset"
    assert "! " not in told("reset")
    assert board.run(f"t 1 {counts(0, 0, 0, 0)}").splitlines()[-1].startswith("ready -")


def test_the_emergency_stop_ends_the_release_of_another_fault() -> None:
    session = Session()
    session.say("arm")
    assert int(session.tick(3, 2400, 100, 100, 100)[2]) < 0, "reels out"
    session.board.run("o 1")
    assert session.tick(1, 2000, 100, 100, 100)[:6] == ["fault", "over-tension", "0", "0", "0", "0"]
    assert "! emergency-stop" in session.say("reset")
    session.board.run("o 0")
    assert "= reset" in session.say("reset")


def test_a_board_without_an_emergency_stop_is_usable_after_a_setting() -> None:
    session = Session()
    session.board.run("o 1")
    assert session.tick(1, 0, 0, 0, 0)[1] == "emergency-stop", "on by default"
    assert "= set estop 0" in session.say("set estop 0") and "= reset" in session.say("reset")
    session.say("set tare_on_start 0")
    session.say("save")
    assert "fault" not in session.board.run("s")
    # the paper's host: plain lines only
    assert session.board.run("r 100 100 100 100") == ""
    assert session.board.run(f"t 1 {counts(0, 0, 0, 0)}").splitlines()[-1].startswith("armed -")
    session.board.run("r hello 2")
    session.number = 0
    session.tick(200, 0, 0, 0, 0)
    session.say("defaults")
    assert session.tick(1, 0, 0, 0, 0)[:2] == ["fault", "emergency-stop"], "default settings watch it"


def test_settings_survive_a_restart_and_damage_is_noticed() -> None:
    session = Session()
    session.say("set limit 1500")
    session.say("set tare_on_start 0")
    assert "= save" in session.say("save")
    started = session.board.run("s")
    assert "fault" not in started
    assert "! range" in session.board.run("r 1600 0 0 0")
    session.board.run("r hello 2")
    assert "get limit 1500" in session.board.run(frame(1, "get limit"))


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2300), st.integers(-300, 3300))
def test_the_drive_has_the_sign_of_the_error(wanted: int, measured: int) -> None:
    board = HostBoard()
    for line in ["s", "r reset"]:
        board.run(line)
    pair = f"{8 * wanted} {8 * measured} "
    drive = int(board.run("p " + pair * 5).split()[-1])
    assert -255 <= drive <= 255
    if abs(wanted - measured) > 300 + wanted:
        assert np.sign(drive) == np.sign(wanted - measured)


def test_the_board_has_room() -> None:
    command = ["avr-size", "-C", "--mcu=atmega2560", str(built() / "tension.elf")]
    shown = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    flash, ram = (int(each) for each in re.findall(r":\s+(\d+) bytes", shown))
    assert flash < 65536 and ram < 4096
