"""Identification of real robots: a library of effects, selected by recordings that were not searched."""

from knode_cosserat.estimation.parameters import Number, PossibleEffect, numbers_at
from knode_cosserat.identification.effects import effects_of, register
from knode_cosserat.identification.evaluate import (
    Comparison,
    Evaluation,
    SeveralEquilibria,
    evaluate,
    predict,
)
from knode_cosserat.identification.experiments import Experiment
from knode_cosserat.identification.fit import fit
from knode_cosserat.identification.identify import identify
from knode_cosserat.identification.result import Estimate, IdentificationError, Identified

__all__ = [
    "Comparison",
    "Estimate",
    "Evaluation",
    "Experiment",
    "IdentificationError",
    "Identified",
    "Number",
    "PossibleEffect",
    "SeveralEquilibria",
    "effects_of",
    "evaluate",
    "fit",
    "identify",
    "numbers_at",
    "predict",
    "register",
]
