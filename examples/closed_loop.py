"""Predictive control of a robot that is softer than its model and carries an unknown mass (simulated).

The controller measures only the tip's position, with noise. Its observer adapts Young's modulus and a mass at
the tip while the robot moves. Inverse kinematics with an integral, on the same model, is the comparison.
"""

import knode_cosserat as kc

DT = 0.05


def main(out: str = "closed_loop.png", seconds: float = 10.0) -> dict[str, kc.control.LoopLog]:
    """Return the logs of both controllers; errors are those of the second half."""
    model = kc.load_robot("delrin-tendon-robot").replace(loads=(kc.robots.loads.AttachedMass(mass=0.0),))
    robot = model.replace(youngs_modulus=0.75 * float(model.youngs_modulus), **{"loads.0.mass": 0.02})
    limits = kc.control.ControlLimits(low=0.0, high=10.0, rate=40.0)  # N, N/s
    adapted = ["youngs_modulus", kc.estimation.Adapted("loads.0.mass", deviation=0.03)]
    logs = {}
    for name in ("predictive", "kinematic"):
        adapt = adapted if name == "predictive" else ()
        controller = kc.control.controller_named(name, model, DT, limits, adapt)
        sensor = kc.control.Sensor(kc.estimation.TipPosition(), noise=1.0)
        plant = kc.control.SimulatedPlant(robot, DT, sensor)
        log = kc.control.run_loop(controller, plant, kc.control.circle(0.1, period=2.0), seconds)
        print(f"{name}: {1e3 * log.tip_rmse(0.5 * seconds):.2f} mm; {log}")
        logs[name] = log
    kc.figures.closed_loop(logs["predictive"]).savefig(out)
    return logs


if __name__ == "__main__":
    main()
