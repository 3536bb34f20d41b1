"""Study of identification on test robots with random imperfections, whose truth is known.

Each robot is recorded as the paper's was, with noisy sensors, lost frames and motors with a lag. It is
identified from three recordings, a residual is learned on it, and both predict two other recordings.

Arms with pressure chambers are identified in equilibria: many more in the same time, by the same code.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from knode_cosserat.identification.evaluate import LEVEL, Evaluation, evaluate
from knode_cosserat.identification.fit import fit
from knode_cosserat.identification.identify import identify
from knode_cosserat.identification.imperfections import (
    END,
    TRAINING,
    Imperfect,
    drawn_robot,
    imperfect_robot,
    nominal_robot,
)
from knode_cosserat.identification.result import Identified
from knode_cosserat.recordings.load import load_recording
from knode_cosserat.recordings.measurements import DT, Measurements
from knode_cosserat.recordings.virtual import record_virtual
from knode_cosserat.rods.robot_file import load_robot
from knode_cosserat.rods.system import System
from knode_cosserat.schemes.result import SimulationError
from knode_cosserat.solvers.equilibrium import equilibria
from knode_cosserat.solvers.places import seen_positions
from studies.report import Report, markdown_table, write_report
from studies.runner import Job, Product, run

#: signals of the held-out recordings
UNSEEN = {"sine_2p0": "sine:2.0", "rand_1": "random:1"}
#: begin of the part of each recording that is used (s): rest
START = 0.5
#: most draws of a robot, and the distance of their seeds
DRAWS, APART = 5, 1000


#: an arm with pressure chambers, and places of its markers
ARM, BODIES = "three-chamber-arm", (0.5, 1.0)
#: equilibria to identify from, and as many to predict; their highest pressure and its noise (Pa), noise (m)
EQUILIBRIA, HIGHEST, PRESSURE_NOISE, POSITION_NOISE = 30, 5e4, 50.0, 3e-4


def jobs(seeds: Sequence[int], arms: bool = False) -> list[Job]:
    """Return one job for each robot."""
    work, name = (arm_facts, "arm") if arms else (robot_facts, "robot")
    return [Job(f"{name}-{seed}", work, {"seed": seed}) for seed in seeds]


def rerun(out: Path, seeds: Sequence[int], arms: bool = False, **how: Any) -> Report:
    """Run the study on these seeds, and write virtual_robots.md and .json; interrupted runs are continued.

    Args:
        out: the folder; an earlier run in it is continued.
        seeds: one for each robot.
        arms: identify arms with pressure chambers.
        how: as `runner.run` has it.
    """
    facts = list(run(jobs(seeds, arms), out, **how).values())
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


def equilibria_of(robot: System, seed: int) -> Measurements:
    """Return measured equilibria of an arm under random pressures."""
    random = np.random.default_rng(seed)
    pressures = random.uniform(0.0, HIGHEST, (EQUILIBRIA, 3))
    rows = equilibria(robot, pressures, space="lobatto4", initial="separate", with_stability=False)
    position = np.asarray(seen_positions(robot, np.asarray(rows.y), BODIES, np.asarray(rows.z)))
    return Measurements(
        time=np.arange(EQUILIBRIA, dtype=float),
        control=pressures + PRESSURE_NOISE * random.normal(size=pressures.shape),
        fractions=np.array(BODIES),
        position=position + POSITION_NOISE * random.normal(size=position.shape),
        quaternion=np.full((*position.shape[:2], 4), np.nan),
        measured=np.ones(position.shape[:2], dtype=bool),
        simulated=True,
        source=f"equilibria of arm {seed}",
        static=True,
    )


def arm_facts(settings: Any) -> Product:
    """Return the identification's result for one arm in equilibria, and its prediction of others."""
    seed = int(settings["seed"])
    nominal, usual = load_robot(ARM), np.full((1, 3), 0.5 * HIGHEST)
    truth = imperfect_robot(nominal, usual, seed, BODIES, static=True)
    given, unseen = (equilibria_of(truth.model.robot(truth.x), 100 * seed + k) for k in range(2))
    found = identify(nominal, [given])
    before, after = evaluate(nominal, unseen), evaluate(found.robot, unseen, ensemble=found.ensemble)
    facts = {
        "seed": seed,
        "true_effects": list(truth.effects),
        "true_values": dict(truth.values),
        "identified": found.to_dict(),
        "covered": _covered(truth, found),
        "unseen": {"equilibria": _outcome(before, after)},
    }
    return Product(facts, {})


