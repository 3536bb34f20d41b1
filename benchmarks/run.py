"""`make bench`: run every case, print the table, write it as JSON."""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

ROUNDS = 3
#: cases that are run with compiled programs
AS_USER = {"KNODE_COSSERAT_CODE": ""}
WARM = ("steps", "cantilever", "batch", "gradient", "tangents", "schemes", "memory", "workspace")


def case(name: str | None, cache: str, of: str = "cases", **environment: str) -> dict[str, Any]:
    """One case in a process of its own, with the given folder of compiled programs."""
    ran = subprocess.run(
        [sys.executable, "-m", f"benchmarks.{of}", *([name] if name else [])],
        env={**os.environ, "KNODE_COSSERAT_CACHE": cache, **environment},
        stdout=subprocess.PIPE,
        check=True,
        text=True,
    )
    return dict(json.loads(ran.stdout))


def command_seconds(cache: str) -> float:
    """From a command to its result, in a new process."""
    with tempfile.TemporaryDirectory() as folder:
        begin = time.perf_counter()
        subprocess.run(
            [
                *(sys.executable, "-m", "knode_cosserat.cli", "simulate", "delrin-tendon-robot"),
                *("--controls", "sine:1.5", "--steps", "100", "--out", f"{folder}/truth.nc"),
            ],
            env={**os.environ, "KNODE_COSSERAT_CACHE": cache, **AS_USER},
            stdout=subprocess.DEVNULL,
            check=True,
        )
        return time.perf_counter() - begin


