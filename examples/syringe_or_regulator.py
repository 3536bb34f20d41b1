"""A silicone arm with three chambers, held by pressure regulators or by syringes of water.

Both drives bend the arm in the same way as long as nothing else does. A payload then shows the difference:
water that is shut in cannot escape, so that the arm gives way less than one whose pressures are held.
"""

import dataclasses

import matplotlib.pyplot as plt
import numpy as np

import knode_cosserat as kc


def main(out: str = "syringe_or_regulator.png", points: int = 49, payload: float = 0.005) -> dict[str, float]:
    """Turn the arm in a circle by both drives, without and with a payload to the side of the tip."""
    arm = kc.load_robot("three-chamber-arm")
    chambers, *others = arm.effects
    drives = {
        "regulators": arm,
        "syringes": arm.replace(effects=(dataclasses.replace(chambers, drive="liquid"), *others)),
    }
    phase = np.linspace(0.0, 2.0 * np.pi, points)[:, None] - np.asarray(chambers.angles)
    volumes = 0.4e-6 * (1.0 + np.cos(phase))
    controls = {"syringes": volumes}
    turn = kc.solvers.equilibria(drives["syringes"], volumes)
    # the pressures that the syringes build up are what regulators have to hold
    controls["regulators"] = np.asarray(turn.part("effect0_pressure"))[:, 0]
    weight = kc.robots.loads.PointWrench(force=(0.0, 9.81 * payload, 0.0))

    figure, axes = plt.subplots(figsize=(4.2, 4.0), layout="constrained")
    axes.plot(*(1e3 * turn.tip_position[:, :2].T), "k", label="both, no payload")
    moved = {}
    for name, robot in drives.items():
        pulled = kc.solvers.equilibria(robot.replace(loads=(weight,)), controls[name])
        axes.plot(
            *(1e3 * pulled.tip_position[:, :2].T), "--", label=f"{name}, {1e3 * payload:g} g pull along y"
        )
        moved[name] = float(np.mean(np.linalg.norm(pulled.tip_position - turn.tip_position, axis=1)))
        print(f"{name}: the payload moves the tip by {1e3 * moved[name]:.1f} mm")
    axes.set(xlabel="x at the tip (mm)", ylabel="y at the tip (mm)", aspect="equal")
    axes.legend(fontsize=8)
    figure.savefig(out, dpi=150)
    print(f"pressures up to {1e-3 * controls['regulators'].max():.0f} kPa; picture: {out}")
    return moved


if __name__ == "__main__":
    main()
