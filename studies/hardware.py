"""Study of the firmware and the closed loop on the emulated robot, with limits for each figure."""

from __future__ import annotations

import dataclasses
import importlib.util
import re
import subprocess
import tempfile
import time as clock
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from knode_cosserat import controls
from knode_cosserat.control import (
    Controller,
    ControlLimits,
    LoopLog,
    circle,
    controller_named,
    figure_eight,
    run_loop,
)
from knode_cosserat.control.commands import identified_lag
from knode_cosserat.estimation.outputs import TipPosition
from knode_cosserat.rods.robot_file import load_robot
from knode_cosserat.rods.tendons import LoadCells
from knode_cosserat_hardware.driver import DriverState, HardwareError, Limits
from knode_cosserat_hardware.emulation import (
    ROBOT,
    EmulatedPort,
    EmulatedRobot,
    built,
    firmware_folder,
    missing,
)
from knode_cosserat_hardware.lines import GRAM_FORCE
from knode_cosserat_hardware.plant import HardwarePlant
from knode_cosserat_hardware.serial_board import SerialBoard
from studies.report import Report, check_row, checks_table, write_report
from studies.runner import Job, Product, run
from studies.stand_in import DAMPING, NOISE, OFFSETS

#: period of the loop (s), and its tension limits (N, N/s)
DT, LOW, HIGH, RATE = 0.05, 0.5, 12.0, 40.0
#: limits of the driver: wider than those of the controller
DRIVER = Limits(0.0, 15.0, 1e4, 60.0)
#: part of the host's bits that the cable flips in the closed loop
BIT_ERRORS = 1e-5


def true_robot() -> Any:
    """Return the rod of the emulated robot in the closed loop."""
    rod: Any = load_robot(ROBOT)
    return rod.replace(bending_damping=DAMPING)


class Cable:
    """Cable that flips bits of the host's lines at random: the part `BIT_ERRORS`, or more in a burst."""

    def __init__(self, random: np.random.Generator, clock: Callable[[], float] = lambda: 0.0):
        self._random, self._clock = random, clock
        self._burst, self._end = 0.0, -np.inf

    def begin_burst(self, rate: float, seconds: float) -> None:
        """Flip another part of the bits for some time (s)."""
        self._burst, self._end = rate, self._clock() + seconds

    def __call__(self, data: bytes) -> bytes:
        """Return damaged bytes."""
        rate = self._burst if self._clock() < self._end else BIT_ERRORS
        flips = self._random.random((len(data), 8)) < rate
        masks = (flips * (1 << np.arange(8))).sum(axis=1)
        return bytes(byte ^ int(mask) for byte, mask in zip(data, masks, strict=True))


def loop_controller(lag: float) -> Controller:
    """Return the predictive controller of the closed loop, for tensions with a time constant (s)."""
    model = true_robot().replace(load_cells=LoadCells(gain=np.ones(4), offset=np.zeros(4)))
    limits = ControlLimits(LOW, HIGH, RATE, lag=lag)
    return controller_named("predictive", model, DT, limits, [OFFSETS], TipPosition(sigma=5e-4))


def connected(robot: EmulatedRobot, damage: Any = None) -> SerialBoard:
    """Return a tared board in front of an emulated robot."""
    board = SerialBoard(EmulatedPort(robot, damage), DRIVER, measured_high=40.0)
    board.connect()
    board.reset()
    board.tare()
    return board


def tensions(board: SerialBoard, robot: EmulatedRobot, grams: Any, seconds: float) -> Float[Any, "T c"]:
    """Return true tensions (gf) in steps of 1/256 s after a command (gf)."""
    board.command(np.asarray(grams, dtype=float) * GRAM_FORCE)
    rows = []
    for _ in range(round(256 * seconds)):
        board.wait(1.0 / 256.0)
        rows.append(robot.tension / GRAM_FORCE)
    return np.array(rows)


