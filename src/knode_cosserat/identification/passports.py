"""Passports of models that were learned from recordings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from knode_cosserat.estimation.parameters import ParameterModel
from knode_cosserat.identification.experiments import Experiment, experiments_of, names_of
from knode_cosserat.identification.trials import motions_of
from knode_cosserat.learning.origins import origin_of
from knode_cosserat.recordings.measurements import Measurements
from knode_cosserat.rods.passport import Origin, Passport
from knode_cosserat.rods.system import System
from knode_cosserat.schemes.space import SpaceScheme
from knode_cosserat.trajectory import Trajectory


def passport_of(
    command: str,
    model: System,
    rows: Sequence[Measurements | Trajectory | Experiment],
    space: str | SpaceScheme,
    held_out_error: Mapping[str, float | None],
    unseen: Sequence[Origin] = (),
) -> Passport:
    """Return the passport of a model. Its range of strains is that of its own motion under the controls.

    Args:
        command: function that made it.
        model: the model.
        rows: what it was learned from.
        space: the scheme along the rod, of its motions.
        held_out_error: errors (m) by the name of a recording, or of a part of it, that was held out in turn.
        unseen: what was held out altogether.
    """
    names = iter(names_of([it for it in rows if isinstance(it, Measurements)]))
    origins = []
    for k, it in enumerate(rows):
        name = next(names) if isinstance(it, Measurements) else getattr(it, "name", f"trajectory {k}")
        errors = [
            error for key, error in held_out_error.items() if key == name or key.startswith(f"{name}, part ")
        ]
        known = [error for error in errors if error is not None]
        error = float(np.sqrt(np.mean(np.square(known)))) if known and len(known) == len(errors) else None
        origins.append(origin_of(it, name, held_out_error=error))
    parameters = ParameterModel(model, ())
    # one by one: experiments of several recordings are made equally long
    experiments = [one for it in rows for one in experiments_of([it], parameters, space)]
    return Passport.of(command, [*origins, *unseen], model, motions_of(model, experiments, space))
