"""Study of identification on test robots with random imperfections, whose truth is known.

Each robot is recorded as the paper's was, with noisy sensors, lost frames and motors with a lag. It is
identified from three recordings, a residual is learned on it, and both predict two other recordings.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from knode_cosserat.identification.evaluate import Evaluation, evaluate
from knode_cosserat.identification.fit import fit
from knode_cosserat.identification.identify import identify
from knode_cosserat.identification.imperfections import END, TRAINING, Imperfect, drawn_robot, nominal_robot
from knode_cosserat.identification.result import Identified
from knode_cosserat.recordings.load import load_recording
from knode_cosserat.recordings.measurements import DT, Measurements
from knode_cosserat.recordings.virtual import record_virtual
from knode_cosserat.schemes.result import SimulationError
from studies.report import Report, markdown_table, write_report
from studies.runner import Job, Product, run

#: signals of the held-out recordings
UNSEEN = {"sine_2p0": "sine:2.0", "rand_1": "random:1"}
#: begin of the part of each recording that is used (s): rest
START = 0.5
#: most draws of a robot, and the distance of their seeds
DRAWS, APART = 5, 1000


def jobs(seeds: Sequence[int]) -> list[Job]:
    """Return one job for each robot."""
    return [Job(f"robot-{seed}", robot_facts, {"seed": seed}) for seed in seeds]


def rerun(out: Path, seeds: Sequence[int], **how: Any) -> Report:
    """Run the study on these seeds, and write virtual_robots.md and .json; interrupted runs are continued.

    Args:
        out: the folder; an earlier run in it is continued.
        seeds: one for each robot.
        how: as `runner.run` has it.
    """
    facts = list(run(jobs(seeds), out, **how).values())
    return write_report(out, "virtual_robots", facts, as_markdown(facts))


def recordings_of(truth: Imperfect, signals: Mapping[str, str], seed: int) -> list[Measurements]:
    """Return recordings of a robot, read from bags as any others."""
    found = []
    # all parts, also inactive ones: one compiled program serves every robot
    robot = truth.model.robot(truth.x)
    with tempfile.TemporaryDirectory() as folder:
        for k, (name, signal) in enumerate(signals.items()):
            path = Path(folder) / f"{name}.bag"
            record_virtual(path, signal, END + 0.5, 100 * seed + k, robot=robot)
            found.append(load_recording(path).sampled(DT, START, END, mean=True))
    return found


class _Recorded(NamedTuple):
    """A test robot, its training and held-out recordings, and the number of draws before it."""

    truth: Imperfect
    given: list[Measurements]
    unseen: list[Measurements]
    redrawn: int


def _recorded(seed: int) -> _Recorded:
    """Return a robot and its recordings; a robot that collapses under the tensions is drawn again.

    Raises:
        SimulationError: all draws collapse.
    """
    redrawn = 0
    while True:
        truth = drawn_robot(seed + APART * redrawn)
        try:
            given = recordings_of(truth, TRAINING, seed)
            return _Recorded(truth, given, recordings_of(truth, UNSEEN, 1000 + seed), redrawn)
        except SimulationError:
            redrawn += 1
            if redrawn == DRAWS:
                raise


def robot_facts(settings: Any) -> Product:
    """Return the identification's result for one robot, and its prediction errors."""
    seed = int(settings["seed"])
    truth, given, unseen, redrawn = _recorded(seed)
    found = identify(nominal_robot(), given)
    learned = fit(found, given)
    residual = learned.about.facts
    outcomes = {}
    for name, each in zip(UNSEEN, unseen, strict=True):
        before, after = (evaluate(robot, each) for robot in (nominal_robot(), found.robot))
        last = evaluate(learned, each) if residual["residual"] else after
        outcomes[name] = {
            "nominal": before.to_dict(),
            "identified": after.to_dict(),
            "residual": last.to_dict(),
            "improvement": _gain(before, after),
        }
    facts = {
        "seed": seed,
        "redrawn": redrawn,
        "true_effects": list(truth.effects),
        "true_values": dict(truth.values),
        "identified": found.to_dict(),
        "covered": _covered(truth, found),
        "residual": {"kept": residual["residual"], "steps": residual["steps"]},
        "unseen": outcomes,
    }
    return Product(facts, {})


