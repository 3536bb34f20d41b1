"""Methods of the studies for an imperfect model and trajectories: none, calibration, or learning."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from knode_cosserat.identification import IdentificationError, identify
from knode_cosserat.learning.config import FitConfig, FitError, StructuredOptions
from knode_cosserat.learning.states import fit_states
from knode_cosserat.rods.system import System
from knode_cosserat.trajectory import Trajectory

Trajectories = Sequence[Trajectory]


@dataclasses.dataclass(frozen=True)
class LearnedSystems:
    """System for each seed, or the reason of its failure, and facts on the fit (plain JSON values)."""

    systems: dict[int, System | str]
    #: the loss of every epoch, where there are epochs
    loss: dict[str, list[float]] = dataclasses.field(default_factory=dict)
    found: dict[str, Any] = dataclasses.field(default_factory=dict)


def baseline(imperfect: System, training: Trajectories, seeds: Sequence[int]) -> LearnedSystems:
    """Return the imperfect model unchanged."""
    return LearnedSystems({0: imperfect})


def calibrated(imperfect: System, training: Trajectories, seeds: Sequence[int]) -> LearnedSystems:
    """Return the imperfect model with calibrated parameters, without a residual."""
    try:
        result = identify(imperfect, training, parameters="all")
    except IdentificationError as error:
        return LearnedSystems({0: str(error)})
    found = {it.label: {"before": it.nominal, "estimate": it.value} for it in result.estimates}
    return LearnedSystems(
        {0: result.robot}, found={**found, "undetermined": [str(name) for name in result.undetermined]}
    )


def paper(imperfect: System, training: Trajectories, seeds: Sequence[int]) -> LearnedSystems:
    """Return the paper's network after the paper's training."""
    return fitted(imperfect, training, FitConfig.paper(seed=tuple(seeds)))


def best(imperfect: System, training: Trajectories, seeds: Sequence[int]) -> LearnedSystems:
    """Return the best training configuration's model; seeds resample the rows, since the fit has none."""
    return fitted(imperfect, training, FitConfig(StructuredOptions(resample=True), seed=tuple(seeds)))


def fitted(imperfect: System, training: Trajectories, config: FitConfig) -> LearnedSystems:
    """Return the models of a configuration, one for each of its seeds."""
    try:
        models = fit_states(imperfect, training, config)
    except FitError as error:
        return LearnedSystems(dict.fromkeys(config.seeds, str(error)))
    histories = {str(model.about.facts["seed"]): model.about.facts.get("segments") for model in models}
    losses = {seed: np.asarray(it["loss"]).tolist() for seed, it in histories.items() if it}
    return LearnedSystems(dict(zip(config.seeds, models, strict=True)), losses)


Method = Callable[[System, Trajectories, Sequence[int]], LearnedSystems]
#: methods by name, in the order of the table
METHODS: dict[str, Method] = {method.__name__: method for method in (baseline, paper, calibrated, best)}
