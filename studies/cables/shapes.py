"""The shape of a cable in one frame of motion capture: an inextensible curve near its markers.

Markers sit beside the centreline, so that distances between them change where the cable bends. The curve has
the cable's length; its curvature changes slowly along it. It is a polygon with even edges, found by least
squares (Levenberg-Marquardt).
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from studies.cables import frames

#: scales of differences: a marker's place (m), strain, tangent at an end (rad), and change of
#: curvature (1/m over the length, by the root of the length). Chosen on DLO1 and DLO2 by the first 0.2 s of
#: rollouts: with less smoothing the first steps are thrown by wiggles between markers
PLACE, STRAIN, TANGENT, ROUGHNESS = 0.5e-3, 1e-4, 0.1, 5.0
#: strains allowed on the way there
SOFTENING = (1e-2, 1e-3, STRAIN)
#: corrections, at most, for each of these
CORRECTIONS = 25
#: diagonals beside that of the middle: a corner's place depends on three neighbours on either side
BAND = 9


class CableShape(NamedTuple):
    """A cable's curve: corners, frames of edges, and the markers as seen from the frames nearest to them."""

    points: Float[np.ndarray, "n+1 3"]
    edges: Float[np.ndarray, "n 4"]
    beside: Float[np.ndarray, "M 3"]


@dataclasses.dataclass(frozen=True)
class CableGrid:
    """A polygon of equal edges, and the places of markers (m from its start, both ends among them)."""

    places: Float[np.ndarray, " M"]
    edges: int

    @property
    def length(self) -> float:
        """Length (m)."""
        return float(self.places[-1])

    @property
    def edge(self) -> float:
        """Length of an edge (m)."""
        return self.length / self.edges

    def interpolation(self) -> Float[np.ndarray, "M n+1"]:
        """Return the matrix from corners to the places of markers, by cubics through four corners."""
        along = self.places / self.edge
        first = np.clip(np.floor(along).astype(int) - 1, 0, self.edges - 3)
        found = np.zeros((len(along), self.edges + 1))
        for k in range(4):
            others = [i for i in range(4) if i != k]
            weight = np.prod([(along - first - i) / (k - i) for i in others], axis=0)
            found[np.arange(len(along)), first + k] = weight
        return found

    def frames_at_places(
        self, edges: Float[np.ndarray, "n 4"], first: Any, last: Any
    ) -> Float[np.ndarray, "M 4"]:
        """Return the frames at the places of markers, those at the ends as given."""
        along = self.places / self.edge - 0.5
        low = np.clip(np.floor(along).astype(int), 0, self.edges - 2)
        part = (along - low)[:, None]
        a, b = edges[low], edges[low + 1]
        same = np.sum(a * b, axis=-1, keepdims=True) >= 0.0
        found = frames.unit((1.0 - part) * a + part * np.where(same, b, -b))
        found[0], found[-1] = first, last
        return found


