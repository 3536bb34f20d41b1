"""Study of the firmware and the closed loop on the emulated robot, with limits for each figure."""

from __future__ import annotations

import importlib.util
import re
import subprocess
import tempfile
import time as clock
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from knode_cosserat.control import circle, figure_eight, run_loop
from knode_cosserat_hardware.driver import DriverState, HardwareError
from knode_cosserat_hardware.emulation import EmulatedRobot, built, firmware_folder, missing
from knode_cosserat_hardware.lines import GRAM_FORCE
from knode_cosserat_hardware.plant import HardwarePlant
from studies.hardware_faults import faults, loop_faults
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
from studies.report import Report, as_json, check_row, checks_table, write_texts
from studies.runner import Job, Product, run

#: tip RMSE of the PyElastica stand-in in the study `control` (% of length), and the allowed multiple of it
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
        Job("faults", faults, {"runs": 20 if quick else 200}),
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
        out: the folder.
        quick: shorter runs.
        how: `workers`, `dask`, `progress` as `runner.run` has them.

    Raises:
        HardwareError: the tools to build the firmware are missing.
    """
    if reason := missing():
        raise HardwareError(f"the study needs the firmware's tools: {reason}")
    made = checks(facts_of(jobs(quick), out, **how))
    texts = {"hardware.json": as_json(made), "hardware.md": as_markdown(made)}
    return Report(made, write_texts(out, texts), [])


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
        ("injected faults that were not caught", facts["faults"]["missed"], 0),
        ("faults after which the robot did not work again", facts["faults"]["dead"], 0),
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
            check=True, capture_output=True,
        )  # fmt: skip
        seconds = clock.perf_counter() - began
    shown = subprocess.run(
        ["avr-size", "-C", "--mcu=atmega2560", built() / "tension.elf"],
        check=True, capture_output=True, text=True,
    ).stdout  # fmt: skip
    flash, ram = (int(each) for each in re.findall(r":\s+(\d+) bytes", shown))
    return Product({"seconds": seconds, "flash": flash, "ram": ram}, {})


def fuzz(settings: Any) -> Product:
    """Send fuzzed frames to the board's logic on this computer."""
    from knode_cosserat_hardware.emulation import HostBoard

    each = settings["frames"] // 10
    found = [HostBoard().fuzz(seed, each) for seed in range(10)]
    return Product({"unsafe": sum(f.unsafe for f in found), "armed": sum(f.armed for f in found)}, {})


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
        plant = HardwarePlant(board, lambda: measured_tip(robot, random), DT, clock=lambda: robot.time)
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
        "rmse": worst if np.isfinite(worst) else 1e9, "errors": errors, "lag": lag, "unsafe": unsafe,
        "faults": failed, "fallbacks": missing_rows, "damaged_lines": dict(board.line_counts),
    }  # fmt: skip
    return Product(facts, {})


def dds(settings: Any) -> Product:
    """Measure the latency of DDS between two processes; with real-time priority where it is allowed."""
    from benchmarks.dds_latency import measure_loopback

    try:
        found = measure_loopback(settings["messages"], real_time=True)
    except HardwareError:
        found = measure_loopback(settings["messages"])
    return Product({"p99": 1e3 * found.p99, "median": 1e3 * found.median, "real_time": found.real_time}, {})
