"""A catheter is fed out of a sheath into a side branch: insertion and field that lead its tip along the way.

The controls are the length that is fed and the field. Inverse kinematics finds them for points of the
centreline. The motion through them is then simulated, with the momentum of the material that enters.
"""

import numpy as np

import knode_cosserat as kc

BRANCH = np.radians(75.0)  # angle between the vessel and its branch


def centreline(part: np.ndarray, straight: float = 0.005, bend: float = 0.025) -> np.ndarray:
    """Return points (m) from the mouth of the sheath: straight on, then an arc of the radius `bend`."""
    way = part * (straight + bend * BRANCH)
    angle = np.maximum(way - straight, 0.0) / bend
    return np.stack(
        [bend * (1.0 - np.cos(angle)), 0.0 * way, np.minimum(way, straight) + bend * np.sin(angle)], axis=1
    )


def place(robot, y):
    """Return the position of a state (m), and no orientation."""
    return kc.robots.Drawing.of(robot).positions(y), None


def main(out: str = "feed_a_catheter.png", points: int = 41, dt: float = 0.025) -> dict[str, np.ndarray]:
    """Return the wanted path and that of the moving tip (m), each (points, 3)."""
    robot = kc.load_robot("fed-catheter")
    wanted = np.array([0.0, 0.0, float(robot.length)]) + centreline(np.linspace(0.0, 1.0, points))
    # of the field only x, across the sheath and in the branch's plane
    limits = np.array([0.02, 0.0, 0.0])  # T
    low, high = [*-limits, -0.015], [*limits, 0.04]
    controls = kc.inverse_kinematics(robot, wanted, low=low, high=high, pose=place).control
    moved = kc.simulate(robot, controls[1:], dt, between="linear", time="bdf2")
    tip = np.asarray(moved.tip_position)
    figure = kc.figures.shape(moved, view="xz")
    figure.axes[0].plot(*wanted[:, [0, 2]].T, "k:", label="centreline")
    figure.axes[0].legend(loc="lower right", fontsize="x-small", frameon=False)
    figure.savefig(out)
    field, fed = 1e3 * np.abs(controls[:, 0]).max(), 1e3 * controls[-1, 3]
    print(f"field up to {field:.2f} mT, {fed:.1f} mm fed in {dt * len(tip[1:]):g} s")
    print(
        f"the moving tip is off the centreline by {1e3 * np.linalg.norm(tip - wanted, axis=1).max():.2f} mm"
    )
    return {"centreline": wanted, "tip": tip}


if __name__ == "__main__":
    main()
