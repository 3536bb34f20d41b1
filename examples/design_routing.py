"""Design a robot for a workspace: 18 holes for tendons and a stiffness, by the gradient of 16 equilibria.

Two levers set the tensions. The tip, with a camera of 20 g, should follow them on a pane, evenly and
without a model. A design with an equilibrium that is unsolved or coarse is refused. Held-out places of the
levers are between the others.
"""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from scipy.optimize import minimize

import knode_cosserat as kc

DISKS = np.array([0.0, 0.5, 1.0])  # their places along the rod
ANGLES = 2.0 * np.pi / 3.0 * np.arange(3)  # of the tendons of the first design
ROBOT = kc.robots.RoutedTendonRobot(
    length=0.4, radius=0.0025, density=1400.0, youngs_modulus=1.2e9, nodes=16, tendon_offset=0.012,
    tendon_angles=ANGLES, loads=(kc.robots.loads.AttachedMass(mass=0.02),),
    routing=[kc.robots.routing.Polynomial(x=np.zeros(3), y=np.zeros(3)) for _ in ANGLES],
)  # fmt: skip
# holes (tendon, disk, xy) in cm, and Young's modulus as log(E / GPa)
STRAIGHT = 1.2 * np.repeat(np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=1)[:, None], 3, axis=1)
FIRST = np.append(STRAIGHT, np.log(1.2))
BOUNDS = [(-2.0, 2.0)] * 18 + [(np.log(0.5), np.log(3.0))]
CLEARANCE = 0.5  # cm, of tendons from the rod's axis


def coefficients(design):
    """Return those (tendon, power, xy) of each tendon's parabola through its holes, in cm."""
    return jnp.linalg.solve(np.vander(DISKS, increasing=True), jnp.reshape(design[:-1], (3, 3, 2)))


def designed(design):
    """Return the robot with these holes and this stiffness."""
    paths = 0.01 * coefficients(design)
    changes = {f"routing.{i}.{axis}": paths[i, :, k] for i in range(3) for k, axis in enumerate("xy")}
    return ROBOT.replace(youngs_modulus=1e9 * jnp.exp(design[-1]), **changes)


def distances(design):
    """Return distances of the tendons from the rod's axis (cm), at many places."""
    points = np.vander(np.linspace(0.0, 1.0, 21), 3, increasing=True) @ coefficients(design)
    return jnp.sqrt(jnp.sum(points**2, axis=-1) + 1e-9)


def task(places):
    """Return tensions (B, 3) in N and targets (B, 3) in m, for all pairs of places of the levers."""
    u, v = (each.ravel() for each in np.meshgrid(places, places))
    tensions = np.stack([9.0 + 4.0 * v, 2.0 + 2.0 * u, 2.0 - 2.0 * u], axis=1)
    return tensions, np.stack([np.full(u.size, 0.28), 0.06 * u, 0.18 - 0.06 * v], axis=1)


def checked_tips(design, tensions):
    """Return the tips (B, 3) in m of equilibria that are all solved on a fine grid."""
    shapes = kc.equilibrium(designed(design), tensions)
    if np.any(shapes.result != 0):
        raise RuntimeError(f"{np.sum(shapes.result != 0)} equilibria are not CONVERGED: no error is reported")
    return np.asarray(shapes.tip_position[:, 0])


def main(out: str = "design_routing.png", iterations: int = 300) -> tuple[dict[str, np.ndarray], float]:
    """Return the distances (m) of tips from targets, and the relative error of the gradient."""
    tensions, targets = task(np.linspace(-1.0, 1.0, 4))

    def error(design):  # mean square, cm², with a penalty for tendons that are too close to the rod
        tips = kc.equilibrium(designed(design), tensions).tip_position[:, 0]
        close = jnp.maximum(CLEARANCE - distances(design), 0.0)
        return 1e4 * jnp.mean(jnp.sum((tips - targets) ** 2, axis=1)) + 1e3 * jnp.mean(close**2)

    slope, step = jax.jit(jax.value_and_grad(error)), 1e-5 * np.random.default_rng(0).normal(size=FIRST.size)
    difference = 0.5 * (slope(FIRST + step)[0] - slope(FIRST - step)[0])
    wrong = abs(float(slope(FIRST)[1] @ step / difference) - 1.0)
    found = minimize(slope, FIRST, jac=True, bounds=BOUNDS, options={"maxiter": iterations}).x

    figure, (holes, pane) = plt.subplots(1, 2, figsize=(9.0, 4.6), layout="constrained")
    missed, unseen = {}, task(np.linspace(-0.8, 0.8, 5))
    for name, design, (pulls, goals), color in (
        ("before", FIRST, (tensions, targets), "0.6"),
        ("after", found, (tensions, targets), "C0"),
        ("held-out", found, unseen, "C1"),
    ):
        tips = checked_tips(design, pulls)
        missed[name] = np.linalg.norm(tips - goals, axis=1)
        pane.plot(*1e3 * goals[:, 1:].T, "+", color="k", markersize=9)
        pane.plot(*1e3 * tips[:, 1:].T, "o", color=color, markersize=4, label=f"tips, {name}")
        for tendon in design[:-1].reshape(3, 3, 2) if name != "held-out" else ():
            holes.plot(*10 * tendon.T, "-", color=color)
            holes.scatter(*10 * tendon.T, s=(110, 50, 12), color=color)
        average, most = 1e3 * missed[name].mean(), 1e3 * missed[name].max()
        print(f"{name}: {average:.1f} mm from the targets on average, {most:.1f} mm at most")
    holes.set(xlabel="x (mm)", ylabel="y (mm)", title="holes, base (large) to tip (small)", aspect="equal")
    pane.set(xlabel="y (mm)", ylabel="z (mm)", title="tips and targets (+) from the front", aspect="equal")
    figure.legend(loc="outside lower center", ncols=3)
    figure.savefig(out, dpi=110)
    nearest = 10.0 * float(distances(found).min())
    print(
        f"Young's modulus {np.exp(found[-1]):.2f} GPa; the tendons are {nearest:.1f} mm from the axis or more"
    )
    print(f"the gradient differs from central differences by {wrong:.0e} of its size")
    return missed, wrong


if __name__ == "__main__":
    main()
