"""Predictive control along a wall: a soft limit keeps the tip off it while the target moves behind it.

The target moves on a circle, of which a part lies behind the wall. The controller predicts one second ahead,
so that the tip is at the wall without having touched it, and leaves it where the target comes back.
"""

import numpy as np

import knode_cosserat as kc

DT = 0.05


def main(out: str = "keep_off_a_wall.png", seconds: float = 12.0, wall: float = 0.05) -> kc.control.LoopLog:
    """Return the log of the loop; the wall is at x = `wall` (m)."""
    robot = kc.load_robot("delrin-tendon-robot")
    tip = kc.estimation.TipPosition()
    observer = kc.estimation.KalmanObserver(robot, DT, tip, adapt=["youngs_modulus"])
    behind = kc.control.SoftLimit(tip, high=[wall, np.inf, np.inf])
    limits = kc.control.ControlLimits(low=0.0, high=10.0, rate=40.0)  # N, N/s
    controller = kc.control.PredictiveController(observer, tip, limits, soft=[behind])
    plant = kc.control.SimulatedPlant(robot, DT, kc.control.Sensor(tip, noise=1.0))
    log = kc.control.run_loop(controller, plant, kc.control.circle(0.1, period=4.0), seconds)
    beyond = 1e3 * max(0.0, float(log.tip[:, 0].max()) - wall)
    print(f"the tip is at most {beyond:.2f} mm behind the wall; the target {1e3 * (0.1 - wall):.0f} mm")
    free = log.reference[:, 0] < wall - 0.02
    print(f"where the target is free, the tip is {1e3 * log.tip_distance[free][20:].mean():.1f} mm from it")
    kc.figures.path({"target": log.reference[:, :2], "tip": log.tip[:, :2]}).savefig(out)
    return log


if __name__ == "__main__":
    main()
