"""Errors of estimated states, quantity by quantity."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from knode_cosserat.trajectory import Trajectory

#: tolerance of equal times (s) and of equal places along the rod (fraction of its length)
_SAME = 1e-6


class StateError(NamedTuple):
    """Error of one quantity: root mean square over rows and nodes of a vector's length.

    Attributes:
        rms: root mean square of the error.
        size: root mean square of the true quantity; for an orientation, of its angle from upright.
        unit: unit of both.
    """

    rms: float
    size: float
    unit: str


def state_errors(
    estimate: Trajectory, truth: Trajectory, start: float | None = None
) -> dict[str, StateError]:
    """Return the errors of all fields that estimate and truth share in y and z; h's error is an angle.

    Args:
        estimate: estimated states of one robot.
        truth: true states; they may have more rows and more nodes.
        start: rows before this time are left out (s).

    Raises:
        ValueError: the truth has no row at a time of the estimate, or no node at a place.
    """
    for name, it in (("estimate", estimate), ("truth", truth)):
        if not isinstance(it, Trajectory):
            raise ValueError(f"the {name} is a {type(it).__name__}; allowed is a Trajectory")
        if np.ndim(it.y) != 3:
            raise ValueError(f"the {name} is a batch of {len(it.y)}; allowed is one robot")
    time = np.asarray(estimate.time)
    mine = np.flatnonzero(time >= (-np.inf if start is None else start) - _SAME)
    rows = _matching(time[mine], np.asarray(truth.time), "row", "s")
    nodes = _matching(
        np.linspace(0.0, 1.0, np.shape(estimate.y)[1]),
        np.linspace(0.0, 1.0, np.shape(truth.y)[1]),
        "node",
        "of its length",
    )
    errors = {}
    for name, unit in _shared(estimate, truth):
        found = np.asarray(estimate.part(name), dtype=float)[mine]
        true = np.asarray(truth.part(name), dtype=float)[np.ix_(rows, nodes)]
        if name == "h":
            upright = np.broadcast_to([1.0, 0.0, 0.0, 0.0], true.shape)
            errors[name] = StateError(_rms(_angle(found, true)), _rms(_angle(true, upright)), "rad")
        else:
            errors[name] = StateError(_rms(_length(found - true)), _rms(_length(true)), unit)
    return errors


def _shared(estimate: Trajectory, truth: Trajectory) -> Iterable[tuple[str, str]]:
    for part in ("y_layout", "z_layout"):
        mine, other = getattr(estimate.system, part), getattr(truth.system, part)
        for field in mine.fields:
            if (
                field.name in other.names
                and other.slice(field.name).stop - other.slice(field.name).start == field.size
            ):
                yield field.name, field.unit


def _matching(
    wanted: Float[np.ndarray, " a"], there: Float[np.ndarray, " b"], what: str, unit: str
) -> Int[np.ndarray, " a"]:
    nearest = (
        np.abs(there[None, :] - wanted[:, None]).argmin(axis=1) if len(wanted) else np.zeros(0, dtype=int)
    )
    far = np.abs(there[nearest] - wanted) > _SAME
    if len(wanted) == 0 or far.any():
        missing = f" at {wanted[np.argmax(far)]:g} {unit}" if len(wanted) else " to compare"
        raise ValueError(f"the truth has no {what}{missing}; required is one for each of the estimate's")
    return np.asarray(nearest)


def _length(vectors: Float[np.ndarray, "T N size"]) -> Any:
    return np.linalg.norm(vectors, axis=-1)


def _angle(a: Float[np.ndarray, "T N 4"], b: Float[np.ndarray, "T N 4"]) -> Any:
    """Return the angle (rad) between orientations, accurate also for small angles."""
    a, b = a / np.linalg.norm(a, axis=-1, keepdims=True), b / np.linalg.norm(b, axis=-1, keepdims=True)
    b = np.where(np.sum(a * b, axis=-1, keepdims=True) < 0.0, -b, b)
    return 4.0 * np.arcsin(np.clip(np.linalg.norm(a - b, axis=-1) / 2.0, 0.0, 1.0))


def _rms(values: Any) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
