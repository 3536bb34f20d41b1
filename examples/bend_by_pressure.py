"""Three soft actuators, one after the other along a hanging rod, bend it into an S.

A control may change the rest curvature and the stiffness of a section: a pneumatic robot, or one that heat
or a magnet bends. No tendon is needed.
"""

import numpy as np

import knode_cosserat as kc


def main(out: str = "bend_by_pressure.png", steps: int = 100) -> kc.Trajectory:
    """Drive the first and the third section in opposite directions, one after the other."""
    robot = kc.load_robot("variable-curvature-robot").replace(nodes=25)
    part = np.linspace(0.0, 1.0, steps)
    first = np.clip(2.0 * part, 0.0, 1.0)
    third = -np.clip(2.0 * part - 1.0, 0.0, 1.0)
    bent = kc.simulate(robot, np.stack([2.0 * first, 0.0 * part, 3.0 * third], axis=1), 0.02)
    kc.figures.shape(bent, count=8, view="xz").savefig(out)
    u = np.asarray(bent.part("u"))[-1, :, 1]
    print(f"curvature at the base {u[1]:.1f} 1/m, near the tip {u[-2]:.1f} 1/m; picture: {out}")
    return bent


if __name__ == "__main__":
    main()
