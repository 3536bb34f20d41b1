"""A gripper of three tendon fingers on a tendon-driven arm closes on a ball; then the arm pulls aside.

Arm, palm and fingers are one assembly: rods that rigid bodies join. The ball is an obstacle that does not
move. Its grip resists the arm, whose palm moves less than with open fingers, which pass the ball.
"""

import matplotlib.pyplot as plt
import numpy as np

import knode_cosserat as kc

FINGERS = ("thumb", "index", "middle")
#: centre and radius of the ball (m)
CENTRE, RADIUS = np.array([0.0, 0.0, 0.325]), 0.015


def main(out: str = "gripper.png", points: int = 9, most: float = 4.0) -> dict[str, np.ndarray]:
    """Close the fingers with up to `most` (N), then pull the arm; return grips (N), displacements (m)."""
    ball = kc.robots.surroundings.Sphere(center=CENTRE, radius=RADIUS, stiffness=2e4, smoothing=2e-4)
    gripper = kc.load_robot("three-finger-gripper")
    gripper = gripper.replace(**{f"rods.{name}.surroundings": (ball,) for name in FINGERS})
    closing, pulling = np.zeros((2, points, 6))
    closing[:, 3:] = np.linspace(0.0, most, points)[:, None]
    closed = kc.solvers.equilibria(gripper, closing)
    # the ball's push is what bends a finger's base outwards
    grips = np.stack([np.linalg.norm(closed.part(f"{name}_n")[:, 0, :2], axis=1) for name in FINGERS], axis=1)
    pulling[:, 0] = np.linspace(0.0, 5.0, points)
    palms = {}
    for name, tension in (("open", 0.0), ("closed", most)):
        pulling[:, 3:] = tension
        pulled = kc.solvers.equilibria(gripper, pulling)
        palms[name] = pulled.part("palm_p")[:, 0, 0]
    figure, axes = plt.subplots(1, 3, figsize=(9.0, 3.4), layout="constrained")
    for row, colour in ((0, "C7"), (-1, "C0")):
        for curve in kc.robots.Drawing.of(gripper).curves(closed.y[row]):
            axes[0].plot(1e3 * curve[..., 0], -1e3 * curve[..., 2], color=colour)
    axes[0].add_patch(plt.Circle((0.0, -1e3 * CENTRE[2]), 1e3 * RADIUS, color="C1", alpha=0.5))
    axes[0].set(
        xlabel="x (mm)", ylabel="height (mm)", aspect="equal", ylim=(-365.0, -225.0), xlim=(-45.0, 45.0)
    )
    axes[1].plot(closing[:, 3], grips[:, 0], "o-")
    axes[1].set(xlabel="tension of each finger (N)", ylabel="force of a finger on the ball (N)")
    for name, palm in palms.items():
        axes[2].plot(pulling[:, 0], 1e3 * (palm - palm[0]), "o-", label=f"fingers {name}")
    axes[2].set(xlabel="tension of the arm's first tendon (N)", ylabel="displacement of the palm (mm)")
    axes[2].legend()
    figure.savefig(out, dpi=150)
    moved = {name: f"{1e3 * np.ptp(palm):.1f} mm" for name, palm in palms.items()}
    print(f"a finger presses with {grips[-1, 0]:.2f} N; the palm moves by {moved}")
    return {"grips": grips, **palms}


if __name__ == "__main__":
    main()
