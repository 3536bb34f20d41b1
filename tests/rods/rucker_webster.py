"""The static shape of a tendon robot by Rucker & Webster 2011, in NumPy and SciPy.

It shares no code with the package, and has their form, not the package's: n and m are those of the rod alone,
tendons load it with distributed forces, and with point forces where they are anchored; v and u are states
whose derivatives come from a 6×6 system.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import root


@dataclasses.dataclass(frozen=True)
class Path:
    """A tendon's r(s), r′(s), r″(s) (3,), its tension (N) and where it is anchored (m)."""

    r: Callable[[float], np.ndarray]
    r_s: Callable[[float], np.ndarray]
    r_ss: Callable[[float], np.ndarray]
    tension: float
    end: float


@dataclasses.dataclass(frozen=True)
class Rod:
    """Length (m), stiffness of a straight rod along z, and its weight (N/m, global frame)."""

    length: float
    Kse: np.ndarray
    Kbt: np.ndarray
    weight: np.ndarray


def hat(a: np.ndarray) -> np.ndarray:
    return np.array([[0.0, -a[2], a[1]], [a[2], 0.0, -a[0]], [-a[1], a[0], 0.0]])


V_STAR = np.array([0.0, 0.0, 1.0])


def polynomial(x: list[float], y: list[float], length: float, tension: float, end: float = 1.0) -> Path:
    """x and y by their coefficients in s/L. Straight and tapered tendons are of degree 0 and 1."""
    px, py = np.polynomial.Polynomial(x), np.polynomial.Polynomial(y)

    def derivative(order: int) -> Callable[[float], np.ndarray]:
        dx, dy = (p.deriv(order) if order else p for p in (px, py))
        return lambda s: np.array([dx(s / length), dy(s / length), 0.0]) / length**order

    return Path(derivative(0), derivative(1), derivative(2), tension, end * length)


def helix(radius: float, phase: float, turns: float, length: float, tension: float, end: float = 1.0) -> Path:
    """Around the rod."""
    k = 2 * np.pi * turns / length

    def derivative(order: int) -> Callable[[float], np.ndarray]:
        ahead = phase + order * np.pi / 2
        return lambda s: radius * k**order * np.array([np.cos(k * s + ahead), np.sin(k * s + ahead), 0.0])

    return Path(derivative(0), derivative(1), derivative(2), tension, end * length)


def strain_rates(rod: Rod, paths: list[Path], s: float, R: np.ndarray, v: np.ndarray, u: np.ndarray):
    """v′ and u′ from the 6×6 system."""
    A, B, G, H = (np.zeros((3, 3)) for _ in range(4))
    alpha, beta = np.zeros(3), np.zeros(3)
    for path in paths:
        r, r_s, r_ss = path.r(s), path.r_s(s), path.r_ss(s)
        p_s = hat(u) @ r + r_s + v
        A_i = -path.tension * hat(p_s) @ hat(p_s) / np.linalg.norm(p_s) ** 3
        B_i = hat(r) @ A_i
        a_i = A_i @ (hat(u) @ p_s + hat(u) @ r_s + r_ss)
        A, B, G, H = A + A_i, B + B_i, G - A_i @ hat(r), H - B_i @ hat(r)
        alpha, beta = alpha + a_i, beta + hat(r) @ a_i
    n, m = rod.Kse @ (v - V_STAR), rod.Kbt @ u
    d = -hat(u) @ n - R.T @ rod.weight - alpha
    c = -hat(u) @ m - hat(v) @ n - beta
    rates = np.linalg.solve(np.block([[rod.Kse + A, G], [B, rod.Kbt + H]]), np.concatenate([d, c]))
    return rates[:3], rates[3:]