def measured_lag(board: SerialBoard) -> float:
    """Return the time constant (s) of the tensions, from random steps of 0.4 s."""
    commands = controls.random(150, low=1.0, high=6.0, seed=5, hold=8)
    board.arm()
    commanded, measured = [], []
    for command in commands:
        commanded.append(board.command(command))
        board.wait(DT)
        measured.append(board.read().tension)
    board.disarm()
    return identified_lag(np.array(commanded[8:]), np.array(measured[8:]), DT, measured[7])


def measured_tip(robot: EmulatedRobot, random: np.random.Generator) -> tuple[float, Float[Any, "3"]]:
    """Return the time (s) and the tip's position (m) with the noise of motion capture."""
    return robot.time, robot.tip() + NOISE * random.normal(size=3)


#: faults of robot, board and host
KINDS = (
    "sensor-rail",
    "sensor-stuck",
    "over-tension",
    "watchdog",
    "stopped",
    "restarted",
    "emergency-stop",
)
#: burst of bit errors: its duration (s), and bounds of the part of flipped bits. With the least, half of the
#: lines come through, and the loop goes on; with the greatest none, and the watchdog latches
BURST, BURST_RATES = 0.4, (2e-3, 2e-2)
NOISE_BURST = "line-noise"
#: faults of the host: they happen between two periods
HOST = ("watchdog", "stopped")
#: time after a fault within which no motor may reel in any more (s): conversions, three readings, one line
REACTION = {
    "emergency-stop": 2 / 256,
    "sensor-rail": 6 / 256,
    "over-tension": 6 / 256,
    "restarted": 2 / 256,
    "stopped": 4 / 256,
    "watchdog": 0.1,
}
#: over-tension limit of the board (N), and the time after a fault in which it releases tendons (s): 0.5 s,
#: which begin anew with the driver's stop in the next period
BOARD_LIMIT, RELEASE = 2300 * GRAM_FORCE, 0.5 + 2 * DT
#: times of faults after the begin of the loop (s), and the longest time until one is caught
EARLIEST, LATEST, CAUGHT = 2.0, 4.0, 3.0
#: tip RMSE in the last 0.5 s before a fault from which on the loop does not follow (% of length): the
#: circle's radius is 16 %, and loops without an earlier fault have up to 1.5 %
RESUMED = 4.0


def inject(robot: EmulatedRobot, board: SerialBoard, kind: str, tendon: int, random: Any) -> None:
    """Cause a fault."""
    if kind == "sensor-rail":
        robot.cells.stuck[tendon] = random.choice([0.0, 5.0])
    elif kind == "sensor-stuck":
        robot.cells.freeze(tendon)
    elif kind == "over-tension":
        robot.cells.offset[tendon] += 3.2
    elif kind == "watchdog":
        robot.advance(0.15)
    elif kind == "stopped":
        board.stop()
    elif kind == "emergency-stop":
        robot.switch = random.choice(["pressed", "broken"])
    else:
        robot.chip.reset()


def mend(robot: EmulatedRobot) -> None:
    """Remove the cause of a fault, but for an offset of a load cell."""
    robot.cells.stuck[:] = np.nan
    robot.switch = "released"


def recover(board: SerialBoard) -> None:
    """Reset a board and tare it, as a person would. Raises `HardwareError` if it does not work again."""
    board.reset()
    if board.fault:
        board.reset()
    board.tare()


