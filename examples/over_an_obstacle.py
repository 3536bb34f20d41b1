"""A soft slender robot is pushed along a table and over the back of a cylinder: contact and friction."""

import argparse
from pathlib import Path

import numpy as np

import knode_cosserat as kc


def simulate(seconds: float = 6.0, dt: float = 0.02) -> kc.Trajectory:
    """Push the base forward, and lift it a little on the way."""
    robot = kc.load_robot("soft-slender-robot")
    steps = round(seconds / dt)
    part = np.arange(1, steps + 1) / steps
    forward = 0.32 * (3 * part**2 - 2 * part**3)
    lifted = 0.02 * np.sin(np.pi * part) ** 2
    lying = kc.equilibrium(robot, np.zeros(3))
    control = np.stack([forward, lifted, 0.0 * part], axis=1)
    return kc.simulate(robot, control, dt, initial=lying)


def draw(found: kc.Trajectory, path: Path) -> None:
    """The rod from the side, from early (light) to late (dark)."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Circle

    cylinder = found.system.surroundings[1]
    figure = Figure(figsize=(8, 2.2), layout="constrained")
    axes = figure.subplots()
    axes.axhline(0.0, color="0.5")
    axes.add_patch(Circle((cylinder.point[0], cylinder.point[2]), cylinder.radius, color="0.8"))
    rows = np.linspace(0, len(found.time) - 1, 10).astype(int)
    for k, row in enumerate(rows):
        axes.plot(found.position[row, :, 0], found.position[row, :, 2], color="C0", alpha=0.2 + 0.08 * k)
    axes.set(
        xlabel="x (m)",
        ylabel="z (m)",
        aspect="equal",
        ylim=(-0.02, 0.08),
        title="A soft robot climbs over a cylinder",
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150)


def main(out: Path) -> None:
    """Simulate, draw, and say what came of the steps."""
    found = simulate()
    draw(found, out / "over_an_obstacle.png")
    harder = int(np.sum(found.result > 0))
    print(f"{len(found.time) - 1} steps solved, {harder} of them by a fallback; picture in {out}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("examples-out"))
    main(parser.parse_args().out)
