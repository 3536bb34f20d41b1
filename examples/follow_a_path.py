"""Follow a figure of eight with the tip: inverse kinematics, each point starting from the last.

The paper's robot bends in two directions, so x and y of its tip can be prescribed, but not z as well.
`pose` defines the prescribed quantities: here two coordinates of the last node.
"""

import numpy as np

import knode_cosserat as kc


def across(robot, y):
    """Return x and y of a state's position (m), and no orientation."""
    return kc.robots.Drawing.of(robot).positions(y)[:2], None


def main(out: str = "follow_a_path.png", points: int = 60) -> kc.statics.InverseKinematics:
    """Return the tensions (points, 4) in N that follow the eight, and the error of each point."""
    robot = kc.load_robot("delrin-tendon-robot")
    turn = np.linspace(0.0, 2.0 * np.pi, points)
    wanted = np.stack([0.25 * np.sin(turn), 0.15 * np.sin(2.0 * turn)], axis=1)
    found = kc.inverse_kinematics(robot, wanted, low=1.0, high=10.0, pose=across)
    kc.figures.path({"wanted": wanted, "reached": found.position}).savefig(out)
    reached, worst = np.sum(found.converged), np.max(found.position_error)
    print(f"{reached} of {points} points reached; the farthest is off by {worst:.1e} m")
    print(f"tensions from {found.control.min():.2f} to {found.control.max():.2f} N")
    return found


if __name__ == "__main__":
    main()
