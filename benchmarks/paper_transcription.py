"""A plain NumPy transcription of the KNODE-Cosserat paper's Algorithm 1 for its tendon-driven robot.

Single shooting with `scipy.optimize.fsolve`, forward Euler along the rod, BDF2 in time, one loop over the
nodes. It serves twice: as the yardstick for speed (what a careful researcher gets without a compiler) and as
the independent oracle for the package's own solver, with which it shares no code.

The paper's symbols, all SI::

    y = [p h n m q w]   (19,) a node: position, quaternion (scalar first), force N and moment N m in the
                        global frame, velocity m/s and angular velocity rad/s in the material frame
    z = [v u]           (6,) a node: stretch and shear, curvature 1/m, both in the material frame
    ds, dt              segment length m, time step s
    c0, c1, c2          BDF2: y_t = c0 y + yh, with the history yh = c1 y(t - dt) + c2 y(t - 2 dt)

Run `python benchmarks/paper_transcription.py` for the baselines of the paper's table of
simulation results.
"""

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import fsolve, root

P, H, N, M, Q, W = slice(0, 3), slice(3, 7), slice(7, 10), slice(10, 13), slice(13, 16), slice(16, 19)
V, U = slice(0, 3), slice(3, 6)

RESIDUAL_TOLERANCE = 1e-8
"""Largest tip residual (2-norm of three N and three N m) that counts as solved."""

PAPER_XTOL = 1.49012e-8
"""The default of `fsolve`, which the paper uses."""

TIGHT_XTOL = 1e-11


@dataclass(frozen=True)
class PaperRobot:
    """The paper's tendon-driven robot, with the paper's true parameters by default.

    length, radius: m. density: kg/m³. youngs_modulus, shear_modulus: Pa; `None` means E / 2.6, which is
    Poisson's ratio 0.3. bending_damping (N m² s), shear_damping (N s) and drag (kg/m²) each multiply the 3×3
    identity. gravity: m/s², global frame. nodes: points along the rod, one more than segments.
    """

    length: float = 0.635
    radius: float = 0.003175
    density: float = 1411.6751
    youngs_modulus: float = 2.757903e9
    shear_modulus: float | None = None
    bending_damping: float = 0.03
    shear_damping: float = 0.0
    drag: float = 1e-4
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)
    nodes: int = 10


@dataclass(frozen=True)
class Result:
    """States over time; row 0 is the straight rest state, row i the state after control i.

    state: (T+1, nodes, 25), y then z. converged: (T+1,) bool, whether that row's own boundary-value problem
    was solved. residual: (T+1,) 2-norm of the tip's force (N) and moment (N m). evaluations: (T+1,)
    integrations along the rod. attempts: (T+1,) solves tried; 1 means the first one did.

    Every row builds on the two before it, so only the first `valid_rows` rows are to be trusted.
    """

    state: np.ndarray
    converged: np.ndarray
    residual: np.ndarray
    evaluations: np.ndarray
    attempts: np.ndarray

    @property
    def valid_rows(self) -> int:
        """Number of rows before the first one that did not converge."""
        return len(self.converged) if self.converged.all() else int(np.argmin(self.converged))

    @property
    def position(self) -> np.ndarray:
        """(T+1, nodes, 3) m."""
        return self.state[:, :, P]

    @property
    def quaternion(self) -> np.ndarray:
        """(T+1, nodes, 4), scalar first, not normalised."""
        return self.state[:, :, H]


def hat(a):
    """The matrix of the cross product: hat(a) @ b = a × b."""
    return np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])


def rotation_matrix(h):
    """Rotation from material to global frame; `h` need not have unit length."""
    w, x, y, z = h
    return np.eye(3) + 2 / (h @ h) * np.array(
        [
            [-y * y - z * z, x * y - z * w, x * z + y * w],
            [x * y + z * w, -x * x - z * z, y * z - x * w],
            [x * z - y * w, y * z + x * w, -x * x - y * y],
        ]
    )


def quaternion_rate(h, u):
    """h_s such that R_s = R hat(u)."""
    return 0.5 * np.array(
        [
            -u[0] * h[1] - u[1] * h[2] - u[2] * h[3],
            u[0] * h[0] + u[2] * h[2] - u[1] * h[3],
            u[1] * h[0] - u[2] * h[1] + u[0] * h[3],
            u[2] * h[0] + u[1] * h[1] - u[0] * h[2],
        ]
    )


