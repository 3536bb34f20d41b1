"""A model that is 3.6 times too stiff learns from three seconds of motion what it misses.

It is not told what is wrong. Two short sines are enough for `fit` to find that the strains are answered by
too much stress, and `explain` says so; then it predicts controls that it has never seen.
"""

import typer

import knode_cosserat as kc

DT = 0.05


def main(out: str = "learn_stiffness.png", steps: int = 100) -> tuple[float, float]:
    """Fit, explain, and predict random tensions; the tip's errors (RMSE in m) before and after."""
    robot = kc.load_robot("delrin-tendon-robot")  # stands for the real one
    model = robot.replace(youngs_modulus=10e9)
    data = [kc.simulate(robot, kc.controls.sine(period, 30, DT), DT) for period in (0.5, 1.0)]
    learned = kc.fit(model, data)
    print("what it adds:", *kc.explain(learned), sep="\n  ")

    unseen = kc.controls.random(steps, seed=3, hold=10)
    truth, before, after = (kc.simulate(each, unseen, DT) for each in (robot, model, learned))
    kc.figures.compare(truth, {"before": before, "after": after}).savefig(out)
    errors = kc.tip_rmse(before, truth), kc.tip_rmse(after, truth)
    print(f"tip RMSE on tensions it has not seen: {errors[0]:.2g} m before, {errors[1]:.2g} m after")
    return errors


if __name__ == "__main__":
    typer.run(main)
