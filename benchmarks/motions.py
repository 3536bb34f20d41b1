"""Damped motions of robots on which something changes along the rod: how far they are from a much finer grid.

For tests and for docs/validation.md. There is no closed form, so that the solver is held to itself with four
times as many nodes: an error of low order shows, one that all grids share would not.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numpy as np

import knode_cosserat as kc
from benchmarks.beams import Case
from benchmarks.cases import DT

#: nodes of what the others are compared with
FINEST = 160


def soft_rod(*ends: float) -> kc.robots.SlenderRod:
    """A damped rod that falls to one side; up to each of these places it is twice as stiff as beyond."""
    return kc.robots.SlenderRod(
        length=0.5,
        radius=0.005,
        density=1200.0,
        youngs_modulus=5e6,
        bending_damping=1e-3,
        linear_drag=(0.01, 0.01, 0.01),
        gravity=(2.0, 0.0, -2.0),
        sections=tuple(kc.robots.Stretch(end=end, stiffness=[2.0]) for end in ends),
    )


def _falling(*ends: float) -> Callable[[], tuple[Any, np.ndarray, float]]:
    return lambda: (soft_rod(*ends), np.zeros((15, 0)), 0.02)


def _pulled(kind: str) -> tuple[Any, np.ndarray, float]:
    controls = kc.controls.sine(1.5, 60, DT)
    if kind == "ribs":
        return kc.load_robot("delrin-routed-tendon-robot"), controls, DT
    places = ((0.3, 1.0), (2.4, 0.63))
    helices = tuple(kc.robots.routing.Helical(0.02, angle, 0.5, end=end) for angle, end in places)
    crude = kc.load_robot("delrin-tendon-robot")
    return kc.robots.RoutedTendonRobot.like(crude, routing=helices), controls[:, :2], DT


@functools.lru_cache
def path(motion: Callable[[], tuple[Any, np.ndarray, float]], nodes: int, space: str) -> np.ndarray:
    """Of the tip (steps + 1, 3) in lengths of the rod."""
    robot, controls, dt = motion()
    moved = kc.simulate(robot.replace(nodes=nodes), controls, dt, space=space, initial="unstressed")
    return np.asarray(moved.tip_position) / float(np.asarray(robot.length))


def _case(name: str, motion: Callable[[], tuple[Any, np.ndarray, float]]) -> Case:
    def error(nodes: int, space: str) -> float:
        found, finest = path(motion, nodes, space), path(motion, FINEST, space)
        return float(np.linalg.norm(found - finest, axis=1).max())

    return Case(name, error)


MOTIONS = {
    "alike": _case("a uniform rod", _falling()),
    "section": _case("its section changes at 0.317 of its length", _falling(0.317)),
    "tendon ends": _case("one of two helical tendons ends at 0.63", functools.partial(_pulled, "ends")),
    "ribs": _case("`delrin-routed-tendon-robot`: sleeve and ribs", functools.partial(_pulled, "ribs")),
}
