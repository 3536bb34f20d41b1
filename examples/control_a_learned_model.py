"""Learn what the model misses from two recordings, and control the robot with and without it (simulated).

The robot is softer and shorter than its model says. The residual on the spatial derivative is learned from
two short motions. The same controller then follows a circle with the model and with the learned one.
"""

import knode_cosserat as kc

DT = 0.05


def main(out: str = "control_a_learned_model.png", seconds: float = 10.0) -> dict[str, kc.control.LoopLog]:
    """Return the logs by the model's name; errors are those of the second half."""
    model = kc.load_robot("delrin-tendon-robot")
    robot = model.replace(youngs_modulus=0.8 * float(model.youngs_modulus), tendon_offset=0.018)
    recordings = [
        kc.simulate(robot, kc.controls.sine(period=period, steps=40, dt=DT), DT) for period in (1.0, 2.0)
    ]
    learned = kc.fit(model, recordings)
    tip = kc.estimation.TipPosition()
    limits = kc.control.ControlLimits(low=0.0, high=10.0, rate=40.0)  # N, N/s
    logs = {}
    for name, used in (("model", model), ("learned", learned)):
        controller = kc.control.controller_named("predictive", used, DT, limits)
        plant = kc.control.SimulatedPlant(robot, DT, kc.control.Sensor(tip, noise=1.0))
        log = kc.control.run_loop(controller, plant, kc.control.circle(0.1, period=2.0), seconds)
        print(f"{name}: tip RMSE {1e3 * log.tip_rmse(0.5 * seconds):.2f} mm")
        logs[name] = log
    paths = {"target": logs["model"].reference[:, :2]} | {name: log.tip[:, :2] for name, log in logs.items()}
    kc.figures.path(paths).savefig(out)
    return logs


if __name__ == "__main__":
    main()
