"""Two curved tubes in one another are turned against each other: smoothly, or past the limit with a snap.

The limit is a known product of length and curvatures, L κ √(EI/GJ) = π/2 for equal tubes. Below it the tip
follows the base. Beyond it the tubes store torsion, snap at different angles there and back, and some tip
angles cannot be reached.
"""

import matplotlib.pyplot as plt
import numpy as np

import knode_cosserat as kc
from knode_cosserat.rods.tubes import ConcentricTubeRobot, Tube

LENGTH = 0.2
#: outer and inner radius (m) of the two tubes
RADII = ((0.35e-3, 0.2e-3), (0.7e-3, 0.45e-3))


def pair(curvature: float) -> ConcentricTubeRobot:
    """Return two tubes of nickel-titanium with the same curvature (1/m)."""
    nitinol = {"youngs_modulus": 6e10, "density": 6450.0, "curvature": curvature}
    tubes = tuple(Tube(radius=outer, inner_radius=inner, **nitinol) for outer, inner in RADII)
    damping = {"bending_damping": 1e-5, "tube_friction": 1e-4}
    return ConcentricTubeRobot(length=LENGTH, gravity=(0.0, 0.0, 0.0), nodes=33, tubes=tubes, **damping)


def limit() -> float:
    """Return the curvature (1/m) beyond which the two tubes snap."""
    EI, GJ = pair(1.0).cross_section.EI, pair(1.0).cross_section.GJ
    return float(np.pi / 2 / LENGTH / np.sqrt(EI[0] * EI[1] / EI.sum() * (1 / GJ).sum()))


def main(out: str = "concentric_tubes.png", steps: int = 300) -> dict[float, float]:
    """Turn the outer tube once around and back, for curvatures below and beyond the limit."""
    turn = np.linspace(0.0, 2.0 * np.pi, steps)
    figure, axes = plt.subplots(1, 3, figsize=(9.0, 3.2), layout="constrained", sharey=True)
    jumps = {}
    for axis, factor in zip(axes, (0.7, 1.0, 1.6), strict=True):
        robot = pair(factor * limit())
        for name, angles, style in (("there", turn, "-"), ("back", turn[::-1], "--")):
            controls = np.zeros((steps, 4))
            controls[:, 2] = angles
            start = kc.equilibrium(robot, controls[0])
            angle = kc.simulate(robot, controls, 0.02, initial=start).part("angle")[1:, -1]
            tip = np.rad2deg(np.diff(angle, axis=1)[:, 0])
            jumps[factor] = float(np.abs(np.diff(tip)).max())
            axis.plot(np.rad2deg(angles), tip, style, label=name)
        axis.set(title=f"{factor:g} × the limit", xlabel="relative angle at the base (°)")
        print(f"{factor:g} times the limit: largest change of the tip's angle in a step {jumps[factor]:.0f}°")
    axes[0].set_ylabel("relative angle at the tip (°)")
    axes[0].legend()
    figure.savefig(out, dpi=150)
    return jumps


if __name__ == "__main__":
    main()
