"""Checks of a robot's commissioning: what a person confirms and what is measured."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float

from knode_cosserat_hardware.driver import Driver, DriverState, HardwareError
from knode_cosserat_hardware.lines import GRAM_FORCE

#: noise (N) and offset (N) of a load cell from which a check fails
NOISE, OFFSET = 0.1, 0.5
#: drive of a jog, and most jogs until a tendon is taut
DRIVE, JOGS = 0.2, 15
#: rise of a tension that shows a motor's direction (N)
RISE = 0.15
#: tension of tests (N); part of it and force (N) by which a measured tension may differ
TEST, RELATIVE, ABSOLUTE = 2.0, 0.1, 0.3
#: silence after which a watchdog must have acted (s), and median latency that passes (s)
SILENCE, LATENCY = 1.0, 0.06


@dataclasses.dataclass(frozen=True)
class Machine:
    """Connected robot, and time on its clock.

    Attributes:
        driver: the driver.
        silence: passes a time (s) without a sign of life to the robot.
    """

    driver: Driver
    silence: Callable[[float], Any]

    def wait(self, seconds: float) -> None:
        """Wait (s), with the robot's watchdog fed."""
        wait = getattr(self.driver, "wait", None)
        if wait is not None:
            wait(seconds)
            return
        end = time.monotonic() + seconds
        while (rest := end - time.monotonic()) > 0.0:
            self.driver.read()
            time.sleep(min(0.02, rest))

    def tensions(self, count: int = 20) -> Float[np.ndarray, "count c"]:
        """Return the measured tensions of some readings (N)."""
        return np.array([self.driver.read().tension for _ in range(count)])

    def hold(self, tension: Float[np.ndarray, " c"], seconds: float) -> None:
        """Command tensions (N) for a time (s)."""
        for _ in range(max(1, round(seconds / 0.02))):
            self.driver.command(tension)
            self.wait(0.02)


class CheckError(HardwareError):
    """A check of the commissioning failed; `values` has what was measured."""

    code = "check"

    def __init__(self, message: str, values: dict[str, Any] | None = None):
        super().__init__(message)
        self.values = values or {}


@dataclasses.dataclass(frozen=True)
class CheckStep:
    """One check.

    Attributes:
        name: short name.
        text: what a person confirms, or what is measured.
        motion: what moves; empty if nothing does.
        measure: returns measured values; None: a person confirms. Raises `CheckError` if the check failed,
            `NotImplementedError` if the robot cannot be checked.
    """

    name: str
    text: str
    motion: str = ""
    measure: Callable[[Machine], dict[str, Any]] | None = None


def measure_noise(machine: Machine) -> dict[str, Any]:
    """Measure offset and noise of each load cell at rest (N)."""
    tension = machine.tensions(100)
    offset, noise = tension.mean(axis=0), tension.std(axis=0)
    values = {"offset": _rounded(offset), "noise": _rounded(noise), "unit": "N"}
    for name, found, limit in (("noise", noise, NOISE), ("offset", np.abs(offset), OFFSET)):
        if np.max(found) > limit:
            raise CheckError(
                f"load cell {int(np.argmax(found)) + 1} has {np.max(found):.3g} N of {name} "
                f"(allowed: {limit:g} N); check shield and supply, then tare",
                values,
            )
    return values


def measure_directions(machine: Machine) -> dict[str, Any]:
    """Reel in with each motor until its load cell reacts, and reel out again."""
    values: dict[str, Any] = {"rise": [], "jogs": [], "unit": "N"}
    driver = machine.driver
    for tendon in range(driver.tendon_count):
        before = machine.tensions(10).mean(axis=0)
        count = 0
        while count < JOGS:
            count += 1
            driver.jog(tendon, DRIVE)
            machine.wait(0.25)
            rise = machine.tensions(5).mean(axis=0) - before
            if np.max(np.abs(rise)) > RISE:
                break
        for _ in range(count):
            driver.jog(tendon, -DRIVE)
            machine.wait(0.25)
        values["rise"].append(round(float(rise[tendon]), 3))
        values["jogs"].append(count)
        strongest = int(np.argmax(np.abs(rise)))
        if abs(rise[strongest]) <= RISE:
            raise CheckError(f"motor {tendon + 1} changes no load cell; check its cable and tendon", values)
        if strongest != tendon:
            raise CheckError(
                f"motor {tendon + 1} changes load cell {strongest + 1}; exchange the cables of motors or "
                "cells",
                values,
            )
        if rise[tendon] < 0.0:
            raise CheckError(f"motor {tendon + 1} reels out instead of in; exchange its two wires", values)
    return values


def measure_stop(machine: Machine) -> dict[str, Any]:
    """Stop the armed robot; it must have the fault `stopped`, and release."""
    driver = machine.driver
    driver.arm()
    machine.hold(np.full(driver.tendon_count, _test(driver) / 2.0), 0.5)
    driver.stop()
    machine.wait(1.0)
    reading = driver.read()
    values = {"fault": reading.fault, "tension": _rounded(reading.tension), "unit": "N"}
    if reading.state is not DriverState.FAULT:
        raise CheckError(f"after stop the robot is {reading.state.value}; it must have a fault", values)
    if np.max(reading.tension) > _test(driver) / 2.0:
        raise CheckError(
            "after stop a tendon is still tensioned; check that motors can be turned back", values
        )
    driver.reset()
    return values