def machine() -> str:
    """The processor, as its system calls it, and its cores."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        name = next(line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        name = platform.processor() or platform.machine()
    return f"{name}, {os.cpu_count()} cores, {platform.system()}, Python {platform.python_version()}"


def measure() -> dict[str, Any]:
    """All figures."""
    with tempfile.TemporaryDirectory() as cache:
        cold = []
        for _ in range(ROUNDS):
            with tempfile.TemporaryDirectory() as empty:
                cold.append(case("first_call", empty, **AS_USER))
        command_seconds(cache)
        second = [command_seconds(cache) for _ in range(ROUNDS)]
        found = {name: case(name, cache) for name in WARM}
        found["family"] = case(None, cache, "family")
        found |= {name: case(name, cache, "learning") for name in ("fits", "learned_steps")}
    with tempfile.TemporaryDirectory() as empty:
        found["study"] = case("study", empty, "learning", **AS_USER)
    found["first_call"] = {key: statistics.median(one[key] for one in cold) for key in cold[0]}
    found["second_process"] = {"seconds": statistics.median(second)}
    return {"machine": machine(), **found}


def comparison(found: dict[str, Any], matched: dict[str, Any]) -> str:
    """Return the comparison with others as a Markdown table, with the figures of `benchmarks.matched`."""
    steps, schemes, cantilever = found["steps"], found["schemes"], found["cantilever"]["microseconds"]
    ratios = [steps[kind]["ratio"] for kind in ("sine", "step", "random")]
    own = matched["ours"]["best"]["cpu"]
    alone = {name: matched[name]["best"]["cpu"] / own for name in ("elastica", "soromox")}
    many = matched["soromox"]["batch"]["cpu"] / matched["ours"]["batch"]["cpu"]
    rows = [
        (
            "the paper's method: `fsolve` along the rod, in NumPy and SciPy",
            "100 steps of the paper's robot, 10 nodes",
            f"{min(ratios):.0f} to {max(ratios):.0f} times as fast",
        ),
        (
            "its scheme along the rod, forward Euler, in this package",
            f"a tip within 1 mm: {schemes['nodes']['default']} nodes "
            f"against {schemes['nodes']['fine_euler']}",
            f"{schemes['fine_euler'] / schemes['default']:.0f} times as fast",
        ),
        (
            f"PyElastica {matched['elastica']['version']}",
            "a Delrin rod released, tip within 1 % of the length, CPU time",
            f"{alone['elastica']:,.0f} times as fast",
        ),
        (
            f"SoRoMoX {matched['soromox']['version']}",
            "the same rod; 256 of them",
            f"{alone['soromox']:.1f} times as fast; {many:.1f} times",
        ),
        (
            "compiled C++ shooting codes: 35 to 95 µs, on other machines",
            "a step of a steel cantilever, 40 segments, 2 ms, BDF-α",
            f"{cantilever:.0f} µs",
        ),
    ]
    lines = ["| against | case | this package |", "| --- | --- | --- |"]
    return "\n".join([*lines, *(f"| {' | '.join(row)} |" for row in rows)])


def table(found: dict[str, Any]) -> str:
    """Return the figures as a Markdown table, each with its aim and whether it was met."""
    steps, nodes, gradient = found["steps"], found["steps"]["nodes"], found["gradient"]
    schemes = found["schemes"]
    default, euler = (
        f"{schemes['nodes'][name]} nodes ({1e3 * schemes['tip_error'][name]:.1f} mm)"
        for name in ("default", "fine_euler")
    )
    rows = [
        *(
            (
                f"100 steps, 10 nodes, {kind}: against fsolve",
                f"{steps[kind]['ratio']:.0f}x ({1e3 * steps[kind]['package']:.1f} ms)",
                ">= 100x",
            )
            for kind in ("sine", "step", "random")
        ),
        (
            "a step of a steel cantilever, 40 segments",
            f"{found['cantilever']['microseconds']:.0f} µs",
            "<= 35 µs",
        ),
        ("40 nodes against 10", f"{nodes['40 nodes'] / nodes['10 nodes']:.1f}x", "<= 4x"),
        ("100 nodes against 10", f"{nodes['100 nodes'] / nodes['10 nodes']:.1f}x", "<= 8x"),
        (
            "1024 robots at once, all cores",
            f"{found['batch']['robot_steps_per_second']:,.0f} robot-steps/s",
            ">= 200,000",
        ),
        (
            "equilibria of a workspace, all cores",
            f"{found['workspace']['per_second']:,.0f} a second",
            ">= 40,000",
        ),
        ("first call (nothing compiled yet)", f"{found['first_call']['first_call']:.1f} s", "<= 1.2 s"),
        (
            "the same, robot with ribs and routed tendons",
            f"{found['first_call']['ribs']:.1f} s",
            "<= 2 s",
        ),
        ("second process, command to result", f"{found['second_process']['seconds']:.1f} s", "<= 2.2 s"),
        ("gradient of 100 steps against the steps", f"{gradient['ratio']:.1f}x", "<= 2x"),
        (
            f"{found['tangents']['steps']} steps with {found['tangents']['columns']} tangents of all states",
            f"{found['tangents']['milliseconds']:.1f} ms",
            "<= 0.8 ms",
        ),
        ("the same of the tip, by `jax.jacfwd`", f"{found['tangents']['by_jax']:.1f} ms", "none"),
        (
            f"tip within 1 mm: default, {default}, against forward Euler, {euler}",
            f"{schemes['fine_euler'] / schemes['default']:.0f}x",
            ">= 3x",
        ),
        ("peak memory, 1,000 steps", f"{found['memory']['megabytes']:.0f} MB", "<= 700 MB"),
        *family_rows(found["family"]),
        *learning_rows(found),
    ]
    lines = ["| case | measured | aim | result |", "| --- | --- | --- | --- |"]
    return "\n".join(
        [*lines, *(f"| {what} | {value} | {aim} | {verdict(value, aim)} |" for what, value, aim in rows)]
    )


def verdict(measured: str, aim: str) -> str:
    """Return "met" or "missed", from the least favourable number of a cell; "–" without an aim."""
    if aim == "none":
        return "–"
    found = [_number(text) for text in measured.partition("(")[0].split(" to ")]
    limit = _number(aim[2:])
    met = min(found) >= limit if aim.startswith(">=") else max(found) <= limit
    return "met" if met else "**missed**"


def _number(text: str) -> float:
    """Return the number at the beginning of a text; milliseconds become seconds."""
    number, unit = re.match(r"\s*([\d.,]+)\s*(\w*)", text).groups()  # type: ignore[union-attr]
    return float(number.replace(",", "")) * (1e-3 if unit == "ms" else 1.0)


def family_rows(found: dict[str, Any]) -> list[tuple[str, str, str]]:
    """Return the rows of the other robots."""

    def ratios(kind: str) -> str:
        each = [case[kind]["ratio"] for case in found["tendons"].values()]
        return f"{min(each):.2f}x to {max(each):.2f}x"

    reel = found["reel"]
    return [
        ("a step with routed tendons, against the paper's tendon model", ratios("straight"), "<= 1.5x"),
        ("the same with friction", ratios("friction"), "<= 1.5x"),
        ("the same with helical tendons", ratios("helical"), "<= 1.5x"),
        ("the same with ribs and a sleeve, the catalog's robot", ratios("ribs"), "none"),
        (
            f"500 steps, 200 nodes, a reel and slack ({reel['slack_steps']} slack steps)",
            f"{reel['seconds']:.2f} s",
            "<= 0.3 s",
        ),
        ("a step of the six-legged robot", f"{found['parallel']['milliseconds']:.2f} ms", "<= 10 ms"),
    ]


def learning_rows(found: dict[str, Any]) -> list[tuple[str, str, str]]:
    """Return the rows of learning."""
    paper, best = found["fits"]["paper"], found["fits"]["best"]
    steps = found["learned_steps"]
    ratios = [taken / steps["physics"] for name, taken in steps.items() if name not in ("physics", "paper")]
    return [
        ("fit, configuration paper, 1,000 epochs", f"{paper['one']:.2f} s", "<= 2 s"),
        ("the same, five seeds against one", f"{paper['ratio']:.1f}x", "<= 2.5x"),
        ("fit, configuration best", f"{1e3 * best['one']:.0f} ms", "<= 5 s"),
        ("the same, five seeds against one", f"{best['ratio']:.1f}x", "<= 2.5x"),
        ("a step with the 512-wide network", f"{1e3 * steps['paper']:.2f} ms", "<= 0.15 ms"),
        (
            "a step with the best residual, against the physics alone",
            f"{min(ratios):.1f}x to {max(ratios):.1f}x",
            "<= 1.4x",
        ),
        (
            "the whole simulation study, nothing compiled yet",
            f"{found['study']['seconds']:.0f} s",
            "<= 300 s",
        ),
    ]


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results.json"))
    out: Path = parser.parse_args().out
    found = measure()
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(json.dumps(found, indent=2) + "\n")
    print(f"{found['machine']}\n\n{table(found)}\n\nwritten: {out}")


if __name__ == "__main__":
    main()
