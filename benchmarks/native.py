"""Exported models: `python -m benchmarks.native` prints their size, and steps against `simulate`.

For each model and target the C program `native_steps.c` makes 100,000 steps of 20 ms in turn with runs of
`simulate` under the same controls (1,000 steps, medians of rounds). The longest step is that of this computer
with all that runs beside it. `--out FILE` writes the table as JSON.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

DT, STEPS, ROUNDS = 0.02, 1000, 5
#: amplitudes of the controls by their units
AMPLITUDES = {"N": 1.0, "Pa": 2e4, "m": 0.005, "rad": 0.5, "T": 0.01}
MODELS = (
    *("delrin-tendon-robot", "delrin-routed-tendon-robot", "three-chamber-arm", "three-tube-robot"),
    "magnetic-catheter",
)
PROGRAM = Path(__file__).with_name("native_steps.c")


def amplitudes(robot: Any) -> np.ndarray:
    """Return the amplitude of each control."""
    fields = [field for field in robot.control_layout.fields for _ in range(field.size)]
    return np.array([AMPLITUDES.get(field.unit, 0.1) for field in fields])


def controls_of(robot: Any, steps: int) -> np.ndarray:
    """Return the controls of the C program."""
    t = (np.arange(steps) + 1)[:, None] * DT
    waves = 0.5 * (1.0 + np.sin(2.0 * np.pi * t / 1.5 + np.arange(len(amplitudes(robot)))))
    return np.minimum(1.0, t / 0.5) * amplitudes(robot) * waves


def compiled(robot: Any, folder: Path, target: str) -> tuple[Any, Path]:
    """Export a model, and return it with the program of its steps."""
    import knode_cosserat as kc

    exported = kc.export(robot, folder, DT, name="robot", target=target)
    listed = ", ".join(map(repr, [*amplitudes(robot).tolist(), 0.0]))
    (folder / "amplitudes.h").write_text(f"static const double robot_amplitudes[] = {{{listed}}};\n")
    command = [
        "cc",
        "-O2",
        "-std=c11",
        "-include",
        "amplitudes.h",
        PROGRAM,
        "robot.c",
        "robot.o",
        "-I.",
        "-lm",
    ]
    subprocess.run([*command, "-o", "steps"], cwd=folder, check=True)
    return exported, folder / "steps"


def measure(name: str, target: str) -> dict[str, Any]:
    """Return the figures of one model for one target."""
    import knode_cosserat as kc

    robot = kc.load_robot(name)
    controls, own, ratios, rows = controls_of(robot, STEPS), [], [], []
    with tempfile.TemporaryDirectory() as folder:
        exported, program = compiled(robot, Path(folder), target)
        kc.simulate(robot, controls, DT)
        for k in range(ROUNDS):
            begun = time.perf_counter()
            kc.simulate(robot, controls, DT)
            own.append(1e6 * (time.perf_counter() - begun) / STEPS)
            found = subprocess.run(
                [program, str(STEPS)], capture_output=True, text=True, check=True
            ).stdout.split()
            rows.append([*map(float, found)])
            ratios.append(rows[k][0] / own[k])
        last = kc.simulate(robot, controls, DT).tip_position[-1]
        found = subprocess.run([program], capture_output=True, text=True, check=True).stdout.split()
        _, most, longest = map(float, found[:3])
    code = exported.object_size - exported.data_size
    return {
        "model": name, "target": target, "object_kB": round(code / 1e3),
        "data_kB": round(exported.data_size / 1e3), "simulate_us": round(statistics.median(own), 1),
        "step_us": round(statistics.median(row[0] for row in rows), 1),
        "ratio": round(statistics.median(ratios), 2),
        "p999_us": round(most, 1), "longest_us": round(longest, 1),
        "difference_m": float(np.max(np.abs(np.array(rows[-1][3:]) - last))),
    }  # fmt: skip


def main() -> None:
    """Measure all models for this computer, and the first one for all targets that it runs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, help="write the table as JSON")
    arguments = parser.parse_args()
    os.environ.setdefault("KNODE_COSSERAT_CODE", "final")
    import llvmlite.binding as llvm

    targets = ["x86-64", "x86-64-v3"] + ["x86-64-v4"] * bool(llvm.get_host_cpu_features().get("avx512f"))
    cases = [(name, "native") for name in MODELS] + [(MODELS[0], target) for target in targets]
    found = []
    for name, target in cases:
        found.append(measure(name, target))
        print(json.dumps(found[-1]), flush=True)
    if arguments.out:
        arguments.out.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    sys.exit(main())
