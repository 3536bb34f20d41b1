"""Predictions of a model over a horizon, linearised by the plan and by the state's uncertain directions."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.estimation.online import Belief, OnlineModel, errors_along, split_record
from knode_cosserat.estimation.outputs import Output
from knode_cosserat.rods.system import System


class Prediction(NamedTuple):
    """Outputs of a predicted motion and their derivatives."""

    #: error of the tracked output from the reference
    error: Float[Any, "T e"]
    by_plan: Float[Any, "n T e"]
    by_state: Float[Any, "m T e"]
    #: constrained outputs
    limited: Float[Any, "T q"]
    limited_by_plan: Float[Any, "n T q"]
    limited_by_state: Float[Any, "m T q"]
    #: positions of the tip (m)
    path: Float[Any, "T 3"]
    solved: Any

    def of_plan(self, count: int) -> Prediction:
        """Return the prediction with the derivatives by the first numbers of the plan only."""
        return self._replace(by_plan=self.by_plan[:count], limited_by_plan=self.limited_by_plan[:count])


def linearised_prediction(
    model: OnlineModel, belief: Belief, plan: Float[Any, "knots c"], basis: Float[Any, "T knots"],
    reference: Float[Any, "T p"], target: Output, limited: tuple[Output, ...],
) -> Prediction:  # fmt: skip
    """Return the prediction of a plan, whose controls are `basis` times `plan`, from an estimated state."""
    (count, c), (steps, m) = plan.shape, (len(basis), len(belief.spread.records))
    of_plan = np.einsum("tk,ij->kjti", basis, np.eye(c)).reshape(count * c, steps, c)

    def extended(part: Any) -> Any:
        return np.concatenate([np.zeros((count * c, *part.shape[1:])), part])

    wide = jax.tree.map(extended, belief.spread)
    d_controls = np.concatenate([of_plan, np.zeros((m, steps, c))])
    system, found = model.rollout(belief._replace(spread=wide), basis @ plan, d_controls)
    outputs = _outputs(system, found.records, found.d_records, reference, target, limited)
    error, slopes, value, slope, path = map(np.asarray, outputs)
    n = count * c
    return Prediction(error, slopes[:n], slopes[n:], value, slope[:n], slope[n:], path, found.solved)


@functools.partial(jax.jit, static_argnames=("target", "limited"))
def _outputs(
    system: System, records: Any, d_records: Any, reference: Any, target: Output, limited: tuple[Output, ...]
) -> Any:
    """Return errors of the target and the limited outputs, with their tangents, and the tip's path."""
    steps, columns = len(records), d_records.shape[-1]
    error, slopes = errors_along(system, target, records, d_records, reference)
    values, moved = [jnp.zeros((steps, 0))], [jnp.zeros((columns, steps, 0))]
    for output in limited:
        zero = jnp.zeros((steps, output.size))
        value, slope = errors_along(system, output, records, d_records, zero)
        values.append(value)
        moved.append(slope)
    path = system.drawing.positions(split_record(system, records[:, -1])[0])
    return error, slopes, jnp.concatenate(values, axis=-1), jnp.concatenate(moved, axis=-1), path