class Fitter:
    """Finds the shapes of one cable; the matrices of a grid are kept between frames."""

    def __init__(self, grid: CableGrid, tangent: float = TANGENT):
        """`tangent`: how far the curve's direction at an end may be from its frame (rad)."""
        self.tangent = tangent
        n, ds = grid.edges, grid.edge
        self.grid = grid
        bending = np.zeros((n - 2, n + 1))
        for k in range(n - 2):
            bending[k, k : k + 4] = np.array([-1.0, 3.0, -3.0, 1.0]) / ds**3
        tangents = np.zeros((2, n + 1))
        tangents[0, :3] = np.array([-1.5, 2.0, -0.5]) / ds
        tangents[1, -3:] = np.array([0.5, -2.0, 1.5]) / ds
        self._places = grid.interpolation()
        self._matrix = np.concatenate(
            [self._places / PLACE, tangents / tangent, bending * np.sqrt(ds) / ROUGHNESS]
        )
        self._square = _banded(self._matrix.T @ self._matrix)

    def shape(
        self,
        markers: Float[np.ndarray, "M 3"],
        ends: tuple[Float[np.ndarray, "4"], Float[np.ndarray, "4"]],
        offset: Float[np.ndarray, "3"],
        start: CableShape | None = None,
        rounds: int = 3,
    ) -> CableShape:
        """Return the shape of one frame.

        Args:
            markers: positions, those at both ends of the free cable among them.
            ends: frames of the cable at its ends.
            offset: where markers sit, seen from the cable's frame.
            start: a shape that is near, such as that of the frame before.
            rounds: how often the frames at the markers are brought up to date.
        """
        grid, (first, last) = self.grid, ends
        directions = np.stack([frames.rotated(each, frames.AXIS) for each in ends])
        points = self._first_guess(markers, first, last, offset) if start is None else start.points
        for k in range(rounds):
            edges = frames.along_curve(np.diff(points, axis=0), first, last)
            at = grid.frames_at_places(edges, first, last)
            aims = np.concatenate(
                [
                    (markers - frames.rotated(at, np.broadcast_to(offset, markers.shape))) / PLACE,
                    directions / self.tangent,
                    np.zeros((grid.edges - 2, 3)),
                ]
            )
            for strain in SOFTENING if start is None and k == 0 else SOFTENING[-1:]:
                points = self._fitted(points, aims, strain)
        edges = frames.along_curve(np.diff(points, axis=0), first, last)
        at = grid.frames_at_places(edges, first, last)
        beside = frames.rotated(frames.conjugate(at), markers - self._places @ points)
        return CableShape(points, edges, beside)

    def _first_guess(self, markers: Any, first: Any, last: Any, offset: Any) -> Float[np.ndarray, "n+1 3"]:
        from scipy.interpolate import CubicSpline

        inner = markers - frames.rotated(first, offset)
        slopes = [frames.rotated(each, frames.AXIS) for each in (first, last)]
        spline = CubicSpline(self.grid.places, inner, bc_type=((1, slopes[0]), (1, slopes[1])))
        return np.asarray(spline(np.linspace(0.0, self.grid.length, self.grid.edges + 1)))

    def _fitted(self, points: Any, aims: Any, strain: float) -> Float[np.ndarray, "n+1 3"]:
        from scipy.linalg import solveh_banded

        ds = self.grid.edge

        def misfit(points: Any) -> tuple[Any, Any, float]:
            stretched = (np.linalg.norm(np.diff(points, axis=0), axis=1) / ds - 1.0) / strain
            left = self._matrix @ points - aims
            return stretched, left, float(np.sum(stretched**2) + np.sum(left**2))

        damping = 1e-7
        stretched, left, cost = misfit(points)
        for _ in range(CORRECTIONS):
            slopes = frames.unit(np.diff(points, axis=0)) / (ds * strain)
            square = self._square + _of_edges(slopes)
            gradient = self._matrix.T @ left
            gradient[1:] += slopes * stretched[:, None]
            gradient[:-1] -= slopes * stretched[:, None]
            for _ in range(6):
                damped = square.copy()
                damped[BAND] *= 1.0 + damping
                step = solveh_banded(damped, gradient.ravel(), overwrite_ab=True, check_finite=False)
                moved = points - step.reshape(-1, 3)
                after = misfit(moved)
                if after[2] < cost:
                    break
                damping *= 10.0
            else:
                break
            gain, points, damping = cost - after[2], moved, damping / 10.0
            stretched, left, cost = after
            if gain < 1e-3 * cost:
                break
        return points


def _banded(square: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "b 3*n"]:
    """Return a symmetric matrix, the same for x, y and z, by its diagonals; row BAND is the middle."""
    count = len(square)
    found = np.zeros((BAND + 1, count, 3))
    for off in range(BAND // 3 + 1):
        found[BAND - 3 * off, off:] = np.diagonal(square, off)[:, None]
    return found.reshape(BAND + 1, -1)


def _of_edges(slopes: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "b 3*n+3"]:
    """Return the squares of strains' derivatives by their diagonals, as `_banded` does."""
    found = np.zeros((BAND + 1, len(slopes) + 1, 3))
    blocks = slopes[:, :, None] * slopes[:, None, :]
    for a, b in np.ndindex(3, 3):
        if a <= b:
            found[BAND + a - b, :-1, b] += blocks[:, a, b]
            found[BAND + a - b, 1:, b] += blocks[:, a, b]
        found[BAND - 3 + a - b, 1:, b] -= blocks[:, a, b]
    return found.reshape(BAND + 1, -1)