def held(paths: list[Path], s: float, v: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Force and moment (6,) that the tendons hold between two sections at s, material frame."""
    wrench = np.zeros(6)
    for path in paths:
        p_s = hat(u) @ path.r(s) + path.r_s(s) + v
        force = path.tension * p_s / np.linalg.norm(p_s)
        wrench += np.concatenate([force, hat(path.r(s)) @ force])
    return wrench


def across(rod: Rod, before: list[Path], after: list[Path], s: float, v: np.ndarray, u: np.ndarray):
    """n and m of the rod (6,) behind a point where tendons are anchored, from v and u before it.

    Those that end there pull with their tension. Because v and u jump those that go on have a kink, and push
    the rod there with T (t₊ - t₋): n and m behind depend on v and u behind.
    """

    def wrench(v: np.ndarray, u: np.ndarray) -> np.ndarray:
        return np.concatenate([rod.Kse @ (v - V_STAR), rod.Kbt @ u])

    free = wrench(v, u) + held(before, s, v, u)
    if not after:
        return free
    stiffness = np.repeat([rod.Kse[2, 2], rod.Kbt[0, 0]], 3)

    def left(x: np.ndarray) -> np.ndarray:
        v, u = np.split(x, 2)
        return (wrench(v, u) + held(after, s, v, u) - free) / stiffness

    found = root(left, np.concatenate([v, u]), tol=1e-14)
    if np.max(np.abs(found.fun)) > 1e-12:
        raise RuntimeError(f"the oracle did not find the jump: {found.message}")
    return wrench(*np.split(found.x, 2))


def integrate(rod: Rod, paths: list[Path], n: np.ndarray, m: np.ndarray, tolerance: float):
    """From n and m of the rod at the base: the state [p, R, v, u] at the tip, and (6,) what is left there."""
    v, u = V_STAR + np.linalg.solve(rod.Kse, n), np.linalg.solve(rod.Kbt, m)
    state = np.concatenate([np.zeros(3), np.eye(3).ravel(), v, u])
    s = 0.0
    for stop in sorted({path.end for path in paths} | {rod.length}):
        running = [path for path in paths if path.end > s]

        def rates(at: float, x: np.ndarray, running: list[Path] = running) -> np.ndarray:
            R, v, u = x[3:12].reshape(3, 3), x[12:15], x[15:]
            return np.concatenate([R @ v, (R @ hat(u)).ravel(), *strain_rates(rod, running, at, R, v, u)])

        along = solve_ivp(rates, (s, stop), state, method="DOP853", rtol=tolerance, atol=tolerance)
        state, s = along.y[:, -1], stop
        after = [path for path in running if path.end > stop]
        left = across(rod, running, after, stop, state[12:15], state[15:])
        if stop < rod.length:
            v, u = V_STAR + np.linalg.solve(rod.Kse, left[:3]), np.linalg.solve(rod.Kbt, left[3:])
            state = np.concatenate([state[:12], v, u])
    return state, left


def shape(rod: Rod, paths: list[Path], tolerance: float = 1e-11, parts: int = 1) -> np.ndarray:
    """The state [p, R, v, u] (18,) at the tip of the rod at rest; tensions and weight may grow in parts."""
    scale = np.repeat([rod.Kbt[0, 0] / rod.length**2, rod.Kbt[0, 0] / rod.length], 3)
    guess = np.zeros(6)
    for part in np.arange(1, parts + 1) / parts:
        loaded = dataclasses.replace(rod, weight=part * rod.weight)
        pulled = [dataclasses.replace(path, tension=part * path.tension) for path in paths]
        # what the straight rod would need, and what was missing of it in the last part
        straight = -held(pulled, 0.0, V_STAR, np.zeros(3))

        def left(x: np.ndarray, loaded=loaded, pulled=pulled, straight=straight) -> np.ndarray:
            n, m = np.split(straight + x * scale, 2)
            return integrate(loaded, pulled, n, m, tolerance)[1] / scale

        found = root(left, guess, tol=1e-12)
        guess = found.x
    if np.max(np.abs(found.fun)) > 1e-9:
        raise RuntimeError(f"the oracle did not converge: {found.message}")
    n, m = np.split(straight + guess * scale, 2)
    return integrate(rod, paths, n, m, tolerance)[0]