def measure_watchdog(machine: Machine) -> dict[str, Any]:
    """Send nothing to the armed robot for a second; it must stop by itself."""
    driver = machine.driver
    driver.arm()
    machine.hold(np.full(driver.tendon_count, _test(driver) / 2.0), 0.5)
    machine.silence(SILENCE)
    # readings from before the silence may still wait
    machine.wait(0.1)
    reading = driver.read()
    values = {"state": reading.state.value, "fault": reading.fault, "silence": SILENCE, "unit": "s"}
    if reading.state is DriverState.ARMED:
        raise CheckError(
            f"the robot is still armed after {SILENCE:g} s without its host; do not use it", values
        )
    driver.reset()
    return values


def measure_tracking(machine: Machine) -> dict[str, Any]:
    """Tension each tendon in turn; the measured tension must follow."""
    driver, test = machine.driver, _test(machine.driver)
    values: dict[str, Any] = {"commanded": test, "measured": [], "unit": "N"}
    driver.arm()
    for tendon in range(driver.tendon_count):
        wanted = np.full(driver.tendon_count, max(driver.limits.low, 0.1 * test))
        wanted[tendon] = test
        machine.hold(wanted, 1.0)
        measured = machine.tensions(10).mean(axis=0)
        values["measured"].append(round(float(measured[tendon]), 3))
        if abs(measured[tendon] - test) > RELATIVE * test + ABSOLUTE:
            driver.disarm()
            raise CheckError(
                f"tendon {tendon + 1}: {test:g} N commanded, {measured[tendon]:.3g} N measured; check "
                "gains and calibration",
                values,
            )
    driver.disarm()
    machine.wait(0.7)
    return values


def measure_over_tension(machine: Machine) -> dict[str, Any]:
    """Lower the board's limit of tension, and exceed it by jogs; the board must stop and release."""
    driver, test = machine.driver, _test(machine.driver)
    board: Any = driver
    if not hasattr(driver, "set_setting"):
        raise NotImplementedError("this robot has no setting of its over-tension limit")
    usual, low = board.setting("limit"), round(0.5 * test / GRAM_FORCE)
    board.set_setting("limit", low)
    values: dict[str, Any] = {"limit": round(low * GRAM_FORCE, 3), "unit": "N"}
    try:
        jogs, reading = 0, driver.read()
        while jogs < 2 * JOGS and not reading.fault:
            driver.jog(0, DRIVE)
            machine.wait(0.25)
            reading = driver.read()
            jogs += 1
        values |= {"fault": reading.fault, "jogs": jogs}
        if not reading.fault.startswith("over-tension"):
            raise CheckError("a tension above the board's limit was no fault; do not use this robot", values)
    finally:
        machine.wait(0.7)
        if driver.state is DriverState.FAULT:
            driver.reset()
        board.set_setting("limit", usual)
    return values


def measure_latency(machine: Machine) -> dict[str, Any]:
    """Send 50 commands at the low limit, and report the latency (s)."""
    driver = machine.driver
    driver.arm()
    machine.hold(np.full(driver.tendon_count, driver.limits.low), 1.0)
    driver.disarm()
    machine.wait(0.7)
    median, p99, count = driver.latency
    if not count:
        raise NotImplementedError("this robot does not acknowledge commands")
    values = {"median": round(median, 5), "p99": round(p99, 5), "count": count, "unit": "s"}
    if median > LATENCY:
        raise CheckError(f"the latency is {1e3 * median:.3g} ms (allowed: {1e3 * LATENCY:g} ms)", values)
    return values


def _test(driver: Driver) -> float:
    """Return the tension of tests (N): small, and within the limits."""
    limits = driver.limits
    return float(min(max(TEST, 1.5 * limits.low), limits.high, 0.5 * limits.total))


def _rounded(values: Float[np.ndarray, " c"]) -> list[float]:
    return [round(float(value), 4) for value in values]


CHECKLIST: tuple[CheckStep, ...] = (
    CheckStep("power-switch", "A switch within reach cuts the motors' supply, and it was tried."),
    CheckStep("clear-space", "Nobody and nothing is within the robot's length; eyes are protected."),
    CheckStep("mechanics", "Rod and ribs are fixed; each tendon is on its reel and in its holes."),
    CheckStep("supply", "The motors' supply has the right voltage and a current limit."),
    CheckStep("limits", "The tension limits of the robot file suit rod, tendons and load cells."),
    CheckStep("noise", "Offset and noise of each load cell at rest.", "", measure_noise),
    CheckStep(
        "directions", "Direction of each motor, and the load cell on its tendon.",
        "each motor in turn reels in slowly until its tendon is taut, and out again", measure_directions,
    ),
    CheckStep("stop", "Emergency stop by the driver.", "all tendons to 1 N, then released", measure_stop),
    CheckStep(
        "watchdog", "Stop of the robot when its host is silent for 1 s.",
        "all tendons to 1 N, then released", measure_watchdog,
    ),
    CheckStep(
        "tracking", "Measured tension under a command.", "each tendon in turn to 2 N: the rod bends",
        measure_tracking,
    ),
    CheckStep(
        "over-tension", "Fault of the board above its tension limit, lowered for the check.",
        "motor 1 reels in slowly to 1 N, then all are released", measure_over_tension,
    ),
    CheckStep(
        "latency", "Time from a command to its acknowledgement.", "all tendons at the low limit",
        measure_latency,
    ),
    CheckStep("observed", "All motions looked right: directions, no rubbing, nothing loose."),
)  # fmt: skip
