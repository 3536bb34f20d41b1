"""Commissioning of a robot: a checklist, measured and confirmed, with a report that can be resumed."""

from __future__ import annotations

import dataclasses
import datetime
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from knode_cosserat._files.json_text import parse_json
from knode_cosserat._files.reading import read_bytes
from knode_cosserat._files.writing import package_version, replacing
from knode_cosserat_hardware.driver import Driver, DriverState, HardwareError
from knode_cosserat_hardware.lines import GRAM_FORCE
from knode_cosserat_hardware.safety import EmergencyStop, StoppedError

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


def _tensions(driver: Driver, count: int = 20) -> Float[np.ndarray, "count c"]:
    """Return the measured tensions of some readings (N)."""
    return np.array([driver.read().tension for _ in range(count)])


def _hold(driver: Driver, tension: Float[np.ndarray, " c"], seconds: float) -> None:
    """Command tensions (N) for a time (s)."""
    for _ in range(max(1, round(seconds / 0.02))):
        driver.command(tension)
        driver.wait(0.02)


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
    measure: Callable[[Driver], dict[str, Any]] | None = None


def measure_noise(driver: Driver) -> dict[str, Any]:
    """Measure offset and noise of each load cell at rest (N)."""
    tension = _tensions(driver, 100)
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


def measure_directions(driver: Driver) -> dict[str, Any]:
    """Reel in with each motor until its load cell reacts, and reel out again."""
    values: dict[str, Any] = {"rise": [], "jogs": [], "unit": "N"}
    for tendon in range(driver.tendon_count):
        before = _tensions(driver, 10).mean(axis=0)
        count = 0
        while count < JOGS:
            count += 1
            driver.jog(tendon, DRIVE)
            driver.wait(0.25)
            rise = _tensions(driver, 5).mean(axis=0) - before
            if np.max(np.abs(rise)) > RISE:
                break
        for _ in range(count):
            driver.jog(tendon, -DRIVE)
            driver.wait(0.25)
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


def measure_stop(driver: Driver) -> dict[str, Any]:
    """Stop the armed robot; it must have the fault `stopped`, and release."""
    driver.arm()
    _hold(driver, np.full(driver.tendon_count, _test(driver) / 2.0), 0.5)
    driver.stop()
    driver.wait(1.0)
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


def measure_watchdog(driver: Driver) -> dict[str, Any]:
    """Send nothing to the armed robot for a second; it must stop by itself."""
    driver.arm()
    _hold(driver, np.full(driver.tendon_count, _test(driver) / 2.0), 0.5)
    driver.advance(SILENCE)
    # readings from before the silence may still wait
    driver.wait(0.1)
    reading = driver.read()
    values = {"state": reading.state.value, "fault": reading.fault, "silence": SILENCE, "unit": "s"}
    if reading.state is DriverState.ARMED:
        raise CheckError(
            f"the robot is still armed after {SILENCE:g} s without its host; do not use it", values
        )
    driver.reset()
    return values


def measure_tracking(driver: Driver) -> dict[str, Any]:
    """Tension each tendon in turn; the measured tension must follow."""
    test = _test(driver)
    values: dict[str, Any] = {"commanded": test, "measured": [], "unit": "N"}
    driver.arm()
    for tendon in range(driver.tendon_count):
        wanted = np.full(driver.tendon_count, max(driver.limits.low, 0.1 * test))
        wanted[tendon] = test
        _hold(driver, wanted, 1.0)
        measured = _tensions(driver, 10).mean(axis=0)
        values["measured"].append(round(float(measured[tendon]), 3))
        if abs(measured[tendon] - test) > RELATIVE * test + ABSOLUTE:
            driver.disarm()
            raise CheckError(
                f"tendon {tendon + 1}: {test:g} N commanded, {measured[tendon]:.3g} N measured; check "
                "gains and calibration",
                values,
            )
    driver.disarm()
    driver.wait(0.7)
    return values


def measure_over_tension(driver: Driver) -> dict[str, Any]:
    """Lower the board's limit of tension, and exceed it by jogs; the board must stop and release."""
    test = _test(driver)
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
            driver.wait(0.25)
            reading = driver.read()
            jogs += 1
        values |= {"fault": reading.fault, "jogs": jogs}
        if not reading.fault.startswith("over-tension"):
            raise CheckError("a tension above the board's limit was no fault; do not use this robot", values)
    finally:
        driver.wait(0.7)
        if driver.state is DriverState.FAULT:
            driver.reset()
        board.set_setting("limit", usual)
    return values


def measure_latency(driver: Driver) -> dict[str, Any]:
    """Send 50 commands at the low limit, and report the latency (s)."""
    driver.arm()
    _hold(driver, np.full(driver.tendon_count, driver.limits.low), 1.0)
    driver.disarm()
    driver.wait(0.7)
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


