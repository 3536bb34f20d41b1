"""Shape and motion of a rod from its curvature: fields along s, integrated from the clamped base.

With u(s, t) in the material frame and a constant stretch λ of the centreline,

    R_s = R û,    p_s = λ R e₃,

and in the global frame, with θ a small rotation, variations and velocities are integrals from the base:

    δθ(s) = ∫ R δu dσ                        δp(s) = ∫ δθ × p_s dσ
    ω = ∫ R u_t dσ                           p_t  = ∫ ω × p_s dσ
    ω_t = ∫ R u_tt + ω × R u_t dσ            p_tt = ∫ ω_t × p_s + ω × (ω × p_s) dσ

The curvature about every axis is a sum of cosines, cos(kπ s/L). The first axis of all arrays is the frame.
"""

from __future__ import annotations

import dataclasses
import itertools
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

#: numbers of cosines for the curvature about x, about y, and for the twist
MODES = (9, 9, 3)
#: the longest segment of the grid, as a fraction of the length
FINEST = 1.0 / 27.0
_GAUSS = 0.5 / np.sqrt(3.0)


@dataclasses.dataclass(frozen=True, eq=False)
class RodGeometry:
    """Grid along a rod that contains its nodes and bodies, and the curvature's basis.

    Points alternate between ends and middles of segments, from base to tip.

    Attributes:
        length: length (m).
        s: arclength of the points (m).
        nodes: indices of the points at the model's nodes.
        bodies: indices of the points at the bodies.
        basis: the curvature's basis at the points, modes of all axes in sequence; zero for other axes.
        gauss: the basis at the two Gauss points of every half segment.
        base: orientation at the base, scalar first.
        origin: position of the base (m).
    """

    length: float
    s: Float[np.ndarray, " P"]
    nodes: Int[np.ndarray, " N"]
    bodies: Int[np.ndarray, " M"]
    basis: Float[np.ndarray, "P 3 K"]
    gauss: Float[np.ndarray, "H 2 3 K"]
    base: Float[np.ndarray, " 4"]
    origin: Float[np.ndarray, " 3"]

    @property
    def modes(self) -> int:
        """Number of coefficients of the curvature at one time."""
        return self.basis.shape[-1]

    @classmethod
    def of(
        cls,
        length: float,
        nodes: int,
        fractions: Float[np.ndarray, " M"],
        base: Float[np.ndarray, " 4"],
        origin: Float[np.ndarray, " 3"],
    ) -> RodGeometry:
        """Return the grid of a rod from its length (m), its number of nodes and its bodies' fractions."""
        fixed = np.unique(np.round(np.concatenate([np.linspace(0.0, 1.0, nodes), fractions]), 9))
        ends = [np.zeros(1)]
        for first, last in itertools.pairwise(fixed):
            pieces = max(1, int(np.ceil((last - first) / FINEST - 1e-6)))
            ends.append(np.linspace(first, last, pieces + 1)[1:])
        joined = np.concatenate(ends)
        points = np.empty(2 * len(joined) - 1)
        points[::2], points[1::2] = joined, (joined[1:] + joined[:-1]) / 2
        middle, half = (points[1:] + points[:-1]) / 2, np.diff(points)
        gauss = np.stack([middle - _GAUSS * half, middle + _GAUSS * half], axis=1)

        def nearest(places: np.ndarray) -> np.ndarray:
            return 2 * np.argmin(np.abs(joined - np.asarray(places)[:, None]), axis=1)

        return cls(
            length=length,
            s=points * length,
            nodes=nearest(np.linspace(0.0, 1.0, nodes)),
            bodies=nearest(fractions),
            basis=_basis(points),
            gauss=_basis(gauss),
            base=base,
            origin=origin,
        )


def mode_groups() -> Int[np.ndarray, " K"]:
    """Return the group of each mode: x and y of one k share their smoothness (invariance about z)."""
    return np.concatenate([np.arange(MODES[0]), np.arange(MODES[1]), MODES[0] + np.arange(MODES[2])])


