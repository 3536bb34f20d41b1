"""Identify stiffness and damping of a robot from one noisy motion, with confidence intervals.

If the equations are right and only parameters are wrong, this is the shortest way. Whole simulations are
compared with everything that was measured.
"""

import dataclasses

import numpy as np

import knode_cosserat as kc

DT, NAMES = 0.05, ("youngs_modulus", "bending_damping")


def main(
    out: str = "calibrate_parameters.png", steps: int = 60, noise: float = 1e-3
) -> kc.identification.Identified:
    """Identify from a sine with noise (m, and of other states alike), and predict random tensions."""
    robot = kc.load_robot("delrin-tendon-robot")  # stands for the real one
    guess = robot.replace(youngs_modulus=1.5e9, bending_damping=0.05)
    seen = kc.simulate(robot, kc.controls.sine(1.0, steps, DT), DT)
    rng = np.random.default_rng(0)
    noisy = np.asarray(seen.y) + rng.normal(0.0, noise, seen.y.shape)
    noisy[0] = seen.y[0]  # it begins at rest, and that is known
    found = kc.identify(guess, [dataclasses.replace(seen, y=noisy)], parameters=NAMES)
    print(found)

    unseen = kc.controls.random(steps, seed=1, hold=10)
    truth, before, after = (kc.simulate(each, unseen, DT) for each in (robot, guess, found.robot))
    kc.figures.error(truth, {"before": before, "after": after}).savefig(out)
    errors = [kc.metrics.tip_rmse(each, truth) for each in (before, after)]
    print(f"tip RMSE {errors[0]:.2g} m before, {errors[1]:.2g} m after")
    return found


if __name__ == "__main__":
    main()