#: version of report files
FORMAT = 1
#: largest report that is read (bytes)
LARGEST_REPORT = 10_000_000
#: results of steps that are not repeated
DONE = ("confirmed", "passed", "not possible")


@dataclasses.dataclass(frozen=True)
class Person:
    """Person in charge of a commissioning.

    Attributes:
        name: name in the report.
        confirm: asks if a statement is true; None if nobody can answer.
        consent: asks if the robot may move as described.
    """

    name: str
    confirm: Callable[[str], bool | None]
    consent: Callable[[str], bool]


class Commissioning:
    """Commissioning of a connected robot, step by step, with a report file.

    The report is written after each step. A report that exists is resumed: its finished steps are not
    repeated. Motion is under an emergency stop, and asked for before.

    Args:
        driver: a connected driver.
        path: report file (.json).
        robot: name of the robot in the report, such as its port.
        person: the person in charge.
        steps: the checklist.

    Raises:
        HardwareError: the file is no report, or a report of another robot.
    """

    def __init__(
        self,
        driver: Driver,
        path: str | Path,
        robot: str,
        person: Person,
        *,
        steps: Sequence[CheckStep] = CHECKLIST,
    ):
        self.path, self.robot, self.person, self.steps = Path(path), robot, person, tuple(steps)
        self._driver = driver
        #: results of steps by name
        self.results: dict[str, dict[str, Any]] = self._resumed()

    @property
    def is_complete(self) -> bool:
        """True if every step is confirmed, passed, or not possible with this robot."""
        return all(self.results.get(step.name, {}).get("result") in DONE for step in self.steps)

    def run(self, shown: Callable[[CheckStep, dict[str, Any]], Any] | None = None) -> dict[str, Any]:
        """Run the steps that are not done, until the first that fails, and return the report.

        Args:
            shown: called with each step and its result.

        Raises:
            StoppedError: the robot was stopped by a person; the report is written.
        """
        for step in self.steps:
            if self.results.get(step.name, {}).get("result") in DONE:
                continue
            try:
                found = self._checked(step)
            except StoppedError as error:
                self._keep(step, {"result": "failed", "reason": str(error)})
                raise
            self._keep(step, found)
            if shown is not None:
                shown(step, self.results[step.name])
            if found["result"] == "failed":
                break
        return self.report()

    def report(self) -> dict[str, Any]:
        """Return the report as plain values."""
        return {
            "format": FORMAT, "robot": self.robot, "package": package_version(), "complete": self.is_complete,
            "limits": dataclasses.asdict(self._driver.limits),
            "steps": [
                {"name": step.name, "text": step.text} | self.results[step.name]
                for step in self.steps
                if step.name in self.results
            ],
        }  # fmt: skip

    def _checked(self, step: CheckStep) -> dict[str, Any]:
        if step.measure is None:
            answer = self.person.confirm(step.text)
            return {"result": {True: "confirmed", False: "failed", None: "not confirmed"}[answer]}
        if step.motion and not self.person.consent(f"{step.name}: {step.motion}"):
            return {"result": "skipped"}
        driver = self._driver
        try:
            if not step.motion:
                return {"result": "passed", "values": step.measure(driver)}
            with EmergencyStop(driver) as emergency:
                values = step.measure(driver)
                if driver.state is DriverState.ARMED:
                    driver.disarm()
                emergency.check()
            return {"result": "passed", "values": values}
        except StoppedError:
            raise
        except NotImplementedError as error:
            if driver.state is DriverState.FAULT:
                driver.reset()
            return {"result": "not possible", "reason": str(error)}
        except HardwareError as error:
            if step.motion and emergency.is_stopped and not emergency.reason.startswith("an error"):
                # a key stopped the robot, and the check saw the fault
                emergency.check()
            values = error.values if isinstance(error, CheckError) else {}
            return {"result": "failed", "reason": str(error), "values": values}

    def _keep(self, step: CheckStep, found: dict[str, Any]) -> None:
        now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
        self.results[step.name] = found | {"person": self.person.name, "time": now}
        with replacing(self.path) as part:
            part.write_text(json.dumps(self.report(), indent=2, allow_nan=False) + "\n", encoding="utf-8")

    def _resumed(self) -> dict[str, dict[str, Any]]:
        if not self.path.exists():
            return {}
        try:
            report = parse_json(read_bytes(self.path, LARGEST_REPORT))
            robot, form, steps = report["robot"], report["format"], report["steps"]
            found = {
                step["name"]: {key: step[key] for key in step if key not in ("name", "text")}
                for step in steps
            }
        except (ValueError, KeyError, TypeError, AttributeError):
            raise HardwareError(f"{self.path}: this is no commissioning report; give another name") from None
        if form != FORMAT:
            raise HardwareError(f"{self.path}: a report of format {form!r}; allowed is {FORMAT}")
        if robot != self.robot:
            raise HardwareError(
                f"{self.path}: a report of another robot, {str(robot)[:60]} (this one: {self.robot}); give "
                "another name"
            )
        return found
