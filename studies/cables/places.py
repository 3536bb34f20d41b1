"""Places of markers along and beside a cable, from shapes alone.

A marker beside the centreline is nearer to its neighbours where the cable bends towards it. The distance
along a curve through the markers is therefore a linear function of the turning between them:

    distance = length + o₂ ∫u₁ ds - o₁ ∫u₂ ds

with o the offset and u the curvature in a frame without twist. Least squares over many frames give the true
length of each piece, and the offset.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from studies.cables import frames
from studies.cables.model import CableModel, CableParameters, Grips
from studies.cables.shapes import CableGrid, Fitter

#: points of a piece at which its turning is summed
POINTS = 8
#: lengths further than this from the median (m) are left out: a marker was lost or swapped
OUTLIER = 0.015
#: frames that are looked at, of each motion
FRAMES = 10
#: tolerance of tangents (rad) in the search for the grips' directions
LOOSE = 1.0


class MarkerPlaces(NamedTuple):
    """Places along the cable (m, from marker 1 on), and beside it (m, in the frame of the base)."""

    along: Float[np.ndarray, " M"]
    offset: Float[np.ndarray, "2"]


def marker_places(motions: Sequence[Float[np.ndarray, "T N 3"]], grips: Grips) -> MarkerPlaces:
    """Return the places of the markers from some frames of each motion."""
    model = CableModel(np.arange(2.0), grips)
    lengths, turnings = [], []
    for markers in motions:
        base, _ = model.end_frames(CableParameters(), markers)
        for k in _some(len(markers)):
            length, turning = _pieces(markers[k], base[k])
            lengths.append(length)
            turnings.append(turning)
    length, turning = np.array(lengths), np.array(turnings)
    pieces, offsets = [], []
    for k in range(length.shape[1]):
        near = np.abs(length[:, k] - np.median(length[:, k])) < OUTLIER
        matrix = np.concatenate([np.ones((int(near.sum()), 1)), turning[near, k]], axis=1)
        found = np.linalg.lstsq(matrix, length[near, k], rcond=None)[0]
        pieces.append(found[0])
        offsets.append([-found[2], found[1]])
    return MarkerPlaces(np.concatenate([[0.0], np.cumsum(pieces)]), np.median(offsets, axis=0))


def grip_tangents(
    model: CableModel, p: CableParameters, motions: Sequence[Float[np.ndarray, "T N 3"]]
) -> CableParameters:
    """Return the parameters with tangents in the grips as shapes with loosely held ends have them."""
    fitter = Fitter(CableGrid(model.places * p.stretch, 2 * (model.nodes - 1)), LOOSE)
    offset = np.array([*p.offset, 0.0])
    off: list[list[Any]] = [[], []]
    for markers in motions:
        ends = model.end_frames(p, markers)
        for k in _some(len(markers)):
            first, last = ends[0][k], ends[1][k]
            points = fitter.shape(markers[k, 1:-1], (first, last), offset).points
            edges = np.diff(points, axis=0)
            directions = 1.5 * edges[0] - 0.5 * edges[1], 1.5 * edges[-1] - 0.5 * edges[-2]
            for found, frame, direction in zip(off, (first, last), directions, strict=True):
                x, y, _ = frames.rotated(frames.conjugate(frame), frames.unit(direction))
                found.append([-y, x])
    base, tip = (np.median(each, axis=0) for each in off)
    return p.replace(
        base_tangent=tuple(np.add(p.base_tangent, base).tolist()),
        tip_tangent=tuple(np.add(p.tip_tangent, tip).tolist()),
    )


def _some(count: int) -> Any:
    return np.unique(np.linspace(0, count - 1, FRAMES).astype(int))


def _pieces(markers: Any, base: Any) -> tuple[Any, Any]:
    """Lengths of the pieces of a spline through the free cable's markers, and their turning (pieces, 2)."""
    from scipy.interpolate import CubicSpline

    points = markers[1:-1]
    slopes = frames.unit(markers[[1, -1]] - markers[[0, -2]])
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
    nodes, weights = np.polynomial.legendre.leggauss(6)
    for _ in range(3):
        along = np.concatenate([[0.0], np.cumsum(lengths)])
        spline = CubicSpline(along, points, bc_type=((1, slopes[0]), (1, slopes[1])))
        at = along[:-1, None] + np.diff(along)[:, None] * (nodes + 1.0) / 2.0
        lengths = np.linalg.norm(spline(at, 1), axis=-1) @ weights * np.diff(along) / 2.0
    fine = np.concatenate([np.linspace(a, b, POINTS, endpoint=False) for a, b in itertools.pairwise(along)])
    directions = frames.unit(spline(np.append(fine, along[-1]), 1))
    edges = frames.along_curve(directions[:-1], base, base)
    edges[0] = base
    for k in range(1, len(edges)):  # without the twist that would meet an end
        edges[k] = frames.quaternion_product(frames.shortest(directions[k - 1], directions[k]), edges[k - 1])
    change = frames.rotated(frames.conjugate(edges), np.diff(directions, axis=0))
    turning = np.stack([-change[:, 1], change[:, 0]], axis=1).reshape(-1, POINTS, 2).sum(axis=1)
    return lengths, turning
