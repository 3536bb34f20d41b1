"""What the other robots cost: `python -m benchmarks.family` prints one JSON object.

Robots with real tendons are measured against the crude one in turn, with controls of which both make the same
number of corrections; Till's example (2019) is a steel rod whose one tendon is pulled by a reel and let go.
"""

from __future__ import annotations

import functools
import json
import statistics
from typing import Any

import numpy as np

from benchmarks.cases import PAPER, one_core, seconds
from knode_cosserat.rods.tendons import TendonFriction

STEPS, DT, ROUNDS = 128, 0.05, 15


def tendons() -> dict[str, Any]:
    """A step of real tendons as a multiple of a step of the crude ones: medians of ratios; corrections."""
    import knode_cosserat as kc

    crude = kc.load_robot("delrin-tendon-robot")
    helix = [kc.robots.routing.Helical(0.02, angle, 0.5) for angle in np.asarray(crude.tendon_angles)]
    robots = {
        "crude": crude,
        "straight": kc.robots.RoutedTendonRobot.like(crude),
        "friction": kc.robots.RoutedTendonRobot.like(
            crude, friction=TendonFriction(wobble=0.6, curvature=0.1)
        ),
        "helical": kc.robots.RoutedTendonRobot.like(crude, routing=tuple(helix)),
        "ribs": kc.load_robot("delrin-routed-tendon-robot"),
    }
    controls = {
        "sine": kc.controls.sine(1.5, STEPS, DT, sampled="end"),
        "step": kc.controls.step(1.5, STEPS, DT, sampled="end"),
    }
    # real tendons bend the robot less: pulled so hard they move it as far, and it takes as many corrections
    large = {"sine": 5.5 * (controls["sine"] - 6.0) + 8.0, "step": 5.0 * (controls["step"] - 5.0) + 5.0}
    found: dict[str, Any] = {}
    for name, control in controls.items():
        for size, pulled in (("", control), (", as far", np.maximum(large[name], 0.0))):
            given = {kind: control if kind == "crude" else pulled for kind in robots}
            moved = {kind: kc.simulate(robot, given[kind], DT, **PAPER) for kind, robot in robots.items()}
            times: dict[str, list[float]] = {kind: [] for kind in robots}
            for _ in range(ROUNDS):
                for kind, robot in robots.items():
                    times[kind].append(
                        seconds(functools.partial(kc.simulate, robot, given[kind], DT, **PAPER))
                    )
            found[name + size] = {
                kind: {
                    "ratio": statistics.median(
                        own / other for own, other in zip(times[kind], times["crude"], strict=True)
                    ),
                    "microseconds": 1e6 * statistics.median(times[kind]) / STEPS,
                    "corrections": float(np.mean(moved[kind].iterations[1:])),
                }
                for kind in robots
            }
    return found


def reel() -> dict[str, Any]:
    """500 steps of Till's example through slack: seconds, and how often the tendon was slack."""
    import knode_cosserat as kc

    length, radius = 0.7144, 0.675e-3
    robot = kc.robots.RoutedTendonRobot(
        length=length,
        radius=radius,
        density=0.034 / (length * np.pi * radius**2),
        youngs_modulus=207e9,
        bending_damping=5e-4,
        drag=1e-4,
        gravity=(9.81, 0.0, 0.0),
        tendon_offset=0.01506,
        tendon_angles=(np.pi / 2,),
        tendon_compliance=1e-4,
        drive="reel",
        nodes=200,
    )
    pulled = kc.controls.parse("reel=ramp:0.01619,start=1,end=1.3", 500, DT, robot)
    released = kc.controls.parse("reel=ramp:0.01619,start=13,end=13.3", 500, DT, robot)
    run = functools.partial(
        kc.simulate, robot, pulled - released, DT, **PAPER | {"initial": kc.equilibrium(robot, np.zeros(1))}
    )
    moved = run()
    times = [seconds(run) for _ in range(5)]
    tension = np.asarray(moved.part("tension"))[:, 0, 0]
    return {
        "seconds": statistics.median(times),
        "slack_steps": int(np.sum(tension < 1e-3)),
        "largest_tension": float(tension.max()),
        "least_tension": float(tension.min()),
        "unsolved": int(np.sum(moved.result < 0)),
        "corrections": float(np.mean(moved.iterations[1:])),
    }