def _basis(places: Float[np.ndarray, "..."]) -> Float[np.ndarray, "... 3 K"]:
    values = np.cos(np.pi * np.arange(max(MODES)) * places[..., None])
    basis = np.zeros((*places.shape, 3, sum(MODES)))
    start = 0
    for axis, count in enumerate(MODES):
        basis[..., axis, start : start + count] = values[..., :count]
        start += count
    return basis


class _RodShape(NamedTuple):
    """Shape of a rod at F times: curvature (1/m), orientation (also as a matrix) and position (m)."""

    u: Float[np.ndarray, "F P 3"]
    h: Float[np.ndarray, "F P 4"]
    R: Float[np.ndarray, "F P 3 3"]
    p: Float[np.ndarray, "F P 3"]


def rod_shape(rod: RodGeometry, a: Float[np.ndarray, "F K"], stretch: float) -> _RodShape:
    """Return the shape of a rod from the curvature's coefficients a (1/m); order 4 in the segments."""
    half = np.diff(rod.s)
    u1, u2 = (np.einsum("hck,fk->fhc", rod.gauss[:, i], a, optimize=True) for i in (0, 1))
    # Magnus' expansion to order 4: the rotation vector of a half segment
    turn = half[:, None] / 2 * (u1 + u2) + np.sqrt(3.0) / 12 * half[:, None] ** 2 * np.cross(u1, u2)
    angle = np.linalg.norm(turn, axis=-1, keepdims=True)
    # sin(x/2)/x, also where x is zero
    steps = np.concatenate([np.cos(angle / 2), np.sinc(angle / (2 * np.pi)) / 2 * turn], axis=-1)
    h = np.empty((len(a), len(rod.s), 4))
    h[:, 0] = rod.base
    for j in range(len(half)):
        h[:, j + 1] = hamilton(h[:, j], steps[:, j])
    R = matrices(h)
    p = rod.origin + cumulative(rod, stretch * R[..., 2])
    return _RodShape(np.einsum("pck,fk->fpc", rod.basis, a, optimize=True), h, R, p)


def sensitivity(
    rod: RodGeometry, shape: _RodShape
) -> tuple[Float[np.ndarray, "F M 3 K"], Float[np.ndarray, "F M 3 K"]]:
    """Return derivatives of the bodies' poses by the coefficients: rotations (global, rad), shifts (m)."""
    weights = _weights(rod)  # (M, P)
    F, P = shape.p.shape[:2]
    moment = np.cross(shape.R, shape.p[..., None], axisa=-2, axisb=-2, axisc=-2)  # columns of R, times p
    M, K = len(rod.bodies), rod.modes
    turn, shift = np.zeros((F, M, 3, K)), np.zeros((F, M, 3, K))
    for axis in range(3):
        modes = np.flatnonzero(np.any(rod.basis[:, axis] != 0.0, axis=0))
        factors = np.einsum("mp,pk->pmk", weights, rod.basis[:, axis, modes]).reshape(P, -1)
        # one product of matrices for all frames and bodies
        for sign, columns, integrals in ((1.0, shape.R, turn), (-1.0, moment, shift)):
            flat = np.ascontiguousarray(np.moveaxis(columns[..., axis], 1, -1)).reshape(F * 3, P)
            product = (flat @ factors).reshape(F, 3, M, len(modes))
            integrals[..., modes] = sign * np.moveaxis(product, 1, 2)
    shift += np.cross(turn, shape.p[:, rod.bodies, :, None], axisa=-2, axisb=-2, axisc=-2)
    return turn, shift


class _RodMotion(NamedTuple):
    """Motion of a rod at F times; q, w and their rates are in the material frame, in SI units."""

    shape: _RodShape
    q: Float[np.ndarray, "F P 3"]
    w: Float[np.ndarray, "F P 3"]
    q_t: Float[np.ndarray, "F P 3"]
    w_t: Float[np.ndarray, "F P 3"]
    u_t: Float[np.ndarray, "F P 3"]