class WatchedRobot(EmulatedRobot):
    """Emulated robot that causes a planned fault at its time, and is watched after each step (1/512 s)."""

    def __init__(self, **parameters: Any):
        super().__init__(true_robot(), **parameters)
        self.board: SerialBoard | None = None
        #: steps with a tension above the board's limit, and steps in which a motor drove after a fault
        self.above = self.driving = 0
        #: greatest tension (N), and longest time after a fault in which a motor reeled in (s), by kind
        self.highest, self.reaction = 0.0, dict.fromkeys(REACTION, 0.0)
        self.forget()

    def plan(self, time: float, kind: str, fault: Callable[[], None]) -> None:
        """Watch from now on, and cause a fault at a time (s)."""
        self._due, self._kind, self._fault = time, kind, fault

    def forget(self) -> None:
        """Watch no longer."""
        self._due = self._began = self._latched = np.inf
        self._kind, self._fault = "", _nothing

    def cause(self, by_host: bool) -> None:
        """Cause the planned fault if it is due, and one of the host, or not."""
        if self.time < self._due or by_host != (self._kind in HOST):
            return
        fault, self._fault, self._due = self._fault, _nothing, np.inf
        self._began = self.time
        fault()

    def step(self) -> None:
        """Move on by 1/512 s."""
        self.cause(by_host=False)
        super().step()
        if self._kind:
            self._watch()

    def _watch(self) -> None:
        self.highest = max(self.highest, float(np.max(self.tension)))
        self.above += bool(np.max(self.tension) > BOARD_LIMIT)
        if self.board is not None and self.board.fault:
            self._latched = min(self._latched, self.time)
        drives, since = self.chip.drives(), self.time - self._began
        reels_in = max(drives) > 0.0
        allowed = REACTION.get(self._kind, np.inf)
        released = self.time - self._latched > RELEASE
        self.driving += (reels_in and (since > allowed or self.time > self._latched)) or (
            released and any(drives)
        )
        if reels_in and since > 0.0 and self._kind in REACTION:
            self.reaction[self._kind] = max(self.reaction[self._kind], since)


def _nothing() -> None:
    pass


@dataclasses.dataclass
class _Rig:
    """A watched robot behind a bad cable, and the controller of its loop."""

    robot: WatchedRobot
    cable: Cable
    board: SerialBoard
    random: np.random.Generator

    @classmethod
    def new(cls, random: np.random.Generator) -> _Rig:
        robot = WatchedRobot()
        cable = Cable(random, lambda: robot.time)
        board = connected(robot, cable)
        # a board that restarts does not move by itself
        board.set_setting("tare_on_start", 0)
        board.save_settings()
        robot.board = board
        return cls(robot, cable, board, random)

    def cause(self, kind: str, tendon: int) -> None:
        if kind != NOISE_BURST:
            inject(self.robot, self.board, kind, tendon, self.random)
            return
        self.cable.begin_burst(float(np.exp(self.random.uniform(*np.log(BURST_RATES)))), BURST)

    def measured(self) -> tuple[float, Any]:
        """Return what motion capture measures; faults of the host happen here."""
        self.robot.cause(by_host=True)
        return measured_tip(self.robot, self.random)


def loop_faults(settings: Any) -> Product:
    """Inject faults at random times of the closed loop; each must be caught, and the loop go on after it.

    The loop is closed again after each fault, so that the next one shows that it works.
    """
    random = np.random.default_rng(6)
    rig = _Rig.new(random)
    controller = loop_controller(measured_lag(rig.board))
    rigs, trials = [rig], []
    kinds = (*KINDS, NOISE_BURST)
    for k in range(settings["runs"] + 1):
        # the last loop has no fault: it shows that the one before was recovered from
        kind = kinds[k % len(kinds)] if k < settings["runs"] else ""
        trial = _trial(rig, controller, kind)
        trials.append(trial)
        if trial["dead"]:
            rig = _Rig.new(random)
            rigs.append(rig)
    reaction = {kind: max(each.robot.reaction[kind] for each in rigs) for kind in REACTION}
    facts = {
        "missed": sum(each["missed"] for each in trials),
        "dead": sum(bool(each["dead"]) or each["error"] > RESUMED for each in trials),
        "unsafe": sum(each["commands"] for each in trials)
        + sum(each.robot.above + each.robot.driving for each in rigs),
        "highest": max(each.robot.highest for each in rigs),
        "error": max(each["error"] for each in trials), "reaction": reaction, "trials": trials,
    }  # fmt: skip
    return Product(facts, {})


