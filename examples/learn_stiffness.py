"""Learn the error of a model that is 3.6 times too stiff from three seconds of motion.

`fit` does not know which parameter is wrong. From two short sines it finds that the strains cause too much
stress, and `explain` lists the terms. The model then predicts held-out controls.
"""

import knode_cosserat as kc

DT = 0.05


def main(out: str = "learn_stiffness.png", steps: int = 100) -> tuple[float, float]:
    """Fit, explain, and predict random tensions; return the tip's errors (RMSE in m) before and after."""
    robot = kc.load_robot("delrin-tendon-robot")  # stands for the real one
    model = robot.replace(youngs_modulus=10e9)
    data = [kc.simulate(robot, kc.controls.sine(period, 30, DT), DT) for period in (0.5, 1.0)]
    learned = kc.fit(model, data)
    print("what it adds:", *kc.learning.explain(learned), sep="\n  ")

    unseen = kc.controls.random(steps, seed=3, hold=10)
    truth, before, after = (kc.simulate(each, unseen, DT) for each in (robot, model, learned))
    kc.figures.compare(truth, {"before": before, "after": after}).savefig(out)
    errors = kc.metrics.tip_rmse(before, truth), kc.metrics.tip_rmse(after, truth)
    print(f"tip RMSE on tensions it has not seen: {errors[0]:.2g} m before, {errors[1]:.2g} m after")
    return errors


if __name__ == "__main__":
    main()
