"""Discontinuities at nodes: the state on the far side, and the slopes on both sides.

A trajectory holds y on the near side of a discontinuity and z on the far side. Predictions and regressions
use the segment that starts at a node, and therefore need y and its slope on the far side.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.system import System
from knode_cosserat.solvers import semi_discrete
from knode_cosserat.solvers.grid import ON_NODE, grid_of
from knode_cosserat.solvers.semi_discrete import unpacked_history
from knode_cosserat.solvers.settings import Settings


def far_side(
    knowledge: System, t: Float[Any, " T"], c0: Float[Any, " T"], y: Float[Any, "T N y"],
    control: Float[Any, "T c"], history: Float[Any, "T N x"],
) -> Float[Any, "T N y"]:  # fmt: skip
    """Return y at all nodes, on the far side of the nominal model's discontinuities."""
    if not (knowledge.cuts and knowledge.jump):
        return y
    # the discontinuities at the exact start of each segment
    grid = grid_of(knowledge)
    acting = grid.acting[grid.nodes[:-1]]
    jumping = np.flatnonzero(acting.any(axis=1))
    if not len(jumping):
        return y
    beyond = y.copy()
    beyond[:, jumping] = _jump(knowledge, acting[jumping], t, c0, y[:, jumping], control, history[:, jumping])
    return beyond


@jax.jit
def _jump(knowledge, acting, t, c0, y, control, history):  # type: ignore[no-untyped-def]
    def at_node(acting: Any, t: Any, c0: Any, y: Any, control: Any, record: Any) -> Any:
        return semi_discrete.jump(knowledge, acting, t, y, control, unpacked_history(knowledge, c0, record))

    at_row = jax.vmap(at_node, in_axes=(0, None, None, 0, None, 0))
    return jax.vmap(at_row, in_axes=(None, 0, 0, 0, 0, 0))(
        jnp.asarray(acting), *map(jnp.asarray, (t, c0, y, control, history))
    )


def slopes_of(
    settings: Settings, y: np.ndarray, beyond: np.ndarray | None = None, cuts: tuple[float, ...] = ()
) -> tuple[np.ndarray, np.ndarray]:
    """Return y_s times the length (T, N, y), from the states alone, and its estimated error (y,).

    Exact if a segment is one Euler step. Otherwise from splines; the error estimate is the difference from
    splines of the next lower order. For the trapezoidal rule the slopes are the nearest ones to the splines'
    whose means equal the changes over segments. No spline spans a discontinuity: with `beyond` (y on the far
    side), slopes at discontinuities are those on the far side.
    """
    last = y.shape[1] - 1
    beyond = y if beyond is None else beyond
    if settings.space.order == 1:
        forward = (y[:, 1:] - beyond[:, :-1]) * last
        return np.concatenate([forward, forward[:, -1:]], axis=1), np.zeros(y.shape[-1])
    slope, wrong = np.zeros_like(y), np.zeros_like(y)
    for first, end in pieces(cuts, last + 1):
        values = y[:, first : end + 1].copy()
        values[:, 0] = beyond[:, first]
        own, doubt = _spline_slopes(values, last)
        if settings.space.order == 2:
            own = _trapezoidal_slopes(values, own, last)
        slope[:, first : end + 1], wrong[:, first : end + 1] = own, doubt
    # a node alone between discontinuities has no spline: use the slope of the segment, with a large error
    alone = [first for first, end in pieces(cuts, last + 1) if first == end]
    for node in alone:
        other = node if node < last else node - 1
        slope[:, node] = (y[:, other + 1] - beyond[:, other]) * last
        wrong[:, node] = slope[:, node]
    return slope, 0.1 * np.sqrt(np.mean(np.square(wrong), axis=(0, 1)))


def whole(knowledge: System, place: Float[Any, " S"]) -> Float[np.ndarray, " S"]:
    """Return 1 for each segment (by its start, a part of the length) without inner discontinuity, else 0."""
    if not knowledge.cuts:
        return np.ones(len(place))
    grid = grid_of(knowledge)
    segment = np.round(np.asarray(place) * (knowledge.nodes - 1)).astype(int)
    return (grid.bounds[grid.nodes[segment], 1] == 1.0).astype(float)


def pieces(cuts: tuple[float, ...], nodes: int) -> list[tuple[int, int]]:
    """Return the first and last node of each smooth stretch; neighbours share a node on a discontinuity."""
    along = np.asarray(cuts) * (nodes - 1)
    nearest = np.round(along)
    is_node = np.abs(nearest - along) < ON_NODE * (nodes - 1)
    on_node = set(nearest[is_node].astype(int).tolist())
    between = set(np.floor(along[~is_node]).astype(int).tolist())
    found: list[tuple[int, int]] = []
    first = 0
    for node in range(nodes - 1):
        if node in between:
            found.append((first, node))
            first = node + 1
        elif node + 1 in on_node and node + 1 < nodes - 1:
            found.append((first, node + 1))
            first = node + 1
    return [*found, (first, nodes - 1)]


def _trapezoidal_slopes(values: np.ndarray, near: np.ndarray, last: int) -> np.ndarray:
    """Return the slopes nearest to `near` whose means over segments equal the changes of values."""
    if values.shape[1] < 3:
        return near
    signs = (-1.0) ** np.arange(values.shape[1])[:, None]
    change = np.diff(values, axis=1) * last
    steps = np.cumsum(2.0 * change * signs[1:], axis=1)
    found = signs * np.concatenate([np.zeros_like(steps[:, :1]), steps], axis=1)
    # the alternating component is free
    return found + signs * np.mean(signs * (near - found), axis=1, keepdims=True)


def _spline_slopes(values: np.ndarray, last: int) -> tuple[np.ndarray, np.ndarray]:
    """Return spline slopes of one smooth stretch, and their difference from the next lower order."""
    # imported here: it takes a third of a second
    from scipy.interpolate import make_interp_spline

    count = values.shape[1]
    if count == 1:
        return np.zeros_like(values), np.zeros_like(values)
    place = np.arange(count) / last
    orders = min(7, count - 1), min(5, count - 2)
    high, low = (
        make_interp_spline(place, values, k=order, axis=1).derivative()(place)
        if order > 0
        else np.zeros_like(values)
        for order in orders
    )
    return high, high - low
