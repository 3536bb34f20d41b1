"""Study of data efficiency: the cells of the paper's table from 5 to 30 rows, of one sine and of two.

Methods with a nominal model are the best preset and the paper's. Methods without one are networks of the same
size and linear prediction. The latter do not depend on the imperfection and have the same result for each.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from knode_cosserat import controls
from knode_cosserat.learning.config import FitConfig
from knode_cosserat.learning.fit import fit
from knode_cosserat.learning.training.runs import FitError
from knode_cosserat.rods.robot_file import load_robot
from knode_cosserat.rods.system import System
from knode_cosserat.solvers.result import SimulationError
from knode_cosserat.solvers.simulate import simulate
from knode_cosserat.trajectory import Trajectory
from studies import simulation
from studies.comparisons import NoKnowledge, compared, linear_predictor
from studies.methods import METHODS, LearnedSystems
from studies.runner import Job, Product

#: training rows of each sine, including the state at rest
ROWS = (5, 10, 20, 30)
#: the first sine alone, and both
SINES = (1, 2)
SEEDS = 3


def paper_alone(imperfect: System, training: Sequence[Trajectory], seeds: Sequence[int]) -> LearnedSystems:
    """Return the paper's network, trained on a system without physics."""
    return _without_knowledge(imperfect, training, FitConfig.paper(seed=tuple(seeds)))


def network_alone(imperfect: System, training: Sequence[Trajectory], seeds: Sequence[int]) -> LearnedSystems:
    """Return a standardised, unconstrained network of the paper's size, on a system without physics."""
    return _without_knowledge(imperfect, training, FitConfig.network(seed=tuple(seeds), hidden=512))


def _without_knowledge(
    imperfect: System, training: Sequence[Trajectory], config: FitConfig
) -> LearnedSystems:
    try:
        models = fit(NoKnowledge(imperfect), training, config)
    except FitError as error:
        return LearnedSystems(dict.fromkeys(config.seeds, str(error)))
    return LearnedSystems(dict(zip(config.seeds, models, strict=True)))


Method = Callable[[System, Sequence[Trajectory], Sequence[int]], LearnedSystems]
INFORMED: dict[str, Method] = {name: METHODS[name] for name in ("baseline", "paper", "best")}
ALONE: dict[str, Method] = {"paper, no knowledge": paper_alone, "network, no knowledge": network_alone}
LINEAR = "linear (DMDc)"
#: all methods by name, in the order of the tables
ALL = (*INFORMED, *ALONE, LINEAR)
#: name for all imperfections, in cells of methods without a nominal model
ANY = "any"


def jobs(seeds: Sequence[int], rows: Sequence[int] = ROWS, methods: Sequence[str] | None = None) -> list[Job]:
    """Return one job for each method, amount of data and, with a nominal model, imperfection.

    Args:
        seeds: seeds of the fits; the baseline and the linear prediction need none.
        rows: training rows of each sine.
        methods: some of `ALL`; all by default.

    Raises:
        ValueError: a method is unknown.
    """
    made = []
    for method in methods or ALL:
        if method not in ALL:
            raise ValueError(f"method {method!r} is unknown; allowed is some of {', '.join(ALL)}")
        imperfections = simulation.IMPERFECTIONS if method in INFORMED else {ANY: {}}
        amounts = [(sines, count) for sines in SINES for count in rows] if method != "baseline" else [(0, 0)]
        made += [
            _job(method, imperfection, changes, amount, seeds)
            for imperfection, changes in imperfections.items()
            for amount in amounts
        ]
    return made


def _job(method: str, imperfection: str, changes: Any, amount: tuple[int, int], seeds: Sequence[int]) -> Job:
    sines, rows = amount
    words = "".join(letter if letter.isalnum() else " " for letter in f"{method} {imperfection}").split()
    settings = {
        "robot": simulation.ROBOT, "dt": simulation.DT, "steps": simulation.ROWS,
        "controls": simulation.CONTROLS, "training": list(simulation.TRAINING[:sines]), "rows": rows,
        "method": method, "imperfection": imperfection, "changes": changes, "seeds": list(seeds),
    }  # fmt: skip
    return Job("-".join([*words, f"{sines}x{rows}"]), predict, settings)


# the work


def predict(settings: Any) -> Product:
    """Return the cells of one method, imperfection and amount of data, under every control."""
    robot, dt, steps = load_robot(settings["robot"]), settings["dt"], settings["steps"]
    amount = {"sines": len(settings["training"]), "rows": settings["rows"]}
    training = [_moved(robot, control, settings["rows"], dt) for control in settings["training"]]
    truths = {name: _moved(robot, control, steps, dt) for name, control in settings["controls"].items()}
    cells = []
    for seed, predictor in _predictors(robot.replace(**settings["changes"]), training, settings).items():
        for name, truth in truths.items():
            of = {"imperfection": settings["imperfection"], "control": name, "method": settings["method"]}
            outcome = compared(predictor(settings["controls"][name]), truth)
            cells.append({**of, "seed": seed, **amount, **outcome})
    return Product({"cells": cells}, {})


Predictor = Callable[[str], Any]


def _predictors(imperfect: System, training: Sequence[Trajectory], settings: Any) -> dict[int, Predictor]:
    """Return for each seed a predictor under a control, or the reason why there is none."""
    dt, steps, method = settings["dt"], settings["steps"], settings["method"]
    if method == LINEAR:
        linear = linear_predictor(imperfect, training)
        return {0: lambda control: linear(controls.parse(control, steps, dt, sampled="end"))}
    learned = {**INFORMED, **ALONE}[method](imperfect, training, settings["seeds"])

    def predictor(system: System | str) -> Predictor:
        def predict(control: str) -> Any:
            if isinstance(system, str):
                return system
            try:
                return _moved(system, control, steps, dt)
            except SimulationError as error:
                return str(error)

        return predict

    return {seed: predictor(system) for seed, system in learned.systems.items()}


def _moved(system: System, control: str, rows: int, dt: float) -> Trajectory:
    """Return the first rows of a simulation from rest: as many as controls, as in the paper."""
    tensions = controls.parse(control, rows, dt, sampled="end")
    return simulate(system, tensions, dt, time="bdf2", start="paper", space="euler")[:rows]
