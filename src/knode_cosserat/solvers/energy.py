"""Energy of a rod under dead loads: a fast test of stability, and the way down to a stable equilibrium.

Small displacements x and rotations θ (global frame) of a rod with forces n and moments m change its energy by

    δE = ∫ n·ε + m·θ' - f·x ds,     ε = x' - θ × p'
    δ²E = ∫ ε·R Kse Rᵀε + θ'·R Kbt Rᵀθ' - 2 n·(θ × x') + n·(θ × (θ × p')) - m·(θ × θ') ds

Linear elements with one Gauss point each make δ²E a banded matrix. Its Cholesky factors take milliseconds,
and nothing is compiled. Dead loads f follow from n in any equilibrium. Stiffness by loads that depend on the
pose is missing; `kc.statics.stability` has it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from knode_cosserat.rods.ends import Free, Pinned, Sliding
from knode_cosserat.rods.loads import AttachedMass, DistributedWrench, PointWrench
from knode_cosserat.rods.rod import SlenderRod
from knode_cosserat.rods.system import System
from knode_cosserat.rods.wrapped import nominal_model
from knode_cosserat.solvers.guess import continuous, materials, rotations

#: fewest elements; an interval between two nodes is divided for them
ELEMENTS = 120
#: eigenvalues above -0.05 EI/L may be zero: a buckled round rod turns about its chord at no cost
NEUTRAL = 0.05
#: rounding as a fraction of the largest stiffness
ROUNDING = 1e-14
#: most corrections of an equilibrium of the nodes to that of the elements, and the last one's size
CORRECTIONS, BALANCED = 8, 1e-5
#: first displacement along an unstable mode, and largest step downhill, as parts of the length (or rad)
FIRST, LARGEST = 0.02, 0.3
#: most steps downhill, and the length of a step that ends them
STEPS, SHORT = 400, 1e-4
#: shear and extension are made as soft as this multiple of EI/L², or of the largest force, on the way down
SOFT, SOFT_BY_FORCE = 1e4, 200.0


def is_tested(system: System) -> bool:
    """True for a rod, or a model of one, without actuators and contact, with dead loads only."""
    rod = nominal_model(system)
    if not isinstance(rod, SlenderRod) or rod.surroundings or rod.effects:
        return False
    if any(part.actuates for part in rod.parts.values()):
        return False
    for load in rod.loads:
        lever = getattr(load, "moment", getattr(load, "offset", None))
        known = isinstance(load, PointWrench | DistributedWrench | AttachedMass)
        if not known or getattr(load, "follows", False) or (lever is not None and np.any(np.asarray(lever))):
            return False
    return True


class _Frames(NamedTuple):
    """Positions (m) and orientations of the points between elements, and SciPy's rotations."""

    p: Float[np.ndarray, "points 3"]
    turned: Any


class _Stress(NamedTuple):
    """Tangent, forces and moments of elements, global frame, and their frames."""

    p_s: Float[np.ndarray, "elements 3"]
    n: Float[np.ndarray, "elements 3"]
    m: Float[np.ndarray, "elements 3"]
    R: Float[np.ndarray, "elements 3 3"]