def _outcome(before: Evaluation, after: Evaluation) -> dict[str, Any]:
    return {
        "nominal": before.to_dict(),
        "identified": after.to_dict(),
        "improvement": _gain(before, after),
        "band": after.band and after.band.coverage,
    }


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
        before, after = evaluate(nominal_robot(), each), evaluate(found.robot, each, ensemble=found.ensemble)
        last = evaluate(learned, each) if residual["residual"] else after
        outcomes[name] = _outcome(before, after) | {"residual": last.to_dict()}
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
    """Return the mean part by which DTW and pose MSE are less; None if a prediction failed.

    Without orientations it is that of DTW.
    """
    pairs = [(getattr(before, name), getattr(after, name)) for name in ("tip_dtw", "pose_mse")]
    parts = [1.0 - b / a for a, b in pairs if a is not None and b is not None]
    return float(np.mean(parts)) if parts else None


def _covered(truth: Imperfect, found: Identified) -> dict[str, bool]:
    """Return which intervals hold the true value, by label; without an effect this is the nominal one."""
    covered = {}
    for each in found.estimates:
        low, high = sorted(each.interval)
        covered[each.label] = bool(low <= truth.values.get(each.label, each.nominal) <= high)
    return covered


def as_markdown(facts: Sequence[Mapping[str, Any]]) -> str:
    """Return the results in Markdown: one row for each robot, and a summary."""
    rows, unseen = [], [*facts[0]["unseen"]]
    for each in facts:
        true, have = set(each["true_effects"]), set(each["identified"]["effects"])
        undecided = set(each["identified"]["undecided"])
        gains = [outcome["improvement"] for outcome in each["unseen"].values()]
        inside = list(each["covered"].values())
        angles = [outcome["identified"].get("rotation_rmse") for outcome in each["unseen"].values()]
        rows.append(
            [
                str(each["seed"]),
                *("failed" if gain is None else f"{100 * gain:.1f} %" for gain in gains),
                *("-" if angle is None else f"{np.degrees(angle):.2f}" for angle in angles),
                f"{len(true & have)} of {len(true)}",
                ", ".join(sorted(undecided & true)) or "none",
                ", ".join(sorted(true - have - undecided)) or "none",
                ", ".join(sorted(have - true)) or "none",
                f"{sum(inside)} of {len(inside)}",
                *("none" if it["band"] is None else f"{it['band']:.0%}" for it in each["unseen"].values()),
            ]
        )
    gains = [f"improvement, {name}" for name in unseen]
    angles = [f"orientations, {name} [degrees]" for name in unseen]
    heads = [
        "seed",
        *gains,
        *angles,
        "effects found",
        "of others undecided",
        "missed",
        "false",
        "in interval",
        *(f"in band, {name}" for name in unseen),
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
        f"{told['covered_right']} of {told['intervals_right']}. Missed effects {told['missed']} of "
        f"{told['true']}. Bands ({LEVEL:.0%}) hold {told['band']:.0%} of the positions that were not learned "
        f"from ({told['least_band']:.0%} to {told['most_band']:.0%}).",
    ]
    return "\n\n".join(lines) + "\n"


def summary(facts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return counts and medians over all robots."""
    gains = [outcome["improvement"] for each in facts for outcome in each["unseen"].values()]
    solved = [gain for gain in gains if gain is not None] or [np.nan]
    outcomes = [outcome for each in facts for outcome in each["unseen"].values()]
    bands = [outcome["band"] for outcome in outcomes if outcome["band"] is not None] or [np.nan]
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
        "true": sum(len(true) for _, true in found),
        "band": float(np.mean(bands)),
        "least_band": float(np.min(bands)),
        "most_band": float(np.max(bands)),
        "covered": sum(inside),
        "intervals": len(inside),
        "covered_right": sum(inside_right),
        "intervals_right": len(inside_right),
    }
