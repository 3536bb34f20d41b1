"""Validation: a cantilever that a moment bends into a half circle, compared with the closed form.

The rod has constant curvature M/EI, so its tip position is known exactly for any bending. The error falls
with the first power of the segment length for Euler's scheme, and with the second and the fourth for the
Lobatto schemes.
"""

import numpy as np

import knode_cosserat as kc


def main(out: str = "closed_form.png", most_nodes: int = 21) -> tuple[list[int], dict[str, list[float]]]:
    """Return the numbers of nodes, and the tip's error (m) for each scheme."""
    length, radius, E = 0.5, 0.005, 1e7
    EI = E * np.pi * radius**4 / 4
    curvature = np.pi / length  # 1/m: half a circle
    load = kc.robots.loads.PointWrench(moment=(0.0, EI * curvature, 0.0), at=1.0)
    exact = np.array([2.0, 0.0, 0.0]) / curvature
    nodes = [n for n in (6, 11, 21, 41, 81) if n <= most_nodes]
    errors: dict[str, list[float]] = {"euler": [], "lobatto2": [], "lobatto4": []}
    for n in nodes:
        rod = kc.robots.SlenderRod(
            length=length,
            radius=radius,
            density=1000.0,
            youngs_modulus=E,
            gravity=(0.0, 0.0, 0.0),
            loads=(load,),
            nodes=n,
        )
        for scheme, found in errors.items():
            tip = kc.equilibrium(rod, np.zeros(0), space=scheme).tip_position[0]
            found.append(float(np.linalg.norm(tip - exact)))
    figure = kc.figures.curves(nodes, errors, "nodes", "error of the tip [m]", log="xy", marker="o")
    figure.savefig(out)
    for scheme, found in errors.items():
        order = np.log(found[-2] / found[-1]) / np.log((nodes[-1] - 1) / (nodes[-2] - 1))
        print(f"{scheme}: {found[-1]:.1e} m at {nodes[-1]} nodes, of order {order:.2f}")
    return nodes, errors


if __name__ == "__main__":
    main()