def _trial(rig: _Rig, controller: Controller, kind: str) -> dict[str, Any]:
    """Close the loop, cause a fault, and recover; an empty kind is a loop without a fault."""
    robot, board, offset = rig.robot, rig.board, rig.robot.cells.offset.copy()
    after, tendon = float(rig.random.uniform(EARLIEST, LATEST)), int(rig.random.integers(0, 4))
    plant = HardwarePlant(board, rig.measured, DT)
    robot.plan(robot.time + after, kind or NOISE_BURST, lambda: rig.cause(kind, tendon) if kind else None)
    log: LoopLog | None
    try:
        log = run_loop(controller, plant, circle(0.1, period=4.0), after + CAUGHT)
    except HardwareError as error:
        log = getattr(error, "log", None)
    fault = board.fault
    trial: dict[str, Any] = {"kind": kind, "after": round(after, 3), "fault": fault, "dead": ""}
    allowed = ("", "watchdog:0") if kind == NOISE_BURST else (f"{kind}:0", f"{kind}:{tendon + 1}")
    trial["missed"] = int(fault not in (allowed if kind else ("",)))
    robot.cells.offset[:] = offset
    mend(robot)
    try:
        # still watched: nothing may move before the reset
        board.wait(1.0)
        robot.forget()
        if fault:
            recover(board)
        else:
            board.disarm()
    except HardwareError as error:
        trial["dead"] = str(error)
    trial["commands"] = 0 if log is None else int(np.sum(log.control > HIGH + 0.02))
    trial["error"] = 100.0 * _rmse_before(log, after) / float(robot.robot.length)
    return trial


def _rmse_before(log: LoopLog | None, time: float) -> float:
    """Return the tip's RMSE (m) in the half second before a time (s); a large number without periods."""
    if log is None:
        return 1e9
    apart = log.tip_distance[(log.time > time - 0.5) & (log.time < time)]
    return float(np.sqrt(np.mean(apart**2))) if len(apart) and np.isfinite(apart).all() else 1e9


#: tip RMSE of the PyElastica test robot in the study `control` (% of length), and the allowed multiple of it
STAND_IN, FACTOR = 0.18, 1.5
#: jobs that measure a speed
ALONE = ("repeat", "dds")


def jobs(quick: bool) -> list[Job]:
    """Return the study's jobs."""
    made = [
        Job("build", build, {}),
        Job("fuzz", fuzz, {"frames": 1_000_000}),
        Job("steps", steps, {}),
        Job("watchdog", watchdog, {"runs": 5 if quick else 50}),
        Job("repeat", repeat, {}),
        Job("loop-faults", loop_faults, {"runs": 8 if quick else 40}),
        Job("loop", loop, {"seconds": 60.0 if quick else 600.0}),
    ]
    if importlib.util.find_spec("cyclonedds"):
        made.append(Job("dds", dds, {"messages": 2000}))
    return made


def rerun(out: Path, quick: bool = False, **how: Any) -> Report:
    """Run the study, and write hardware.json and hardware.md; interrupted runs are continued.

    Args:
        out: the folder; an earlier run in it is continued.
        quick: shorter runs.
        how: as `runner.run` has it.

    Raises:
        HardwareError: the tools to build the firmware are missing.
    """
    if reason := missing():
        raise HardwareError(f"the study needs the firmware's tools: {reason}")
    made = checks(facts_of(jobs(quick), out, **how))
    return write_report(out, "hardware", made, as_markdown(made))


def facts_of(jobs: Sequence[Job], out: Path, **how: Any) -> dict[str, dict[str, Any]]:
    """Return the facts of all jobs. Those of `ALONE` run at the end in this process, beside no other job."""
    facts = run([job for job in jobs if job.key not in ALONE], out, **how)
    how |= {"workers": 1, "dask": None}
    return facts | run([job for job in jobs if job.key in ALONE], out, **how)


