"""A soft robot is pushed along a table and climbs over a cylinder: contact and friction.

A control moves its base, and the rest follows from contact. A step that is hard to solve is reached by
continuation from easier ones, and its result reports it.
"""

import numpy as np

import knode_cosserat as kc


def main(out: str = "over_an_obstacle.png", seconds: float = 6.0, reach: float = 0.32) -> kc.Trajectory:
    """Push the base forward by `reach` (m), and lift it a little on the way."""
    robot = kc.load_robot("soft-slender-robot")
    dt = 0.02
    part = np.arange(1, round(seconds / dt) + 1) / round(seconds / dt)
    forward = reach * (3 * part**2 - 2 * part**3)
    lifted = 0.02 * np.sin(np.pi * part) ** 2
    push = np.stack([forward, lifted, 0.0 * part], axis=1)
    # order 4 along the rod: the robot bends sharply where it touches
    lying = kc.equilibrium(robot, np.zeros(3), space="lobatto4")
    pushed = kc.simulate(robot, push, dt, space="lobatto4", initial=lying)
    kc.figures.shape(pushed, count=8, view="xz", columns=2).savefig(out)
    harder = int(np.sum(np.asarray(pushed.result) > kc.Result.COARSE))
    print(f"{len(part)} steps solved, {harder} of them by a fallback; picture: {out}")
    return pushed


if __name__ == "__main__":
    main()
