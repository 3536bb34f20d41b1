"""Commissioning of a robot: runs the checklist, and writes a report that can be resumed."""

from __future__ import annotations

import dataclasses
import datetime
import json
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from knode_cosserat._files.json_text import parse_json
from knode_cosserat._files.reading import read_bytes
from knode_cosserat._files.writing import package_version, replacing
from knode_cosserat_hardware.commissioning_steps import CHECKLIST, CheckError, CheckStep, Machine
from knode_cosserat_hardware.driver import Driver, DriverState, HardwareError
from knode_cosserat_hardware.safety import EmergencyStop, StoppedError

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


def silence_of(driver: Driver) -> Callable[[float], Any]:
    """Return a function that passes a time (s) without a sign of life to a robot."""
    found: Callable[[float], Any] = getattr(driver, "advance", time.sleep)
    return found


class Commissioning:
    """Commissioning of a connected robot, step by step, with a report file.

    The report is written after each step. A report that exists is resumed: its finished steps are not
    repeated. Motion is under an emergency stop, and asked for before.

    Args:
        driver: a connected driver.
        path: report file (.json).
        robot: name of the robot in the report, such as its port.
        person: the person in charge.
        silence: passes a time (s) without a sign of life to the robot.
        steps: the checklist.

    Raises:
        HardwareError: the file is no report, or a report of another robot.
    """

    def __init__(
        self, driver: Driver, path: str | Path, robot: str, person: Person, *,
        silence: Callable[[float], Any] | None = None, steps: Sequence[CheckStep] = CHECKLIST,
    ):  # fmt: skip
        self.path, self.robot, self.person, self.steps = Path(path), robot, person, tuple(steps)
        self._machine = Machine(driver, silence_of(driver) if silence is None else silence)
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
            "limits": dataclasses.asdict(self._machine.driver.limits),
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
        driver = self._machine.driver
        try:
            if not step.motion:
                return {"result": "passed", "values": step.measure(self._machine)}
            with EmergencyStop(driver) as emergency:
                values = step.measure(self._machine)
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
