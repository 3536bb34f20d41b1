"""Learning of model errors: a nominal model and a residual form a KNODE, which is again a system."""

from typing import TYPE_CHECKING

from knode_cosserat._lazy import make_lazy

if TYPE_CHECKING:
    from knode_cosserat.identification.fit import fit
    from knode_cosserat.learning.config import (
        ConfigError,
        FitConfig,
        NetworkOptions,
        PassiveOptions,
        RolloutTraining,
        StructuredOptions,
        Training,
    )
    from knode_cosserat.learning.ensemble import Ensemble, Prediction, load_ensemble
    from knode_cosserat.learning.explain import explain
    from knode_cosserat.learning.knode import KNODE, ModelFileError, load_model
    from knode_cosserat.learning.residual import Residual
    from knode_cosserat.learning.training.checkpoint import CheckpointError
    from knode_cosserat.learning.training.runs import FitError
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
    "PassiveOptions",
    "Prediction",
    "Residual",
    "RolloutTraining",
    "StructuredOptions",
    "Training",
    "explain",
    "fit",
    "load_ensemble",
    "load_model",
]

# `fit` also identifies, and the package `identification` needs this one
make_lazy(
    __name__,
    {
        "knode_cosserat.identification.fit": "fit",
        "knode_cosserat.learning.config": (
            "ConfigError FitConfig NetworkOptions PassiveOptions RolloutTraining StructuredOptions Training"
        ),
        "knode_cosserat.learning.ensemble": "Ensemble Prediction load_ensemble",
        "knode_cosserat.learning.explain": "explain",
        "knode_cosserat.learning.knode": "KNODE ModelFileError load_model",
        "knode_cosserat.learning.residual": "Residual",
        "knode_cosserat.solvers.segments": "DataError",
        "knode_cosserat.learning.training.checkpoint": "CheckpointError",
        "knode_cosserat.learning.training.runs": "FitError",
    },
)
