"""Time of a cable's rollout, and of 14 of them at once: `python -m benchmarks.cables`.

The cable is simulated: no data are needed. It is like DLO1 (1 m free length, 13 markers, EI/ρA 0.02 m⁴/s²).
It hangs between two grippers, which swing. The discretisation error is that from GRID nodes.
"""

from __future__ import annotations

import os
import statistics
import time
from typing import Any

import numpy as np

from studies.cables.model import DT, CableModel, CableParameters, Grips
from studies.cables.rollouts import Rollouts

#: frames of a motion, motions of the batch, measurements whose median counts, nodes of the finer grid
FRAMES, MOTIONS, REPEATS, GRID = 502, 14, 5, 121
#: largest distance of the grips, as a part of the cable's length
APART = 0.95
PLACES = np.linspace(0.0, 1.0, 11)
CABLE = CableParameters(bending=0.02, torsion=0.01, damping_time=0.03, drag=0.5)


def held(seed: int, frames: int = FRAMES) -> Any:
    """Markers (T, N, 3) of a hanging arc whose grips swing; those that are free matter at the start only."""
    rng = np.random.default_rng(seed)
    angle = np.linspace(-1.1, 1.1, 2001)
    tangent = np.stack([np.cos(angle), 0.0 * angle, np.sin(angle)], axis=1)
    points = np.cumsum(0.5 * (tangent[1:] + tangent[:-1]), axis=0) / 2000.0
    free = np.concatenate([np.zeros((1, 3)), points])[np.linspace(0, 2000, len(PLACES)).astype(int)]
    markers = np.concatenate([free[:1] - 0.02 * tangent[:1], free, free[-1:] + 0.02 * tangent[-1:]])
    time_ = DT * np.arange(frames)
    sway = [
        sum(
            0.5 * np.outer(1.0 - np.cos(2.0 * np.pi * f * time_), rng.normal(size=3) * 0.08 / f)
            for f in (0.4, 0.9, 1.7)
        )
        for _ in range(2)
    ]
    while True:
        moved = np.repeat(markers[None], frames, axis=0)
        moved[:, :2] += sway[0][:, None]
        moved[:, -2:] += sway[1][:, None]
        # grips further apart than the cable is long would tear it
        if np.max(np.linalg.norm(moved[:, 1] - moved[:, -2], axis=1)) < APART * PLACES[-1]:
            return moved
        sway = [0.9 * each for each in sway]


def error(rollouts: Rollouts, model: CableModel, motions: list[Any]) -> float:
    """Return the mean distance (m) of free markers from those of a finer grid, over three motions."""
    fine = Rollouts(CableModel(PLACES, model.grips, GRID), "lobatto4")
    both = [[each.predict(CABLE, markers) for each in (rollouts, fine)] for markers in motions[:3]]
    for found in (each for pair in both for each in pair if each.markers is None):
        print(f"not predicted: {found.failure}")
    solved = [[each.markers for each in pair] for pair in both if all(e.markers is not None for e in pair)]
    return float(np.mean([np.linalg.norm(a - b, axis=-1).mean() for a, b in solved])) if solved else np.nan


def main() -> None:
    """Print the medians of one rollout and of a batch."""
    motions = [held(seed) for seed in range(MOTIONS)]
    model = CableModel(PLACES, Grips.of(motions))
    rollouts = Rollouts(model)
    failed = [k for k, each in enumerate(rollouts.predict_all(CABLE, motions)) if each.markers is None]
    one, all_ = [], []
    for _ in range(REPEATS):
        began, used = time.perf_counter(), time.process_time()
        rollouts.predict(CABLE, motions[0])
        one.append((time.perf_counter() - began, time.process_time() - used))
        began, used = time.perf_counter(), time.process_time()
        rollouts.predict_all(CABLE, motions)
        all_.append((time.perf_counter() - began, time.process_time() - used))
    off = error(rollouts, model, motions)
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}; {model.nodes} nodes, {FRAMES - 2} steps")
    for label, times in (("one rollout", one), (f"{MOTIONS} rollouts", all_)):
        wall, cpu = (statistics.median(each) for each in zip(*times, strict=True))
        print(f"{label}: {wall:.2f} s (CPU {cpu:.2f} s), median of {REPEATS}")
    print(f"mean distance of markers from {GRID} nodes: {1e3 * off:.2f} mm; {len(failed)} failed")


if __name__ == "__main__":
    main()
