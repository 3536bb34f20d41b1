"""Workspace of a robot: thousands of equilibria, spread evenly over all tensions.

Each is solved from the unloaded robot, so none depends on another. Unsolved cases are reported and not drawn.
A limit of the curvature excludes shapes that would break the rod.
"""

import numpy as np

import knode_cosserat as kc


def main(out: str = "where_it_reaches.png", count: int = 5000) -> kc.statics.Workspace:
    """Return the workspace for tensions from 0 to 10 N."""
    robot = kc.load_robot("delrin-tendon-robot")
    found = kc.workspace(robot, 0.0, 10.0, count)
    kc.figures.workspace(found).savefig(out)
    gentle = found.within(u=4.0)  # 1/m: bent to a radius of 25 cm at most
    low, high = np.nanmin(found.position, axis=0), np.nanmax(found.position, axis=0)
    print(f"{count} equilibria, {found.unsolved} of them not solved; {np.sum(gentle)} bent less than 4 1/m")
    print(f"the tip is between {np.round(low, 3)} and {np.round(high, 3)} m")
    return found


if __name__ == "__main__":
    main()
