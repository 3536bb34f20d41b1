"""Learning of model errors: a nominal model and a residual form a KNODE, which is again a system."""

from knode_cosserat.learning.config import (
    ConfigError,
    FitConfig,
    FitError,
    NetworkOptions,
    RolloutTraining,
    StructuredOptions,
    Training,
)
from knode_cosserat.learning.ensemble import Ensemble, Prediction, load_ensemble
from knode_cosserat.learning.explain import explain
from knode_cosserat.learning.knode import KNODE, ModelFileError, load_model
from knode_cosserat.learning.residual import Residual
from knode_cosserat.learning.training.checkpoint import CheckpointError
from knode_cosserat.solvers.segments import DataError

__all__ = [
    "KNODE",
    "CheckpointError",
    "ConfigError",
    "DataError",
    "Ensemble",
    "FitConfig",
    "FitError",
    "ModelFileError",
    "NetworkOptions",
    "Prediction",
    "Residual",
    "RolloutTraining",
    "StructuredOptions",
    "Training",
    "explain",
    "load_ensemble",
    "load_model",
]
