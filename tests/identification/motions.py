"""Trajectories of the paper's robot and of a bar to calibrate by, and what measuring makes of them."""

import dataclasses
from typing import Any

import numpy as np

import knode_cosserat as kc

ROBOT = kc.load_robot("delrin-tendon-robot")
FOUR = ["youngs_modulus", "length", "bending_damping", "drag"]
DT = 0.05


def sines(robot: kc.System, **solved: Any) -> list[kc.Trajectory]:
    """The training data of the paper's study."""
    controls = [kc.controls.sine(period, 30, DT) for period in (0.5, 1.0)]
    return [kc.simulate(robot, each, DT, **solved)[:30] for each in controls]


def noisy(trajectories: list[kc.Trajectory], part: float, seed: int) -> list[kc.Trajectory]:
    """White noise in all of y and z, as large as a part of how much each field varies."""
    rng = np.random.default_rng(seed)
    robot = trajectories[0].system

    def sizes(layout: kc.robots.Layout, name: str) -> np.ndarray:
        every = np.concatenate(
            [getattr(each, name) - getattr(each, name).mean(axis=0) for each in trajectories]
        )
        return np.concatenate(
            [np.full(field.size, np.std(every[..., layout.slice(field.name)])) for field in layout.fields]
        )

    in_y, in_z = sizes(robot.y_layout, "y"), sizes(robot.z_layout, "z")
    return [
        dataclasses.replace(
            each,
            y=each.y + part * in_y * rng.normal(size=each.y.shape),
            z=each.z + part * in_z * rng.normal(size=each.z.shape),
        )
        for each in trajectories
    ]


def as_measured(trajectories: list[kc.Trajectory], noise: float, seed: int) -> list[kc.Trajectory]:
    """Positions (and orientations, as 5 times the noise) alone; nothing else is known."""
    rng = np.random.default_rng(seed)
    result = []
    for each in trajectories:
        y, layout = np.full_like(each.y, np.nan), each.system.y_layout
        for name, factor in (("p", 1.0), ("h", 5.0)):
            if name in layout.names:
                where = layout.slice(name)
                y[..., where] = each.y[..., where] + factor * noise * rng.normal(
                    size=each.y[..., where].shape
                )
        result.append(dataclasses.replace(each, y=y, z=np.full_like(each.z, np.nan)))
    return result


def require_exact_slopes(misfit: Any, size: int, rtol: float = 1e-6) -> None:
    """Compare derivatives at the nominal robot with central differences."""
    at, h = np.zeros(size), 1e-4
    (here,) = misfit.differences(at)
    for k, along in enumerate(h * np.eye(size)):
        (high,), (low,) = (misfit.differences(at + sign * along) for sign in (1.0, -1.0))
        expected = (high.values - low.values) / (2.0 * h)
        largest = np.nanmax(np.abs(expected))
        np.testing.assert_allclose(here.derivatives[k], expected, atol=1e-6 * largest, rtol=rtol)