class SemiDiscreteRod:
    """The robot's equations at one instant: BDF2 has turned every time derivative into c0 · + history."""

    def __init__(self, robot: PaperRobot, dt: float):
        E = robot.youngs_modulus
        G = E / 2.6 if robot.shear_modulus is None else robot.shear_modulus
        A = np.pi * robot.radius**2
        I = np.pi * robot.radius**4 / 4
        self.nodes = robot.nodes
        self.length = robot.length
        self.ds = robot.length / (robot.nodes - 1)
        self.c0, self.c1, self.c2 = 1.5 / dt, -2.0 / dt, 0.5 / dt
        self.rhoA = robot.density * A
        self.rhoJ = robot.density * np.diag([I, I, 2 * I])
        self.g = np.array(robot.gravity, dtype=float)
        self.C = robot.drag * np.eye(3)
        Kse = np.diag([G * A, G * A, E * A])
        Kbt = np.diag([E * I, E * I, 2 * G * I])
        self.Bse = robot.shear_damping * np.eye(3)
        self.Bbt = robot.bending_damping * np.eye(3)
        self.Kse_vstar = Kse @ np.array([0.0, 0.0, 1.0])
        self.Kse_c0Bse_inv = np.linalg.inv(Kse + self.c0 * self.Bse)
        self.Kbt_c0Bbt_inv = np.linalg.inv(Kbt + self.c0 * self.Bbt)
        angles = np.pi / 4 + np.arange(4) * np.pi / 2
        self.phi = np.array([np.cos(angles), np.sin(angles), np.zeros(4)])

    def rest(self):
        """Straight up and still: y (nodes, 19), z (nodes, 6)."""
        y = np.zeros((self.nodes, 19))
        y[:, 2] = np.linspace(0, self.length, self.nodes)
        y[:, 3] = 1
        z = np.zeros((self.nodes, 6))
        z[:, 2] = 1
        return y, z

    def equations(self, y, yh, zh, f_tendon):
        """y_s (19,) and z (6,) at a node from its state, its history and the tendons' force (N/m)."""
        h, n, m, q, w = y[H], y[N], y[M], y[Q], y[W]
        R = rotation_matrix(h)

        v = self.Kse_c0Bse_inv @ (R.T @ n + self.Kse_vstar - self.Bse @ zh[V])
        u = self.Kbt_c0Bbt_inv @ (R.T @ m - self.Bbt @ zh[U])
        v_t = self.c0 * v + zh[V]
        u_t = self.c0 * u + zh[U]
        q_t = self.c0 * q + yh[Q]
        w_t = self.c0 * w + yh[W]

        p_s = R @ v
        h_s = quaternion_rate(h, u)
        n_s = R @ (self.rhoA * (hat(w) @ q + q_t) + self.C @ (q * np.abs(q))) - self.rhoA * self.g - f_tendon
        m_s = R @ (hat(w) @ self.rhoJ @ w + self.rhoJ @ w_t) - hat(p_s) @ n
        q_s = v_t - hat(u) @ q + hat(w) @ v
        w_s = u_t - hat(u) @ w
        return np.concatenate([p_s, h_s, n_s, m_s, q_s, w_s]), np.concatenate([v, u])

    def integrate(self, base_load, yh, zh, f_tendon):
        """Forward Euler from the clamped base, whose force and moment are guessed (6,), to the tip."""
        y, z = self.rest()
        y[0, N] = base_load[:3]
        y[0, M] = base_load[3:]
        for j in range(self.nodes - 1):
            y_s, z[j] = self.equations(y[j], yh[j], zh[j], f_tendon)
            y[j + 1] = y[j] + self.ds * y_s
        # z of the last node is never computed: no segment starts there.
        return y, z


class BoundaryValueProblem:
    """One time step: find the base load (force N, moment N m) that leaves the tip free."""

    def __init__(self, rod: SemiDiscreteRod, yh, zh, f_tendon_before, f_tendon):
        self.rod, self.yh, self.zh = rod, yh, zh
        self.f_tendon_before, self.f_tendon = f_tendon_before, f_tendon
        self.evaluations = 0

    def integrate(self, base_load, fraction=1.0):
        """y, z along the rod; `fraction` of the change in tendon force since the step before is applied."""
        self.evaluations += 1
        f_tendon = self.f_tendon_before + fraction * (self.f_tendon - self.f_tendon_before)
        return self.rod.integrate(base_load, self.yh, self.zh, f_tendon)

    def residual(self, base_load, fraction=1.0):
        """The tip's (-n, -m)."""
        y, _ = self.integrate(base_load, fraction)
        return -y[-1, 7:13]


