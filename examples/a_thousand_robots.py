"""Uncertainty of a prediction: simulate a thousand robots with stiffness and density known to 10 % only.

A list of robots runs as one compiled, batched program on all cores. The bands show the distribution of the
tips, and therefore the value of a measurement of the material.
"""

import numpy as np

import knode_cosserat as kc


def main(out: str = "a_thousand_robots.png", robots: int = 1000, steps: int = 60) -> kc.Trajectory:
    """Simulate a batch of robots under the same tensions."""
    robot = kc.load_robot("delrin-tendon-robot")
    rng = np.random.default_rng(0)
    factors = rng.normal(1.0, 0.1, (robots, 2)).clip(0.6, 1.4)
    drawn = [
        robot.replace(youngs_modulus=robot.youngs_modulus * one, density=robot.density * other)
        for one, other in factors
    ]
    batch = kc.simulate(drawn, kc.controls.sine(period=1.5, steps=steps, dt=0.05), dt=0.05)
    kc.figures.spread(batch).savefig(out)
    spread = np.std(np.asarray(batch.tip_position)[:, -1], axis=0)
    print(f"{robots} robots, {np.sum(~np.asarray(batch.valid))} steps not solved")
    print(f"the last tips are spread by {100 * np.linalg.norm(spread):.1f} cm (standard deviation)")
    return batch


if __name__ == "__main__":
    main()
