"""Rates along the rod of a trajectory's rows, from y at the nodes alone; no spline spans a discontinuity."""

from __future__ import annotations

import numpy as np

from knode_cosserat.solvers.grid import ON_NODE
from knode_cosserat.solvers.settings import Settings


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
        rates, doubt = _spline_slopes(values, last)
        if settings.space.order == 2:
            rates = _trapezoidal_slopes(values, rates, last)
        slope[:, first : end + 1], wrong[:, first : end + 1] = rates, doubt
    # a node alone between discontinuities has no spline: use the slope of the segment, with a large error
    alone = [first for first, end in pieces(cuts, last + 1) if first == end]
    for node in alone:
        other = node if node < last else node - 1
        slope[:, node] = (y[:, other + 1] - beyond[:, other]) * last
        wrong[:, node] = slope[:, node]
    return slope, 0.1 * np.sqrt(np.mean(np.square(wrong), axis=(0, 1)))


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