def candidates(problem: BoundaryValueProblem, previous, extrapolated, retry: bool) -> Iterator[np.ndarray]:
    """Base loads to try: the paper's own solve, then, with `retry`, ever more patient ones."""
    xtol = TIGHT_XTOL if retry else PAPER_XTOL
    stuck = fsolve(problem.residual, previous, full_output=True, xtol=xtol)[0]
    yield stuck
    if not retry:
        return

    def patient_fsolve(start, **options):
        return fsolve(problem.residual, without_noise(start), full_output=True, xtol=TIGHT_XTOL, **options)

    yield patient_fsolve(previous)[0]

    # Load stepping comes before any other starting point because it follows the solution continuously from
    # the robot's present shape, and so does not jump to another equilibrium of a strongly bent rod.
    for increments in (4, 16, 64):
        x = previous
        for fraction in np.linspace(0, 1, increments + 1):
            x, info, _, _ = patient_fsolve(x, args=(fraction,))
            if not np.linalg.norm(info["fvec"]) <= RESIDUAL_TOLERANCE:
                break
        else:
            yield x

    # A short first step: the default, 100 times the size of the start, leaves the region in which the
    # linearisation of a shooting problem means anything.
    for start in (extrapolated, stuck, np.zeros(6)):
        yield patient_fsolve(start, factor=0.1)[0]
    for start in (previous, extrapolated):
        options = {"xtol": 1e-14, "ftol": 1e-14}
        yield root(problem.residual, without_noise(start), method="lm", options=options).x


def without_noise(base_load):
    """The base load with rounding noise, and anything not finite, set to zero.

    MINPACK's difference step is 1.5e-8 of each unknown, and 1.5e-8 itself only for an exact zero. A straight
    weightless rod has base loads of 1e-17: their Jacobian columns are noise, which is why the paper's own
    solve gives up on that rod's step response.
    """
    return np.where(np.isfinite(base_load) & (np.abs(base_load) > 1e-6), base_load, 0.0)


def solve(problem: BoundaryValueProblem, previous, extrapolated, retry: bool):
    """The best candidate: base load, y, z, its residual's norm, and the number of candidates tried."""
    best = None
    # Trial base loads far from the solution may overflow; the check of the residual sees to the outcome.
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        attempts = 0
        for base_load in candidates(problem, previous, extrapolated, retry):
            attempts += 1
            y, z = problem.integrate(base_load)
            # The residual decides, not fsolve's `ier`: that also reports failure for a solve with nothing
            # left to gain, and its success is relative to the size of the base load.
            norm = np.linalg.norm(y[-1, 7:13])
            if best is None or norm < best[3] or np.isnan(best[3]):
                best = base_load, y, z, norm
            if norm <= RESIDUAL_TOLERANCE:
                break
    return *best, attempts


def simulate(robot: PaperRobot, tensions, dt: float = 0.05, retry: bool = True) -> Result:
    """Algorithm 1 of the paper.

    Args:
        tensions: (T, 4) N.
        dt: time step, s.
        retry: solve tightly, check every step's residual, and try again in other ways where it is above
            `RESIDUAL_TOLERANCE`. After a step that defeats all of them the rest is computed without retries,
            as it is not to be trusted anyway. `False` is the paper's literal behaviour: one `fsolve` at its
            default tolerance a step, whose answer is taken whether it converged or not (`converged` still
            tells).

    Returns:
        A `Result` with T + 1 rows.

    Source: Algorithm 1 and the tendon robot's equations in Jiahao et al., "Knowledge-based Neural Ordinary
    Differential Equations for Cosserat Rod-based Soft Robots".
    """
    tensions = np.asarray(tensions, dtype=float)
    if tensions.ndim != 2 or tensions.shape[1] != 4:
        raise ValueError(f"tensions has shape {tensions.shape}; it must be (steps, 4), in newtons")
    rod = SemiDiscreteRod(robot, dt)
    rows = len(tensions) + 1
    y = np.empty((rows, robot.nodes, 19))
    z = np.empty((rows, robot.nodes, 6))
    y[0], z[0] = rod.rest()
    converged = np.ones(rows, dtype=bool)
    residual = np.zeros(rows)
    evaluations = np.zeros(rows, dtype=int)
    attempts = np.zeros(rows, dtype=int)
    base_load = base_load_before = np.zeros(6)
    f_tendon_before = np.zeros(3)

    for i, tau in enumerate(tensions, start=1):
        f_tendon = rod.phi @ tau
        # The state before the first is the first.
        yh = rod.c1 * y[i - 1] + rod.c2 * y[max(i - 2, 0)]
        zh = rod.c1 * z[i - 1] + rod.c2 * z[max(i - 2, 0)]
        problem = BoundaryValueProblem(rod, yh, zh, f_tendon_before, f_tendon)
        extrapolated = 2 * base_load - base_load_before
        base_load_before = base_load
        base_load, y[i], z[i], residual[i], attempts[i] = solve(
            problem, base_load, extrapolated, retry and converged.all()
        )
        converged[i] = residual[i] <= RESIDUAL_TOLERANCE
        evaluations[i] = problem.evaluations
        f_tendon_before = f_tendon

    return Result(np.concatenate([y, z], axis=2), converged, residual, evaluations, attempts)


