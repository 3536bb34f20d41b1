"""What learning costs: `python -m benchmarks.learning NAME` prints one JSON object, as `cases` does.

Compilation is apart: everything runs once before it is timed.
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.cases import DT, PAPER, STEPS, medians, one_core, seconds


def _knowledge_and_data(**wrong: Any) -> Any:
    import knode_cosserat as kc

    robot = kc.load_robot("delrin-tendon-robot")
    data = [
        kc.simulate(robot, kc.controls.sine(period, 30, DT, sampled="end"), DT, **PAPER)[:30]
        for period in (0.5, 1.0)
    ]
    return robot.replace(**wrong), data


def fits() -> dict[str, Any]:
    """A fit of each preset, with one seed and with five, on all cores."""
    import knode_cosserat as kc
    from knode_cosserat.learning.config import StructuredOptions

    knowledge, data = _knowledge_and_data(length=0.4, youngs_modulus=10e9)
    seeds = tuple(range(5))
    resampled = StructuredOptions(resample=True)
    presets = {
        "paper": (kc.FitConfig.paper(0), kc.FitConfig.paper(seeds)),
        "best": (kc.FitConfig(resampled, seed=0), kc.FitConfig(resampled, seed=seeds)),
    }
    found = {}
    for name, (one, five) in presets.items():
        times = medians(
            {
                "one": lambda one=one: kc.fit(knowledge, data, one),
                "five": lambda five=five: kc.fit(knowledge, data, five),
            },
            rounds=3,
        )
        found[name] = {**times, "ratio": times["five"] / times["one"]}
    return found


def learned_steps() -> dict[str, Any]:
    """A step of the physics alone, with the paper's network, and with the best residual; on one core."""
    one_core()
    import knode_cosserat as kc

    tensions = kc.controls.sine(1.5, STEPS, DT, sampled="end")
    wrong = {
        "self-weight": {"gravity": (0.0, 0.0, 0.0)},
        "length": {"length": 0.4},
        "stiffness": {"youngs_modulus": 10e9},
        "length-stiffness": {"length": 0.4, "youngs_modulus": 10e9},
    }
    knowledge, data = _knowledge_and_data()
    models = {"physics": knowledge}
    for name, change in wrong.items():
        models[name] = kc.fit(knowledge.replace(**change), data)
    models["paper"] = kc.fit(knowledge.replace(**wrong["stiffness"]), data, kc.FitConfig.paper(0))
    times = medians(
        {
            name: lambda model=model: kc.simulate(model, tensions, DT, **PAPER)
            for name, model in models.items()
        },
        rounds=15,
        repeats=10,
    )
    return {name: taken / STEPS for name, taken in times.items()}


def study() -> dict[str, Any]:
    """The whole simulation study, from nothing compiled to table and figures."""
    from studies.methods import METHODS
    from studies.simulation import rerun

    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        taken = seconds(lambda: rerun(out, seeds=range(5), methods=list(METHODS)))
        rows = json.loads((out / "table1.json").read_text())
    return {"seconds": taken, "rows": len(rows)}


CASES = {case.__name__: case for case in (fits, learned_steps, study)}

if __name__ == "__main__":
    print(json.dumps(CASES[sys.argv[1]]()))
