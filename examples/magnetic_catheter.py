"""A magnetic catheter follows a rotating field; slowly, its tip is on the circle of a closed form.

The rod is magnetised along its axis and a uniform field across it bends it to an elastica. Near its natural
frequency the catheter swings wider, and behind the field.
"""

import numpy as np
from scipy.integrate import quad
from scipy.optimize import brentq

import knode_cosserat as kc


def elastica_radius(load: float) -> float:
    """Return the tip's deflection over the length, for EI θ'' = -M B cos θ and load = M B L²/EI."""

    def along(function, end: float) -> float:
        # from θ'²/2 = load (sin θ_L - sin θ), with θ = θ_L - x²
        def integrand(x: float) -> float:
            rise = 2.0 * np.cos(end - x * x / 2.0) * np.sin(x * x / 2.0)
            return function(end - x * x) * 2.0 * x / np.sqrt(2.0 * load * rise)

        return float(quad(integrand, 0.0, np.sqrt(end))[0])

    end = brentq(lambda end: along(lambda _: 1.0, end) - 1.0, 1e-3, np.pi / 2 - 1e-6)
    return along(np.sin, end)


def main(out: str = "magnetic_catheter.png", turns: int = 3, size: float = 5e-3) -> dict[str, np.ndarray]:
    """Turn a field of `size` (T) about the catheter, slowly and fast; return the paths of the tip (m)."""
    # the closed form is that of a rod without weight
    robot = kc.load_robot("magnetic-catheter").replace(gravity=(0.0, 0.0, 0.0))
    magnetisation, EI = float(robot.loads[0].magnetisation[2]), float(robot.Kbt[0, 0])
    radius = float(robot.length * elastica_radius(magnetisation * size * robot.length**2 / EI))
    paths = {}
    for period in (4.0, 0.4):
        angle = 2.0 * np.pi * np.arange(1, 60 * turns + 1) / 60
        field = size * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
        begun = kc.equilibrium(robot, [size, 0.0, 0.0], space="lobatto4")
        moved = kc.simulate(robot, field, period / 60, space="lobatto4", initial=begun, between="linear")
        tip = np.asarray(moved.tip_position)
        paths[f"turn in {period:g} s"] = tip
        turned = np.degrees(np.angle(np.exp(1j * angle[-1]) / complex(*tip[-1, :2])))
        last = np.mean(np.hypot(*tip[-60:, :2].T))
        print(f"a turn in {period:g} s: tip at {1e3 * last:.2f} mm, {turned:.1f} degrees behind the field")
    circle = np.linspace(0.0, 2.0 * np.pi, 121)
    still = radius * np.stack([np.cos(circle), np.sin(circle), 0.0 * circle], axis=1)
    paths = {"closed form": still} | paths
    kc.figures.path(paths, view="xy").savefig(out)
    print(f"closed form: {1e3 * radius:.2f} mm; picture: {out}")
    return paths


if __name__ == "__main__":
    main()
