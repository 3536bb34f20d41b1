"""A helical tendon bends and twists the rod; the direction of twist follows its handedness.

Routings are parts of a robot: straight, tapered, helical, polynomial or any function. Left-handed and
right-handed tendons are mirror images, and so are the resulting shapes.
"""

import numpy as np

import knode_cosserat as kc


def wound(turns: float) -> kc.robots.RoutedTendonRobot:
    """Return a soft rod of 30 cm with one tendon, 8 mm from its axis."""
    return kc.robots.RoutedTendonRobot(
        length=0.3,
        radius=0.004,
        density=1100.0,
        youngs_modulus=5e7,
        bending_damping=1e-3,
        nodes=21,
        gravity=(0.0, 0.0, 0.0),
        tendon_offset=0.008,
        tendon_angles=(0.0,),
        routing=(kc.robots.routing.Helical(radius=0.008, phase=0.0, turns=turns),),
    )


def main(out: str = "helical_tendons.png", tension: float = 6.0, turns: float = 1.0) -> list[kc.Trajectory]:
    """Return the equilibria with a straight, a left-handed and a right-handed tendon."""
    windings = (0.0, turns, -turns)
    shapes = [kc.equilibrium(wound(each), [tension], space="lobatto4") for each in windings]
    names = ("straight", f"{turns:g} turn to the left", f"{turns:g} turn to the right")
    rods = {name: np.asarray(shape.position[0]) for name, shape in zip(names, shapes, strict=True)}
    kc.figures.path(rods, view="xyz").savefig(out)
    for name, shape in zip(names, shapes, strict=True):
        twist = np.mean(np.asarray(shape.part("u"))[0, :, 2])
        print(f"{name}: tip at {np.round(shape.tip_position[0], 3)} m, twisted by {twist:.2f} rad/m")
    return shapes


if __name__ == "__main__":
    main()