def _gain(before: Evaluation, after: Evaluation) -> float | None:
    """Return the mean part by which DTW and pose MSE are less; None if a prediction failed."""
    parts = []
    for name in ("tip_dtw", "pose_mse"):
        a, b = getattr(before, name), getattr(after, name)
        if a is None or b is None:
            return None
        parts.append(1.0 - b / a)
    return float(np.mean(parts))


def _covered(truth: Imperfect, found: Identified) -> dict[str, bool]:
    """Return which intervals hold the true value, by label; without an effect this is the nominal one."""
    covered = {}
    for each in found.estimates:
        low, high = sorted(each.interval)
        covered[each.label] = bool(low <= truth.values.get(each.label, each.nominal) <= high)
    return covered


def as_markdown(facts: Sequence[Mapping[str, Any]]) -> str:
    """Return the results in Markdown: one row for each robot, and a summary."""
    rows = []
    for each in facts:
        true, have = set(each["true_effects"]), set(each["identified"]["effects"])
        undecided = set(each["identified"]["undecided"])
        gains = [outcome["improvement"] for outcome in each["unseen"].values()]
        inside = list(each["covered"].values())
        angles = [outcome["identified"]["rotation_rmse"] for outcome in each["unseen"].values()]
        rows.append(
            [
                str(each["seed"]),
                *("failed" if gain is None else f"{100 * gain:.1f} %" for gain in gains),
                *("failed" if angle is None else f"{np.degrees(angle):.2f}" for angle in angles),
                f"{len(true & have)} of {len(true)}",
                ", ".join(sorted(undecided & true)) or "none",
                ", ".join(sorted(true - have - undecided)) or "none",
                ", ".join(sorted(have - true)) or "none",
                f"{sum(inside)} of {len(inside)}",
            ]
        )
    gains = [f"improvement, {name}" for name in UNSEEN]
    angles = [f"orientations, {name} [degrees]" for name in UNSEEN]
    heads = [
        "seed",
        *gains,
        *angles,
        "effects found",
        "of others undecided",
        "missed",
        "false",
        "in interval",
    ]
    told = summary(facts)
    lines = [
        "# Test robots with random imperfections",
        "Simulated recordings with noise. Improvement: mean part by which DTW of the tip and pose MSE are "
        "less than the nominal robot's, on recordings that were not learned from. Orientations: root mean "
        "square angle between predicted and measured ones.",
        markdown_table(heads, rows),
        f"Median improvement {100 * told['median_improvement']:.1f} %, least "
        f"{100 * told['least_improvement']:.1f} %, failed predictions {told['failed']}. "
        f"False effects {told['false']} of {told['found']} found. Intervals (95 %) hold the true value of "
        f"{told['covered']} of {told['intervals']} numbers; where the set of effects is right, of "
        f"{told['covered_right']} of {told['intervals_right']}.",
    ]
    return "\n\n".join(lines) + "\n"


def summary(facts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return counts and medians over all robots."""
    gains = [outcome["improvement"] for each in facts for outcome in each["unseen"].values()]
    solved = [gain for gain in gains if gain is not None] or [np.nan]
    found = [(set(each["identified"]["effects"]), set(each["true_effects"])) for each in facts]
    undecided = [set(each["identified"]["undecided"]) for each in facts]
    right = [each for each, (have, true) in zip(facts, found, strict=True) if have == true]
    inside, inside_right = (
        [value for each in some for value in each["covered"].values()] for some in (facts, right)
    )
    return {
        "median_improvement": float(np.median(solved)),
        "least_improvement": float(np.min(solved)),
        "failed": sum(gain is None for gain in gains),
        "false": sum(len(have - true) for have, true in found),
        "found": sum(len(have) for have, _ in found),
        "missed": sum(
            len(true - have - others) for (have, true), others in zip(found, undecided, strict=True)
        ),
        "covered": sum(inside),
        "intervals": len(inside),
        "covered_right": sum(inside_right),
        "intervals_right": len(inside_right),
    }