class RodEnergy:
    """Energy of a rod near one of its equilibria, by linear elements."""

    def __init__(self, system: System, y: Float[np.ndarray, "nodes y"], control: Any):
        """Take material, ends and dead loads of a rod that `is_tested`, in an equilibrium y at the nodes."""
        from scipy.interpolate import CubicSpline

        rod: Any = nominal_model(system)
        self.rod, self.length, segments = rod, float(rod.length), len(y) - 1
        self.divisions = -(-ELEMENTS // segments)
        self.count = self.divisions * segments
        self.ds = self.length / self.count
        h = y[:, rod.y_layout.slice("h")]
        fields = [y[:, rod.y_layout.slice(name)] for name in ("p", "n", "m")]
        fields.append(continuous(h / np.linalg.norm(h, axis=1, keepdims=True)))
        points = np.arange(self.count + 1) / self.divisions
        middle = (points[1:] + points[:-1]) / 2.0
        known = np.arange(segments + 1.0)

        if not rod.is_uniform:
            own = materials(rod, middle * self.length / segments, np.asarray(control))
            self.Kse, self.Kbt, v_star, u_star = map(np.asarray, (own.Kse, own.Kbt, own.v_star, own.u_star))
        else:
            spread = (self.count, 3, 3)
            self.Kse, self.Kbt = (np.broadcast_to(np.asarray(x), spread) for x in (rod.Kse, rod.Kbt))
            v_star, u_star = rod.v_star, rod.u_star
        self.v_star, self.u_star = (np.broadcast_to(star, (self.count, 3)) for star in (v_star, u_star))
        self.unit = float(np.asarray(rod.Kbt)[0, 0]) / self.length
        p, n, m, h = fields
        smooth_h = CubicSpline(known, h)
        self.shape = _Frames(CubicSpline(known, p)(points), rotations(smooth_h(points)))
        R = rotations(smooth_h(middle)).as_matrix()
        # forces may jump at nodes
        n, m = (
            np.stack([np.interp(middle, known, column) for column in values.T], axis=1) for values in (n, m)
        )
        v = self.v_star + np.linalg.solve(self.Kse, (n[:, None, :] @ R).swapaxes(1, 2))[..., 0]
        self.stress = _Stress((R @ v[..., None])[..., 0], n, m, R)
        # dead loads balance the forces of the equilibrium
        self.load = -np.diff(n, axis=0, prepend=0.0, append=0.0)
        self.free = np.ones((self.count + 1, 6), dtype=bool)
        for end, own in ((rod.base_end, self.free[0]), (rod.tip_end, self.free[-1])):
            if not isinstance(end, Free):
                own[:3], own[3:] = False, isinstance(end, Pinned)
            if isinstance(end, Sliding):
                own["xyz".index(end.along)] = True
        weight = np.full(self.count + 1, 1.0 / self.count)
        weight[[0, -1]] /= 2.0
        #: coordinates of unit weight over x/L and θ; zero where an end is held
        self.root = np.where(self.free, weight[:, None] ** -0.5, 0.0).reshape(-1)

    def mode(self) -> Float[np.ndarray, "points 6"] | None:
        """Return x/L and θ that decrease the energy of the equilibrium most; None if it is stable.

        It is None, too, if the grid is so coarse that the equilibrium of the elements is not found.
        """
        from scipy.linalg import eig_banded

        if self._surely_stable():
            return None
        stiffness = self._band(self.stress)
        if _factors(stiffness, _neutral(stiffness)) is not None:
            return None
        # the equilibrium of the elements differs a little: with the nodes', a free rotation would gain energy
        band = self._balanced()
        if band is None or _factors(band, _neutral(band)) is not None:
            return None
        vector = eig_banded(band, lower=True, select="i", select_range=(0, 0))[1][:, 0]
        mode = (self.root * vector).reshape(-1, 6)
        return np.asarray(mode / np.max(np.abs(mode)))

    def _balanced(self) -> Float[np.ndarray, "12 coordinates"] | None:
        """Correct the shape to the elements' equilibrium, and return its stiffness; None if that fails."""
        from scipy.linalg import solve_banded

        self.stress = self._energy(self.shape)[1]
        for _ in range(CORRECTIONS):
            band = self._band(self.stress)
            whole = np.zeros((23, band.shape[1]))
            for k in range(12):
                whole[11 + k] = band[k]
                whole[11 - k, k:] = band[k, : band.shape[1] - k]
            step = (self.root * solve_banded((11, 11), whole, -self._slope(self.stress))).reshape(-1, 6)
            if not np.max(np.abs(step)) < LARGEST:
                return None
            self.shape = self._moved(self.shape, step)
            self.stress = self._energy(self.shape)[1]
            if np.max(np.abs(step)) < BALANCED:
                return self._band(self.stress)
        return None

    def stable_shape(self, mode: Float[np.ndarray, "points 6"]) -> dict[str, np.ndarray]:
        """Return p, h, n and m at the nodes of a stable shape: from the equilibrium along a mode, downhill.

        Steps are those of Newton's method, with a shift that makes the stiffness positive and the energy
        decrease. The shape changes in small steps, and therefore keeps its turns.
        """
        force = float(np.max(np.linalg.norm(self.stress.n, axis=1)))
        soft = max(SOFT * self.unit / self.length, SOFT_BY_FORCE * force)
        self.Kse = self.Kse * np.minimum(1.0, soft / np.max(self.Kse, axis=(1, 2)))[:, None, None]
        shape, shift = self._moved(self.shape, FIRST * mode), 1.0
        energy, stress = self._energy(shape)
        for _ in range(STEPS):
            band, slope = self._band(stress), self._slope(stress)
            step = None
            while step is None:
                step = self._step(band, slope, shift)
                if step is not None:
                    trial = self._moved(shape, step)
                    lower, there = self._energy(trial)
                    if lower < energy or np.max(np.abs(step)) < SHORT:
                        break
                    step = None
                shift = 4.0 * max(shift, 1e-3)
            shape, energy, stress, shift = trial, lower, there, shift / 4.0
            if np.max(np.abs(step)) < SHORT:
                break
        at_points = [np.concatenate([x[:1], (x[1:] + x[:-1]) / 2.0, x[-1:]]) for x in (stress.n, stress.m)]
        h = continuous(np.roll(shape.turned.as_quat(), 1, axis=1))
        fields = zip(("p", "h", "n", "m"), (shape.p, h, *at_points), strict=True)
        return {name: values[:: self.divisions] for name, values in fields}

    def _surely_stable(self) -> bool:
        """True if a bound on δ²E is positive: loads are far below those of buckling.

        By Poincaré's inequality the norm of θ is at most c times that of θ', c = L/π with both ends clamped
        and 2L/π with one. At least K|θ'|² - M|θ||θ'| - P|θ|² is left, with K the least stiffness.
        """
        free = [not self.free[k, 3] for k in (0, -1)]
        if not any(free):
            return False
        p_s, n, m, _ = self.stress
        along, size = np.sum(n * p_s, axis=1), np.linalg.norm(n, axis=1)
        P = np.max(np.maximum(-along, (size * np.linalg.norm(p_s, axis=1) - along) / 2.0))
        every = slice(1) if self.rod.is_uniform else slice(None)
        P += np.max(size) ** 2 / np.min(np.linalg.eigvalsh(self.Kse[every]))
        K = np.min(np.linalg.eigvalsh(self.Kbt[every]))
        c = self.length / np.pi * (1.0 if all(free) else 2.0)
        return bool(np.max(np.linalg.norm(m, axis=1)) * c + P * c * c < K)

    def _moved(self, shape: _Frames, step: Float[np.ndarray, "points 6"]) -> _Frames:
        from scipy.spatial.transform import Rotation

        return _Frames(shape.p + self.length * step[:, :3], Rotation.from_rotvec(step[:, 3:]) * shape.turned)

    def _energy(self, shape: _Frames) -> tuple[float, _Stress]:
        """Return the energy (J), and the stress of the elements."""
        from scipy.spatial.transform import Rotation

        begin, change = shape.turned[:-1], (shape.turned[:-1].inv() * shape.turned[1:]).as_rotvec()
        R = (begin * Rotation.from_rotvec(change / 2.0)).as_matrix()
        p_s = np.diff(shape.p, axis=0) / self.ds
        strains = (p_s[:, None, :] @ R)[:, 0] - self.v_star, change / self.ds - self.u_star
        stresses = [(K @ z[..., None])[..., 0] for K, z in zip((self.Kse, self.Kbt), strains, strict=True)]
        energy = 0.5 * self.ds * sum(np.sum(z * f) for z, f in zip(strains, stresses, strict=True))
        n, m = ((R @ f[..., None])[..., 0] for f in stresses)
        return float(energy - np.sum(self.load * shape.p)), _Stress(p_s, n, m, R)

    def _slope(self, stress: _Stress) -> Float[np.ndarray, " coordinates"]:
        """Return the derivatives of the energy with respect to the coordinates, in units of EI/L."""
        slope = np.zeros((self.count + 1, 6))
        torque = 0.5 * self.ds * np.cross(stress.p_s, stress.n)
        for points, sign in ((slice(1, None), 1.0), (slice(None, -1), -1.0)):
            slope[points, :3] += sign * self.length * stress.n
            slope[points, 3:] += sign * stress.m - torque
        slope[:, :3] -= self.length * self.load
        return self.root * slope.reshape(-1) / self.unit

    def _band(self, stress: _Stress) -> Float[np.ndarray, "12 coordinates"]:
        """Return the lower band of the stiffness δ²E in the coordinates, in units of EI/L."""
        p_s, n, m, R = stress
        Kse, Kbt = (R @ K @ R.swapaxes(1, 2) for K in (self.Kse, self.Kbt))
        eye, zero = np.broadcast_to(np.eye(3), Kse.shape), np.zeros_like(Kse)
        # x', θ' and θ at the Gauss point, from x/L and θ at both ends
        x_s = np.concatenate([-eye, zero, eye, zero], axis=2) * self.length / self.ds
        theta_s = np.concatenate([zero, -eye, zero, eye], axis=2) / self.ds
        theta = np.concatenate([zero, eye, zero, eye], axis=2) / 2.0
        strain = x_s + _hat(p_s) @ theta
        across = n[:, :, None] * p_s[:, None, :] - np.sum(n * p_s, axis=1)[:, None, None] * eye
        K = strain.swapaxes(1, 2) @ Kse @ strain + theta_s.swapaxes(1, 2) @ Kbt @ theta_s
        K = K + theta.swapaxes(1, 2) @ (2.0 * _hat(n) @ x_s + across @ theta + _hat(m) @ theta_s)
        K = 0.5 * self.ds / self.unit * (K + K.swapaxes(1, 2))
        size = len(self.root)
        band, (rows, columns) = np.zeros((12, size)), np.tril_indices(12)
        for k in range(2):  # elements of one parity do not overlap
            spots = columns[:, None] + 6 * np.arange(k, self.count, 2)
            band[(rows - columns)[:, None], spots] += K[k::2][:, rows, columns].T
        for k in range(12):
            band[k, : size - k] *= self.root[: size - k] * self.root[k:]
        band[0, self.root == 0.0] = np.max(np.abs(band[0]))
        return band

    def _step(self, band: Any, slope: Any, shift: float) -> Float[np.ndarray, "points 6"] | None:
        """Return the step of Newton's method with a shift; None if it is not downhill, or too long."""
        from scipy.linalg import cho_solve_banded

        factors = _factors(band, shift)
        if factors is None:
            return None
        step = (self.root * -cho_solve_banded((factors, True), slope)).reshape(-1, 6)
        return step if np.max(np.abs(step)) < LARGEST else None


def _neutral(band: np.ndarray) -> float:
    """Return the size of an eigenvalue that may be zero."""
    return max(NEUTRAL, ROUNDING * float(np.max(np.abs(band[0]))))


def _factors(band: np.ndarray, shift: float) -> np.ndarray | None:
    """Return the Cholesky factors of a shifted band; None if it is not positive."""
    from scipy.linalg import LinAlgError, cholesky_banded

    shifted = band.copy()
    shifted[0] += shift
    try:
        return np.asarray(cholesky_banded(shifted, lower=True, check_finite=False))
    except LinAlgError:
        return None


def _hat(a: np.ndarray) -> np.ndarray:
    zero = np.zeros(len(a))
    x, y, z = a.T
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
