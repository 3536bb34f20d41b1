"""Identification of real robots: a library of effects, selected by recordings that were not searched."""

from knode_cosserat.estimation.parameters import Effect, Number
from knode_cosserat.identification.effects import effects_of, register
from knode_cosserat.identification.evaluate import Evaluation, evaluate, predict
from knode_cosserat.identification.experiments import Experiment
from knode_cosserat.identification.fit import fit
from knode_cosserat.identification.identify import identify
from knode_cosserat.identification.result import Estimate, IdentificationError, Identified

__all__ = [
    "Effect",
    "Estimate",
    "Evaluation",
    "Experiment",
    "IdentificationError",
    "Identified",
    "Number",
    "effects_of",
    "evaluate",
    "fit",
    "identify",
    "predict",
    "register",
]