def motion(rod: RodGeometry, a: Float[np.ndarray, "3 F K"], stretch: float) -> _RodMotion:
    """Return shape, velocities and accelerations from the coefficients and their first two rates."""
    shape = rod_shape(rod, a[0], stretch)
    u_t, u_tt = (np.einsum("pck,fk->fpc", rod.basis, rate, optimize=True) for rate in a[1:])
    p_s = stretch * shape.R[..., 2]
    turned = rotated(shape.R, u_t)
    w = cumulative(rod, turned)
    p_t = cumulative(rod, np.cross(w, p_s))
    w_t = cumulative(rod, rotated(shape.R, u_tt) + np.cross(w, turned))
    p_tt = cumulative(rod, np.cross(w_t, p_s) + np.cross(w, np.cross(w, p_s)))
    back = np.swapaxes(shape.R, -1, -2)
    q_local, w_local = rotated(back, p_t), rotated(back, w)
    # rates in a rotating frame; for ω the extra term vanishes
    q_t = rotated(back, p_tt) - np.cross(w_local, q_local)
    return _RodMotion(shape, q_local, w_local, q_t, rotated(back, w_t), u_t)


# integrals


def cumulative(rod: RodGeometry, values: Float[np.ndarray, "F P 3"]) -> Float[np.ndarray, "F P 3"]:
    """Return the integrals from the base to every point, by Simpson's rule in each segment."""
    ds = (rod.s[2::2] - rod.s[:-2:2])[:, None]
    first, middle, last = values[:, :-2:2], values[:, 1::2], values[:, 2::2]
    total = np.zeros_like(values)
    total[:, 2::2] = np.cumsum(ds / 6 * (first + 4 * middle + last), axis=1)
    total[:, 1::2] = total[:, :-2:2] + ds / 24 * (5 * first + 8 * middle - last)
    return total


def _weights(rod: RodGeometry) -> Float[np.ndarray, "M P"]:
    """Return Simpson's weights of the integrals from the base to the bodies."""
    ds = rod.s[2::2] - rod.s[:-2:2]
    weights = np.zeros((len(rod.bodies), len(rod.s)))
    for row, end in zip(weights, rod.bodies, strict=True):
        count = end // 2
        row[0 : 2 * count : 2] += ds[:count] / 6
        row[1 : 2 * count : 2] += ds[:count] * 4 / 6
        row[2 : 2 * count + 1 : 2] += ds[:count] / 6
    return weights


# rotations


def hamilton(a: Float[np.ndarray, "... 4"], b: Float[np.ndarray, "... 4"]) -> Float[np.ndarray, "... 4"]:
    """Return the product of quaternions, scalar first."""
    scalar = a[..., :1] * b[..., :1] - np.sum(a[..., 1:] * b[..., 1:], axis=-1, keepdims=True)
    vector = a[..., :1] * b[..., 1:] + b[..., :1] * a[..., 1:] + np.cross(a[..., 1:], b[..., 1:])
    return np.concatenate([scalar, vector], axis=-1)


def matrices(h: Float[np.ndarray, "... 4"]) -> Float[np.ndarray, "... 3 3"]:
    """Return the rotation matrices of unit quaternions, scalar first."""
    rotation = Rotation.from_quat(h.reshape(-1, 4), scalar_first=True)
    return rotation.as_matrix().reshape(*h.shape[:-1], 3, 3)


def turn_between(
    to: Float[np.ndarray, "... 4"], start: Float[np.ndarray, "... 4"]
) -> Float[np.ndarray, "... 3"]:
    """Return the rotation vectors (rad, global frame) from orientations `start` to `to`."""
    before, after = (Rotation.from_quat(h.reshape(-1, 4), scalar_first=True) for h in (start, to))
    return (after * before.inv()).as_rotvec().reshape(*to.shape[:-1], 3)


def rotated(
    R: Float[np.ndarray, "... 3 3"], vectors: Float[np.ndarray, "... 3"]
) -> Float[np.ndarray, "... 3"]:
    """Return vectors turned by rotation matrices."""
    return (R @ vectors[..., None])[..., 0]
