"""Find the tensions that bring the tip to a target in one second, by the gradient of the whole simulation.

Every solved step is differentiable by the implicit function theorem, so SciPy's optimiser can change all
tensions at once. The tip reaches the target at rest, because all of the last rows enter the objective.
"""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize

import knode_cosserat as kc

DT, KNOTS, TARGET = 0.05, 6, np.array([0.15, 0.10])
REST = 5.0  # N, what all tendons are pulled with


def main(out: str = "hit_a_target.png", steps: int = 20, iterations: int = 40) -> tuple[float, np.ndarray]:
    """Return the final distance of the tip from the target (m), and the tensions (steps, 4) in N."""
    robot = kc.load_robot("delrin-tendon-robot")
    places = np.linspace(0.0, KNOTS - 1.0, steps)

    def tensions(pulls):  # two pairs of opposite tendons, linear between knots
        a, b = (jnp.interp(places, np.arange(KNOTS), each) for each in pulls.reshape(2, KNOTS))
        return REST + jnp.stack([a, b, -a, -b], axis=1)

    def miss(pulls):
        tip = kc.simulate(robot, tensions(pulls), DT).tip_position[-4:, :2]
        return 1e4 * jnp.mean(jnp.sum((tip - TARGET) ** 2, axis=1)) + 1e-3 * jnp.sum(pulls**2)

    start, limits = np.zeros(2 * KNOTS), [(-REST, REST)] * (2 * KNOTS)
    slope = jax.jit(jax.value_and_grad(miss))
    options = {"maxiter": iterations}
    found = minimize(slope, start, jac=True, bounds=limits, method="L-BFGS-B", options=options)

    pulled = np.asarray(tensions(found.x))
    moved = kc.simulate(robot, pulled, DT)
    missed = float(np.linalg.norm(moved.tip_position[-1, :2] - TARGET))
    kc.figures.overview(moved).savefig(out)
    print(f"{found.nfev} simulations with gradients; the tip ends {1e3 * missed:.1f} mm from the target")
    return missed, pulled


if __name__ == "__main__":
    main()
