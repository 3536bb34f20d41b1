"""Result of the study of cables."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from studies.cables.model import CableModel, CableParameters
from studies.cables.recordings import CableData


class CableResult(NamedTuple):
    """Parameters and predictions of one cable."""

    data: CableData
    model: CableModel
    parameters: CableParameters
    cells: list[dict[str, Any]]
    predictions: dict[str, dict[str, Float[np.ndarray, "T M 3"]]]
    notes: list[str]