def checks(facts: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the figures of the study with their limits: check, value, limit, ok."""
    found, fastest, injected = facts["steps"], facts["loop"], facts["loop-faults"]
    listed = [
        ("build of the firmware (s)", facts["build"]["seconds"], 60.0),
        ("flash (bytes)", facts["build"]["flash"], 253_952),
        ("RAM before the stack (bytes)", facts["build"]["ram"], 8192),
        ("unsafe outputs in 1,000,000 fuzzed frames", facts["fuzz"]["unsafe"], 0),
        ("tension steps: time to stay within 5 % (s)", found["settling"], 0.1),
        ("tension steps: overshoot (% of the step)", found["overshoot"], 10.0),
        ("tension left 100 ms after the last line (gf)", facts["watchdog"]["left"], 20.0),
        ("bits that differ between two runs", facts["repeat"]["different"], 0),
        ("closed loop: tip RMSE, worst reference (% of length)", fastest["rmse"], FACTOR * STAND_IN),
        ("closed loop: periods above the tension limit", fastest["unsafe"], 0),
        ("closed loop: faults", fastest["faults"], 0),
        ("faults within the closed loop that were not caught", injected["missed"], 0),
        ("faults within the closed loop that were not recovered from", injected["dead"], 0),
        ("closed loop with faults: unsafe periods", injected["unsafe"], 0),
    ]
    if "dds" in facts:
        listed.append(("DDS on this host: p99 (ms)", facts["dds"]["p99"], 1.0))
    return [check_row(*each) for each in listed] + [
        check_row("control loop on the chip (1/s)", found["rate"], 200.0, least=True),
        check_row("emulation relative to real time", facts["repeat"]["speed"], 3.0, least=True),
    ]


def as_markdown(made: Sequence[Mapping[str, Any]]) -> str:
    """Return the table of the study."""
    said = "Nothing ran on physical hardware."
    return f"# Firmware and closed loop, emulated\n\n{said}\n\n{checks_table(made)}\n"


def build(settings: Any) -> Product:
    """Build the firmware anew; report time and sizes."""
    with tempfile.TemporaryDirectory() as folder:
        began = clock.perf_counter()
        subprocess.run(
            ["make", "-s", "-C", str(firmware_folder()), f"OUT={folder}", "all"],
            check=True,
            capture_output=True,
        )
        seconds = clock.perf_counter() - began
    shown = subprocess.run(
        ["avr-size", "-C", "--mcu=atmega2560", built() / "tension.elf"],
        check=True,
        capture_output=True,
        text=True,
    ).stdout
    flash, ram = (int(each) for each in re.findall(r":\s+(\d+) bytes", shown))
    return Product({"seconds": seconds, "flash": flash, "ram": ram}, {})


def fuzz(settings: Any) -> Product:
    """Send fuzzed frames to the board's logic on this computer."""
    from knode_cosserat_hardware.emulation import HostBoard

    each = settings["frames"] // 10
    unsafe, armed = np.sum([HostBoard().fuzz(seed, each) for seed in range(10)], axis=0).tolist()
    return Product({"unsafe": unsafe, "armed": armed}, {})


def steps(settings: Any) -> Product:
    """Measure the response of all tensions to steps, and the rate of the control loop."""
    robot = EmulatedRobot()
    board = connected(robot)
    board.arm()
    tensions(board, robot, [200.0] * 4, 1.0)
    settling, overshoot, before = 0.0, 0.0, 200.0
    for after in (300.0, 600.0, 1000.0, 800.0, 600.0):
        rows = tensions(board, robot, [after] * 4, 0.6)
        outside = np.flatnonzero(np.any(np.abs(rows - after) > 0.05 * after, axis=1))
        settling = max(settling, (outside[-1] + 1) / 256 if len(outside) else 0.0)
        beyond = np.max((rows - after) * np.sign(after - before))
        overshoot = max(overshoot, 100.0 * float(beyond) / abs(after - before))
        before = after
    slowest = 0.0
    for _ in range(50):
        board.read()
        slowest = max(slowest, board.loop_time)
    rate = 1.0 / slowest
    return Product({"settling": settling, "overshoot": overshoot, "rate": rate}, {})


def watchdog(settings: Any) -> Product:
    """Measure the tension that is left 100 ms after the host's last line, after random tensions."""
    robot, random, left = EmulatedRobot(), np.random.default_rng(1), 0.0
    board = connected(robot)
    for _ in range(settings["runs"]):
        board.arm()
        tensions(board, robot, [random.uniform(100.0, 800.0)] * 4, 0.5)
        board.command(robot.tension)
        robot.advance(0.1)
        left = max(left, float(np.max(robot.tension)) / GRAM_FORCE)
        robot.advance(0.6)
        board.wait(0.05)
        board.reset()
    return Product({"left": left}, {})


def repeat(settings: Any) -> Product:
    """Compare two runs of the same commands bit by bit, and measure the speed of the emulation."""

    def moved() -> tuple[bytes, float]:
        robot = EmulatedRobot(seed=3)
        board = connected(robot)
        board.arm()
        began, start = clock.perf_counter(), robot.time
        rows = [tensions(board, robot, grams, 0.5) for grams in ([300.0] * 4, [400.0, 300.0, 200.0, 300.0])]
        speed = (robot.time - start) / (clock.perf_counter() - began)
        return np.concatenate(rows).tobytes() + robot.tip().tobytes(), speed

    # the first run compiles
    runs = [moved() for _ in range(6)][1:]
    (first, _), (second, _) = runs[:2]
    different = sum(int(a ^ b).bit_count() for a, b in zip(first, second, strict=True))
    return Product({"different": different, "speed": float(np.median([speed for _, speed in runs]))}, {})


def loop(settings: Any) -> Product:
    """Close the whole loop: controller, driver, serial line with bit errors, firmware, motors, rod."""
    random = np.random.default_rng(4)
    robot = EmulatedRobot(true_robot())
    board = connected(robot, Cable(random))
    lag = measured_lag(board)
    controller = loop_controller(lag)
    length = float(robot.robot.length)
    errors, unsafe, failed, missing_rows = {}, 0, 0, 0
    for name, path in {"circle": circle(0.1, period=4.0), "eight": figure_eight(0.1, period=6.0)}.items():
        plant = HardwarePlant(board, lambda: measured_tip(robot, random), DT)
        try:
            log = run_loop(controller, plant, path, settings["seconds"])
        except HardwareError as error:
            failed += 1
            board.wait(0.7)
            board.reset()
            kept = getattr(error, "log", None)
            if kept is None:
                continue
            log = kept
        errors[name] = 100.0 * log.tip_rmse(6.0) / length
        unsafe += int(np.sum(log.control > HIGH + 0.02))
        missing_rows += log.fallbacks
        if board.state is DriverState.ARMED:
            board.disarm()
    worst = max(errors.values(), default=float("inf"))
    facts = {
        "rmse": worst if np.isfinite(worst) else 1e9,
        "errors": errors,
        "lag": lag,
        "unsafe": unsafe,
        "faults": failed,
        "fallbacks": missing_rows,
        "damaged_lines": dict(board.line_counts),
    }
    return Product(facts, {})


def dds(settings: Any) -> Product:
    """Measure the latency of DDS between two processes; with real-time priority where it is allowed."""
    from benchmarks.dds_latency import measure_loopback

    try:
        found = measure_loopback(settings["messages"], real_time=True)
    except HardwareError:
        found = measure_loopback(settings["messages"])
    return Product({"p99": 1e3 * found.p99, "median": 1e3 * found.median, "real_time": found.real_time}, {})
