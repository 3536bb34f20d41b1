"""Recordings of simulated robots, for tests of identification."""

import numpy as np

import knode_cosserat as kc
from knode_cosserat.rotation import since_first

DT = 0.025
NOISE = 2e-4
FRACTIONS = np.array([3.0, 5.0, 7.0, 9.0]) / 9.0


def tensions(kind, seconds, seed=0, base=4.0):
    """Half a second of rest, then a sine of a period (s), or random tensions."""
    rest = np.full((round(0.5 / DT), 4), base)
    count = round(seconds / DT) - len(rest)
    if kind == "random":
        moving = kc.controls.random(count, low=0.5 * base, high=1.7 * base, seed=seed, hold=round(0.4 / DT))
    else:
        moving = kc.controls.sine(kind, count, DT, base=base, amplitude=0.7 * base)
    return np.concatenate([rest, moving])


def measured(robot, true_tension, source, *, seed=0, noise=NOISE, reading=None, turned=True):
    """What motion capture and load cells see of a robot that begins in its equilibrium.

    `reading` makes load cells' readings of tensions; bodies are mounted anyhow if `turned`.
    """
    rng = np.random.default_rng(seed)
    still = kc.equilibrium(robot, true_tension[0], space="lobatto4")
    moved = kc.simulate(robot, true_tension, DT, initial=still, space="lobatto4")
    nodes = np.round(FRACTIONS * (robot.nodes - 1)).astype(int)
    position = np.asarray(moved.position)[:, nodes]
    quaternion = np.array(np.asarray(moved.quaternion)[:, nodes])
    if turned:
        # as a reader has them that takes the first row for upright
        quaternion = since_first(quaternion)
    quaternion = quaternion + 5.0 * noise * rng.normal(size=quaternion.shape)
    seen = true_tension if reading is None else reading(true_tension)
    return kc.recordings.Measurements(
        time=np.asarray(moved.time),
        # the last row's leads beyond the end
        control=np.concatenate([seen, seen[-1:]]),
        fractions=FRACTIONS,
        position=position + noise * rng.normal(size=position.shape),
        quaternion=quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True),
        measured=np.ones(position.shape[:2], dtype=bool),
        simulated=True,
        source=source,
        initial_control=seen[0],
    )
