"""Simulate the paper's tendon-driven robot for five seconds, and plot the result.

A robot is a file (here from the catalog), its tensions are an array, and the result is a trajectory that
states for every step how it was solved.
"""

import knode_cosserat as kc


def main(out: str = "papers_robot.png", steps: int = 100) -> kc.Trajectory:
    """Pull four tendons in turn, so that the tip moves on a circle."""
    robot = kc.load_robot("delrin-tendon-robot")
    tensions = kc.controls.sine(period=1.5, steps=steps, dt=0.05)  # (steps, 4) in N
    truth = kc.simulate(robot, tensions, dt=0.05)
    truth.require_valid()
    kc.figures.overview(truth).savefig(out)
    x, y, z = truth.tip_position[-1]
    print(f"{steps} steps; the tip ends at ({x:.3f}, {y:.3f}, {z:.3f}) m; picture: {out}")
    return truth


if __name__ == "__main__":
    main()
