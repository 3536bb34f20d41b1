"""A deflected rod with a tip mass is released, and vibrates at the frequency of beam theory.

Beam theory gives the frequency of a cantilever with a tip mass as the root of an equation. The simulation
does not use it: it has a rod, a rigid body and a force that vanishes.
"""

import numpy as np
from scipy.optimize import brentq

import knode_cosserat as kc

LENGTH, RADIUS, DENSITY, E, MASS = 0.3, 0.002, 1200.0, 3e9, 0.01


def known_frequency() -> float:
    """Return the frequency (Hz) from the root β of 1 + cos cosh + (M/ρAL) β (cos sinh - sin cosh) = 0."""
    rod = DENSITY * np.pi * RADIUS**2  # kg/m
    ratio, EI = MASS / (rod * LENGTH), E * np.pi * RADIUS**4 / 4
    beta = brentq(
        lambda b: 1 + np.cos(b) * np.cosh(b) + ratio * b * (np.cos(b) * np.sinh(b) - np.sin(b) * np.cosh(b)),
        0.1,
        1.875,
    )
    return float(beta**2 / LENGTH**2 * np.sqrt(EI / rod) / (2 * np.pi))


def main(out: str = "cut_the_thread.png", steps: int = 128, nodes: int = 11) -> tuple[float, float]:
    """Return the frequencies (Hz): simulated, and from beam theory."""
    thread = kc.robots.loads.PointWrench(force=(0.05, 0.0, 0.0), at=1.0, controlled=True)
    robot = kc.robots.SlenderRod(
        length=LENGTH,
        radius=RADIUS,
        density=DENSITY,
        youngs_modulus=E,
        gravity=(0.0, 0.0, 0.0),
        loads=(kc.robots.loads.AttachedMass(mass=MASS), thread),
        nodes=nodes,
    )
    held = kc.equilibrium(robot, np.ones(1), space="lobatto4")
    known = known_frequency()
    dt = 1 / (40 * known)
    swings = kc.simulate(robot, np.zeros((steps, 1)), dt, time="trapezoidal", space="lobatto4", initial=held)
    x, time = np.asarray(swings.tip_position)[:, 0], np.asarray(swings.time)
    down = np.flatnonzero((x[:-1] > 0) & (x[1:] <= 0))
    crossings = time[down] + dt * x[down] / (x[down] - x[down + 1])
    found = float(1 / np.mean(np.diff(crossings)))
    theory = x[0] * np.cos(2 * np.pi * known * time)
    lines = {"beam theory": theory, "simulated": x}
    kc.figures.curves(time, lines, "time [s]", "tip x [m]").savefig(out)
    print(f"{found:.3f} Hz simulated, {known:.3f} Hz by beam theory")
    return found, known


if __name__ == "__main__":
    main()