def sine(period: float, steps: int, dt: float = 0.05) -> np.ndarray:
    """(steps, 4) N: 6 N ± 1 N, a quarter period between neighbouring tendons; row i - 1 is control i."""
    t = dt * np.arange(1, steps + 1)[:, None]
    return 6 + np.sin(2 * np.pi * t / period + np.arange(4) * np.pi / 2)


def step(height: float, steps: int, dt: float = 0.05) -> np.ndarray:
    """(steps, 4) N: 5 N, the first and the last tendon at 5 N + `height` from 1.5 s on."""
    t = dt * np.arange(1, steps + 1)
    tensions = np.full((steps, 4), 5.0)
    # The margin keeps the jump on its step when i · dt rounds to just below 1.5.
    tensions[np.ix_(t >= 1.5 - 1e-9, [0, 3])] += height
    return tensions


def random(seed: int, steps: int) -> np.ndarray:
    """(steps, 4) N: uniform between 5 N and 10 N, anew for every step and tendon."""
    return 5 + 5 * np.random.default_rng(seed).random((steps, 4))


TRUE_ROBOT = PaperRobot()
IMPERFECT = {
    "self-weight": replace(TRUE_ROBOT, gravity=(0.0, 0.0, 0.0)),
    "length": replace(TRUE_ROBOT, length=0.4),
    "stiffness": replace(TRUE_ROBOT, youngs_modulus=10e9),
    "length & stiffness": replace(TRUE_ROBOT, length=0.4, youngs_modulus=10e9),
}
PUBLISHED = {
    ("self-weight", "sine"): (1.75, 0.09),
    ("length", "sine"): (40.16, 16.46),
    ("stiffness", "sine"): (19.99, 12.52),
    ("length & stiffness", "sine"): (42.70, 23.13),
    ("self-weight", "step"): (1.30, 0.23),
    ("length", "step"): (32.88, 14.90),
    ("stiffness", "step"): (13.92, 11.15),
    ("length & stiffness", "step"): (34.57, 21.44),
}
"""Baseline tip DTW and pose MSE × 1000 in the paper's table of simulation results."""


def print_table(controls: dict[str, np.ndarray], retry: bool) -> None:
    """Print each imperfect model's distance from the true robot beside the published one."""
    # Imported here so that the transcription itself needs nothing but NumPy and SciPy.
    from knode_cosserat.metrics import pose_mse, tip_dtw

    print("Every step solved" if retry else "As published: one fsolve a step, unchecked")
    print(f"{'imperfection':<20}{'control':<9}{'DTW':>7}{'paper':>8}{'MSE':>8}{'paper':>8}  notes")
    truths = {name: simulate(TRUE_ROBOT, tensions, retry=retry) for name, tensions in controls.items()}
    for (imperfection, control), (paper_dtw, paper_mse) in PUBLISHED.items():
        truth = truths[control]
        result = simulate(IMPERFECT[imperfection], controls[control], retry=retry)
        notes = [
            f"{who} {what} in rows {np.flatnonzero(rows).tolist()}"
            for who, run in (("true robot", truth), ("model", result))
            for what, rows in (("retried", run.attempts > 1), ("not converged", ~run.converged))
            if rows.any()
        ]
        print(
            f"{imperfection:<20}{control:<9}{tip_dtw(result, truth):7.2f}{paper_dtw:8.2f}"
            f"{pose_mse(result, truth):8.2f}{paper_mse:8.2f}  {'; '.join(notes)}"
        )
    print()


def print_time_per_step(controls: dict[str, np.ndarray]) -> None:
    """Print the best of three runs of the true robot."""
    for retry in (True, False):
        for name, tensions in controls.items():
            seconds = []
            for _ in range(3):
                start = time.perf_counter()
                result = simulate(TRUE_ROBOT, tensions, retry=retry)
                seconds.append(time.perf_counter() - start)
            print(
                f"{'checked' if retry else 'paper':<9}{name:<6}{1e3 * min(seconds) / len(tensions):6.2f} ms "
                f"and {result.evaluations[1:].mean():.1f} integrations along the rod a step"
            )


def main() -> None:
    """Print the baselines beside the published ones, solved and as published, and the time a step takes."""
    # The paper keeps 100 rows, the rest state among them.
    controls = {"sine": sine(1.5, steps=99), "step": step(1.5, steps=99)}
    for retry in (True, False):
        print_table(controls, retry)
    print_time_per_step(controls)


if __name__ == "__main__":
    main()
