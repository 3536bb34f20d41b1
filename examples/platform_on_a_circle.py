"""Six flexible legs move a level platform around a circle.

Inverse kinematics finds the displacement of each leg's actuator for a position and orientation of the
platform. The dynamic simulation then shows the motion of the platform at that speed.
"""

import numpy as np

import knode_cosserat as kc


def main(
    out: str = "platform_on_a_circle.png", points: int = 40, radius: float = 0.03
) -> tuple[kc.statics.InverseKinematics, kc.Trajectory]:
    """Return actuator displacements (points, 6) in m for a circle of this radius (m), and the motion."""
    robot = kc.load_robot("six-legged-robot")
    still = kc.equilibrium(robot, np.zeros(6))
    centre, level = still.tip_position[0], np.asarray(still.quaternion)[0, -1]
    turn = np.linspace(0.0, 2.0 * np.pi, points)
    grow = np.minimum(1.0, 4.0 * turn / (2.0 * np.pi))[:, None]  # out to the circle in a quarter turn
    wanted = centre + radius * grow * np.stack([np.cos(turn), np.sin(turn), 0.0 * turn], axis=1)
    found = kc.inverse_kinematics(
        robot, wanted, np.tile(level, (points, 1)), low=-0.1, high=0.1, initial=np.zeros(6)
    )
    moved = kc.simulate(robot, found.control, 0.1, initial=still)
    kc.figures.shape(moved, count=3, columns=1).savefig(out)
    off = np.linalg.norm(np.asarray(moved.tip_position)[1:] - wanted, axis=1)
    print(f"{np.sum(found.converged)} of {points} poses reached; in motion off by {1e3 * off.max():.1f} mm")
    return found, moved


if __name__ == "__main__":
    main()