def others() -> dict[str, float]:
    """A step of 20 ms of other robots, as a multiple of a step of the paper's: medians of ratios."""
    import knode_cosserat as kc

    t = 0.02 * np.arange(1, 201)[:, None]
    motions = {
        "delrin-tendon-robot": 5.0 + np.sin(2.0 * np.pi * t + np.arange(4) * np.pi / 2.0),
        "three-chamber-arm": 2e4 * (1.0 + np.sin(np.pi * t + np.arange(3) * 2.1)),
        "three-tube-robot": np.sin(np.pi / 2.0 * t) * np.array([1.0, -0.02, -0.5, 0.01, 0.5, -0.02]),
        "magnetic-catheter": 5e-3 * np.sin(np.pi / 2.0 * t + np.array([0.0, np.pi / 2.0, 0.0])),
    }
    motions["fed-catheter"] = np.hstack(
        [motions["magnetic-catheter"], 0.02 * (1.0 - np.cos(np.pi / 2.0 * t))]
    )
    runs = {
        name: functools.partial(kc.simulate, kc.load_robot(name), control, 0.02)
        for name, control in motions.items()
    }
    for run in runs.values():
        run()
    times: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(ROUNDS):
        for name, run in runs.items():
            times[name].append(seconds(run))
    paper = times.pop("delrin-tendon-robot")
    return {
        name: statistics.median(one / other for one, other in zip(mine, paper, strict=True))
        for name, mine in times.items()
    }


def assembled() -> dict[str, float]:
    """A step of the gripper as a multiple of the steps of its rods alone: median of ratios; its time (ms)."""
    import knode_cosserat as kc

    gripper, t = kc.load_robot("three-finger-gripper"), 0.01 * np.arange(1, 201)[:, None]
    control = 1.0 + np.sin(2.0 * np.pi * t + np.arange(6))
    alone = {
        "base_end": kc.robots.ends.Clamped(),
        "tip_end": kc.robots.ends.Free(),
        "nodes": gripper.nodes,
        "gravity": gripper.gravity,
    }
    runs = [functools.partial(kc.simulate, gripper, control, 0.01)]
    for rod, first, last in zip(gripper.rods, (0, 3, 4, 5), (3, 4, 5, 6), strict=True):
        runs.append(functools.partial(kc.simulate, rod.replace(**alone), control[:, first:last], 0.01))
    for run in runs:
        run()
    times = np.array([[seconds(run) for run in runs] for _ in range(ROUNDS)])
    return {
        "ratio": float(np.median(times[:, 0] / times[:, 1:].sum(axis=1))),
        "milliseconds": 1e3 * float(np.median(times[:, 0])) / len(control),
    }


def parallel() -> dict[str, Any]:
    """A step of the six-legged robot, its actuators moving by 20 mm (ms)."""
    import knode_cosserat as kc

    robot = kc.load_robot("six-legged-robot")
    t = np.arange(1, 101)[:, None]
    control = 0.02 * np.sin(0.06 * t) * np.cos(np.arange(6))
    kc.simulate(robot, control, 0.02, **PAPER)
    times = [seconds(lambda: kc.simulate(robot, control, 0.02, **PAPER)) for _ in range(7)]
    return {"milliseconds": 1e3 * statistics.median(times) / 100}


if __name__ == "__main__":
    one_core()
    found = {"tendons": tendons(), "reel": reel(), "others": others(), "parallel": parallel()}
    print(json.dumps(found | {"assembled": assembled()}))
