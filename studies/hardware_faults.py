"""Faults of the emulated robot: at rest under steps of tension, and at random times of the closed loop."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from knode_cosserat.control import Controller, LoopLog, circle, run_loop
from knode_cosserat_hardware.driver import HardwareError
from knode_cosserat_hardware.emulation import EmulatedRobot
from knode_cosserat_hardware.lines import GRAM_FORCE
from knode_cosserat_hardware.plant import HardwarePlant
from knode_cosserat_hardware.serial_board import SerialBoard
from studies.hardware_rig import (
    DT,
    HIGH,
    Cable,
    connected,
    loop_controller,
    measured_lag,
    measured_tip,
    tensions,
    true_robot,
)
from studies.runner import Product

#: faults of robot, board and host
KINDS = (
    *("sensor-rail", "sensor-stuck", "over-tension", "watchdog", "stopped", "restarted"),
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
    "emergency-stop": 2 / 256, "sensor-rail": 6 / 256, "over-tension": 6 / 256, "restarted": 2 / 256,
    "stopped": 4 / 256, "watchdog": 0.1,
}  # fmt: skip
#: over-tension limit of the board (N), and the time after a fault in which it releases tendons (s): 0.5 s,
#: which begin anew with the driver's stop in the next period
BOARD_LIMIT, RELEASE = 2300 * GRAM_FORCE, 0.5 + 2 * DT
#: times of faults after the begin of the loop (s), and the longest time until one is caught
EARLIEST, LATEST, CAUGHT = 2.0, 4.0, 3.0
#: tip RMSE in the last 0.5 s before a fault from which on the loop does not follow (% of length): the
#: circle's radius is 16 %, and loops without an earlier fault have up to 1.5 %
RESUMED = 4.0


def faults(settings: Any) -> Product:
    """Inject faults at random; each must be caught, and the robot work again after it was mended."""
    robot, random = EmulatedRobot(), np.random.default_rng(2)
    board = connected(robot)
    missed: list[str] = []
    dead: list[str] = []
    for k in range(settings["runs"]):
        kind, tendon = KINDS[k % len(KINDS)], int(random.integers(0, 4))
        board.arm()
        tensions(board, robot, random.uniform(150.0, 500.0, 4), 0.4)
        offset = robot.cells.offset.copy()
        inject(robot, board, kind, tendon, random)
        caught = _is_caught(robot, board)
        if not caught or not board.fault.startswith(kind):
            missed.append(f"{kind} ({board.fault or 'none'})")
        robot.cells.offset[:] = offset
        mend(robot)
        board.wait(0.7)
        try:
            recover(board)
        except HardwareError as error:
            dead.append(f"{kind}: {error}")
            robot = EmulatedRobot()
            board = connected(robot)
    return Product({"missed": len(missed), "dead": len(dead), "listed": missed + dead}, {})


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


def _is_caught(robot: EmulatedRobot, board: SerialBoard) -> bool:
    """Return True if the driver refuses commands within 3 s, and no motor reels in afterwards."""
    try:
        for k in range(60):
            board.command(np.full(4, 3.0 + 0.2 * k))
            board.wait(DT)
    except HardwareError:
        robot.advance(0.05)
        return max(robot.chip.drives()) <= 0.0
    return False


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
    plant = HardwarePlant(board, rig.measured, DT, clock=lambda: robot.time)
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
